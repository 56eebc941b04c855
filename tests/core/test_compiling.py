"""Compiled code is kept once for all environments, and is compiled again when any file that takes
part changes.
"""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from carlasc.core import compiling

INNER = """
from carlasc.core.compiling import jit

FACTOR = {factor}

@jit
def inner(x):
    return FACTOR * x
"""
OUTER = """
from numba.core import event
from carlasc.core.compiling import cached
from inner import inner

class Compiled(event.Listener):
    def on_start(self, found):
        print("compiled", found.data["dispatcher"].py_func.__name__)
    def on_end(self, found):
        pass

event.register("numba:compile", Compiled())

@cached
def outer(x):
    return inner(x) + 1

print(outer(3))
"""


def run(folder: Path, home: Path, factor: int = 2) -> list[str]:
    """Run the program in an environment of its own; return what it compiled and what it computed."""
    folder.mkdir(exist_ok=True)
    (folder / "inner.py").write_text(INNER.format(factor=factor))
    (folder / "outer.py").write_text(OUTER)
    environment = {name: value for name, value in os.environ.items() if name != "NUMBA_CACHE_DIR"}
    environment |= {"HOME": str(home), "XDG_CACHE_HOME": str(home / ".cache")}
    environment |= {"PYTHONPATH": os.pathsep.join([str(folder), *filter(None, sys.path)])}
    ran = subprocess.run(  # noqa: PLW1510
        [sys.executable, "-B", "-c", "import outer"],
        env=environment,
        capture_output=True,
        text=True,
        timeout=100,
    )
    assert ran.returncode == 0, ran.stderr
    return ran.stdout.split("\n")[:-1]


def test_a_machine_compiles_once_for_all_environments(tmp_path: Path) -> None:
    assert run(tmp_path / "a", tmp_path) == ["compiled outer", "compiled inner", "7"]
    assert run(tmp_path / "b", tmp_path) == ["7"]
    assert not list(tmp_path.glob("[ab]/__pycache__"))


@pytest.mark.slow
def test_a_change_of_a_file_whose_functions_are_compiled_in_compiles_again(tmp_path: Path) -> None:
    assert run(tmp_path / "a", tmp_path)[-1] == "7"
    assert run(tmp_path / "a", tmp_path, factor=5) == ["compiled outer", "compiled inner", "16"]
    assert run(tmp_path / "b", tmp_path) == ["7"]  # both versions are kept


@pytest.mark.skipif(
    os.name != "posix" or os.geteuid() == 0, reason="needs a user who may not write everywhere"
)
def test_where_the_folder_of_the_user_cannot_be_written_to_code_is_kept_beside_the_source(
    tmp_path: Path,
) -> None:
    home = tmp_path / "home"
    home.mkdir(mode=0o500)
    assert run(tmp_path / "a", home)[-1] == "7"
    assert run(tmp_path / "a", home) == ["7"]


@pytest.mark.slow
def test_a_file_in_the_place_of_the_folder_does_not_stop_the_program(tmp_path: Path) -> None:
    (tmp_path / ".cache").write_text("")
    assert run(tmp_path / "a", tmp_path)[-1] == "7"
    assert run(tmp_path / "a", tmp_path) == ["7"]


@pytest.mark.slow
def test_what_old_versions_compiled_is_removed(tmp_path: Path) -> None:
    run(tmp_path / "a", tmp_path)
    kept = sorted(tmp_path.glob(".cache/carlasc/*/outer.outer/*"))
    assert len(kept) == 1
    for path in kept:
        os.utime(path, (0, 0))
    run(tmp_path / "a", tmp_path, factor=5)
    now = sorted(tmp_path.glob(".cache/carlasc/*/outer.outer/*"))
    assert len(now) == len(kept)
    assert not set(now) & set(kept)


def test_checked_loops_are_kept_apart(monkeypatch: pytest.MonkeyPatch) -> None:
    plain = compiling.cache_folder()
    monkeypatch.setattr("numba.core.config.BOUNDSCHECK", 1)
    assert compiling.cache_folder() != plain


def test_code_is_kept_in_the_folder_of_the_user_beside_a_copy_of_its_source() -> None:
    @compiling.cached
    def double(x):
        return 2 * x

    assert double(2) == 4
    folder = Path(double.stats.cache_path)
    assert folder.is_relative_to(compiling.cache_folder().parent)
    assert {path.suffix for path in folder.glob("*.double-*")} == {".nbc", ".nbi"}
    copy = Path(double.py_func.__code__.co_filename)
    assert copy.read_bytes() == Path(__file__).read_bytes()
    assert copy.is_relative_to(compiling.cache_folder())


def test_the_time_of_several_loops_is_added_up(monkeypatch):
    times, notes, timers = iter([0.0, 0.7, 5.0, 5.2]), [], []

    class Timer:
        def __init__(self, wait_s, call):
            self.wait_s, self.call, self.daemon, self.cancelled = wait_s, call, False, False
            timers.append(self)

        def start(self):
            pass

        def cancel(self):
            self.cancelled = True

    monkeypatch.setattr(compiling, "Timer", Timer)
    monkeypatch.setattr(compiling.time, "perf_counter", lambda: next(times))
    note = compiling.CompilingNote(lambda: notes.append("told"), 1.0)
    note.on_start(None)
    note.on_start(None)  # a loop that the first one calls
    note.on_end(None)
    note.on_end(None)
    assert timers[0].cancelled and not notes
    note.on_start(None)
    assert timers[1].wait_s == pytest.approx(0.3)
    timers[1].call()
    note.on_end(None)
    note.on_start(None)
    assert notes == ["told"] and len(timers) == 2
