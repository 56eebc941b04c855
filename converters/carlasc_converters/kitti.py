"""SemanticKITTI, and KITTI odometry data without labels: see the format page, `docs/format.md#semantickitti`."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from carlasc.converting import Converter, Exporter, FrameContent, FrameHandle, Recording, Split, VoxelContent
from carlasc.core.geometry import Transform, check_rigid
from carlasc.core.tables import REMAPS, SEMANTICKITTI
from carlasc.errors import FormatError, MissingDataError
from carlasc.storage import layout
from carlasc_converters.kitti_voxels import GRID, read_voxel_files

_STANDING = {  # class of moving actors -> class of the same actors when they stand
    moving: SEMANTICKITTI.id_of(SEMANTICKITTI.names[moving].removeprefix("moving-")) for moving in SEMANTICKITTI.moving
}
_TEST_FIRST, _VALIDATION = 11, 8


class SemanticKitti(Converter):
    """Reads SemanticKITTI, one of its sequences, or KITTI odometry data."""

    title: ClassVar[str] = "SemanticKITTI, or KITTI odometry data without labels"
    classes = SEMANTICKITTI
    to_carla = REMAPS["semantickitti_to_carla"]
    sensor = "Velodyne HDL-64E"
    min_range_m = 2.5
    max_range_m = 70.0
    voxels = GRID

    def sequences(self) -> list[Recording]:
        """Return the sequences, by number.

        Raises:
            MissingDataError: no sequence exists.
        """
        folders = find_sequences(self.source)
        return [KittiRecording(folder, f"KITTI_{folder.name}", _split_of(folder.name)) for folder in folders]

    @classmethod
    def exporter(cls, **options: Any) -> Exporter:
        """Return the exporter that writes SemanticKITTI's files."""
        from carlasc_converters.kitti_export import KittiExporter

        return KittiExporter(**options)


class KittiRecording(Recording):
    """One sequence: a folder with velodyne/, labels/, voxels/, poses.txt, calib.txt and times.txt.

    Attributes:
        folder: this folder.
    """

    def __init__(self, folder: Path, name: str, split: Split) -> None:
        self.folder, self.name, self.split = folder, name, split
        self.location = str(folder)
        self.has_labels = bool(frames_of(folder / "labels", ".label"))

    @cached_property
    def frames(self) -> Sequence[FrameHandle]:  # type: ignore[override]
        """The frames that have a scan."""
        return [self._handle(number) for number in frames_of(self.folder / "velodyne", ".bin")]

    def _handle(self, number: int) -> FrameHandle:
        return KittiFrame(str(self.folder), number, self.has_labels)

    def poses(self, *, force: bool = False) -> NDArray[np.float64] | None:
        """Return inv(Tr) @ P @ Tr for each pose P in poses.txt, because the file holds poses of the left camera."""
        path = next((path for path in self._pose_files() if path.is_file()), None)
        if path is None:
            return None
        camera_poses = layout.decode_poses(path.read_bytes(), str(path))
        camera_T_lidar = self._calibration(path, force=force)
        return np.linalg.inv(camera_T_lidar) @ check_rigid(camera_poses, str(path)) @ camera_T_lidar

    def _pose_files(self) -> tuple[Path, ...]:
        """Return where poses may be: in the sequence, or, for KITTI odometry, in poses/ beside sequences/."""
        return self.folder / "poses.txt", self.folder.parent.parent / "poses" / f"{self.folder.name}.txt"

    def _calibration(self, poses: Path, *, force: bool) -> Transform:
        path = self.folder / "calib.txt"
        found = read_calibration(path) if path.is_file() else None
        if found is not None and "Tr" in found:
            return check_rigid(found["Tr"], f"{path}: Tr")
        if force:
            return np.eye(4)
        error = MissingDataError if found is None else FormatError
        raise error(
            path,
            expected=f"Tr, which takes LiDAR points to the camera whose poses {poses.name} holds",
            found="no such file" if found is None else f"only {', '.join(found) or 'other lines'}",
            advice='copy calib.txt of the KITTI odometry data, estimate poses from the scans with `poses="kiss-icp"`, or, if the'
            " poses are those of the LiDAR, accept them with `force=True`",
        )

    def times(self) -> NDArray[np.float64] | None:
        """Return the lines of times.txt."""
        path = self.folder / "times.txt"
        return layout.decode_times(path.read_bytes(), str(path)) if path.is_file() else None

    def problems(self) -> list[tuple[int, str]]:
        """Return the frames that have labels or voxels, but no scan."""
        scanned = {frame.number for frame in self.frames}
        others = {*frames_of(self.folder / "labels", ".label"), *frames_of(self.folder / "voxels", ".label")}
        found = []
        for number in sorted(others - scanned):
            file = self.folder / "velodyne" / f"{number:06d}.bin"
            error = MissingDataError(file, expected="a scan beside its labels", found="no such file")
            found.append((number, str(error)))
        return found


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

    def read(self) -> FrameContent:
        """Read points, classes and instances."""
        points = _read_array(self.location, np.dtype("<f4"), 4)
        if not len(points):
            raise FormatError(self.location, expected="points", found="an empty file", advice="copy it again")
        labels, instances = self.read_labels()
        if labels is not None and len(labels) != len(points):
            raise FormatError(
                self._label_file,
                expected=f"a label for each of {len(points)} points",
                found=str(len(labels)),
                advice="the file belongs to another scan, or is incomplete",
            )
        return FrameContent(points, labels, instances)

    def read_labels(self) -> tuple[NDArray[np.uint16] | None, NDArray[np.uint32] | None]:
        """Read classes (the low 16 bits) and instances (the high 16 bits)."""
        if not self.labelled:
            return None, None
        both = _read_array(self._label_file, np.dtype("<u4"), 1)[:, 0]
        labels = both.astype(np.uint16)  # keeps the low 16 bits
        actors = both >> 16
        # SemanticKITTI numbers the instances of each class from 1, so the class is part of an actor's number.
        # A moving car and the same car standing get the same number.
        return labels, np.where(actors > 0, _CLASS_PART[labels] | actors, np.uint32(0))

    def read_voxels(self) -> VoxelContent | None:
        """Read the frame's voxels, which SemanticKITTI has for every fifth scan."""
        return read_voxel_files(Path(self.folder) / "voxels", self.number)


def find_sequences(root: Path) -> list[Path]:
    """Return the folders of the sequences: those in `sequences/` or `dataset/sequences/`, or the folder itself.

    Raises:
        MissingDataError: no sequence exists.
    """
    if not root.is_dir():
        raise MissingDataError(
            root, expected="a folder", found="a file" if root.exists() else "nothing", advice="check the path"
        )
    if (root / "velodyne").is_dir():
        return [root.resolve()]
    for folder in (root / "sequences", root / "dataset" / "sequences", root):
        if folder.is_dir() and (found := sorted(path for path in folder.iterdir() if (path / "velodyne").is_dir())):
            return found
    raise MissingDataError(
        root,
        expected="sequences/00/velodyne/ and so on, or a folder with velodyne/ in it",
        found="none",
        advice="give the folder that holds sequences/",
    )


def frames_of(folder: Path, suffix: str) -> list[int]:
    """Return the sorted frame numbers of a folder's files; none if the folder does not exist."""
    if not folder.is_dir():
        return []
    numbers = (layout.frame_of(path.name, suffix) for path in folder.iterdir())
    return sorted(number for number in numbers if number is not None)


def read_calibration(path: Path) -> dict[str, Transform]:
    """Read calib.txt: "NAME:" and 12 numbers per line. Lines with other values are ignored.

    Returns:
        (4, 4) by name.

    Raises:
        FormatError: the file is not text, or Tr does not have 12 numbers.
    """
    try:
        lines = path.read_text().splitlines()
    except UnicodeDecodeError as error:
        raise FormatError(
            path, expected="NAME: and 12 numbers per line", found=f"a file that is not text ({error})"
        ) from error
    found = {}
    for line in lines:
        name, colon, values = line.partition(":")
        try:
            numbers = [float(value) for value in values.split()]
        except ValueError:
            numbers = []
        if colon and len(numbers) == 12:
            found[name.strip()] = np.vstack([np.reshape(numbers, (3, 4)), (0.0, 0.0, 0.0, 1.0)])
        elif name.strip() == "Tr":
            raise FormatError(path, expected="12 numbers after Tr:", found=repr(values.strip()))
    return found


def _split_of(name: str) -> Split:
    """Return the split of a sequence by its number; folders with other names belong to the training split."""
    number = int(name) if name.isascii() and name.isdigit() else 0
    return "Val" if number == _VALIDATION else "Test" if _TEST_FIRST <= number <= 21 else "Train"


def _read_array(path: str, dtype: np.dtype[Any], columns: int) -> NDArray[Any]:
    try:
        data = np.fromfile(path, np.uint8)
    except FileNotFoundError:
        raise MissingDataError(path, expected="a file", found="nothing", advice="copy it again") from None
    row = dtype.itemsize * columns
    if len(data) % row:
        raise FormatError(
            path,
            expected=f"a multiple of {row} bytes",
            found=str(len(data)),
            advice="the file is incomplete: copy it again",
        )
    return data.view(dtype).reshape(-1, columns)


_CLASS_PART = np.arange(1 << 16, dtype=np.uint32) << 16
_CLASS_PART[list(_STANDING)] = _CLASS_PART[list(_STANDING.values())]
