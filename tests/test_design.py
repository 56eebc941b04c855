"""The rooms are in the order that the design says: each imports those above it, never those below."""

import ast
import re
from graphlib import TopologicalSorter
from pathlib import Path

import pytest
from entered import cases, count_case

ROOT = Path(__file__).parents[1]
PACKAGE = ROOT / "carlasc"
# Of the package, that one frame of `regrid` from scans enters: see tests/tools/entered.py.
MOST_FILES, DEEPEST = 40, 16


def rooms():
    """Return the rooms in the order of the design's table."""
    table = (
        (ROOT / "docs" / "design.md").read_text().partition("## The rooms")[2].partition("\n## ")[0]
    )
    return re.findall(r"^\| `(\w+)` \|", table, re.MULTILINE)


def imported(path):
    """Yield the rooms that a file imports, wherever in it."""
    for node in ast.walk(ast.parse(path.read_text())):
        modules = []
        if isinstance(node, ast.ImportFrom) and node.module == "carlasc":
            modules = [f"carlasc.{alias.name}" for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            modules = [node.module or ""]
        elif isinstance(node, ast.Import):
            modules = [alias.name for alias in node.names]
        for module in modules:
            if (parts := module.split("."))[0] == "carlasc" and len(parts) > 1:
                yield parts[1]


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
    graph = {}
    for name, path in modules().items():
        nodes = [
            node
            for node in ast.walk(ast.parse(path.read_text()))
            if isinstance(node, ast.ImportFrom)
        ]
        wanted = {f"{node.module}.{alias.name}" for node in nodes for alias in node.names} | {
            n.module for n in nodes
        }
        graph[name] = wanted & set(modules())
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


def test_rooms_import_rooms_and_not_the_top_package():
    for room in ("converting", "inspection", "running", "testing"):
        for path in (PACKAGE / room).rglob("*.py"):
            for node in ast.walk(ast.parse(path.read_text())):
                names = (
                    {alias.name for alias in node.names}
                    if isinstance(node, ast.Import | ast.ImportFrom)
                    else set()
                )
                from_top = (
                    isinstance(node, ast.ImportFrom)
                    and node.module == "carlasc"
                    and not names <= set(rooms())
                )
                assert not (isinstance(node, ast.Import) and "carlasc" in names) and not from_top, (
                    path
                )


def test_converters_and_examples_use_no_private_name():
    for path in [*(ROOT / "converters").rglob("*.py"), *(ROOT / "examples").rglob("*.py")]:
        private = re.findall(r"from carlasc[\w.]* import .*\b_\w+", path.read_text())
        assert not private, f"{path.relative_to(ROOT)}: {private}"


@pytest.mark.needs("trimesh", "embreex")
def test_one_frame_from_scans_passes_through_few_files(tmp_path):
    found = count_case(cases(tmp_path)["regrid from scans"])
    assert len(found.files) <= MOST_FILES, sorted(found.files)
    assert found.depth <= DEEPEST, found.deepest


def modules_of(path):
    """Yield the full names of the modules that a file imports, wherever in it; by name too
    (`import_extra("s3fs", ...)`).
    """
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.ImportFrom):
            yield node.module or ""
            yield from (f"{node.module}.{alias.name}" for alias in node.names)
        elif isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif (
            isinstance(node, ast.Call)
            and isinstance(node.func, ast.Name)
            and node.func.id in ("import_extra", "import_module")
            and node.args
            and isinstance(node.args[0], ast.Constant)
        ):
            yield str(node.args[0].value)


CLIENTS = (
    "aiobotocore",
    "aiohttp",
    "boto3",
    "botocore",
    "fsspec",
    "http.client",
    "httpx",
    "httpx2",
    "huggingface_hub",
    "requests",
    "s3fs",
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


def test_the_protocols_of_stores_rest_on_no_store_and_on_no_transport():
    allowed = {"files", "layout", "metadata", "protocol"}
    for name in ("protocol", "sinks"):
        path = PACKAGE / "storage" / f"{name}.py"
        names = {
            part[2]
            for module in modules_of(path)
            if (part := module.split("."))[:2] == ["carlasc", "storage"] and len(part) > 2
        }
        assert names <= allowed, (
            f"{path.relative_to(ROOT)} imports {', '.join(sorted(names - allowed))}"
        )
