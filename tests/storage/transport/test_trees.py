"""Ranges of local files, and names that lead out of a folder."""

from __future__ import annotations

import pickle

import numpy as np
import pytest
from helpers.errors import raises

from carlasc.errors import CarlascError, FormatError, MissingDataError
from carlasc.storage.files import leads_outside
from carlasc.storage.transport.trees import LocalTree

LARGE = (4 << 20) + 5000  # bytes: enough that a range is mapped


@pytest.fixture(scope="module")
def tree(tmp_path_factory: pytest.TempPathFactory) -> LocalTree:
    folder = tmp_path_factory.mktemp("tree")
    (folder / "large").write_bytes(np.random.default_rng(0).bytes(LARGE))
    (folder / "small").write_bytes(b"0123456789")
    (folder / "empty").write_bytes(b"")
    (folder / "inside").mkdir()
    return LocalTree(folder)


@pytest.mark.parametrize(
    ("start", "end"),
    [
        (0, LARGE),
        (1, LARGE),
        (4095, LARGE - 1),
        (700, (4 << 20) + 700),
        (701, (4 << 20) + 700),
        (-LARGE, 0),
        (-9, -4),
    ],
)
def test_ranges_are_the_bytes_of_the_file_mapped_or_not(
    tree: LocalTree, start: int, end: int
) -> None:
    content = (tree.root / "large").read_bytes()
    assert bytes(tree.read_range("large", start, end)) == content[start : end or None]


def test_a_start_before_the_file_is_its_beginning(tree: LocalTree) -> None:
    assert bytes(tree.read_range("small", -1000, 0)) == b"0123456789"


@pytest.mark.parametrize(
    ("name", "start", "end"), [("small", 5, 11), ("large", 1000, LARGE + 1), ("small", 20, 30)]
)
def test_a_range_beyond_the_end_is_one_clear_error(
    tree: LocalTree, name: str, start: int, end: int
) -> None:
    with pytest.raises(FormatError, match=rf"{name}: expected .* bytes.*truncated"):
        tree.read_range(name, start, end)


def test_an_empty_file_is_read(tree: LocalTree) -> None:
    assert bytes(tree.read("empty")) == b""
    assert bytes(tree.read("small")) == b"0123456789"


def test_listings_tell_files_from_folders(tree: LocalTree) -> None:
    assert tree.entries() == {"large": False, "small": False, "empty": False, "inside": True}
    assert tree.entries("absent") == tree.entries("small") == {}
    assert tree.is_file("small") and not tree.is_file("inside") and not tree.is_file("absent")


def test_errors_name_the_file(tree: LocalTree) -> None:
    with raises(MissingDataError, where="/absent", expected="a file", found="nothing"):
        pickle.loads(pickle.dumps(tree)).read("absent")
    with pytest.raises(CarlascError, match=r"/inside"):
        tree.read_range("inside", 0, 1)


@pytest.mark.parametrize(
    "name", ["../a", "a/../b", "..", "/a", "\\a", "a\\b", "C:a", "z:/a", "a\0"]
)
def test_names_that_lead_outside(name: str) -> None:
    assert leads_outside(name)


@pytest.mark.parametrize(
    "name", ["", "a", "a/b", "..a", "a../b", "a/10:30", "1:a", "Übersicht", ".a"]
)
def test_names_that_stay_inside(name: str) -> None:
    assert not leads_outside(name)
