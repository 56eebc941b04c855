"""The rooms are in the order of the design: each imports those above it, never those below."""

import ast
import re
from functools import cache
from graphlib import TopologicalSorter
from pathlib import Path

import pytest
from entered import cases, count_case
from helpers.sources import modules_of, outline

ROOT = Path(__file__).parents[1]
PACKAGE = ROOT / "carlasc"
# files of both packages that a case of tests/tools/entered.py enters
MOST_FILES = {"regrid from scans": 40, "view": 20, "convert bag": 60}
DEEPEST = 16


@cache
def rooms():
    """Return the rooms in the order of the design's table."""
    table = (
        (ROOT / "docs" / "design.md").read_text().partition("## The rooms")[2].partition("\n## ")[0]
    )
    return re.findall(r"^\| `(\w+)` \|", table, re.MULTILINE)


def imported(path):
    """Return the rooms that a file imports, wherever in it."""
    parts = (module.split(".") for module in modules_of(path))
    return {part[1] for part in parts if part[0] == "carlasc" and len(part) > 1}


def test_every_room_stands_in_the_table():
    there = {
        path.stem
        for path in PACKAGE.iterdir()
        if path.suffix == ".py" or (path / "__init__.py").is_file()
    }
    assert set(rooms()) == there - {"__init__", "__main__"}


def modules():
    """Return the modules of the package, packages apart: their `__init__` only gather names."""
    files = [
        path for path in PACKAGE.rglob("*.py") if path.name not in ("__init__.py", "__main__.py")
    ]
    return {".".join(path.relative_to(ROOT).with_suffix("").parts): path for path in files}


def test_no_two_modules_import_each_other():
    files = modules()
    graph = {name: modules_of(path) & files.keys() for name, path in files.items()}
    TopologicalSorter(graph).prepare()  # raises CycleError, which names the modules


def test_no_room_imports_one_below_it():
    order = {room: place for place, room in enumerate(rooms())}
    for room, place in order.items():
        files = (
            [PACKAGE / f"{room}.py"]
            if (PACKAGE / f"{room}.py").is_file()
            else (PACKAGE / room).rglob("*.py")
        )
        for path in files:
            below = {name for name in imported(path) if order.get(name, -1) > place}
            assert not below, f"{path.relative_to(ROOT)} imports {', '.join(below)}"


@pytest.mark.parametrize("room", ["converting", "inspection", "running", "testing"])
def test_rooms_import_rooms_and_not_the_top_package(room):
    for path in (PACKAGE / room).rglob("*.py"):
        for module, name, line in outline(path).imports:
            is_top = module == "carlasc" and name not in rooms()
            assert not is_top, f"{path.relative_to(ROOT)}, line {line}: {name}"


def test_converters_and_examples_use_no_private_name():
    for path in [*(ROOT / "converters").rglob("*.py"), *(ROOT / "examples").rglob("*.py")]:
        private = re.findall(r"from carlasc[\w.]* import .*\b_\w+", path.read_text())
        assert not private, f"{path.relative_to(ROOT)}: {private}"


@pytest.fixture(scope="module")
def counted(tmp_path_factory):
    return cases(tmp_path_factory.mktemp("entered"))


@pytest.mark.slow
@pytest.mark.needs("trimesh", "embreex", "rosbags")
@pytest.mark.parametrize("case", MOST_FILES)
def test_a_frame_passes_through_few_files(counted, case):
    found = count_case(counted[case])
    assert len(found.files) <= MOST_FILES[case], sorted(found.files)
    assert found.depth <= DEEPEST, found.deepest


CLIENTS = (
    "aiohttp",
    "boto3",
    "botocore",
    "fsspec",
    "http.client",
    "httpx",
    "httpx2",
    "huggingface_hub",
    "obstore",
    "requests",
    "urllib.request",
    "urllib3",
)


def test_nothing_outside_of_transport_sends_a_request():
    transport = PACKAGE / "storage" / "transport"
    files = [path for place in (PACKAGE, ROOT / "converters") for path in place.rglob("*.py")]
    for path in files:
        if transport not in path.parents:
            found = {
                name
                for name in modules_of(path)
                if any(name == c or name.startswith(f"{c}.") for c in CLIENTS)
            }
            assert not found, f"{path.relative_to(ROOT)} imports {', '.join(sorted(found))}"


@pytest.mark.slow
def test_converters_and_recorders_are_found_by_entry_points_only():
    for path in PACKAGE.rglob("*.py"):
        tree = ast.parse(path.read_text())
        for_types = [
            node
            for block in ast.walk(tree)
            if isinstance(block, ast.If) and ast.unparse(block.test) == "TYPE_CHECKING"
            for node in ast.walk(block)
        ]
        for node in ast.walk(tree):
            modules = [node.module or ""] if isinstance(node, ast.ImportFrom) else []
            modules += [alias.name for alias in node.names] if isinstance(node, ast.Import) else []
            named = {module.partition(".")[0] for module in modules}
            found = named & {"carlasc_converters", "carlasc_recorders"}
            assert not found or node in for_types, f"{path.relative_to(ROOT)}, line {node.lineno}"


def test_the_protocols_of_stores_rest_on_no_store_and_on_no_transport():
    allowed = {"files", "layout", "protocol"}
    for name in ("protocol",):
        path = PACKAGE / "storage" / f"{name}.py"
        names = {
            part[2]
            for module in modules_of(path)
            if (part := module.split("."))[:2] == ["carlasc", "storage"] and len(part) > 2
        }
        assert names <= allowed, (
            f"{path.relative_to(ROOT)} imports {', '.join(sorted(names - allowed))}"
        )
