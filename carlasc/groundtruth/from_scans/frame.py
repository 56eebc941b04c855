"""The grid of one frame, made from the scans of a window."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, fields, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from carlasc.core.classes import ClassTable
from carlasc.core.evidence import VoxelFlag
from carlasc.core.grids import Grid, GridSpec
from carlasc.groundtruth.from_scans.actors import Actors
from carlasc.groundtruth.from_scans.feed import ScanFeed
from carlasc.groundtruth.from_scans.merging import Instant, Merger
from carlasc.groundtruth.from_scans.regions import STATIC, Regions
from carlasc.groundtruth.inputs import Plan
from carlasc.groundtruth.options import FromScans
from carlasc.groundtruth.voting.ballot import Ballot, Observation, Votes
from carlasc.groundtruth.voting.certainty import (
    UNKNOWN,
    Matter,
    VoxelCertainty,
    class_shares,
    is_occupied,
    matter_of,
    probability,
)
from carlasc.groundtruth.voting.kernel import mark

# The volume that certainly belongs to the recording vehicle, and to every vehicle that carries a LiDAR: metres around the sensor.
_OWN_LOWER, _OWN_UPPER = np.array([-2.2, -0.75, -1.2]), np.array([2.2, 0.75, 0.0])
_OWN_PROBABILITY = 0.01
_NO_VOXELS = np.empty(0, np.int64)


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
    evidence: VoxelCertainty | None = None


def merge_frame(plan: Plan, feed: ScanFeed, actors: Actors, frame: int, window: list[int]) -> MergedFrame:
    """Make the grid of a frame from the scans of a window, which need not contain the frame itself."""
    return _Merging(plan, feed, feed.merger(actors, frame), feed.instant(frame), window).run()


@dataclass(frozen=True)
class _Evidence:
    """What votes say of N voxels.

    Attributes:
        voxels: (N,) flat indices, increasing.
        labels: (N,) class with most hits, 0 without hits.
        hits: (N,) points.
        free: (N,) free samples.
        matter: (N,) what the evidence is about.
    """

    voxels: NDArray[np.int64]
    labels: NDArray[np.unsignedinteger]
    hits: NDArray[np.integer]
    free: NDArray[np.integer]
    matter: NDArray[np.int8]

    @property
    def counts(self) -> NDArray[np.integer]:
        """(N,) hits and free samples."""
        return self.hits + self.free

    def at(self, chosen: NDArray[np.bool_]) -> _Evidence:
        """Return the evidence of some of the voxels."""
        return _Evidence(*(getattr(self, field.name)[chosen] for field in fields(self)))


@dataclass
class _Scene:
    """The grid while it is made.

    Attributes:
        labels: (V,) classes.
        counts: (V,) hits and free samples; 0 means unknown.
        occupied: (V,) float32, probability that the voxel is occupied; None if it is not needed.
    """

    labels: NDArray[np.unsignedinteger]
    counts: NDArray[np.unsignedinteger]
    occupied: NDArray[np.float32] | None = None

    def forget(self, voxels: NDArray[np.integer]) -> None:
        """Make voxels unknown."""
        self.labels[voxels] = self.counts[voxels] = 0
        self.set_probability(voxels, UNKNOWN)

    def set_probability(self, voxels: NDArray[np.integer], probability: NDArray[np.float32] | float) -> None:
        """Set the probability that voxels are occupied, if it is needed."""
        if self.occupied is not None:
            self.occupied[voxels] = probability


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
        votes, views = ballot.votes(copy=False), ballot.views if self.plan.needs_evidence else None
        del ballot  # its memory is needed by the next ones
        if self.plan.rule != "ray":
            return MergedFrame(votes.to_grid(), votes)
        scene = self._scene(votes)

        # What rays beside a body, or of other times, saw as free says nothing of these voxels.
        contested = self._contested()
        doubtful = np.concatenate([self.regions.hidden, self._unseen_now(contested)])
        scene.forget(doubtful[scene.labels[doubtful] == 0])

        completed = [(_NO_VOXELS, votes.occupied)]
        completed += [self._complete(scene, completion) for completion in self._completions()]
        if self.options.own_path and self.options.dynamic != "tube":
            driven = self._driven(scene)
            scene.labels[driven] = 0
            scene.set_probability(driven, _OWN_PROBABILITY)
        if self.feed.finds_ground:
            scene.labels[np.isin(scene.labels, sorted(self.classes.ground))] = self.classes.geometry_id
        size = self.spec.size
        grid = Grid(self.spec, scene.labels.reshape(size), scene.counts.reshape(size))
        if scene.occupied is None or views is None:
            return MergedFrame(grid, votes)
        inferred, hits = (np.concatenate(parts) for parts in zip(*completed, strict=True))
        flags, shares = self._flags(inferred, contested), class_shares(hits, self.classes)
        return MergedFrame(
            grid, votes, VoxelCertainty(scene.occupied.reshape(size), shares, flags.reshape(size), views)
        )

    def _scene(self, votes: Votes) -> _Scene:
        """Return what the votes for the static scene and in the actors' bodies say."""
        evidence = self.plan.needs_evidence
        labels, hits = votes.elect_occupied()
        free = votes.free.reshape(-1)
        found = self._evidence(votes, labels, hits, np.flatnonzero((labels > 0) | (free > 0) if evidence else labels))
        labels[found.voxels] = self._decide(found)
        counts = np.add(hits, free, out=hits)
        scene = _Scene(labels, counts)
        if evidence:
            scene.occupied = np.full(len(labels), UNKNOWN, np.float32)
            scene.occupied[found.voxels] = self._probability(found)
        return scene

    def _complete(self, scene: _Scene, votes: Votes) -> tuple[NDArray[np.int64], NDArray[Any]]:
        """Take what completes actors where nothing else is known of their bodies: return these voxels, and the votes for their classes."""
        found = self._evidence(votes, *votes.elect_occupied(), np.flatnonzero(self.in_body))
        found.matter[found.matter == Matter.BODY] = Matter.MIRRORED
        unseen = np.isin(found.voxels, self.regions.hidden_ends) & (found.hits == 0)
        found = found.at((scene.counts[found.voxels] == 0) & (found.counts > 0) & ~unseen)
        scene.labels[found.voxels] = self._decide(found)
        scene.counts[found.voxels] = found.counts
        scene.set_probability(found.voxels, self._probability(found))
        return found.voxels, votes.occupied[np.isin(votes.occupied["voxel"], found.voxels)]

    def _flags(self, inferred: NDArray[np.int64], contested: NDArray[np.int64]) -> NDArray[np.uint8]:
        """Return (V,) the flags of each voxel."""
        own = [self.now.frame] if self.now.frame in self.window else []
        now = self._vote(self.merger.observations(self.now, own, replace(self.regions, actors={})))
        flags = np.zeros(self.spec.num_voxels, np.uint8)
        for where, flag in (
            (inferred, VoxelFlag.INFERRED),
            (contested, VoxelFlag.CONTESTED),
            (now.seen(), VoxelFlag.SEEN_NOW),
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

    def _evidence(self, votes: Votes, labels: NDArray[Any], hits: NDArray[Any], voxels: NDArray[np.int64]) -> _Evidence:
        """Return what votes say of some voxels; `labels` and `hits` are those of `Votes.elect_occupied`."""
        labels = labels[voxels]
        matter = matter_of(labels, self.in_body[voxels], self.classes)
        return _Evidence(voxels, labels, hits[voxels], votes.free.reshape(-1)[voxels], matter)

    def _decide(self, evidence: _Evidence) -> NDArray[np.unsignedinteger]:
        if self.options.dynamic == "tube":
            return evidence.labels
        free_m = evidence.free * self.plan.voting.free_step_m
        return np.where(is_occupied(evidence.hits, free_m, evidence.matter), evidence.labels, 0).astype(
            evidence.labels.dtype
        )

    def _probability(self, evidence: _Evidence) -> NDArray[np.float32]:
        step = self.plan.voting.free_step_m
        return probability(
            evidence.hits, evidence.free * step, evidence.matter, self.in_body[evidence.voxels], self.spec, step
        )

    def _contested(self) -> NDArray[np.int64]:
        """Return the voxels outside of bodies where something that moves passes at other times."""
        if self.options.dynamic != "align":
            return _NO_VOXELS
        return np.flatnonzero(self._vote(self.merger.passing(self.now, self.window)).hit & ~self.in_body)

    def _unseen_now(self, voxels: NDArray[np.int64]) -> NDArray[np.int64]:
        """Return those of some voxels that the scans just before and after the frame did not see."""
        if not len(voxels):
            return voxels
        return voxels[~self._vote(self.merger.recent(self.now, self.window)).seen(voxels)]

    def _completions(self) -> Iterable[Votes]:
        """Yield the votes of what completes actors: of their mirror images, then of their usual shapes."""
        if not self.regions.actors or self.options.complete == "seen":
            return
        yield self._vote(self.merger.mirrored(self.now, self.window, self.regions)).votes(copy=False)
        if self.options.complete == "body":
            yield self._vote(self.merger.shells(self.now, self.regions)).votes(copy=False)

    def _driven(self, scene: _Scene) -> NDArray[np.int64]:
        """Return the occupied voxels that the recording vehicle drove through at other frames, without the ground and what is there now."""
        apart = float(self.spec.voxel_size[[0, 2]].min()) / 2
        axes = [np.arange(a, b + 1e-9, apart) for a, b in zip(_OWN_LOWER, _OWN_UPPER, strict=True)]
        body = np.stack(np.meshgrid(*axes), axis=-1).reshape(-1, 3)
        path = np.zeros(self.spec.num_voxels, np.bool_)
        for other in self.window:
            if other != self.now.frame:
                mark(body, self.now.grid_T_world @ self.feed.pose(other), self.spec, path)
        voxels = np.flatnonzero(path & (scene.labels > 0))
        solid = ~np.isin(scene.labels[voxels], sorted(self.classes.ground))
        return voxels[solid & ~self._hit_now()[voxels]]

    def _hit_now(self) -> NDArray[np.bool_]:
        """Return the voxels in which the frame's own scan has points, or that belong to an actor at the frame."""
        if self.now.frame not in self.window:
            return self.in_body
        scan = self.merger.scans[self.now.frame]
        return self.in_body | mark(scan.points, self.now.grid_T_world @ scan.world_T_sensor, self.spec)
