"""Sequences whose grids are made from scans: each frame's grid from the scans around it in time."""

from __future__ import annotations

import os
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from carlasc.errors import MissingDataError
from carlasc.groundtruth.from_scans.feed import ScanFeed
from carlasc.groundtruth.from_scans.trajectory import check_trajectory, with_estimated_poses
from carlasc.groundtruth.inputs import (
    FrameData,
    FrameInput,
    Plan,
    SequenceInput,
    StoredSequence,
    choose_frames,
    parent_path,
    scan_fields,
)
from carlasc.groundtruth.options import FromScans
from carlasc.groundtruth.voting.ballot import Ballot
from carlasc.storage import as_source, layout
from carlasc.storage.protocol import Sequence, Source

# Points per square metre of surface that outweigh one scan that saw free space there.
_STATIC_POINTS_M2, _MOVABLE_POINTS_M2 = 3.0, 32.0


@dataclass(frozen=True)
class ScanFrame(FrameInput):
    """One frame of a sequence, with the scans that vote on it."""

    feed: ScanFeed
    number: int
    source_frame: int

    def fields(self) -> tuple[str, ...]:
        """Return the names of the scan fields that the frame has."""
        return scan_fields(self.feed.sequence, self.number)

    def make(self, plan: Plan) -> FrameData:
        """Read the frame's own files, and count the votes of the scans in its window."""
        fields = {name: self.feed.sequence.read(name, self.number) for name in self.fields()}
        merger, spec = self.feed.merger(self.number), plan.spec
        window = self.feed.reaching(self.number, spec)
        regions = merger.regions(self.number, spec)
        ballot = Ballot(spec, self.feed.classes, rule=plan.rule, free_step_m=plan.voting.free_step_m, regions=regions)
        for observation in merger.observations(self.number, window, regions):
            ballot.add(observation)
        votes = ballot.votes()
        return FrameData(fields, votes.to_grid(free_weight(plan, self.feed)), votes)


def free_weight(plan: Plan, feed: ScanFeed) -> NDArray[np.float64] | None:
    """Return (K,) how many points of each class one scan that saw free space outweighs; None unless the rule is "point".

    Most scans that graze a thin surface see free space in its voxels, so a few points are enough for static classes. An actor may have
    left during the window, so movable classes need more points. Smaller voxels contain fewer points.
    """
    if plan.rule != "point":
        return None
    classes = feed.classes
    if feed.options.dynamic == "tube":
        return np.zeros(classes.num_channels)
    face_m2 = float(plan.spec.voxel_size[0] * plan.spec.voxel_size[2])
    weight = np.full(classes.num_channels, _STATIC_POINTS_M2 * face_m2)
    weight[sorted(classes.movable)] = _MOVABLE_POINTS_M2 * face_m2
    return weight


class ScanSequence(StoredSequence):
    """A sequence whose scans are merged over time."""

    def __init__(self, sequence: Sequence, plan: Plan, options: FromScans) -> None:
        super().__init__(sequence, plan)
        self.options = options

    @cached_property
    def feed(self) -> ScanFeed:
        """The scans of the sequence, after its poses and times were checked.

        Raises:
            MissingDataError: there are no poses.
            FormatError: poses or times are not valid.
        """
        estimated = self.options.poses == "kiss-icp"
        sequence = with_estimated_poses(self.sequence) if estimated else self.sequence
        check_trajectory(sequence, self.options)
        return ScanFeed(sequence, self.options)

    def _find_frames(self) -> tuple[FrameInput, ...]:
        chosen = choose_frames(self.plan.frames, self.sequence.frames("points"), self.location)
        return tuple(ScanFrame(self.feed, number, number) for number in chosen)

    def record(self) -> dict[str, Any]:
        """Return how scans are merged."""
        options = self.options
        record: dict[str, Any] = {"observe": "scans", "motion": self.feed.motion_source or "none"}
        record |= {"dynamic": options.dynamic}
        record |= {} if options.poses == "file" else {"poses": options.poses}
        record |= {"window": f"{options.window[0]}:{options.window[1]}", "stride": options.stride}
        record |= {} if options.window_m is None else {"window_m": options.window_m}
        limits = {"min_range_m": self.feed.min_range_m, "max_range_m": self.feed.max_range_m}
        return record | {name: value for name, value in limits.items() if np.isfinite(value) and value > 0}

    def poses(self) -> NDArray[np.float64] | None:
        """Return the poses to write beside the grids; None if they were estimated and the sequence has its own."""
        has_own = layout.POSES in self.sequence.documents()
        return None if has_own and self.options.poses != "file" else self.feed.sequence.poses

    def notes(self) -> list[str]:
        """Return what the scans lack."""
        where, dynamic = self.location, self.options.dynamic
        if "labels" not in self.sequence.fields():
            return [f"{where}: the scans have no labels: grids contain geometry only, in one class"]
        if self.feed.motion_source is None and dynamic != "tube":
            return [f"{where}: neither flow nor instances show what moves: everything was treated as static"]
        if self.feed.motion_source == "labels" and dynamic == "align":
            return [f"{where}: labels show what moves, but not how: moving points were left out of other frames"]
        return []


def scan_sequences(source: str | os.PathLike[str] | Source, plan: Plan, options: FromScans) -> list[SequenceInput]:
    """Find the sequences of a source that have scans.

    Raises:
        MissingDataError: there is none.
    """
    sequences: dict[str, Sequence] = {}
    for sequence in as_source(source).sequences().values():
        parent = parent_path(sequence)
        other = sequences.get(parent)  # scans may exist beside the grids of both coordinates: take the folder with more
        if other is None or len(sequence.frames("points")) > len(other.frames("points")):
            sequences[parent] = sequence
    chosen = [sequence for sequence in sequences.values() if "points" in sequence.fields()]
    if not chosen:
        raise MissingDataError(source, expected="sequences with scans (velodyne/)", found="none")
    return [ScanSequence(sequence, plan, options) for sequence in chosen]
