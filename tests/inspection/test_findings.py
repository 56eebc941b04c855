"""Findings: made from the parts of errors, grouped, and counted."""

from __future__ import annotations

import pytest

from carlasc.errors import FormatError
from carlasc.inspection.findings import Finding, SequenceReport, ValidationResult


@pytest.mark.parametrize(
    ("error", "advice", "expected"),
    [
        (
            FormatError(
                "a.bin", expected="a b, found in c: x", found="d: expected e", advice="copy it"
            ),
            "make it again",
            ("a.bin", "a b, found in c: x", "d: expected e", "copy it"),
        ),
        (
            FormatError("a.bin", expected="b", found="c"),
            "make it again",
            ("a.bin", "b", "c", "make it again"),
        ),
        (
            FormatError("a.json", problem="does not parse", expected="JSON", found="{"),
            "",
            ("a.json", "JSON", "does not parse: {", ""),
        ),
        (
            FormatError("a.json", problem="does not parse"),
            "",
            ("a.json", "data that can be read", "does not parse", ""),
        ),
        (FormatError("it is broken"), "", ("folder", "data that can be read", "it is broken", "")),
    ],
)
def test_the_parts_of_an_error_become_those_of_a_finding(error, advice, expected):
    finding = Finding.from_error("check", "folder", error, advice)
    assert (finding.location, finding.expected, finding.found, finding.advice) == expected
    assert (finding.severity, finding.check) == ("error", "check")


def test_a_finding_reads_as_an_error_does():
    error = FormatError("a.bin", expected="b", found="c", advice="d")
    assert (
        str(Finding.from_error("check", "", error)) == str(error) == "a.bin: expected b, found c: d"
    )
    assert str(Finding("note", "check", "a.bin", "b", "c")) == "a.bin: expected b, found c"


def finding(severity, check="x"):
    return Finding(severity, check, "a", "b", "c")


def test_findings_are_grouped_by_check_with_errors_first():
    findings = (
        finding("note"),
        finding("warning"),
        finding("error", "y"),
        finding("note"),
        finding("error"),
    )
    result = ValidationResult("place", findings, ())
    assert list(result.grouped()) == [
        ("error", "y"),
        ("error", "x"),
        ("warning", "x"),
        ("note", "x"),
    ]
    assert len(result.grouped()["note", "x"]) == 2
    assert [result.count(severity) for severity in ("error", "warning", "note")] == [2, 1, 2]


@pytest.mark.parametrize(("severity", "ok"), [("error", False), ("warning", True), ("note", True)])
def test_errors_make_a_data_set_unsound(severity, ok):
    assert ValidationResult("place", (finding(severity),), ()).ok is ok


@pytest.mark.parametrize(
    ("states", "verdict"),
    [
        (("right", "accepted"), "sound"),
        (("right", "untested"), "undetermined"),
        (("untested", "wrong"), "not sound"),
    ],
)
def test_the_checks_that_a_grid_needs_decide_the_verdict(states, verdict):
    reports = [SequenceReport("A", 1, 1, checks={"ground": state}) for state in states]
    result = ValidationResult("place", (), tuple(reports))
    assert (result.verdict, result.ok) == (verdict, verdict == "sound")
    assert result.to_dict()["verdict"] == verdict


def test_a_result_as_a_dictionary_holds_all_of_it():
    report = SequenceReport("Val/A", 10, 2, {"evaluation": 0.5}, 0.25)
    values = ValidationResult("place", (finding("warning"),), (report,)).to_dict()
    assert values["counts"] == {"error": 0, "warning": 1, "note": 0}
    assert (values["ok"], values["location"], values["findings"][0]["expected"]) == (
        True,
        "place",
        "b",
    )
    assert values["sequences"] == [
        {
            "path": "Val/A",
            "frames": 10,
            "sampled": 2,
            "voxel_share": {"evaluation": 0.5},
            "pose_share": 0.25,
            "disagreement_m": None,
            "refined_m": None,
            "mounting": {},
            "images": {},
            "checks": {},
        }
    ]
