"""The content of carlasc.json, and the version of the files that carlasc adds.

See `docs/format.md#carlasc-json`.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, get_args

from carlasc.core.choices import Axes as Axes  # noqa: PLC0414 (part of this module)
from carlasc.core.classes import ClassTable
from carlasc.core.tables import CARLA, table_from_json, table_to_json
from carlasc.errors import FormatError
from carlasc.storage.files import parse_json, to_json
from carlasc.storage.layout import FORMAT, check_format

PREDICTED = "predicted by "
"""Prefix of the key `labels` of carlasc.json for predicted labels; the name of the network follows.
"""
_AXES: dict[str, Axes] = {"carlasc": "left", "kitti": "right"}  # by the `frame` of version 1


@dataclass(frozen=True)
class Metadata:
    """The content of carlasc.json. The defaults apply if the file does not exist.

    Attributes:
        axes: "left" (left-handed, y to the right: CarlaSC, CARLA) or "right" (right-handed, y to
            the left: SemanticKITTI, ROS).
        classes: class table of the labels.
        sensor: description of the sensor.
        min_range_m: points nearer than this are left out of grids (the roof of the ego vehicle),
            metres.
        max_range_m: points farther than this are left out of grids, metres.
        source: data that the sequence was made from.
        extra: other keys, unchanged.
    """

    axes: Axes = "left"
    classes: ClassTable = CARLA
    sensor: str | None = None
    min_range_m: float | None = None
    max_range_m: float | None = None
    source: str | None = None
    extra: Mapping[str, Any] = field(default_factory=dict)

    @property
    def has_rays(self) -> bool:
        """Whether points have rays from a known sensor position.

        Without rays, there is no free space.
        """
        return self.extra.get("rays") is not False

    @property
    def predicted(self) -> str | None:
        """The key `labels`, "predicted by ...", if labels are predicted; otherwise None."""
        labels = self.extra.get("labels")
        return labels if isinstance(labels, str) and labels.startswith(PREDICTED) else None

    @classmethod
    def from_json(cls, data: bytes, where: str) -> Metadata:
        """Read carlasc.json, of this version or an older one; `where` is the file named in errors.

        Raises:
            FormatError: it is not a JSON object, is of a newer version, or has unknown axes or an
                unknown or damaged class table.
        """
        values = parse_json(data, where)
        check_format(values.pop("format", 1), where)
        ranges: dict[str, Any] = {
            name: values.pop(name, None) for name in ("min_range_m", "max_range_m")
        }
        for name, value in ranges.items():
            if value is not None and (
                isinstance(value, bool) or not isinstance(value, int | float) or value < 0
            ):
                raise FormatError(
                    where, expected=f"a number of metres in {name}", found=repr(value)
                )
        return cls(
            _read_axes(values, where),
            table_from_json(values.pop("classes", CARLA.name), where),
            values.pop("sensor", None),
            **ranges,
            source=values.pop("source", None),
            extra=values,
        )

    def to_json(self) -> bytes:
        """Return the bytes of carlasc.json.

        A class table that is not built into carlasc is written in full.
        """
        values = {"format": FORMAT, **vars(self), "classes": table_to_json(self.classes)}
        extra = values.pop("extra")
        return to_json({key: value for key, value in values.items() if value is not None} | extra)


def _read_axes(values: dict[str, Any], where: str) -> Axes:
    """Remove `axes` from the values of carlasc.json (`frame` in version 1), and return them."""
    frame, axes = values.pop("frame", None), values.pop("axes", None)
    if frame is not None and frame not in _AXES:
        raise FormatError(where, expected=f"{' or '.join(_AXES)} in frame", found=repr(frame))
    if axes is not None and axes not in get_args(Axes):
        raise FormatError(
            where, expected=f"{' or '.join(get_args(Axes))} in axes", found=repr(axes)
        )
    meant: Axes | None = None if frame is None else _AXES[frame]
    if axes is not None and meant is not None and axes != meant:
        raise FormatError(where, expected=f"the axes {meant}, as frame {frame} says", found=axes)
    return axes or meant or "left"
