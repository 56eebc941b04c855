"""The grid of one frame, merged from the scans of a window."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field, fields
from functools import cached_property, partial

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from carlasc.core.arrays import (
    AnyArray,
    AnyIntArray,
    BoolArray,
    Float32Array,
    Int32Array,
    IntArray,
    LabelArray,
    Uint8Array,
)
from carlasc.core.cells import count_points, joined
from carlasc.core.classes import ClassTable
from carlasc.core.geometry import Transform, invert, transform_points
from carlasc.core.grids import Grid, GridSpec, VoxelFlag
from carlasc.groundtruth.from_scans.actor_voxels import find_voxels
from carlasc.groundtruth.from_scans.feed import ScanFeed
from carlasc.groundtruth.from_scans.merging import (
    STATIC,
    BodyRegions,
    Instant,
    Merger,
    SeenBody,
    passed_by,
)
from carlasc.groundtruth.inputs import FrameData, GridPlan
from carlasc.groundtruth.voting.ballot import Ballot, Observation, SeenClass, Votes
from carlasc.groundtruth.voting.certainty import (
    UNKNOWN,
    ClassConsensus,
    Matter,
    VoxelCertainty,
    agree,
    class_shares,
    is_occupied,
    matter_of,
    probability,
)
from carlasc.groundtruth.voxel_actors import VoxelActors
from carlasc.motion.tracks import MovingActors

# The volume that is inside of any recording vehicle: metres around the sensor.
_OWN_LOWER, _OWN_UPPER = np.array([-2.2, -0.75, -1.2]), np.array([2.2, 0.75, 0.0])
_OWN_PROBABILITY = 0.01
_ABOVE_PROBABILITY = 0.01  # of an unknown voxel above a body
_RETURNED_PROBABILITY = 0.6  # of a voxel with a return of this scan that other scans saw free
# Hits per metre of free path in a voxel with a return of the frame's own scan, below which this
# return is an outlier: with other returns around it, and without.
_OUTLIER_PER_M, _SINGLE_PER_M = 0.02, 0.05  # fact: outlier-per-m
# A voxel of a body with a greater probability is not free, and one with a smaller probability is
# not occupied.
_DOUBTFUL, _UNSURE = 0.05, 0.75  # fact: doubtful
# Height of the space above a body that is taken for free, metres: no scan of one LiDAR sees it, and
# networks that are trained without it put roofs into the air.
_ABOVE_M = 1.2
_NO_VOXELS = np.empty(0, np.int64)


def merge_frame(
    plan: GridPlan, feed: ScanFeed, actors: MovingActors, frame: int, window: list[int]
) -> FrameData:
    """Make the grid of a frame from the scans of a window.

    The result has no fields of the scan, and its votes are without those that complete actors.

    Args:
        plan: geometry of the grid, and how votes are counted.
        feed: the scans of the sequence.
        actors: the moving actors.
        frame: frame number.
        window: frames whose scans are merged; the frame itself need not be one of them.
    """
    merger = feed.merger(actors, frame)
    now = feed.instant(frame)
    options = feed.options
    classes = feed.classes

    # Free space comes from maps, in which each ray is followed once for all frames. The frame's own
    # rays count everywhere, and those of other scans outside of bodies, or in the body of an actor.
    regions = BodyRegions.at(merger, now, window, plan.spec)
    space = feed.free_space(plan)
    space.forget_others(merger.actors.tracks)
    steps = _FrameSteps(plan, feed, merger, now, window, regions)
    own = steps.vote([], [merger.own(now)] if frame in window else [])
    own_free, seen_now = own.free[steps.in_body], own.seen()
    del own  # frees memory for the next ballots
    # The static scene votes in all voxels, and each moving actor in the voxels of its body.
    bodies = list(merger.bodies(now, window, regions))
    ballot = steps.vote([*merger.points(now, window), *(body.points for body in bodies)])
    ballot.free[:] = space.count("scene", now, window)
    ballot.free[steps.in_body] = own_free
    space.add_bodies(bodies, now, ballot.free)
    votes = ballot.votes(copy=False)
    del ballot
    # The votes are whole now: what follows decides, completes and corrects, in this order.
    if plan.rule != "ray":
        whole = votes.to_grid()
        return FrameData(
            {}, whole, votes, None, steps.actors(whole.labels.reshape(-1)), votes.boxes
        )
    consensus = None if options.dynamic == "tube" else agree(votes.occupied, plan.spec, classes)
    made = steps.decide_seen(votes, consensus)

    # In these voxels, free space of rays beside a body or of other times does not count.
    contested = steps.contested()
    recent = merger.recent(now, window) if len(contested) else []
    unseen = contested[space.count("recent", now, recent, contested) == 0]
    doubtful = np.concatenate([regions.hidden, unseen])
    made.forget(doubtful[made.labels[doubtful] == 0])

    # Actors are completed by their mirror images, then by the surfaces of their tracks.
    completed = list[tuple[IntArray, AnyArray]]()
    if regions.actors and options.complete != "seen":
        bodies = list(merger.bodies(now, window, regions, mirror=True))
        mirrored = steps.vote(body.points for body in bodies)
        space.add_bodies(bodies, now, mirrored.free)
        completed.append(steps.complete(made, mirrored.votes(copy=False), bodies))
        if options.complete == "body":
            del mirrored
            shells = steps.vote(merger.shells(now, regions))
            completed.append(steps.complete(made, shells.votes(copy=False), bodies))

    # After completion: an inferred body must not stand where the recording vehicle drove.
    if options.own_path and options.dynamic != "tube":
        driven = steps.driven(made)
        made.labels[driven] = 0
        made.set_probability(driven, _OWN_PROBABILITY)
    # Last, because what the frame's own scan saw is stronger than all inferences above.
    if consensus is not None:
        steps.keep_returns(made, votes, consensus)
    above = _NO_VOXELS
    if consensus is not None and options.complete != "seen":
        above = steps.free_above(made)
    who = steps.actors(made.labels)
    if feed.must_find_ground:  # ground that was found had a class for the votes only
        made.labels[classes.have_role(made.labels, "ground")] = classes.geometry_id
    size = plan.spec.size
    grid = Grid(plan.spec, made.labels.reshape(size), made.counts.reshape(size))
    inferred = np.concatenate([above, *(voxels for voxels, _ in completed)])
    flags = steps.flags(inferred, contested, seen_now).reshape(size)
    if made.occupied is None:
        return FrameData({}, grid, votes, None, who, votes.boxes, flags)
    shares = _join_shares(votes, consensus, completed, classes)
    views = space.count("views", now, window)
    views[steps.in_body] = 0  # rays of other times
    np.maximum.at(views, votes.occupied["voxel"], votes.occupied["voters"])
    np.maximum(views, made.counts > 0, out=views)  # free space is summed over smaller cells
    views_of_voxels = views.astype(np.uint16).reshape(size)
    evidence = VoxelCertainty(made.occupied.reshape(size), shares, views_of_voxels)
    return FrameData({}, grid, votes, evidence, who, votes.boxes, flags)


def _join_shares(
    votes: Votes,
    consensus: ClassConsensus | None,
    completed: list[tuple[IntArray, AnyArray]],
    classes: ClassTable,
) -> AnyArray:
    """Return the shares of classes: from the consensus of scans, and for completed voxels from the
    votes that completed them.
    """
    seen = class_shares(votes.occupied, classes) if consensus is None else consensus.shares
    later = [class_shares(hits, classes) for _, hits in completed]
    taken = np.concatenate([_NO_VOXELS, *(hits["voxel"] for hits in later)])
    joined = np.concatenate([seen[~_among(seen["voxel"], taken)], *later])
    return joined[np.argsort(joined["voxel"], kind="stable")]


# whether voxels are among others: by a table, as a sort takes many times as long
_among = partial(np.isin, kind="table")


def _are_alone(voxels: IntArray, others: IntArray, spec: GridSpec) -> BoolArray:
    """Return which of (N,) voxels, flat indices, have none of (M,) other voxels among the 26 around
    them; they are among the others themselves.
    """
    taken = np.zeros(np.add(spec.size, 2), np.bool_)
    taken[1:-1, 1:-1, 1:-1].flat[others] = True
    around = sliding_window_view(taken, (3, 3, 3))
    return around[np.unravel_index(voxels, spec.size)].sum(axis=(1, 2, 3)) == 1


def find_above(solid: BoolArray, known: BoolArray, bodies: BoolArray, spec: GridSpec) -> IntArray:
    """Return the unknown voxels above bodies whose tops were seen.

    A body is a group of columns that touch. Its top was seen if a voxel above it is free: rays
    passed there, and nothing of the body stopped them. Columns beside a body count too, because a
    body fills its outer voxels in part. Nothing above a solid voxel is taken for free.

    Args:
        solid: (V,) bool, occupied voxels.
        known: (V,) bool, free and occupied voxels.
        bodies: (V,) bool, the voxels of vehicles and people.
        spec: the grid.

    Returns:
        Flat indices, increasing.
    """
    nx, ny, levels = spec.size
    solid, known, bodies = (voxels.reshape(-1, levels) for voxels in (solid, known, bodies))
    columns = np.flatnonzero(bodies.any(axis=1))
    # two more columns in a row: the last of one does not touch the first of the next
    rows, places = np.divmod(columns, ny)
    group = joined(rows * (ny + 2) + places, np.ones(len(columns), bool), ny + 2)
    top, passed = np.full((2, len(columns)), -1)
    np.maximum.at(top, group, _highest(bodies[columns]))
    np.maximum.at(passed, group, _highest(known[columns] & ~solid[columns]))

    roofs = np.full((nx + 2, ny + 2), -1)
    roofs[rows + 1, places + 1] = own = np.where(passed > top, top, -1)[group]
    wide = np.maximum.reduce([roofs[:-2], roofs[1:-1], roofs[2:]])
    roof = np.maximum.reduce([wide[:, :-2], wide[:, 1:-1], wide[:, 2:]]).reshape(-1)
    roof[columns] = own
    chosen = np.flatnonzero(roof >= 0)
    over = np.arange(levels) - roof[chosen, None]
    above = (over > 0) & (over <= round(_ABOVE_M / float(spec.voxel_size[2])))
    covered = np.logical_or.accumulate(above & solid[chosen], axis=1)
    column, level = np.nonzero(above & ~covered & ~known[chosen])
    return chosen[column] * levels + level


def _highest(voxels: BoolArray) -> IntArray:
    """Return the highest level of the voxels in each of (C, Z) columns, -1 without one."""
    return np.where(voxels, np.arange(voxels.shape[1]), -1).max(axis=1)


@dataclass(frozen=True)
class _VoxelEvidence:
    """The evidence of N voxels from votes.

    Attributes:
        voxels: (N,) flat indices, increasing.
        labels: (N,) most frequent class of the hits, 0 without hits.
        hits: (N,) points.
        free: (N,) free samples.
        matter: (N,) kind of matter: see `Matter`.
    """

    voxels: IntArray
    labels: LabelArray
    hits: AnyIntArray
    free: AnyIntArray
    matter: NDArray[np.int8]

    @property
    def counts(self) -> AnyIntArray:
        """(N,) hits and free samples."""
        return self.hits + self.free

    def at(self, chosen: BoolArray) -> _VoxelEvidence:
        """Return the evidence of some of the voxels."""
        return _VoxelEvidence(*(getattr(self, field.name)[chosen] for field in fields(self)))


@dataclass
class _UnfinishedGrid:
    """The unfinished grid of a frame.

    Attributes:
        labels: (V,) classes.
        counts: (V,) hits and free samples; 0 means unknown.
        occupied: (V,) float32, probability that the voxel is occupied; None if it is not needed.
        passed: (P,) flat indices of unknown voxels whose mirror images rays passed through.
    """

    labels: LabelArray
    counts: LabelArray
    occupied: Float32Array | None = None
    passed: IntArray = field(default_factory=lambda: _NO_VOXELS)

    def forget(self, voxels: AnyIntArray) -> None:
        """Make voxels unknown."""
        self.labels[voxels] = self.counts[voxels] = 0
        self.set_probability(voxels, UNKNOWN)

    def set_probability(self, voxels: AnyIntArray, probability: Float32Array | float) -> None:
        """Set the probability that voxels are occupied, if it is needed."""
        if self.occupied is not None:
            self.occupied[voxels] = probability


@dataclass(frozen=True)
class _FrameSteps:
    """The steps of `merge_frame`."""

    plan: GridPlan
    feed: ScanFeed
    merger: Merger
    now: Instant
    window: list[int]
    regions: BodyRegions

    @cached_property
    def in_body(self) -> BoolArray:
        """(V,) bool: the voxels of bodies."""
        return self.regions.of_voxel != STATIC

    @cached_property
    def grid_T_sensor(self) -> dict[int, Transform]:
        """(4, 4) pose of the sensor at each other frame of the window."""
        others = [frame for frame in self.window if frame != self.now.frame]
        return {frame: self.now.grid_T_world @ self.feed.pose(frame) for frame in others}

    @cached_property
    def returned(self) -> tuple[IntArray, Int32Array]:
        """The voxels with points of the frame's own scan, increasing, and their numbers of points;
        none if the scan is not merged.
        """
        return self._returned(slice(None if self.now.frame in self.window else 0))

    def _returned(self, chosen: BoolArray | slice) -> tuple[IntArray, Int32Array]:
        points = self.merger.settled(self.now.frame).points[chosen]
        now = self.now
        pose = now.grid_T_world @ self.feed.pose(now.frame)
        counts = count_points(points, [pose], self.plan.spec)
        voxels = np.flatnonzero(counts)
        return voxels, counts[voxels]

    def decide_seen(self, votes: Votes, consensus: ClassConsensus | None) -> _UnfinishedGrid:
        """Return the grid from the votes for the static scene and in the bodies of actors, with the
        classes of the consensus.
        """
        evidence = self.plan.needs_evidence
        labels, hits = votes.elect_occupied()
        if consensus is not None:
            labels = consensus.labels.copy()
        free = votes.free.reshape(-1)
        bodies = np.flatnonzero(self.in_body)
        bodies = bodies[np.isin(self.regions.of_voxel[bodies], list(self.regions.actors))]
        # Before `labels` is overwritten by decisions: doubt is about the class that was seen.
        doubtful = self._doubtful(self._evidence(votes, labels, hits, bodies))
        voted = self._evidence(
            votes, labels, hits, np.flatnonzero((labels > 0) | (free > 0) if evidence else labels)
        )
        labels[voted.voxels] = self._decide(voted)
        counts = np.add(hits, free, out=hits)
        made = _UnfinishedGrid(labels, counts)
        if evidence:
            made.occupied = np.full(len(labels), UNKNOWN, np.float32)
            made.occupied[voted.voxels] = self._probability(voted)
        made.forget(doubtful)
        return made

    def _doubtful(self, evidence: _VoxelEvidence) -> IntArray:
        """Return the voxels of bodies with an uncertain decision: free ones that may be occupied,
        and actors that may be free.
        """
        likely = self._probability(evidence)
        is_free = self._decide(evidence) == 0
        unsure = np.where(
            is_free, likely > _DOUBTFUL, (likely < _UNSURE) & (evidence.matter == Matter.BODY)
        )
        return evidence.voxels[(evidence.counts > 0) & unsure]

    def complete(
        self, made: _UnfinishedGrid, votes: Votes, bodies: Iterable[SeenBody]
    ) -> tuple[IntArray, AnyArray]:
        """Complete unknown voxels of bodies by votes; return these voxels and their votes.

        Voxels with free votes stay unknown, and those through which rays passed at this time.

        Args:
            made: the grid.
            votes: the votes.
            bodies: what scans saw of each body, as mirror images.
        """
        inferred = self._evidence(votes, *votes.elect_occupied(), np.flatnonzero(self.in_body))
        # A mirrored side is less certain than a seen one, and has its own calibration.
        inferred.matter[inferred.matter == Matter.BODY] = Matter.MIRRORED
        unseen = _among(inferred.voxels, self.regions.hidden_ends) & (inferred.hits == 0)
        unseen |= _among(inferred.voxels, made.passed) | _among(inferred.voxels, self.returned[0])
        inferred = inferred.at(
            (made.counts[inferred.voxels] == 0) & (inferred.counts > 0) & ~unseen
        )
        is_there = self._decide(inferred) > 0
        is_there[is_there] = ~self._passed(bodies, inferred.voxels[is_there])
        # Rays passed through these mirrored voxels: the surfaces of the next step do not fill them.
        made.passed = inferred.voxels[~is_there]
        inferred = inferred.at(is_there)
        made.labels[inferred.voxels] = inferred.labels
        made.counts[inferred.voxels] = inferred.counts
        made.set_probability(inferred.voxels, self._probability(inferred))
        return inferred.voxels, votes.occupied[_among(votes.occupied["voxel"], inferred.voxels)]

    def _passed(self, bodies: Iterable[SeenBody], voxels: IntArray) -> BoolArray:
        """Return (N,) bool: the voxels of bodies, flat indices, through whose middle rays of the
        frame or of its neighbours passed.
        """
        passed = np.zeros(len(voxels), np.bool_)
        world = transform_points(self.now.world_T_grid, self.plan.spec.centers_of(voxels))
        size_m = float(self.plan.spec.voxel_size[[0, 2]].min())
        recent = set(self.merger.recent(self.now, self.window))
        for body in bodies:
            own = np.flatnonzero(self.regions.of_voxel[voxels] == body.points.region)
            centers = transform_points(invert(body.world_T_actor), world[own]) * (1, -1, 1)
            for frame in recent & body.casts.keys():
                passed[own] |= passed_by(*body.casts[frame][:3], centers, size_m)
        return passed

    def actors(self, labels: AnyIntArray) -> VoxelActors | None:
        """Return the actors in the voxels of (V,) classes; None unless the plan needs them."""
        if not self.plan.voting.keep_actors:
            return None
        merger = self.merger
        return find_voxels(
            self.plan.spec, self.feed, merger.actors, self.now, self.regions, self.window, labels
        )

    def flags(self, inferred: IntArray, contested: IntArray, seen_now: BoolArray) -> Uint8Array:
        """Return (V,) uint8: the flags of each voxel."""
        flags = seen_now * np.uint8(VoxelFlag.SEEN_NOW)
        flags |= self.in_body * np.uint8(VoxelFlag.IN_ACTOR)
        flags[inferred] |= np.uint8(VoxelFlag.INFERRED)
        flags[contested] |= np.uint8(VoxelFlag.CONTESTED)
        return flags

    def vote(self, points: Iterable[SeenClass], observations: Iterable[Observation] = ()) -> Ballot:
        """Return the votes of points without rays, and of observations."""
        ballot = Ballot(
            self.plan.spec,
            self.feed.classes,
            rule=self.plan.rule,
            free_step_m=self.plan.voting.free_step_m,
            keep_boxes=self.plan.voting.keep_seen,
        )
        for observation in observations:
            ballot.add(observation)
        ballot.add_points(points)
        return ballot

    def _evidence(
        self, votes: Votes, labels: AnyArray, hits: AnyArray, voxels: IntArray
    ) -> _VoxelEvidence:
        """Return the evidence of some voxels; `labels`, `hits`: from `Votes.elect_occupied`."""
        labels = labels[voxels]
        matter = matter_of(labels, self.in_body[voxels], self.feed.classes)
        return _VoxelEvidence(voxels, labels, hits[voxels], votes.free.reshape(-1)[voxels], matter)

    def _decide(self, evidence: _VoxelEvidence) -> LabelArray:
        if self.feed.options.dynamic == "tube":
            return evidence.labels
        free_m = evidence.free * self.plan.voting.free_step_m
        return np.where(
            is_occupied(evidence.hits, free_m, evidence.matter), evidence.labels, 0
        ).astype(evidence.labels.dtype)

    def _probability(self, evidence: _VoxelEvidence) -> Float32Array:
        step = self.plan.voting.free_step_m
        return probability(
            evidence.hits,
            evidence.free * step,
            evidence.matter,
            self.in_body[evidence.voxels],
            self.plan.spec,
            step,
        )

    def contested(self) -> IntArray:
        """Return the voxels outside of bodies that moving points are in at other times."""
        if self.feed.options.dynamic != "align":
            return _NO_VOXELS
        spec = self.plan.spec
        found = np.zeros(spec.num_voxels, np.int32)
        for frame, pose in self.grid_T_sensor.items():
            count_points(self.merger.moving(frame), [pose], spec, found)
        return np.flatnonzero((found > 0) & ~self.in_body)

    def keep_returns(self, made: _UnfinishedGrid, votes: Votes, consensus: ClassConsensus) -> None:
        """Make voxels with returns of the frame's own scan occupied, unless the returns are
        outliers. Other scans do not count here.
        """
        if self.now.frame not in self.window:
            return
        # Other scans may have seen such a voxel free, as a thin object in it stops few rays. A
        # return is an outlier only if very many rays passed; fewer are enough if it is alone.
        returned, returns = self.returned
        if self.merger.dynamic == "drop":
            returned, returns = self._returned(self.merger.static(self.now.frame))
        is_lost = (made.labels[returned] == 0) & (consensus.labels[returned] > 0)
        lost = returned[is_lost]
        is_single = (returns[is_lost] == 1) & _are_alone(lost, returned, self.plan.spec)
        rows = votes.occupied[_among(votes.occupied["voxel"], lost)]
        hits = np.bincount(np.searchsorted(lost, rows["voxel"]), rows["votes"], len(lost))
        free = votes.free.reshape(-1)[lost]
        enough = np.where(is_single, _SINGLE_PER_M, _OUTLIER_PER_M) * self.plan.voting.free_step_m
        is_kept = hits >= enough * free
        kept = lost[is_kept]
        made.labels[kept] = consensus.labels[kept]
        made.counts[kept] = (hits + free)[is_kept]
        made.set_probability(kept, _RETURNED_PROBABILITY)

    def free_above(self, made: _UnfinishedGrid) -> IntArray:
        """Make unknown voxels above vehicles and people free; return them."""
        classes, solid = self.feed.classes, made.labels > 0
        voxels = np.flatnonzero(solid)
        labels = made.labels[voxels]
        are_bodies = self.in_body[voxels] & ~classes.have_role(labels, "ground")
        if self.feed.has_labels:
            are_bodies |= classes.have_role(labels, "movable")
        bodies = np.zeros_like(solid)
        bodies[voxels[are_bodies]] = True
        voxels = find_above(solid, made.counts > 0, bodies, self.plan.spec)
        made.counts[voxels] = 1
        made.set_probability(voxels, _ABOVE_PROBABILITY)
        return voxels

    def driven(self, made: _UnfinishedGrid) -> IntArray:
        """Return the occupied voxels on the ego path of other frames, without ground, bodies and
        returns of the frame's own scan.
        """
        # Samples of the vehicle's volume are half a voxel apart, so that none is left out.
        apart = float(self.plan.spec.voxel_size[[0, 2]].min()) / 2
        axes = [np.arange(a, b + 1e-9, apart) for a, b in zip(_OWN_LOWER, _OWN_UPPER, strict=True)]
        body = np.stack(np.meshgrid(*axes), axis=-1).reshape(-1, 3)
        path = count_points(body, self.grid_T_sensor.values(), self.plan.spec)
        voxels = np.flatnonzero(path)
        voxels = voxels[made.labels[voxels] > 0]
        solid = ~self.feed.classes.have_role(made.labels[voxels], "ground")
        is_there_now = self.in_body[voxels] | _among(voxels, self.returned[0])
        return voxels[solid & ~is_there_now]
