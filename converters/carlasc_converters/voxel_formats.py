"""The formats of voxel grids that other programs write: where the files are, their ids, geometry
and masks.

Formats are entry points of the group `carlasc.voxels`. Each was written from the published
description of its benchmark or from the program that reads it: docs/commands/evaluate.md.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from carlasc.core.arrays import AnyArray, BoolArray, FloatArray, LabelArray
from carlasc.core.geometry import invert, rotations_of
from carlasc.core.grids import GridSpec
from carlasc.core.tables import (
    CARLASC11,
    OCC3D,
    OCCNET,
    OPENOCCUPANCY,
    SEMANTICKITTI,
    SEMANTICKITTI19,
    SSCBENCH,
)
from carlasc.errors import FormatError, MissingDataError, reading
from carlasc.storage import layout
from carlasc.storage.arrays import NUMBERS, WHOLE_NUMBERS, ArrayFormat, open_npz, read_npy
from carlasc.storage.files import parse_json
from carlasc.storage.voxel_files import (
    IGNORED_ID,
    GridFrames,
    LabelFrames,
    SeenBy,
    VoxelFormat,
    matches,
)

KITTI_SPEC = GridSpec("cartesian", (256, 256, 32), (0.0, -25.6, -2.0), (51.2, 25.6, 4.4))
OCC3D_SPEC = GridSpec("cartesian", (200, 200, 16), (-40.0, -40.0, -1.0), (40.0, 40.0, 5.4))
OPENOCCUPANCY_SPEC = GridSpec("cartesian", (512, 512, 40), (-51.2, -51.2, -5.0), (51.2, 51.2, 3.0))
SURROUNDOCC_SPEC = GridSpec("cartesian", (200, 200, 16), (-50.0, -50.0, -5.0), (50.0, 50.0, 3.0))
_LIDAR = "the LiDAR, x to the right and y forward"
# position of the LiDAR in the frame of nuScenes' vehicles, metres
_NUSCENES_LIDAR = (0.943713, 0.0, 1.84023)
# possible names of the array of classes in an .npz: that of the benchmark, and other common ones
_ARRAYS = ("semantics", "pred", "occ_pred")
_SIX = "[0-9]" * 6


def _checked(labels: AnyArray, file: Path) -> LabelArray:
    """Return ids of one byte."""
    if labels.size and not 0 <= labels.min() <= labels.max() <= IGNORED_ID:
        found = f"{labels.min()} to {labels.max()}"
        raise FormatError(file, expected=f"class ids 0..{IGNORED_ID}", found=found)
    return labels.astype(np.uint8, copy=False)


def read_occ3d(file: Path) -> LabelArray:
    """Return (200, 200, 16) ids of an .npz of Occ3D, or of a prediction in its form."""
    with open_npz(file) as arrays:
        name = next((name for name in _ARRAYS if name in arrays.names), _ARRAYS[0])
        name = arrays.names[0] if len(arrays.names) == 1 else name
        return _checked(arrays.read(name, ArrayFormat(WHOLE_NUMBERS, OCC3D_SPEC.size)), file)


def occ3d_mask(file: Path, seen_by: SeenBy) -> BoolArray | None:
    """Return (200, 200, 16) bool, a mask of Occ3D; None if the file does not contain it."""
    name = f"mask_{seen_by}"
    with open_npz(file) as arrays:
        if name not in arrays.names:
            return None
        return arrays.read(name, ArrayFormat(WHOLE_NUMBERS, OCC3D_SPEC.size)).astype(np.bool_)


def _can(read: Callable[[Path], AnyArray], file: Path) -> bool:
    """Whether a file can be read."""
    try:
        read(file)
    except (FormatError, MissingDataError):
        return False
    return True


def _rows(file: Path, columns: tuple[int, ...]) -> AnyArray:
    """Return the rows of an .npy of numbers.

    Raises:
        FormatError: it has another number of columns, or a number is not finite.
    """
    rows = read_npy(file, ArrayFormat(NUMBERS, (None, None)))
    if rows.shape[1] not in columns:
        expected = f"rows of {' or '.join(map(str, columns))} columns"
        raise FormatError(file, expected=expected, found=rows.shape)
    if not np.isfinite(rows).all():
        raise FormatError(file, expected="finite numbers", found="NaN or infinity")
    return rows


def _dense(cells: AnyArray, ids: AnyArray, spec: GridSpec, free: int, file: Path) -> LabelArray:
    """Return (X, Y, Z) ids of occupied voxels, given as (N, 3) x, y, z; the others are free."""
    cells = cells.astype(np.int64)
    outside = ((cells < 0) | (cells >= spec.size)).any(axis=1)
    if outside.any():
        found = str(tuple(cells[outside][0].tolist()))
        raise FormatError(file, expected=f"voxels inside {spec}", found=found)
    labels = np.full(spec.size, free, np.uint8)
    labels[tuple(cells.T)] = _checked(ids.astype(np.int64), file)
    return labels


def _without_zero(ids: AnyArray) -> AnyArray:
    """Return ids in which 0, noise, is ignored."""
    return np.where(ids == 0, IGNORED_ID, ids)


def read_openoccupancy(file: Path) -> LabelArray:
    """Return (512, 512, 40) ids of an .npy with rows z, y, x, ..., class; 0 becomes ignored."""
    rows = _rows(file, (4, 7))
    return _dense(rows[:, 2::-1], _without_zero(rows[:, -1]), OPENOCCUPANCY_SPEC, 0, file)


def read_surroundocc(file: Path) -> LabelArray:
    """Return (200, 200, 16) ids of an .npy with rows x, y, z, class; 0 becomes ignored."""
    rows = _rows(file, (4,))
    return _dense(rows[:, :3], _without_zero(rows[:, 3]), SURROUNDOCC_SPEC, 0, file)


def read_occnet(file: Path) -> LabelArray:
    """Return (200, 200, 16) ids of an .npy with rows flat index, class.

    The index runs over z, y and x, with x fastest.
    """
    rows = _rows(file, (2,))
    x, y, _ = SURROUNDOCC_SPEC.size
    index = rows[:, 0].astype(np.int64)
    cells = np.column_stack([index % x, index // x % y, index // (x * y)])
    cells[index < 0] = -1
    return _dense(cells, rows[:, 1], SURROUNDOCC_SPEC, OCCNET.free, file)


def read_preprocessed(file: Path) -> LabelArray:
    """Return (256, 256, 32) learning ids of an .npy as MonoScene and its descendants keep them."""
    return _checked(read_npy(file, ArrayFormat(NUMBERS, KITTI_SPEC.size)), file)


def kitti_poses(folder: Path, names: list[str]) -> FloatArray | None:
    """Return (F, 4, 4) poses of the LiDAR from the poses.txt and calib.txt above the voxels."""
    poses = folder.parent / "poses.txt"
    calibration = folder.parent / "calib.txt"
    if not (poses.is_file() and calibration.is_file()):
        return None
    with reading(poses, "a pose of 12 numbers for each scan, and Tr in calib.txt"):
        rows = np.loadtxt(poses, ndmin=2).reshape(-1, 3, 4)
        lines = dict(line.split(":", 1) for line in calibration.read_text().splitlines() if line)
        camera_T_lidar = np.eye(4)
        camera_T_lidar[:3] = np.array(lines["Tr"].split(), np.float64).reshape(3, 4)
        world_T_camera = np.tile(np.eye(4), (len(names), 1, 1))
        world_T_camera[:, :3] = rows[[int(name) for name in names]]
        return invert(camera_T_lidar) @ world_T_camera @ camera_T_lidar


def occ3d_poses(folder: Path, names: list[str]) -> FloatArray | None:
    """Return (F, 4, 4) poses of the vehicle from the annotations.json above a scene."""
    for file in (above / "annotations.json" for above in list(folder.parents)[:2]):
        if file.is_file():
            with reading(file, "the ego_pose of each frame"):
                scenes: Any = parse_json(file.read_bytes(), str(file))["scene_infos"]
                scene = scenes.get(folder.name, {})
                if any(scene.get(name, {}).get("ego_pose") is None for name in names):
                    return None
                found = [scene[name]["ego_pose"] for name in names]
                poses = np.tile(np.eye(4), (len(names), 1, 1))
                rotations = np.array([pose["rotation"] for pose in found], np.float64)
                poses[:, :3, :3] = rotations_of(rotations)
                poses[:, :3, 3] = [pose["translation"] for pose in found]
                return poses
    return None


class CarlaScPredictions(VoxelFormat):
    """Predictions as the test script of CarlaSC's authors writes them: `.label` files in a folder
    beside velodyne/, without params.json.
    """

    def find(self, place: Path) -> Iterator[tuple[str, GridFrames]]:
        """Yield the folders of predictions at a place, each with its name."""
        for above in ("", "*/", "*/*/"):
            template = f"{above}{{coordinates=c[ay]*}}/{{grid}}/{{frame={_SIX}}}.label"
            found: dict[Path, dict[str, Path]] = {}
            for path, names in matches(place, template):
                found.setdefault(path.parent, {})[names["frame"]] = path
            for folder, files in sorted(found.items()):
                coordinates = folder.parent.name
                scans = layout.scan_folders()
                if coordinates not in layout.COORDINATES or folder.name in scans:
                    continue
                for preset in ("coarse", "fine", "cylindrical"):
                    format = replace(self, spec=GridSpec.published(preset))
                    frames = LabelFrames(format, folder, "/".join(folder.parts[-4:-1]), files)
                    if frames.spec is not None and frames.spec.coordinates == coordinates:
                        yield folder.name, frames
                        break


CARLASC = CarlaScPredictions(
    "CarlaSC predictions",
    {},
    CARLASC11,
    GridSpec.published(),
    label_bytes=4,
    named="assumed",
    benchmark=("carlasc",),
)
_KITTI = VoxelFormat(
    "SemanticKITTI",
    {
        "voxels": f"sequences/{{sequence}}/voxels/{{frame={_SIX}}}.label",
        "predictions": f"sequences/{{sequence}}/predictions/{{frame={_SIX}}}.label",
    },
    SEMANTICKITTI,
    KITTI_SPEC,
    benchmark=("semantickitti",),
    poses=kitti_poses,
)
SEMANTICKITTI_FILES = _KITTI
SSCBENCH_FILES = replace(
    _KITTI,
    name="SSCBench",
    files={
        name: template.replace("sequences/", "data_2d_raw/")
        for name, template in _KITTI.files.items()
    },
    benchmark=("sscbench",),
    poses=None,
)
PREPROCESSED = replace(
    _KITTI,
    name="SemanticKITTI, preprocessed",
    files={
        "labels": "labels/{sequence=[0-9][0-9]}/{frame}_1_1.npy",
        "preprocess": "preprocess/labels/{sequence=[0-9][0-9]}/{frame}_1_1.npy",
    },
    classes=SEMANTICKITTI19,
    read=read_preprocessed,
    poses=None,
)
SSCBENCH_PREPROCESSED = replace(
    PREPROCESSED,
    name="SSCBench, preprocessed",
    files={
        name: template.replace("[0-9][0-9]", "*_sync")
        for name, template in PREPROCESSED.files.items()
    },
    classes=SSCBENCH,
    benchmark=("sscbench",),
)
OCC3D_FILES = VoxelFormat(
    "Occ3D",
    {"labels": "{sequence}/{frame}/labels.npz", "pred": "{sequence}/{frame}/pred.npz"},
    OCC3D,
    OCC3D_SPEC,
    read_occ3d,
    occ3d_mask,
    benchmark=("occ3d-camera", "occ3d-lidar"),
    place="the vehicle, with its origin on the ground",
    origin=_NUSCENES_LIDAR,
    poses=occ3d_poses,
)
OCC3D_BELOW = replace(
    OCC3D_FILES, files={name: f"gts/{template}" for name, template in OCC3D_FILES.files.items()}
)
OCC3D_PREDICTIONS = replace(
    OCC3D_FILES,
    name="Occ3D predictions",
    files={"pred": "{frame}.npz"},
    holds=partial(_can, read_occ3d),
)
OPENOCCUPANCY_FILES = VoxelFormat(
    "OpenOccupancy",
    {"occupancy": "{sequence=scene_*}/occupancy/{frame}.npy"},
    OPENOCCUPANCY,
    OPENOCCUPANCY_SPEC,
    read_openoccupancy,
    benchmark=("openoccupancy",),
    place=_LIDAR,
    y_forward=True,
)
SURROUNDOCC_FILES = VoxelFormat(
    "SurroundOcc",
    {"occupancy": "{frame}.npy"},
    OPENOCCUPANCY,
    SURROUNDOCC_SPEC,
    read_surroundocc,
    holds=partial(_can, partial(_rows, columns=(4,))),
    benchmark=("surroundocc",),
    place=_LIDAR,
    y_forward=True,
)
OCCNET_FILES = replace(
    SURROUNDOCC_FILES,
    name="OccNet",
    classes=OCCNET,
    read=read_occnet,
    holds=partial(_can, partial(_rows, columns=(2,))),
    benchmark=("occnet",),
)
