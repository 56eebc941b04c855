"""The sums and the verdicts of an audit: sums over blocks of successive frames, shares of them, and
a verdict for each check.

The intervals of shares come from a block bootstrap: blocks are drawn with replacement.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from functools import cached_property
from typing import Any, Literal

import numpy as np

from carlasc.core.arrays import FloatArray, IntArray

State = Literal["fault", "undetermined", "sound"]
STATES: tuple[State, ...] = ("fault", "undetermined", "sound")  # worst first

Share = tuple[float, float, float]
"""A number, and the lower and upper end of its interval of 95%."""


@dataclass(frozen=True)
class Verdict:
    """The verdict of one check of one sequence.

    Attributes:
        check: what was checked, such as "shift x"; docs/commands/audit.md lists all.
        state: "fault"; "sound"; "undetermined" if the drive or the files do not determine it.
        value: the number that was measured; None if nothing could be measured.
        low: lower end of its interval of 95%.
        high: upper end.
        unit: of the three numbers; "share" for shares of 1.
        text: what was found, in words.
        where: the sequence.
        advice: what to do; empty if nothing is wrong.
        details: more numbers, such as those by distance; shown on the page.
    """

    check: str
    state: State
    value: float | None
    low: float | None
    high: float | None
    unit: str
    text: str
    where: str
    advice: str = ""
    details: str = ""

    @classmethod
    def of(
        cls,
        where: str,
        check: str,
        state: State | bool,
        text: str,
        value: Share | float | None = None,
        advice: str = "",
        unit: str = "share",
    ) -> Verdict:
        """Return a verdict; True is a fault, and False is sound. Only a fault has advice.

        A number without an interval was counted, not sampled.
        """
        named: State = state if isinstance(state, str) else "fault" if state else "sound"
        share = value if isinstance(value, tuple) else (value, value, value)
        return cls(check, named, *share, unit, text, where, advice if named == "fault" else "")

    def __str__(self) -> str:
        return f"{self.where}: {self.sentence}"

    @property
    def sentence(self) -> str:
        """The check, what was found, and what to do, in a line."""
        return f"{self.check}: {self.text}{f': {self.advice}' if self.advice else ''}"


@dataclass(frozen=True)
class AuditFailure:
    """A frame that could not be audited.

    Attributes:
        where: the sequence.
        frame: the frame of the grids, by its number or token.
        message: why.
    """

    where: str
    frame: str
    message: str


@dataclass(frozen=True)
class AuditResult:
    """What `audit` found.

    Attributes:
        grids: location of the grids.
        scans: location of the scans.
        verdicts: of all checks, by path of the sequence; empty until all parts have counted their
            frames.
        frames: number of audited frames, by path of the sequence.
        placed: the assumed coordinate frame of the grids, in words, by path of the sequence.
        worst: the frames with most wrong voxels, worst first: path, frame of the grids, frame of
            the scan, number of wrong voxels.
        notes: what was assumed.
        failures: frames that could not be audited.
        grid: requested name of the grids.
        elapsed_s: duration, in seconds.
    """

    grids: str
    scans: str
    verdicts: Mapping[str, tuple[Verdict, ...]]
    frames: Mapping[str, int]
    placed: Mapping[str, str]
    worst: tuple[tuple[str, int, int, int], ...] = ()
    notes: tuple[str, ...] = ()
    failures: tuple[AuditFailure, ...] = ()
    grid: str | None = None
    elapsed_s: float = field(default=0.0, compare=False)

    @property
    def ok(self) -> bool:
        """Whether no fault was found, and every frame could be read."""
        return not self.faults and not self.failures

    @property
    def faults(self) -> tuple[Verdict, ...]:
        """The verdicts that are faults."""
        return tuple(
            v for verdicts in self.verdicts.values() for v in verdicts if v.state == "fault"
        )

    def to_dict(self) -> dict[str, Any]:
        """Return everything as plain values for JSON."""
        return {"ok": self.ok} | asdict(self)


DRAWS = 300

Sums = dict[str, IntArray]
"""Counts by name, each an array of its own shape; missing ones are 0."""


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

    def stacked(self, name: str) -> IntArray | None:
        """Return (S, ...) the counts of each stretch; None if no stretch has any."""
        empty = next((np.zeros_like(part[name]) for part in self.parts if name in part), None)
        return None if empty is None else np.stack([part.get(name, empty) for part in self.parts])

    @cached_property
    def _weights(self) -> FloatArray:
        count = len(self.parts)
        drawn = np.random.default_rng(0).multinomial(count, np.full(count, 1 / count), DRAWS)
        return np.concatenate([np.ones((1, count)), drawn])

    def draw(self, counts: IntArray) -> FloatArray:
        """Return (1 + DRAWS, ...) sums of (S, ...) counts: of all stretches, then of stretches that
        are drawn with replacement.
        """
        return np.tensordot(self._weights, counts.astype(np.float64), axes=1)

    def drawn(self, name: str) -> FloatArray | None:
        """Return (1 + DRAWS, ...) sums; None if no stretch has any."""
        counts = self.stacked(name)
        return None if counts is None else self.draw(counts)

    def share(self, name: str) -> Share | None:
        """Return the share of the second of two counts in the first; None if the first is missing
        or 0.
        """
        drawn = self.drawn(name)
        return None if drawn is None else share_of(drawn[:, 1], drawn[:, 0])


def share_of(part: FloatArray, whole: FloatArray) -> Share | None:
    """Return a share and its interval from (1 + DRAWS,) sums; None if the whole is 0."""
    if not whole[0] > 0:
        return None
    shares = part / np.where(whole > 0, whole, np.nan)
    low, high = np.nanquantile(shares[1:], (0.025, 0.975)).tolist()
    return float(shares[0]), min(low, float(shares[0])), max(high, float(shares[0]))
