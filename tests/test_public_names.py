"""The public names of the package and of its rooms: each stands once, in a stub that type checkers
and `lazy_loader` read.
"""

import ast
import importlib
import pickle
import subprocess
import sys
from pathlib import Path
from types import FunctionType

import pytest

PACKAGE = Path(__file__).parents[1] / "carlasc"
ROOMS = sorted(path.parent.name for path in PACKAGE.glob("*/__init__.pyi"))
PACKAGES = ["carlasc", *(f"carlasc.{room}" for room in ROOMS)]


def folder_of(package):
    """Return the folder of a package."""
    return PACKAGE.joinpath(*package.split(".")[1:])


def homes(package):
    """Return the names of a stub, each with the module that it is imported from."""
    imports = [
        node
        for node in ast.parse((folder_of(package) / "__init__.pyi").read_text()).body
        if isinstance(node, ast.ImportFrom)
    ]
    for node in imports:
        assert node.level == 1 and all(alias.name == alias.asname for alias in node.names), (
            ast.unparse(node)
        )
    return [(alias.name, node.module) for node in imports for alias in node.names]


def run(code, *options):
    """Return what a program prints."""
    command = [sys.executable, *options, "-c", code]
    return subprocess.run(command, capture_output=True, text=True, check=True).stdout.strip()


def test_every_room_but_the_command_line_has_a_stub():
    rooms = {path.parent.name for path in PACKAGE.glob("*/__init__.py")}
    assert set(ROOMS) == rooms - {"cli"}


@pytest.mark.parametrize("package", PACKAGES)
def test_a_stub_lists_each_public_name_once(package):
    names = [name for name, _ in homes(package)]
    module = importlib.import_module(package)
    assert len(names) == len(set(names))
    assert set(names) == set(module.__all__) == set(dir(module))


@pytest.mark.parametrize("package", PACKAGES)
def test_every_public_name_resolves_and_hides_no_module(package):
    module = importlib.import_module(package)
    for name, home in homes(package):
        if home is None:
            assert getattr(module, name) is importlib.import_module(f"{package}.{name}")
            continue
        assert getattr(module, name) is getattr(importlib.import_module(f"{package}.{home}"), name)
        assert (
            not (folder_of(package) / f"{name}.py").exists()
            and not (folder_of(package) / name).exists()
        )
    with pytest.raises(AttributeError, match=rf"{package}\b.* attribute '?no_such_name"):
        module.no_such_name  # noqa: B018


@pytest.mark.parametrize("package", PACKAGES)
def test_importing_a_package_loads_none_of_its_modules(package):
    code = f"import sys, {package}; print([m for m in sys.modules if m.startswith('{package}.')])"
    assert run(code) == "[]"


def test_public_names_work_without_docstrings_and_assertions():
    assert (
        run("import carlasc; print(carlasc.open.__name__, carlasc.core.Grid.__name__)", "-OO")
        == "open Grid"
    )


def test_all_public_names_are_what_a_star_imports():
    code = (
        "from carlasc.core import *; from carlasc.storage import *; "
        "print(Grid.__name__, pack.__name__)"
    )
    assert run(code) == "Grid pack"


@pytest.mark.parametrize("package", PACKAGES)
def test_public_classes_and_functions_pickle(package):
    module = importlib.import_module(package)
    for name, _ in homes(package):
        value = getattr(module, name)
        if isinstance(value, type | FunctionType):
            assert pickle.loads(pickle.dumps(value)) is value
