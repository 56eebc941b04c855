"""The trajectory by which scans are merged: estimated where that is asked for, and checked before anything is made with it."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from carlasc.core.geometry import check_rigid
from carlasc.errors import FormatError, MissingDataError
from carlasc.groundtruth.options import FromScans
from carlasc.motion.odometry import estimate_poses
from carlasc.storage import layout
from carlasc.storage.protocol import Sequence

_MAX_SPEED_M_S, _MAX_TURN_RAD_S = 70.0, 5.0  # no vehicle moves or turns faster
_RANGE_M = 100.0  # of a sensor whose range carlasc.json does not give


def with_estimated_poses(sequence: Sequence) -> Sequence:
    """Return a sequence with poses estimated by KISS-ICP.

    Lines of frames without a scan repeat the pose of the last scan.

    Raises:
        DependencyError: kiss-icp is not installed.
    """
    frames = sequence.frames("points")
    scans = (sequence.read("points", int(frame))[:, :3] for frame in frames)
    poses = estimate_poses(scans, max_range_m=sequence.metadata.max_range_m or _RANGE_M)
    lines = np.clip(np.searchsorted(frames, np.arange(frames[-1] + 1), side="right") - 1, 0, None)
    return sequence.with_poses(poses[lines])


def check_trajectory(sequence: Sequence, options: FromScans) -> None:
    """Check that a sequence has rigid poses without jumps, and that its times, if it has any, increase.

    Raises:
        MissingDataError: it has no poses.
        FormatError: nobody knows where points were seen from, a pose is not rigid, or jumps without `options.poses.force`, or a time does not increase; names the frame.
    """
    where = f"{sequence.location}/{layout.POSES}"
    if not sequence.metadata.has_rays:
        raise FormatError(
            sequence.location,
            expected="scans of a sensor whose place is known",
            found='"rays": false in carlasc.json',
            advice="free space cannot be told from unknown space: take the grids that came with the data",
        )
    if options.poses.source == "file" and layout.POSES not in sequence.documents():
        raise MissingDataError(
            where,
            expected="poses, which merging scans needs",
            found="none",
            advice='estimate them with KISS-ICP (`poses=PoseOptions("kiss-icp")`)',
        )
    check_rigid(sequence.poses, where)
    frames = sequence.frames("points")
    _check_times(sequence, frames)
    if not options.poses.force:
        _check_speed(sequence, frames, where)


def _check_speed(sequence: Sequence, frames: NDArray[np.int64], where: str) -> None:
    poses = np.stack([sequence.read_pose(int(frame)) for frame in frames])
    if layout.TIMES in sequence.documents():
        elapsed_s = np.diff([sequence.read_time(int(frame)) for frame in frames])
    else:
        elapsed_s = np.diff(frames) * layout.FRAME_PERIOD_S
    speed = np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1) / elapsed_s
    traces = np.einsum("fij,fij->f", poses[1:, :3, :3], poses[:-1, :3, :3])
    turn = np.arccos(np.clip((traces - 1) / 2, -1, 1)) / elapsed_s
    jumps = np.flatnonzero((speed > _MAX_SPEED_M_S) | (turn > _MAX_TURN_RAD_S))
    if len(jumps):
        row = int(jumps[0])
        found = f"a jump of {speed[row]:.0f} m/s and {turn[row]:.1f} rad/s at frame {frames[row + 1]}"
        raise FormatError(
            where,
            expected=f"at most {_MAX_SPEED_M_S:g} m/s and {_MAX_TURN_RAD_S:g} rad/s",
            found=f"{found} ({len(jumps)} in all)",
            advice="fix the poses, or continue with `force=True`",
        )


def _check_times(sequence: Sequence, frames: NDArray[np.int64]) -> None:
    if layout.TIMES not in sequence.documents():
        return
    times = np.array([sequence.read_time(int(frame)) for frame in frames])
    falls = np.flatnonzero(~(np.diff(times) > 0))
    if len(falls):
        row = int(falls[0])
        raise FormatError(
            f"{sequence.location}/{layout.TIMES}",
            expected="increasing times",
            found=f"{times[row]:g} s and {times[row + 1]:g} s at frames {frames[row]} and {frames[row + 1]}",
            advice="fix the file, or remove it: frames are then 0.1 s apart",
        )
