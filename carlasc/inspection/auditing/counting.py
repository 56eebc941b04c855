"""Counting frames: the counts of a frame are added to sums, so that memory does not grow with the
number of frames.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from carlasc.core.arrays import (
    AnyFloatArray,
    AnyIntArray,
    BoolArray,
    Float32Array,
    FloatArray,
    IntArray,
    LabelArray,
    Uint8Array,
)
from carlasc.core.cells import first_of_cells
from carlasc.core.geometry import invert, thin, transform_points
from carlasc.core.scans import Scan
from carlasc.errors import CarlascError
from carlasc.inspection.auditing.geometry import Family, families
from carlasc.inspection.auditing.loops import crossings, grown, voxels_at
from carlasc.inspection.auditing.matching import MatchedGrids
from carlasc.inspection.auditing.verdicts import Sums, add
from carlasc.inspection.heldout_scores import BANDS_M, lowest_of_columns
from carlasc.inspection.points_in_voxels import labels_at
from carlasc.motion.tracks import FIRST_FOUND, MovingActors, Track

HEIGHTS = 4  # shares are also computed for this number of layers of equal height
MAX_ID = 511  # larger ids of classes count as this one
# points of a frame that are thinned evenly in space, and rays that are followed
_SPREAD, _RAYS = (20_000, 8000)
# points that are kept of these in a frame, and in all frames
_LEAST, _MOST, _IN_ALL = (500, 2500, 250_000)
# frames before and after, in which the paths of actors are checked
_TIMES = (*range(-20, -1, 2), *range(2, 21, 2))
_APART = 20  # frames between the scans that show a drift
_CLEAR_RAYS = 3  # an occupied voxel that this number of rays cross is a phantom
# an actor may be larger than its body by this, because bodies are measured on a few sides only
_AROUND_M = 0.6
# the path of an actor is narrower than its body by this, and as far above the ground
_INSET_M = 0.2
_MEMBERS = 5  # an actor counts if it is seen in this number of voxels
_KEPT = 14  # number of scans kept in memory for later frames
FREE, OCCUPIED, PHANTOM, TRAIL, FALSE_FREE = range(5)
"""The states of voxels that `add_frame` returns."""


@dataclass
class _Frame:
    """A grid and its scan; `voxels` is -1 for points outside of the grid, and for points that are
    no returns.
    """

    number: int
    scan: Scan
    points: FloatArray  # (N, 3) in the frame of the grid
    voxels: IntArray
    labels: LabelArray  # (X, Y, Z)
    occupied: BoolArray
    known: BoolArray | None
    crossed: IntArray
    turns: bool  # whether the grid is cylindrical

    @cached_property
    def hit(self) -> BoolArray:
        """(X, Y, Z) which voxels hold a return."""
        hit = np.zeros(self.occupied.size, np.bool_)
        hit[self.voxels[self.voxels >= 0]] = True
        return hit.reshape(self.occupied.shape)

    @cached_property
    def around(self) -> BoolArray:
        """(X, Y, Z) these voxels and their neighbours."""
        return grown(self.hit, self.turns)


@dataclass
class FrameCounter:
    """Counts the frames of one sequence. It pickles into workers.

    Attributes:
        matched: the grids and their scans.
        actors: the moving actors of the recording.
        window: first and last scan that the grids were made from, relative to the frame; None if
            that is not known.
    """

    matched: MatchedGrids
    actors: MovingActors
    window: tuple[int, int] | None = None
    _scans: dict[int, Scan] = field(default_factory=dict, init=False, repr=False)
    _spread: dict[int, FloatArray] = field(default_factory=dict, init=False, repr=False)

    def add_frame(self, sums: Sums, number: int, frame: int) -> Uint8Array:
        """Add a frame to sums, and return the states of its voxels.

        Args:
            sums: sums of the frames before.
            number: number of the grid.
            frame: number of the scan.

        Raises:
            CarlascError: the grid or the scan cannot be read.
        """
        seen = self._read(number, frame)
        add(sums, "frames", [1, seen.known is None])
        add(sums, "fits", self._fits(seen))
        self._add_classes(sums, seen)
        self._add_unknown(sums, seen)
        self._add_held_out(sums, seen)
        kinds = np.where(seen.occupied, OCCUPIED, FREE).astype(np.uint8)
        kinds[self._add_phantoms(sums, seen)] = PHANTOM
        kinds[self._add_actors(sums, seen)] = TRAIL
        kinds[self._add_false_free(sums, seen)] = FALSE_FREE
        return kinds

    def _read(self, number: int, frame: int) -> _Frame:
        spec, scan = self.matched.spec, self._scan(frame)
        labels, occupied, known = self.matched.read(number)
        points, returns = self.matched.place(scan.points), _are_returns(scan)
        rays = np.flatnonzero(returns)
        rays = rays[:: max(1, len(rays) // _RAYS)]
        begun = scan.others.get("origins", np.zeros_like(scan.points))[rays]
        margin = 1.5 * float(np.linalg.norm(spec.voxel_size[[0, 0, 2]]))
        crossed = crossings(self.matched.place(begun), points[rays], spec, margin)
        voxels = np.where(returns, spec.flat_index(points), -1)
        kinds = labels if labels.dtype == np.uint8 else np.minimum(labels, MAX_ID)
        turns = spec.coordinates == "cylindrical"
        return _Frame(frame, scan, points, voxels, kinds, occupied, known, crossed, turns)

    def _scan(self, frame: int) -> Scan:
        if frame not in self._scans:
            self._scans[frame] = self.matched.scans.scan(frame, ("labels", "instances", "origins"))
            while len(self._scans) > _KEPT:
                self._scans.pop(next(iter(self._scans)))
        return self._scans[frame]

    # Geometry

    @cached_property
    def _families(self) -> list[Family]:
        return families(self.matched.spec)

    def _fits(self, seen: _Frame) -> IntArray:
        """Return (H, 2) points, and those in occupied voxels, under all corrections of all
        families.
        """
        drift, lag = self._families[-2:]
        own = self._fit_points(seen.number)
        counts = [self._fit(seen, family.warps, own) for family in self._families[:-2]]
        drifts = np.zeros((len(drift.values), 2), np.int64)
        for other in (seen.number - _APART, seen.number + _APART):
            if (placed := self._standing(seen.number, other)) is not None:
                later_s = self._second(other) - self._second(seen.number)
                drifts += self._fit(seen, drift.warps, thin(placed, self._most), later_s)
        lags = [
            self._fit(seen, lag.warps[:1], self._fit_points(seen.number + int(value)))
            for value in lag.values
        ]
        return np.concatenate([*counts, drifts, *lags])

    def _fit(
        self,
        seen: _Frame,
        warps: FloatArray,
        points: FloatArray,
        later_s: float = 0.0,
    ) -> IntArray:
        at_points = labels_at(
            points, self.matched.spec, seen.occupied, warps=warps, later_s=later_s
        )
        occupied = (at_points[:, 0] > 0).sum(axis=1)
        return np.column_stack([np.full(len(warps), len(points)), occupied])

    @property
    def _most(self) -> int:
        return int(np.clip(_IN_ALL // len(self.matched.frames), _LEAST, _MOST))

    def _fit_points(self, frame: int) -> FloatArray:
        """Return (N, 3) points of a scan inside the grid, thinned evenly in space; none if it
        cannot be read.
        """
        if frame not in self._spread:
            spec, edge = self.matched.spec, float(self.matched.spec.voxel_size[[0, 2]].min()) / 2
            scan = self._other(frame)
            some = (
                np.empty((0, 3), np.float32)
                if scan is None
                else thin(scan.points[_are_returns(scan)], _SPREAD)
            )
            points = self.matched.place(
                some[first_of_cells(np.floor(some / edge).astype(np.int64))]
            )
            self._spread[frame] = thin(points[spec.flat_index(points) >= 0], self._most)
            while len(self._spread) > _KEPT:
                self._spread.pop(next(iter(self._spread)))
        return self._spread[frame]

    # Scans at other times

    def _other(self, frame: int) -> Scan | None:
        """Return the scan of another frame; None if it does not exist or cannot be read (its own
        frame reports the error).
        """
        try:
            return None if self._row(frame) is None else self._scan(frame)
        except (CarlascError, OSError):
            return None

    def _row(self, frame: int) -> int | None:
        frames = self.matched.trajectory[0]
        row = int(np.searchsorted(frames, frame))
        return row if row < len(frames) and int(frames[row]) == frame else None

    def _second(self, frame: int) -> float:
        return float(self.matched.trajectory[1][self._row(frame)])

    def _grid_T_world(self, frame: int) -> FloatArray | None:
        poses = self.matched.trajectory[2]
        return None if poses is None else self.matched.grid_T_scan @ invert(poses[self._row(frame)])

    def _standing(self, frame: int, other: int) -> FloatArray | None:
        """Return (N, 3) returns of another scan inside the grid of a frame, without classes that
        can move; None without the scan.
        """
        grid_T_world, poses = self._grid_T_world(frame), self.matched.trajectory[2]
        if grid_T_world is None or poses is None or (scan := self._other(other)) is None:
            return None
        keep = _are_returns(scan)
        if scan.labels is not None:
            keep &= ~np.isin(scan.labels, sorted(self.matched.scans.metadata.classes.movable))
        placed = transform_points(
            grid_T_world @ poses[self._row(other)], thin(scan.points[keep], _SPREAD)
        )
        return placed[self.matched.spec.flat_index(placed) >= 0]

    def _add_held_out(self, sums: Sums, seen: _Frame) -> None:
        """Count static returns of the nearest scans that took no part in the grid."""
        if self.window is None or seen.known is None:
            return
        for other in (seen.number + self.window[0] - 1, seen.number + self.window[1] + 1):
            if (placed := self._standing(seen.number, other)) is not None:
                at_points = labels_at(placed, self.matched.spec, seen.occupied, seen.known)
                add(sums, "held out", [(at_points >= 0).sum(), (at_points == 0).sum()])

    # Contents

    def _add_classes(self, sums: Sums, seen: _Frame) -> None:
        """Count the classes of the grid, points by their class and the class of their voxel, and
        columns with ground at one and at two heights.
        """
        lookup, labels = self.matched.lookup, seen.scan.labels
        add(
            sums,
            "classes of grids",
            np.bincount(seen.labels[seen.occupied].astype(np.int64), minlength=MAX_ID + 1),
        )
        if self.matched.ground:
            ground = seen.occupied & np.isin(seen.labels, self.matched.ground)
            layers = (ground & ~np.pad(ground, ((0, 0), (0, 0), (1, 0)))[:, :, :-1]).sum(axis=2)
            add(sums, "ground columns", [(layers > 0).sum(), (layers > 1).sum()])
        if labels is not None and lookup is not None and self.matched.classes is not None:
            size = min(self.matched.classes.num_channels, MAX_ID + 1)
            own = lookup[np.minimum(labels.astype(np.int64), len(lookup) - 1)]
            both = np.flatnonzero((seen.voxels >= 0) & (own >= 0) & (own < size))
            both = both[seen.occupied.reshape(-1)[seen.voxels[both]]]
            # an id without a name
            met = np.minimum(seen.labels.reshape(-1)[seen.voxels[both]].astype(np.int64), size)
            confusion = np.bincount(own[both] * (size + 1) + met, minlength=(size + 1) ** 2)
            add(sums, "confusion", confusion.reshape(size + 1, size + 1))

    def _add_false_free(self, sums: Sums, seen: _Frame) -> BoolArray:
        """Count returns in free voxels by class, distance and height, and return these voxels."""
        wrong = np.zeros(seen.occupied.shape, np.bool_)
        if seen.known is not None:
            at_points = labels_at(seen.points, self.matched.spec, seen.occupied, seen.known)[0, 0]
            own = np.flatnonzero((at_points >= 0) & (seen.voxels >= 0))
            free = at_points[own] == 0
            wrong.reshape(-1)[seen.voxels[own[free]]] = True
            kinds = (
                np.zeros(len(own), np.int64) if seen.scan.labels is None else seen.scan.labels[own]
            )
            self._add_by(sums, "returns", kinds, seen.points[own], free)
        return wrong

    def _add_phantoms(self, sums: Sums, seen: _Frame) -> BoolArray:
        """Count occupied voxels that rays see, and those that rays cross, by class, distance and
        height; return the crossed ones.
        """
        spec, clear = self.matched.spec, seen.crossed >= _CLEAR_RAYS
        wrong = seen.occupied & clear & ~seen.around
        # rays near the ground cross its voxels for metres
        wrong &= ~(
            np.isin(seen.labels, self.matched.ground)
            if self.matched.ground
            else lowest_of_columns(seen.occupied)
        )
        looked = np.nonzero(seen.occupied & (clear | seen.hit))
        centers = spec.from_axes(
            np.array(spec.lower) + (np.column_stack(looked) + 0.5) * spec.voxel_size
        )
        self._add_by(sums, "seen voxels", seen.labels[looked], centers, wrong[looked])
        return wrong

    def _add_by(
        self,
        sums: Sums,
        name: str,
        kinds: AnyIntArray,
        points: AnyFloatArray,
        wrong: BoolArray,
    ) -> None:
        """Add (K, B, H, 2) counts by class, distance and height: all, and the wrong ones."""
        low, high = self.matched.spec.lower[2], self.matched.spec.upper[2]
        heights = np.clip((points[:, 2] - low) / (high - low) * HEIGHTS, 0, HEIGHTS - 1).astype(
            np.int64
        )
        bands = np.searchsorted(BANDS_M, np.linalg.norm(points, axis=1), side="right") - 1
        shape = (MAX_ID + 1, len(BANDS_M) - 1, HEIGHTS, 2)
        cells = np.ravel_multi_index(
            (np.minimum(kinds.astype(np.int64), MAX_ID), bands, heights, wrong.astype(np.int64)),
            shape,
        )
        counts = np.bincount(cells, minlength=int(np.prod(shape))).reshape(shape)
        add(sums, name, np.stack([counts.sum(axis=3), counts[..., 1]], axis=3))

    def _add_unknown(self, sums: Sums, seen: _Frame) -> None:
        """Count unknown voxels by cause: they hold a return, a ray crosses them, they are outside
        of the view, or hidden.
        """
        if seen.known is None or not seen.hit.any():
            return
        points = seen.points[seen.voxels >= 0]
        angles = np.arctan2(
            points[:, 2] - self.matched.height_m, np.hypot(points[:, 0], points[:, 1])
        )
        rest = ~seen.known & ~seen.hit & (seen.crossed == 0)
        view = (self._elevations >= angles.min()) & (self._elevations <= angles.max())
        crossed = ~seen.known & ~seen.hit & (seen.crossed > 0)
        causes = [~seen.known & seen.hit, crossed, rest & ~view, rest & view]
        add(sums, "unknown", [seen.known.size, *(cause.sum() for cause in causes)])

    @cached_property
    def _elevations(self) -> Float32Array:
        x, y, z = np.moveaxis(
            self.matched.spec.from_axes(self.matched.spec.centers().reshape(-1, 3)), -1, 0
        )
        return np.arctan2(z - self.matched.height_m, np.hypot(x, y), dtype=np.float32).reshape(
            self.matched.spec.size
        )

    # Actors

    def _add_actors(self, sums: Sums, seen: _Frame) -> BoolArray:
        """Count voxels, and occupied voxels, on the path and on the body of each actor; return the
        occupied voxels of paths.
        """
        trails, flat = np.zeros(seen.occupied.size, np.bool_), seen.occupied.reshape(-1)
        for name, members in self._members(seen):
            own = np.unique(seen.voxels[members])
            own = own[own >= 0]
            if len(own) >= _MEMBERS:
                add(sums, f"actor {name}", [0, 0, len(own), flat[own].sum(), 1])
        if (grid_T_world := self._grid_T_world(seen.number)) is not None:
            wide = max(float(self.matched.spec.voxel_size[0]), _AROUND_M)
            # a voxel with a return of the scan is rightly occupied
            here = seen.around.reshape(-1).copy()
            for track in self.actors.tracks.values():
                here[self._body(track, [seen.number], grid_T_world, wide)] = True
            for number, track in self.actors.tracks.items():
                path = self._body(track, [seen.number + k for k in _TIMES], grid_T_world, -_INSET_M)
                path = path[~here[path]]
                if len(path):
                    trails[path[flat[path]]] = True
                    add(
                        sums,
                        f"actor {_name(number, track)}",
                        [len(path), flat[path].sum(), 0, 0, 0],
                    )
        return trails.reshape(seen.occupied.shape)

    def _members(self, seen: _Frame) -> list[tuple[str, AnyIntArray]]:
        """Return the points of each actor in a scan, by instances or by tracks."""
        ids, labels = seen.scan.instances, seen.scan.labels
        if ids is None or not ids.any():
            tracks = self.actors.tracks.items()
            return [
                (_name(n, t), t.members[seen.number]) for n, t in tracks if seen.number in t.members
            ]
        order = np.argsort(ids, kind="stable")
        actors, starts = np.unique(ids[order], return_index=True)
        movable = sorted(self.matched.scans.metadata.classes.movable)
        parts = zip(actors.tolist(), np.split(order, starts[1:]), strict=True)
        return [
            (str(i), own)
            for i, own in parts
            if i and (labels is None or np.isin(labels[own], movable).all())
        ]

    def _body(
        self,
        track: Track,
        frames: Sequence[int],
        grid_T_world: FloatArray,
        margin_m: float,
    ) -> IntArray:
        """Return the voxels in the body of an actor at some frames, wider by a margin.

        A negative margin also leaves out the lowest voxel.
        """
        spec = self.matched.spec
        poses = [pose for frame in frames if (pose := track.pose(frame)) is not None]
        lower, upper = track.lower - margin_m, track.upper + margin_m
        if margin_m < 0:
            lower[2] = track.lower[2] + float(spec.voxel_size[2])
        if not poses or (upper <= lower).any():
            return np.empty(0, np.int64)
        edge = float(spec.voxel_size[[0, 2]].min()) / 1.5
        lines = [
            np.linspace(a, b, max(2, round((b - a) / edge) + 1))
            for a, b in zip(lower, upper, strict=True)
        ]
        lattice = np.stack(np.meshgrid(*lines, indexing="ij"), axis=-1).reshape(-1, 3)
        return voxels_at(lattice, grid_T_world @ np.stack(poses), spec)


def _are_returns(scan: Scan) -> BoolArray:
    """Return (N,) which points are returns: some sensors write (0, 0, 0) where there is none."""
    x, y, z = scan.points.T
    return np.asarray((x != 0) | (y != 0) | (z != 0))


def _name(number: int, track: Track) -> str:
    is_named = 0 < track.instance < FIRST_FOUND
    return (
        str(track.instance)
        if is_named
        else f"of track {number}, first seen in scan {min(track.members, default=track.first)}"
    )
