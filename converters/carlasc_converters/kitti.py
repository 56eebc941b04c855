"""SemanticKITTI, and KITTI odometry data without labels: see the format page,
`docs/format.md#semantickitti`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import ClassVar

import numpy as np

from carlasc.converting import (
    Cloud,
    FrameHandle,
    Recording,
    Sensor,
    Split,
    Trajectory,
    VoxelContent,
)
from carlasc.core.arrays import FloatArray, Uint16Array, Uint32Array
from carlasc.core.cameras import CameraModel
from carlasc.core.geometry import Transform, check_rigid, inverse_of, multiply
from carlasc.core.tables import REMAPS, SEMANTICKITTI
from carlasc.errors import FormatError, MissingDataError
from carlasc.storage import layout
from carlasc_converters.files import check_labels, missing_scans, read_bytes
from carlasc_converters.kitti_cameras import rectified_cameras
from carlasc_converters.kitti_files import (
    HEIGHT_M,
    Calibration,
    KittiConverter,
    frames_of,
    read_array,
    read_scan,
)
from carlasc_converters.kitti_voxels import GRID, read_voxel_files

_TEST_FIRST = 11
_VALIDATION = 8


class SemanticKitti(KittiConverter):
    """Reads SemanticKITTI, one of its sequences, or KITTI odometry data."""

    title: ClassVar[str] = "SemanticKITTI, or KITTI odometry data without labels"
    citation = (
        "J. Behley et al., SemanticKITTI, ICCV 2019; A. Geiger, P. Lenz, R. Urtasun, Are we ready "
        "for Autonomous Driving?, CVPR 2012"
    )
    classes = SEMANTICKITTI
    keeps_classes = True
    to_carla = REMAPS["semantickitti_to_carla"]

    def sequences(self) -> list[Recording]:
        """Return the sequences, by number.

        Raises:
            MissingDataError: no sequence exists.
        """
        folders = find_sequences(self.source)
        return [
            KittiRecording(folder, f"KITTI_{folder.name}", _split_of(folder.name))
            for folder in folders
        ]


class KittiRecording(Recording):
    """One sequence: a folder with velodyne/, labels/, voxels/, poses.txt, calib.txt and times.txt.

    The LiDAR is its vehicle.

    Attributes:
        folder: this folder.
    """

    sensors = (Sensor("velodyne", height_m=HEIGHT_M),)

    def __init__(self, folder: Path, name: str, split: Split) -> None:
        self.folder = folder
        self.name = name
        self.split = split
        self.location = str(folder)
        self.has_labels = self.has_instances = bool(frames_of(folder / "labels", ".label"))
        self.voxels = GRID if frames_of(folder / "voxels", ".label") else None

    @cached_property
    def frames(self) -> Sequence[FrameHandle]:  # type: ignore[override]
        """The frames that have a scan."""
        return [self._handle(number) for number in frames_of(self.folder / "velodyne", ".bin")]

    def _handle(self, number: int) -> FrameHandle:
        return KittiFrame(str(self.folder), number, self.has_labels)

    def poses(self, *, force: bool = False) -> Trajectory | None:
        """Return inv(Tr) @ P @ Tr for each pose P in poses.txt, because the file holds poses of the
        left camera.
        """
        path = next((path for path in self._pose_files() if path.is_file()), None)
        if path is None:
            return None
        camera_poses = layout.decode_poses(read_bytes(path), str(path))
        camera_T_lidar = self._calibration(path, force=force)
        poses = multiply(
            inverse_of(camera_T_lidar), check_rigid(camera_poses, str(path)), camera_T_lidar
        )
        return Trajectory(poses, where=str(path))

    def _pose_files(self) -> tuple[Path, ...]:
        """Return the possible files of poses: in the sequence, or, for KITTI odometry, in poses/
        beside sequences/.
        """
        return (
            self.folder / "poses.txt",
            self.folder.parent.parent / "poses" / f"{self.folder.name}.txt",
        )

    @cached_property
    def _calib(self) -> Calibration | None:
        path = self.folder / "calib.txt"
        return Calibration.read(path) if path.is_file() else None

    def _calibration(self, poses: Path, *, force: bool) -> Transform:
        calibration = self._calib
        if calibration is not None and "Tr" in calibration.values:
            return calibration.transform("Tr")
        if force:
            return np.eye(4)
        error = MissingDataError if calibration is None else FormatError
        raise error(
            self.folder / "calib.txt",
            expected=f"Tr, which takes LiDAR points to the camera whose poses {poses.name} holds",
            found="no such file"
            if calibration is None
            else f"only {', '.join(calibration.values) or 'other lines'}",
            advice="copy calib.txt of the KITTI odometry data, estimate poses from the scans with "
            '`poses="kiss-icp"`, or, if the'
            " poses are those of the LiDAR, accept them with `force=True`",
        )

    def cameras(self) -> Sequence[CameraModel]:
        """Return the rectified cameras of calib.txt; none without that file or Tr in it."""
        calibration = self._calib
        if calibration is None or "Tr" not in calibration.values:
            return ()

        def image_of(name: str, frame: int) -> Path:
            return self.folder / name / f"{frame:06d}.png"

        projections = {f"image_{number}": f"P{number}" for number in range(4)}
        numbers = [frame.number for frame in self.frames]
        return rectified_cameras(
            calibration, calibration.transform("Tr"), projections, image_of, numbers
        )

    def times(self) -> FloatArray | None:
        """Return the lines of times.txt."""
        path = self.folder / "times.txt"
        return layout.decode_times(read_bytes(path), str(path)) if path.is_file() else None

    def problems(self) -> list[tuple[int, str]]:
        """Return the frames that have labels or voxels, but no scan."""
        scanned = {frame.number for frame in self.frames}
        others = {
            *frames_of(self.folder / "labels", ".label"),
            *frames_of(self.folder / "voxels", ".label"),
        }
        folder = self.folder / "velodyne"
        files = [(number, folder / f"{number:06d}.bin") for number in sorted(others - scanned)]
        return missing_scans(files, "a scan beside its labels")


@dataclass(frozen=True)
class KittiFrame(FrameHandle):
    """One frame's files."""

    folder: str
    number: int
    labelled: bool

    @property
    def location(self) -> str:  # type: ignore[override]
        """The file of the points."""
        return f"{self.folder}/velodyne/{self.number:06d}.bin"

    @property
    def _label_file(self) -> str:
        return f"{self.folder}/labels/{self.number:06d}.label"

    def read(self) -> Sequence[Cloud]:
        """Read points, classes and instances."""
        points = read_scan(self.location)
        labels, instances = self._read_labels()
        if labels is not None:
            check_labels(labels, len(points), self._label_file)
        return [Cloud(points, labels, instances)]

    def _read_labels(self) -> tuple[Uint16Array | None, Uint32Array | None]:
        """Read classes (the low 16 bits) and instances (the high 16 bits)."""
        if not self.labelled:
            return None, None
        both = read_array(self._label_file, np.dtype("<u4"), 1)[:, 0]
        labels = both.astype(np.uint16)  # keeps the low 16 bits
        actors = both >> 16
        # SemanticKITTI numbers the instances of each class from 1, so the class is part of an
        # actor's number. A car gets the same number whether it moves or not.
        return labels, np.where(actors > 0, _CLASS_PART[labels] | actors, np.uint32(0))

    def read_voxels(self) -> VoxelContent | None:
        """Read the frame's voxels, which SemanticKITTI has for every fifth scan."""
        return read_voxel_files(Path(self.folder) / "voxels", self.number)


def find_sequences(root: Path) -> list[Path]:
    """Return the folders of the sequences: those in `sequences/` or `dataset/sequences/`, or the
    folder itself.

    Raises:
        MissingDataError: no sequence exists.
    """
    if not root.is_dir():
        raise MissingDataError(
            root,
            expected="a folder",
            found="a file" if root.exists() else "nothing",
            advice="check the path",
        )
    if (root / "velodyne").is_dir():
        return [root.resolve()]
    for folder in (root / "sequences", root / "dataset" / "sequences", root):
        if folder.is_dir() and (
            folders := sorted(path for path in folder.iterdir() if (path / "velodyne").is_dir())
        ):
            return folders
    raise MissingDataError(
        root,
        expected="sequences/00/velodyne/ and so on, or a folder with velodyne/ in it",
        found="none",
        advice="give the folder that holds sequences/",
    )


def _split_of(name: str) -> Split:
    """Return the split of a sequence by its number; folders with other names belong to the training
    split.
    """
    number = int(name) if name.isascii() and name.isdigit() else 0
    return "Val" if number == _VALIDATION else "Test" if _TEST_FIRST <= number <= 21 else "Train"


_CLASS_PART = np.arange(1 << 16, dtype=np.uint32) << 16
_CLASS_PART[list(SEMANTICKITTI.standing)] = _CLASS_PART[list(SEMANTICKITTI.standing.values())]
CLASS_PARTS = np.unique(_CLASS_PART[[label for label in SEMANTICKITTI.names if label]])
"""Offsets of the classes of actors for the instance numbers of SemanticKITTI."""
