"""The size and the names of the house: what one person must keep in mind."""

import ast
import re
from collections import defaultdict
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PACKAGE = ROOT / "carlasc"
FILES = sorted([*PACKAGE.rglob("*.py"), *(ROOT / "converters").rglob("*.py")])
MOST_LINES, MOST_PARAMETERS, MOST_FIELDS, MOST_ENTRIES = 400, 12, 12, 16
# names of classes that hold options
OPTIONS = re.compile(r"\w*(Options|Settings|Scoring|Details|Address)|From\w+|Voting|Run|Lidar")


def parsed():
    """Yield each file, relative to the repository, and its syntax tree."""
    for path in FILES:
        yield path.relative_to(ROOT).as_posix(), ast.parse(path.read_text())


def test_no_two_classes_have_the_same_name():
    homes = defaultdict(list)
    for path, tree in parsed():
        for node in ast.walk(tree):
            if isinstance(node, ast.ClassDef):
                homes[node.name.strip("_")].append(path)
    assert {name: paths for name, paths in homes.items() if len(paths) > 1} == {}


def test_no_file_name_occurs_more_than_twice():
    homes = defaultdict(list)
    for path in FILES:
        if path.name not in ("__init__.py", "__main__.py"):
            homes[path.name].append(path.relative_to(ROOT).as_posix())
    assert {name: paths for name, paths in homes.items() if len(paths) > 2} == {}


def test_no_module_is_long():
    lengths = {
        path.relative_to(ROOT).as_posix(): len(path.read_text().splitlines()) for path in FILES
    }
    assert {path: length for path, length in lengths.items() if length > MOST_LINES} == {}


def is_public(path):
    """Whether a file belongs to the library, not to the command line, whose functions have a
    parameter per option.
    """
    return not path.startswith("carlasc/cli/")


def test_no_public_function_has_many_parameters():
    many = {}
    for path, tree in parsed():
        for node in ast.walk(tree):
            if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef) and is_public(path):
                arguments = [*node.args.posonlyargs, *node.args.args, *node.args.kwonlyargs]
                names = [
                    argument.arg for argument in arguments if argument.arg not in ("self", "cls")
                ]
                if len(names) > MOST_PARAMETERS and (
                    not node.name.startswith("_") or node.name == "__init__"
                ):
                    many[f"{path}: {node.name}"] = len(names)
    assert many == {}


def test_no_options_object_has_many_fields():
    many = {}
    for path, tree in parsed():
        for node in ast.walk(tree):
            if isinstance(node, ast.ClassDef) and OPTIONS.fullmatch(node.name):
                fields = [field for field in node.body if isinstance(field, ast.AnnAssign)]
                if len(fields) > MOST_FIELDS:
                    many[f"{path}: {node.name}"] = len(fields)
    assert many == {}


def test_the_package_has_few_entries():
    entries = {
        path.stem for path in PACKAGE.iterdir() if path.name not in ("__pycache__", "py.typed")
    }
    assert len(entries - {"__init__", "__main__"}) <= MOST_ENTRIES, sorted(entries)


@pytest.mark.parametrize("room", ["converting", "inspection", "running", "testing"])
def test_rooms_do_not_import_the_top_package(room):
    rooms = {path.stem for path in PACKAGE.iterdir()}
    for path in (PACKAGE / room).rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text())):
            names = (
                [alias.name for alias in node.names]
                if isinstance(node, ast.Import | ast.ImportFrom)
                else []
            )
            if isinstance(node, ast.Import):
                assert "carlasc" not in names, f"{path.relative_to(ROOT)}, line {node.lineno}"
            elif isinstance(node, ast.ImportFrom) and node.module == "carlasc":
                assert set(names) <= rooms, f"{path.relative_to(ROOT)}, line {node.lineno}: {names}"
