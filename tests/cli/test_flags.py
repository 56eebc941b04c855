"""Options that stand in groups, or that a converter declares, are options like any other."""

import inspect
import re
from typing import get_type_hints

import pytest
from typer.testing import CliRunner

from carlasc.cli import app, convert
from carlasc.cli.flags import DeclaredOptions, OneWorkerFlags, flatten
from carlasc.cli.grid_flags import GroundTruthFlags, ScanFlags, VoteFlags
from carlasc.cli.regrid import regrid
from carlasc.groundtruth import FromScans
from carlasc.motion import MotionOptions, PoseOptions


def run(*arguments):
    return CliRunner().invoke(app, [*map(str, arguments)], terminal_width=200)


def test_a_group_becomes_options_and_comes_back_as_an_object():
    seen = []

    def command(scans: ScanFlags, work: OneWorkerFlags, name: str = "x") -> None:
        seen.append((scans, work, name))

    flat = flatten(command)
    names = list(inspect.signature(flat).parameters)
    assert {"window", "stride", "workers", "cluster", "name"} <= set(names)
    given = {
        name: parameter.default for name, parameter in inspect.signature(flat).parameters.items()
    }
    flat(**given | {"stride": 3, "motion": "flow", "name": "y"})
    ((scans, work, name),) = seen
    assert scans == ScanFlags(stride=3, motion="flow") and scans.is_given
    assert work == OneWorkerFlags() and not work.is_given
    assert name == "y"
    merged = scans.from_scans(PoseOptions("file"))
    assert (merged.stride, merged.motion, merged.poses) == (
        3,
        MotionOptions("flow"),
        PoseOptions("file"),
    )


def test_regrid_and_convert_have_the_same_grid_options():
    of = {
        function: set(inspect.signature(flatten(function)).parameters)
        for function in (regrid, convert.convert)
    }

    def making(making: GroundTruthFlags) -> None:
        """Take the options alone."""

    shared = set(inspect.signature(flatten(making)).parameters)
    assert {"res", "bounds", "rule", "keep_evidence", "window", "motion"} <= shared
    assert all(shared <= names for names in of.values())
    assert VoteFlags().voting().free_step_m == 1.5


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

    flat = flatten(command, convert.declared_options(["nuscenes"]))
    names = list(inspect.signature(flat).parameters)
    flat(**dict.fromkeys(names))
    flat(**dict.fromkeys(names) | {names[-1]: False})
    assert seen[0] == {} and list(seen[1].values()) == [False]


def test_the_default_that_a_help_text_names_is_that_of_the_library():
    """The text of `--complete` named the default of an earlier version."""
    named = {}
    for name, annotation in get_type_hints(ScanFlags, include_extras=True).items():
        for option in getattr(annotation, "__metadata__", ()):
            word = re.search(r"(?:^|[;.] )(\w+): [^;.]*\(default\)", option.help)
            named |= {name: word[1]} if word else {}
    library = FromScans()
    assert named == {
        "dynamic": library.dynamic,
        "motion": library.motion.source,
        "complete": library.complete,
        "rays": library.rays,
    }
