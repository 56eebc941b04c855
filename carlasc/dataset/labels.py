"""The fields of a sample from labels and grids: mapped class ids, known voxels, and their
certainty.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from numbers import Integral

import numpy as np
from numpy.typing import ArrayLike

from carlasc.core.arrays import AnyArray, AnyFloatArray, BoolArray, Float32Array, LabelArray
from carlasc.core.classes import ClassTable, Remap
from carlasc.core.grids import VoxelFlag, is_confident
from carlasc.core.tables import benchmark_remap
from carlasc.dataset.fields import Values
from carlasc.errors import ArgumentError, FormatError
from carlasc.storage import Sequence, layout
from carlasc.storage.class_files import read_remap
from carlasc.storage.field_files import dense_velocity

RemapLike = str | Remap | Mapping[int, int] | ArrayLike | None
"""Type of `remap` arguments: a name in `carlasc.core.REMAPS`, a JSON or YAML file of classes with a
map, a Remap, a mapping or table of ids, "auto"; None keeps the ids.
"""

_GREY = (128, 128, 128)


class LabelMap:
    """Maps the labels of one class table to the labels of samples.

    Attributes:
        name: name of the remap; "none" if ids are unchanged.
        source: class table of the input labels.
        target: class table of the labels in samples.
    """

    def __init__(self, remap: RemapLike, classes: ClassTable) -> None:
        """Create the lookup table. `classes` is the class table of the data."""
        if isinstance(remap, str) and remap == "auto":
            remap = benchmark_remap(classes)
        self._remap = None if remap is None else _as_remap(remap, classes)
        self.name = self._remap.name if self._remap else "none"
        self.source = self._remap.source if self._remap else classes
        self.target = self._remap.target if self._remap else classes
        kept = Remap("none", classes, classes, {i: i for i in classes.names})
        self._table = (self._remap or kept).table

    def __call__(self, labels: LabelArray, where: str) -> LabelArray:
        """Map labels of any shape to the target table, as uint8, or int32 if ids exceed 255.

        Raises:
            FormatError: an id is not in the source table. `where` is the file named in the message.
        """
        from carlasc.dataset.stacking import look_up

        # torch cannot compute with uint16
        dtype = np.dtype(np.int32) if self.target.dtype.itemsize > 1 else self.target.dtype
        mapped = look_up(labels, self._table, dtype)
        if mapped is None and self._remap is not None:
            return self._remap(labels, where)  # raises an error with the id
        if mapped is None:
            self.source.check(labels, where)  # raises an error with the ids and a proposal
            raise FormatError(where, expected=f"class ids of {self.source.name}")
        return mapped


def _as_remap(remap: str | Remap | Mapping[int, int] | ArrayLike, classes: ClassTable) -> Remap:
    if isinstance(remap, Remap):
        return remap
    if isinstance(remap, str):
        return read_remap(remap)
    if isinstance(remap, Mapping):
        if wrong := [f"{a!r}: {b!r}" for a, b in remap.items() if not _are_ids(a, b)]:
            raise ArgumentError("remap", expected="whole numbers as ids", found=wrong[0])
        mapping = {int(old): int(new) for old, new in remap.items()}
    else:
        table = np.asarray(remap)
        if table.ndim != 1 or table.dtype.kind not in "iu" or not table.size:
            raise ArgumentError(
                "remap", expected="a name, a mapping or a table of ids", found=type(remap).__name__
            )
        mapping = dict(enumerate(table.tolist()))
    if not mapping or min(mapping.values()) < 0:
        raise ArgumentError(
            "remap", expected="ids of 0 or more", found="a negative id" if mapping else "no ids"
        )
    ids = sorted(set(mapping.values()))
    target = ClassTable("custom", {i: f"class {i}" for i in ids}, dict.fromkeys(ids, _GREY))
    return Remap("custom", classes, target, mapping)


def _are_ids(*values: object) -> bool:
    return all(isinstance(value, Integral) for value in values)


_PARTS = {  # field of a sample -> fields of the grid
    "labels": ("labels",),
    "known": ("counts",),
    "counts": ("counts",),
    "posterior": ("counts", "occupied", "classes"),
    "occupied": ("occupied",),
    "flags": ("flags",),
    "views": ("views",),
    "instances": ("instance",),
    "voxel_flow": ("velocity",),
    "camera_visible": ("seen",),
}
OF_GRID = frozenset(_PARTS)
"""The fields of a sample that come from a grid."""
# types in samples
_PLAIN: dict[str, type[np.generic]] = {
    "occupied": np.float32,
    "flags": np.uint8,
    "views": np.int32,
    "instances": np.int64,
    "camera_visible": np.uint8,
}


@dataclass(frozen=True)
class GridFields:
    """The fields of a sample that come from a grid, and the rule for known voxels.

    Attributes:
        fields: names of fields. Fields that do not come from a grid are ignored.
        inferred: whether completed voxels, which no scan saw, count as known.
        min_confidence: minimum probability of known voxels: a voxel is known if it is free or
            occupied with at least this probability.

    Raises:
        ArgumentError: `min_confidence` is not in 0 <= c < 1.
    """

    fields: frozenset[str]
    inferred: bool
    min_confidence: float

    def __post_init__(self) -> None:
        if not 0 <= self.min_confidence < 1:
            found = str(self.min_confidence)
            raise ArgumentError(
                "min_confidence", expected="a probability from 0 to below 1", found=found
            )

    def parts(self, grids: Sequence, grid: str) -> set[str]:
        """Return the names of the required fields of the grid."""
        parts = {part for field in self.fields & OF_GRID for part in _PARTS[field]}
        if self._needs_known:
            parts |= set() if self.inferred else {"flags"}
            parts |= {"occupied"} if self.min_confidence else set()
        if (
            "counts" in parts
            and "counts" not in self.fields
            and not len(grids.frames(f"{grid}/counts"))
        ):
            # all voxels are known in all frames with labels
            parts = parts - {"counts"} | {"labels"}
        return parts

    def read(self, grids: Sequence, grid: str, frame: int, label_map: LabelMap) -> Values:
        """Read the fields of a frame.

        Raises:
            FormatError: the content of a file is not valid; the message names the file.
        """

        def read(part: str) -> AnyArray:
            return grids.read(f"{grid}/{part}", frame)

        def where(part: str) -> str:
            return f"{grids.location}: {grid}/{part} of frame {frame}"

        sample: Values = {
            name: np.array(read(*_PARTS[name]), _PLAIN[name])
            for name in self.fields & _PLAIN.keys()
        }
        if "voxel_flow" in self.fields:
            sample["voxel_flow"] = dense_velocity(
                read("velocity"), grids.grids[grid].size, where("velocity")
            )
        if "labels" in self.fields:
            sample["labels"] = label_map(read("labels"), where("labels"))
        if "counts" in self.fields:
            sample["counts"] = np.array(read("counts"), np.float32)
        if self._needs_known:
            counted = len(grids.frames(f"{grid}/counts"))
            known = read("counts") > 0 if counted else np.ones(grids.grids[grid].size, np.bool_)
            if not self.inferred:
                known = known & ((read("flags") & int(VoxelFlag.INFERRED)) == 0)
            if self.min_confidence:
                known = known & is_confident(read("occupied"), self.min_confidence)
            sample["known"] = known
        if "posterior" in self.fields:
            occupied = read("occupied")
            classes = read("classes")
            sample["posterior"] = soft_labels(
                occupied, classes, sample["known"], label_map, where("classes")
            )
        return sample

    @property
    def _needs_known(self) -> bool:
        return not self.fields.isdisjoint(("known", "posterior"))


def soft_labels(
    occupied: AnyFloatArray,
    classes: AnyArray,
    known: BoolArray,
    label_map: LabelMap,
    where: str,
) -> Float32Array:
    """Return the probability of each class in each voxel.

    If a voxel is occupied with probability p, and by a class with probability c given that it is
    occupied, the soft labels are 1 - p for free (class 0) and p * c for the class. Classes that map
    to the same id are added up. If the class probabilities of a voxel do not sum to 1, neither do
    its soft labels.

    Args:
        occupied: (X, Y, Z), the field `<grid>/occupied`.
        classes: (M,), the field `<grid>/classes`.
        known: (X, Y, Z) bool; other voxels get zeros.
        label_map: maps the class ids of the grid.
        where: the field, for errors.

    Returns:
        (K, X, Y, Z) float32, where K is the largest id of the target table plus 1.

    Raises:
        FormatError: a voxel is not in the grid, or a class id is not in the map.
    """
    voxel = classes["voxel"].astype(np.int64)
    count = known.size
    if len(voxel) and not 0 <= int(voxel.min()) <= int(voxel.max()) < count:
        outside = voxel[(voxel < 0) | (voxel >= count)]
        raise FormatError(where, expected=f"voxels 0 to {count - 1}", found=outside[0])
    label = label_map(np.ascontiguousarray(classes["label"]), where).astype(np.int64)
    p = np.where(known, occupied, 0).astype(np.float32).reshape(-1)
    posterior = np.zeros((max(label_map.target.names) + 1, count), np.float32)
    posterior[0] = known.reshape(-1) - p
    share = classes["votes"].astype(np.float32) / np.float32(layout.CERTAIN)
    np.add.at(posterior.reshape(-1), label * count + voxel, p[voxel] * share)
    return posterior.reshape(-1, *known.shape)
