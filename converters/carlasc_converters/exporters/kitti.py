"""Sequences of the layout as SemanticKITTI's files: see the format page,
`docs/format.md#semantickitti`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np

from carlasc import storage
from carlasc.converting import VOXEL_FILES, Files, FrameExporter
from carlasc.core.arrays import (
    AnyFloatArray,
    AnyIntArray,
    Float32Array,
    FloatArray,
    Int32Array,
    LabelArray,
    Uint32Array,
)
from carlasc.core.cameras import CameraModel
from carlasc.core.classes import ClassTable
from carlasc.core.geometry import Transform, invert, mirror_poses, multiply
from carlasc.core.grids import mirror_grid, mirror_spec
from carlasc.core.tables import CARLASC11, REMAPS, SEMANTICKITTI, SEMANTICKITTI19
from carlasc.errors import ArgumentError, FormatError, MissingDataError, check_choice
from carlasc.storage import layout
from carlasc_converters.exporters.classes import classes_of, lookup_of, mapping_of
from carlasc_converters.exporters.grid_exporter import (
    choose_grid,
    number_folders,
    read_points,
    scan_occupancy,
)
from carlasc_converters.exporters.occlusion import occluded_voxels
from carlasc_converters.exporters.submission import (
    Task,
    check_archive,
    check_submission,
    pack_submission,
)
from carlasc_converters.kitti import CLASS_PARTS
from carlasc_converters.kitti_voxels import GRID, MASKS, pack_bits

_NAMES_OF_11 = (
    "unlabeled building fence other-object person pole road other-ground sidewalk vegetation car"
)
TO_RAW: Mapping[str, Mapping[int, int]] = {
    "carla": REMAPS["carla_to_semantickitti"].mapping,
    CARLASC11.name: dict(
        zip(CARLASC11.names, map(SEMANTICKITTI.id_of, _NAMES_OF_11.split()), strict=True)
    ),
    SEMANTICKITTI.name: {label: label for label in SEMANTICKITTI.names},
    SEMANTICKITTI19.name: {
        label: SEMANTICKITTI.id_of(name) for label, name in SEMANTICKITTI19.names.items()
    },
}
"""Name of a class table -> id -> raw id of SemanticKITTI."""

_FENCE = 51
_BUILDING = 50
UNSCORED: Mapping[int, int] = {1: 0, 52: _BUILDING, 99: _BUILDING}
"""Raw id that SemanticKITTI's evaluator does not accept in a prediction -> id that is written
instead.

Its table maps outlier, other-structure and other-object to no class. Their voxels stay occupied, as
buildings: other structures are most similar to buildings, and a few voxels of other objects change
the score of buildings least.
"""
# CarlaSC's: other-structure in ground truth; a fence in predictions, as its paper's class Barrier
_WALL = 11
TO_PREDICTED: Mapping[str, Mapping[int, int]] = {
    name: {label: UNSCORED.get(raw, raw) for label, raw in mapping.items()}
    | ({_WALL: _FENCE} if name == "carla" else {})
    for name, mapping in TO_RAW.items()
}
"""Name of a class table -> id -> raw id in a prediction: only ids that the evaluator scores, and 0.
"""
# the ids of moving-object segmentation; unlabelled points and outliers stay 0
_STANDS = 9
_MOVES = 251
_MOVING_M_S = 0.5  # points that are faster than this are moving
_TO_MOVING = np.arange(max(SEMANTICKITTI.names) + 1)
_TO_MOVING[list(SEMANTICKITTI.standing.values())] = list(SEMANTICKITTI.standing)
_PROJECTIONS = ("P0", "P1", "P2", "P3")


class KittiExporter(FrameExporter):
    """Writes velodyne/, labels/, voxels/ or predictions/, poses.txt, calib.txt and times.txt."""

    title = "SemanticKITTI: sequences/NN/velodyne, labels, voxels or predictions"

    def __init__(
        self,
        grid: Annotated[
            str | None, "Grid to export. Default: the grid with the smallest voxels."
        ] = None,
        *,
        predictions: Annotated[
            bool, "The grids are predictions: only predictions/ is written."
        ] = False,
        labels: Annotated[
            Literal["semantic", "moving"],
            "moving: the labels of moving-object segmentation, 9 for static and 251 for moving "
            "points.",
        ] = "semantic",
        check: Annotated[
            Task | None,
            "Export nothing: check the predictions in OUT for a task, as SemanticKITTI's script "
            "does. SOURCE is the benchmark's data.",
        ] = None,
        zip: Annotated[
            str | None, "With --check: also pack OUT for the benchmark into this file."
        ] = None,
    ) -> None:
        check_choice("labels", labels, ("semantic", "moving"))
        if zip is not None:
            if check is None:
                raise ArgumentError("zip", expected="`check` too", found="only `zip`")
            check_archive(Path(zip))
        self.grid = grid
        self.predictions = predictions
        self.labels = labels
        self.task: Task | None = check
        self.archive = zip

    @property
    def settings(self) -> Mapping[str, Any]:
        """The options that the files depend on."""
        return {"grid": self.grid, "predictions": self.predictions, "labels": self.labels}

    def check_output(self, source: str, root: Path) -> tuple[int, list[str]] | None:
        """Check and pack the predictions in `root`, if an option requests that."""
        if self.task is None:
            return None
        ids = (
            set(TO_PREDICTED[SEMANTICKITTI.name].values())
            if self.task == "completion"
            else set(SEMANTICKITTI.names)
        )
        files = check_submission(root, Path(source), self.task, ids)
        notes = [
            f"{root} is a valid submission to SemanticKITTI's benchmark for {self.task}: "
            f"{len(files)} files"
        ]
        if self.archive is not None:
            pack_submission(root, files, Path(self.archive))
            notes.append(f"{self.archive} contains them")
        return len(files), notes

    @property
    def product(self) -> str:
        """Predictions lie beside the ground truth."""
        return "predictions" if self.predictions else "data"

    def folders(self, names: Sequence[str]) -> dict[str, str]:
        """Return sequences/NN for each name: 08 for KITTI_08, and the next free number for other
        names.
        """
        return {
            name: f"sequences/{number}"
            for name, number in number_folders(names, "KITTI_", 2).items()
        }

    def check(self, sequence: storage.Sequence) -> list[str]:
        """Check the grid and the classes."""
        if "labels" in sequence.fields() and not self.predictions:
            self._mapping(sequence.metadata.classes, sequence.location)
        if sequence.grids or self.grid or self.predictions:
            name = self._grid_of(sequence)
            self._mapping(sequence.classes_of(name), f"{sequence.location}/{name}")
            spec = sequence.grids[name]
            if spec.size != GRID.size:
                return [
                    f"{sequence.location}/{name} is {spec}; programs for SemanticKITTI read only "
                    f"voxels of {GRID}"
                ]
        return []

    def frames(self, sequence: storage.Sequence) -> list[int]:
        """Return all frames, or those with a prediction."""
        if self.predictions:
            return sequence.frames(f"{self._grid_of(sequence)}/labels").tolist()
        return super().frames(sequence)

    def documents(self, sequence: storage.Sequence) -> dict[str, bytes]:
        """Return poses, calibration and times.

        With KITTI's cameras, poses are those of the left one, as in KITTI. Without, they are those
        of the LiDAR, and Tr is the identity.
        """
        if self.predictions:
            return {}
        documents = {}
        if layout.POSES in sequence.documents():
            poses = sequence.poses if _is_right_handed(sequence) else mirror_poses(sequence.poses)
            calibration = calibration_of(sequence)
            poses = multiply(calibration["Tr"], poses, invert(calibration["Tr"]))
            documents["poses.txt"] = layout.encode_poses(poses)
            documents["calib.txt"] = encode_calibration(calibration)
        if layout.TIMES in sequence.documents():
            documents["times.txt"] = layout.encode_times(sequence.times)
        return documents

    def frame_files(self, sequence: storage.Sequence, frame: int) -> tuple[str, ...]:
        """Return the files of a frame: its scan, labels and voxels, or its prediction."""
        if self.predictions:
            return (f"predictions/{frame:06d}.label",)
        names = [f"velodyne/{frame:06d}.bin"] if frame in sequence.frames("points") else []
        names += [f"labels/{frame:06d}.label"] if frame in sequence.frames("labels") else []
        if sequence.grids and frame in sequence.frames(f"{self._grid_of(sequence)}/labels"):
            names += [f"voxels/{frame:06d}{suffix}" for suffix in (".label", *MASKS)]
        return tuple(names)

    def make_frame(self, sequence: storage.Sequence, frame: int) -> Files:
        """Return the frame's files."""
        made: dict[str, bytes | memoryview] = {}
        wanted = self.frame_files(sequence, frame)
        points = np.empty((0, 4), np.float32) if self.predictions else read_points(sequence, frame)
        if f"velodyne/{frame:06d}.bin" in wanted:
            made[f"velodyne/{frame:06d}.bin"] = points.astype("<f4").tobytes()
        if f"labels/{frame:06d}.label" in wanted:
            labels = self._point_labels(sequence, frame)
            both = labels.astype("<u4") | _instances(sequence, frame, len(labels)) << 16
            made[f"labels/{frame:06d}.label"] = both.tobytes()
        if f"predictions/{frame:06d}.label" in wanted:
            made[f"predictions/{frame:06d}.label"] = (
                self._labels(sequence, frame).astype("<u2").tobytes()
            )
        if f"voxels/{frame:06d}.label" in wanted:
            made |= self._voxels(sequence, frame, points)
        return made

    def _point_labels(self, sequence: storage.Sequence, frame: int) -> AnyIntArray:
        """Return (N,) ids of SemanticKITTI: those of moving actors where the class or the flow of a
        point says that it moves.
        """
        table = sequence.metadata.classes
        where = f"{sequence.location}: labels of frame {frame}"
        labels = self._raw_ids(table, sequence.read("labels", frame), where)
        # without classes for moving actors
        if not table.moving and frame in sequence.frames("flow"):
            flow = np.asarray(sequence.read("flow", frame))
            if len(flow) != len(labels):
                where = f"{sequence.location}: flow of frame {frame}"
                raise FormatError(where, expected=f"{len(labels)} rows, as labels", found=len(flow))
            labels = np.where(
                np.linalg.norm(flow, axis=1) > _MOVING_M_S, _TO_MOVING[labels], labels
            )
        if self.labels == "moving":
            labels = np.select(
                [np.isin(labels, sorted(SEMANTICKITTI.moving)), labels > 1], [_MOVES, _STANDS], 0
            )
        return labels

    def _voxels(
        self, sequence: storage.Sequence, frame: int, points: Float32Array
    ) -> Mapping[str, bytes]:
        """Return the original voxel files if they were kept, else files made from the grid."""
        kept = _kept_files(sequence, frame) if self.grid is None else {}
        if kept:
            return {f"voxels/{name}": data for name, data in kept.items()}
        name = self._grid_of(sequence)
        labels = self._labels(sequence, frame)
        counts = self._counts(sequence, frame)
        spec = sequence.grids[name]
        spec = spec if _is_right_handed(sequence) else mirror_spec(spec)
        files = {
            ".label": labels.astype("<u2").tobytes(),
            ".invalid": pack_bits(counts == 0),
            ".occluded": pack_bits(occluded_voxels(labels > 0, spec)),
            ".bin": pack_bits(scan_occupancy(sequence, points, spec)),
        }
        return {f"voxels/{frame:06d}{suffix}": data for suffix, data in files.items()}

    def _labels(self, sequence: storage.Sequence, frame: int) -> AnyIntArray:
        """Return (X, Y, Z) ids of SemanticKITTI, right-handed."""
        name = self._grid_of(sequence)
        where = f"{sequence.location}: {name} of frame {frame}"
        labels = self._raw_ids(
            sequence.classes_of(name), sequence.read(f"{name}/labels", frame), where
        )
        return labels if _is_right_handed(sequence) else mirror_grid(labels)

    def _counts(self, sequence: storage.Sequence, frame: int) -> AnyFloatArray:
        name = self._grid_of(sequence)
        if frame not in sequence.frames(f"{name}/counts"):
            raise MissingDataError(
                f"{sequence.location}/{name}",
                expected=f"counts of frame {frame}, for the known voxels",
                found="none",
                advice="if the grids are predictions, give `predictions=True`",
            )
        counts = np.asarray(sequence.read(f"{name}/counts", frame))
        return counts if _is_right_handed(sequence) else mirror_grid(counts)

    def _grid_of(self, sequence: storage.Sequence) -> str:
        """Return the grid to export.

        Raises:
            MissingDataError: the sequence has no Cartesian grid, or none of that name.
            ArgumentError: the grid of that name is not Cartesian.
        """
        return choose_grid(sequence, sequence.grids, self.grid)

    def _mapping(self, classes: ClassTable, where: str) -> dict[int, int]:
        """Return the map from the ids of a class table to SemanticKITTI's; raise if it does not
        exist.
        """
        if not self.predictions:
            return mapping_of(TO_RAW, "raw", classes, where)
        return {
            label: UNSCORED.get(raw, raw)
            for label, raw in mapping_of(TO_PREDICTED, "raw", classes, where).items()
        }

    def _raw_ids(self, classes: ClassTable, labels: LabelArray, where: str) -> Int32Array:
        """Map class ids to SemanticKITTI's.

        Raises:
            FormatError: an id is not in the table, or nothing maps the table to SemanticKITTI's
                classes.
        """
        return classes_of(labels, lookup_of(self._mapping(classes, where)), classes, where)


def _instances(sequence: storage.Sequence, frame: int, count: int) -> Uint32Array:
    """Return the (count,) numbers of actors in a frame as SemanticKITTI's files hold them, 0 for
    none.

    Numbers that `convert` made from SemanticKITTI's own numbers have the class in the upper half.
    The lower half is the own number.

    Raises:
        FormatError: a number needs more than 16 bits, or there are not as many as labels.
    """
    if frame not in sequence.frames("instances"):
        return np.zeros(count, np.uint32)
    instances = np.asarray(sequence.read("instances", frame), np.uint32)
    where = f"{sequence.location}: instances of frame {frame}"
    if len(instances) != count:
        raise FormatError(where, expected=f"{count} rows, as labels", found=len(instances))
    numbered = instances[instances > 0]
    if np.isin(numbered >> 16, CLASS_PARTS >> 16).all():
        return (instances & 0xFFFF).astype(np.uint32)
    if numbered.max(initial=0) > np.iinfo(np.uint16).max:
        raise FormatError(
            where,
            expected="numbers of at most 16 bits",
            found=numbered.max(),
            advice="number the actors from 1 before exporting",
        )
    return instances


def _kept_files(sequence: storage.Sequence, frame: int) -> dict[str, bytes]:
    """Return the original voxel files that `convert` kept."""
    kept = {}
    for suffix in (".label", *MASKS):
        try:
            kept[f"{frame:06d}{suffix}"] = sequence.read_document(
                f"{VOXEL_FILES}/{frame:06d}{suffix}"
            )
        except (MissingDataError, FileNotFoundError):
            continue
    return kept


def cameras_by_number(sequence: storage.Sequence) -> dict[int, CameraModel]:
    """Return KITTI's rectified cameras of a sequence, image_0 to image_3 or image_00 to image_03,
    by their numbers; none without the first one, to which the others are related.
    """
    names = {name: n for n in range(4) for name in (f"image_{n}", f"image_0{n}")}
    cameras = storage.cameras_of(sequence).items()
    found = {names[name]: camera for name, camera in cameras if name in names}
    return found if 0 in found else {}


def calibration_of(
    sequence: storage.Sequence, camera_T_lidar: Transform | None = None
) -> dict[str, FloatArray]:
    """Return the projections P0 to P3 and Tr, from the LiDAR to the left camera, of the rectified
    cameras; identities without them, or the given Tr.
    """
    cameras = cameras_by_number(sequence)
    lidar_T_scan = np.diag([1.0, 1.0 if _is_right_handed(sequence) else -1.0, 1.0, 1.0])
    left_T_lidar = np.eye(4) if camera_T_lidar is None else camera_T_lidar
    if cameras:
        left_T_lidar = invert(lidar_T_scan @ cameras[0].sensor_T_camera)
    made: dict[str, FloatArray] = {}
    for number, name in enumerate(_PROJECTIONS):
        made[name] = np.eye(4)
        if number in cameras:
            left_T_camera = left_T_lidar @ lidar_T_scan @ cameras[number].sensor_T_camera
            matrix = cameras[number].matrix
            moved = invert(left_T_camera)[:3, 3]
            made[name] = np.column_stack([matrix, matrix @ moved])  # rectified: axes are the same
    return {**made, "Tr": left_T_lidar}


def encode_calibration(matrices: Mapping[str, FloatArray]) -> bytes:
    """Return the bytes of a file of calibrations: name and three rows of each matrix per line."""
    return "".join(
        f"{name}: {' '.join(f'{value:.12e}' for value in matrix[:3].ravel())}\n"
        for name, matrix in matrices.items()
    ).encode()


def _is_right_handed(sequence: storage.Sequence) -> bool:
    return sequence.metadata.axes == "right"
