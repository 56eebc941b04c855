"""The raw capture: recordings of many sensors, from which ground truth is made (see the format
page, `docs/format.md#raw-capture`).

Sensor 0 is the ego sensor. The files in the folder raw/, which `carlasc.captures.writing` writes,
are:

velodyne{s}/{f}.npy  labels{s}/  instances{s}/  velocities{s}/  pose{s}/  times{s}.txt  bev/{f}.jpg
cameras.json  images/{camera}/{f}.jpg, and the other folders of images
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import cached_property
from pathlib import PurePosixPath

import numpy as np

from carlasc.captures.settings import LidarEffects
from carlasc.core.arrays import Float32Array, FloatArray, IntArray, Uint8Array
from carlasc.core.cameras import CameraModel
from carlasc.core.classes import ClassTable
from carlasc.core.geometry import Transform, check_rigid, rotate_vectors
from carlasc.core.scans import Scan, check_finite
from carlasc.core.tables import CARLA
from carlasc.errors import CarlascError, FormatError, MissingDataError
from carlasc.storage import layout
from carlasc.storage.arrays import ArrayFormat, parse_npy
from carlasc.storage.camera_files import cameras_from_json
from carlasc.storage.files import AnyPath
from carlasc.storage.inputs import FrameFiles, digest_of_bytes
from carlasc.storage.transport.remote_tree import RemoteTree, tree_of
from carlasc.storage.transport.trees import LocalTree, Tree

RAW = "raw"
"""Name of the folder of a capture, in the folder of its sequence."""

FOLDERS = {  # folder by value; the sensor number is appended
    "points": "velodyne",
    "labels": "labels",
    "instances": "instances",
    "velocities": "velocities",
    "pose": "pose",
}
FORMATS = {
    "points": ArrayFormat(("<f4",), (None, 3)),
    "labels": ArrayFormat(("<u4",), (None,)),
    "instances": ArrayFormat(("<u4",), (None,)),
    "velocities": ArrayFormat(("<f8",), (None, 4)),
    "pose": ArrayFormat(("<f8",), (4, 4)),
}
_BEV = "bev"


def array_path(name: str, sensor: int, frame: int) -> str:
    """Return the path of one value, such as "points", of a sensor in a frame."""
    return f"{FOLDERS[name]}{sensor}/{frame}.npy"


def times_path(sensor: int) -> str:
    """Return the path of the times file of a sensor."""
    return f"times{sensor}.txt"


def bev_path(frame: int) -> str:
    """Return the path of the bird's-eye picture of a frame."""
    return f"{_BEV}/{frame}.jpg"


def image_path(field: str, frame: int) -> str:
    """Return the path of an image of a frame. `field` is its name in the layout."""
    entry = layout.field_named(field)
    return f"{entry.folder}/{frame}{entry.suffix}"


def parse_times(data: bytes | memoryview, where: str) -> dict[int, tuple[float, str]]:
    """Return the time in seconds and the line of each frame of a times file.

    If a frame has several lines, the last one is valid.

    Raises:
        FormatError: a line does not have the format of CARLA. `where` is the file named in the
            message.
    """
    times: dict[int, tuple[float, str]] = {}
    for number, line in enumerate(bytes(data).decode(errors="replace").splitlines(), 1):
        match = re.match(r"\s*([0-9]{1,18})\s*,.*\belapsed_seconds=([-+0-9.eE]+)", line)
        try:
            if match is None:
                raise ValueError("another format")
            times[int(match[1])] = float(match[2]), line
        except ValueError as error:
            raise FormatError(
                where,
                expected="'<frame>, Timestamp(...,elapsed_seconds=...)'",
                found=f"{line[:60]!r} in line {number}",
            ) from error
    return times


_SEARCH_DEPTH = 3  # levels of folders: <root>/<split>/<sequence>, and one folder around them


@dataclass(frozen=True)
class SensorRecording:
    """The recording of one sensor in one frame.

    Attributes:
        scan: points in the sensor frame, with labels (0 is unlabelled) and instances (0 is no
            actor).
        world_T_sensor: (4, 4) float64 pose.
        velocities: (K, 4) float64, one row per actor that was hit: actor id, and velocity over
            ground in m/s on the axes of the sensor frame.
    """

    scan: Scan
    world_T_sensor: Transform
    velocities: FloatArray

    def flow(self) -> Float32Array:
        """Return (N, 3) float32 velocities of the actors hit by the points, m/s, sensor frame; zero
        for points without an actor.
        """
        flow = np.zeros((len(self.scan), 3), np.float32)
        if self.scan.instances is None or not len(self.velocities):
            return flow
        order = np.argsort(self.velocities[:, 0], kind="stable")
        actors = self.velocities[order, 0]
        row = np.searchsorted(actors, self.scan.instances).clip(max=len(actors) - 1)
        hit = (actors[row] == self.scan.instances) & (self.scan.instances != 0)
        flow[hit] = self.velocities[order[row[hit]], 1:]
        return flow


class Capture:
    """A capture, read by sensor and frame. It keeps only paths, so it can be pickled.

    Attributes:
        tree: the files of the sequence, or of raw/ itself.
        location: name of the folder raw/ in errors: a folder or a URL.
        classes: class table of the labels.
        effects: how the scans of the ego sensor differ from recordings.
    """

    effects = LidarEffects()

    def __init__(self, source: AnyPath | Tree, classes: ClassTable = CARLA) -> None:
        """Keep the folder of a capture. Sensors and frames are listed on first use.

        Args:
            source: the folder of a sequence with raw/, or raw/ itself: a path, a URL, or a tree of
                files.
            classes: class table of the labels.

        Raises:
            MissingDataError: the folder does not exist.
        """
        self.tree = source if isinstance(source, Tree) else tree_of(source, mapped=False)
        _check_folder(self.tree)
        self._folder = f"{RAW}/" if self.tree.entries().get(RAW) else ""
        self.location = self.tree.where(self._folder.rstrip("/"))
        self.classes = classes

    @property
    def is_simulated(self) -> bool:
        """Whether `carlasc simulate` or `carlasc capture` recorded it, whose settings are beside
        it.
        """
        return not {"simulation.json", "recording.json"}.isdisjoint(self._entries(""))

    @cached_property
    def sensors(self) -> tuple[int, ...]:
        """The sorted numbers of sensors: all sensors with at least one of the five folders.

        Raises:
            MissingDataError: no sensor, or not sensor 0, has such a folder.
        """
        numbers = set()
        for name, is_folder in self._entries("").items():
            match = re.fullmatch(r"([a-z]+)([0-9]{1,18})", name)
            if match and match[1] in FOLDERS.values() and is_folder:
                numbers.add(int(match[2]))
        if 0 not in numbers:
            raise MissingDataError(
                self.location,
                expected="the folder velodyne0 of the ego sensor",
                found=f"only the sensors {sorted(numbers)}" if numbers else "no sensor",
                advice="give a folder with raw/ in it, or raw/ itself",
            )
        return tuple(sorted(numbers))

    @cached_property
    def frames(self) -> IntArray:
        """The sorted frame numbers of sensor 0.

        A frame is listed if any of its files exists. Reading it raises an error if another file, or
        a file of another sensor, is missing.

        Raises:
            MissingDataError: the capture has no frames.
        """
        ego = self.sensors[0]
        numbers: set[int] = set()
        for kind in FOLDERS.values():
            names = self._entries(f"{kind}{ego}")
            numbers |= {
                int(name.removesuffix(".npy"))
                for name in names
                if re.fullmatch(r"[0-9]{1,18}\.npy", name)
            }
        if not numbers:
            raise MissingDataError(
                self.location, expected="frames such as velodyne0/100.npy", found="none"
            )
        return np.array(sorted(numbers), np.int64)

    def read_scan(self, frame: int) -> SensorRecording:
        """Read the scan of a frame, which need not be as ideal as the recording of sensor 0."""
        return self.read(0, frame)

    def read(self, sensor: int, frame: int) -> SensorRecording:
        """Read the recording of a sensor in a frame.

        Its files are requested together. The arrays may be read-only.

        Raises:
            MissingDataError: a file does not exist.
            FormatError: a file is cut short, has another type or shape, or has invalid values.
        """
        path = {name: self._folder + array_path(name, sensor, frame) for name in FOLDERS}
        where = {name: self.tree.where(file) for name, file in path.items()}
        files = dict(zip(path, self.tree.read_many(list(path.values())), strict=True))
        arrays = {name: parse_npy(data, FORMATS[name], where[name]) for name, data in files.items()}
        check_finite(arrays["points"], where["points"])
        check_finite(arrays["velocities"], where["velocities"])
        self.classes.check(arrays["labels"], where["labels"])
        for name in ("labels", "instances"):
            if len(arrays[name]) != len(arrays["points"]):
                raise FormatError(
                    where[name],
                    expected=f"{len(arrays['points'])} values, one per point of "
                    f"{array_path('points', sensor, frame)}",
                    found=len(arrays[name]),
                )
        scan = Scan(arrays["points"], labels=arrays["labels"], instances=arrays["instances"])
        return SensorRecording(
            scan, check_rigid(arrays["pose"], where["pose"]), arrays["velocities"]
        )

    def read_velocities(self, frame: int) -> dict[int, FloatArray]:
        """Return the (3,) velocity over ground, m/s, world frame, of each actor that a sensor hit
        in a frame, by actor id.

        Raises:
            MissingDataError: a file does not exist.
            FormatError: a file does not have the format.
        """
        paths = [
            self._folder + array_path(kind, sensor, frame)
            for kind in ("velocities", "pose")
            for sensor in self.sensors
        ]
        files = self.tree.read_many(paths)
        by_actor = dict[int, FloatArray]()
        half = len(self.sensors)
        for row, (path, data) in enumerate(zip(paths[:half], files[:half], strict=True)):
            rows = parse_npy(data, FORMATS["velocities"], where := self.tree.where(path))
            check_finite(rows, where)
            velocities = rotate_vectors(
                self._pose_of(paths[half + row], files[half + row]), rows[:, 1:]
            )
            by_actor |= dict(zip(rows[:, 0].astype(np.int64).tolist(), velocities, strict=True))
        return by_actor

    def read_pose(self, sensor: int, frame: int) -> Transform:
        """Return the (4, 4) float64 world_T_sensor of a frame.

        Raises:
            MissingDataError: the file does not exist.
            FormatError: it is not a rigid transform.
        """
        path = self._folder + array_path("pose", sensor, frame)
        return self._pose_of(path, self.tree.read(path))

    def read_poses(self, sensor: int, frames: Iterable[int]) -> FloatArray:
        """Return (F, 4, 4) float64 world_T_sensor of several frames, requested together; NaN for
        poses that cannot be read.
        """
        paths = [self._folder + array_path("pose", sensor, frame) for frame in frames]
        poses = np.full((len(paths), 4, 4), np.nan)
        try:
            files = dict(enumerate(self.tree.read_many(paths)))
        except CarlascError:
            files = {}
        for place, path in enumerate(paths):
            with suppress(FormatError, MissingDataError):
                poses[place] = self._pose_of(path, files[place] if files else self.tree.read(path))
        return poses

    def _pose_of(self, path: str, data: bytes | memoryview) -> Transform:
        where = self.tree.where(path)
        return check_rigid(parse_npy(data, FORMATS["pose"], where), where)

    def read_time(self, frame: int, sensor: int = 0) -> float:
        """Return the simulation time of a frame, seconds.

        If a frame has several lines, the last one is valid.

        Raises:
            MissingDataError: the times file does not exist, or has no line for the frame.
            FormatError: a line does not have the format of CARLA.
        """
        times = self.read_times(sensor)
        if frame not in times:
            where = self.tree.where(self._folder + times_path(sensor))
            raise MissingDataError(
                where, expected=f"a line for frame {frame}", found="no such line"
            )
        return times[frame]

    def read_times(self, sensor: int = 0) -> Mapping[int, float]:
        """Return the simulation time by frame number, seconds.

        Raises:
            MissingDataError: the times file does not exist.
            FormatError: a line does not have this format.
        """
        path = self._folder + times_path(sensor)
        lines = parse_times(self.tree.read(path), self.tree.where(path))
        return {frame: elapsed_s for frame, (elapsed_s, _) in lines.items()}

    def read_bev(self, frame: int) -> bytes | None:
        """Return the bird's-eye picture of a frame as JPEG bytes; None if it does not exist."""
        try:
            return bytes(self.tree.read(self._folder + bev_path(frame)))
        except MissingDataError:
            return None

    def has_bev(self, frame: int) -> bool:
        """Whether a frame has a bird's-eye picture."""
        return self.tree.is_file(self._folder + bev_path(frame))

    @cached_property
    def cameras(self) -> dict[str, CameraModel]:
        """The cameras of cameras.json by name, in the frame of the ego sensor; empty if the file
        does not exist.

        Raises:
            FormatError: the file is damaged.
        """
        path = self._folder + layout.CAMERAS
        if not self.tree.is_file(path):
            return {}
        return cameras_from_json(bytes(self.tree.read(path)), self.tree.where(path), "left")

    def image_fields(self, frame: int) -> tuple[str, ...]:
        """Return the layout names of the images of a frame, such as `images.front.jpg`."""
        names = [
            f"{folder}.{camera}.{suffix}"
            for camera in self.cameras
            for folder in layout.IMAGE_FOLDERS
            for suffix in layout.IMAGE_SUFFIXES
        ]
        return tuple(
            name for name in names if self.tree.is_file(self._folder + image_path(name, frame))
        )

    def read_images(self, frame: int) -> dict[str, Uint8Array]:
        """Return the image files of a frame as bytes, by their layout names."""
        names = self.image_fields(frame)
        files = self.tree.read_many([self._folder + image_path(name, frame) for name in names])
        return {
            name: np.frombuffer(data, np.uint8) for name, data in zip(names, files, strict=True)
        }

    def files_of(self, frame: int) -> list[str]:
        """Return the files of all sensors and cameras of a frame, as paths in the tree."""
        arrays = [array_path(name, sensor, frame) for sensor in self.sensors for name in FOLDERS]
        pictures = [bev_path(frame)] if self.has_bev(frame) else []
        pictures += [image_path(name, frame) for name in self.image_fields(frame)]
        return [self._folder + path for path in (*arrays, *pictures)]

    def light(self) -> Capture:
        """Return a copy without cached listings, to be sent to other processes with every frame."""
        return Capture(self.tree, self.classes)

    def _entries(self, folder: str) -> Mapping[str, bool]:
        return self.tree.entries((self._folder + folder).rstrip("/"))

    def __repr__(self) -> str:
        return f"<Capture {self.location}>"


def find_captures(source: AnyPath, places: Sequence[str] = ("",)) -> dict[str, Capture]:
    """Find the captures in a folder.

    Args:
        source: a path or a URL: the folder of a sequence with raw/ in it, raw/ itself, or a folder
            up to three levels above such sequences.
        places: folders in it that are searched.

    Returns:
        Captures by the path of their sequence relative to `source`, in sorted order. The path is ""
        if `source` is the sequence.

    Raises:
        MissingDataError: the folder does not exist, or contains no capture.
    """
    tree = tree_of(source, mapped=False)
    _check_folder(tree)
    entries = tree.entries()
    if (
        entries.get(RAW)
        or entries.get("velodyne0")
        or tree.location.rstrip("/").rpartition("/")[2] == RAW
    ):
        return {"": Capture(tree)}
    paths = list[str]()
    for place in places:
        depth = _SEARCH_DEPTH - len(PurePosixPath(place).parts)
        paths += _find(tree, place, max(depth, 0))
    if not paths:
        raise MissingDataError(
            tree.location,
            expected="a capture (a folder raw/ with velodyne0/, labels0/, ...)",
            found=f"none within {_SEARCH_DEPTH} levels of folders",
            advice="give the folder of a sequence with raw/ in it, or a folder of such sequences",
        )
    return {path: Capture(tree.below(path)) for path in sorted(paths)}


def _find(tree: Tree, path: str, depth: int) -> Iterator[str]:
    entries = tree.entries(path)
    if path and entries.get(RAW):
        yield path
    if depth:
        for name, is_folder in entries.items():
            if is_folder and name != RAW and not name.startswith("."):
                yield from _find(tree, f"{path}/{name}" if path else name, depth - 1)


def _check_folder(tree: Tree) -> None:
    """Raise MissingDataError if the folder of a tree does not exist.

    A folder in an object store exists if it contains a file.
    """
    if isinstance(tree, LocalTree):
        if not tree.root.is_dir():
            found = "a file" if tree.root.exists() else "nothing"
            raise MissingDataError(tree.location, expected="a folder", found=found)
    elif (
        isinstance(tree, RemoteTree) and tree.size() is not None
    ):  # to list it, a web server would send the whole file
        raise MissingDataError(tree.location, expected="a folder", found="a file")
    elif not tree.entries():
        raise MissingDataError(tree.location, expected="a folder", found="nothing")


class CaptureFiles(FrameFiles):
    """The files of each frame of a capture."""

    kind = "capture"

    def __init__(self, capture: Capture) -> None:
        self.capture = capture
        self.tree = capture.tree

    def paths(self, frame: int) -> list[str]:
        """Return the files of all sensors and cameras."""
        return self.capture.files_of(frame)

    def contents(self, frame: int) -> Iterator[tuple[str, bytes]]:
        """Yield the name and the digest of each file."""
        paths = self.paths(frame)
        for path, data in zip(paths, self.capture.tree.read_many(paths), strict=True):
            yield path, digest_of_bytes(data)
