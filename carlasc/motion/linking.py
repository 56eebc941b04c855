"""Linking: the segments of each actor, linked from scan to scan into chains.

Scans are added to a `Linker` in order of time. A chain ends when its actor was not seen for some
time, so memory does not grow with the length of a drive.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from functools import reduce
from itertools import compress, islice

import numpy as np

from carlasc.core.arrays import FloatArray
from carlasc.motion.paths import Segment
from carlasc.motion.segments import LINKED_M_S, StaticPoints
from carlasc.motion.solving import best_pairs

_MAX_GAP_S = 1.55  # an actor may be hidden for this time
_NUMBERED_GAP_S = 10.0  # a numbered actor is the same after this time
_BACKWARDS_S = 12.0  # an actor that starts is searched for in the scans of this time before
_FARTHEST_M, _MAX_SPEED_M_S = 15.0, 40.0  # fast first test: no actor is longer or faster
_GATE_M = 1.5  # maximum distance of a segment from the prediction of its track
_NUMBERED_GATE_M = 6.0  # the same for a numbered actor, of which another part may be visible
_OTHER_CLASS = 1.0  # cost of a change of class: labels may be wrong
_OTHER_NUMBER = 2.0  # cost of a change of number
_SOON_S = 1.0  # after more than this, a numbered actor may be anywhere
_HISTORY_S = 0.3  # a velocity is estimated over at least this time, if the scans have no flow
_STOPPING_M_S = 1.5  # slower actors may be static in the next scan, or in the previous one

_UNKNOWN = np.full(3, np.nan)  # a velocity

Chain = list[Segment]


class Linker:
    """Links segments, scan by scan.

    Numbered actors are linked by their numbers where possible, and all other actors by prediction:
    a segment continues the chain whose predicted position is nearest, also after the actor was
    hidden for some time. Chains of its class come first.
    """

    def __init__(self) -> None:
        self._chains: list[Chain] = []
        self._numbered: list[Chain] = []
        self._seconds: dict[int, float] = {}  # of the frames of open chains
        self._static: deque[tuple[float, StaticPoints]] = deque()

    def add(
        self,
        frame: int,
        seconds: float,
        segments: Sequence[Segment],
        static: StaticPoints | None = None,
    ) -> list[Chain]:
        """Add the segments of the next scan, and return the chains that ended.

        Args:
            frame: frame number.
            seconds: time of the scan.
            segments: the actors of the scan.
            static: its static points. An actor that stops, as at a crossing, is found in them until
                it continues.
        """
        self._seconds[frame] = seconds
        ended = self._end(seconds)
        self._link_numbers([s for s in segments if s.instance], seconds)
        alive = list(self._chains)
        for segment, chain in self._match([s for s in segments if not s.instance], alive):
            if chain is None:
                self._chains.append([*self._before(segment), segment])
            else:
                chain.append(segment)
        if static is not None:
            for chain in alive:  # a slow actor that was not found may have stopped
                if chain[-1].frame < frame and _is_slow(chain[-1]):
                    rest = static.segment_at(chain[-1])
                    if rest is not None:
                        chain.append(rest)
            self._static.append((seconds, static))
            while self._static[0][0] < seconds - _BACKWARDS_S:
                self._static.popleft()
        return ended

    def finish(self) -> list[Chain]:
        """Return the chains that have not ended."""
        rest = [*self._numbered, *self._chains]
        self._numbered, self._chains = [], []
        return rest

    def _end(self, seconds: float) -> list[Chain]:
        """Remove and return the chains whose actors were not seen for the maximum gap."""
        over: list[Chain] = []
        for chains, gap_s in ((self._chains, _MAX_GAP_S), (self._numbered, _NUMBERED_GAP_S)):
            late = [seconds - self._seconds[chain[-1].frame] > gap_s for chain in chains]
            over += compress(chains, late)
            chains[:] = [chain for chain, is_late in zip(chains, late, strict=True) if not is_late]
        kept_s = _NUMBERED_GAP_S + _MAX_GAP_S
        self._seconds = {
            frame: then for frame, then in self._seconds.items() if seconds - then <= kept_s
        }
        return over

    def _link_numbers(self, segments: list[Segment], seconds: float) -> None:
        """Continue the chains of numbered actors: by number where possible, otherwise by predicted
        position.
        """
        linked: dict[int, int] = {}
        for i, j, is_other in (
            self._candidates(segments, seconds) if segments and self._numbered else ()
        ):
            if i not in linked and not (is_other and j in linked.values()):
                linked[i] = j
        for j, chain in enumerate(self._numbered):
            parts = [segments[i] for i, continued in linked.items() if continued == j]
            if parts:
                chain.append(reduce(Segment.joined, parts))
        self._numbered += [[segment] for i, segment in enumerate(segments) if i not in linked]

    def _candidates(self, segments: list[Segment], seconds: float) -> list[tuple[int, int, bool]]:
        """Return (segment, chain, whether the number changes) of the possible links of numbered
        actors, the best first.
        """
        elapsed = np.array([seconds - self._seconds[chain[-1].frame] for chain in self._numbered])
        velocity = np.stack([self._velocity(chain) for chain in self._numbered])
        velocity[elapsed > _SOON_S] = np.nan
        is_lost = np.isnan(velocity[:, 0])
        shift = np.where(is_lost, 0.0, velocity.T * elapsed).T
        gap = _gaps(segments, [chain[-1] for chain in self._numbered], shift)
        change = np.nan_to_num(_lengths(_velocities(segments)[:, None] - velocity))
        numbers = np.array([segment.instance for segment in segments])
        is_other = numbers[:, None] != np.array([chain[0].instance for chain in self._numbered])
        far = _NUMBERED_GATE_M + np.where(
            elapsed > _SOON_S, np.inf, np.where(is_lost, _MAX_SPEED_M_S * elapsed, 0.0)
        )
        possible = gap < np.where(is_other, np.where(is_lost, 0.0, _GATE_M), far)
        cost = gap + change + is_other * _OTHER_NUMBER
        costs = sorted((float(cost[i, j]), i, j) for i, j in np.argwhere(possible).tolist())
        return [(i, j, bool(is_other[i, j])) for _, i, j in costs]

    def _velocity(self, chain: Chain) -> FloatArray:
        """Return the (3,) velocity, m/s, of an actor in its last segment; NaN if it is unknown."""
        last = chain[-1]
        if last.velocity is not None:
            return last.velocity
        now = self._seconds[last.frame]
        for before in islice(reversed(chain), 1, None):
            elapsed = now - self._seconds.get(before.frame, now)
            if elapsed >= _HISTORY_S:
                velocity: FloatArray = (last.center - before.center) / elapsed
                return velocity
        return _UNKNOWN

    def _before(self, segment: Segment) -> Chain:
        """Return the segments of earlier scans in which the actor of a new chain was static at the
        start of the chain.
        """
        earlier: Chain = []
        for _, static in reversed(self._static):
            rest = static.segment_at(segment) if _is_slow(segment) else None
            if rest is None:
                break
            segment = rest
            earlier.append(rest)
        return earlier[::-1]

    def _match(
        self, segments: list[Segment], alive: list[Chain]
    ) -> list[tuple[Segment, Chain | None]]:
        """Pair the segments of one scan with the chains that they continue: the nearest prediction
        first, each chain once.
        """
        if not segments or not alive:
            return [(segment, None) for segment in segments]
        last = [chain[-1] for chain in alive]
        elapsed = np.array(
            [self._seconds[segments[0].frame] - self._seconds[end.frame] for end in last]
        )
        centers, velocity, before = (
            np.stack([s.center for s in segments])[:, None],
            _velocities(segments)[:, None],
            _velocities(last),
        )
        shift = (before + velocity) / 2 * elapsed[:, None]
        # The visible part of an actor changes: the gap between boxes counts most, and their centres
        # have little weight.
        gap, change = _gaps(segments, last, shift), _lengths(velocity - before)
        offset = _lengths(np.stack([end.points.mean(axis=0) for end in last]) + shift - centers)
        is_other = np.array([s.label for s in segments])[:, None] != np.array(
            [end.label for end in last]
        )
        reach = _FARTHEST_M + _MAX_SPEED_M_S * elapsed
        possible = (gap <= _GATE_M) & (change <= LINKED_M_S)
        possible &= _lengths(np.stack([end.center for end in last]) - centers) < reach
        cost = gap + change + 0.1 * offset + is_other * _OTHER_CLASS
        candidates = [(float(cost[i, j]), i, j) for i, j in np.argwhere(possible).tolist()]
        taken = best_pairs(candidates)
        return [
            (segment, alive[taken[i]] if i in taken else None) for i, segment in enumerate(segments)
        ]


def _velocities(segments: list[Segment]) -> FloatArray:
    """Return the (S, 3) velocities of segments, m/s, world; NaN where the scan has no flow."""
    return np.stack(
        [_UNKNOWN if segment.velocity is None else segment.velocity for segment in segments]
    )


def _lengths(vectors: FloatArray) -> FloatArray:
    # the same sum on every processor
    lengths: FloatArray = np.linalg.norm(vectors, axis=-1)
    return lengths


def _is_slow(segment: Segment) -> bool:
    return (
        segment.velocity is not None and float(np.square(segment.velocity).sum()) < _STOPPING_M_S**2
    )


def _gaps(segments: list[Segment], ends: list[Segment], shifts: FloatArray) -> FloatArray:
    """Return the (S, C) gaps, metres, between the bounding boxes of segments and of `ends` moved by
    (C, 3) or (S, C, 3); 0 if they overlap.
    """
    lower, upper = (
        np.stack([bound(s.points, axis=0) for s in segments])[:, None] for bound in (np.min, np.max)
    )
    lowest, highest = (
        np.stack([bound(s.points, axis=0) for s in ends]) + shifts for bound in (np.min, np.max)
    )
    return _lengths(np.maximum(np.maximum(lowest - upper, lower - highest), 0.0))
