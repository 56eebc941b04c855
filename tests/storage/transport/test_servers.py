"""The names of other packages that requests rest on: a version that lacks one is named."""

from __future__ import annotations

import importlib
from importlib.metadata import packages_distributions, version
from pathlib import Path

import pytest

from carlasc.storage.transport.failures import TEMPORARY, WrongAnswerError
from carlasc.storage.transport.object_stores import PRIVATE
from carlasc.storage.transport.web import check_range


def installed(module: str) -> str:
    """Return the distribution of a module and its version, such as "obstore 0.12.1"."""
    name = module.partition(".")[0]
    found = packages_distributions().get(name)
    return f"{found[0]} {version(found[0])}" if found else "Python"


def test_the_installed_version_has_each_undocumented_name() -> None:
    pytest.importorskip("obstore")
    advice = "see carlasc.storage.transport.object_stores.PRIVATE"
    module = importlib.import_module(PRIVATE)
    assert Path(str(module.__file__)).is_file(), (
        f"{installed('obstore')} has no {PRIVATE}: {advice}"
    )


@pytest.mark.parametrize(
    ("module", "name"), [(module, name) for module, names in TEMPORARY.items() for name in names]
)
def test_the_installed_version_has_each_error_of_the_connection(module: str, name: str) -> None:
    pytest.importorskip(module.partition(".")[0])
    kind = getattr(importlib.import_module(module), name, None)
    advice = "see carlasc.storage.transport.failures.TEMPORARY"
    assert isinstance(kind, type) and issubclass(kind, Exception), (
        f"{installed(module)} has no {module}.{name}: {advice}"
    )


@pytest.mark.parametrize("header", [None, "bytes 5-9/100", "bytes 5-7/8"])
def test_a_range_that_was_asked_for_is_taken_also_where_the_file_ends_before_it(
    header: str | None,
) -> None:
    check_range(header, 5, 10)


@pytest.mark.parametrize("header", ["bytes 4-9/100", "bytes 5-10/100", "bytes */100", "5"])
def test_another_range_is_refused(header: str) -> None:
    with pytest.raises(WrongAnswerError):
        check_range(header, 5, 10)
