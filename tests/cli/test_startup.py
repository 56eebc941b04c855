"""What commands load before they start: a user waits for each of these modules."""

import subprocess
import sys

import pytest
from typer.main import get_command

from carlasc.cli import app
from carlasc.testing import write_dataset

COMPILER = {"numba", "llvmlite", "scipy"}
STORES = {"h5py", "pyarrow", "zarr", "fsspec", "numcodecs", "dask"}
PICTURES = {"trimesh", "embreex", "PIL", "matplotlib", "open3d", "torch"}
UNUSED_HELP = {"rich.markdown", "rich.traceback", "pygments", "markdown_it"}


def loaded(*arguments):
    """Return what a command printed, and the modules that it loaded."""
    code = (
        f"import sys; sys.argv = ['carlasc', *{list(map(str, arguments))!r}]\n"
        "from carlasc.cli import main\n"
        "try: main()\nfinally: print('loaded:', *sys.modules)"
    )
    ran = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    printed, _, modules = ran.stdout.partition("loaded:")
    return printed, set(modules.split())


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    return write_dataset(tmp_path_factory.mktemp("data"))


def test_help_loads_what_it_prints_with():
    printed, modules = loaded("--help")
    assert "Usage: carlasc" in printed
    assert not modules & (COMPILER | STORES | PICTURES | UNUSED_HELP | {"numpy", "pydantic"})


@pytest.mark.parametrize("command", ["regrid", "convert", "evaluate", "render"])
def test_the_help_of_a_command_loads_no_numpy(command):
    printed, modules = loaded(command, "--help")
    assert f"Usage: carlasc {command}" in printed
    assert not modules & (COMPILER | STORES | PICTURES | UNUSED_HELP | {"numpy"})


@pytest.mark.slow
@pytest.mark.parametrize("command", ["info", "stats"])
def test_commands_that_compile_nothing_load_no_compiler(command, data):
    _, modules = loaded(command, data)
    assert not modules & (COMPILER | STORES | PICTURES | UNUSED_HELP)


def test_the_list_of_commands_shows_their_first_lines():
    printed, _ = loaded("--help")
    text = " ".join(printed.split())
    for name, command in get_command(app).commands.items():
        first = " ".join(command.help.split("\n\n")[0].split())
        assert f"{name} {first[:30]}" in text, name


def test_a_command_with_texts_and_defaults_loads_no_pydantic(data):
    """Typer converts values with pydantic, which takes as long to load as NumPy."""
    _, modules = loaded("info", data, "--json")
    assert "numpy" in modules and "pydantic" not in modules
