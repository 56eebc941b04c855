"""What was found of each kind, as the documentation shows it."""

from __future__ import annotations

from faults import figures


def test_every_figure_has_a_kind_and_a_date() -> None:
    rows = figures.read()
    assert rows
    for name, row in rows.items():
        assert name == row["kind"] and name in figures.KINDS
        assert row["tried"] > 0 and row["date"] > "2026"


def test_faults_that_were_found_are_counted_in_the_table_and_in_the_line() -> None:
    rows = {"kills": {"tried": 1234, "found": ["one", "two"], "seconds": 5, "date": "2026-11-22"}}
    assert "1,234 kills, 2 faults found" in figures.line(rows)
    assert "| 1,234 | 2 | 1 | 2026-11-22 |" in figures.table(rows)
