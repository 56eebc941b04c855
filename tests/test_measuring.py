"""The pages show the figures of docs/figures.json, and no others; a measurement that fails leaves the figure of before."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest
from measuring import __main__ as command
from measuring import benchmarks
from measuring.figures import FILE, HISTORY, PAGES, ROOT, STRICT, Figure, Figures, pages, ratio, typed, within
from measuring.places import fill, keys, typed_by_hand
from measuring.sizes import SIZES, by_turns

ENVIRONMENT = os.environ | {"PYTHONPATH": os.pathsep.join([str(ROOT / "tests"), str(ROOT / "tests" / "tools")])}
RUN = {"date": "2030-01-02", "size": "quick", "processor": "Abacus", "target": "beads", "cores": 2, "load": 0.1}
RUN |= {"python": "3.11", "system": "wood", "versions": {"carlasc": "0.1.0"}}


def test_the_pages_show_the_figures_of_the_file() -> None:
    made = pages(Figures.read())
    assert {ROOT / "README.md", ROOT / "docs" / "performance.md", ROOT / "docs" / "reliability.md"} <= set(made)
    for path, text in made.items():
        assert path.read_text() == text, (
            f"{path.relative_to(ROOT)}: run `PYTHONPATH=tests:tests/tools python -m measuring --fill`"
        )


def test_no_page_holds_a_figure_that_is_not_in_the_file() -> None:
    others = Figures.read().others
    for path in PAGES:
        page = path.relative_to(ROOT).as_posix()
        new = set(typed(path)) - set(others.get(page, ()))
        assert not new, (
            f"{page} holds {sorted(new)}: measure it (tests/measuring) and put it into a place; if it is no figure of a machine,"
            " run `PYTHONPATH=tests:tests/tools python -m measuring --accept`"
        )


def test_pages_whose_figures_are_all_measured_hold_hardly_another_number() -> None:
    others = Figures.read().others
    for path in STRICT:
        assert set(others.get(path.relative_to(ROOT).as_posix(), ())) <= {"20 minutes"}  # what the size promises


def test_every_figure_says_how_and_where_it_was_measured_and_belongs_to_what_the_pages_show() -> None:
    held = Figures.read()
    for key, figure in held.figures.items():
        assert figure.how, key
        assert figure.run in held.runs or (figure.run == HISTORY and figure.date and figure.machine), key
    for run in held.runs.values():
        assert run.keys() >= RUN.keys()
    shown = set().union(*(keys(path.read_text()) for path in PAGES))
    assert shown <= set(held.texts())
    groups = {key.split(".")[0] for key in shown}
    assert {key.split(".")[0] for key in held.figures} <= groups


def test_a_place_is_made_again_from_its_template() -> None:
    line = "It is <!-- figures {a.b} times -->3 times<!-- figures end --> as fast."
    assert fill(line, {"a.b": "4 to 5"}) == line.replace(">3 times", ">4 to 5 times")
    block = "x\n\n<!-- figures\n| {a} |\n|---|\n-->old<!-- figures end -->\n\ny"
    made = fill(block, {"a": "1 ms"})
    assert made == "x\n\n<!-- figures\n| {a} |\n|---|\n-->\n\n| 1 ms |\n|---|\n\n<!-- figures end -->\n\ny"
    assert fill(made, {"a": "1 ms"}) == made
    assert keys(line + block) == {"a.b", "a"}
    with pytest.raises(KeyError):
        fill(line, {})


def test_no_place_of_a_line_begins_a_line_where_markdown_would_end_the_paragraph() -> None:
    for path in PAGES:
        wrong = [
            line for line in path.read_text().splitlines() if line.startswith("<!-- figures ") and "end -->" in line
        ]
        assert not [line for line in wrong if not line.startswith("<!-- figures end")], path


@pytest.mark.parametrize(
    ("text", "found"),
    [
        ("It takes 12.5 ms, or 3 to 4 s.", ["12.5 ms", "3 to 4 s"]),
        ("16x as fast, 1,442 MB, 2.5 times", ["16x", "1,442 MB", "2.5 times"]),
        ("a grid of 128 x 128 x 8 voxels of 0.4 m, T = 16, 20 LiDARs", []),
        ("`--timeout 10 s` and\n```\n5 ms\n```\n", []),
        ("<!-- figures {a} -->7 ms<!-- figures end --> and 8 ms", ["8 ms"]),
    ],
)
def test_figures_that_were_typed_are_found(text: str, found: list[str]) -> None:
    assert typed_by_hand(text) == found
    assert typed_by_hand(f"{text} 7 %", shares=True) == [*found, "7 %"]


@pytest.mark.parametrize(
    ("figure", "text"),
    [
        (Figure(0.5843, "ms", "x"), "0.58 ms"),
        (Figure(9.53, "ms", "x"), "9.5 ms"),
        (Figure(0.6, "ms", "x"), "0.60 ms"),
        (Figure(0.0, "%", "x"), "0 %"),
        (Figure(10.3, "", "x"), "10"),
        (Figure(139.1, "ms", "x"), "139 ms"),
        (Figure(3882.0, "ms", "x"), "3,880 ms"),
        (Figure(128777.0, "", "x"), "129,000"),
        (Figure(15.8, "", "x", high=27.3), "16 to 27"),
        (Figure(2.01, "", "x", high=2.04), "2.0"),
    ],
)
def test_figures_are_shown_with_two_or_three_digits(figure: Figure, text: str) -> None:
    assert str(figure) == text


def test_ratios_and_ranges() -> None:
    slow, fast = Figure(9.0, "ms", "a"), Figure(3.0, "ms", "b")
    assert ratio(slow, fast, "c") == Figure(3.0, "", "c")
    assert within([slow, fast], "d") == Figure(3.0, "ms", "d", high=9.0)


def test_what_is_compared_takes_turns_and_the_least_time_counts() -> None:
    order, times = [], iter([0, 5, 5, 8, 8, 10, 10, 14])
    calls = {"a": lambda: order.append("a"), "b": lambda: order.append("b")}
    assert by_turns(calls, 2, clock=lambda: next(times)) == {"a": 2, "b": 3}
    assert order == ["a", "b", "a", "b"]


def test_a_run_replaces_what_it_measured_and_keeps_the_rest(tmp_path: Path) -> None:
    first = Figures({}, {}, {"page.md": ["1 s"]}).updated(RUN, {"a": Figure(1.0, "s", "a"), "b": Figure(2.0, "s", "b")})
    second = first.updated(RUN | {"date": "2030-02-03"}, {"a": Figure(1.23456, "s", "a")})
    assert set(second.runs) == {"2030-01-02 quick", "2030-02-03 quick"}
    second.write(tmp_path / "figures.json")
    read = Figures.read(tmp_path / "figures.json")
    assert read.figures["a"] == Figure(1.235, "s", "a", run="2030-02-03 quick")
    assert read.figures["b"].run == "2030-01-02 quick" and read.others == {"page.md": ["1 s"]}
    third = read.updated(RUN | {"date": "2030-02-03"}, {"b": Figure(2.0, "s", "b")})
    assert set(third.runs) == {"2030-02-03 quick"}


def test_a_group_that_fails_is_reported_and_keeps_its_figures(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    file = tmp_path / "figures.json"
    Figures({}, {}, {}).updated(RUN, {"a": Figure(1.0, "s", "a"), "b": Figure(2.0, "s", "b")}).write(file)
    answers = {"loading": ({"a": Figure(3.0, "s", "a")}, "it failed:\nValueError: too slow"), "stores": ({}, "")}
    monkeypatch.setattr(command, "_describe_run", lambda size: RUN | {"date": "2030-02-03"})
    monkeypatch.setattr(command, "_measure_in_a_process", lambda group, size: answers[group])
    assert command.measure_all(["loading", "stores"], "quick", file) == ["loading"]
    figures = Figures.read(file).figures
    assert (figures["a"].value, figures["b"].value) == (3.0, 2.0)
    printed = capsys.readouterr().out
    assert "loading: 1 figures in 0 s, then it failed" in printed and "ValueError: too slow" in printed
    assert "loading failed: these figures are those of before" in printed


def test_a_benchmark_that_fails_does_not_hide_the_others(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    runs = iter([1.0, 0.5])

    def run(name: str, size: object, out: Path) -> tuple[list[dict[str, object]], str]:
        return [
            {"name": "test_bench_encode", "stats": {"min": next(runs)}, "extra_info": {"peak_mb": 7}}
        ], "E  too slow"

    monkeypatch.setattr(benchmarks, "_run", run)
    found, measured = {}, benchmarks.measure_file("votes", SIZES["quick"], tmp_path)
    with pytest.raises(RuntimeError, match=r"test_bench_decode(.|\n)*too slow"):
        for key, figure in measured:
            found[key] = (figure.value, figure.unit)
    assert found == {"votes_file.encode": (0.5, "s"), "votes_file.encode.memory": (7, "MB")}


def test_every_group_has_a_function() -> None:
    for group in command.GROUPS:
        assert callable(command.measure_of(group))


def test_tiny_figures_never_reach_the_pages() -> None:
    ran = subprocess.run(
        [sys.executable, "-m", "measuring", "--size", "tiny"],
        cwd=ROOT / "tests",
        env=ENVIRONMENT,
        capture_output=True,
        text=True,
        check=False,
    )
    assert ran.returncode == 2 and "say with --out where they go" in ran.stderr


@pytest.mark.slow
@pytest.mark.parametrize("group", ["metrics", "stores"])
def test_a_group_measures_the_figures_that_the_file_has_of_it(group: str, tmp_path: Path) -> None:
    file = tmp_path / "figures.json"
    before = FILE.read_bytes()
    command_line = [sys.executable, "-m", "measuring", "--size", "tiny", "--only", group, "--out", str(file)]
    ran = subprocess.run(command_line, cwd=ROOT / "tests", env=ENVIRONMENT, capture_output=True, text=True, check=False)
    assert ran.returncode == 0, ran.stdout + ran.stderr
    measured = Figures.read(file)
    first = {key.split(".")[0] for key in measured.figures}
    kept = Figures.read().figures
    assert set(measured.figures) == {key for key in kept if key.split(".")[0] in first}
    assert all(figure.value > 0 for figure in measured.figures.values())
    assert FILE.read_bytes() == before
