"""The results of the checks: a finding is one fault in one place, with advice."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass, field
from typing import TYPE_CHECKING, Any, Literal

from carlasc.errors import CarlascError
from carlasc.storage.layout import identity_of

if TYPE_CHECKING:
    from carlasc.metrics.results import Interval

Severity = Literal["error", "warning", "note"]
SEVERITIES: tuple[Severity, ...] = ("error", "warning", "note")  # worst first
State = Literal["right", "wrong", "untested", "accepted"]
Verdict = Literal["sound", "not sound", "undetermined"]
STATES = {
    "right": "tested and right",
    "wrong": "tested and wrong",
    "untested": "could not be tested",
    "accepted": "accepted",
}
"""What can be said of a check that a grid needs, in words."""


@dataclass(frozen=True)
class Finding:
    """One fault.

    Attributes:
        severity: "error": reading fails or gives wrong values; "warning": probably a mistake;
            "note": no fault, for information.
        check: short name of the check that found it, such as "file-size"; findings are grouped by
            it.
        location: the file or the folder.
        expected: the content that the file should have.
        found: the content that it has.
        advice: what to do; may be empty.
        sequence: path of the sequence in its Source; `validate` fills it in.
        tested: False if the check could not be made; `found` says why.
    """

    severity: Severity
    check: str
    location: str
    expected: str
    found: str
    advice: str = ""
    sequence: str = ""
    tested: bool = True

    @classmethod
    def from_error(
        cls, check: str, location: str, error: CarlascError, advice: str = ""
    ) -> Finding:
        """Turn an error of the library into a finding of severity "error".

        Args:
            check: short name of the check.
            location: the file or the folder, for an error without a location.
            error: its parts become the parts of the finding.
            advice: for an error without advice.
        """
        expected = error.expected
        found = error.found
        where = error.where
        if error.problem:
            found = f"{error.problem}: {found}" if expected else error.problem
        elif not expected:  # all that the error says is in its first part
            found = where
            where = location
        expected = expected or "data that can be read"
        return cls("error", check, where, expected, found, error.advice or advice)

    def __str__(self) -> str:
        text = f"{self.location}: expected {self.expected}, found {self.found}"
        return f"{text}: {self.advice}" if self.advice else text


@dataclass(frozen=True)
class SequenceReport:
    """What was read and measured in a sequence.

    Attributes:
        path: the sequence's path in its Source.
        frames: number of frames.
        sampled: number of frames whose contents were read.
        voxel_share: by grid, the mean share of the points in known voxels whose voxel has their
            class (any class but free if the points have no labels). A grid for which it could not
            be measured is left out.
        pose_share: mean share of a scan's structure that falls on the structure of an earlier scan
            under the poses; None if it could not be measured.
        disagreement_m: distance of scans from the surfaces that their neighbours saw, under the
            poses, metres; None if it is undetermined.
        refined_m: the same distance under refined poses.
        mounting: x, y, z, roll, pitch and yaw of the sensor in the frame of the poses, and the
            delay of the poses, each with its interval, or "undetermined"; empty if none could
            be measured.
        images: by camera, the shift of its images against the scans, in pixels, and their delay, or
            "undetermined"; empty without images.
        checks: by check that a grid needs, "right", "wrong", "untested" or "accepted".
    """

    path: str
    frames: int
    sampled: int
    voxel_share: Mapping[str, float] = field(default_factory=dict)
    pose_share: float | None = None
    disagreement_m: float | None = None
    refined_m: float | None = None
    mounting: Mapping[str, str] = field(default_factory=dict)
    images: Mapping[str, str] = field(default_factory=dict)
    checks: Mapping[str, State] = field(default_factory=dict)


@dataclass(frozen=True)
class ValidationResult:
    """What `validate` found.

    Attributes:
        location: what was validated.
        findings: in the order of the sequences; errors first within a sequence.
        sequences: what was read of each sequence.
        places: number of folders of sequences by split; empty if all were looked at.
    """

    location: str
    findings: tuple[Finding, ...]
    sequences: tuple[SequenceReport, ...]
    places: Mapping[str, int] = field(default_factory=dict)

    @property
    def verdict(self) -> Verdict:
        """Whether the data are sound: there may be warnings of checks that no grid needs.

        They are "not sound" if there is an error, or a check that a grid needs is wrong, and
        "undetermined" if such a check could not be made.
        """
        states = {state for report in self.sequences for state in report.checks.values()}
        if self.count("error") or "wrong" in states:
            return "not sound"
        return "undetermined" if "untested" in states else "sound"

    @property
    def ok(self) -> bool:
        """Whether the verdict is "sound"."""
        return self.verdict == "sound"

    def count(self, severity: Severity) -> int:
        """Return the number of findings of a severity."""
        return sum(finding.severity == severity for finding in self.findings)

    def sequences_with(self, findings: Iterable[Finding]) -> Interval:
        """Return the number of all sequences that have such findings, estimated with its interval
        if only some were looked at.
        """
        from carlasc.metrics.results import estimate  # compiles loops, for scores

        found = {finding.sequence for finding in findings}
        return estimate([report.path in found for report in self.sequences], self.places)

    def by_split(self) -> dict[str, dict[str, int]]:
        """Return the number of sequences and of frames of each split, and of its sequences with
        findings of each severity and with checks of each state.
        """
        found = Counter((one.sequence, one.severity) for one in self.findings)
        splits: dict[str, Counter[str]] = {}
        for report in self.sequences:
            sums = Counter(dict.fromkeys(("sequences", "frames", *SEVERITIES, *STATES), 0))
            own = {severity for severity in SEVERITIES if found[report.path, severity]}
            sums.update({"sequences": 1, "frames": report.frames})
            sums.update(own | {*report.checks.values()})
            splits.setdefault(identity_of(report.path)[0] or "none", Counter()).update(sums)
        return {split: dict(sums) for split, sums in splits.items()}

    def grouped(self) -> dict[tuple[Severity, str], list[Finding]]:
        """Return the findings by severity and check, errors first."""
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
            "verdict": self.verdict,
            "splits": self.by_split(),
            "counts": {severity: self.count(severity) for severity in SEVERITIES},
            "findings": [asdict(finding) for finding in self.findings],
            "sequences": [asdict(report) for report in self.sequences],
            "places": dict(self.places),
        }
