import json
import subprocess
import sys
from pathlib import Path
from typing import Annotated

import numpy as np
import pytest
import typer
from typer.testing import CliRunner

from carlasc.cli import app
from carlasc.cli.commands import Command, CommandGroup
from carlasc.cli.common import parse_numbers, print_json, read_frames, report_failures
from carlasc.core.frames import FrameRange
from carlasc.errors import ArgumentError, ConflictError, FormatError


def run(action):
    app = typer.Typer(cls=CommandGroup)
    app.command("one", cls=Command)(action)
    app.command("other")(lambda: None)
    return CliRunner().invoke(app, ["one"])


@pytest.mark.parametrize(
    ("error", "code"),
    [
        (FormatError("a.bin", expected="x", found="y"), 1),
        (ArgumentError("res", expected="a number", found="x"), 2),
        (KeyboardInterrupt(), 130),
    ],
)
def test_an_error_is_one_line_and_an_honest_exit_code(error, code):
    def action():
        raise error

    result = run(action)
    assert result.exit_code == code
    assert result.stderr.count("\n") == 1
    assert "Traceback" not in result.output


@pytest.mark.parametrize(
    "error", [SystemError("a result with an exception set"), ValueError("Can't close the ZIP file")]
)
@pytest.mark.parametrize("between", [False, True])
def test_ctrl_c_that_another_error_hides_is_ctrl_c(error, between):
    def action():
        cause = KeyboardInterrupt()
        if between:  # one compiled loop was called by another
            cause = SystemError("a result with an exception set")
            cause.__cause__ = KeyboardInterrupt()
        raise error from cause

    result = run(action)
    assert result.exit_code == 130
    assert result.stderr.startswith("carlasc: interrupted")


def run_with_options(error):
    """Run a command that has some of the library's arguments as options, and fails with an error;
    return its message.
    """

    def action(
        source: str,
        out: Annotated[Path | None, typer.Option("-o", "--out")] = None,
        window: int = 1,
        near_m: Annotated[float, typer.Option("--near")] = 0.0,
        overwrite: Annotated[bool, typer.Option("--overwrite")] = False,
        frames: Annotated[str | None, typer.Option(callback=read_frames)] = None,
    ):
        if error is not None:
            raise error
        typer.echo(repr(frames))

    app = typer.Typer(cls=CommandGroup)
    app.command("one", cls=Command)(action)
    app.command("other")(lambda: None)
    return lambda *arguments: CliRunner().invoke(app, ["one", "data", *arguments])


@pytest.mark.parametrize(
    ("where", "named"),
    [
        ("window", "--window"),
        ("near_m", "--near"),
        ("out", "--out"),
        ("source", "SOURCE"),
        ("truth_grid", "truth_grid"),
        ("a/window", "a/window"),
    ],
)
def test_an_argument_is_named_as_the_option_that_gives_it(where, named):
    result = run_with_options(ArgumentError(where, expected="5", found="6"))()
    assert result.stderr == f"carlasc: {named}: expected 5, found 6\n"
    assert result.exit_code == 2


@pytest.mark.parametrize(
    ("advice", "shown"),
    [
        ("give `overwrite=True`", "give `--overwrite`"),
        ("give `window=8` or `near_m=2.5`", "give `--window 8` or `--near 2.5`"),
        ('give `out="town"`', "give `--out town`"),
        ("see `window`", "see `--window`"),
        ("give `workers=2`", "give `workers=2`"),
        ("run `carlasc info`", "run `carlasc info`"),
        ("one window", "one window"),
    ],
)
def test_advice_names_options_where_the_command_has_them(advice, shown):
    error = ConflictError("a.bin", expected="b", found="c", advice=advice)
    assert run_with_options(error)().stderr == f"carlasc: a.bin: expected b, found c: {shown}\n"
    assert error.advice == advice


def test_messages_of_a_batch_name_options_too():
    def action(overwrite: Annotated[bool, typer.Option("--overwrite")] = False):
        report_failures([(1, "a: give `overwrite=True`")], 2)

    assert run(action).stderr.splitlines()[0] == "carlasc: a: give `--overwrite`"


def test_a_range_of_frames_is_an_option_with_a_message_of_one_line():
    command = run_with_options(None)
    assert command().stdout == "None\n"
    assert command("--frames", "3:7").stdout == "FrameRange(start=3, stop=7, only=None)\n"
    result = command("--frames", "7:3")
    assert (result.exit_code, result.stderr) == (
        2,
        "carlasc: --frames: expected a range that holds a frame, found 7:3\n",
    )


def test_a_bug_keeps_its_traceback():
    def action():
        raise RuntimeError("a bug")

    assert isinstance(run(action).exception, RuntimeError)


def test_failures_of_a_batch_are_listed_and_exit_1():
    result = run(lambda: report_failures([(3, "a.bin: cut short"), (4, "b.bin: cut short")], 10))
    assert result.exit_code == 1
    assert "a.bin" in result.stderr
    assert "2 of 10 frames failed" in result.stderr
    assert run(lambda: report_failures([], 10)).exit_code == 0


def test_frames_are_half_open_ranges():
    assert FrameRange.parse("3:7") == FrameRange(3, 7)
    assert FrameRange.parse("3:") == FrameRange(3, None)
    assert FrameRange.parse(":7") == FrameRange(None, 7)
    assert FrameRange.parse("3") == FrameRange(3, 4)
    for text in ("a:b", "7:3", "3:3", "1:2:3"):
        with pytest.raises(ArgumentError) as error:
            FrameRange.parse(text)
        assert error.value.where == "frames"


def test_numbers_are_counted():
    assert parse_numbers("0.2", float, (1, 3), "--res") == (0.2,)
    assert parse_numbers("1,2,3", int, (3,), "--size") == (1, 2, 3)
    for text in ("1,2", "a", "1.5,2,3", ""):
        with pytest.raises(ArgumentError) as error:
            parse_numbers(text, int, (3,), "--size")
        assert error.value.where == "--size" and "3 whole numbers" in error.value.expected


def test_numpy_values_become_json():
    result = run(
        lambda: print_json({"a": np.float32(0.5), "b": np.arange(3), "c": frozenset({2, 1})})
    )
    assert json.loads(result.stdout) == {"a": 0.5, "b": [0, 1, 2], "c": [1, 2]}


def test_version_and_unknown_commands():
    assert subprocess.run(
        [sys.executable, "-m", "carlasc", "--version"], capture_output=True, check=True
    ).stdout.strip()
    assert (
        subprocess.run(
            [sys.executable, "-m", "carlasc", "frobnicate"], capture_output=True, check=False
        ).returncode
        == 2
    )


def test_help_of_a_flag_names_no_value():
    result = CliRunner().invoke(app, ["regrid", "--help"], terminal_width=200)
    (flag,) = (line for line in result.output.splitlines() if "--overwrite" in line)
    assert "bool" not in flag
    assert "int" in next(line for line in result.output.splitlines() if "--workers" in line).lower()


def test_ctrl_c_after_the_result_ends_with_its_exit_code():
    code = """
import os, signal, time
import carlasc.cli
carlasc.cli.app = lambda: print("result")
carlasc.cli.main()
os.kill(os.getpid(), signal.SIGINT)
time.sleep(60)
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, check=False, text=True)
    assert (done.returncode, done.stdout) == (130, "result\n")
