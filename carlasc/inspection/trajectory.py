"""Checks of poses and times: is every pose rigid, does the sensor move as a thing with mass does, do the times rise?"""

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
_SPEED_CHANGE_M_S = 15.0  # from one step to the next ones; a collision in CARLA takes off as much
_TURN_RAD_S = np.deg2rad(250.0)
_TOLERANCE = 1e-3


def check_poses(sequence: Sequence) -> Iterator[Finding]:
    """Check that poses.txt is there, has a line for each frame, and holds rigid transforms that change smoothly."""
    where, frames = f"{sequence.location}/{layout.POSES}", sequence.scan_frames()
    if layout.POSES not in sequence.documents():
        if "points" in sequence.fields():
            advice = "scans cannot be put on each other without poses: copy the file, or estimate it with KISS-ICP"
            yield Finding("error", "poses", sequence.path, where, "a pose for each scan", "no file", advice)
        return
    try:
        poses = sequence.poses
    except CarlascError as error:
        yield Finding.from_error("poses", sequence.path, where, error)
        return
    yield from _check_lines(sequence, layout.POSES, len(poses))
    bad = [line for line, pose in enumerate(poses) if not _is_rigid(pose)]
    if bad:
        yield Finding.from_error("poses", sequence.path, where, _why_not_rigid(poses[bad[0]], where, bad))
    elif len(frames) and _has_lines(sequence, len(poses)):
        yield from _check_steps(sequence, frames, where)


def check_times(sequence: Sequence) -> Iterator[Finding]:
    """Check that times.txt is there, has a line for each frame, and that the times rise."""
    where = f"{sequence.location}/{layout.TIMES}"
    if layout.TIMES not in sequence.documents():
        if "points" in sequence.fields():
            advice = "readers that need times take 10 Hz"
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
        yield Finding("error", "times", sequence.path, where, "seconds that rise from line to line", found)


def _check_lines(sequence: Sequence, document: str, lines: int) -> Iterator[Finding]:
    """Check that each frame has its line, and that there are no lines beyond the last."""
    frames, where = sequence.scan_frames(), f"{sequence.location}/{document}"
    if not len(frames):
        return
    last, kind = int(frames[-1]), "poses" if document == layout.POSES else "times"
    if not _has_lines(sequence, lines):
        needed = f"{last + 1} lines, up to frame {last}"
        if last + 1 != len(frames):
            needed += f" (or {len(frames)}, one a frame that is there)"
        missing = f"{lines} lines: the file is shorter than the scans"
        yield Finding("error", kind, sequence.path, where, needed, missing, "copy the file whole")
    elif lines > last + 1:
        found = f"{lines} lines: scans are missing at the end, or the file is of another sequence"
        yield Finding("warning", kind, sequence.path, where, f"{last + 1} lines, up to frame {last}", found)


def _has_lines(sequence: Sequence, lines: int) -> bool:
    """Whether each frame has a line in a file of so many; the rule is the reader's own."""
    try:
        for frame in sequence.scan_frames().tolist():
            sequence.line_of(frame, lines, layout.POSES)
    except FormatError:
        return False
    return True


def _is_rigid(pose: NDArray[np.float64]) -> bool:
    try:
        check_rigid(pose, "", _TOLERANCE)
    except FormatError:
        return False
    return True


def _why_not_rigid(pose: NDArray[np.float64], where: str, bad: list[int]) -> FormatError:
    """The reason why the first bad pose is not rigid, and how many more there are."""
    try:
        check_rigid(pose, f"{where}: line {bad[0] + 1}", _TOLERANCE)
    except FormatError as error:
        return FormatError(f"{error}{f' (and {len(bad) - 1} more lines)' if len(bad) > 1 else ''}")
    raise ValueError("the pose is rigid")


def _check_steps(sequence: Sequence, frames: NDArray[np.int64], where: str) -> Iterator[Finding]:
    """Check the first pose, and that no step is longer or sharper than a vehicle can make it."""
    poses = np.stack([sequence.read_pose(frame) for frame in frames.tolist()])
    if frames[0] == 0 and np.abs(poses[0] - np.eye(4)).max() > 1e-3:
        found = "another: the poses are relative to something else, which history and merging do not mind"
        yield Finding("note", "poses", sequence.path, where, "the identity as the first frame's pose", found)
    if len(frames) < 2:
        return
    steps = invert(poses[:-1]) @ poses[1:]
    period_s = np.diff(frames) * layout.FRAME_PERIOD_S
    speed = np.linalg.norm(steps[:, :3, 3], axis=1) / period_s
    cosine = (np.trace(steps[:, :3, :3], axis1=1, axis2=2) - 1) / 2
    turn = np.arccos(np.clip(cosine, -1, 1)) / period_s
    usual = np.array([np.median(speed[max(0, i - 3) : i + 4]) for i in range(len(speed))])
    jumps = np.flatnonzero((speed > _SPEED_M_S) | (np.abs(speed - usual) > _SPEED_CHANGE_M_S) | (turn > _TURN_RAD_S))
    if len(jumps):
        step = int(jumps[np.argmax(np.abs(speed - usual)[jumps] + turn[jumps])])
        moved, turned = float(np.linalg.norm(steps[step, :3, 3])), float(np.rad2deg(turn[step] * period_s[step]))
        usually = float(usual[step] * period_s[step])
        found = f"{moved:.2f} m and {turned:.1f} degrees from frame {frames[step]} to {frames[step + 1]}, where {usually:.2f} m is usual"
        found += f" ({len(jumps)} such steps)" if len(jumps) > 1 else ""
        advice = "look whether frames are missing or sequences were joined there"
        yield Finding("error", "pose-jump", sequence.path, where, "a drive without jumps", found, advice)
