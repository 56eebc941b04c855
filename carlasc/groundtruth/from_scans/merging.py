"""Merging the scans of one sensor over time, without traces of moving actors.

Plain voting would remove moving actors: the free space that other scans saw in their voxels has more votes. So the static scene and each
actor are voted on separately. In the box of an actor, the points and rays of every scan vote after the actor's motion has moved them to the
time of the frame. Free space that other scans saw of the static scene does not count there.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from carlasc.core.classes import ClassTable
from carlasc.core.geometry import Transform, invert, transform_points
from carlasc.core.grids import GridSpec
from carlasc.groundtruth.options import Dynamic
from carlasc.groundtruth.voting.observations import Observation
from carlasc.motion import Track

STATIC = 0  # region of the voxels that belong to no actor
_DEFORMABLE_WINDOW = 8  # a person's shape is used for this many frames before and after


@dataclass(frozen=True)
class PreparedScan:
    """A scan that is ready for merging: decoded once, and used for every frame whose window contains it.

    Attributes:
        frame: frame number.
        points: (N, 3) float32, metres, sensor frame.
        labels: (N,) uint16; 0 casts no vote.
        world_T_sensor: (4, 4).
        reach_m: distance of the farthest point, metres.
        order: (N,) int32, indices of the points by increasing azimuth.
        azimuth: (N,) float32, radians, in this order.
    """

    frame: int
    points: NDArray[np.float32]
    labels: NDArray[np.uint16]
    world_T_sensor: Transform
    reach_m: float
    order: NDArray[np.int32]
    azimuth: NDArray[np.float32]

    @classmethod
    def of(
        cls, frame: int, points: NDArray[np.float32], labels: NDArray[np.unsignedinteger], world_T_sensor: Transform
    ) -> PreparedScan:
        """Prepare the voting points of a scan."""
        azimuth = np.arctan2(points[:, 1], points[:, 0])
        order = np.argsort(azimuth, kind="stable").astype(np.int32)
        reach = float(np.sqrt(np.square(points).sum(axis=1).max(initial=0.0)))
        return cls(frame, points, labels.astype(np.uint16), world_T_sensor, reach, order, azimuth[order])

    def rays_through(
        self, box_T_sensor: Transform, lower: NDArray[np.float64], upper: NDArray[np.float64]
    ) -> NDArray[np.int32]:
        """Return the indices of the points whose rays, from the sensor to the point, intersect a box.

        Args:
            box_T_sensor: (4, 4), from the sensor's frame to the frame in which the box is axis-aligned.
            lower: (3,) lower corner.
            upper: (3,) upper corner.
        """
        candidates = self._in_view_of(box_T_sensor, lower, upper)
        origin = box_T_sensor[:3, 3]
        rays = transform_points(box_T_sensor, self.points[candidates]) - origin
        with np.errstate(divide="ignore", invalid="ignore"):
            one, other = (lower - origin) / rays, (upper - origin) / rays
        # A ray that lies in a face gives 0/0 there: fmin and fmax ignore the NaN.
        enter = np.fmin(one, other).max(axis=1)
        leave = np.fmax(one, other).min(axis=1)
        return candidates[(enter <= leave) & (leave >= 0) & (enter <= 1)]

    def _in_view_of(
        self, box_T_sensor: Transform, lower: NDArray[np.float64], upper: NDArray[np.float64]
    ) -> NDArray[np.int32]:
        """Return the indices of the points in the range of azimuths that a box covers."""
        origin = box_T_sensor[:3, 3]
        if ((origin > lower) & (origin < upper))[:2].all():  # the sensor is above, below or inside the box
            return self.order
        corners = np.stack(np.meshgrid(*zip(lower, upper, strict=True), indexing="ij"), axis=-1).reshape(-1, 3)
        seen = transform_points(invert(box_T_sensor), corners)
        angles = np.arctan2(seen[:, 1], seen[:, 0])
        middle = np.arctan2(np.sin(angles).sum(), np.cos(angles).sum())
        half = np.abs((angles - middle + np.pi) % (2 * np.pi) - np.pi).max() + 1e-6
        if half > np.pi / 2:  # the corners surround the sensor
            return self.order
        first, last = np.searchsorted(self.azimuth, [middle - half, middle + half])
        parts = [self.order[first:last]]
        if middle - half < -np.pi:
            parts.append(self.order[np.searchsorted(self.azimuth, middle - half + 2 * np.pi) :])
        if middle + half > np.pi:
            parts.append(self.order[: np.searchsorted(self.azimuth, middle + half - 2 * np.pi)])
        return np.concatenate(parts)


class Merger:
    """Merges the scans of a window into the observations of one frame.

    Args:
        scans: prepared scans by frame.
        tracks: the actors' motion; actors that never move are part of the static scene.
        moving: (M,) indices of the moving points of each scan, on a track or not.
        classes: class table of the labels.
        dynamic: what happens to moving points.
    """

    def __init__(
        self,
        scans: Mapping[int, PreparedScan],
        tracks: Iterable[Track],
        moving: Mapping[int, NDArray[np.int64]],
        classes: ClassTable,
        dynamic: Dynamic,
    ) -> None:
        self.scans, self.moving, self.classes, self.dynamic = scans, moving, classes, dynamic
        self.tracks = [track for track in tracks if track.moves]
        self._hits: dict[int, NDArray[np.bool_]] = {}
        self._carried: dict[tuple[int, int], Observation | None] = {}

    def regions(self, frame: int, spec: GridSpec) -> NDArray[np.uint16]:
        """Return (V,) uint16: the number of the actor whose box contains each voxel at a frame, STATIC elsewhere.

        A box contains all voxels that it touches. Where boxes overlap, the smaller one takes precedence.
        """
        regions = np.zeros(spec.num_voxels, np.uint16)
        if self.dynamic != "align":
            return regions
        world_T_grid = self.scans[frame].world_T_sensor
        centers = spec.from_axes(spec.centers())
        columns, heights = centers[:, :, 0, :2].reshape(-1, 2), centers[0, 0, :, 2]
        across, up = _half_cells(spec, columns)
        by_column = regions.reshape(len(columns), len(heights))
        for i in sorted(range(len(self.tracks)), key=lambda i: -float(np.prod(self.tracks[i].size))):
            track, pose = self.tracks[i], self.tracks[i].pose(frame)
            if pose is None:
                continue
            actor_T_grid = invert(pose) @ world_T_grid
            turned = np.abs(actor_T_grid[:3, :3])
            middle = invert(actor_T_grid)[:2, 3]
            reach = float(np.linalg.norm(np.maximum(-track.lower, track.upper))) + across + up
            near = np.flatnonzero((np.abs(columns - middle) < reach[:, None]).all(axis=1))
            cells = np.column_stack([np.repeat(columns[near], len(heights), axis=0), np.tile(heights, len(near))])
            slack = np.repeat(across[near], len(heights))[:, None] * turned[:, :2].sum(axis=1) + up * turned[:, 2]
            body = transform_points(actor_T_grid, cells)
            inside = ((body > track.lower - slack) & (body < track.upper + slack)).all(axis=1)
            by_column[near] = np.where(inside.reshape(len(near), len(heights)), np.uint16(i + 1), by_column[near])
        return regions

    def observations(self, frame: int, window: Iterable[int], regions: NDArray[np.uint16]) -> Iterator[Observation]:
        """Yield the observations of a frame's grid: each scan of the static scene, then each actor's scans in its box.

        Static surfaces vote everywhere, so the road below an actor is kept. Free space that was seen at other times does not count
        inside an actor's box. The frame's own rays always count.
        """
        window = list(window)
        grid_T_world = invert(self.scans[frame].world_T_sensor)
        for other in window:
            scan, own = self.scans[other], other == frame
            everything = self.dynamic == "tube" or (own and self.dynamic != "drop")
            hits = None if everything else self.static(other)
            yield Observation(
                scan.points, scan.labels, grid_T_world @ scan.world_T_sensor, hits, free_region=None if own else STATIC
            )
        for number in np.unique(regions[regions != STATIC]).tolist():
            track = self.tracks[number - 1]
            for other in window:
                bends = track.label in self.classes.deformable and abs(other - frame) > _DEFORMABLE_WINDOW
                carried = None if bends or other == frame else self._carry(number - 1, other)
                pose = track.pose(frame)
                if carried is not None and pose is not None:
                    yield replace(
                        carried,
                        grid_T_sensor=grid_T_world @ pose @ carried.grid_T_sensor,
                        free_region=number,
                        hit_region=number,
                    )

    def static(self, frame: int) -> NDArray[np.bool_]:
        """Return (N,) bool: the points of a scan that do not belong to anything that moves."""
        if frame not in self._hits:
            hits = np.ones(len(self.scans[frame].points), np.bool_)
            hits[self.moving.get(frame, [])] = False
            for track in self.tracks:
                if frame in track.segments:
                    hits[track.segments[frame].members] = False
            self._hits[frame] = hits
        return self._hits[frame]

    def _carry(self, index: int, frame: int) -> Observation | None:
        """Return a scan's rays through an actor's box, in the actor's frame; None if there are none."""
        key = (index, frame)
        if key not in self._carried:
            self._carried[key] = self._cut(self.tracks[index], frame)
        return self._carried[key]

    def _cut(self, track: Track, frame: int) -> Observation | None:
        pose = track.pose(frame)
        if pose is None:
            return None
        scan = self.scans[frame]
        actor_T_sensor = invert(pose) @ scan.world_T_sensor
        rays = scan.rays_through(actor_T_sensor, track.lower, track.upper)
        if not len(rays):
            return None
        hits = self.static(frame)[rays]
        if frame in track.segments:
            hits = hits | np.isin(rays, track.segments[frame].members)
        return Observation(scan.points[rays], scan.labels[rays], actor_T_sensor, hits)


def _half_cells(spec: GridSpec, columns: NDArray[np.floating]) -> tuple[NDArray[np.float64], float]:
    """Return half the greatest width of the cells of each column, (C,), and half their height, in metres."""
    size = spec.voxel_size
    if spec.coordinates == "cartesian":
        return np.full(len(columns), max(size[0], size[1]) / 2), float(size[2] / 2)
    return np.maximum(size[0], np.hypot(columns[:, 0], columns[:, 1]) * size[1]) / 2, float(size[2] / 2)
