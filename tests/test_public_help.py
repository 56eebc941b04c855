"""`help` works in every installation: it loads each public name, whatever packages are missing."""

import re
import subprocess
import sys
import tomllib
from importlib.metadata import packages_distributions
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

ROOT = Path(__file__).parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
EXTRAS = PROJECT["optional-dependencies"]
INSTALLED = re.findall(
    r"pip install '\.\[([a-z,]+)\]'",
    "".join((ROOT / page).read_text() for page in ("README.md", "docs/index.md", "docs/start.md")),
)
SETS = sorted({tuple(sorted(extras.split(","))) for extras in INSTALLED} | {("all",)})
ROOMS = sorted(path.parent.name for path in (ROOT / "carlasc").glob("*/__init__.py"))
MODULES = ["carlasc", *(f"carlasc.{room}" for room in ROOMS), "carlasc.errors", "carlasc.demo"]

PRINT_HELP = '''
import pydoc, sys

hidden, modules = sys.argv[1].split(), sys.argv[2:]

class Installed:
    """A finder that finds no hidden module."""

    def __init__(self, finder):
        self.finder = finder

    def __getattr__(self, name):
        return getattr(self.finder, name)

    def find_spec(self, name, *others):
        known = name.partition(".")[0] not in hidden
        return self.finder.find_spec(name, *others) if known else None

for name in hidden:
    assert name not in sys.modules, name
sys.meta_path[:] = map(Installed, sys.meta_path)
for module in modules:
    print(module, len(pydoc.render_doc(module, renderer=pydoc.plaintext)))
'''


def packages_of(extra):
    """Return the names of the packages that an extra of carlasc brings."""
    names = set()
    for line in EXTRAS[extra]:
        needed = Requirement(line)
        if needed.name == "carlasc":
            names.update(*map(packages_of, needed.extras))
        else:
            names.add(canonicalize_name(needed.name))
    return names


def hidden_without(extras):
    """Return the modules that are missing from an installation with these extras: those of all
    packages that only other extras bring.
    """
    optional = set().union(*map(packages_of, EXTRAS))
    core = {canonicalize_name(Requirement(line).name) for line in PROJECT["dependencies"]}
    missing = optional - core - set().union(*map(packages_of, extras))
    homes = packages_distributions().items()
    return sorted(
        module
        for module, distributions in homes
        if {canonicalize_name(name) for name in distributions} <= missing
        and module.isidentifier()
        and not module.startswith("_")
    )


def check_help(extras):
    hidden = " ".join(hidden_without(extras))
    command = [sys.executable, "-c", PRINT_HELP, hidden, *MODULES]
    ran = subprocess.run(command, capture_output=True, text=True, check=False)
    assert ran.returncode == 0, ran.stderr.splitlines()[-1]
    assert [line.split()[0] for line in ran.stdout.splitlines()] == MODULES


@pytest.mark.slow
def test_help_works_in_a_base_installation():
    assert "pytest" in hidden_without(()) and "numpy" not in hidden_without(())
    check_help(())


@pytest.mark.slow
@pytest.mark.parametrize("extras", SETS, ids=",".join)
def test_help_works_in_each_documented_installation(extras):
    check_help(extras)


def test_contract_tests_without_pytest_say_what_is_missing():
    code = (
        "import sys; sys.modules['pytest'] = None\n"
        "import carlasc\n"
        "assert 'published_bytes' in dir(carlasc.testing)\n"
        "try: carlasc.testing.SourceContract\n"
        "except carlasc.errors.DependencyError as error: print(error)"
    )
    ran = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert ran.stdout == "pytest is not installed: install it with `pip install pytest`\n"
