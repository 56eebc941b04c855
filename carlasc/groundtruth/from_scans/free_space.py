"""The free space of the scans around a frame: of the static scene, and in the bodies of actors."""

from __future__ import annotations

import math
import threading
from collections.abc import Callable, Collection

import numpy as np

from carlasc.core.arrays import BoolArray, FloatArray, IntArray, Uint32Array
from carlasc.core.geometry import Transform, invert, transform_points
from carlasc.core.grids import GridSpec
from carlasc.groundtruth.from_scans.merging import MIRROR, RECENT_S, BodyRegions, Instant, Merger
from carlasc.groundtruth.voting.free_maps import Cast, FreeMap


class FreeSpace:
    """The maps of free space of a drive, which slide with the window of the frames.

    Args:
        spec: the grids.
        step_m: distance between two samples of a ray, metres.
        views: count each scan once per voxel, instead of all samples.
        map_T_world: (4, 4), which fixes the cells of the static scene.
        corners_of: returns the corners of the grids that a scan may be merged into, within some
            seconds, (N, 3) metres, world.
    """

    def __init__(
        self,
        spec: GridSpec,
        step_m: float,
        views: bool,
        map_T_world: Transform,
        corners_of: Callable[[int, float], FloatArray],
    ) -> None:
        self.key = spec, step_m, views
        self._map_T_world, self._corners_of = map_T_world, corners_of
        self._static, self._recent = FreeMap(*self.key), FreeMap(spec, step_m, first=0)
        self._views = FreeMap(spec, step_m, views=True, first=0)
        self._bodies = dict[int, FreeMap]()
        self._lock = threading.Lock()  # an executor may be of threads

    def of_scene(self, merger: Merger, now: Instant, window: Collection[int]) -> Uint32Array:
        """Return (V,) the free samples of the scans of a window in each voxel, or the scans."""
        return self._count(self._static, merger, now, window)

    def views(self, merger: Merger, now: Instant, window: Collection[int]) -> Uint32Array:
        """Return (V,) the number of scans of a window that saw each voxel."""
        return self._count(self._views, merger, now, window)

    def is_seen(
        self, merger: Merger, now: Instant, recent: Collection[int], voxels: IntArray
    ) -> BoolArray:
        """Return (M,) bool: which of some voxels recent scans saw."""
        return self._count(self._recent, merger, now, recent, voxels) > 0

    def _count(
        self,
        cells: FreeMap,
        merger: Merger,
        now: Instant,
        window: Collection[int],
        voxels: IntArray | None = None,
    ) -> Uint32Array:
        def cast_of(frame: int) -> Cast:
            within_s = RECENT_S if cells is self._recent else math.inf
            corners = transform_points(self._map_T_world, self._corners_of(frame, within_s))
            return merger.scan_of(frame).cast(
                self._map_T_world, corners.min(axis=0), corners.max(axis=0)
            )

        with self._lock:
            cells.hold(window, cast_of)
            return cells.count(self._map_T_world @ now.world_T_grid, voxels)

    def in_bodies(
        self,
        merger: Merger,
        now: Instant,
        window: Collection[int],
        regions: BodyRegions,
        free: Uint32Array,
        *,
        mirror: bool = False,
    ) -> None:
        """Add the free samples in the body of each actor to (V,) those of all voxels."""
        for region, number in regions.actors.items():
            track, seen = merger.actors.tracks[number], merger.seen(number, now, window, mirror)
            pose = track.pose(now.frame)
            if not seen or pose is None:
                continue
            casts = {frame: carried.cast for frame, carried in seen.items()}
            voxels = np.flatnonzero(regions.of_voxel == region)
            map_T_grid = (MIRROR if mirror else np.eye(4)) @ invert(pose) @ now.world_T_grid
            with self._lock:
                cells = self._bodies.setdefault(number, FreeMap(*self.key, fine=True))
                cells.hold(casts, casts.__getitem__)
                free[voxels] += cells.count(map_T_grid, voxels)

    def forget_others(self, actors: Collection[int]) -> None:
        """Clear the maps of all other actors."""
        with self._lock:
            for number in [number for number in self._bodies if number not in actors]:
                del self._bodies[number]
