"""`doctor` says what is installed, names no user, and tells what is broken from what is only
missing.
"""

import importlib
import json
import os
import re
import tomllib
from importlib import metadata
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from typer.testing import CliRunner

import carlasc
from carlasc.cli import app
from carlasc.inspection import installation
from carlasc.inspection.installation import Package, doctor, without_names

ROOT = Path(__file__).parents[2]


def required(lines, extras):
    """Yield the requirements of an extra, with those of the extras that it names in their place."""
    for need in map(Requirement, lines):
        if need.name == "carlasc":
            for name in need.extras:
                yield from required(extras[name], extras)
        else:
            yield need


@pytest.fixture
def metadata_of_project(monkeypatch):
    """The requirements as pyproject.toml has them now, whatever was installed; returns them by
    extra ("" without).
    """
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    lines = {"": project["dependencies"], **project["optional-dependencies"]}
    listed = [
        f"{need.name}{need.specifier}" + (f"; extra == '{extra}'" if extra else "")
        for extra, wanted in lines.items()
        for need in required(wanted, lines)
        if need.marker is None
    ]
    monkeypatch.setattr(metadata, "requires", lambda name: listed)
    return lines


def test_every_package_of_every_extra_for_users_is_listed(metadata_of_project):
    found = doctor()
    listed = {"": found.packages} | {extra.name: extra.packages for extra in found.extras}
    for extra, lines in metadata_of_project.items():
        if extra not in installation.FOR_DEVELOPERS:
            wanted = {
                (need.name, next(iter(need.specifier)).version)
                for need in required(lines, metadata_of_project)
            }
            assert {(package.name, package.lowest) for package in listed.pop(extra)} == wanted, (
                extra
            )
    assert listed == {}
    assert found.version == carlasc.__version__
    assert found.ok and found.problems == ()


def test_missing_and_old_packages_are_told_from_good_ones():
    assert Package("a", "2.10", "2.9").problem == ""
    assert Package("a", "2.0", "2").problem == ""
    assert Package("a", "2.13.0+cpu", "2.13").problem == ""
    assert Package("a", "2.9", "2.10").problem == "a 2.9 is older than 2.10"
    assert Package("a", None, "1").problem == "a is not installed"


def pretend(monkeypatch, **versions):
    """Let packages have other versions, or none."""
    real = metadata.version

    def version(name):
        if name not in versions:
            return real(name)
        if versions[name] is None:
            raise metadata.PackageNotFoundError(name)
        return versions[name]

    monkeypatch.setattr(metadata, "version", version)


def test_a_missing_extra_is_no_problem_and_names_its_command(monkeypatch):
    pretend(monkeypatch, pyarrow=None)
    ran = CliRunner().invoke(app, ["doctor"])
    assert ran.exit_code == 0, ran.output
    assert re.search(r"^  parquet +pyarrow is not installed$", ran.output, re.MULTILINE)
    missing, _, problems = ran.output.partition("\nmissing\n")[2].partition("\nproblems\n")
    assert re.search(r"pip install .*\[parquet\]'", missing) and problems == "  none\n"


def test_a_needed_package_that_is_too_old_is_a_problem(monkeypatch):
    pretend(monkeypatch, rich="10.1")
    ran = CliRunner().invoke(app, ["doctor"])
    assert ran.exit_code == 1
    assert re.search(r"\nproblems\n  rich 10.1 is older than [\d.]+\n$", ran.output)


def test_a_needed_package_that_does_not_load_is_a_problem_and_what_needs_it_is_left_out(
    monkeypatch,
):
    real = importlib.import_module

    def load(name, *arguments):
        if name == "numba":
            raise ImportError("Numba needs NumPy 2.2 or less")
        return real(name, *arguments)

    monkeypatch.setattr(importlib, "import_module", load)
    found = doctor()
    assert not found.ok
    assert found.problems == ("numba cannot be imported (Numba needs NumPy 2.2 or less)",)
    assert found.compiled is None and found.processor.target == ""


def test_a_package_that_is_only_on_the_path_says_so(monkeypatch):
    def requires(name):
        raise metadata.PackageNotFoundError(name)

    monkeypatch.setattr(metadata, "requires", requires)
    found = doctor()
    assert not found.ok and "on the path, but not installed" in found.problems[0]


def test_compiled_code_that_another_process_replaces_is_no_problem(tmp_path):
    (tmp_path / "a.nbi").write_bytes(b"123")
    (tmp_path / "b.nbc").symlink_to(tmp_path / "gone")
    assert list(installation._sizes_in(tmp_path)) == [3]


def test_no_name_of_a_user_is_printed(monkeypatch, tmp_path):
    home = tmp_path / "homes" / "jdoe"
    (home / "cache").mkdir(parents=True)
    scratch = tmp_path / "scratch" / "lab_jdoe"
    scratch.mkdir(parents=True)
    monkeypatch.setenv("HOME", str(home))
    monkeypatch.setenv("LOGNAME", "jdoe")
    monkeypatch.setenv("CARLASC_SOMETHING", str(scratch))
    assert without_names(str(home / "cache")) == f"~{os.sep}cache"
    assert without_names(f"{home}2") == str(home).replace("jdoe", "jdoe2")
    ran = CliRunner().invoke(app, ["doctor"])
    assert ran.exit_code == 0
    assert "jdoe" not in ran.output and "lab_USER" in ran.output
    assert "jdoe" not in CliRunner().invoke(app, ["doctor", "--json"]).output


def test_json_holds_the_same_figures():
    ran = CliRunner().invoke(app, ["doctor", "--json"])
    found = json.loads(ran.stdout)
    assert ran.exit_code == 0
    assert found["version"] == carlasc.__version__
    assert {package["name"] for package in found["packages"]} == {
        "filelock",
        "fsspec",
        "lazy-loader",
        "numba",
        "numpy",
        "rich",
        "typer",
        "urllib3",
    }
    assert found["processor"]["usable"] >= 1 and found["compiled"]["compile_s"] > 0
    assert found["compiled"]["writable"] is True
