"""Sequences of the layout as SemanticKITTI's files (FORMAT section 6)."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from carlasc import storage
from carlasc.converting import Exporter
from carlasc.converting.frames import MIRROR, VOXEL_FILES
from carlasc.core.classes import ClassTable
from carlasc.core.geometry import Transform
from carlasc.core.grids import GridSpec
from carlasc.core.tables import REMAPS, SEMANTICKITTI
from carlasc.errors import ArgumentError, FormatError, MissingDataError
from carlasc.storage import layout
from carlasc_converters.kitti_voxels import MASKS, pack_bits
from carlasc_converters.occlusion import occluded_voxels

_PREDICTED = {  # classes that networks are trained on -> raw ids
    "carlasc11": (0, 50, 51, 99, 30, 80, 40, 49, 48, 70, 10),
    "semantickitti19": (0, 10, 11, 15, 18, 20, 30, 31, 32, 40, 44, 48, 49, 50, 51, 70, 71, 72, 80, 81),
}
_CALIBRATION = "".join(
    f"{name}: {' '.join(f'{value:.12e}' for value in np.eye(4)[:3].ravel())}\n"
    for name in ("P0", "P1", "P2", "P3", "Tr")
)


class KittiExporter(Exporter):
    """Writes velodyne/, labels/, voxels/ or predictions/, poses.txt, calib.txt and times.txt.

    Args:
        grid: which grid goes to voxels/ (predictions/); None: the one with most voxels.
        predictions: whether grids are a network's output: they go to predictions/ as its evaluator reads them, and nothing else is written.
    """

    def __init__(self, grid: str | None = None, *, predictions: bool = False) -> None:
        self.grid, self.predictions = grid, predictions

    def folders(self, names: Sequence[str]) -> dict[str, str]:
        """Return sequences/NN: a name's own number where it ends in one, KITTI_08, else the next that is free."""
        numbers = {name: match[1] for name in names if (match := re.search(r"KITTI_(\d\d)$", name))}
        free = (f"{number:02d}" for number in range(10_000) if f"{number:02d}" not in numbers.values())
        return {name: f"sequences/{numbers.get(name) or next(free)}" for name in names}

    def documents(self, sequence: storage.Sequence) -> dict[str, bytes]:
        """Return poses of the LiDAR, which an identity Tr makes those of the camera too, and times."""
        if self.predictions:
            self._grid_of(sequence)
            return {}
        documents = {}
        if layout.POSES in sequence.documents():
            documents["poses.txt"] = layout.encode_poses(_right_handed(sequence, sequence.poses))
            documents["calib.txt"] = _CALIBRATION.encode()
        if layout.TIMES in sequence.documents():
            documents["times.txt"] = layout.encode_times(sequence.times)
        return documents

    def frame_files(self, sequence: storage.Sequence, frame: int) -> tuple[str, ...]:
        """Return what a frame has: a scan, labels, voxels or predictions."""
        if self.predictions:
            has = frame in sequence.frames(f"{self._grid_of(sequence)}/labels")
            return (f"predictions/{frame:06d}.label",) if has else ()
        names = [f"velodyne/{frame:06d}.bin"] if frame in sequence.frames("points") else []
        names += [f"labels/{frame:06d}.label"] if frame in sequence.frames("labels") else []
        if sequence.grids and frame in sequence.frames(f"{self._grid_of(sequence)}/labels"):
            names += [f"voxels/{frame:06d}{suffix}" for suffix in (".label", *MASKS)]
        return tuple(names)

    def make_frame(self, sequence: storage.Sequence, frame: int) -> dict[str, bytes | memoryview]:
        """Return the frame's files."""
        made: dict[str, bytes | memoryview] = {}
        wanted = self.frame_files(sequence, frame)
        if f"velodyne/{frame:06d}.bin" in wanted:
            points = np.asarray(sequence.read("points", frame), "<f4")
            made[f"velodyne/{frame:06d}.bin"] = (points * _mirror_row(sequence)).tobytes()
        if f"labels/{frame:06d}.label" in wanted:
            where = f"{sequence.location}: labels of frame {frame}"
            labels = _raw_ids(sequence.metadata.classes, sequence.read("labels", frame), where)
            made[f"labels/{frame:06d}.label"] = labels.astype("<u4").tobytes()
        if f"predictions/{frame:06d}.label" in wanted:
            made[f"predictions/{frame:06d}.label"] = self._labels(sequence, frame).astype("<u2").tobytes()
        if f"voxels/{frame:06d}.label" in wanted:
            made |= self._voxels(sequence, frame)
        return made

    def _voxels(self, sequence: storage.Sequence, frame: int) -> Mapping[str, bytes]:
        """Return the original voxel files where they were kept, else files made from the grid."""
        kept = _kept_files(sequence, frame) if self.grid is None else {}
        if kept:
            return {f"voxels/{name}": data for name, data in kept.items()}
        name = self._grid_of(sequence)
        labels, counts = self._labels(sequence, frame), self._counts(sequence, frame)
        spec = right_handed_grid(sequence, sequence.grids[name])
        invalid = counts == 0
        files = {
            ".label": labels.astype("<u2").tobytes(),
            ".invalid": pack_bits(invalid),
            ".occluded": pack_bits(occluded_voxels(labels > 0, spec)),
            ".bin": pack_bits(self._occupancy(sequence, frame, spec)),
        }
        return {f"voxels/{frame:06d}{suffix}": data for suffix, data in files.items()}

    def _labels(self, sequence: storage.Sequence, frame: int) -> NDArray[np.unsignedinteger]:
        """Return (X, Y, Z) raw ids, right-handed."""
        name = self._grid_of(sequence)
        where = f"{sequence.location}: {name} of frame {frame}"
        labels = _raw_ids(sequence.classes_of(name), sequence.read(f"{name}/labels", frame), where)
        return _flipped(sequence, labels)

    def _counts(self, sequence: storage.Sequence, frame: int) -> NDArray[np.floating]:
        name = self._grid_of(sequence)
        if frame not in sequence.frames(f"{name}/counts"):
            raise MissingDataError(
                f"{sequence.location}/{name}",
                expected=f"counts of frame {frame}, which tell what is known",
                found="none",
                advice="a prediction? Then --predictions",
            )
        return _flipped(sequence, np.asarray(sequence.read(f"{name}/counts", frame)))

    def _occupancy(self, sequence: storage.Sequence, frame: int, spec: GridSpec) -> NDArray[np.bool_]:
        """Return which voxels the frame's own scan has points in."""
        occupancy = np.zeros(spec.num_voxels, np.bool_)
        if frame in sequence.frames("points"):
            points = (sequence.read("points", frame) * _mirror_row(sequence))[:, :3]
            distance = np.linalg.norm(points.astype(np.float64), axis=1)
            low, high = sequence.metadata.min_range_m or 0.0, sequence.metadata.max_range_m or np.inf
            index = spec.flat_index(points[(distance >= low) & (distance <= high)])
            occupancy[index[index >= 0]] = True
        return occupancy.reshape(spec.size)

    def _grid_of(self, sequence: storage.Sequence) -> str:
        """Return the grid to export.

        Raises:
            MissingDataError: there is none, or none of that name.
            ArgumentError: it is not Cartesian.
        """
        grids = sequence.grids
        if not grids or (self.grid is not None and self.grid not in grids):
            wanted = self.grid or "a grid"
            raise MissingDataError(sequence.location, expected=f"{wanted}", found=f"{', '.join(grids) or 'none'}")
        name = self.grid or max(grids, key=lambda grid: grids[grid].num_voxels)
        if grids[name].coordinates != "cartesian":
            raise ArgumentError(f"{sequence.location}/{name}", expected="a Cartesian grid", found="a cylindrical one")
        return name


def right_handed_grid(sequence: storage.Sequence, spec: GridSpec) -> GridSpec:
    """Return a grid's geometry in SemanticKITTI's frame: y's bounds change places where the sequence is mirrored."""
    if sequence.metadata.axes == "right":
        return spec
    (x0, y0, z0), (x1, y1, z1) = spec.lower, spec.upper
    return GridSpec(spec.coordinates, spec.size, (x0, -y1, z0), (x1, -y0, z1))


def _kept_files(sequence: storage.Sequence, frame: int) -> dict[str, bytes]:
    """Return the files that convert kept beside the grid."""
    kept = {}
    for suffix in (".label", *MASKS):
        try:
            kept[f"{frame:06d}{suffix}"] = sequence.read_document(f"{VOXEL_FILES}/{frame:06d}{suffix}")
        except (MissingDataError, FileNotFoundError):
            continue
    return kept


def _raw_ids(classes: ClassTable, labels: NDArray[np.integer], where: str) -> NDArray[np.unsignedinteger]:
    """Take class ids to SemanticKITTI's.

    Raises:
        FormatError: an id, or the table, has no counterpart there.
    """
    if classes.name == SEMANTICKITTI.name:
        classes.check(labels, where)
        return np.asarray(labels, np.uint32)
    if classes.name == "carla":
        return REMAPS["carla_to_semantickitti"](labels, where)
    if classes.name not in _PREDICTED:
        raise FormatError(
            where,
            expected=f"classes carla, semantickitti, {' or '.join(_PREDICTED)}",
            found=f"{classes.name}",
            advice="they have no counterpart in SemanticKITTI",
        )
    classes.check(labels, where)
    return np.array(_PREDICTED[classes.name], np.uint16)[labels]


def _right_handed(sequence: storage.Sequence, poses: NDArray[np.float64]) -> Transform:
    return poses if sequence.metadata.axes == "right" else MIRROR @ poses @ MIRROR


def _mirror_row(sequence: storage.Sequence) -> NDArray[np.float32]:
    return np.array([1, 1 if sequence.metadata.axes == "right" else -1, 1, 1], np.float32)


def _flipped(sequence: storage.Sequence, grid: NDArray[Any]) -> NDArray[Any]:
    return grid if sequence.metadata.axes == "right" else grid[:, ::-1]
