"""The sensor data set of Argoverse 2: see the page `docs/sets/argoverse2.md`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from carlasc.converting.protocol import (
    Cloud,
    Converter,
    FrameHandle,
    Recording,
    Sensor,
    Split,
    Trajectory,
)
from carlasc.core import CameraModel
from carlasc.core.arrays import AnyFloatArray, FloatArray, IntArray, Uint32Array
from carlasc.core.boxes import Boxes
from carlasc.core.geometry import translation
from carlasc.errors import FormatError
from carlasc_converters.argoverse2_classes import ARGOVERSE2, CATEGORIES, TO_CARLA
from carlasc_converters.feather import read_columns
from carlasc_converters.files import missing_scans, no_data
from carlasc_converters.image_files import nearest_images
from carlasc_converters.transforms import poses_of

_SPLITS: dict[str, Split] = {"train": "Train", "val": "Val", "test": "Test"}
_LEVELS = 4  # depth of a log below the given folder: root/sensor/train/LOG, and one more
_SENSORS = ("up_lidar", "down_lidar")  # lasers 0 to 31, and 32 to 63
_LASERS = 32
# the origin of the vehicle's frame is the rear axle: measured on the ground points of two logs
_AXLE_HEIGHT_M = 0.33
# midway between the two LiDARs, which are 0.11 m apart, as calibrated in log 7fab2350
_ASSUMED_M = (  # fact: argoverse2-lidar
    1.35,
    0.0,
    1.58,
)
_INTRINSICS = ("fx_px", "fy_px", "cx_px", "cy_px", "k1", "k2", "k3", "width_px", "height_px")
_NEAR_NS = 100_000_000  # an image that is farther from a frame in time does not belong to it
_QUATERNION = ("qw", "qx", "qy", "qz")
_TRANSLATION = ("tx_m", "ty_m", "tz_m")
_SIZE = ("length_m", "width_m", "height_m")


class Argoverse2(Converter):
    """Reads the sensor data set of Argoverse 2, one of its splits, or one log."""

    title: ClassVar[str] = "Argoverse 2, sensor data set"
    license = "CC BY-NC-SA 4.0"
    citation = "B. Wilson et al., Argoverse 2, NeurIPS Datasets and Benchmarks 2021"
    classes = ARGOVERSE2
    to_carla = TO_CARLA
    sensor = "two Velodyne VLP-32C, one above the other"
    min_range_m = 2.5
    max_range_m = 70.0

    def sequences(self) -> list[Recording]:
        """Return the logs, by name.

        Raises:
            MissingDataError: no log exists.
        """
        root = self.source.resolve()
        patterns = ("*/" * level + "sensors/lidar" for level in range(_LEVELS + 1))
        logs = {
            path.parents[1] for pattern in patterns for path in root.glob(pattern) if path.is_dir()
        }
        if not logs:
            raise no_data(
                self.source,
                "logs: folders with sensors/lidar/ in them",
                "give the folder that holds train/, val/ or test/, one of these, or one log",
            )
        return [Argoverse2Log(log) for log in sorted(logs, key=lambda log: (log.name, str(log)))]


class Argoverse2Log(Recording):
    """One log.

    Frames are the existing and the annotated sweeps. A frame therefore keeps its number if other
    files of the log are missing, and tracks have their annotated length. Times begin at the first
    frame.

    Attributes:
        folder: its folder.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.name = f"AV2_{folder.name}"
        self.location = str(folder)
        self.split = _SPLITS.get(folder.parent.name, "Train")

    @cached_property
    def _sweeps(self) -> dict[int, Path]:
        """The files of the points by timestamp in nanoseconds, increasing."""
        files = (self.folder / "sensors" / "lidar").iterdir()
        return dict(sorted((int(path.stem), path) for path in files if _is_sweep(path)))

    @cached_property
    def _annotated(self) -> IntArray:
        """(A,) timestamps of the annotated sweeps in nanoseconds, increasing; none if nothing is
        annotated.
        """
        if not self._annotations.is_file():
            return np.zeros(0, np.int64)
        return np.unique(
            read_columns(self._annotations, ("timestamp_ns",))["timestamp_ns"].astype(np.int64)
        )

    @cached_property
    def _timeline(self) -> IntArray:
        """(F,) timestamp of each frame in nanoseconds."""
        return np.union1d(np.array(list(self._sweeps), np.int64), self._annotated)

    @cached_property
    def _missing(self) -> tuple[list[tuple[int, int]], int]:
        """Number and timestamp of annotated sweeps without a file between sweeps with files; and
        the number of others without a file.
        """
        missing = [
            (number, at)
            for number, at in enumerate(self._timeline.tolist())
            if at not in self._sweeps
        ]
        sweeps = list(self._sweeps)
        between = [row for row in missing if sweeps and sweeps[0] < row[1] < sweeps[-1]]
        return between, len(missing) - len(between)

    @cached_property
    def frames(self) -> Sequence[FrameHandle]:  # type: ignore[override]
        """The sweeps that exist."""
        sweeps = enumerate(self._timeline.tolist())
        count = len(self.sensors)
        return [
            Sweep(str(self._sweeps[at]), number, count)
            for number, at in sweeps
            if at in self._sweeps
        ]

    @cached_property
    def sensors(self) -> Sequence[Sensor]:  # type: ignore[override]
        """The upper and the lower LiDAR; one sensor at an assumed position if the log has no
        calibration.
        """
        if not self._calibration.is_file():
            mount = translation(_ASSUMED_M)
            height = round(_ASSUMED_M[2] + _AXLE_HEIGHT_M, 2)
            return (Sensor("lidar", mount, points_in="vehicle", height_m=height, calibrated=False),)
        where = str(self._calibration)
        table = read_columns(self._calibration, (*_QUATERNION, *_TRANSLATION), ("sensor_name",))
        names = table["sensor_name"].tolist()
        if lacking := [name for name in _SENSORS if name not in names]:
            found = ", ".join(names) or "none"
            raise FormatError(
                where,
                expected=f"a row for each of {', '.join(_SENSORS)}",
                found=f"no {lacking[0]} in {found}",
            )
        poses = poses_of(_stack(table, _QUATERNION), _stack(table, _TRANSLATION), where)
        mounts = [poses[names.index(name)] for name in _SENSORS]
        return [
            Sensor(
                name,
                mount,
                points_in="vehicle",
                height_m=round(float(mount[2, 3]) + _AXLE_HEIGHT_M, 2),
            )
            for name, mount in zip(_SENSORS, mounts, strict=True)
        ]

    @property
    def _calibration(self) -> Path:
        return self.folder / "calibration" / "egovehicle_SE3_sensor.feather"

    @property
    def _annotations(self) -> Path:
        return self.folder / "annotations.feather"

    @property
    def _poses(self) -> Path:
        return self.folder / "city_SE3_egovehicle.feather"

    def poses(self, *, force: bool = False) -> Trajectory | None:
        """Return the poses of the vehicle in the city's frame, at their own times: about 100 a
        second.
        """
        if not self._poses.is_file():
            return None
        table = read_columns(self._poses, ("timestamp_ns", *_QUATERNION, *_TRANSLATION))
        poses = poses_of(_stack(table, _QUATERNION), _stack(table, _TRANSLATION), str(self._poses))
        return Trajectory(poses, self._seconds(table["timestamp_ns"]), str(self._poses))

    def times(self) -> FloatArray:
        """Return seconds after the first frame."""
        return self._seconds(self._timeline)

    def _seconds(self, timestamps: IntArray) -> FloatArray:
        """Return seconds after the first frame.

        Nanoseconds are subtracted as integers, because float64 would round them to 64 ns.
        """
        start = self._timeline[0] if len(self._timeline) else 0
        return (timestamps.astype(np.int64) - start) * 1e-9

    def cameras(self) -> Sequence[CameraModel]:
        """Return the ring and stereo cameras, with the images nearest in time to each frame; none
        without their calibration.
        """
        path = self.folder / "calibration" / "intrinsics.feather"
        if not path.is_file() or not self._calibration.is_file():
            return ()
        table = read_columns(path, _INTRINSICS, ("sensor_name",))
        places = read_columns(self._calibration, (*_QUATERNION, *_TRANSLATION), ("sensor_name",))
        poses = poses_of(
            _stack(places, _QUATERNION), _stack(places, _TRANSLATION), str(self._calibration)
        )
        by_name = dict(zip(places["sensor_name"].tolist(), poses, strict=True))
        cameras = []
        for row, name in enumerate(table["sensor_name"].tolist()):
            if name not in by_name:
                expected = f"a row for each of {', '.join(table['sensor_name'].tolist())}"
                raise FormatError(self._calibration, expected=expected, found=f"no {name}")
            fx, fy, cx, cy, k1, k2, k3, width, height = (
                float(table[key][row]) for key in _INTRINSICS
            )
            times, images = self._images_of(name)
            cameras.append(
                CameraModel(
                    name=name,
                    width=int(width),
                    height=int(height),
                    model="radial-tangential",
                    matrix=np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]]),
                    distortion=(k1, k2, 0.0, 0.0, k3),
                    sensor_T_camera=by_name[name],
                    times=times,
                    images=images,
                )
            )
        return cameras

    def _images_of(self, name: str) -> tuple[FloatArray | None, tuple[str, ...] | None]:
        """Return the time and the path of the image nearest to each frame; None if the camera has
        no images.
        """
        folder = self.folder / "sensors" / "cameras" / name
        paths = {
            int(path.stem): path
            for path in folder.glob("*.jpg")
            if path.stem.isascii() and path.stem.isdigit()
        }
        if not paths:
            return None, None
        nearest, near, images = nearest_images(paths, self._timeline, _NEAR_NS)
        return np.where(near, self._seconds(nearest), np.nan), images

    def boxes(self) -> Mapping[int, Boxes] | None:
        """Return the boxes of the annotated sweeps.

        Tracks are numbered by the order of their UUIDs.
        """
        path = self._annotations
        if not path.is_file():
            return None
        numbers = ("timestamp_ns", *_QUATERNION, *_TRANSLATION, *_SIZE)
        table = read_columns(path, numbers, ("track_uuid", "category"))
        tracks = np.unique(table["track_uuid"], return_inverse=True)[1].astype(
            np.uint32
        ) + np.uint32(1)
        labels = _labels(table["category"], str(path))
        centers, quaternions, sizes = (
            _stack(table, names) for names in (_TRANSLATION, _QUATERNION, _SIZE)
        )
        boxes = {}
        for number, at in enumerate(self._timeline.tolist()):
            own = table["timestamp_ns"] == at
            if not own.any():
                continue  # this sweep was not annotated
            annotated = np.ones(np.count_nonzero(own), np.bool_)
            try:
                boxes[number] = Boxes(
                    tracks[own], labels[own], centers[own], quaternions[own], sizes[own], annotated
                )
            except FormatError as error:
                raise error.within(f"{path}: timestamp {at}") from error
        return boxes

    def problems(self) -> list[tuple[int, str]]:
        """Return the annotated sweeps without a file that are between sweeps with files."""
        lidar = self.folder / "sensors" / "lidar"
        files = [(number, lidar / f"{at}.feather") for number, at in self._missing[0]]
        return missing_scans(files, "an annotated sweep")

    def notes(self) -> list[str]:
        """Return notes on what is missing in the log."""
        notes = []
        if not self._calibration.is_file():
            place = ", ".join(f"{value:.2f}" for value in _ASSUMED_M)
            notes.append(
                f"{self._calibration} does not exist: both LiDARs count as one, whose rays begin "
                f"at ({place}) m in the frame of the"
                " vehicle, as assumed from another log"
            )
        if outside := self._missing[1]:
            notes.append(
                f"{self.folder}: {outside} annotated sweeps before the first and after the last "
                f"file do not exist"
            )
        return notes


@dataclass(frozen=True)
class Sweep(FrameHandle):
    """One file of points.

    Attributes:
        sensors: 2; 1 if all points count as those of one sensor.
    """

    location: str
    number: int
    sensors: int

    def read(self) -> Sequence[Cloud]:
        """Read the points of each LiDAR, in the order of the file."""
        names = ("x", "y", "z", "intensity", "laser_number", "offset_ns")
        table = read_columns(Path(self.location), names)
        count = len(table["x"])
        lasers = table["laser_number"]
        if not count:
            raise FormatError(
                self.location, expected="points", found="an empty table", advice="download it again"
            )
        if lasers.max() >= 2 * _LASERS:
            raise FormatError(
                self.location,
                expected=f"laser numbers 0..{2 * _LASERS - 1}",
                found=lasers.max(),
            )
        points = np.empty((count, 4), np.float32)
        for column, name in enumerate(("x", "y", "z", "intensity")):
            points[:, column] = table[name]
        points[:, 3] /= 255.0
        seconds = table["offset_ns"] * 1e-9
        if self.sensors == 1:
            return (Cloud(points, seconds=seconds),)
        upper = lasers < _LASERS
        return tuple(
            Cloud(points[own], seconds=seconds[own], sensor=k)
            for k, own in enumerate((upper, ~upper))
        )


def _is_sweep(path: Path) -> bool:
    return path.suffix == ".feather" and path.stem.isascii() and path.stem.isdigit()


def _stack(table: Mapping[str, AnyFloatArray], names: Sequence[str]) -> FloatArray:
    return np.stack([table[name].astype(np.float64) for name in names], axis=1)


def _labels(categories: NDArray[np.object_], where: str) -> Uint32Array:
    """Return the class id of each category."""
    names, rows = np.unique(categories, return_inverse=True)
    if unknown := [str(name) for name in names if name not in CATEGORIES]:
        raise FormatError(
            where,
            expected=f"the {len(CATEGORIES)} categories of Argoverse 2",
            found=", ".join(unknown),
            advice="the file belongs to another version of the data set, or to another data set",
        )
    return np.array([CATEGORIES[name] for name in names], np.uint32)[rows]
