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
        once: count each scan once per voxel, instead of all samples.
        map_T_world: (4, 4), which fixes the cells of the static scene.
        stride: frames share scans with every `stride`-th one.
        corners_of: returns the corners of the grids that a scan may be merged into, within some
            seconds, (N, 3) metres, world.
    """

    def __init__(
        self,
        spec: GridSpec,
        step_m: float,
        once: bool,
        map_T_world: Transform,
        stride: int,
        corners_of: Callable[[int, float], FloatArray],
    ) -> None:
        self.key = spec, step_m, once
        self._map_T_world, self._stride, self._corners_of = map_T_world, stride, corners_of
        # by the frames that share it, and what is in it: an actor has its number
        self._maps = dict[tuple[int, str | int], FreeMap]()
        self._lock = threading.Lock()  # an executor may be of threads

    def of_scene(self, merger: Merger, now: Instant, window: Collection[int]) -> Uint32Array:
        """Return (V,) the free samples of the scans of a window in each voxel, or the scans."""
        return self._count("scene", merger, now, window)

    def views(self, merger: Merger, now: Instant, window: Collection[int]) -> Uint32Array:
        """Return (V,) the number of scans of a window whose rays passed through each voxel."""
        return self._count("views", merger, now, window)

    def is_seen(
        self, merger: Merger, now: Instant, recent: Collection[int], voxels: IntArray
    ) -> BoolArray:
        """Return (M,) bool: which of some voxels rays of recent scans passed through."""
        return self._count("recent", merger, now, recent, voxels) > 0

    def _count(
        self,
        kind: str,
        merger: Merger,
        now: Instant,
        window: Collection[int],
        voxels: IntArray | None = None,
    ) -> Uint32Array:
        def cast_of(frame: int) -> Cast:
            within_s = RECENT_S if kind == "recent" else math.inf
            corners = transform_points(self._map_T_world, self._corners_of(frame, within_s))
            return merger.scan_of(frame).cast(
                self._map_T_world, corners.min(axis=0), corners.max(axis=0)
            )

        with self._lock:
            cells = self._map_of(kind, now)
            cells.hold(window, cast_of)
            return cells.count(self._map_T_world @ now.world_T_grid, voxels)

    def _map_of(self, kind: str | int, now: Instant) -> FreeMap:
        key, (spec, step_m, once) = (now.frame % self._stride, kind), self.key
        if key not in self._maps:
            once = kind == "views" or (once and kind != "recent")
            self._maps[key] = FreeMap(spec, step_m, once, fine=isinstance(kind, int))
        return self._maps[key]

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
                cells = self._map_of(number, now)
                cells.hold(casts, casts.__getitem__)
                free[voxels] += cells.count(map_T_grid, voxels)

    def forget_others(self, actors: Collection[int]) -> None:
        """Clear the maps of all other actors."""
        with self._lock:
            for key in [key for key in self._maps if key[1] not in actors]:
                if isinstance(key[1], int):
                    del self._maps[key]
