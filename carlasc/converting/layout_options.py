"""Options for the sequences of a conversion, and the ids and axes of a data set that follow from
them.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from carlasc.converting.protocol import Converter
from carlasc.core.arrays import LabelArray, Uint32Array
from carlasc.core.choices import FlowSource as FlowSource  # noqa: PLC0414 (part of this module)
from carlasc.core.choices import Images as Images  # noqa: PLC0414 (part of this module)
from carlasc.core.classes import ClassTable, Remap
from carlasc.errors import ArgumentError, FormatError, check_choice
from carlasc.storage.metadata import Axes

_IDS = np.iinfo(np.uint16).max + 1
_UNKNOWN = np.uint32(np.iinfo(np.uint32).max)
_MAX_LISTED = 8


@dataclass(frozen=True)
class LayoutOptions:
    """How a conversion writes sequences.

    Attributes:
        classes: classes of the labels. "carla": CarlaSC's classes. The name of the data set's own
            class table, such as "semantickitti": its ids are kept. "auto": the ids of SemanticKITTI
            are kept, because its tools need them, and all others become "carla".
        axes: axes of the output. "left": y is mirrored, as in CarlaSC, which is left-handed.
            "right": right-handed, as in the data set.
        flow: scene flow. "auto": the velocity of each actor, from its tracked boxes, otherwise
            estimated from the points of numbered actors. "none": no flow.
        allow_unknown: treat class ids that the table does not have as unlabelled.
        images: images of cameras. "copy": copied into the output. "link": only their paths are
            written. "none": left out. The calibration of the cameras is always written.

    Raises:
        ArgumentError: an unknown value of `axes`, `flow` or `images`.
    """

    classes: str = "auto"
    axes: Axes = "left"
    flow: FlowSource = "auto"
    allow_unknown: bool = False
    images: Images = "none"

    def __post_init__(self) -> None:
        check_choice("axes", self.axes, Axes)
        check_choice("images", self.images, Images)
        check_choice("flow", self.flow, FlowSource)

    def of(self, converter: Converter) -> AxesAndClasses:
        """Return the axes and the classes in which the data of a converter are written.

        Raises:
            ArgumentError: `classes` is neither "auto", "carla" nor the name of the converter's
                class table.
        """
        own = converter.classes.name
        check_choice("classes", self.classes, ("auto", "carla", own))
        usual = own if converter.keeps_classes else "carla"
        if (usual if self.classes == "auto" else self.classes) == own:
            return AxesAndClasses(converter.classes, None, self.axes == "left", self.allow_unknown)
        if converter.to_carla is None:
            raise ArgumentError(
                "classes",
                expected=f"{converter.classes.name}, because no map to CarlaSC's classes exists",
                found="carla",
            )
        return AxesAndClasses(
            converter.classes, converter.to_carla, self.axes == "left", self.allow_unknown
        )


@dataclass(frozen=True)
class AxesAndClasses:
    """The axes and the classes in which frames of a data set are written.

    Attributes:
        source: class table of the ids that are read.
        remap: maps them to other ids; None keeps them.
        mirrored: whether y is mirrored, from right-handed axes to CarlaSC's left-handed ones.
        allow_unknown: whether ids that the table does not have become unlabelled.
    """

    source: ClassTable
    remap: Remap | None
    mirrored: bool
    allow_unknown: bool = False

    @property
    def classes(self) -> ClassTable:
        """Table of the ids that are written."""
        return self.source if self.remap is None else self.remap.target

    def map_labels(self, labels: LabelArray, where: str) -> Uint32Array:
        """Return the ids that are written for the ids that were read.

        Raises:
            FormatError: an id is unknown; the message names it and its frequency. `where` names the
                labels.
        """
        ids = self.source.names if self.remap is None else self.remap.mapping
        lookup = _lookup_table(
            tuple(ids), tuple(ids if self.remap is None else self.remap.mapping.values())
        )
        mapped = lookup[labels if labels.dtype.itemsize <= 2 else np.minimum(labels, _IDS - 1)]
        if mapped.size and int(mapped.max()) == _UNKNOWN:
            unknown = mapped == _UNKNOWN
            if not self.allow_unknown:
                raise FormatError(
                    where,
                    expected=f"class ids of {self.source.name}",
                    found=_list_ids(labels[unknown]),
                    advice="treat them as unlabelled with `allow_unknown=True`",
                )
            mapped[unknown] = 0
        return mapped


@lru_cache(maxsize=8)
def _lookup_table(ids: tuple[int, ...], targets: tuple[int, ...]) -> Uint32Array:
    """Return the target of every 16-bit id, `_UNKNOWN` where it has none."""
    lookup = np.full(_IDS, _UNKNOWN, np.uint32)
    lookup[list(ids)] = targets
    return lookup


def _list_ids(labels: LabelArray) -> str:
    ids, counts = np.unique(labels, return_counts=True)
    named = [f"{i} ({n} times)" for i, n in zip(ids.tolist(), counts.tolist(), strict=True)]
    more = f" and {len(named) - _MAX_LISTED} more" if len(named) > _MAX_LISTED else ""
    return ", ".join(named[:_MAX_LISTED]) + more
