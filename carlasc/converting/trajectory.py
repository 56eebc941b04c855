"""Poses and times of a recording: from its files or estimated from its scans, and whether the scans fit the poses."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from carlasc.converting.protocol import Converter, Recording
from carlasc.errors import FormatError, MissingDataError
from carlasc.inspection.alignment import diagnose_poses
from carlasc.inspection.structure import static_structure
from carlasc.storage import layout
from carlasc.storage.metadata import Metadata
from carlasc.storage.protocol import Sequence

PoseSource = Literal["file", "kiss-icp", "auto"]
FILE, KISS_ICP = "file", "kiss-icp"
_ESTIMATE = 'estimate poses from the scans with `poses="kiss-icp"`'
_ACCEPT = "accept them as they are with `force=True`"


def read_poses(recording: Recording, pose_source: PoseSource, *, force: bool) -> NDArray[np.float64] | None:
    """Return (F, 4, 4) first_T_sensor by frame number from the recording's files; None if they are to be estimated.

    Raises:
        MissingDataError: the file of poses does not exist, and they are not to be estimated.
        FormatError: a frame has no pose.
    """
    poses = None if pose_source == KISS_ICP else recording.poses(force=force)
    if poses is None:
        if pose_source == FILE:
            raise MissingDataError(
                recording.location,
                expected="poses.txt",
                found="nothing",
                advice=f"copy it, or {_ESTIMATE}",
            )
        return None
    last = recording.frames[-1].number
    if len(poses) <= last:
        raise FormatError(
            recording.location,
            expected=f"a pose for each frame up to {last}",
            found=f"{len(poses)} lines in the file of poses",
            advice=f"copy it again, or {_ESTIMATE}",
        )
    relative: NDArray[np.float64] = np.linalg.inv(poses[0]) @ poses[: last + 1]
    return relative


def estimate_poses(recording: Recording, converter: type[Converter], step: Callable[[], object]) -> NDArray[np.float64]:
    """Estimate the pose of each scan with KISS-ICP. A frame without a scan gets the pose of the scan before it.

    Scans that cannot be read are skipped: their conversion reports them.

    Returns:
        (F, 4, 4) first_T_sensor by frame number, right-handed.

    Raises:
        MissingDataError: no scan can be read.
        DependencyError: kiss-icp is not installed.
    """
    from carlasc.motion import odometry

    found: list[int] = []

    def scans() -> Any:
        for handle in recording.frames:
            step()
            try:
                points = handle.read().points
            except (FormatError, MissingDataError):
                continue
            found.append(handle.number)
            yield points[np.isfinite(points).all(axis=1), :3]

    nearest, farthest = converter.min_range_m or 0.0, converter.max_range_m or 100.0
    poses = odometry.estimate_poses(scans(), min_range_m=nearest, max_range_m=farthest)
    if not len(poses):
        raise MissingDataError(
            recording.location, expected="scans to estimate poses from", found="none that can be read"
        )
    lines = np.searchsorted(found, np.arange(recording.frames[-1].number + 1), side="right") - 1
    return poses[np.clip(lines, 0, None)]


def check_poses(recording: Recording, converter: type[Converter], poses: NDArray[np.float64]) -> None:
    """Check that the scans overlap under their poses.

    Raises:
        FormatError: they do not; says which mistake the poses look like, and what to do.
    """
    scans = _Scans(recording, converter)
    frames = [handle.number for handle in recording.frames]

    def structure(index: int) -> NDArray[np.float64]:
        try:
            return static_structure(scans, frames[index])
        except (FormatError, MissingDataError):
            return np.empty((0, 3))

    diagnosis = diagnose_poses(structure, poses[frames])
    expected = "poses under which the scans overlap"
    if diagnosis.correction is not None:
        raise FormatError(
            recording.location,
            expected=expected,
            found=f"{diagnosis.share_there:.0%} of a scan's structure on that of an earlier scan; they look like"
            f" {diagnosis.correction.name} (with that corrected: {diagnosis.corrected_share:.0%})",
            advice=f"{diagnosis.correction.advice}, or {_ACCEPT}",
        )
    if diagnosis.offset_m is not None:
        x, y, z = diagnosis.offset_m
        raise FormatError(
            recording.location,
            expected=expected,
            found=f"scans that are about ({x:.1f}, {y:.1f}, {z:.1f}) m away from each other",
            advice=f"check that poses.txt and calib.txt belong to this sequence, {_ESTIMATE}, or {_ACCEPT}",
        )


def times_from_first(recording: Recording) -> NDArray[np.float64]:
    """Return (F,) seconds since the first frame, by frame number; 10 Hz if the recording has no times.

    Raises:
        FormatError: a frame has no time.
    """
    frames = recording.frames[-1].number + 1
    times = recording.times()
    if times is None:
        return np.arange(frames, dtype=np.float64) * layout.FRAME_PERIOD_S
    if len(times) < frames:
        raise FormatError(
            recording.location,
            expected=f"a time for each frame up to {frames - 1}",
            found=f"{len(times)} lines in times.txt",
            advice="copy it again",
        )
    since: NDArray[np.float64] = times[:frames] - times[0]
    return since


class _Scans(Sequence):
    """A recording's scans as a sequence, in their own axes and classes, for functions that read sequences."""

    def __init__(self, recording: Recording, converter: type[Converter]) -> None:
        self.recording, self.path, self.location = recording, "", recording.location
        self.split, self.name, self.coordinates = recording.split, recording.name, "cartesian"
        self.metadata = Metadata("right", converter.classes)
        self._handles = {handle.number: handle for handle in recording.frames}

    def fields(self) -> frozenset[str]:
        return frozenset(("points", "labels") if self.recording.has_labels else ("points",))

    def frames(self, field: str) -> NDArray[np.int64]:
        return np.array(list(self._handles), np.int64) if field in self.fields() else np.empty(0, np.int64)

    def read(self, field: str, frame: int) -> NDArray[Any]:
        if field == "points":
            return self._handles[frame].read().points
        labels, _ = self._handles[frame].read_labels()
        if labels is None:
            raise MissingDataError(self.location, expected="labels", found="none")
        return labels

    def documents(self) -> tuple[str, ...]:
        return ()

    def read_document(self, name: str) -> bytes:
        raise MissingDataError(f"{self.location}/{name}", expected="a file", found="a recording of another data set")
