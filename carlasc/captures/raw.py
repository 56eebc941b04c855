"""The raw multi-sensor capture: what the ground truth is made from (FORMAT section 3).

    raw/velodyne{s}/{f}.npy  labels{s}/  instances{s}/  velocities{s}/  pose{s}/  times{s}.txt  bev/{f}.jpg

Sensor 0 is the ego one. Nothing else knows a file name of a capture.
"""

from __future__ import annotations

import io
import os
import re
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from carlasc.core.classes import ClassTable
from carlasc.core.geometry import Transform, check_rigid
from carlasc.core.scans import Scan, check_finite
from carlasc.core.tables import CARLA
from carlasc.errors import ConflictError, FormatError, MissingDataError
from carlasc.storage.files import append_line, parse_json, write_atomic, write_json

EGO_SENSOR_M = (-0.5, 0.0, 1.8)  # in the vehicle's frame (FORMAT section 3)
SPREAD_M, HEIGHTS_M = 20.0, (1.0, 5.0)  # the other sensors are within this of the vehicle, in x and y, and so high
TRAFFIC = {"light": 25, "medium": 50, "heavy": 100}
"""Vehicles under way, and as many pedestrians, by the name of the traffic (FORMAT section 1)."""

RAW = "raw"
_BEV = "bev"
_DEPTH = 3  # <root>/<split>/<sequence>, and one folder around it


def sensor_offsets(count: int, rng: np.random.Generator) -> NDArray[np.float64]:
    """Return where the sensors are on the vehicle: (count, 3) metres, the ego one first, the others anywhere around."""
    low, high = (-SPREAD_M, -SPREAD_M, HEIGHTS_M[0]), (SPREAD_M, SPREAD_M, HEIGHTS_M[1])
    return np.vstack([EGO_SENSOR_M, rng.uniform(low, high, (count - 1, 3))])


@dataclass(frozen=True)
class _File:
    """What one of a sensor's files holds: folder before the sensor's number, type, shape (None is any length)."""

    folder: str
    dtype: str
    shape: tuple[int | None, ...]


_FILES = {
    "points": _File("velodyne", "<f4", (None, 3)),
    "labels": _File("labels", "<u4", (None,)),
    "instances": _File("instances", "<u4", (None,)),
    "velocities": _File("velocities", "<f8", (None, 4)),
    "pose": _File("pose", "<f8", (4, 4)),
}


@dataclass(frozen=True)
class Recording:
    """What one sensor recorded in one frame.

    Attributes:
        scan: points in the sensor's own frame, with labels (0 is unlabelled) and instances (0 is no actor).
        world_T_sensor: (4, 4) float64 pose.
        velocities: (K, 4) float64: actor id, then its velocity in m/s in the sensor's frame; one row an actor that was hit.
    """

    scan: Scan
    world_T_sensor: Transform
    velocities: NDArray[np.float64]

    def flow(self) -> NDArray[np.float32]:
        """Return the (N, 3) float32 velocity of each point's actor, m/s, sensor frame; zero where there is none."""
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
    """A capture on disk, read one sensor and one frame at a time. Holds paths only, so it pickles."""

    def __init__(self, root: str | os.PathLike[str], classes: ClassTable = CARLA) -> None:
        """Remember the folder; it is looked at when its sensors or frames are asked for.

        Args:
            root: a sequence's folder that holds raw/, or raw/ itself.
            classes: the labels' table.

        Raises:
            MissingDataError: there is no such folder.
        """
        root = Path(root)
        if not root.is_dir():
            raise MissingDataError(root, expected="a folder", found=f"{'a file' if root.exists() else 'nothing'}")
        self.raw = root / RAW if (root / RAW).is_dir() else root
        self.location = str(self.raw)
        self.classes = classes

    @cached_property
    def sensors(self) -> tuple[int, ...]:
        """The sensors' numbers, in rising order: those that any of the five kinds of file names.

        Raises:
            MissingDataError: there is none, or the ego sensor 0 is not among them.
        """
        found = set()
        for name in os.listdir(self.raw):
            kind = re.fullmatch(r"([a-z]+)([0-9]+)", name)
            if kind and kind[1] in {file.folder for file in _FILES.values()} and (self.raw / name).is_dir():
                found.add(int(kind[2]))
        if 0 not in found:
            raise MissingDataError(
                self.raw,
                expected="the ego sensor's folder velodyne0",
                found=f"{f'only the sensors {sorted(found)}' if found else 'no sensor'}",
                advice="give a folder that holds raw/, or raw/ itself",
            )
        return tuple(sorted(found))

    @cached_property
    def frames(self) -> NDArray[np.int64]:
        """The sorted frame numbers of sensor 0. Those that lack a file, here or at another sensor, are found when read.

        Raises:
            MissingDataError: there is none.
        """
        ego = self.sensors[0]
        found: set[int] = set()
        for file in _FILES.values():
            folder = self.raw / f"{file.folder}{ego}"
            names = os.listdir(folder) if folder.is_dir() else []
            found |= {int(name.removesuffix(".npy")) for name in names if re.fullmatch(r"[0-9]+\.npy", name)}
        if not found:
            raise MissingDataError(self.raw, expected="frames such as velodyne0/100.npy", found="none")
        return np.array(sorted(found), np.int64)

    def read(self, sensor: int, frame: int) -> Recording:
        """Read what a sensor recorded in a frame.

        Raises:
            MissingDataError: one of its files is not there.
            FormatError: a file is cut short, has another type or shape, or values that make no sense.
        """
        arrays = {name: self._read(name, sensor, frame) for name in ("points", "labels", "instances", "velocities")}
        path = {name: self._path(name, sensor, frame) for name in _FILES}
        check_finite(arrays["points"], str(path["points"]))
        check_finite(arrays["velocities"], str(path["velocities"]))
        self.classes.check(arrays["labels"], str(path["labels"]))
        for name in ("labels", "instances"):
            if len(arrays[name]) != len(arrays["points"]):
                raise FormatError(
                    path[name],
                    expected=(
                        f"{len(arrays['points'])} values, one a point of {path['points'].name} in "
                        f"{path['points'].parent.name}"
                    ),
                    found=f"{len(arrays[name])}",
                )
        velocities = arrays.pop("velocities")
        scan = Scan(arrays["points"], labels=arrays["labels"], instances=arrays["instances"])
        return Recording(scan, self.read_pose(sensor, frame), velocities)

    def read_pose(self, sensor: int, frame: int) -> Transform:
        """Return (4, 4) float64 world_T_sensor.

        Raises:
            MissingDataError: the file is not there.
            FormatError: it holds no rigid transform.
        """
        return check_rigid(self._read("pose", sensor, frame), str(self._path("pose", sensor, frame)))

    def read_time(self, frame: int, sensor: int = 0) -> float:
        """Return the simulation's seconds at a frame; the last line for it counts.

        Raises:
            MissingDataError: the times file, or the frame in it, is not there.
        """
        times = self._times(sensor)
        if frame not in times:
            raise MissingDataError(self._times_path(sensor), expected=f"a line for frame {frame}", found="none")
        return times[frame]

    def read_bev(self, frame: int) -> bytes | None:
        """Return a frame's bird's-eye picture as JPEG bytes, None if there is none."""
        path = self.bev_path(frame)
        return path.read_bytes() if path.is_file() else None

    def has_bev(self, frame: int) -> bool:
        """Whether a frame has a bird's-eye picture."""
        return self.bev_path(frame).is_file()

    def bev_path(self, frame: int) -> Path:
        """Return where a frame's bird's-eye picture stands, or would."""
        return self.raw / _BEV / f"{frame}.jpg"

    def _path(self, name: str, sensor: int, frame: int) -> Path:
        return self.raw / f"{_FILES[name].folder}{sensor}" / f"{frame}.npy"

    def _read(self, name: str, sensor: int, frame: int) -> NDArray[Any]:
        return _read_npy(self._path(name, sensor, frame), _FILES[name])

    def _times_path(self, sensor: int) -> Path:
        return self.raw / f"times{sensor}.txt"

    def _times(self, sensor: int) -> Mapping[int, float]:
        path = self._times_path(sensor)
        if not path.is_file():
            raise MissingDataError(path, expected="a file", found="nothing")
        times: dict[int, float] = {}
        for number, line in enumerate(path.read_text(errors="replace").splitlines(), 1):
            match = re.match(r"\s*([0-9]+)\s*,.*\belapsed_seconds=([-+0-9.eE]+)", line)
            if not match:
                raise FormatError(
                    path,
                    expected="'<frame>, Timestamp(...,elapsed_seconds=...)'",
                    found=f"{line[:60]!r} in line {number}",
                )
            times[int(match[1])] = float(match[2])
        return times

    def __repr__(self) -> str:
        return f"<Capture {self.location}>"


class CaptureWriter:
    """Writes a capture, every file atomically; pickles into workers."""

    def __init__(self, root: str | os.PathLike[str]) -> None:
        """Remember the sequence's folder: files go to `<root>/raw`."""
        self.raw = Path(root) / RAW
        self.location = str(self.raw)

    def check_settings(self, file: str, settings: Mapping[str, Any], command: str) -> None:
        """Check that what is there was made with the same settings, or that nothing is there yet.

        Args:
            file: the file in raw/ that holds them.
            settings: those of this run, as JSON has them.
            command: what makes such captures, for the error.

        Raises:
            ConflictError: another capture is there; names the difference.
        """
        path = self.raw / file
        if not path.is_file():
            if self.raw.is_dir() and any(self.raw.iterdir()):
                raise ConflictError(
                    self.raw,
                    expected=f"nothing or a capture of `{command}`",
                    found=f"a capture without {file}",
                    advice="choose another folder",
                )
            return
        theirs = parse_json(path.read_bytes(), str(path))
        differing = [key for key in sorted(settings.keys() | theirs.keys()) if settings.get(key) != theirs.get(key)]
        if differing:
            wanted, there = (", ".join(f"{key} {side.get(key)!r}" for key in differing) for side in (settings, theirs))
            raise ConflictError(
                path,
                expected=f"{wanted}",
                found=f"{there}",
                advice="choose another folder, or the settings it was made with",
            )

    def write_settings(self, file: str, settings: Mapping[str, Any]) -> None:
        """Write down what the capture is made from."""
        write_json(self.raw / file, dict(settings))

    def has(self, sensor: int, frame: int) -> bool:
        """Whether all of a sensor's files of a frame are there; each is whole, because files are renamed into place."""
        return all(self._path(name, sensor, frame).is_file() for name in _FILES)

    def write(self, sensor: int, frame: int, recording: Recording) -> None:
        """Write what a sensor recorded in a frame, over what is there.

        Raises:
            FormatError: the scan has no labels or instances, or the pose is not rigid.
            StorageError: the disk is full or the folder cannot be written to.
        """
        scan = recording.scan
        if scan.labels is None or scan.instances is None:
            raise FormatError(
                f"{self.raw}: sensor {sensor}, frame {frame}", expected="labels and instances", found="none"
            )
        arrays: dict[str, NDArray[Any]] = {
            "points": scan.points,
            "labels": scan.labels,
            "instances": scan.instances,
            # as the authors' files: an empty list of actors has lost its columns
            "velocities": recording.velocities if len(recording.velocities) else np.empty(0, np.float64),
            "pose": check_rigid(recording.world_T_sensor, f"{self.raw}: sensor {sensor}, frame {frame}"),
        }
        for name, array in arrays.items():
            buffer = io.BytesIO()
            np.save(buffer, np.ascontiguousarray(array, _FILES[name].dtype), allow_pickle=False)
            write_atomic(self._path(name, sensor, frame), buffer.getbuffer())

    def write_time(self, sensor: int, frame: int, elapsed_s: float) -> None:
        """Add a frame's line to a sensor's times file: the simulation's seconds, in CARLA's words."""
        seconds = float(elapsed_s)
        append_line(
            self.raw / f"times{sensor}.txt",
            f"{frame}, Timestamp(frame={frame},elapsed_seconds={seconds},delta_seconds=0.1,platform_timestamp={seconds})",
        )

    def write_bev(self, frame: int, jpeg: bytes) -> None:
        """Write a frame's bird's-eye picture, given as JPEG bytes."""
        write_atomic(self.raw / _BEV / f"{frame}.jpg", jpeg)

    def _path(self, name: str, sensor: int, frame: int) -> Path:
        return self.raw / f"{_FILES[name].folder}{sensor}" / f"{frame}.npy"

    def __repr__(self) -> str:
        return f"<CaptureWriter {self.location}>"


def find_captures(root: str | os.PathLike[str]) -> dict[str, Capture]:
    """Find the captures at or below a folder.

    Args:
        root: a sequence's folder that holds raw/, raw/ itself, or a folder of such sequences, up to three levels up.

    Returns:
        Captures by the path of their sequence below `root`, in sorted order; "" where root is the sequence.

    Raises:
        MissingDataError: there is none; says what was looked for.
    """
    root = Path(root)
    capture = Capture(root)
    if capture.raw != root or root.name == RAW or (root / "velodyne0").is_dir():
        return {"": capture}
    paths = sorted(
        str(raw.parent.relative_to(root))
        for depth in range(1, _DEPTH + 1)
        for raw in root.glob("/".join(["[!.]*"] * depth) + f"/{RAW}")
        if raw.is_dir()
    )
    if not paths:
        raise MissingDataError(
            root,
            expected="a capture (a folder raw/ with velodyne0/, labels0/, ...)",
            found=f"none down to {_DEPTH} levels",
            advice="give a sequence's folder that holds raw/, or a folder of such sequences",
        )
    return {path: Capture(root / path) for path in paths}


def _read_npy(path: Path, file: _File) -> NDArray[Any]:
    """Read a .npy file of a known type and shape. The size is checked before a byte of the array is read."""
    try:
        with path.open("rb") as stream:
            shape, fortran, dtype = _read_header(stream, path)
            size, start = os.fstat(stream.fileno()).st_size, stream.tell()
            if len(shape) == 1 and shape[0] == 0 and len(file.shape) == 2:
                shape = (0, file.shape[1] or 0)  # the authors' empty list of actors has no columns
            named = " x ".join("N" if n is None else str(n) for n in file.shape)
            if dtype != np.dtype(file.dtype):
                raise FormatError(path, expected=f"{np.dtype(file.dtype).name} values", found=f"{dtype.name}")
            if len(shape) != len(file.shape) or any(
                want not in (None, found) for want, found in zip(file.shape, shape, strict=True)
            ):
                raise FormatError(path, expected=f"an array of {named} values", found=f"{' x '.join(map(str, shape))}")
            count = int(np.prod(shape, dtype=np.int64))
            if size - start != count * dtype.itemsize:
                raise FormatError(
                    path,
                    expected=f"{start + count * dtype.itemsize} bytes ({' x '.join(map(str, shape))} {dtype.name})",
                    found=f"{size}",
                    advice="cut short, or something was added",
                )
            array = np.fromfile(stream, dtype, count)
    except FileNotFoundError as error:
        raise MissingDataError(path, expected="a file", found="nothing") from error
    except OSError as error:
        raise FormatError(f"{path}: cannot be read: {error.strerror or error}") from error
    return np.ascontiguousarray(array.reshape(shape, order="F" if fortran else "C"))


def _read_header(stream: BinaryIO, path: Path) -> tuple[tuple[int, ...], bool, np.dtype[Any]]:
    readers = {(1, 0): np.lib.format.read_array_header_1_0, (2, 0): np.lib.format.read_array_header_2_0}
    try:
        version = np.lib.format.read_magic(stream)
        if version not in readers:
            raise ValueError(f"version {version} of the .npy format")
        shape, fortran, dtype = readers[version](stream)
    except ValueError as error:
        raise FormatError(path, expected="a .npy array", found="something else", advice=f"{error}") from error
    return shape, fortran, dtype
