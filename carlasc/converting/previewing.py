"""A preview of a conversion, from one scan of each recording. Nothing is written."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from carlasc.converting.assembling import Assembled, LayoutOptions, Rig, read_scan
from carlasc.converting.given_boxes import GivenBoxes
from carlasc.converting.plans import (
    FILE,
    KISS_ICP,
    Examined,
    SplitName,
    choose_recordings,
    examine,
    placed_boxes,
)
from carlasc.converting.plausibility import find_mount
from carlasc.converting.protocol import Converter, Recording
from carlasc.converting.registry import find_recordings, open_converter
from carlasc.core.frames import FrameRange, Frames
from carlasc.errors import CarlascError, only
from carlasc.inspection.findings import Finding
from carlasc.motion.box_table import ONE_FRAME
from carlasc.motion.options import PoseOptions
from carlasc.storage.files import AnyPath


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
        findings: what is probably wrong ("warning"), and what would stop a conversion ("error").
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
    findings: tuple[Finding, ...]


def preview(
    name: str | type[Converter],
    source: AnyPath,
    *,
    sequences: Collection[str] | None = None,
    frames: Frames = None,
    split: SplitName = "all",
    layout: LayoutOptions = LayoutOptions(),  # noqa: B008 (frozen)
    poses: PoseOptions = PoseOptions(),  # noqa: B008 (frozen)
    options: Mapping[str, Any] | None = None,
) -> tuple[RecordingPreview, ...]:
    """Return what `convert` with the same arguments would read, and what it would find.

    Args:
        name: the converter: its name, or a class that inherits `Converter`.
        source: folder of the data set, or of one of its sequences.
        sequences: names of sequences or the last parts of them; None for all.
        frames: numbers of the frames that would be converted; None for all.
        split: only sequences of this split.
        layout: whether scans would be turned upright, and the boxes that would be taken.
        poses: where poses would come from.
        options: options of the converter, by name.

    Raises:
        ArgumentError: an argument has a wrong value, or no converter has that name.
        MissingDataError: the source, a sequence or the poses do not exist.
        FormatError: a file does not have the format, or boxes are those of another drive.
    """
    converter = open_converter(name, Path(source), options)
    recordings = choose_recordings(find_recordings(converter), Path(source), sequences, split)
    chosen = FrameRange.of(frames)
    given = None
    previews = []
    if layout.boxes is not None:
        only("boxes", {one.name: one for one in recordings}, ONE_FRAME)
        given = GivenBoxes.read(layout.boxes, layout.of(converter).classes)
    for recording in recordings:
        seen = examine(
            recording, converter, poses, frames=chosen, level=layout.level, known=poses.force
        )
        if given is not None and not any(one.severity == "error" for one in seen.findings):
            placed_boxes(given, seen, force=poses.force)
        previews.append(_preview(seen))
    return tuple(previews)


def _preview(seen: Examined) -> RecordingPreview:
    recording = seen.recording
    scan = _first_scan(seen.recording)
    mount = seen.mount or find_mount([scan.points])
    steps = np.diff(seen.times[recording.frame_numbers])
    timed = seen.has_times and len(steps) and np.median(steps) > 0
    given = {"labels": scan.labels, "instances": scan.instances}
    points = scan.points[:, :3]
    lower, upper = (
        tuple(round(float(value), 2) for value in edge(points, axis=0)) for edge in (np.min, np.max)
    )
    return RecordingPreview(
        recording.name,
        recording.split,
        recording.location,
        len(recording.frames),
        round(float(1 / np.median(steps)), 2) if timed else None,
        tuple(sensor.name for sensor in recording.sensors),
        ("points", *(field for field, values in given.items() if values is not None), *scan.fields),
        len(points),
        lower,  # type: ignore[arg-type]
        upper,  # type: ignore[arg-type]
        None if mount is None else mount.up,
        None if mount is None else round(mount.height_m, 2),
        KISS_ICP if seen.trajectory is None else FILE,
        (*recording.notes(), *seen.notes),
        tuple(seen.findings),
    )


def _first_scan(recording: Recording) -> Assembled:
    """Return the first scan that can be read; the error of the first one if there is none."""
    rig = Rig.of(recording)
    problem = None
    for handle in recording.frames:
        try:
            return read_scan(handle, rig, None)
        except CarlascError as error:
            problem = problem or error
    assert problem is not None
    raise problem
