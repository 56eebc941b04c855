"""What was found of each kind, as the documentation shows it."""

from __future__ import annotations

from datetime import datetime, timedelta

import pytest
from faults import figures


def test_every_figure_has_a_kind_and_a_date() -> None:
    rows = figures.read()
    assert rows
    for name, row in rows.items():
        assert name == row["kind"] and name in figures.KINDS
        assert row["tried"] > 0 and row["date"] > "2026"


def test_the_page_says_with_which_code_the_cases_were_run() -> None:
    rows = figures.read()
    for name, row in rows.items():
        assert sum(one["tried"] for one in row["runs"]) == row["tried"], name
    if not (figures.ROOT / ".git").exists():
        pytest.skip("no history of the code")
    known, changed = map(datetime.fromisoformat, (figures.known_code(), figures.code_changed()))
    # run `python -m faults --publish`
    assert changed - known < timedelta(days=30), "the page names an old change of the code"


def test_cases_are_listed_by_their_code() -> None:
    runs = [{"date": "2026-01-02", "code": code, "tried": 1} for code in ("old", "new")]
    text = figures.runs({"kills": {"runs": runs}}, "new")
    assert "| kills | 1 | 2026-01-02 | old | yes |" in text
    assert "| kills | 1 | 2026-01-02 | new | no |" in text and "last on new" in text


def test_faults_that_were_found_are_counted_in_the_table_and_in_the_line() -> None:
    rows = {"kills": {"tried": 1234, "found": ["one", "two"], "seconds": 5, "date": "2026-11-22"}}
    assert "1,234 kills; 2 faults found" in figures.line(rows)
    assert "| 1,234 | 2 | 1 | 2026-11-22 |" in figures.table(rows)
