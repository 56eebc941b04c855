"""Linking: the segments of one actor in consecutive scans become a chain.

Scans are added one after the other, and a chain ends when its actor was not seen for a while: memory does not grow with the length of a drive.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence

import numpy as np

from carlasc.motion.segments import Segment, Standing

MAX_GAP_S = 1.55  # an actor may be hidden for this time
_NUMBERED_GAP_S = 10.0  # a numbered actor is the same after this time
_BACKWARDS_S = 12.0  # an actor that starts is looked for in the scans of this time before
_REACH_M, _MAX_SPEED_M_S = 15.0, 40.0  # fast first test: no actor is longer or faster
_GATE_M = 1.5  # maximum distance of a segment from the prediction of its track
_SAME_VELOCITY_M_S = 2.0  # maximum change of an actor's velocity between two segments
_STOPPING_M_S = 1.5  # slower actors may be standing in the next scan, or in the previous one

Chain = list[Segment]


class Linker:
    """Links segments, scan by scan.

    Numbered actors are linked by their numbers, others by prediction: a segment continues the chain of its class whose predicted position
    is nearest to it, also after the actor was hidden for some time.
    """

    def __init__(self) -> None:
        self._chains: list[Chain] = []
        self._numbered: dict[int, Chain] = {}
        self._seconds: dict[int, float] = {}  # of the frames of live chains
        self._standing: deque[tuple[float, Standing]] = deque()

    def add(
        self, frame: int, seconds: float, segments: Sequence[Segment], standing: Standing | None = None
    ) -> list[Chain]:
        """Add the segments of the next scan, and return the chains that ended.

        Args:
            frame: frame number.
            seconds: time of the scan.
            segments: the actors of the scan.
            standing: its standing points, in which an actor that stops, for example at a crossing, is found until it continues.
        """
        self._seconds[frame] = seconds
        ended = self._end(seconds)
        for segment in segments:
            if segment.instance:
                self._numbered.setdefault(segment.instance, []).append(segment)
        alive = list(self._chains)
        for segment, chain in self._match([s for s in segments if not s.instance], alive):
            if chain is None:
                self._chains.append([*self._before(segment), segment])
            else:
                chain.append(segment)
        if standing is not None:
            for chain in alive:  # a slow actor that was not found may have stopped
                if chain[-1].frame < frame and _is_slow(chain[-1]):
                    rest = standing.segment_at(chain[-1])
                    if rest is not None:
                        chain.append(rest)
            self._standing.append((seconds, standing))
            while self._standing[0][0] < seconds - _BACKWARDS_S:
                self._standing.popleft()
        return ended

    def finish(self) -> list[Chain]:
        """Return the chains that have not ended."""
        rest = [*self._numbered.values(), *self._chains]
        self._numbered, self._chains = {}, []
        return rest

    def _end(self, seconds: float) -> list[Chain]:
        """Remove and return the chains whose actors were not seen for too long."""
        over = [chain for chain in self._chains if seconds - self._seconds[chain[-1].frame] > MAX_GAP_S]
        self._chains = [chain for chain in self._chains if seconds - self._seconds[chain[-1].frame] <= MAX_GAP_S]
        for number, chain in list(self._numbered.items()):
            if seconds - self._seconds[chain[-1].frame] > _NUMBERED_GAP_S:
                over.append(self._numbered.pop(number))
        oldest = min((c[-1].frame for c in [*self._chains, *self._numbered.values()]), default=None)
        self._seconds = {f: s for f, s in self._seconds.items() if s == seconds or (oldest is not None and f >= oldest)}
        return over

    def _before(self, segment: Segment) -> Chain:
        """Return segments from the scans in which the actor of a new chain was standing where the chain starts."""
        found: Chain = []
        for _, standing in reversed(self._standing):
            rest = standing.segment_at(segment) if _is_slow(segment) else None
            if rest is None:
                break
            segment = rest
            found.append(rest)
        return found[::-1]

    def _match(self, found: list[Segment], alive: list[Chain]) -> list[tuple[Segment, Chain | None]]:
        """Pair the segments of one scan with the chains that they continue: nearest prediction first, each chain once."""
        if not found or not alive:
            return [(segment, None) for segment in found]
        candidates = []
        ends = np.stack([chain[-1].center for chain in alive])
        elapsed = np.array([self._seconds[found[0].frame] - self._seconds[chain[-1].frame] for chain in alive])
        for i, segment in enumerate(found):
            near = np.linalg.norm(ends - segment.center, axis=1) < _REACH_M + _MAX_SPEED_M_S * elapsed
            for j in np.flatnonzero(near).tolist():
                cost = _cost(alive[j][-1], segment, float(elapsed[j]))
                if cost is not None:
                    candidates.append((cost, i, j))
        taken: dict[int, int] = {}
        for _, i, j in sorted(candidates):
            if i not in taken and j not in taken.values():
                taken[i] = j
        return [(segment, alive[taken[i]] if i in taken else None) for i, segment in enumerate(found)]


def _is_slow(segment: Segment) -> bool:
    return segment.velocity is not None and float(np.square(segment.velocity).sum()) < _STOPPING_M_S**2


def _cost(last: Segment, segment: Segment, elapsed_s: float) -> float | None:
    """Return how much a segment differs from the prediction of its predecessor; None if it cannot be the same actor."""
    if last.label != segment.label or last.velocity is None or segment.velocity is None:
        return None
    change = float(np.linalg.norm(segment.velocity - last.velocity))
    predicted = last.points + (last.velocity + segment.velocity) / 2 * elapsed_s
    # The visible part of an actor changes, so the gap between boxes is compared first, and their centres have little weight.
    gap = np.maximum(
        predicted.min(axis=0) - segment.points.max(axis=0), segment.points.min(axis=0) - predicted.max(axis=0)
    )
    distance = float(np.linalg.norm(np.maximum(gap, 0.0)))
    if distance > _GATE_M or change > _SAME_VELOCITY_M_S:
        return None
    offset = float(np.linalg.norm(predicted.mean(axis=0) - segment.center))
    return distance + change + 0.1 * offset
