"""Fixtures that every test may use."""

from __future__ import annotations

import os
import tarfile
from collections.abc import Generator
from importlib.util import find_spec
from pathlib import Path

import hypothesis
import pytest

from carlasc.cli import common
from carlasc.errors import DependencyError

if os.name == "nt":  # faults are made with signals, limits and traced calls of POSIX systems
    collect_ignore = ["reliability", "tools"]

DATA = Path(__file__).parent / "data"

# servers of tests that fail need no time to recover
os.environ.setdefault("CARLASC_REMOTE_BACKOFF_S", "0.01")

common._LINE_S = float("inf")  # what a command prints must not depend on how long it takes

# How long an example takes is the machine's affair. Equal code gets equal examples;
# `--hypothesis-profile default` looks for others.
hypothesis.settings.register_profile("carlasc", deadline=None, derandomize=True)
hypothesis.settings.load_profile("carlasc")


def _skip_without_extra() -> Generator[None]:
    """Skip a test whose code says that an optional package is not installed.

    An import that fails in any other way is an error.
    """
    try:
        return (yield)
    except DependencyError as error:
        cause = error.__cause__
        if (
            isinstance(cause, ModuleNotFoundError)
            and cause.name
            and find_spec(cause.name.partition(".")[0]) is None
        ):
            pytest.skip(str(error))
        raise


@pytest.hookimpl(wrapper=True)
def pytest_runtest_setup(item: pytest.Item) -> Generator[None]:
    """Skip a test that is marked with a package that is not installed, or one of whose fixtures
    needs such a package; on Windows, also a test that is marked as one for POSIX systems.
    """
    if os.name == "nt":
        for mark in item.iter_markers("posix"):
            pytest.skip(f"needs a POSIX system: {mark.args[0]}")
        if "fork" in getattr(item, "callspec", item).__dict__.get("params", {}).values():
            pytest.skip("needs a POSIX system: fork")
    for mark in item.iter_markers("needs"):
        for package in mark.args:
            pytest.importorskip(package)
    return (yield from _skip_without_extra())


@pytest.hookimpl(wrapper=True)
def pytest_runtest_call(item: pytest.Item) -> Generator[None]:
    """Skip a test that comes to a package that is not installed."""
    return (yield from _skip_without_extra())


@pytest.fixture(scope="session")
def golden_capture(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The golden capture, unpacked: raw/, and what the authors' generator made of it.

    Read only by convention.
    """
    folder = tmp_path_factory.mktemp("golden")
    with tarfile.open(DATA / "golden" / "capture.tar.xz") as archive:
        archive.extractall(folder, filter="data")
    return folder


@pytest.fixture(scope="session")
def golden() -> Path:
    """The folder of the golden files."""
    return DATA / "golden"


@pytest.fixture(scope="session")
def real() -> Path:
    """Real data made elsewhere, which may not be shipped: $CARLASC_REAL, or shared/real beside the
    checkout.
    """
    folder = Path(os.environ.get("CARLASC_REAL", Path(__file__).parents[2] / "shared" / "real"))
    if not folder.is_dir():
        pytest.skip(f"{folder} is not there: set CARLASC_REAL to a folder with the real data")
    return folder
