"""Checks of poses and times: poses are rigid and change as those of a vehicle, times increase."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from carlasc.core.geometry import check_rigid, invert
from carlasc.errors import CarlascError, FormatError
from carlasc.inspection.findings import Finding
from carlasc.storage import layout
from carlasc.storage.protocol import Sequence

_SPEED_M_S = 70.0  # 250 km/h
_SPEED_CHANGE_M_S = 15.0  # between neighbouring steps; a collision in CARLA changes the speed as much
_TURN_RAD_S = np.deg2rad(250.0)
_TOLERANCE = 1e-3


def check_poses(sequence: Sequence) -> Iterator[Finding]:
    """Check that poses.txt exists, has a line for each frame, and holds rigid transforms that change smoothly."""
    where, frames = f"{sequence.location}/{layout.POSES}", sequence.scan_frames()
    if layout.POSES not in sequence.documents():
        if "points" in sequence.fields():
            advice = "scans cannot be merged without poses: copy the file, or estimate poses with KISS-ICP"
            yield Finding("error", "poses", sequence.path, where, "a pose for each scan", "no file", advice)
        return
    try:
        poses = sequence.poses
    except CarlascError as error:
        yield Finding.from_error("poses", sequence.path, where, error)
        return
    yield from _check_lines(sequence, layout.POSES, len(poses))
    errors = [_rigid_error(pose, f"{where}: line {line}") for line, pose in enumerate(poses, 1)]
    if wrong := [error for error in errors if error is not None]:
        if len(wrong) > 1:
            wrong[0].found += f" (and {len(wrong) - 1} more such lines)"
        yield Finding.from_error("poses", sequence.path, where, wrong[0])
    elif len(frames) and _has_lines(sequence, len(poses)):
        yield from _check_steps(sequence, frames, where)


def check_times(sequence: Sequence) -> Iterator[Finding]:
    """Check that times.txt exists, has a line for each frame, and that times increase."""
    where = f"{sequence.location}/{layout.TIMES}"
    if layout.TIMES not in sequence.documents():
        if "points" in sequence.fields():
            advice = "10 Hz is assumed where times are needed"
            yield Finding("warning", "times", sequence.path, where, "a time for each scan", "no file", advice)
        return
    try:
        times = sequence.times
    except CarlascError as error:
        yield Finding.from_error("times", sequence.path, where, error)
        return
    yield from _check_lines(sequence, layout.TIMES, len(times))
    wrong = np.flatnonzero(~(np.diff(times) > 0))
    if len(wrong):
        line = int(wrong[0]) + 1
        found = f"{times[line]:g} s in line {line + 1} after {times[line - 1]:g} s ({len(wrong)} such lines)"
        yield Finding("error", "times", sequence.path, where, "seconds that increase from line to line", found)


def _check_lines(sequence: Sequence, document: str, lines: int) -> Iterator[Finding]:
    """Check that each frame has a line, and that there are no lines after that of the last frame."""
    frames, where = sequence.scan_frames(), f"{sequence.location}/{document}"
    if not len(frames):
        return
    last, kind = int(frames[-1]), "poses" if document == layout.POSES else "times"
    if not _has_lines(sequence, lines):
        expected = f"{last + 1} lines, up to frame {last}"
        if last + 1 != len(frames):
            expected += f" (or {len(frames)}, one per frame that exists)"
        advice = "lines are missing: copy the file again"
        yield Finding("error", kind, sequence.path, where, expected, f"{lines} lines", advice)
    elif lines > last + 1:
        advice = "scans are missing at the end, or the file belongs to another sequence"
        yield Finding(
            "warning", kind, sequence.path, where, f"{last + 1} lines, up to frame {last}", f"{lines} lines", advice
        )


def _has_lines(sequence: Sequence, lines: int) -> bool:
    """Return whether each frame has a line in a file of `lines` lines, by the rule of the reader."""
    try:
        for frame in sequence.scan_frames().tolist():
            sequence.line_of(frame, lines, layout.POSES)
    except FormatError:
        return False
    return True


def _rigid_error(pose: NDArray[np.float64], where: str) -> FormatError | None:
    """Return the error that says why a pose is not rigid; None if it is."""
    try:
        check_rigid(pose, where, _TOLERANCE)
    except FormatError as error:
        return error
    return None


def _periods(sequence: Sequence, frames: NDArray[np.int64]) -> NDArray[np.float64]:
    """Return the seconds between frames, by their times if these increase."""
    try:
        times = np.array([sequence.read_time(frame) for frame in frames.tolist()])
    except CarlascError:
        times = np.zeros(1)
    periods = np.diff(times)
    return (
        periods if len(periods) == len(frames) - 1 and (periods > 0).all() else np.diff(frames) * layout.FRAME_PERIOD_S
    )


def _check_steps(sequence: Sequence, frames: NDArray[np.int64], where: str) -> Iterator[Finding]:
    """Check the first pose, and that the sensor moves and turns between frames as a vehicle can."""
    poses = np.stack([sequence.read_pose(frame) for frame in frames.tolist()])
    if frames[0] == 0 and np.abs(poses[0] - np.eye(4)).max() > 1e-3:
        advice = "the poses are relative to another frame, which is allowed: only relative poses are used"
        yield Finding("note", "poses", sequence.path, where, "the identity as the first pose", "another pose", advice)
    if len(frames) < 2 or not sequence.metadata.has_rays:  # frames of a cloud without a sensor are places, not instants
        return
    steps = invert(poses[:-1]) @ poses[1:]
    period_s = _periods(sequence, frames)
    speed = np.linalg.norm(steps[:, :3, 3], axis=1) / period_s
    cosine = (np.trace(steps[:, :3, :3], axis1=1, axis2=2) - 1) / 2
    turn = np.arccos(np.clip(cosine, -1, 1)) / period_s
    usual = np.array([np.median(speed[max(0, i - 3) : i + 4]) for i in range(len(speed))])
    jumps = np.flatnonzero((speed > _SPEED_M_S) | (np.abs(speed - usual) > _SPEED_CHANGE_M_S) | (turn > _TURN_RAD_S))
    if len(jumps):
        step = int(jumps[np.argmax(np.abs(speed - usual)[jumps] + turn[jumps])])
        moved, turned = float(np.linalg.norm(steps[step, :3, 3])), float(np.rad2deg(turn[step] * period_s[step]))
        usually = float(usual[step] * period_s[step])
        found = f"{moved:.2f} m and {turned:.1f} degrees from frame {frames[step]} to {frames[step + 1]}, {usually:.2f} m between other frames"
        found += f" ({len(jumps)} such steps)" if len(jumps) > 1 else ""
        advice = "check whether frames are missing there, or sequences were joined"
        yield Finding("error", "pose-jump", sequence.path, where, "poses without jumps", found, advice)
