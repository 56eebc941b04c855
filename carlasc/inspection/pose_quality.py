"""Checks of poses: whether they move like a vehicle, how well neighbouring scans agree under them,
and whether they have a lever arm or a delay.

Some runs of scans are aligned with each other (`carlasc.motion.joint_alignment`) and compared with
the given poses. The runs are in the middle of the drive, and where the sensor turns and accelerates
most, because a lever arm and a delay have the largest effect there.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np

from carlasc.core.arrays import AnyFloatArray, FloatArray, IntArray
from carlasc.core.geometry import check_rigid, invert, multiply, slerp
from carlasc.errors import CarlascError, FormatError
from carlasc.inspection.findings import Finding
from carlasc.motion.joint_alignment import align
from carlasc.motion.mounting import Mounting, find_mounting
from carlasc.motion.refinement import ThinnedScan, disagreement, finite_mean
from carlasc.storage import layout
from carlasc.storage.protocol import Sequence

POOR_M = 0.03
"""If scans disagree by more than this, and agree better under other poses, the poses reduce the
quality of grids.
"""

_RUN = 30  # scans of a run
# frames by which poses are moved for another start, which must be better by this factor
_SHIFTS = (-2, 2)
_BETTER = 0.9
_AGREE_M = 0.03  # scans that agree within this distance are aligned


@dataclass(frozen=True)
class PoseQuality:
    """The quality of the poses of a drive, measured from some runs of scans.

    Attributes:
        disagreement_m: distance of scans from the surfaces that their neighbours saw, under the
            given poses; None if it is undetermined.
        refined_m: the same distance under refined poses.
        mounting: pose of the sensor in the frame of the poses, and the delay of the poses; None if
            they are undetermined.
    """

    disagreement_m: float | None
    refined_m: float | None
    mounting: Mounting | None

    @property
    def is_poor(self) -> bool:
        """Whether neighbouring scans would agree clearly better under other poses."""
        before = self.disagreement_m
        after = self.refined_m
        return before is not None and after is not None and before > max(POOR_M, 1.5 * after)


def measure_poses(
    points: Callable[[int], AnyFloatArray],
    poses: FloatArray,
    seconds: FloatArray | None = None,
) -> PoseQuality:
    """Measure how well scans agree under their poses, and whether a lever arm or a delay explains
    the disagreement.

    Args:
        points: returns (N, 3) points of the i-th scan on static things, metres, in the frame of the
            sensor.
        poses: (F, 4, 4) first_T_sensor of each scan, in order of time; rigid.
        seconds: (F,) their times, increasing; None for frames at 10 Hz.
    """
    times = np.asarray(
        layout.FRAME_PERIOD_S * np.arange(len(poses)) if seconds is None else seconds, np.float64
    )
    before = list[float]()
    after = list[float]()
    runs = list[tuple[int, FloatArray]]()
    numbers = np.arange(len(poses), dtype=np.float64)
    for first in _choose_runs(poses, times):
        rows = slice(first, first + _RUN)
        scans = list[ThinnedScan]()
        for row in range(len(poses))[rows]:  # in Python 3.11, a comprehension is a level of calls
            thinned = ThinnedScan.of(points(row).astype(np.float32), poses[row])
            scans.append(thinned)
        used = [scan.used for scan in scans]
        measured = [scan.measured for scan in scans]
        was = finite_mean(disagreement(measured, poses[rows]))
        aligned = align(used, poses[rows], poses[rows])
        now = finite_mean(disagreement(measured, aligned))
        for shift in _SHIFTS:  # of poses that are late, an alignment may not find to the right ones
            start = slerp(poses, numbers, numbers[rows] + shift)
            start = multiply(poses[first], invert(start[0]), start)
            other = align(used, start, start)
            other_now = finite_mean(disagreement(measured, other))
            if other_now < _BETTER * now:
                aligned = other
                now = other_now
        before.append(was)
        after.append(now)
        if now <= _AGREE_M:
            runs.append((first, aligned))
    if not np.isfinite(before).any():
        return PoseQuality(None, None, None)
    return PoseQuality(
        finite_mean(np.array(before)),
        finite_mean(np.array(after)),
        find_mounting(poses, times, runs),
    )


def describe_mounting(mounting: Mounting) -> tuple[str, str] | None:
    """Return a description of poses with this mounting and an advice, for a message; None if they
    need no correction.
    """
    wrong = mounting.wrong
    values = mounting.values
    errors = mounting.errors
    described = []
    advice = "write corrected poses with `carlasc refine`"
    said = list(mounting.describe().items())
    if wrong[:3].any():
        place = ", ".join(f"{axis} = {value}" for axis, value in said[:3])
        described.append(
            f"poses of another point of the vehicle: in their frame, the sensor is at about {place}"
        )
        advice = (
            "write the poses of the sensor: inv(T) @ P @ T, with T the sensor's pose in the frame "
            f"of the poses (from the calibration), or {advice}"
        )
    if wrong[3:6].any():
        turned = " and ".join(f"{said[i][0]} {said[i][1]}" for i in (3, 4, 5) if wrong[i])
        described.append(f"poses in whose frame the sensor is turned by {turned}")
        advice = f"check the rotation of the calibration, which no command changes; {advice}"
    if wrong[6]:
        when = "late" if values[6] > 0 else "early"
        late_s = abs(values[6])
        described.append(
            f"poses that are {late_s:.2f} ± {errors[6]:.2f} s {when} "
            f"({late_s / layout.FRAME_PERIOD_S:.1f} frames)"
        )
        advice += ", and compare the time stamps of both"
    return (" and ".join(described), advice) if described else None


def angles_of(motions: FloatArray) -> FloatArray:
    """Return (...) the angles by which (..., 4, 4) motions turn, radians."""
    traces = np.trace(motions[..., :3, :3], axis1=-2, axis2=-1)
    return np.asarray(np.arccos(np.clip((traces - 1) / 2, -1, 1)))


def _choose_runs(poses: FloatArray, seconds: FloatArray) -> list[int]:
    """Return the first rows of up to three runs that do not overlap: the sharpest turn, the largest
    acceleration, the middle.
    """
    count = len(poses)
    if count <= _RUN:
        return [0] if count > 2 else []
    motions = multiply(invert(poses[:-1]), poses[1:])
    speed = np.linalg.norm(motions[:, :3, 3], axis=1) / np.maximum(np.diff(seconds), 1e-3)
    changes = np.abs(speed[_RUN // 3 :] - speed[: -(_RUN // 3)])
    chosen: list[int] = []
    for values in (angles_of(motions), changes, -np.abs(np.arange(count) - count / 2)):
        sums = np.convolve(values, np.ones(min(_RUN, len(values))), "valid")
        for row in np.argsort(-sums, kind="stable")[:: max(1, len(sums) // 50)].tolist():
            first = min(row, count - _RUN)
            if all(abs(first - other) >= _RUN for other in chosen):
                chosen.append(first)
                break
    return sorted(chosen)


_SPEED_M_S = 70.0  # 250 km/h
# between neighbouring steps; a collision in CARLA changes the speed as much
_SPEED_CHANGE_M_S = 15.0
_TURN_RAD_S = np.deg2rad(250.0)
_TOLERANCE = 1e-3


def check_poses(sequence: Sequence) -> Iterator[Finding]:
    """Check that poses.txt exists, has a line for each frame, and holds rigid transforms that
    change smoothly.
    """
    where = f"{sequence.location}/{layout.POSES}"
    frames = sequence.scan_frames()
    if layout.POSES not in sequence.documents():
        if "points" in sequence.fields():
            yield Finding(
                "error",
                "poses",
                where,
                "a pose for each scan",
                "no file",
                "copy the file, or estimate poses with KISS-ICP: scans cannot be merged without "
                "poses",
            )
        return
    try:
        poses = sequence.poses
    except CarlascError as error:
        yield Finding.from_error("poses", where, error)
        return
    yield from _check_lines(sequence, "poses", where, len(poses))
    wrong: list[FormatError] = []
    for line, pose in enumerate(poses, 1):
        try:
            check_rigid(pose, f"{where}: line {line}", _TOLERANCE)
        except FormatError as error:
            wrong.append(error)
    if wrong:
        if len(wrong) > 1:
            wrong[0].found += f" (and {len(wrong) - 1} more such lines)"
        yield Finding.from_error("poses", where, wrong[0])
    elif len(frames) and _has_lines(sequence, len(poses)):
        yield from _check_steps(sequence, frames, where)


def check_times(sequence: Sequence) -> Iterator[Finding]:
    """Check that times.txt exists, has a line for each frame, and that times increase."""
    where = f"{sequence.location}/{layout.TIMES}"
    if layout.TIMES not in sequence.documents():
        if "points" in sequence.fields():
            advice = "copy the file; without it, 10 Hz is assumed"
            yield Finding("warning", "times", where, "a time for each scan", "no file", advice)
        return
    try:
        times = sequence.times
    except CarlascError as error:
        yield Finding.from_error("times", where, error)
        return
    yield from _check_lines(sequence, "times", where, len(times))
    wrong = np.flatnonzero(~(np.diff(times) > 0))
    if len(wrong):
        line = int(wrong[0]) + 1
        lines = f"{times[line]:g} s in line {line + 1} after {times[line - 1]:g} s"
        found = f"{lines} ({len(wrong)} such lines)"
        yield Finding("error", "times", where, "seconds that increase from line to line", found)


def _check_lines(sequence: Sequence, kind: str, where: str, lines: int) -> Iterator[Finding]:
    """Check that each frame has a line, and that the file ends with the line of the last frame."""
    frames = sequence.scan_frames()
    if not len(frames):
        return
    last = int(frames[-1])
    expected = f"{last + 1} lines, up to frame {last}"
    found = f"{lines} lines"
    if not _has_lines(sequence, lines):
        if last + 1 != len(frames):
            expected += f" (or {len(frames)}, one per frame that exists)"
        advice = "lines are missing: copy the file again"
        yield Finding("error", kind, where, expected, found, advice)
    elif lines > last + 1:
        advice = (
            "check whether scans are missing at the end, or the file belongs to another sequence"
        )
        yield Finding("warning", kind, where, expected, found, advice)


def _has_lines(sequence: Sequence, lines: int) -> bool:
    """Return whether each frame has a line in a file of `lines` lines, as readers count them."""
    try:
        for frame in sequence.scan_frames().tolist():
            sequence.line_of(frame, lines, layout.POSES)
    except FormatError:
        return False
    return True


def _check_steps(sequence: Sequence, frames: IntArray, where: str) -> Iterator[Finding]:
    """Check the first pose, and that the sensor moves and turns between frames as a vehicle can."""
    poses = np.stack([sequence.read_pose(frame) for frame in frames.tolist()])
    if frames[0] == 0 and np.abs(poses[0] - np.eye(4)).max() > _TOLERANCE:
        yield Finding(
            "note",
            "poses",
            where,
            "the identity as the first pose",
            "another pose",
            "nothing to do: the poses are relative to another frame, and only relative poses are "
            "used",
        )
    # frames of a cloud without a sensor have no order in time
    if len(frames) < 2 or not sequence.metadata.has_rays:
        return
    try:
        seconds = np.array([sequence.read_time(frame) for frame in frames.tolist()])
    except CarlascError:
        seconds = np.zeros(len(frames))
    if found := describe_jumps(frames, poses, seconds):
        advice = "check whether frames are missing there, or sequences were joined"
        yield Finding("error", "pose-jump", where, "poses without jumps", found, advice)


def describe_jumps(frames: IntArray, poses: FloatArray, seconds: FloatArray) -> str:
    """Return where poses jump as no carrier of a sensor moves; empty if they do not.

    Args:
        frames: (F,) increasing frame numbers.
        poses: (F, 4, 4) their poses.
        seconds: (F,) their times; if they do not increase, frames at 10 Hz are taken.
    """
    steps = invert(poses[:-1]) @ poses[1:]
    period_s = np.diff(seconds)
    if not (period_s > 0).all():  # which is reported elsewhere
        period_s = np.diff(frames) * layout.FRAME_PERIOD_S
    moved_m = np.linalg.norm(steps[:, :3, 3], axis=1)
    turned = angles_of(steps)
    speed = moved_m / period_s
    turn = turned / period_s
    usual = np.array([np.median(speed[max(0, i - 3) : i + 4]) for i in range(len(speed))])
    strange = np.abs(speed - usual)
    jumps = np.flatnonzero(
        (speed > _SPEED_M_S) | (strange > _SPEED_CHANGE_M_S) | (turn > _TURN_RAD_S)
    )
    if not len(jumps):
        return ""
    step = int(jumps[np.argmax(strange[jumps] + turn[jumps])])
    found = (
        f"{moved_m[step]:.2f} m and {np.rad2deg(turned[step]):.1f} degrees from frame "
        f"{frames[step]} to {frames[step + 1]}, {usual[step] * period_s[step]:.2f} m between "
        "other frames"
    )
    return found + (f" ({len(jumps)} such steps)" if len(jumps) > 1 else "")
