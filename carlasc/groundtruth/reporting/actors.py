"""How well moving actors are tracked: how often each is seen, and how well its sightings overlay when its motion is undone."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from carlasc.core.classes import ClassTable
from carlasc.core.geometry import Transform, invert, thin, transform_points

_MOST_POINTS, _MOST_ASKED = 600, 50  # of one sighting: that are looked at, and whose distance is measured


@dataclass(frozen=True)
class Residual:
    """How well a sighting of an actor overlays with the next one.

    Attributes:
        moving_m: sum of the distances from points of one to the nearest points of the other, once the motion is undone, metres.
        standing_m: the same, if the actor is taken to stand still.
        count: number of these points.
    """

    moving_m: float
    standing_m: float
    count: int

    @classmethod
    def between(
        cls,
        one: NDArray[np.floating],
        other: NDArray[np.floating],
        world_T_actor: Transform,
        world_T_next: Transform,
    ) -> Residual:
        """Compare two sightings.

        Args:
            one: (N, 3) points of a sighting, metres, world.
            other: (M, 3) points of the next one.
            world_T_actor: (4, 4) pose of the actor at the first sighting.
            world_T_next: (4, 4) its pose at the next one.
        """
        one, other = thin(one, _MOST_POINTS), thin(other, _MOST_POINTS)
        standing = _distances(one, other)
        moving = _distances(transform_points(invert(world_T_actor), one), transform_points(invert(world_T_next), other))
        return cls(float(moving.sum()), float(standing.sum()), len(moving))


@dataclass(frozen=True)
class Actor:
    """A moving actor that was tracked.

    Attributes:
        label: name of its class.
        instance: its number in the data; 0 if actors are not numbered.
        first: first frame in which it was seen.
        last: last frame in which it was seen.
        sightings: number of frames in which it was seen.
        points: number of its points in all sightings.
        speed_m_s: its median speed, metres per second.
        size_m: length, width and height of its body, metres.
        seen_m: length, width and height of what was seen of it, metres.
        faces: number of its sides that were seen: front, rear, left and right.
        residual_m: how well neighbouring sightings overlay once the motion is undone: mean distance from a point of one to the nearest
            point of the one before or after, metres; None if none were compared. It is at least the distance between neighbouring points.
        residual_standing_m: the same for an actor that is taken to stand still; a motion that is true makes `residual_m` smaller.
    """

    label: str
    instance: int
    first: int
    last: int
    sightings: int
    points: int
    speed_m_s: float
    size_m: tuple[float, float, float]
    seen_m: tuple[float, float, float]
    faces: int
    residual_m: float | None
    residual_standing_m: float | None

    @classmethod
    def of(cls, summary: Mapping[str, Any], residuals: Sequence[Residual], classes: ClassTable) -> Actor:
        """Return the actor that a summary of the tracks describes."""
        length, width, height = summary["size_m"]
        seen_length, seen_width, seen_height = summary["seen_m"]
        count = sum(residual.count for residual in residuals)
        return cls(
            label=classes.names.get(summary["label"], str(summary["label"])),
            instance=summary["instance"],
            first=summary["first"],
            last=summary["last"],
            sightings=summary["scans"],
            points=summary["points"],
            speed_m_s=summary["speed_m_s"],
            size_m=(length, width, height),
            seen_m=(seen_length, seen_width, seen_height),
            faces=summary["faces"],
            residual_m=round(sum(r.moving_m for r in residuals) / count, 4) if count else None,
            residual_standing_m=round(sum(r.standing_m for r in residuals) / count, 4) if count else None,
        )


def actors_of(
    summaries: Sequence[Mapping[str, Any]], residuals: Iterable[Mapping[int, Residual]], classes: ClassTable
) -> tuple[Actor, ...]:
    """Return the moving actors, in order of their first sighting.

    Args:
        summaries: what was found of each actor, by its number.
        residuals: how well the sightings in each frame overlay with the next ones, by number.
        classes: class table of the labels.
    """
    by_actor: dict[int, list[Residual]] = {}
    for frame in residuals:
        for number, residual in frame.items():
            by_actor.setdefault(number, []).append(residual)
    actors = [Actor.of(s, by_actor.get(i, []), classes) for i, s in enumerate(summaries) if s["moves"]]
    return tuple(sorted(actors, key=lambda actor: (actor.first, actor.label, actor.instance)))


def _distances(one: NDArray[np.floating], other: NDArray[np.floating]) -> NDArray[np.floating]:
    """Return the distances from some points of each sighting to the nearest point of the other, metres."""
    found = []
    for asked, others in ((one, other), (other, one)):
        squares = np.square(thin(asked, _MOST_ASKED)[:, None] - others[None]).sum(axis=2)
        found.append(np.sqrt(squares.min(axis=1)))
    return np.concatenate(found)
