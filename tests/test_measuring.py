"""The pages show the figures of docs/figures.json, and no others; a measurement that fails leaves
the figure of before.
"""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest
from measuring import __main__ as command
from measuring import benchmarks
from measuring.facts import CONSTANTS, EXCEPTIONS, facts, is_right, value_of
from measuring.figures import FILE, PAGES, ROOT, Figure, Figures, pages, ratio, unwritten, within
from measuring.places import commands, fill, keys, typed_by_hand
from measuring.sizes import SIZES, by_turns

ENVIRONMENT = os.environ | {
    "PYTHONPATH": os.pathsep.join([str(ROOT / "tests"), str(ROOT / "tests" / "tools")])
}
RUN = {
    "date": "2030-01-02",
    "size": "quick",
    "processor": "Abacus",
    "target": "beads",
    "cores": 2,
    "load": 0.1,
}
RUN |= {"python": "3.11", "system": "wood", "versions": {"carlasc": "0.1.0"}}


def test_the_pages_show_the_figures_of_the_file() -> None:
    made = pages(Figures.read())
    assert {
        ROOT / "README.md",
        ROOT / "docs" / "performance.md",
        ROOT / "docs" / "reliability.md",
    } <= set(made)
    for path, text in made.items():
        assert path.read_text() == text, (
            f"{path.relative_to(ROOT)}: run `PYTHONPATH=tests:tests/tools python -m measuring "
            f"--fill`"
        )


@pytest.mark.parametrize("path", PAGES, ids=lambda path: path.relative_to(ROOT).as_posix())
def test_every_number_of_a_page_has_a_command(path: Path) -> None:
    page, new = path.relative_to(ROOT).as_posix(), unwritten(path)
    assert not new, (
        f"{page}: {new}: nothing writes these numbers. Name the study that makes them in their "
        f"section (docs/studies/NAME.py), measure them"
        " (tests/tools/measuring) and put them into a place, name the constant of the code "
        "(tests/tools/measuring/facts.py), or leave them out"
    )


def test_pages_name_studies_that_there_are() -> None:
    for path in PAGES:
        for script in commands(path.read_text()):
            assert (ROOT / script).is_file(), f"{path}: {script}"


@pytest.mark.parametrize("page", CONSTANTS)
def test_constants_of_pages_are_those_of_the_code(page: str) -> None:
    found = typed_by_hand((ROOT / page).read_text())
    for text, name in CONSTANTS[page].items():
        assert text in found, (
            f"{page} does not hold {text} any more: remove it from tests/tools/measuring/facts.py"
        )
        assert is_right(text, name), f"{page} says {text}, {name} is {value_of(name)}"


def test_every_fact_of_the_code_is_on_a_page() -> None:
    shown = {name.partition("[")[0] for page in CONSTANTS.values() for name in page.values()}
    assert set(facts()) == shown


def test_there_are_few_exceptions_and_all_are_on_their_pages() -> None:
    assert len(EXCEPTIONS) <= 20
    for (page, text), reason in EXCEPTIONS.items():
        assert reason
        whole = (ROOT / page).read_text()
        assert text in whole if text.startswith("## ") else text in typed_by_hand(whole), (
            f"{page} does not hold {text}"
        )


def test_every_figure_says_how_and_where_it_was_measured_and_belongs_to_what_the_pages_show() -> (
    None
):
    held = Figures.read()
    for key, figure in held.figures.items():
        assert figure.how, key
        assert figure.run in held.runs, key
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
    assert (
        made
        == "x\n\n<!-- figures\n| {a} |\n|---|\n-->\n\n| 1 ms |\n|---|\n\n<!-- figures end -->\n\ny"
    )
    assert fill(made, {"a": "1 ms"}) == made
    assert keys(line + block) == {"a.b", "a"}
    with pytest.raises(KeyError):
        fill(line, {})


def test_no_place_of_a_line_begins_a_line_where_markdown_would_end_the_paragraph() -> None:
    for path in PAGES:
        wrong = [
            line
            for line in path.read_text().splitlines()
            if line.startswith("<!-- figures ") and "end -->" in line
        ]
        assert not [line for line in wrong if not line.startswith("<!-- figures end")], path


@pytest.mark.parametrize(
    ("text", "found"),
    [
        ("It takes 12.5 ms, or 3 to 4 s.", ["12.5 ms", "3 to 4 s"]),
        ("16x as fast, 1,442 MB, 2.5 times", ["16x", "1,442 MB", "2.5 times"]),
        (
            "IoU 0.74 instead of 0.39, 7% and 3 to 16 % called free",
            ["0.74", "0.39", "7%", "3 to 16 %"],
        ),
        ("a grid of 128 x 128 x 8 voxels of 0.25 m, T = 16, 20 LiDARs, 0.15 m or 0.5 degrees", []),
        (
            "| rule | IoU | false |\n|---|---:|---:|\n| tube | 0.11 ± 0.03 | 6,675 |\n| 0.4 m | "
            "**51.2 %** | 7 ms |",
            None,
        ),
        ("`--timeout 10 s` and\n```\n5 ms\n```\n<!-- 3 s --> [x](1.25.md)", []),
        ("<!-- figures {a} -->7 ms<!-- figures end --> and 8 ms", ["8 ms"]),
        (
            "# a\n\n8 ms\n\n## b\n\n`docs/studies/movers.py` finds 7%.\n\n### c\n\n9 ms\n\n## "
            "d\n\n6 ms",
            ["8 ms", "6 ms"],
        ),
    ],
)
def test_numbers_that_nothing_writes_are_found(text: str, found: list[str] | None) -> None:
    assert typed_by_hand(text) == (["0.11 ± 0.03", "51.2 %", "7 ms"] if found is None else found)


@pytest.mark.parametrize(
    ("figure", "text"),
    [
        (Figure(0.5843, "ms", "x"), "0.58 ms"),
        (Figure(9.53, "ms", "x"), "9.5 ms"),
        (Figure(0.6, "ms", "x"), "0.60 ms"),
        (Figure(0.0, "%", "x"), "0%"),
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
    first = Figures({}, {}).updated(RUN, {"a": Figure(1.0, "s", "a"), "b": Figure(2.0, "s", "b")})
    second = first.updated(RUN | {"date": "2030-02-03"}, {"a": Figure(1.23456, "s", "a")})
    assert set(second.runs) == {"2030-01-02 quick beads", "2030-02-03 quick beads"}
    second.write(tmp_path / "figures.json")
    read = Figures.read(tmp_path / "figures.json")
    assert read.figures["a"] == Figure(1.235, "s", "a", run="2030-02-03 quick beads")
    assert read.figures["b"].run == "2030-01-02 quick beads"
    third = read.updated(RUN | {"date": "2030-02-03"}, {"b": Figure(2.0, "s", "b")})
    assert set(third.runs) == {"2030-02-03 quick beads"}


def test_a_group_that_fails_is_reported_and_keeps_its_figures(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    file = tmp_path / "figures.json"
    Figures({}, {}).updated(RUN, {"a": Figure(1.0, "s", "a"), "b": Figure(2.0, "s", "b")}).write(
        file
    )
    answers = {
        "loading": ({"a": Figure(3.0, "s", "a")}, "it failed:\nValueError: too slow"),
        "stores": ({}, ""),
    }
    monkeypatch.setattr(command, "_describe_run", lambda size: RUN | {"date": "2030-02-03"})
    monkeypatch.setattr(command, "_measure_in_a_process", lambda group, size: answers[group])
    assert command.measure_all(["loading", "stores"], "quick", file) == ["loading"]
    figures = Figures.read(file).figures
    assert (figures["a"].value, figures["b"].value) == (3.0, 2.0)
    printed = capsys.readouterr().out
    assert (
        "loading: 1 figures in 0 s, then it failed" in printed and "ValueError: too slow" in printed
    )
    assert "loading failed: these figures are those of before" in printed


def test_a_benchmark_that_fails_does_not_hide_the_others(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    runs = iter([1.0, 0.5])

    def run(name: str, size: object, out: Path) -> tuple[list[dict[str, object]], str]:
        return [
            {
                "name": "test_bench_encode",
                "stats": {"min": next(runs)},
                "extra_info": {"peak_mb": 7},
            }
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
    command_line = [
        sys.executable,
        "-m",
        "measuring",
        "--size",
        "tiny",
        "--only",
        group,
        "--out",
        str(file),
    ]
    ran = subprocess.run(
        command_line,
        cwd=ROOT / "tests",
        env=ENVIRONMENT,
        capture_output=True,
        text=True,
        check=False,
    )
    assert ran.returncode == 0, ran.stdout + ran.stderr
    measured = Figures.read(file)
    first = {key.split(".")[0] for key in measured.figures}
    kept = Figures.read().figures
    assert set(measured.figures) == {key for key in kept if key.split(".")[0] in first}
    assert all(figure.value > 0 for figure in measured.figures.values())
    assert FILE.read_bytes() == before
