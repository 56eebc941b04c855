"""What is counted of each frame: sums, which add up over stretches of frames, so that memory does not grow with the number of frames."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from carlasc.core.cells import first_of_cells
from carlasc.core.geometry import invert, thin, transform_points
from carlasc.core.scans import Scan
from carlasc.errors import CarlascError
from carlasc.inspection.auditing.counting import (
    BANDS_M,
    HEIGHTS,
    Sums,
    add,
    add_by,
    are_returns,
    count_occupied_under,
    crossings,
    grown,
)
from carlasc.inspection.auditing.hypotheses import drift_family, families
from carlasc.inspection.auditing.matching import MatchedGrids
from carlasc.inspection.heldout_scores import lowest_of_columns
from carlasc.motion.tracks import MovingActors, Track
from carlasc.storage import layout

LAGS = (-3, -2, -1, 1, 2, 3)
_SPREAD, _FIT_POINTS, _RAYS = (
    20_000,
    2500,
    8000,
)  # points of a frame that are spread over places, and of these; rays that are followed
_TIMES = (*range(-20, -1, 2), *range(2, 21, 2))  # frames before and after, at which actors are looked for
_APART = 20  # frames to the scans that show a drift
_CLEAR_RAYS = 3  # so many rays cross a phantom
_AROUND_M = 0.6  # by which an actor may be larger than its body, which was measured on a few sides
_INSET_M = 0.2  # by which the path of an actor is narrower than its body, and above the ground


@dataclass(frozen=True)
class FrameErrors:
    """The voxels of one frame that are wrong, for the sums and for pictures.

    Attributes:
        false_free: (X, Y, Z) free voxels that hold returns.
        phantoms: (X, Y, Z) occupied voxels that rays cross.
        trails: (X, Y, Z) occupied voxels on the paths of what moves.
    """

    occupied: NDArray[np.bool_]
    false_free: NDArray[np.bool_]
    phantoms: NDArray[np.bool_]
    trails: NDArray[np.bool_]

    @property
    def count(self) -> int:
        """Number of wrong voxels."""
        return int(np.count_nonzero(self.false_free | self.phantoms | self.trails))


@dataclass
class FrameCounter:
    """Counts the frames of one sequence. It pickles into workers.

    Attributes:
        matched: the grids and their scans.
        actors: what moves in the recording.
        window: first and last scan that the grids were made from, relative to the frame; None if that is not known.
    """

    matched: MatchedGrids
    actors: MovingActors
    window: tuple[int, int] | None = None
    _scans: dict[int, Scan] = field(default_factory=dict, repr=False)
    _spread: dict[int, NDArray[np.float64]] = field(default_factory=dict, repr=False)  # by frame

    @cached_property
    def _warps(self) -> NDArray[np.float64]:
        return np.concatenate([family.warps for family in families(self.matched.spec)])

    @cached_property
    def _ground(self) -> list[int]:
        """The classes of the grids that are ground, as far as the scans' classes tell."""
        lookup = self.matched.lookup
        found = set() if lookup is None else {int(lookup[i]) for i in self.matched.scans.metadata.classes.ground}
        return sorted(found - {-1, 0})

    @cached_property
    def _trajectory(self) -> tuple[NDArray[np.int64], NDArray[np.float64], NDArray[np.float64]] | None:
        """Frames with scans, their times and (F, 4, 4) poses; None without poses."""
        scans = self.matched.scans
        if layout.POSES not in scans.documents():
            return None
        frames = scans.frames("points")
        poses = np.stack([scans.read_pose(f) for f in frames.tolist()])
        return frames, np.array([self.matched.seconds(f) for f in frames.tolist()]), poses

    def add_frame(self, sums: Sums, number: int, frame: int) -> FrameErrors:
        """Add a frame to sums, and return its wrong voxels.

        Raises:
            CarlascError: the grid or the scan cannot be read.
        """
        matched, scan = self.matched, self._scan(frame)
        labels, occupied, known = matched.read(number)
        points = matched.place(scan.points)
        voxels = matched.spec.flat_index(points)
        inside = (voxels >= 0) & are_returns(scan.points)
        add(sums, "frames", [1])
        add(sums, "inside", [len(points), int(inside.sum())])
        if len(self._ground):
            ground = occupied & np.isin(labels, self._ground)
            begins = ground & ~np.pad(ground, ((0, 0), (0, 0), (1, 0)))[:, :, :-1]
            layers = begins.sum(axis=2)
            add(sums, "ground columns", [int((layers > 0).sum()), int((layers > 1).sum())])
        self._add_fits(sums, frame, occupied)
        self._add_drift(sums, frame, occupied)
        self._add_confusion(sums, scan, voxels, inside, labels, occupied)
        crossed = self._crossed(scan, points, frame)
        self._add_unknown(sums, points[inside], known, crossed, voxels[inside])
        add(sums, "classes of grids", np.bincount(labels[occupied].astype(np.int64), minlength=1)[:512])
        trails = self._add_actors(sums, scan, frame, voxels, occupied)
        free, phantoms = self._add_occupancy(sums, scan, points, voxels, inside, labels, occupied, known, crossed)
        self._add_held_out(sums, frame, occupied, known)
        return FrameErrors(occupied, free, phantoms, trails)

    def _scan(self, frame: int) -> Scan:
        if frame not in self._scans:
            self._scans[frame] = self.matched.scans.scan(frame, ("labels", "instances", "origins"))
            while len(self._scans) > 2 * len(LAGS):
                self._scans.pop(next(iter(self._scans)))
        return self._scans[frame]

    def _add_fits(self, sums: Sums, frame: int, occupied: NDArray[np.bool_]) -> None:
        spec, own = self.matched.spec, self._fit_points(frame)
        nearest = np.column_stack([own, np.zeros(len(own))])
        found = count_occupied_under(nearest, self._warps, spec, occupied)
        add(sums, "fits", [len(nearest), *found])
        lags = np.zeros((len(LAGS), 2), np.int64)
        for row, lag in enumerate(LAGS):
            try:
                near = self._fit_points(frame + lag) if self._has(frame + lag) else np.empty((0, 3))
            except CarlascError:
                continue  # that scan is reported where it is the frame's own
            others = np.column_stack([near, np.zeros(len(near))])
            lags[row] = len(near), *count_occupied_under(others, self._warps[:1], spec, occupied)
        add(sums, "lags", lags)

    def _has(self, frame: int) -> bool:
        frames = self.matched.scans.frames("points")
        row = int(np.searchsorted(frames, frame))
        return row < len(frames) and int(frames[row]) == frame

    def _fit_points(self, frame: int) -> NDArray[np.float64]:
        """Return (N, 3) points of a scan inside the grid, about as many of each place."""
        if frame not in self._spread:
            spec, scan = self.matched.spec, self._scan(frame)
            some = thin(scan.points[are_returns(scan.points)], _SPREAD)
            edge = float(spec.voxel_size[[0, 2]].min()) / 2
            some = some[first_of_cells(np.floor(some / edge).astype(np.int64))]
            points = self.matched.place(some)
            self._spread[frame] = thin(points[spec.flat_index(points) >= 0], _FIT_POINTS)
            while len(self._spread) > 2 * len(LAGS):
                self._spread.pop(next(iter(self._spread)))
        return self._spread[frame]

    def _add_drift(self, sums: Sums, frame: int, occupied: NDArray[np.bool_]) -> None:
        """Count the points of static things in scans some seconds away: grids that were made under drifting poses hold them higher or lower."""
        if self._trajectory is None:
            return
        frames, seconds, poses = self._trajectory
        here, spec, drift = int(np.searchsorted(frames, frame)), self.matched.spec, drift_family()
        for other in (frame - _APART, frame + _APART):
            if not self._has(other):
                continue
            scan, there = self._scan(other), int(np.searchsorted(frames, other))
            points = thin(scan.points[self._stand_still(scan)], _SPREAD)
            placed = self.matched.place(transform_points(invert(poses[here]) @ poses[there], points))
            placed = thin(placed[spec.flat_index(placed) >= 0], _FIT_POINTS)
            delayed = np.column_stack([placed, np.full(len(placed), seconds[there] - seconds[here])])
            add(sums, "drift", [len(placed), *count_occupied_under(delayed, drift.warps, spec, occupied)])

    def _stand_still(self, scan: Scan) -> NDArray[np.bool_]:
        """Return which points of a scan are returns of things that cannot move, as far as labels say."""
        returns = are_returns(scan.points)
        movable = sorted(self.matched.scans.metadata.classes.movable)
        return returns if scan.labels is None else returns & ~np.isin(scan.labels, movable)

    def _add_confusion(
        self,
        sums: Sums,
        scan: Scan,
        voxels: NDArray[np.int64],
        inside: NDArray[np.bool_],
        labels: NDArray[np.unsignedinteger],
        occupied: NDArray[np.bool_],
    ) -> None:
        lookup = self.matched.lookup
        if scan.labels is None or lookup is None:
            return
        own = lookup[np.minimum(scan.labels[inside].astype(np.int64), len(lookup) - 1)]
        met = labels.reshape(-1)[voxels[inside]].astype(np.int64)
        both = occupied.reshape(-1)[voxels[inside]] & (own >= 0) & (met < 512)
        confusion = np.bincount(own[both] * 512 + met[both], minlength=512 * 512)
        size = max(int(own.max(initial=0)), int(met[both].max(initial=0))) + 1
        add(sums, "confusion", confusion.reshape(512, 512)[:size, :size])

    def _crossed(self, scan: Scan, points: NDArray[np.float64], frame: int) -> NDArray[np.int64]:
        """Return (X, Y, Z) how many rays of a scan cross each voxel."""
        spec, begun = self.matched.spec, scan.others.get("origins")
        chosen = np.flatnonzero(are_returns(scan.points))
        chosen = chosen[:: max(1, len(chosen) // _RAYS)]
        origins = np.zeros((len(points), 3), np.float32) if begun is None else begun
        margin = 1.5 * float(np.linalg.norm(spec.voxel_size[[0, 0, 2]]))
        return crossings(self.matched.place(origins[chosen]), points[chosen], spec, margin)

    def _add_occupancy(
        self,
        sums: Sums,
        scan: Scan,
        points: NDArray[np.float64],
        voxels: NDArray[np.int64],
        inside: NDArray[np.bool_],
        labels: NDArray[np.unsignedinteger],
        occupied: NDArray[np.bool_],
        known: NDArray[np.bool_] | None,
        crossed: NDArray[np.int64],
    ) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
        """Count false free returns and phantoms, by class, distance and height."""
        spec, false_free = self.matched.spec, np.zeros(occupied.shape, np.bool_)
        if known is not None:
            own, own_points = voxels[inside], points[inside]
            free = (known & ~occupied).reshape(-1)[own]
            false_free.reshape(-1)[own[free]] = True
            kinds = np.zeros(len(own), np.int64) if scan.labels is None else scan.labels[inside].astype(np.int64)
            add_by(sums, "returns", kinds, *self._bands(own_points), free, known.reshape(-1)[own])
        hit = np.zeros(occupied.shape, np.bool_)
        hit.reshape(-1)[voxels[inside]] = True
        phantoms = occupied & (crossed >= _CLEAR_RAYS) & ~grown(hit, spec.coordinates == "cylindrical")
        # rays run along the ground for metres, and through its voxels
        phantoms &= ~(np.isin(labels, self._ground) if len(self._ground) else lowest_of_columns(occupied))
        looked = occupied & ((crossed >= _CLEAR_RAYS) | hit)
        cells = np.flatnonzero(looked)
        places = spec.from_axes(spec.centers().reshape(-1, 3)[cells])
        kinds = labels.reshape(-1)[cells].astype(np.int64)
        every = np.ones(len(cells), np.bool_)
        add_by(sums, "seen voxels", kinds, *self._bands(places), phantoms.reshape(-1)[cells], every)
        return false_free, phantoms

    def _bands(self, points: NDArray[np.floating]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        low, high = self.matched.spec.lower[2], self.matched.spec.upper[2]
        heights = np.clip((points[:, 2] - low) / (high - low) * HEIGHTS, 0, HEIGHTS - 1).astype(np.int64)
        return np.searchsorted(BANDS_M, np.linalg.norm(points, axis=1), side="right") - 1, heights

    def _add_held_out(
        self, sums: Sums, frame: int, occupied: NDArray[np.bool_], known: NDArray[np.bool_] | None
    ) -> None:
        """Count the returns of the nearest scans that did not make the grid, of what stands still."""
        if self.window is None or self._trajectory is None or known is None:
            return
        frames, _, poses = self._trajectory
        here = poses[int(np.searchsorted(frames, frame))]
        for other in (frame + self.window[0] - 1, frame + self.window[1] + 1):
            if not self._has(other):
                continue
            scan = self._scan(other)
            keep = self._stand_still(scan)
            motion = invert(here) @ poses[int(np.searchsorted(frames, other))]
            own = self.matched.spec.flat_index(self.matched.place(transform_points(motion, scan.points[keep])))
            own = own[own >= 0]
            free, seen = (known & ~occupied).reshape(-1)[own], known.reshape(-1)[own]
            add(sums, "held out", [int(seen.sum()), int(free.sum())])

    def _add_actors(
        self, sums: Sums, scan: Scan, frame: int, voxels: NDArray[np.int64], occupied: NDArray[np.bool_]
    ) -> NDArray[np.bool_]:
        """Count, for each actor, the voxels on its path and on itself, and those of them that are occupied."""
        trails, spec = np.zeros(occupied.shape, np.bool_), self.matched.spec
        flat = occupied.reshape(-1)
        for name, members in self._members(scan, frame):
            own = np.unique(voxels[members])
            own = own[own >= 0]
            if len(own) >= 5:
                add(sums, f"actor {name}", [0, 0, len(own), int(flat[own].sum()), 1])
        if self._trajectory is None:
            return trails
        frames, _, poses = self._trajectory
        grid_T_world = self.matched.grid_T_scan @ invert(poses[int(np.searchsorted(frames, frame))])
        here = np.zeros(spec.num_voxels, np.bool_)
        here[voxels[voxels >= 0]] = True  # what the scan meets is there, whoever it is
        here = grown(here.reshape(spec.size), spec.coordinates == "cylindrical").reshape(-1)
        wide = max(float(spec.voxel_size[0]), _AROUND_M)
        for track in self.actors.tracks.values():
            here[self._body(track, frame, grid_T_world, wide)] = True
        for number, track in self.actors.tracks.items():
            bodies = [self._body(track, frame + k, grid_T_world, -_INSET_M) for k in _TIMES]
            path = np.unique(np.concatenate(bodies))
            path = path[~here[path]]
            if len(path):
                trails.reshape(-1)[path[flat[path]]] = True
                add(sums, f"actor {_name(number, track)}", [len(path), int(flat[path].sum()), 0, 0, 0])
        return trails

    def _members(self, scan: Scan, frame: int) -> list[tuple[str, NDArray[np.integer]]]:
        """Return the points of each actor in a scan."""
        if scan.instances is not None and scan.instances.any():
            order = np.argsort(scan.instances, kind="stable")
            ids, starts = np.unique(scan.instances[order], return_index=True)
            movable = sorted(self.matched.scans.metadata.classes.movable)
            parts = [(int(i), part) for i, part in zip(ids, np.split(order, starts[1:]), strict=True) if i]
            return [(str(i), p) for i, p in parts if scan.labels is None or np.isin(scan.labels[p], movable).all()]
        return [
            (_name(number, track), members)
            for number, track in self.actors.tracks.items()
            if (members := track.members.get(frame)) is not None
        ]

    def _body(self, track: Track, frame: int, grid_T_world: NDArray[np.float64], margin_m: float) -> NDArray[np.int64]:
        """Return the voxels in the body of an actor at a frame, wider by a margin; above the ground where it is narrower."""
        pose = track.pose(frame)
        if pose is None:
            return np.empty(0, np.int64)
        lower, upper = track.lower - margin_m, track.upper + margin_m
        if margin_m < 0:
            lower[2] = track.lower[2] + float(self.matched.spec.voxel_size[2])
        if (upper <= lower).any():
            return np.empty(0, np.int64)
        edge = float(self.matched.spec.voxel_size[[0, 2]].min()) / 1.5
        lines = [np.linspace(a, b, max(2, round((b - a) / edge) + 1)) for a, b in zip(lower, upper, strict=True)]
        lattice = np.stack(np.meshgrid(*lines, indexing="ij"), axis=-1).reshape(-1, 3)
        found = np.unique(self.matched.spec.flat_index(transform_points(grid_T_world @ pose, lattice)))
        return found[found >= 0]

    def _add_unknown(
        self,
        sums: Sums,
        points: NDArray[np.float64],
        known: NDArray[np.bool_] | None,
        crossed: NDArray[np.int64],
        voxels: NDArray[np.int64],
    ) -> None:
        """Count unknown voxels by cause: they hold a return, a ray crosses them, they are outside of the view, or hidden."""
        if known is None:
            add(sums, "without mask", [1])
            return
        unknown = ~known.reshape(-1)
        hit = np.zeros(len(unknown), np.bool_)
        hit[voxels] = True
        seen = (crossed.reshape(-1) > 0) & ~hit
        low, high = self._view(points)
        view = (self._elevations >= low) & (self._elevations <= high)
        rest = unknown & ~hit & ~seen
        causes = [unknown & hit, unknown & seen, rest & ~view, rest & view]
        add(sums, "unknown", [len(unknown), *(int(cause.sum()) for cause in causes)])

    @cached_property
    def _elevations(self) -> NDArray[np.float64]:
        centers = self.matched.spec.from_axes(self.matched.spec.centers().reshape(-1, 3))
        return np.arctan2(centers[:, 2] - self.matched.height_m, np.hypot(centers[:, 0], centers[:, 1]))

    def _view(self, points: NDArray[np.float64]) -> tuple[float, float]:
        if not len(points):
            return 0.0, 0.0
        angles = np.arctan2(points[:, 2] - self.matched.height_m, np.hypot(points[:, 0], points[:, 1]))
        return float(angles.min()), float(angles.max())


def _name(number: int, track: Track) -> str:
    return str(track.instance) if 0 < track.instance < 1 << 33 else f"mover {number}"
