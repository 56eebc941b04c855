"""What an audit says: the verdict of each check, and the result of them all."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from typing import Any, Literal

State = Literal["fault", "undetermined", "sound"]
STATES: tuple[State, ...] = ("fault", "undetermined", "sound")  # worst first


@dataclass(frozen=True)
class Verdict:
    """The verdict of one check of one sequence.

    Attributes:
        check: what was checked, such as "shift x"; docs/commands/audit.md lists all.
        state: "fault"; "sound"; "undetermined" where the drive or the files cannot tell.
        value: the number that was measured; None if nothing could be measured.
        low: lower end of its interval of 95 %.
        high: upper end.
        unit: of the three numbers; "share" for shares of 1.
        text: what was found, in words.
        where: the sequence.
        advice: what to fix; empty if nothing is wrong.
        details: more numbers in words, such as those by distance; shown on the page.
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

    def __str__(self) -> str:
        return f"{self.where}: {self.sentence}"

    @property
    def sentence(self) -> str:
        """The check, what was found, and what to fix, in a line."""
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
        grids: where the grids are.
        scans: where the scans are.
        verdicts: of all checks, by path of the sequence; empty if other parts have still to count their frames.
        frames: number of audited frames, by path of the sequence.
        placed: the frame that the grids are taken to be in, in words, by path of the sequence.
        worst: the frames with most wrong voxels, worst first: path, frame of the grids, frame of the scan, number of wrong voxels.
        notes: what was assumed.
        failures: frames that could not be audited.
        grid: name of the grids that was asked for.
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
        """Whether nothing is wrong, as far as the drives tell, and every frame could be read."""
        return not self.faults and not self.failures

    @property
    def faults(self) -> tuple[Verdict, ...]:
        """The verdicts that are faults."""
        return tuple(v for verdicts in self.verdicts.values() for v in verdicts if v.state == "fault")

    def to_dict(self) -> dict[str, Any]:
        """Return everything as plain values for JSON."""
        return {"ok": self.ok} | asdict(self)
