"""Sequences of the layout as SemanticKITTI's files: see the format page, `docs/format.md#semantickitti`."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from carlasc import storage
from carlasc.converting import VOXEL_FILES, Exporter, mirror_grid, mirror_points, mirror_poses, mirror_spec
from carlasc.core.classes import ClassTable, Remap
from carlasc.core.grids import GridSpec
from carlasc.core.tables import CARLASC11, REMAPS, SEMANTICKITTI, SEMANTICKITTI19
from carlasc.errors import ArgumentError, FormatError, MissingDataError
from carlasc.storage import layout
from carlasc_converters.kitti_voxels import MASKS, pack_bits
from carlasc_converters.occlusion import occluded_voxels


def _by_name(classes: ClassTable, names: Sequence[str]) -> Remap:
    """Return the remap of a table, in the order of its ids, to the classes of SemanticKITTI with these names."""
    targets = map(SEMANTICKITTI.id_of, names)
    return Remap(
        f"{classes.name}_to_semantickitti", classes, SEMANTICKITTI, dict(zip(classes.names, targets, strict=True))
    )


_NAMES_OF_11 = "unlabeled building fence other-object person pole road other-ground sidewalk vegetation car"
_TO_KITTI = {
    remap.source.name: remap
    for remap in (
        REMAPS["carla_to_semantickitti"],
        _by_name(CARLASC11, _NAMES_OF_11.split()),
        _by_name(SEMANTICKITTI19, tuple(SEMANTICKITTI19.names.values())),
    )
}
_CALIBRATION = "".join(
    f"{name}: {' '.join(f'{value:.12e}' for value in np.eye(4)[:3].ravel())}\n"
    for name in ("P0", "P1", "P2", "P3", "Tr")
)


class KittiExporter(Exporter):
    """Writes velodyne/, labels/, voxels/ or predictions/, poses.txt, calib.txt and times.txt.

    Args:
        grid: name of the grid that goes to voxels/ or predictions/; None takes the one with the most voxels.
        predictions: whether grids are the output of a network. They then go to predictions/, where SemanticKITTI's evaluator reads
            them, and nothing else is written.
    """

    def __init__(self, grid: str | None = None, *, predictions: bool = False) -> None:
        self.grid, self.predictions = grid, predictions

    def folders(self, names: Sequence[str]) -> dict[str, str]:
        """Return sequences/NN for each name: 08 for KITTI_08, and the next free number for other names."""
        numbers = {name: match[1] for name in names if (match := re.search(r"KITTI_(\d\d)$", name))}
        free = (f"{number:02d}" for number in range(10_000) if f"{number:02d}" not in numbers.values())
        return {name: f"sequences/{numbers.get(name) or next(free)}" for name in names}

    def documents(self, sequence: storage.Sequence) -> dict[str, bytes]:
        """Return poses, calibration and times. The poses are those of the LiDAR, and Tr is the identity."""
        if self.predictions:
            self._grid_of(sequence)
            return {}
        documents = {}
        if layout.POSES in sequence.documents():
            documents["poses.txt"] = layout.encode_poses(
                sequence.poses if _is_right_handed(sequence) else mirror_poses(sequence.poses)
            )
            documents["calib.txt"] = _CALIBRATION.encode()
        if layout.TIMES in sequence.documents():
            documents["times.txt"] = layout.encode_times(sequence.times)
        return documents

    def frame_files(self, sequence: storage.Sequence, frame: int) -> tuple[str, ...]:
        """Return the files of a frame: its scan, labels and voxels, or its prediction."""
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
            made[f"velodyne/{frame:06d}.bin"] = self._points(sequence, frame).astype("<f4").tobytes()
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
        """Return the original voxel files if they were kept, else files made from the grid."""
        kept = _kept_files(sequence, frame) if self.grid is None else {}
        if kept:
            return {f"voxels/{name}": data for name, data in kept.items()}
        name = self._grid_of(sequence)
        labels, counts = self._labels(sequence, frame), self._counts(sequence, frame)
        spec = sequence.grids[name]
        spec = spec if _is_right_handed(sequence) else mirror_spec(spec)
        files = {
            ".label": labels.astype("<u2").tobytes(),
            ".invalid": pack_bits(counts == 0),
            ".occluded": pack_bits(occluded_voxels(labels > 0, spec)),
            ".bin": pack_bits(self._occupancy(sequence, frame, spec)),
        }
        return {f"voxels/{frame:06d}{suffix}": data for suffix, data in files.items()}

    def _points(self, sequence: storage.Sequence, frame: int) -> NDArray[np.float32]:
        """Return (N, 4) points and remission, right-handed."""
        points = np.asarray(sequence.read("points", frame), np.float32)
        return points if _is_right_handed(sequence) else mirror_points(points)

    def _labels(self, sequence: storage.Sequence, frame: int) -> NDArray[np.unsignedinteger]:
        """Return (X, Y, Z) ids of SemanticKITTI, right-handed."""
        name = self._grid_of(sequence)
        where = f"{sequence.location}: {name} of frame {frame}"
        labels = _raw_ids(sequence.classes_of(name), sequence.read(f"{name}/labels", frame), where)
        return labels if _is_right_handed(sequence) else mirror_grid(labels)

    def _counts(self, sequence: storage.Sequence, frame: int) -> NDArray[np.floating]:
        name = self._grid_of(sequence)
        if frame not in sequence.frames(f"{name}/counts"):
            raise MissingDataError(
                f"{sequence.location}/{name}",
                expected=f"counts of frame {frame}, which say which voxels are known",
                found="none",
                advice="if the grids are predictions, give `predictions=True`",
            )
        counts = np.asarray(sequence.read(f"{name}/counts", frame))
        return counts if _is_right_handed(sequence) else mirror_grid(counts)

    def _occupancy(self, sequence: storage.Sequence, frame: int, spec: GridSpec) -> NDArray[np.bool_]:
        """Return the voxels that hold a point of the frame's own scan."""
        occupancy = np.zeros(spec.num_voxels, np.bool_)
        if frame in sequence.frames("points"):
            points = self._points(sequence, frame)[:, :3]
            distance = np.linalg.norm(points.astype(np.float64), axis=1)
            low, high = sequence.metadata.min_range_m or 0.0, sequence.metadata.max_range_m or np.inf
            index = spec.flat_index(points[(distance >= low) & (distance <= high)])
            occupancy[index[index >= 0]] = True
        return occupancy.reshape(spec.size)

    def _grid_of(self, sequence: storage.Sequence) -> str:
        """Return the grid to export.

        Raises:
            MissingDataError: the sequence has no grid, or none of that name.
            ArgumentError: the grid is not Cartesian.
        """
        grids = sequence.grids
        if not grids or (self.grid is not None and self.grid not in grids):
            wanted = "a grid" if self.grid is None else f"the grid {self.grid}"
            raise MissingDataError(sequence.location, expected=wanted, found=", ".join(grids) or "none")
        name = self.grid or max(grids, key=lambda grid: grids[grid].num_voxels)
        if grids[name].coordinates != "cartesian":
            raise ArgumentError(
                "grid", expected="a Cartesian grid", found=f"{sequence.location}/{name}, which is cylindrical"
            )
        return name


def _kept_files(sequence: storage.Sequence, frame: int) -> dict[str, bytes]:
    """Return the original voxel files that `convert` kept."""
    kept = {}
    for suffix in (".label", *MASKS):
        try:
            kept[f"{frame:06d}{suffix}"] = sequence.read_document(f"{VOXEL_FILES}/{frame:06d}{suffix}")
        except (MissingDataError, FileNotFoundError):
            continue
    return kept


def _raw_ids(classes: ClassTable, labels: NDArray[np.integer], where: str) -> NDArray[np.unsignedinteger]:
    """Map class ids to SemanticKITTI's.

    Raises:
        FormatError: an id is not in the table, or the table has no counterpart in SemanticKITTI.
    """
    if classes.name == SEMANTICKITTI.name:
        classes.check(labels, where)
        return np.asarray(labels, np.uint32)
    if classes.name not in _TO_KITTI:
        raise FormatError(
            where,
            expected=f"the classes {', '.join(_TO_KITTI)} or {SEMANTICKITTI.name}",
            found=classes.name,
            advice="other classes have no counterpart in SemanticKITTI",
        )
    return _TO_KITTI[classes.name](labels, where)


def _is_right_handed(sequence: storage.Sequence) -> bool:
    return sequence.metadata.axes == "right"
