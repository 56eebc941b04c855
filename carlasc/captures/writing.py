"""Writing a raw capture (see the format page, `docs/format.md#raw-capture`)."""

from __future__ import annotations

import io
from collections.abc import Mapping, Sequence
from typing import Any, Self

import numpy as np

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
from carlasc.core.arrays import AnyArray, Uint8Array
from carlasc.core.geometry import check_rigid
from carlasc.errors import ConflictError, FormatError
from carlasc.storage.files import AnyPath, has_content, parse_json, remove_stale, to_json
from carlasc.storage.layout import FRAME_PERIOD_S
from carlasc.storage.transport.remote_tree import target_of
from carlasc.storage.transport.trees import LocalTarget, Target


class CaptureWriter:
    """Writes a capture to a folder or an object store.

    Every file is written whole. A writer can be pickled.

    Attributes:
        out: name of the folder of the sequence.
        target: the folder raw/ in it.
        location: name of the folder raw/ in errors.
    """

    def __init__(self, out: AnyPath | Target, **storage_options: Any) -> None:
        """Keep the folder of a sequence. Files are written to `<out>/raw`.

        Args:
            out: a folder, its URL, or a Target.
            **storage_options: options of fsspec for the URL.
        """
        folder = target_of(out, **storage_options)
        self.out = folder.location
        self.target = folder.below(RAW)
        self.location = self.target.location

    def check_settings(self, file: str, settings: Mapping[str, Any], command: str) -> None:
        """Check that the folder is empty, or has a capture with the same settings.

        Args:
            file: the file in raw/ with the settings.
            settings: settings of this run, as JSON values.
            command: the command that makes such captures, for errors.

        Raises:
            ConflictError: the folder has another capture; the message names the different settings.
        """
        where = self.target.tree.where(file)
        if not self.target.tree.is_file(file):
            # files with this prefix were left by a killed run
            if any(not name.startswith(".") for name in self.target.tree.entries()):
                raise ConflictError(
                    self.location,
                    expected=f"an empty folder, or a capture of `{command}`",
                    found=f"a capture without {file}",
                    advice="choose another folder",
                )
            return
        earlier = parse_json(bytes(self.target.tree.read(file)), where)
        settings = parse_json(to_json(settings), where)  # tuples are lists in files
        differing = [
            key
            for key in sorted(settings.keys() | earlier.keys())
            if settings.get(key) != earlier.get(key)
        ]
        if differing:
            expected, found = (
                ", ".join(f"{key} {side.get(key)!r}" for key in differing)
                for side in (settings, earlier)
            )
            raise ConflictError(
                where,
                expected=expected,
                found=found,
                advice="choose another folder, or use the settings of the existing capture",
            )

    def write_settings(self, file: str, settings: Mapping[str, Any]) -> None:
        """Write the settings of a capture as JSON. Temporary files of a killed run are removed."""
        if isinstance(self.target, LocalTarget):
            remove_stale(self.target.folder)
        self.target.put(file, to_json(dict(settings)))

    def has(self, sensor: int, frame: int) -> bool:
        """Whether all files of a sensor and a frame exist.

        An existing file is complete, unless a power failure left it empty.
        """
        return all(self._has(array_path(name, sensor, frame)) for name in FOLDERS)

    def has_frame(self, frame: int, sensors: int, bev: bool, images: Sequence[str] = ()) -> bool:
        """Whether all files of a frame exist.

        Args:
            frame: frame number.
            sensors: number of sensors.
            bev: whether the bird's-eye picture is required too.
            images: fields of the required images.
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
            FormatError: a line of a times file does not have the format of CARLA.
        """
        return frozenset.intersection(
            *(frozenset(self._times_of(sensor)) for sensor in range(sensors))
        )

    def write(self, sensor: int, frame: int, recording: SensorRecording) -> None:
        """Write the recording of a sensor in a frame. Existing files are replaced.

        Args:
            sensor: number of the sensor; 0 is the ego sensor.
            frame: number of the frame.
            recording: its scan, with labels and instances, and its pose.

        Raises:
            FormatError: the scan has no labels or instances, or the pose is not rigid.
            StorageError: the disk is full, or the folder cannot be written to.
        """
        scan = recording.scan
        where = f"{self.location}: sensor {sensor}, frame {frame}"
        if scan.labels is None or scan.instances is None:
            raise FormatError(
                where,
                expected="a scan with labels and instances",
                found="a scan without one of them",
            )
        arrays: dict[str, AnyArray] = {
            "points": scan.points,
            "labels": scan.labels,
            "instances": scan.instances,
            # In the published files, an empty list of actors has no columns.
            "velocities": recording.velocities
            if len(recording.velocities)
            else np.empty(0, np.float64),
            "pose": check_rigid(recording.world_T_sensor, where),
        }
        files: dict[str, bytes | memoryview] = {}
        for name, array in arrays.items():
            buffer = io.BytesIO()
            np.save(
                buffer, np.ascontiguousarray(array, FORMATS[name].dtypes[0]), allow_pickle=False
            )
            files[array_path(name, sensor, frame)] = buffer.getbuffer()
        self.target.put_many(files)

    def write_times(self, times_s: Mapping[int, Sequence[float]]) -> None:
        """Write the simulation times of frames.

        The times file of each sensor is written whole, in the order of frames.

        Existing lines of other frames are kept. To write times frame by frame, see `TimesLog`.

        Args:
            times_s: time of each sensor, seconds, by frame number.

        Raises:
            FormatError: a line of an existing file does not have the format of CARLA.
            StorageError: the disk is full, or the folder cannot be written to.
        """
        files: dict[str, bytes | memoryview] = {}
        for sensor in range(max(map(len, times_s.values()), default=0)):
            lines = self._times_of(sensor)
            for frame, times in times_s.items():
                elapsed_s = float(times[sensor])
                lines[frame] = (
                    f"{frame}, "
                    f"Timestamp(frame={frame},elapsed_seconds={elapsed_s},"
                    f"delta_seconds={FRAME_PERIOD_S},platform_timestamp={elapsed_s})"
                )
            files[times_path(sensor)] = "".join(
                f"{lines[frame]}\n" for frame in sorted(lines)
            ).encode()
        self.target.put_many(files)

    def _times_of(self, sensor: int) -> dict[int, str]:
        """Return the lines of the times file of a sensor by frame; empty if the file does not
        exist.
        """
        path = times_path(sensor)
        if (data := self.target.read(path)) is None:
            return {}
        return {
            frame: line
            for frame, (_, line) in parse_times(data, self.target.tree.where(path)).items()
        }

    def write_bev(self, frame: int, jpeg: bytes) -> None:
        """Write the bird's-eye picture of a frame, given as JPEG bytes."""
        self.target.put(bev_path(frame), jpeg)

    def write_images(self, frame: int, images: Mapping[str, Uint8Array]) -> None:
        """Write the images of a frame, given as the bytes of their files by field."""
        self.target.put_many(
            {image_path(field, frame): data.data for field, data in images.items()}
        )

    def __repr__(self) -> str:
        return f"<CaptureWriter {self.location}>"


class TimesLog:
    """Collects the times of frames, and writes the times files regularly and at the end, also after
    an error or Ctrl-C.

    Times are not appended line by line, because object stores cannot append, and because the order
    of lines would differ between runs.
    """

    def __init__(self, writer: CaptureWriter, every: int = 50) -> None:
        """Write the times files of a capture after `every` frames.

        Only one process may do this at a time.
        """
        self.writer = writer
        self.every = every
        self._waiting: dict[int, Sequence[float]] = {}

    def add(self, frame: int, times_s: Sequence[float]) -> None:
        """Add the time of a frame for each sensor, in seconds."""
        self._waiting[frame] = times_s
        if len(self._waiting) >= self.every:
            self.flush()

    def flush(self) -> None:
        """Write the collected times."""
        if self._waiting:
            self.writer.write_times(self._waiting)
            self._waiting = {}

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.flush()
