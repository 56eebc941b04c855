"""A preview of a conversion, from one scan of each recording. Nothing is written."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from carlasc.converting.assembling import Assembled, Rig, read_scan
from carlasc.converting.plans import (
    FILE,
    KISS_ICP,
    SplitName,
    choose_recordings,
    frame_times,
    read_trajectory,
)
from carlasc.converting.protocol import Converter, Recording
from carlasc.converting.registry import find_recordings, open_converter
from carlasc.core.arrays import Float32Array
from carlasc.errors import CarlascError
from carlasc.motion.ground import find_ground
from carlasc.motion.options import PoseOptions
from carlasc.storage.files import AnyPath

_LEAST_M = 0.3  # ground must be at least this far below the sensor
_UP = {
    "+z": (0, 1, 2),
    "-z": (0, 1, 2),
    "+y": (2, 0, 1),
    "-y": (2, 0, 1),
    "+x": (1, 2, 0),
    "-x": (1, 2, 0),
}


@dataclass(frozen=True)
class RecordingPreview:
    """A recording that a conversion would read.

    Attributes:
        name: name of the sequence in the output.
        split: the split that it belongs to.
        location: where it is.
        frames: number of frames.
        rate_hz: frames per second; None if it has no times.
        sensors: names of its LiDARs.
        fields: fields of its first scan, by their names in the layout.
        points: number of points of the first scan.
        lower: least x, y, z of these points, metres, right-handed, in the frame of the scan.
        upper: greatest x, y, z.
        up: the direction away from the ground, "+z" for correct axes; None if no ground was found.
        height_m: height of the first sensor above the ground, estimated from the first scan; None
            if no ground was found.
        poses: "file", or "kiss-icp" if they would be estimated from the scans.
        notes: notes for the user, one line each.
    """

    name: str
    split: str
    location: str
    frames: int
    rate_hz: float | None
    sensors: tuple[str, ...]
    fields: tuple[str, ...]
    points: int
    lower: tuple[float, float, float]
    upper: tuple[float, float, float]
    up: str | None
    height_m: float | None
    poses: str
    notes: tuple[str, ...]


def preview(
    name: str | type[Converter],
    source: AnyPath,
    *,
    sequences: Collection[str] | None = None,
    split: SplitName = "all",
    poses: PoseOptions = PoseOptions(),  # noqa: B008 (frozen)
    options: Mapping[str, Any] | None = None,
) -> tuple[RecordingPreview, ...]:
    """Return what `convert` with the same arguments would read.

    Args:
        name: the converter: its name, or a class that inherits `Converter`.
        source: folder of the data set, or of one of its sequences.
        sequences: names of sequences or the last parts of them; None for all.
        split: only sequences of this split.
        poses: where poses would come from.
        options: options of the converter, by name.

    Raises:
        ArgumentError: an argument has a wrong value, or no converter has that name.
        MissingDataError: the source, a sequence or the poses do not exist.
        FormatError: a file does not have the format.
    """
    converter = open_converter(name, Path(source), options)
    recordings = choose_recordings(find_recordings(converter), Path(source), sequences, split)
    return tuple(_preview(recording, poses) for recording in recordings)


def _preview(recording: Recording, poses: PoseOptions) -> RecordingPreview:
    times = recording.times()
    trajectory = read_trajectory(recording, frame_times(recording, times), poses)
    scan = _first_scan(recording)
    steps = (
        np.zeros(0)
        if times is None
        else np.diff(times[[handle.number for handle in recording.frames]])
    )
    given = {"labels": scan.labels, "instances": scan.instances}
    points = scan.points[:, :3]
    up, height_m = _ground(points)
    lower, upper = (
        tuple(round(float(value), 2) for value in edge(points, axis=0)) for edge in (np.min, np.max)
    )
    return RecordingPreview(
        recording.name,
        recording.split,
        recording.location,
        len(recording.frames),
        round(float(1 / np.median(steps)), 2) if len(steps) and np.median(steps) > 0 else None,
        tuple(sensor.name for sensor in recording.sensors),
        ("points", *(field for field, values in given.items() if values is not None), *scan.fields),
        len(points),
        lower,  # type: ignore[arg-type]
        upper,  # type: ignore[arg-type]
        up,
        height_m,
        KISS_ICP if trajectory is None else FILE,
        tuple(recording.notes()),
    )


def _first_scan(recording: Recording) -> Assembled:
    """Return the first scan that can be read; the error of the first one if there is none."""
    rig, problem = Rig(tuple(recording.sensors), recording.vehicle_T_scan), None
    for handle in recording.frames:
        try:
            return read_scan(handle, rig, None)
        except CarlascError as error:
            problem = problem or error
    assert problem is not None
    raise problem


def _ground(points: Float32Array) -> tuple[str | None, float | None]:
    """Return the direction away from the ground, and the height of the sensor above it, of (N, 3)
    points.
    """
    for up, order in _UP.items():
        turned = points[:, order] * np.array([1, 1, -1 if up.startswith("-") else 1], np.float32)
        ground = find_ground([turned])
        if ground is not None and ground.below_m > _LEAST_M:
            return up, round(ground.below_m, 2)
    return None, None
