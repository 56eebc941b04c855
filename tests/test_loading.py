"""Rooms whose names are loaded on first use: type checkers and Python must be told the same."""

import ast
import importlib
import subprocess
import sys
from pathlib import Path

import pytest

PACKAGE = Path(__file__).parents[1] / "carlasc"
LATE = sorted(path.parent.name for path in PACKAGE.glob("*/__init__.py") if "late_names(" in path.read_text())


def test_rooms_load_late():
    assert {"inspection", "metrics", "storage", "groundtruth"} <= set(LATE)


@pytest.mark.parametrize("room", LATE)
def test_type_checkers_and_python_see_the_same_names(room):
    tree = ast.parse((PACKAGE / room / "__init__.py").read_text())
    choice = next(node for node in tree.body if isinstance(node, ast.If))
    seen = {(alias.name, node.module) for node in choice.body for alias in node.names}
    call = next(node for node in ast.walk(choice) if isinstance(node, ast.Call) and node.func.id == "late_names")
    homes = ast.literal_eval(call.args[1])
    assert seen == {(name, f"carlasc.{room}.{module}") for module, names in homes.items() for name in names}


@pytest.mark.parametrize("room", LATE)
def test_every_name_of_a_room_resolves_and_hides_no_module(room):
    module = importlib.import_module(f"carlasc.{room}")
    assert set(dir(module)) <= set(module.__all__)
    for name in module.__all__:
        assert getattr(module, name) is not None
        assert not (PACKAGE / room / f"{name}.py").exists() and not (PACKAGE / room / name).exists()
    with pytest.raises(AttributeError, match=f"module 'carlasc.{room}' has no attribute 'no_such_name'"):
        module.no_such_name  # noqa: B018


@pytest.mark.parametrize("room", LATE)
def test_importing_a_room_loads_none_of_its_modules(room):
    code = f"import sys, carlasc.{room}; print([m for m in sys.modules if m.startswith('carlasc.{room}.')])"
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout == "[]\n"


def test_a_module_of_a_room_is_an_attribute_of_it():
    code = "import carlasc; print(carlasc.storage.layout.METADATA)"
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout.strip()
