"""Poses and times of a recording: from its files or estimated from its scans, and whether the scans
fit the poses.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import closing
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from carlasc.converting.assembling import Rig, read_scan
from carlasc.converting.protocol import Converter, FrameHandle, Recording, Trajectory
from carlasc.core.arrays import FloatArray
from carlasc.core.frames import check_seconds
from carlasc.core.geometry import relative_to
from carlasc.errors import CarlascError, FormatError, MissingDataError
from carlasc.inspection.alignment import diagnose_poses
from carlasc.inspection.pose_quality import describe_mounting
from carlasc.inspection.structure import structure_of
from carlasc.motion.options import PoseOptions
from carlasc.running.processes import run_all
from carlasc.running.spreading import Run
from carlasc.storage import layout

if TYPE_CHECKING:
    from carlasc.motion import odometry

FILE, KISS_ICP = "file", "kiss-icp"
_ESTIMATE = 'estimate poses from the scans with `poses="kiss-icp"`'
_ACCEPT = "accept them as they are with `force=True`"
# fourth differences, which are nearly 0 for a vehicle
_SMOOTH = np.array([1.0, -4.0, 6.0, -4.0, 1.0])
_JITTER_M = 0.05


def frame_times(recording: Recording, times: FloatArray | None) -> FloatArray:
    """Return (F,) seconds by frame number, by the clock of the recording; without times, 10 Hz from
    0.

    Raises:
        FormatError: a frame has no time, or a time is not finite.
    """
    frames = recording.frames[-1].number + 1
    if times is None:
        return np.arange(frames, dtype=np.float64) * layout.FRAME_PERIOD_S
    if len(times) < frames:
        raise FormatError(
            recording.location,
            expected=f"a time for each frame up to {frames - 1}",
            found=f"{len(times)} times",
            advice="copy the file of times again",
        )
    return check_seconds(np.asarray(times[:frames], np.float64), recording.location)


def read_trajectory(
    recording: Recording, times: FloatArray, options: PoseOptions
) -> Trajectory | None:
    """Return the poses of the vehicle at their own times, from the recording's files; None if they
    must be estimated.

    Poses without times belong to the frames, one by one.

    Args:
        recording: the recording.
        times: (F,) seconds by frame number.
        options: where poses come from.

    Raises:
        MissingDataError: the file of poses does not exist, and poses must not be estimated.
        FormatError: a frame has no pose, or all frames share one pose.
    """
    trajectory = None if options.source == KISS_ICP else recording.poses(force=options.force)
    if trajectory is None:
        if options.source == FILE:
            raise MissingDataError(
                recording.location,
                expected="a file of poses",
                found="none",
                advice=f"copy it, or {_ESTIMATE}",
            )
        return None
    last = recording.frames[-1].number
    if trajectory.seconds is None:
        if len(trajectory.world_T_vehicle) <= last:
            raise FormatError(
                recording.location,
                expected=f"a pose for each frame up to {last}",
                found=f"{len(trajectory.world_T_vehicle)} lines in the file of poses",
                advice=f"copy it again, or {_ESTIMATE}",
            )
        return at_frames(trajectory.world_T_vehicle[: last + 1], times)
    if len(trajectory.seconds) == 1 < len(recording.frames):
        raise FormatError(
            recording.location,
            expected=f"poses over the time of {len(recording.frames)} scans",
            found="one pose",
            advice=f"copy the file of poses again, or {_ESTIMATE}",
        )
    return trajectory


def at_frames(world_T_vehicle: FloatArray, times: FloatArray) -> Trajectory:
    """Return the trajectory of (F, 4, 4) poses of frames.

    If times do not increase, 0.1 s between frames is assumed.
    """
    if not (np.diff(times) > 0).all():
        times = np.arange(len(times), dtype=np.float64) * layout.FRAME_PERIOD_S
    return Trajectory(world_T_vehicle, times)


def scan_poses(trajectory: Trajectory, recording: Recording, times: FloatArray) -> FloatArray:
    """Return (F, 4, 4) first_T_scan by frame number.

    Poses with the times of frames are not changed, others are interpolated.

    Args:
        trajectory: poses of the vehicle, with times.
        recording: the recording, for the pose of the scan on the vehicle.
        times: (F,) seconds by frame number, by the same clock.
    """
    given = trajectory.world_T_vehicle
    same = trajectory.seconds is not None and np.array_equal(trajectory.seconds, times)
    poses = (given if same else trajectory.at(times)) @ recording.vehicle_T_scan
    return relative_to(poses[0], poses)


def jitter(poses: FloatArray) -> float:
    """Return the noise of (F, 4, 4) poses of frames about a smooth path, metres: such as that of an
    unfiltered receiver.
    """
    places = poses[:, :3, 3]
    if len(places) < 2 * len(_SMOOTH):
        return 0.0
    jumps = np.stack(
        [np.convolve(places[:, axis], _SMOOTH, mode="valid") for axis in range(3)], axis=1
    )
    return float(np.median(np.linalg.norm(jumps, axis=1)) / np.linalg.norm(_SMOOTH))


def jitter_note(poses: FloatArray) -> str | None:
    """Return a note if poses jump; None if they do not."""
    if (error_m := jitter(poses)) < _JITTER_M:
        return None
    return (
        f"poses jump by about {100 * error_m:.0f} cm from one to the next, which blurs grids: "
        f"{_ESTIMATE}"
    )


@dataclass(frozen=True)
class _ReadUsable:
    """Reads the points of a scan for odometry, in a worker, while poses of earlier scans are
    estimated.
    """

    rig: Rig

    def __call__(self, handle: FrameHandle) -> odometry.UsableScan | CarlascError | OSError:
        from carlasc.motion.odometry import usable_points

        try:
            scan = read_scan(handle, self.rig, None)
        except (CarlascError, OSError) as error:
            return error
        used, seconds = usable_points(scan.points), scan.fields.get("seconds")
        return scan.points[used, :3], None if seconds is None else seconds[used]


def estimate_poses(
    recording: Recording,
    converter: Converter,
    times: FloatArray,
    step: Callable[[], object],
    run: Run,
) -> FloatArray:
    """Estimate the pose of each scan with KISS-ICP.

    A frame without a scan gets the pose of the scan before it.

    Points of sensors that are not corrected for motion are corrected by the estimate, if their
    times are known. Scans that cannot be read are skipped: their conversion reports them. So are
    scans with too few points.

    Args:
        recording: its scans.
        converter: the converter, for the range of points to use.
        times: (F,) seconds by frame number.
        step: called for each frame.
        run: how the reading of scans is spread.

    Returns:
        (F, 4, 4) first_T_scan by frame number, right-handed.

    Raises:
        CarlascError: no scan can be read: the error of the first one.
        MissingDataError: no scan has enough points.
        DependencyError: kiss-icp is not installed.
    """
    from carlasc.motion import odometry

    rig = Rig(tuple(recording.sensors), recording.vehicle_T_scan)
    numbers: list[int] = []
    read_at: list[float] = []  # times of the frames that were read
    errors: list[CarlascError | OSError] = []

    def scans() -> Iterator[odometry.UsableScan]:
        with closing(run_all(_ReadUsable(rig), recording.frames, run)) as read:
            for handle, scan in zip(recording.frames, read, strict=True):
                step()
                if isinstance(scan, Exception):
                    errors.append(scan)
                elif len(scan[0]) >= odometry.MIN_POINTS:
                    numbers.append(handle.number)
                    read_at.append(float(times[handle.number]))
                    yield scan

    nearest, farthest = odometry_range(converter)
    poses = list(
        odometry.follow_scans(scans(), times=read_at, min_range_m=nearest, max_range_m=farthest)
    )
    if len(errors) == len(recording.frames):
        raise errors[0]
    return fill_gaps(numbers, np.array(poses), recording)


def odometry_range(converter: Converter) -> tuple[float, float]:
    """Return the least and the greatest range of the points that odometry uses, in metres."""
    return converter.min_range_m or 0.0, converter.max_range_m or 100.0


def fill_gaps(frames: list[int], poses: FloatArray, recording: Recording) -> FloatArray:
    """Return (F, 4, 4) poses by frame number from those of some frames: others have the pose of the
    frame before.

    Args:
        frames: M frame numbers, increasing.
        poses: (M, 4, 4) their poses.
        recording: its last frame is the last that gets a pose.

    Raises:
        MissingDataError: there is none.
    """
    if not frames:
        raise MissingDataError(
            recording.location,
            expected="scans to estimate poses from",
            found="none that can be read and has enough points",
            advice="copy the scans again",
        )
    lines = np.searchsorted(frames, np.arange(recording.frames[-1].number + 1), side="right") - 1
    return poses[np.clip(lines, 0, None)]


def check_poses(recording: Recording, converter: Converter, poses: FloatArray) -> str | None:
    """Check that the scans overlap under their poses, which reads some scans.

    Poses of another point of the vehicle, or some frames late, are accepted with a note, which is
    returned.

    Args:
        recording: its scans.
        converter: the converter, for the classes that do not move.
        poses: (F, 4, 4) first_T_scan by frame number.

    Raises:
        FormatError: scans do not overlap; the message names the likely mistake, and what to do.
    """
    rig = Rig(tuple(recording.sensors), recording.vehicle_T_scan)

    def structure(index: int) -> FloatArray:
        try:
            scan = read_scan(recording.frames[index], rig, None)
        except (CarlascError, OSError):
            return np.empty((0, 3))  # the conversion of the frame reports the error
        return structure_of(scan.points[:, :3], scan.labels, None, converter.classes)

    diagnosis = diagnose_poses(structure, poses[[handle.number for handle in recording.frames]])
    expected = "poses under which the scans overlap"
    if diagnosis.correction is not None:
        raise FormatError(
            recording.location,
            expected=expected,
            found=f"{diagnosis.share_there:.0%} of a scan's structure overlaps that of an earlier "
            f"scan; the likely cause is {diagnosis.correction.name} (with that corrected: "
            f"{diagnosis.corrected_share:.0%})",
            advice=f"{diagnosis.correction.advice}, or {_ACCEPT}",
        )
    if diagnosis.offset_m is not None:
        x, y, z = diagnosis.offset_m
        raise FormatError(
            recording.location,
            expected=expected,
            found=f"scans that are about ({x:.1f}, {y:.1f}, {z:.1f}) m away from each other",
            advice=f"check that poses and calibration belong to this sequence, {_ESTIMATE}, or "
            f"{_ACCEPT}",
        )
    mounting = None if diagnosis.quality is None else diagnosis.quality.mounting
    described = None if mounting is None else describe_mounting(mounting)
    return None if described is None else f"{described[0]}: {described[1]}, or {_ESTIMATE}"
