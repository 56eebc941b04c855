"""Counts that add up over frames, by stretches of frames; and shares of them, with intervals from stretches that are drawn with replacement."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

DRAWS = 300

Sums = dict[str, NDArray[np.int64]]
"""Counts by name, each an array of its own shape; missing ones are 0."""

Share = tuple[float, float, float]
"""A number, and the lower and upper end of its interval of 95 %."""


def add(sums: Sums, name: str, counts: object) -> None:
    """Add counts to those of a name."""
    sums[name] = sums.get(name, np.int64(0)) + np.asarray(counts, np.int64)


@dataclass(frozen=True)
class Stretches:
    """The sums of a sequence.

    Attributes:
        parts: the sums of each stretch, in order.
    """

    parts: Sequence[Sums]

    def stacked(self, name: str) -> NDArray[np.int64] | None:
        """Return (S, ...) the counts of each stretch; None if no stretch has any."""
        empty = next((np.zeros_like(part[name]) for part in self.parts if name in part), None)
        return None if empty is None else np.stack([part.get(name, empty) for part in self.parts])

    @cached_property
    def _weights(self) -> NDArray[np.float64]:
        count = len(self.parts)
        drawn = np.random.default_rng(0).multinomial(count, np.full(count, 1 / count), DRAWS)
        return np.concatenate([np.ones((1, count)), drawn])

    def draw(self, counts: NDArray[np.int64]) -> NDArray[np.float64]:
        """Return (1 + DRAWS, ...) the sum of (S, ...) counts of all stretches, then of stretches drawn with replacement."""
        return np.tensordot(self._weights, counts.astype(np.float64), axes=1)

    def drawn(self, name: str) -> NDArray[np.float64] | None:
        """Return (1 + DRAWS, ...) sums; None if no stretch has any."""
        counts = self.stacked(name)
        return None if counts is None else self.draw(counts)

    def share(self, name: str) -> Share | None:
        """Return the share of the second of two counts in the first; None if there is nothing to share."""
        drawn = self.drawn(name)
        return None if drawn is None else share_of(drawn[:, 1], drawn[:, 0])


def share_of(part: NDArray[np.float64], whole: NDArray[np.float64]) -> Share | None:
    """Return a share and its interval from (1 + DRAWS,) sums; None if the whole is 0."""
    if not whole[0] > 0:
        return None
    shares = part / np.where(whole > 0, whole, np.nan)
    low, high = np.nanquantile(shares[1:], (0.025, 0.975)).tolist()
    return float(shares[0]), min(low, float(shares[0])), max(high, float(shares[0]))
