"""Which voxels of a frame belong to which actor, and which of them no scan saw."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Self

import numpy as np
from numpy.typing import NDArray

from carlasc.core.geometry import Transform, invert, transform_points
from carlasc.core.grids import GridSpec
from carlasc.groundtruth.from_scans.merging import STATIC, Instant, Merger
from carlasc.motion import BODY_MARGIN_M, Track


@dataclass(frozen=True)
class BodyRegions:
    """Which voxels belong to which actor.

    Attributes:
        of_voxel: (V,) uint16, region of each voxel; STATIC outside of all bodies.
        actors: number of the actor by region, for the regions that have voxels.
        hidden: (H,) flat indices of voxels of a body's face that no scan saw. Rays beside the body go through them: they say nothing of it.
        hidden_ends: (E,) those of a face that is hidden also if the body is completed by its mirror image.
    """

    of_voxel: NDArray[np.uint16]
    actors: Mapping[int, int]
    hidden: NDArray[np.int64]
    hidden_ends: NDArray[np.int64]

    @classmethod
    def at(cls, merger: Merger, now: Instant, window: Collection[int], spec: GridSpec) -> BodyRegions:
        """Return the regions of a frame: of the bodies of what moves, and of moving points without a body.

        Args:
            merger: what moves, and the scans.
            now: the frame.
            window: frames whose scans are merged.
            spec: the grid.
        """
        tracks = merger.actors.tracks.items() if merger.dynamic == "align" else ()
        present = [(number, track, pose) for number, track in tracks if (pose := track.pose(now.frame)) is not None]
        regions = cls.of_bodies(spec, now.world_T_grid, present)
        if merger.dynamic in ("align", "current") and now.frame in window:
            scan = merger.scan_of(now.frame)
            moving = scan.points[~merger.static(now.frame)]
            return regions.with_points(spec, transform_points(now.grid_T_world @ scan.world_T_sensor, moving))
        return regions

    def with_points(self, spec: GridSpec, points: NDArray[np.floating]) -> BodyRegions:
        """Return the regions with one more, of the voxels of points that move and belong to no body: only the frame's own rays vote there.

        Args:
            spec: the grid.
            points: (M, 3) metres, grid frame.
        """
        of_voxel = self.of_voxel.copy()
        voxels = spec.flat_index(points)
        voxels = voxels[voxels >= 0]
        of_voxel[voxels[of_voxel[voxels] == STATIC]] = max(self.actors, default=0) + 1
        return replace(self, of_voxel=of_voxel)

    @classmethod
    def of_bodies(cls, spec: GridSpec, world_T_grid: Transform, bodies: Sequence[tuple[int, Track, Transform]]) -> Self:
        """Return the regions of bodies: (number, track, world_T_actor) of each actor.

        A body has all voxels that it touches. Where bodies overlap, the smaller one takes precedence.
        """
        of_voxel = np.zeros(spec.num_voxels, np.uint16)
        hidden, hidden_ends = np.zeros(spec.num_voxels, np.bool_), np.zeros(spec.num_voxels, np.bool_)
        size = spec.voxel_size
        # x and y of the centres of the columns of cells, (C, 2), z of the centres in each, and half the extent of the cells.
        columns = spec.from_axes(replace(spec, size=(*spec.size[:2], 1)).centers())[:, :, 0, :2].reshape(-1, 2)
        columns, heights = columns.astype(np.float64), spec.lower[2] + (np.arange(spec.size[2]) + 0.5) * size[2]
        width = np.hypot(columns[:, 0], columns[:, 1]) * size[1] if spec.coordinates == "cylindrical" else size[1]
        across, up = np.broadcast_to(np.maximum(size[0], width) / 2, len(columns)), float(size[2] / 2)
        largest_first = sorted(bodies, key=lambda body: -float(np.prod(body[1].size)))
        for region, (_, track, pose) in enumerate(largest_first, 1):
            actor_T_grid = invert(pose) @ world_T_grid
            turned = np.abs(actor_T_grid[:3, :3])
            middle = invert(actor_T_grid)[:2, 3]
            reach = float(np.linalg.norm(np.maximum(-track.lower, track.upper))) + across + up
            near = np.flatnonzero((np.abs(columns - middle) < reach[:, None]).all(axis=1))
            cells = np.column_stack([np.repeat(columns[near], len(heights), axis=0), np.tile(heights, len(near))])
            slack = np.repeat(across[near], len(heights))[:, None] * turned[:, :2].sum(axis=1) + up * turned[:, 2]
            body = transform_points(actor_T_grid, cells)
            inside = ((body > track.lower - slack) & (body < track.upper + slack)).all(axis=1)
            own = (near[:, None] * len(heights) + np.arange(len(heights))).reshape(-1)[inside]
            of_voxel[own] = region
            rear, front, low, high = track.extent.faces
            mirrored = (rear, front, low or high, low or high)
            hidden[own] = _on_hidden_face(track, body[inside], slack[inside], track.extent.faces)
            hidden_ends[own] = _on_hidden_face(track, body[inside], slack[inside], mirrored)
        present = np.unique(of_voxel[of_voxel != STATIC]).tolist()
        actors = {region: largest_first[region - 1][0] for region in present}
        return cls(of_voxel, actors, np.flatnonzero(hidden), np.flatnonzero(hidden_ends))


def _on_hidden_face(
    track: Track, cells: NDArray[np.float64], slack: NDArray[np.float64], faces: tuple[bool, bool, bool, bool]
) -> NDArray[np.bool_]:
    """Return which cells, (C, 3) centres in the actor's frame, touch a face that was not seen, and none that was seen.

    Args:
        track: the actor.
        cells: centres of cells that its body touches.
        slack: (C, 3) half the extent of each cell along the axes of the actor.
        faces: whether the rear, the front, the side of low y and the side of high y were seen.
    """
    lower, upper = track.lower + BODY_MARGIN_M, track.upper - BODY_MARGIN_M
    away = np.stack([cells[:, 0] - lower[0], upper[0] - cells[:, 0], cells[:, 1] - lower[1], upper[1] - cells[:, 1]])
    touches = np.abs(away) <= np.stack([slack[:, 0], slack[:, 0], slack[:, 1], slack[:, 1]])
    seen = np.array(faces)[:, None]
    return (touches & ~seen).any(axis=0) & ~(touches & seen).any(axis=0)
