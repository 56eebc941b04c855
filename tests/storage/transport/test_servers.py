"""The names of other packages that requests rest on: a version that lacks one is named."""

from __future__ import annotations

import importlib
from importlib.metadata import packages_distributions, version

import pytest

from carlasc.storage.transport.failures import TEMPORARY, WrongAnswerError
from carlasc.storage.transport.servers import PRIVATE, S3, check_range


def installed(module: str) -> str:
    """Return the distribution of a module and its version, such as "s3fs 2026.9.0"."""
    name = module.partition(".")[0]
    found = packages_distributions().get(name)
    return f"{found[0]} {version(found[0])}" if found else "Python"


@pytest.mark.parametrize(
    ("kind", "name"), [(kind, name) for kind, names in PRIVATE.items() for name in names]
)
def test_the_installed_version_has_each_undocumented_name(kind: str, name: str) -> None:
    module, _, class_name = kind.rpartition(".")
    holder = getattr(pytest.importorskip(module), class_name)
    advice = "see carlasc.storage.transport.servers.PRIVATE"
    assert callable(getattr(holder, name, None)), (
        f"{installed(module)} has no {kind}.{name}: {advice}"
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


def test_each_scheme_of_object_stores_is_one_of_s3fs() -> None:
    s3fs = pytest.importorskip("s3fs")
    protocols = s3fs.S3FileSystem.protocol
    assert set(S3) <= set(protocols), f"{installed('s3fs')} has the schemes {protocols}"


@pytest.mark.parametrize("header", [None, "bytes 5-9/100", "bytes 5-7/8"])
def test_a_range_that_was_asked_for_is_taken_also_where_the_file_ends_before_it(
    header: str | None,
) -> None:
    check_range(header, 5, 10)


@pytest.mark.parametrize("header", ["bytes 4-9/100", "bytes 5-10/100", "bytes */100", "5"])
def test_another_range_is_refused(header: str) -> None:
    with pytest.raises(WrongAnswerError, match="another range"):
        check_range(header, 5, 10)
