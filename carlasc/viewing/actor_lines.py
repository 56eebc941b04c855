"""Lines that show actors: arrows of their motion, edges of their boxes, and their tracks."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from carlasc.core.arrays import AnyFloatArray, FloatArray, IntArray
from carlasc.core.boxes import Boxes
from carlasc.core.geometry import transform_points
from carlasc.core.scans import Scan
from carlasc.viewing.scene import FrameContent

MOVING_M_S = 0.2
"""Slower points count as static: flow has noise."""
_ARROW_CELL_M = 3.0  # points without a number of an actor share an arrow within such a cell

_CORNERS = np.array(list(np.ndindex(2, 2, 2))) - 0.5
_EDGES = [
    (a, b) for a in range(8) for b in range(a + 1, 8) if np.sum(_CORNERS[a] != _CORNERS[b]) == 1
]


def edges_of(size: AnyFloatArray) -> FloatArray:
    """Return the (13, 2, 3) ends of the edges of a box, and of a bar on its floor from its middle
    to its front, metres, frame of the box.
    """
    corners = _CORNERS * size
    floor = -size[2] / 2
    bar = np.array([(0.0, 0.0, floor), (size[0] / 2 + 0.8, 0.0, floor)])
    return np.array([*((corners[a], corners[b]) for a, b in _EDGES), bar])


def box_lines(boxes: Boxes) -> FloatArray:
    """Return (L, 2, 3) both ends of the lines of `edges_of` of all boxes, metres, sensor frame."""
    ends = [
        transform_points(pose, edges_of(size).reshape(-1, 3))
        for pose, size in zip(boxes.sensor_T_box, boxes.sizes, strict=True)
    ]
    return np.concatenate([np.empty((0, 3)), *ends]).reshape(-1, 2, 3)


def motion_arrows(moving: Scan) -> tuple[FloatArray, FloatArray]:
    """Return (M, 3) start points and (M, 3) vectors of the arrows that show how actors move, in
    metres.

    There is one arrow per instance, and one per cell of 3 m for points without an instance. An
    arrow starts above the middle of its points and is as long as the distance moved in one second.

    Args:
        moving: the points that move, with flow.
    """
    if not len(moving):
        return np.empty((0, 3)), np.empty((0, 3))
    flow = np.asarray(moving.flow, np.float64)
    keys = np.floor(moving.points[:, :2] / _ARROW_CELL_M).astype(np.int64)
    if moving.instances is not None:
        known = moving.instances > 0
        keys[known] = np.column_stack(
            [moving.instances[known], np.full(int(known.sum()), np.iinfo(np.int64).max)]
        )
    _, group = np.unique(keys, axis=0, return_inverse=True)
    group = group.reshape(-1)
    count = np.bincount(group)
    middle = _means(moving.points, group)
    vectors = _means(flow, group)
    top = np.full(len(count), -np.inf)
    np.maximum.at(top, group, moving.points[:, 2])
    middle[:, 2] = top + 0.4
    real = np.linalg.norm(vectors, axis=1) > MOVING_M_S
    return middle[real], vectors[real]


def _means(values: AnyFloatArray, group: IntArray) -> FloatArray:
    """Return the (G, 3) mean of the (N, 3) values of each group, by (N,) numbers of all groups."""
    sums = np.stack([np.bincount(group, values[:, a]) for a in range(3)], axis=1)
    return sums / np.bincount(group)[:, None]


LONGEST = 50
"""Length of a trail in frames: five seconds at the rate of the data."""

_LEAST_WAY_M = 1.0  # an actor that moved less is static: boxes of parked cars move by decimetres


class Trail(NamedTuple):
    """The track of one actor up to a frame.

    Attributes:
        actor: number of the track, or of the instance without boxes.
        label: class id.
        points: (K, 3) float64 metres in the world, the frame of the first scan; the last is in the
            present frame.
    """

    actor: int
    label: int
    points: FloatArray


@dataclass
class Trails:
    """Collects the positions of actors over the frames of a sequence, forwards or backwards.

    It keeps `LONGEST` frames around the last one.
    """

    # positions of actors, by frame
    _seen: dict[int, dict[int, FloatArray]] = field(default_factory=dict)

    def follow(
        self, position: int, content: FrameContent, moving: Scan | None
    ) -> tuple[Trail, ...]:
        """Return the trails of the actors in a frame that have moved; empty without poses.

        The position of an actor is that of its box. Without boxes, it is the mean of the points of
        its instance, or of its voxels, if these move.

        Args:
            position: index of the frame in the order of frames.
            content: the frame.
            moving: the moving points or voxels, with flow, as `SceneReader.read_motion` returns
                them.
        """
        if content.pose is None:
            return ()
        actors = list(_actors(content, moving))
        self._seen = {
            at: places for at, places in self._seen.items() if abs(at - position) < LONGEST
        }
        self._seen[position] = {
            actor: transform_points(content.pose, center) for actor, _, center in actors
        }
        ways = defaultdict(list)
        for at in sorted(at for at in self._seen if at <= position):
            for actor, place in self._seen[at].items():
                ways[actor].append(place)
        trails = (Trail(actor, label, np.array(ways[actor])) for actor, label, _ in actors)
        return tuple(
            trail
            for trail in trails
            if np.linalg.norm(np.ptp(trail.points, axis=0)) >= _LEAST_WAY_M
        )


def _actors(content: FrameContent, moving: Scan | None) -> Iterator[tuple[int, int, FloatArray]]:
    """Yield number, class and (3,) position of each actor, in the frame of the sensor."""
    boxes = content.boxes
    if boxes is not None:
        yield from zip(boxes.tracks.tolist(), boxes.labels.tolist(), boxes.centers, strict=True)
        return
    scan = content.scan if moving is None else moving
    if scan is None or scan.instances is None:
        return
    chosen = scan.instances > 0
    if scan.flow is not None:
        chosen &= np.linalg.norm(scan.flow, axis=1) > MOVING_M_S
    actors, first, group = np.unique(scan.instances[chosen], return_index=True, return_inverse=True)
    middles = _means(scan.points[chosen], group.reshape(-1))
    labels = np.zeros(len(group), np.int64) if scan.labels is None else scan.labels[chosen]
    yield from zip(actors.tolist(), labels[first].tolist(), middles, strict=True)
