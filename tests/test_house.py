"""The size and the names of the house: what one person must keep in mind.

Code is counted in tokens, see tests/tools/rooms.py.
"""

import re
import warnings
from collections import defaultdict
from pathlib import Path

import pytest
import rooms
from helpers.sources import outline

ROOT = Path(__file__).parents[1]
PACKAGE = ROOT / "carlasc"
FILES = sorted([*PACKAGE.rglob("*.py"), *(ROOT / "converters").rglob("*.py")])
MOST_PARAMETERS, MOST_FIELDS, MOST_ENTRIES = 12, 12, 16
MOST_TOKENS = {"carlasc": 452_000, "converters": 107_650}
DENSEST = 9.45  # tokens a line of code
WIDEST = 100  # columns
LONG = 500  # lines of a module, above which it is named
# names of classes that hold options
OPTIONS = re.compile(r"\w*(Options|Settings|Scoring|Details|Address)|From\w+|Voting|Run|Lidar")


def outlines():
    """Yield each file, relative to the repository, and what it defines."""
    for path in FILES:
        yield path.relative_to(ROOT).as_posix(), outline(path)


def test_no_two_public_classes_have_the_same_name():
    homes = defaultdict(list)
    for path, found in outlines():
        for name, _ in found.classes:
            if not name.startswith("_"):
                homes[name].append(path)
    assert {name: paths for name, paths in homes.items() if len(paths) > 1} == {}


def test_no_file_name_occurs_more_than_twice():
    homes = defaultdict(list)
    for path in FILES:
        if path.name not in ("__init__.py", "__main__.py"):
            homes[path.name].append(path.relative_to(ROOT).as_posix())
    assert {name: paths for name, paths in homes.items() if len(paths) > 2} == {}


def test_no_room_has_grown():
    grown = {
        room: f"{now:,}, docs/design.md says {held:,}"
        for room, held in rooms.table(rooms.PAGE.read_text()).items()
        if (now := rooms.mass_of_room(room).tokens) > (1 + rooms.GROWTH) * held
    }
    assert grown == {}, "if it is worth it, `python tests/tools/rooms.py` writes the table anew"


@pytest.mark.parametrize("package", MOST_TOKENS)
def test_a_package_has_few_tokens_and_few_in_a_line(package):
    found = rooms.mass(ROOT / package)
    assert found.tokens <= MOST_TOKENS[package]
    assert found.tokens / found.lines <= DENSEST


def test_no_line_is_wide():
    wide = [
        f"{path.relative_to(ROOT)}:{number}"
        for path in FILES
        for number, line in enumerate(path.read_text().splitlines(), 1)
        if len(line) > WIDEST and "://" not in line and not line.lstrip().startswith("|")
    ]
    assert wide == []


def test_long_modules_are_named():
    for path in FILES:
        if (lines := len(path.read_text().splitlines())) > LONG:
            warnings.warn(f"{path.relative_to(ROOT)} has {lines} lines", stacklevel=1)


def is_public(path):
    """Whether a file belongs to the library, not to the command line, whose functions have a
    parameter per option.
    """
    return not path.startswith("carlasc/cli/")


def test_no_public_function_has_many_parameters():
    many = {
        f"{path}: {name}": len(parameters)
        for path, found in outlines()
        for name, parameters in found.functions
        if is_public(path)
        and len(parameters) > MOST_PARAMETERS
        and (not name.startswith("_") or name == "__init__")
    }
    assert many == {}


def test_no_options_object_has_many_fields():
    many = {
        f"{path}: {name}": fields
        for path, found in outlines()
        for name, fields in found.classes
        if OPTIONS.fullmatch(name) and fields > MOST_FIELDS
    }
    assert many == {}


def test_the_package_has_few_entries():
    entries = {
        path.stem for path in PACKAGE.iterdir() if path.name not in ("__pycache__", "py.typed")
    }
    assert len(entries - {"__init__", "__main__"}) <= MOST_ENTRIES, sorted(entries)
