"""One number for each actor over a whole sequence, although its tracks may be several."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from carlasc.core.geometry import invert, multiply
from carlasc.motion.tracks import FIRST_MOVER, Track

_FEWEST_COMMON = 3  # frames in which two tracks must have poses to be compared
_AROUND_M = 0.3  # what is so near to a body may be a part of it
_INSIDE = 0.7  # part of them in which one is in the other's body, if both are of one actor


def number_actors(tracks: Mapping[int, Track], highest: int = 0) -> dict[int, int]:
    """Return the number of the actor of each track, by the number of the track.

    It is that of the data where these have numbers. Other tracks are numbered above all of them, in the order in which they begin. Tracks are of
    one actor if they have one class, no two numbers, and the middle of what was seen of the smaller one is in the larger one's body most of the time; people only
    where not both were seen in one scan.

    Args:
        tracks: what moves.
        highest: the highest number that the data have.
    """
    order = sorted(tracks, key=lambda number: (tracks[number].first, number))
    group = {number: number for number in order}
    numbers = {n: t.instance for n, t in tracks.items() if 0 < t.instance < FIRST_MOVER}

    def root(number: int) -> int:
        while group[number] != number:
            number = group[number]
        return number

    for row, one in enumerate(order):
        end = tracks[one].first + len(tracks[one].world_T_actor)
        for other in order[row + 1 :]:
            if tracks[other].first > end - _FEWEST_COMMON:
                break
            first, second = root(one), root(other)
            may_join = first != second and not (first in numbers and second in numbers)
            if may_join and _are_one(tracks[one], tracks[other]):
                kept, joined = (second, first) if second in numbers else (first, second)
                group[joined] = kept
    following = max([highest, *numbers.values()], default=0)
    seen: dict[int, set[int]] = {}  # scans in which each number of the data was seen
    found: dict[int, int] = {}
    for number in sorted(order, key=lambda number: (-len(tracks[number].members), number)):
        own = root(number)
        if own in found or own not in numbers:
            continue
        members = {f for n in order if root(n) == own for f in tracks[n].members}
        if not members & seen.get(
            numbers[own], set()
        ):  # otherwise the number is in two places, and the longer track has it
            seen.setdefault(numbers[own], set()).update(members)
            found[own] = numbers[own]
    for number in order:
        if root(number) not in found:
            following += 1
            found[root(number)] = following
    return {number: found[root(number)] for number in order}


def _are_one(one: Track, other: Track) -> bool:
    """Return whether two tracks are of one actor."""
    if one.label != other.label or ((not one.rigid or not other.rigid) and set(one.members) & set(other.members)):
        return False
    small, large = sorted((one, other), key=lambda track: float(np.prod(track.size)))
    begin = max(one.first, other.first)
    end = min(one.first + len(one.world_T_actor), other.first + len(other.world_T_actor))
    if end - begin < _FEWEST_COMMON:
        return False
    poses = (track.world_T_actor[begin - track.first : end - track.first] for track in (large, small))
    large_T_world, world_T_small = invert(next(poses)), next(poses)
    seen = (small.extent.lower + small.extent.upper) / 2  # of what was completed, nobody knows where it is
    middle = multiply(large_T_world, world_T_small, np.append(seen, 1.0)[:, None])[:, :3, 0]
    inside = ((middle > large.lower - _AROUND_M) & (middle < large.upper + _AROUND_M)).all(axis=1)
    return bool(inside.mean() >= _INSIDE)
