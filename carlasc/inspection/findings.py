"""What the checks have to say: a finding is one fault, in one place, with what to do about it."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from typing import Any, Literal

Severity = Literal["error", "warning", "note"]
SEVERITIES: tuple[Severity, ...] = ("error", "warning", "note")

_HOUSE_FORM = re.compile(r"(?P<where>.*?): expected (?P<expected>.*?), found (?P<found>.*)", re.DOTALL)


@dataclass(frozen=True)
class Finding:
    """One fault.

    Attributes:
        severity: "error": a reader fails on it or learns something wrong; "warning": likely a mistake; "note": good to know.
        check: the check that found it, a short name such as "file-size"; findings are grouped by it.
        sequence: path of the sequence in its Source.
        location: the file or the folder.
        expected: what should be there.
        found: what is.
        advice: what to do about it; empty where nothing better than looking at the file can be said.
    """

    severity: Severity
    check: str
    sequence: str
    location: str
    expected: str
    found: str
    advice: str = ""

    @classmethod
    def from_error(cls, check: str, sequence: str, location: str, error: Exception, advice: str = "") -> Finding:
        """Turn an error of the library, "<where>: expected <this>, found <that>", into a finding of severity "error"."""
        text = str(error)
        match = _HOUSE_FORM.fullmatch(text)
        if match is None:
            return cls("error", check, sequence, location, "something that can be read", text, advice)
        return cls("error", check, sequence, match["where"], match["expected"], match["found"], advice)

    def __str__(self) -> str:
        text = f"{self.location}: expected {self.expected}, found {self.found}"
        return f"{text}: {self.advice}" if self.advice else text


@dataclass(frozen=True)
class SequenceReport:
    """What was looked at in a sequence, and the figures that came out of it.

    Attributes:
        path: the sequence's path in its Source.
        frames: number of frames.
        sampled: number of frames whose contents were read.
        voxel_share: by grid, the mean share of the points in known space that lie in a voxel of their class (of any class where
            points carry no labels); absent where it could not be measured.
        pose_share: mean share of a scan's structure that the poses put on the structure of an earlier scan; None where not measured.
    """

    path: str
    frames: int
    sampled: int
    voxel_share: Mapping[str, float] = field(default_factory=dict)
    pose_share: float | None = None


@dataclass(frozen=True)
class ValidationResult:
    """What `validate` found.

    Attributes:
        location: what was validated.
        findings: in the order of the sequences; worst first within a sequence.
        sequences: what was looked at.
    """

    location: str
    findings: tuple[Finding, ...]
    sequences: tuple[SequenceReport, ...]

    @property
    def ok(self) -> bool:
        """Whether there is no error; warnings and notes may stand."""
        return self.count("error") == 0

    def count(self, severity: Severity) -> int:
        """Return the number of findings of a severity."""
        return sum(finding.severity == severity for finding in self.findings)

    def grouped(self) -> dict[tuple[Severity, str], list[Finding]]:
        """Return the findings by severity and check, worst first."""
        groups: dict[tuple[Severity, str], list[Finding]] = {}
        for severity in SEVERITIES:
            for finding in self.findings:
                if finding.severity == severity:
                    groups.setdefault((severity, finding.check), []).append(finding)
        return groups

    def to_dict(self) -> dict[str, Any]:
        """Return everything as plain values for JSON."""
        return {
            "location": self.location,
            "ok": self.ok,
            "counts": {severity: self.count(severity) for severity in SEVERITIES},
            "findings": [asdict(finding) for finding in self.findings],
            "sequences": [asdict(report) for report in self.sequences],
        }
