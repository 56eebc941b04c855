"""The raw capture: recordings of many sensors, from which ground truth is made (see the format page, `docs/format.md#raw-capture`).

    raw/velodyne{s}/{f}.npy  labels{s}/  instances{s}/  velocities{s}/  pose{s}/  times{s}.txt  bev/{f}.jpg

Sensor 0 is the ego sensor. Only this module knows the file names of a capture.
"""

from __future__ import annotations

import io
import os
import re
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from carlasc.captures.npy import ArrayFormat, read_npy
from carlasc.core.classes import ClassTable
from carlasc.core.geometry import Transform, check_rigid
from carlasc.core.scans import Scan, check_finite
from carlasc.core.tables import CARLA
from carlasc.errors import ConflictError, FormatError, MissingDataError
from carlasc.storage.files import append_line, parse_json, write_atomic, write_json
from carlasc.storage.layout import FRAME_PERIOD_S

RAW = "raw"
"""Name of the folder that holds a capture, in the folder of its sequence."""

_BEV = "bev"
_SEARCH_DEPTH = 3  # levels: <root>/<split>/<sequence>, and one folder around them
_FOLDERS = {  # value -> folder, to which the sensor's number is appended
    "points": "velodyne",
    "labels": "labels",
    "instances": "instances",
    "velocities": "velocities",
    "pose": "pose",
}
_FORMATS = {
    "points": ArrayFormat("<f4", (None, 3)),
    "labels": ArrayFormat("<u4", (None,)),
    "instances": ArrayFormat("<u4", (None,)),
    "velocities": ArrayFormat("<f8", (None, 4)),
    "pose": ArrayFormat("<f8", (4, 4)),
}


@dataclass(frozen=True)
class Recording:
    """What one sensor recorded in one frame.

    Attributes:
        scan: points in the sensor's frame, with labels (0 is unlabelled) and instances (0 is no actor).
        world_T_sensor: (4, 4) float64 pose.
        velocities: (K, 4) float64, one row per actor that was hit: the actor's id, and its velocity over ground in m/s, on the axes
            of the sensor's frame.
    """

    scan: Scan
    world_T_sensor: Transform
    velocities: NDArray[np.float64]

    def flow(self) -> NDArray[np.float32]:
        """Return the (N, 3) float32 velocity of the actor that each point lies on, m/s, sensor frame; zero on points of no actor."""
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
    """A capture on disk, read per sensor and frame. It holds paths only, so it can be pickled.

    Attributes:
        raw: the folder raw/.
        location: the same as text, for messages.
        classes: class table of the labels.
    """

    def __init__(self, source: str | os.PathLike[str], classes: ClassTable = CARLA) -> None:
        """Take a capture's folder. Its sensors and frames are listed when they are asked for.

        Args:
            source: the folder of a sequence, which holds raw/, or raw/ itself.
            classes: class table of the labels.

        Raises:
            MissingDataError: the folder does not exist.
        """
        folder = Path(source)
        if not folder.is_dir():
            raise MissingDataError(folder, expected="a folder", found="a file" if folder.exists() else "nothing")
        self.raw = folder / RAW if (folder / RAW).is_dir() else folder
        self.location = str(self.raw)
        self.classes = classes

    @cached_property
    def sensors(self) -> tuple[int, ...]:
        """The sensors' numbers in ascending order: all sensors that have a folder of any of the five kinds.

        Raises:
            MissingDataError: no sensor has one, or sensor 0 has none.
        """
        found = set()
        for name in os.listdir(self.raw):
            match = re.fullmatch(r"([a-z]+)([0-9]+)", name)
            if match and match[1] in _FOLDERS.values() and (self.raw / name).is_dir():
                found.add(int(match[2]))
        if 0 not in found:
            raise MissingDataError(
                self.raw,
                expected="the ego sensor's folder velodyne0",
                found=f"only the sensors {sorted(found)}" if found else "no sensor",
                advice="give a folder that holds raw/, or raw/ itself",
            )
        return tuple(sorted(found))

    @cached_property
    def frames(self) -> NDArray[np.int64]:
        """The frame numbers of sensor 0 in ascending order.

        A frame is listed when any of its files exists; reading it raises an error where another file, or another sensor's, is missing.

        Raises:
            MissingDataError: the capture has no frames.
        """
        ego = self.sensors[0]
        found: set[int] = set()
        for kind in _FOLDERS.values():
            folder = self.raw / f"{kind}{ego}"
            names = os.listdir(folder) if folder.is_dir() else []
            found |= {int(name.removesuffix(".npy")) for name in names if re.fullmatch(r"[0-9]+\.npy", name)}
        if not found:
            raise MissingDataError(self.raw, expected="frames such as velodyne0/100.npy", found="none")
        return np.array(sorted(found), np.int64)

    def read(self, sensor: int, frame: int) -> Recording:
        """Read what a sensor recorded in a frame.

        Raises:
            MissingDataError: a file does not exist.
            FormatError: a file is cut short, or has another type or shape, or invalid values.
        """
        path = {name: _array_path(self.raw, name, sensor, frame) for name in _FOLDERS}
        arrays = {name: read_npy(path[name], _FORMATS[name]) for name in _FOLDERS if name != "pose"}
        check_finite(arrays["points"], str(path["points"]))
        check_finite(arrays["velocities"], str(path["velocities"]))
        self.classes.check(arrays["labels"], str(path["labels"]))
        for name in ("labels", "instances"):
            if len(arrays[name]) != len(arrays["points"]):
                points = f"{path['points'].parent.name}/{path['points'].name}"
                raise FormatError(
                    path[name],
                    expected=f"{len(arrays['points'])} values, one per point of {points}",
                    found=str(len(arrays[name])),
                )
        velocities = arrays.pop("velocities")
        scan = Scan(arrays["points"], labels=arrays["labels"], instances=arrays["instances"])
        return Recording(scan, self.read_pose(sensor, frame), velocities)

    def read_pose(self, sensor: int, frame: int) -> Transform:
        """Return the (4, 4) float64 world_T_sensor of a frame.

        Raises:
            MissingDataError: the file does not exist.
            FormatError: it holds no rigid transform.
        """
        path = _array_path(self.raw, "pose", sensor, frame)
        return check_rigid(read_npy(path, _FORMATS["pose"]), str(path))

    def read_time(self, frame: int, sensor: int = 0) -> float:
        """Return the simulation's time at a frame, in seconds. Where a frame has several lines, the last one is valid.

        Raises:
            MissingDataError: the times file does not exist, or has no line for the frame.
            FormatError: a line of the file is not in CARLA's form.
        """
        times = self.read_times(sensor)
        if frame not in times:
            raise MissingDataError(
                _times_path(self.raw, sensor), expected=f"a line for frame {frame}", found="no such line"
            )
        return times[frame]

    def read_times(self, sensor: int = 0) -> Mapping[int, float]:
        """Return the simulation's time in seconds per frame number.

        Raises:
            MissingDataError: the times file does not exist.
            FormatError: a line of it is not in CARLA's form.
        """
        path = _times_path(self.raw, sensor)
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

    def read_bev(self, frame: int) -> bytes | None:
        """Return a frame's bird's-eye picture as JPEG bytes, or None where it has none."""
        path = _bev_path(self.raw, frame)
        return path.read_bytes() if path.is_file() else None

    def has_bev(self, frame: int) -> bool:
        """Whether a frame has a bird's-eye picture."""
        return _bev_path(self.raw, frame).is_file()

    def __repr__(self) -> str:
        return f"<Capture {self.location}>"


class CaptureWriter:
    """Writes a capture. Every file is written atomically. A writer can be pickled.

    Attributes:
        raw: the folder raw/.
        location: the same as text, for messages.
    """

    def __init__(self, out: str | os.PathLike[str]) -> None:
        """Take the folder of a sequence. Files go to `<out>/raw`."""
        self.raw = Path(out) / RAW
        self.location = str(self.raw)

    def check_settings(self, file: str, settings: Mapping[str, Any], command: str) -> None:
        """Check that the folder is empty, or holds a capture that was made with the same settings.

        Args:
            file: the file in raw/ that holds the settings.
            settings: those of this run, as JSON has them.
            command: the command that makes such captures, for the error.

        Raises:
            ConflictError: the folder holds another capture. The error names the settings that differ.
        """
        path = self.raw / file
        if not path.is_file():
            if self.raw.is_dir() and any(self.raw.iterdir()):
                raise ConflictError(
                    self.raw,
                    expected=f"nothing, or a capture of `{command}`",
                    found=f"a capture without {file}",
                    advice="choose another folder",
                )
            return
        earlier = parse_json(path.read_bytes(), str(path))
        differing = [key for key in sorted(settings.keys() | earlier.keys()) if settings.get(key) != earlier.get(key)]
        if differing:
            expected, found = (
                ", ".join(f"{key} {side.get(key)!r}" for key in differing) for side in (settings, earlier)
            )
            raise ConflictError(
                path,
                expected=expected,
                found=found,
                advice="choose another folder, or use the settings of the existing capture",
            )

    def write_settings(self, file: str, settings: Mapping[str, Any]) -> None:
        """Write the settings of a capture as JSON."""
        write_json(self.raw / file, dict(settings))

    def has(self, sensor: int, frame: int) -> bool:
        """Whether all of a sensor's files of a frame exist. An existing file is complete, because files are renamed into place."""
        return all(_array_path(self.raw, name, sensor, frame).is_file() for name in _FOLDERS)

    def has_frame(self, frame: int, sensors: int, bev: bool) -> bool:
        """Whether all files of a frame exist: those of `sensors` sensors, and the bird's-eye picture where `bev` is true."""
        complete = all(self.has(sensor, frame) for sensor in range(sensors))
        return complete and (not bev or _bev_path(self.raw, frame).is_file())

    def timed_frames(self, sensors: int) -> frozenset[int]:
        """Return the frames whose times are written for all sensors: those of the last sensor, which is written last.

        Raises:
            FormatError: a line of the times file is not in CARLA's form.
        """
        last = sensors - 1
        return frozenset(Capture(self.raw).read_times(last)) if _times_path(self.raw, last).is_file() else frozenset()

    def write(self, sensor: int, frame: int, recording: Recording) -> None:
        """Write what a sensor recorded in a frame. Existing files are replaced.

        Raises:
            FormatError: the scan has no labels or instances, or the pose is not rigid.
            StorageError: the disk is full, or the folder cannot be written to.
        """
        scan, where = recording.scan, f"{self.raw}: sensor {sensor}, frame {frame}"
        if scan.labels is None or scan.instances is None:
            raise FormatError(where, expected="labels and instances", found="none")
        arrays: dict[str, NDArray[Any]] = {
            "points": scan.points,
            "labels": scan.labels,
            "instances": scan.instances,
            # An empty list of actors has no columns in the authors' files.
            "velocities": recording.velocities if len(recording.velocities) else np.empty(0, np.float64),
            "pose": check_rigid(recording.world_T_sensor, where),
        }
        for name, array in arrays.items():
            buffer = io.BytesIO()
            np.save(buffer, np.ascontiguousarray(array, _FORMATS[name].dtype), allow_pickle=False)
            write_atomic(_array_path(self.raw, name, sensor, frame), buffer.getbuffer())

    def write_time(self, sensor: int, frame: int, elapsed_s: float) -> None:
        """Append a line for a frame to a sensor's times file: the simulation's time in seconds, in CARLA's form."""
        elapsed = float(elapsed_s)
        append_line(
            _times_path(self.raw, sensor),
            f"{frame}, Timestamp(frame={frame},elapsed_seconds={elapsed},delta_seconds={FRAME_PERIOD_S},"
            f"platform_timestamp={elapsed})",
        )

    def write_bev(self, frame: int, jpeg: bytes) -> None:
        """Write a frame's bird's-eye picture, given as JPEG bytes."""
        write_atomic(_bev_path(self.raw, frame), jpeg)

    def __repr__(self) -> str:
        return f"<CaptureWriter {self.location}>"


def find_captures(source: str | os.PathLike[str]) -> dict[str, Capture]:
    """Find the captures in a folder.

    Args:
        source: the folder of a sequence, which holds raw/; or raw/ itself; or a folder of such sequences, up to three levels above them.

    Returns:
        Captures by the path of their sequence relative to `source`, in sorted order. The path is "" where `source` is the sequence.

    Raises:
        MissingDataError: the folder does not exist, or holds no capture.
    """
    folder = Path(source)
    capture = Capture(folder)
    if capture.raw != folder or folder.name == RAW or (folder / "velodyne0").is_dir():
        return {"": capture}
    paths = sorted(
        str(raw.parent.relative_to(folder))
        for depth in range(1, _SEARCH_DEPTH + 1)
        for raw in folder.glob("/".join(["[!.]*"] * depth) + f"/{RAW}")
        if raw.is_dir()
    )
    if not paths:
        raise MissingDataError(
            folder,
            expected="a capture (a folder raw/ with velodyne0/, labels0/, ...)",
            found=f"none down to {_SEARCH_DEPTH} levels",
            advice="give a sequence's folder that holds raw/, or a folder of such sequences",
        )
    return {path: Capture(folder / path) for path in paths}


def _array_path(raw: Path, name: str, sensor: int, frame: int) -> Path:
    return raw / f"{_FOLDERS[name]}{sensor}" / f"{frame}.npy"


def _times_path(raw: Path, sensor: int) -> Path:
    return raw / f"times{sensor}.txt"


def _bev_path(raw: Path, frame: int) -> Path:
    return raw / _BEV / f"{frame}.jpg"
