"""Writing a raw capture (see the format page, `docs/format.md#raw-capture`)."""

from __future__ import annotations

import io
import os
from collections.abc import Mapping, Sequence
from types import TracebackType
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from carlasc.captures.raw import (
    FOLDERS,
    FORMATS,
    RAW,
    SensorRecording,
    array_path,
    bev_path,
    image_path,
    parse_times,
    times_path,
)
from carlasc.core.geometry import check_rigid
from carlasc.errors import ConflictError, FormatError
from carlasc.storage.files import has_content, parse_json, remove_stale, to_json
from carlasc.storage.layout import FRAME_PERIOD_S
from carlasc.storage.transport.targets import LocalTarget, Target, target_of


class CaptureWriter:
    """Writes a capture, to a folder or to an object store. Every file is written whole. A writer can be pickled.

    Attributes:
        out: name of the folder of the sequence.
        target: the folder raw/ in it.
        location: name of the folder raw/ in errors.
    """

    def __init__(self, out: str | os.PathLike[str] | Target, **storage_options: Any) -> None:
        """Take the folder of a sequence. Files go to `<out>/raw`.

        Args:
            out: a folder, its URL, or a Target.
            **storage_options: options of fsspec for the URL.
        """
        folder = target_of(out, **storage_options)
        self.out, self.target = folder.location, folder.below(RAW)
        self.location = self.target.location

    def check_settings(self, file: str, settings: Mapping[str, Any], command: str) -> None:
        """Check that the folder is empty, or holds a capture that was made with the same settings.

        Args:
            file: the file in raw/ that holds the settings.
            settings: those of this run, as JSON has them.
            command: the command that makes such captures, for the error.

        Raises:
            ConflictError: the folder holds another capture. The error names the settings that differ.
        """
        where = self.target.tree.where(file)
        if not self.target.tree.is_file(file):
            if any(
                not name.startswith(".") for name in self.target.tree.entries()
            ):  # one that begins so is what a killed run left
                raise ConflictError(
                    self.location,
                    expected=f"nothing, or a capture of `{command}`",
                    found=f"a capture without {file}",
                    advice="choose another folder",
                )
            return
        earlier = parse_json(bytes(self.target.tree.read(file)), where)
        differing = [key for key in sorted(settings.keys() | earlier.keys()) if settings.get(key) != earlier.get(key)]
        if differing:
            expected, found = (
                ", ".join(f"{key} {side.get(key)!r}" for key in differing) for side in (settings, earlier)
            )
            raise ConflictError(
                where,
                expected=expected,
                found=found,
                advice="choose another folder, or use the settings of the existing capture",
            )

    def write_settings(self, file: str, settings: Mapping[str, Any]) -> None:
        """Write the settings of a capture as JSON; the unfinished files of a run that was killed are removed."""
        if isinstance(self.target, LocalTarget):
            remove_stale(self.target.folder)
        self.target.put(file, to_json(dict(settings)))

    def has(self, sensor: int, frame: int) -> bool:
        """Whether all of a sensor's files of a frame exist. An existing file is whole unless a power failure left it empty."""
        return all(self._has(array_path(name, sensor, frame)) for name in FOLDERS)

    def has_frame(self, frame: int, sensors: int, bev: bool, images: Sequence[str] = ()) -> bool:
        """Whether all files of a frame exist.

        Args:
            frame: number of the frame.
            sensors: number of sensors whose files are looked for.
            bev: whether the bird's-eye picture is looked for too.
            images: fields of images that are looked for.
        """
        complete = all(self.has(sensor, frame) for sensor in range(sensors))
        complete = complete and all(self._has(image_path(field, frame)) for field in images)
        return complete and (not bev or self._has(bev_path(frame)))

    def _has(self, path: str) -> bool:
        if isinstance(self.target, LocalTarget):
            return has_content(self.target.folder / path)
        return self.target.tree.is_file(path)

    def timed_frames(self, sensors: int) -> frozenset[int]:
        """Return the frames whose times are written for all sensors.

        Raises:
            FormatError: a line of a times file is not in CARLA's form.
        """
        return frozenset.intersection(*(frozenset(self._times_of(sensor)) for sensor in range(sensors)))

    def write(self, sensor: int, frame: int, recording: SensorRecording) -> None:
        """Write what a sensor recorded in a frame. Existing files are replaced.

        Args:
            sensor: number of the sensor; 0 is the ego sensor.
            frame: number of the frame.
            recording: its scan, with labels and instances, and its pose.

        Raises:
            FormatError: the scan has no labels or instances, or the pose is not rigid.
            StorageError: the disk is full, or the folder cannot be written to.
        """
        scan, where = recording.scan, f"{self.location}: sensor {sensor}, frame {frame}"
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
        files: dict[str, bytes | memoryview] = {}
        for name, array in arrays.items():
            buffer = io.BytesIO()
            np.save(buffer, np.ascontiguousarray(array, FORMATS[name].dtypes[0]), allow_pickle=False)
            files[array_path(name, sensor, frame)] = buffer.getbuffer()
        self.target.put_many(files)

    def write_times(self, times_s: Mapping[int, Sequence[float]]) -> None:
        """Write the simulation's times of frames: each sensor's times file is written whole, in the order of frames.

        Lines of other frames that the files have already are kept. See `TimesLog` for the times of one frame after the other.

        Args:
            times_s: for each frame number, the time of each sensor in seconds.

        Raises:
            FormatError: a line of an existing file is not in CARLA's form.
            StorageError: the disk is full, or the folder cannot be written to.
        """
        files: dict[str, bytes | memoryview] = {}
        for sensor in range(max(map(len, times_s.values()), default=0)):
            lines = self._times_of(sensor)
            for frame, times in times_s.items():
                elapsed_s = float(times[sensor])
                lines[frame] = (
                    f"{frame}, Timestamp(frame={frame},elapsed_seconds={elapsed_s},delta_seconds={FRAME_PERIOD_S},"
                    f"platform_timestamp={elapsed_s})"
                )
            files[times_path(sensor)] = "".join(f"{lines[frame]}\n" for frame in sorted(lines)).encode()
        self.target.put_many(files)

    def _times_of(self, sensor: int) -> dict[int, str]:
        """Return the lines of a sensor's times file by frame; none if the file does not exist."""
        path = times_path(sensor)
        if (data := self.target.read(path)) is None:
            return {}
        return {frame: line for frame, (_, line) in parse_times(data, self.target.tree.where(path)).items()}

    def write_bev(self, frame: int, jpeg: bytes) -> None:
        """Write a frame's bird's-eye picture, given as JPEG bytes."""
        self.target.put(bev_path(frame), jpeg)

    def write_images(self, frame: int, images: Mapping[str, NDArray[np.uint8]]) -> None:
        """Write the images of a frame, given as the bytes of their files by field."""
        self.target.put_many({image_path(field, frame): data.data for field, data in images.items()})

    def __repr__(self) -> str:
        return f"<CaptureWriter {self.location}>"


class TimesLog:
    """Collects the times of frames, and writes the times files now and then, and at its end, also after an error or Ctrl-C.

    Object stores cannot append to a file, and lines in the order in which frames were finished would differ between runs.
    """

    def __init__(self, writer: CaptureWriter, every: int = 50) -> None:
        """Write to a capture's times files after every so many frames; one process at a time does so."""
        self.writer, self.every = writer, every
        self._waiting: dict[int, Sequence[float]] = {}

    def add(self, frame: int, times_s: Sequence[float]) -> None:
        """Add the time of a frame for each sensor, in seconds."""
        self._waiting[frame] = times_s
        if len(self._waiting) >= self.every:
            self.flush()

    def flush(self) -> None:
        """Write what was added."""
        if self._waiting:
            self.writer.write_times(self._waiting)
            self._waiting = {}

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.flush()
