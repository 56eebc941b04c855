"""Sequences without a raw capture: each frame's grid is made of the scans around it in time."""

from __future__ import annotations

import os
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from carlasc.core.geometry import check_rigid
from carlasc.errors import FormatError, MissingDataError
from carlasc.groundtruth.from_scans.windows import Merging, ScanFeed
from carlasc.groundtruth.inputs import FrameData, FrameInputs, FrameRange, Recipe, SequenceInputs, range_text
from carlasc.groundtruth.voting.ballot import Ballot
from carlasc.storage import layout
from carlasc.storage import open as open_source
from carlasc.storage.protocol import Sequence

_FASTEST_M_S, _SHARPEST_RAD_S = 70.0, 5.0  # no vehicle moves or turns faster: its poses jump
# Points on a square metre that outweigh one scan which saw free space there.
_STANDING_POINTS_M2, _MOVABLE_POINTS_M2 = 3.0, 32.0


@dataclass(frozen=True)
class ScanFrame(FrameInputs):
    """One frame of a sequence, with the window of scans that vote on it."""

    feed: ScanFeed
    number: int
    source_frame: int

    def fields(self) -> tuple[str, ...]:
        """Return the scan fields that the frame has."""
        return scan_fields(self.feed.sequence, self.number)

    def make(self, recipe: Recipe) -> FrameData:
        """Read the frame's own files; let the scans of its window vote."""
        fields = {name: self.feed.sequence.read(name, self.number) for name in self.fields()}
        merger, spec = self.feed.merger(self.number), recipe.spec
        window = self.feed.reaching(self.number, spec)
        regions = merger.regions(self.number, spec)
        ballot = Ballot(spec, recipe.classes, vote=recipe.vote, free_step_m=recipe.free_step_m, regions=regions)
        for observation in merger.observations(self.number, window, regions):
            ballot.add(observation)
        votes = ballot.votes()
        return FrameData(fields, votes.to_grid(free_weight(recipe, self.feed.merging)), votes)


def free_weight(recipe: Recipe, merging: Merging) -> NDArray[np.float64] | None:
    """Return (K,) how many points of each class one scan that saw free space outweighs; None for plain votes.

    A thin surface that scans graze is free in most of them and there all the same, so a few points are enough for what stands. What may
    move may also have left unnoticed, so it takes more of them. Smaller voxels have fewer points on them.
    """
    if recipe.vote != "point":
        return None
    if merging.dynamic == "tube":
        return np.zeros(recipe.classes.num_channels)
    face_m2 = float(recipe.spec.voxel_size[0] * recipe.spec.voxel_size[2])
    weight = np.full(recipe.classes.num_channels, _STANDING_POINTS_M2 * face_m2)
    weight[sorted(recipe.classes.movable)] = _MOVABLE_POINTS_M2 * face_m2
    return weight


class StoredInputs(SequenceInputs):
    """A sequence of the layout: scans, poses and times are its own, frames keep their numbers."""

    def __init__(self, sequence: Sequence) -> None:
        self.sequence = sequence
        self.path = _parent_of(sequence.path, sequence.coordinates)
        self.location, self.metadata = sequence.location, sequence.metadata

    def poses(self) -> NDArray[np.float64] | None:
        """Return the sequence's poses, a line each; None where it has none."""
        return self.sequence.poses if layout.POSES in self.sequence.documents() else None

    def times(self) -> NDArray[np.float64] | None:
        """Return the sequence's times, a line each; None where it has none."""
        return self.sequence.times if layout.TIMES in self.sequence.documents() else None


class ScanInputs(StoredInputs):
    """A sequence whose scans are merged over time."""

    def __init__(
        self, sequence: Sequence, frames: FrameRange | None, merging: Merging, *, estimate_poses: bool, force: bool
    ) -> None:
        super().__init__(sequence)
        chosen = choose_frames(sequence, sequence.frames("points"), frames)
        self.vote = "point"
        self.merging, self.estimated = merging, estimate_poses
        if estimate_poses:
            sequence.poses = _estimate(sequence)
        check_trajectory(sequence, force=force)
        self.feed = ScanFeed(sequence, merging, sequence.poses if estimate_poses else None)
        self.frames = tuple(ScanFrame(self.feed, number, number) for number in chosen)

    def record(self) -> dict[str, Any]:
        """Return the kind of source and how scans are merged."""
        merging = self.merging
        record: dict[str, Any] = {
            "source": "scans",
            "motion": self.feed.motion_source or "none",
            "dynamic": merging.dynamic,
        }
        record |= {"poses": "kiss-icp"} if self.estimated else {}
        record |= {"window": f"{merging.window[0]}:{merging.window[1]}", "stride": merging.stride}
        record |= {} if merging.window_m is None else {"window_m": merging.window_m}
        limits = {"min_range_m": self.feed.min_range_m, "max_range_m": self.feed.max_range_m}
        return record | {name: value for name, value in limits.items() if np.isfinite(value) and value > 0}

    def poses(self) -> NDArray[np.float64] | None:
        """Return the poses to write beside the grids: estimated ones only where the sequence has none of its own."""
        has_own = layout.POSES in self.sequence.documents()
        return None if self.estimated and has_own else self.sequence.poses

    def notes(self) -> list[str]:
        """Say what the scans cannot tell."""
        if "labels" not in self.sequence.fields():
            return [f"{self.location}: scans have no labels: grids hold geometry only, everything is one class"]
        if self.feed.motion_source is None and self.merging.dynamic != "tube":
            return [f"{self.location}: neither flow nor instances tell what moves: everything was taken to stand still"]
        if self.feed.motion_source == "labels" and self.merging.dynamic == "align":
            return [f"{self.location}: labels say what moves, but not how: moving points were left out of other frames"]
        return []


def _estimate(sequence: Sequence) -> NDArray[np.float64]:
    """Let KISS-ICP find the pose of each scan; lines of frames without a scan stay where the last one was."""
    from carlasc.motion.odometry import estimate_poses

    frames = sequence.frames("points")
    farthest = sequence.metadata.max_range_m or 100.0
    found = estimate_poses((sequence.read("points", int(f))[:, :3] for f in frames), max_range_m=farthest)
    lines = np.clip(np.searchsorted(frames, np.arange(frames[-1] + 1), side="right") - 1, 0, None)
    return found[lines]


def scan_inputs(
    source: str | os.PathLike[str],
    frames: FrameRange | None,
    merging: Merging,
    *,
    estimate_poses: bool = False,
    force: bool = False,
) -> list[SequenceInputs]:
    """Find the sequences of a source that have scans.

    Raises:
        MissingDataError: there is none, or it has no poses.
        FormatError: poses are not rigid, or jump.
    """
    sequences: dict[str, Sequence] = {}
    for sequence in open_source(source).sequences().values():
        parent = _parent_of(sequence.path, sequence.coordinates)
        rival = sequences.get(parent)  # scans may stand beside the grids of both coordinates: the fuller ones are taken
        if rival is None or len(sequence.frames("points")) > len(rival.frames("points")):
            sequences[parent] = sequence
    sequences = {parent: sequence for parent, sequence in sequences.items() if "points" in sequence.fields()}
    if not sequences:
        raise MissingDataError(source, expected="sequences with scans (velodyne/)", found="none")
    return [
        ScanInputs(sequence, frames, merging, estimate_poses=estimate_poses, force=force)
        for sequence in sequences.values()
    ]


def choose_frames(sequence: Sequence, there: NDArray[np.int64], frames: FrameRange | None) -> list[int]:
    """Return the frames in a range.

    Raises:
        MissingDataError: there is none.
    """
    start, stop = frames or (None, None)
    chosen = [int(f) for f in there if (start is None or f >= start) and (stop is None or f < stop)]
    if not chosen:
        found = f"only {there[0]} to {there[-1]}" if len(there) else "none"
        raise MissingDataError(sequence.location, expected=f"frames in {range_text(start, stop)}", found=f"{found}")
    return chosen


def scan_fields(sequence: Sequence, frame: int) -> tuple[str, ...]:
    """Return the scan fields that a frame has."""
    present = sequence.fields()
    return tuple(name for name in layout.SCAN_FIELDS if name in present and frame in sequence.frames(name))


def check_trajectory(sequence: Sequence, *, force: bool) -> None:
    """Check that a sequence has poses, that they are rigid, and that they do not jump; and that its times, if it has any, rise.

    Raises:
        MissingDataError: it has none.
        FormatError: a pose is not rigid, or jumps and `force` is not given, or a time does not rise; names the frame.
    """
    if "poses" not in vars(sequence) and layout.POSES not in sequence.documents():
        raise MissingDataError(
            f"{sequence.location}/{layout.POSES}",
            expected="poses, without which scans cannot be merged",
            found="nothing",
            advice="have them estimated by KISS-ICP (`--poses kiss-icp`)",
        )
    check_rigid(sequence.poses, f"{sequence.location}/{layout.POSES}")
    frames = sequence.frames("points")
    _check_times(sequence, frames)
    if force:
        return
    poses = np.stack([sequence.read_pose(int(frame)) for frame in frames])
    elapsed = np.diff(frames) * layout.FRAME_PERIOD_S
    speed = np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1) / elapsed
    traces = np.einsum("fij,fij->f", poses[1:, :3, :3], poses[:-1, :3, :3])
    turning = np.arccos(np.clip((traces - 1) / 2, -1, 1)) / elapsed
    jumps = np.flatnonzero((speed > _FASTEST_M_S) | (turning > _SHARPEST_RAD_S))
    if len(jumps):
        row = int(jumps[0])
        raise FormatError(
            f"{sequence.location}/{layout.POSES}",
            expected="a continuous drive",
            found=(
                f"a jump of {speed[row]:.0f} m/s and {turning[row]:.1f} rad/s at frame {frames[row + 1]} "
                f"({len(jumps)} jumps in all)"
            ),
            advice="mend the poses, or go on with --force",
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
            expected="times that rise",
            found=f"{times[row]:g} s and {times[row + 1]:g} s at frames {frames[row]} and {frames[row + 1]}",
            advice="mend the file, or remove it: frames are 0.1 s apart then",
        )


def _parent_of(path: str, coordinates: str) -> str:
    """Return the path of the sequence's folder, above `<coordinates>`: where a run puts that again."""
    head, _, last = path.rpartition("/")
    return head if last == coordinates else path
