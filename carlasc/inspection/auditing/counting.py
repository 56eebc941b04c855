"""Counting frames: the counts of a frame are added to sums, so that memory does not grow with the
number of frames.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import cached_property, lru_cache, partial

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
from carlasc.core.cells import Cells, count_points, find_voxel, first_of_cells
from carlasc.core.compiling import cached
from carlasc.core.geometry import invert, thin, transform_points
from carlasc.core.grids import GridSpec
from carlasc.core.scans import Scan
from carlasc.errors import tried_twice
from carlasc.inspection.auditing.geometry import families
from carlasc.inspection.auditing.matching import MatchedGrids
from carlasc.inspection.auditing.verdicts import Sums, add
from carlasc.inspection.heldout_scores import BANDS_M, depth_errors, lowest_of_columns
from carlasc.inspection.points_in_voxels import labels_at
from carlasc.motion.tracks import FIRST_FOUND, MovingActors, Track

HEIGHTS = 4  # shares are also computed for this number of layers of equal height
MAX_ID = 511  # larger ids of classes count as this one
# points of a frame that are thinned evenly in space, and rays that are followed
_SPREAD = 20_000
_RAYS = 8000
# points that are kept of these in a frame, and in all frames
_LEAST = 500
_MOST = 2500
_IN_ALL = 250_000
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
    errors_m: FloatArray | None  # of the depth of its rays; None in a cylindrical grid

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
    # points of scans: the counter of a stretch of frames needs few of them
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
        if seen.errors_m is not None:
            add(sums, "depth", [len(seen.errors_m), np.rint(1000 * seen.errors_m).sum()])
        kinds = np.where(seen.occupied, OCCUPIED, FREE).astype(np.uint8)
        kinds[self._add_phantoms(sums, seen)] = PHANTOM
        kinds[self._add_actors(sums, seen)] = TRAIL
        kinds[self._add_false_free(sums, seen)] = FALSE_FREE
        return kinds

    def _read(self, number: int, frame: int) -> _Frame:
        spec = self.matched.spec
        scan = self._scan(frame)
        labels, occupied, known = self.matched.read(number)
        points = self.matched.place(scan.points)
        returns = _are_returns(scan)
        rays = np.flatnonzero(returns)
        rays = rays[:: max(1, len(rays) // _RAYS)]
        begun = scan.others.get("origins", np.zeros_like(scan.points))[rays]
        margin = 1.5 * float(np.linalg.norm(spec.voxel_size[[0, 0, 2]]))
        begun = self.matched.place(begun)
        crossed = crossings(begun, points[rays], spec, margin)
        voxels = np.where(returns, spec.flat_index(points), -1)
        kinds = labels if labels.dtype == np.uint8 else np.minimum(labels, MAX_ID)
        turns = spec.coordinates == "cylindrical"
        errors = None
        if not turns:
            inside = voxels[rays] >= 0
            errors = depth_errors(occupied, spec, begun[inside], points[rays[inside]])
        return _Frame(frame, scan, points, voxels, kinds, occupied, known, crossed, turns, errors)

    @cached_property
    def _scan(self) -> Callable[[int], Scan]:
        read = self.matched.scans.scan
        return lru_cache(_KEPT)(lambda frame: read(frame, ("labels", "instances", "origins")))

    # Geometry

    def _fits(self, seen: _Frame) -> IntArray:
        """Return (H, 2) points, and those in occupied voxels, under all corrections of all
        families.
        """
        *others, drift, lag = families(self.matched.spec)
        own = self._fit_points(seen.number)
        counts = [self._fit(seen, family.warps, own) for family in others]
        drifts = np.zeros((len(drift.values), 2), np.int64)
        for other in (seen.number - _APART, seen.number + _APART):
            if (placed := self._standing(seen.number, other)) is not None:
                later_s = self.matched.seconds[other] - self.matched.seconds[seen.number]
                drifts += self._fit(seen, drift.warps, thin(placed, self._most), later_s)
        lags = [
            self._fit(seen, lag.warps[:1], self._fit_points(seen.number + int(value)))
            for value in lag.values
        ]
        return np.concatenate([*counts, drifts, *lags])

    def _fit(
        self, seen: _Frame, warps: FloatArray, points: FloatArray, later_s: float = 0.0
    ) -> IntArray:
        spec = self.matched.spec
        occupied = seen.occupied
        at_points = labels_at(points, spec, occupied, warps=warps, later_s=later_s)
        return np.column_stack([np.full(len(warps), len(points)), (at_points > 0).sum(axis=1)])

    @property
    def _most(self) -> int:
        return int(np.clip(_IN_ALL // len(self.matched.frames), _LEAST, _MOST))

    def _fit_points(self, frame: int) -> FloatArray:
        """Return (N, 3) points of a scan inside the grid, thinned evenly in space; none if it
        cannot be read.
        """
        if frame not in self._spread:
            spec = self.matched.spec
            scan = self._other(frame)
            edge = float(spec.voxel_size[[0, 2]].min()) / 2
            some = np.empty((0, 3), np.float32)
            if scan is not None:
                some = thin(scan.points[_are_returns(scan)], _SPREAD)
            some = some[first_of_cells(np.floor(some / edge).astype(np.int64))]
            points = self.matched.place(some)
            self._spread[frame] = thin(points[spec.flat_index(points) >= 0], self._most)
        return self._spread[frame]

    # Scans at other times

    def _other(self, frame: int) -> Scan | None:
        """Return the scan of another frame; None if it does not exist or cannot be read (its own
        frame reports the error).
        """
        return tried_twice(partial(self._scan, frame)) if frame in self.matched.seconds else None

    def _grid_T_world(self, frame: int) -> FloatArray | None:
        pose = self.matched.poses.get(frame)
        return None if pose is None else self.matched.grid_T_scan @ invert(pose)

    def _standing(self, frame: int, other: int) -> FloatArray | None:
        """Return (N, 3) returns of another scan inside the grid of a frame, without classes that
        can move; None without the scan.
        """
        grid_T_world = self._grid_T_world(frame)
        scan = self._other(other)
        if grid_T_world is None or scan is None:
            return None
        keep = _are_returns(scan)
        if scan.labels is not None:
            keep &= ~np.isin(scan.labels, sorted(self.matched.scans.metadata.classes.movable))
        grid_T_scan = grid_T_world @ self.matched.poses[other]
        placed = transform_points(grid_T_scan, thin(scan.points[keep], _SPREAD))
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
        lookup = self.matched.lookup
        labels = seen.scan.labels
        classes = np.bincount(seen.labels[seen.occupied], minlength=MAX_ID + 1)
        add(sums, "classes of grids", classes)
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
            own = np.flatnonzero(seen.voxels >= 0)
            own = own[seen.known.reshape(-1)[seen.voxels[own]]]
            free = ~seen.occupied.reshape(-1)[seen.voxels[own]]
            wrong.reshape(-1)[seen.voxels[own[free]]] = True
            labels = seen.scan.labels
            kinds = np.zeros(len(own), np.int64) if labels is None else labels[own]
            self._add_by(sums, "returns", kinds, seen.points[own], free)
        return wrong

    def _add_phantoms(self, sums: Sums, seen: _Frame) -> BoolArray:
        """Count occupied voxels that rays see, and those that rays cross, by class, distance and
        height; return the crossed ones.
        """
        spec = self.matched.spec
        clear = seen.crossed >= _CLEAR_RAYS
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
        low = self.matched.spec.lower[2]
        high = self.matched.spec.upper[2]
        heights = ((points[:, 2] - low) / (high - low) * HEIGHTS).clip(0, HEIGHTS - 1).astype(int)
        bands = np.searchsorted(BANDS_M, np.linalg.norm(points, axis=1), side="right") - 1
        counts = np.zeros((MAX_ID + 1, len(BANDS_M) - 1, HEIGHTS, 2), np.int64)
        cells = np.minimum(kinds.astype(np.int64), MAX_ID), bands, heights
        np.add.at(counts[..., 0], cells, 1)
        np.add.at(counts[..., 1], cells, wrong)
        add(sums, name, counts)

    def _add_unknown(self, sums: Sums, seen: _Frame) -> None:
        """Count unknown voxels by cause: they hold a return, a ray crosses them, they are outside
        of the view, or hidden.
        """
        if seen.known is None or not seen.hit.any():
            return
        angles = self._elevations(seen.points[seen.voxels >= 0])
        of_voxels = self._elevations_of_voxels
        view = (of_voxels >= angles.min()) & (of_voxels <= angles.max())
        without = ~seen.known & ~seen.hit
        crossed = seen.crossed > 0
        rest = without & ~crossed
        causes = [~seen.known & seen.hit, without & crossed, rest & ~view, rest & view]
        add(sums, "unknown", [seen.known.size, *(cause.sum() for cause in causes)])

    def _elevations(self, points: AnyFloatArray) -> AnyFloatArray:
        """Return the angle of each point above the horizon of the sensor."""
        x, y, z = np.moveaxis(points, -1, 0)
        return np.arctan2(z - self.matched.height_m, np.hypot(x, y))

    @cached_property
    def _elevations_of_voxels(self) -> Float32Array:
        spec = self.matched.spec
        return self._elevations(spec.from_axes(spec.centers())).astype(np.float32)

    # Actors

    def _add_actors(self, sums: Sums, seen: _Frame) -> BoolArray:
        """Count voxels, and occupied voxels, on the path and on the body of each actor; return the
        occupied voxels of paths.
        """
        trails = np.zeros(seen.occupied.size, np.bool_)
        flat = seen.occupied.reshape(-1)
        for name, members in self._members(seen):
            own = np.unique(seen.voxels[members])
            own = own[own >= 0]
            if seen.known is not None:  # what is called unknown is not called free
                own = own[seen.known.reshape(-1)[own]]
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
                    counts = [len(path), flat[path].sum(), 0, 0, 0]
                    add(sums, f"actor {_name(number, track)}", counts)
        return trails.reshape(seen.occupied.shape)

    def _members(self, seen: _Frame) -> list[tuple[str, AnyIntArray]]:
        """Return the points of each actor in a scan, by instances or by tracks."""
        ids = seen.scan.instances
        labels = seen.scan.labels
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
        lower = track.lower - margin_m
        upper = track.upper + margin_m
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
        placed = [grid_T_world @ pose for pose in poses]
        return np.flatnonzero(count_points(lattice, placed, spec))


def _are_returns(scan: Scan) -> BoolArray:
    """Return (N,) which points are returns: some sensors write (0, 0, 0) where there is none."""
    x, y, z = scan.points.T
    return np.asarray((x != 0) | (y != 0) | (z != 0))


def _name(number: int, track: Track) -> str:
    if 0 < track.instance < FIRST_FOUND:
        return str(track.instance)
    first = min(track.members, default=track.first)
    return f"of track {number}, first seen in scan {first}"


_SAMPLES = 4  # samples on a ray per edge of the smallest voxel
# least samples of a ray in a voxel that it crosses: rays that graze a corner do not count
_INSIDE = 3


def crossings(origins: FloatArray, points: FloatArray, spec: GridSpec, margin_m: float) -> IntArray:
    """Return (X, Y, Z) how many rays cross each voxel, not only a corner of it, before they come
    near their return.

    Args:
        origins: (N, 3) metres, where each ray begins, in the frame of the grid.
        points: (N, 3) metres, the returns.
        spec: geometry of the grid, Cartesian or cylindrical.
        margin_m: rays end this far before their return.
    """
    crossed = np.zeros(spec.num_voxels + 1, np.int64)
    edges = spec.voxel_size[[0, 2]] if spec.coordinates == "cylindrical" else spec.voxel_size
    _cross(origins, points, Cells.of(spec), float(min(edges)) / _SAMPLES, margin_m, crossed)
    return crossed[:-1].reshape(spec.size)


@cached
def _cross(origins, points, cells, step_m, margin_m, crossed):  # type: ignore[no-untyped-def]
    outside = len(crossed) - 1
    for i in range(len(points)):
        x = origins[i, 0]
        y = origins[i, 1]
        z = origins[i, 2]
        dx = points[i, 0] - x
        dy = points[i, 1] - y
        dz = points[i, 2] - z
        length = np.sqrt(dx * dx + dy * dy + dz * dz)
        if not length > margin_m:
            continue
        dx = dx / length
        dy = dy / length
        dz = dz / length
        last = outside
        inside = 0
        for k in range(int((length - margin_m) / step_m)):
            t = (k + 0.5) * step_m
            voxel = find_voxel(x + t * dx, y + t * dy, z + t * dz, cells)
            inside = inside + 1 if voxel == last else 1
            last = voxel
            if inside == _INSIDE:
                crossed[voxel] += 1


def grown(mask: BoolArray, turns: bool) -> BoolArray:
    """Return a mask grown by one voxel in each direction; if `turns`, the azimuth of a cylindrical
    grid is periodic.
    """
    for axis in range(3):
        sides = [(1, 1) if a == axis else (0, 0) for a in range(3)]
        wide = np.moveaxis(
            np.pad(mask, sides, mode="wrap" if turns and axis == 1 else "constant"), axis, 0
        )
        mask = np.moveaxis(wide[:-2] | wide[1:-1] | wide[2:], 0, axis)
    return mask
