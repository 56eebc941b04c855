"""Options that stand in groups, or that a converter declares, are options like any other."""

import dataclasses
import inspect
import re
import subprocess
import sys
from typing import Annotated, get_args

import pytest
from typer.testing import CliRunner

from carlasc import CardDetails, FromScans, LayoutOptions, StyleOptions, Voting
from carlasc.cli import app, convert
from carlasc.cli.flags import DeclaredOptions, OneWorkerFlags, declared_by, flatten
from carlasc.cli.grid_flags import GroundTruthFlags, MotionGiven
from carlasc.cli.library import TABLE, Given, Library, declarations
from carlasc.cli.regrid import regrid
from carlasc.motion import MotionOptions, PoseOptions


def run(*arguments):
    return CliRunner().invoke(app, [*map(str, arguments)], terminal_width=200)


def parameters_of(function):
    return inspect.signature(flatten(function)).parameters


def option_of(library, name):
    """Return the option of a command that stands for an argument or a field of the library."""
    (one,) = [one for one in library.parameters() if one.name.endswith(f"__{name}")]
    return get_args(one.annotation)[1]


def test_a_group_becomes_options_and_comes_back_as_an_object():
    seen = []

    def command(
        scans: Annotated[Given, Library("carlasc.FromScans")],
        motion: MotionGiven,
        work: OneWorkerFlags,
        name: str = "x",
    ) -> None:
        seen.append((scans, motion, work, name))

    flat = flatten(command)
    given = {name: one.default for name, one in inspect.signature(flat).parameters.items()}
    assert {"FromScans__window", "FromScans__stride", "workers", "cluster", "name"} <= set(given)
    flat(**given | {"FromScans__stride": 3, "MotionOptions__source": "flow", "name": "y"})
    ((scans, motion, work, name),) = seen
    assert scans.values == {"stride": 3} and scans.is_given
    assert work == OneWorkerFlags() and not work.is_given
    assert name == "y"
    merged = scans.make(motion=motion.make(), poses=PoseOptions("file"))
    assert merged == FromScans(stride=3, motion=MotionOptions("flow"), poses=PoseOptions("file"))


def test_regrid_and_convert_have_the_same_grid_options():
    def making(making: GroundTruthFlags) -> None:
        """Take the options alone."""

    shared = set(parameters_of(making))
    fields = {name.rpartition("__")[2] for name in shared}
    assert {"res", "bounds", "rule", "keep_evidence", "window", "own_path"} <= fields
    assert all(shared <= set(parameters_of(command)) for command in (regrid, convert.convert))


@pytest.mark.parametrize("made", [FromScans, Voting, LayoutOptions, StyleOptions, CardDetails])
def test_each_field_of_an_option_object_is_an_option_with_its_default(made):
    library = Library(f"carlasc.{made.__name__}")
    options = {one.name.rpartition("__")[2]: one for one in library.parameters()}
    fields = {field.name: field.default for field in dataclasses.fields(made)}
    assert set(fields) - set(options) == ({"motion", "poses"} if made is FromScans else set())
    for name, parameter in options.items():
        named = re.search(r"\[default: (.*)\]$", get_args(parameter.annotation)[1].help)
        default = fields[name]
        if default is False or default in (None, (), dataclasses.MISSING):
            assert named is None
        else:
            text = ":".join(map(str, default)) if isinstance(default, tuple) else str(default)
            assert named[1] == ("yes" if default is True else text)


def test_what_a_text_says_of_python_is_said_of_the_command_line():
    assert option_of(Library("carlasc.Scene"), "truth_grid").help.endswith(
        "Default: as for --grid."
    )
    assert (
        option_of(Library("carlasc.download"), "keep").help == "With --extract: keep the zips too."
    )
    assert option_of(Library("carlasc.FromScans"), "dynamic").help.startswith(
        "What happens to moving points. align: each moving actor"
    )


def test_every_renamed_or_hidden_name_is_one_of_the_library():
    for name, shown in TABLE.items():
        known = declarations(name)
        assert {*shown.hidden.split(), *shown.files.split(), *shown.renamed} <= set(known), name


def test_a_python_that_drops_docstrings_keeps_the_help():
    command = [sys.executable, "-OO", "-m", "carlasc", "pack", "--help"]
    ran = subprocess.run(command, capture_output=True, text=True, check=True)
    assert "Compress points with PCodec" in ran.stdout


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("frobnicate",), "carlasc: no such command 'frobnicate'"),
        (("info", "--jsn"), "carlasc: no such option: --jsn"),
        (("pack",), "carlasc: missing argument 'SOURCE'"),
        (("stats", "--workers", "0"), "carlasc: invalid value for '--workers'"),
        (
            ("regrid", "--preset", "finest"),
            "carlasc: invalid value for '--preset': 'finest' is not one of 'coarse'",
        ),
        (("regrid", "--res"), "carlasc: option '--res' requires an argument"),
        (("info", "a", "b"), "carlasc: got unexpected extra argument"),
    ],
)
def test_wrong_usage_is_one_line_and_exits_2(arguments, message):
    result = run(*arguments)
    assert result.exit_code == 2
    assert result.stderr.startswith(message) and result.stderr.count("\n") == 1
    assert "--help`" in result.stderr
    assert result.stdout == ""


def test_the_help_of_a_converter_shows_its_own_options():
    result = run("convert", "nuscenes", "--help")
    assert result.exit_code == 0
    lines = result.output.splitlines()
    heading = next(i for i, line in enumerate(lines) if line.startswith("Options of this data set"))
    assert any("--sweeps / --no-sweeps" in line for line in lines[heading:])
    assert "--sweeps" not in run("convert", "--help").output
    assert "--sweeps" not in run("convert", "kitti", "--help").output
    assert run("convert", "kitti", "a", "b", "--no-sweeps").exit_code == 2


def test_declared_options_that_are_not_given_are_left_to_the_library():
    seen = []

    def command(options: DeclaredOptions) -> None:
        seen.append(dict(options.values))

    flat = flatten(command, declared_by("converter", ["nuscenes"]))
    names = list(inspect.signature(flat).parameters)
    flat(**dict.fromkeys(names))
    flat(**dict.fromkeys(names) | {names[-1]: False})
    assert seen[0] == {} and list(seen[1].values()) == [False]
