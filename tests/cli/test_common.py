import json
import subprocess
import sys

import numpy as np
import pytest
import typer
from typer.testing import CliRunner

from carlasc.cli import app
from carlasc.cli.common import CommandGroup, parse_frames, parse_numbers, print_json, report_failures
from carlasc.errors import ArgumentError, FormatError


def run(action):
    app = typer.Typer(cls=CommandGroup)
    app.command("one")(action)
    app.command("other")(lambda: None)
    return CliRunner().invoke(app, ["one"])


@pytest.mark.parametrize(
    ("error", "code"),
    [(FormatError("a.bin: expected x, found y"), 1), (ArgumentError("--res: no"), 2), (KeyboardInterrupt(), 130)],
)
def test_an_error_is_one_line_and_an_honest_exit_code(error, code):
    def action():
        raise error

    result = run(action)
    assert result.exit_code == code
    assert result.stderr.count("\n") == 1
    assert "Traceback" not in result.output


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
    assert parse_frames(None) is None
    assert parse_frames("3:7") == (3, 7)
    assert parse_frames("3:") == (3, None)
    assert parse_frames(":7") == (None, 7)
    assert parse_frames("3") == (3, 4)
    for text in ("a:b", "7:3", "3:3", "1:2:3"):
        with pytest.raises(ArgumentError, match="--frames"):
            parse_frames(text)


def test_numbers_are_counted():
    assert parse_numbers("0.2", float, (1, 3), "--res") == (0.2,)
    assert parse_numbers("1,2,3", int, (3,), "--size") == (1, 2, 3)
    for text in ("1,2", "a", "1.5,2,3", ""):
        with pytest.raises(ArgumentError, match="--size: expected 3 whole numbers"):
            parse_numbers(text, int, (3,), "--size")


def test_numpy_values_become_json():
    result = run(lambda: print_json({"a": np.float32(0.5), "b": np.arange(3), "c": frozenset({2, 1})}))
    assert json.loads(result.stdout) == {"a": 0.5, "b": [0, 1, 2], "c": [1, 2]}


def test_version_and_unknown_commands():
    assert subprocess.run(
        [sys.executable, "-m", "carlasc", "--version"], capture_output=True, check=True
    ).stdout.strip()
    assert (
        subprocess.run([sys.executable, "-m", "carlasc", "frobnicate"], capture_output=True, check=False).returncode
        == 2
    )


def test_help_of_a_flag_names_no_value():
    result = CliRunner().invoke(app, ["regrid", "--help"], terminal_width=200)
    (flag,) = (line for line in result.output.splitlines() if "--overwrite" in line)
    assert "bool" not in flag
    assert "<" in next(line for line in result.output.splitlines() if "--workers" in line)
