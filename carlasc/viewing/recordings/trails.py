"""The ways of actors through the world, as far as a frame and its predecessors show them."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from carlasc.core.geometry import transform_points
from carlasc.viewing.scene import FrameContent

LONGEST = 50
"""Frames that a trail reaches back: five seconds at the rate of the data."""

_LEAST_WAY_M = 1.0  # what moved less stands: boxes of parked cars move by decimetres
_MOVING_M_S = 0.2


class Trail(NamedTuple):
    """The way of one actor up to a frame.

    Attributes:
        actor: number of the track, or of the instance where there are no boxes.
        label: class id.
        points: (K, 3) float64 metres in the world, the frame of the first scan; the last is in the present frame.
    """

    actor: int
    label: int
    points: NDArray[np.float64]


@dataclass
class Trails:
    """Follows the actors of a sequence from frame to frame. It remembers `LONGEST` frames, however long the sequence is."""

    _ways: dict[int, deque[NDArray[np.float64]]] = field(default_factory=dict)
    _missed: dict[int, int] = field(default_factory=dict)

    def follow(self, content: FrameContent) -> tuple[Trail, ...]:
        """Return the trails of the actors that a frame shows and that have moved; none without poses.

        An actor is where its box is. In sequences without boxes, it is in the middle of the points of its instance, if these move.
        """
        if content.pose is None:
            return ()
        trails, seen = [], set()
        for actor, label, center in _actors(content):
            seen.add(actor)
            way = self._ways.setdefault(actor, deque(maxlen=LONGEST))
            way.append(transform_points(content.pose, center))
            points = np.array(way)
            if np.linalg.norm(points.max(0) - points.min(0)) >= _LEAST_WAY_M:
                trails.append(Trail(actor, label, points))
        self._missed = {actor: 0 if actor in seen else self._missed.get(actor, 0) + 1 for actor in self._ways}
        for actor in [actor for actor, missed in self._missed.items() if missed >= LONGEST]:
            del self._ways[actor]
        return tuple(trails)


def _actors(content: FrameContent) -> Iterator[tuple[int, int, NDArray[np.float64]]]:
    """Yield the number, the class and the (3,) position of each actor, in the frame of the sensor."""
    scan, boxes = content.scan, content.boxes
    if boxes is not None:
        yield from zip(boxes.tracks.tolist(), boxes.labels.tolist(), boxes.centers, strict=True)
        return
    if scan is None or scan.instances is None:
        return
    chosen = scan.instances > 0
    if scan.flow is not None:
        chosen &= np.linalg.norm(scan.flow, axis=1) > _MOVING_M_S
    actors, first, group = np.unique(scan.instances[chosen], return_index=True, return_inverse=True)
    points = scan.points[chosen].astype(np.float64)
    count = np.bincount(group.reshape(-1), minlength=len(actors))
    middles = np.stack([np.bincount(group.reshape(-1), points[:, a], len(actors)) for a in range(3)], axis=1)
    labels = np.zeros(len(points), np.int64) if scan.labels is None else scan.labels[chosen]
    yield from zip(actors.tolist(), labels[first].tolist(), middles / count[:, None], strict=True)
