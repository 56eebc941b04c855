"""The motion of a drive whose scans are all in memory: what the pass of a run does block by block."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass
from itertools import chain

import numpy as np
from numpy.typing import NDArray

from carlasc.motion import (
    ActorFollower,
    EvidenceScan,
    Linker,
    Segment,
    StaticPoints,
    Track,
    complete_bodies,
    find_evidence,
    make_track,
)
from carlasc.motion.found_actors import FoundActor


def link_segments(
    segments: Iterable[Segment],
    times: Mapping[int, float],
    static: Mapping[int, StaticPoints] | None = None,
    *,
    deformable: Collection[int] = (),
) -> list[Track]:
    """Link the segments of several scans into tracks.

    Args:
        segments: the segments of all scans, in any order.
        times: seconds by frame, for every frame with a segment.
        static: the static points of each scan, in which an actor that stops, for example at a
            crossing, is found until it continues.
        deformable: classes whose actors change their shape; without flow, the centre of their
            points is followed.

    Returns:
        Tracks in order of their first segment, with whole bodies.
    """
    by_frame: dict[int, list[Segment]] = {}
    for segment in segments:
        by_frame.setdefault(segment.frame, []).append(segment)
    linker = Linker()
    chains: list[list[Segment]] = []
    for frame in sorted(by_frame.keys() | (static or {}).keys()):
        chains += linker.add(
            frame, times[frame], by_frame.get(frame, []), (static or {}).get(frame)
        )
    chains += linker.finish()
    return complete_bodies([make_track(chain, times, deformable=deformable) for chain in chains])


@dataclass(frozen=True)
class FoundActors:
    """What moved in a drive.

    Attributes:
        moved: (M,) int64 indices of the points of each frame that belong to something that moved,
            tracked or not. They must be left out of other frames.
        tracked: the actors whose observations align better along an estimated path than without
            motion.
        own: (6,) lower and upper corners of the parts of the recording vehicle.
    """

    moved: Mapping[int, NDArray[np.int64]]
    tracked: tuple[FoundActor, ...]
    own: tuple[NDArray[np.float64], ...]

    @property
    def segments(self) -> list[Segment]:
        """The segments of all tracked actors, for `link_segments`."""
        return [segment for actor in self.tracked for segment in actor.segments]


def find_actors(
    scans: Iterable[EvidenceScan],
    *,
    movable: Collection[int] = (),
    deformable: Collection[int] = (),
    first_instance: int = 1,
    default_label: int = 0,
) -> FoundActors:
    """Find what moved in the scans of a drive from the free space that other scans saw, and follow
    it over time.

    Scans are read one by one, and only those of some seconds are held. A block of a drive gives the
    same evidence as the whole drive, if the scans of `HORIZON_S` before and after it are given too.

    Args:
        scans: the scans in order of time, in one world frame whose z is up.
        movable: classes of objects that can move, if the scans have labels.
        deformable: classes of objects that change their shape as they move. Without labels, the
            size tells.
        first_instance: number of the first actor; others follow.
        default_label: class of actors without labels.

    Returns:
        The points that moved, and the actors with enough evidence.
    """
    follower = ActorFollower(
        deformable=deformable, first_instance=first_instance, default_label=default_label
    )
    ended = [follower.add(evidence) for evidence in find_evidence(scans, movable=movable)]
    tracked = [
        actor
        for actor in chain.from_iterable([*ended, follower.finish()])
        if actor.segments[0].instance not in follower.riders
    ]
    return FoundActors(follower.moved, tuple(tracked), tuple(follower.own))
