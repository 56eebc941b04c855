"""The grid of one frame, made from the scans of a window."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from carlasc.core.classes import ClassTable
from carlasc.core.evidence import VoxelFlag
from carlasc.core.geometry import transform_points
from carlasc.core.grids import Grid, GridSpec
from carlasc.groundtruth.from_scans.actors import Actors
from carlasc.groundtruth.from_scans.feed import ScanFeed
from carlasc.groundtruth.from_scans.merging import Instant, Merger
from carlasc.groundtruth.from_scans.regions import STATIC, Regions
from carlasc.groundtruth.inputs import Plan
from carlasc.groundtruth.options import FromScans
from carlasc.groundtruth.voting.ballot import Ballot, Votes
from carlasc.groundtruth.voting.evidence import (
    UNKNOWN,
    Evidence,
    Matter,
    class_shares,
    is_occupied,
    matter_of,
    probability,
)
from carlasc.groundtruth.voting.observations import Observation

# The volume that certainly belongs to the recording vehicle, and to every vehicle that carries a LiDAR: metres around the sensor.
_OWN_LOWER, _OWN_UPPER = np.array([-2.2, -0.75, -1.2]), np.array([2.2, 0.75, 0.0])
_OWN_PROBABILITY = 0.01


@dataclass(frozen=True)
class MergedFrame:
    """What the scans of a window say of a frame.

    Attributes:
        grid: the grid.
        votes: the votes that decided it, without what completes actors.
        evidence: how certain each voxel is; None unless the plan asks for it.
    """

    grid: Grid
    votes: Votes
    evidence: Evidence | None = None


def merge_frame(plan: Plan, feed: ScanFeed, actors: Actors, frame: int, window: list[int]) -> MergedFrame:
    """Make the grid of a frame from the scans of a window, which need not contain the frame itself."""
    return _Merging(plan, feed, feed.merger(actors, frame), feed.instant(frame), window).run()


@dataclass(frozen=True)
class _Evidence:
    """The class with most hits of each voxel, its hits, its free samples, and what they are about, (V,) each; and the hits by class."""

    labels: NDArray[np.unsignedinteger]
    hits: NDArray[np.integer]
    free: NDArray[np.integer]
    matter: NDArray[np.int8]
    votes: NDArray[Any]

    @property
    def counts(self) -> NDArray[np.integer]:
        """(V,) hits and free samples."""
        return self.hits + self.free


@dataclass(frozen=True)
class _Merging:
    """The steps by which the grid of a frame is made."""

    plan: Plan
    feed: ScanFeed
    merger: Merger
    now: Instant
    window: list[int]

    def run(self) -> MergedFrame:
        """Make the grid."""
        ballot = self._vote(self.merger.observations(self.now, self.window, self.regions), self.plan.needs_evidence)
        votes = ballot.votes()
        if self.plan.rule != "ray":
            return MergedFrame(votes.to_grid(), votes)
        seen = self._evidence(votes)
        labels, counts, posterior = self._decide(seen), seen.counts.copy(), self._probability(seen)

        # What rays beside a body, or of other times, saw as free says nothing of these voxels.
        contested = self._contested()
        unseen = contested & ~self._seen_now() if contested.any() else contested
        forgotten = (labels == 0) & (self.regions.hidden | unseen)
        counts[forgotten], posterior[forgotten] = 0, UNKNOWN

        inferred, hits = np.zeros(len(labels), np.bool_), [votes.occupied]
        for completion in self._completions():
            new = (counts == 0) & (completion.counts > 0) & ~(self.regions.hidden_ends & (completion.hits == 0))
            labels[new] = self._decide(completion)[new]
            counts[new], posterior[new] = completion.counts[new], self._probability(completion)[new]
            hits.append(completion.votes[new[completion.votes["voxel"]]])
            inferred |= new

        if self.options.own_path and self.options.dynamic != "tube":
            driven = self._own_path() & (labels > 0) & (seen.matter != Matter.GROUND) & ~self._hit_now()
            labels[driven], posterior[driven] = 0, _OWN_PROBABILITY
        if self.feed.finds_ground:
            labels[np.isin(labels, sorted(self.classes.ground))] = self.classes.geometry_id
        size = self.spec.size
        grid = Grid(self.spec, labels.reshape(size), counts.reshape(size))
        if not self.plan.needs_evidence:
            return MergedFrame(grid, votes)
        flags = self._flags(inferred, contested)
        shares = class_shares(np.concatenate(hits), self.classes)
        return MergedFrame(grid, votes, Evidence(posterior.reshape(size), shares, flags.reshape(size), ballot.views))

    def _flags(self, inferred: NDArray[np.bool_], contested: NDArray[np.bool_]) -> NDArray[np.uint8]:
        """Return the flags of each voxel."""
        own = [self.now.frame] if self.now.frame in self.window else []
        now = self._count(self.merger.observations(self.now, own, replace(self.regions, actors={})))
        flags = np.zeros(len(inferred), np.uint8)
        for where, flag in (
            (inferred, VoxelFlag.INFERRED),
            (contested, VoxelFlag.CONTESTED),
            ((now.occupied_counts() + now.free).reshape(-1) > 0, VoxelFlag.SEEN_NOW),
            (self.in_body, VoxelFlag.IN_ACTOR),
        ):
            flags[where] |= np.uint8(flag)
        return flags

    @property
    def spec(self) -> GridSpec:
        return self.plan.spec

    @property
    def classes(self) -> ClassTable:
        return self.feed.classes

    @property
    def options(self) -> FromScans:
        return self.feed.options

    @cached_property
    def regions(self) -> Regions:
        return self.merger.regions(self.now, self.window, self.spec)

    @cached_property
    def in_body(self) -> NDArray[np.bool_]:
        return self.regions.of_voxel != STATIC

    def _vote(self, observations: Iterable[Observation], count_views: bool = False) -> Ballot:
        regions, step = self.regions.of_voxel, self.plan.voting.free_step_m
        ballot = Ballot(
            self.spec, self.classes, rule=self.plan.rule, free_step_m=step, regions=regions, count_views=count_views
        )
        for observation in observations:
            ballot.add(observation)
        return ballot

    def _count(self, observations: Iterable[Observation]) -> Votes:
        return self._vote(observations).votes()

    def _evidence(self, votes: Votes, *, mirrored: bool = False) -> _Evidence:
        labels, hits = votes.elect_occupied()
        matter = matter_of(labels, self.in_body, self.classes)
        if mirrored:
            matter[matter == Matter.BODY] = Matter.MIRRORED
        return _Evidence(labels, hits, votes.free.reshape(-1), matter, votes.occupied)

    def _decide(self, evidence: _Evidence) -> NDArray[np.unsignedinteger]:
        if self.options.dynamic == "tube":
            return evidence.labels
        free_m = evidence.free * self.plan.voting.free_step_m
        return np.where(is_occupied(evidence.hits, free_m, evidence.matter), evidence.labels, 0).astype(
            evidence.labels.dtype
        )

    def _probability(self, evidence: _Evidence) -> NDArray[np.float32]:
        step = self.plan.voting.free_step_m
        return probability(evidence.hits, evidence.free * step, evidence.matter, self.in_body, self.spec, step)

    def _contested(self) -> NDArray[np.bool_]:
        """Return where something that moves passes at other times."""
        if self.options.dynamic != "align":
            return np.zeros(self.spec.num_voxels, np.bool_)
        passing = self._count(self.merger.passing(self.now, self.window))
        return (passing.occupied_counts().reshape(-1) > 0) & ~self.in_body

    def _seen_now(self) -> NDArray[np.bool_]:
        """Return what the scans just before and after the frame saw."""
        votes = self._count(self.merger.recent(self.now, self.window))
        return (votes.occupied_counts() + votes.free).reshape(-1) > 0

    def _completions(self) -> Iterable[_Evidence]:
        """Yield what completes actors: their mirror images, then their usual shapes."""
        if not self.regions.actors or self.options.complete == "seen":
            return
        yield self._evidence(self._count(self.merger.mirrored(self.now, self.window, self.regions)), mirrored=True)
        if self.options.complete == "body":
            yield self._evidence(self._count(self.merger.shells(self.now, self.regions)), mirrored=True)

    def _own_path(self) -> NDArray[np.bool_]:
        """Return the voxels that the recording vehicle itself drove through at other frames of the window."""
        apart = float(self.spec.voxel_size[[0, 2]].min()) / 2
        axes = [np.arange(a, b + 1e-9, apart) for a, b in zip(_OWN_LOWER, _OWN_UPPER, strict=True)]
        body = np.stack(np.meshgrid(*axes), axis=-1).reshape(-1, 3)
        driven = np.zeros(self.spec.num_voxels + 1, np.bool_)
        for other in self.window:
            if other != self.now.frame:
                driven[self.spec.flat_index(transform_points(self.now.grid_T_world @ self.feed.pose(other), body))] = (
                    True
                )
        return driven[:-1]

    def _hit_now(self) -> NDArray[np.bool_]:
        """Return the voxels in which the frame's own scan has points, or that belong to an actor at the frame."""
        if self.now.frame not in self.window:
            return self.in_body
        scan = self.merger.scans[self.now.frame]
        hit = np.zeros(self.spec.num_voxels + 1, np.bool_)
        hit[self.spec.flat_index(transform_points(self.now.grid_T_world @ scan.world_T_sensor, scan.points))] = True
        return hit[:-1] | self.in_body
