"""The documentation shows the figures that were measured."""

from __future__ import annotations

from faults import figures


def test_the_pages_show_the_figures_that_were_measured() -> None:
    for path, text in figures.pages().items():
        assert path.read_text() == text, f"{path.name}: run `python -m faults`"


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
