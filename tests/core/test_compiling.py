"""Compiled code is kept once for all environments, and is compiled again when any file that takes
part changes.
"""

import fcntl
import os
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numba
import pytest
from numba.core import event
from numba.core.caching import CompileResultCacheImpl, FunctionCache, _CacheLocator
from numba.core.dispatcher import Dispatcher

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
    kept = sorted(tmp_path.glob(".cache/carlasc/*/outer/*"))
    assert {path.suffix for path in kept} == {".nbc", ".nbi", ".lock"}
    for path in kept:
        os.utime(path, (0, 0))
    run(tmp_path / "a", tmp_path, factor=5)
    now = sorted(tmp_path.glob(".cache/carlasc/*/outer/*"))
    assert len(now) == len(kept)
    assert not set(now) & set(kept)


def test_checked_loops_are_kept_apart(monkeypatch: pytest.MonkeyPatch) -> None:
    plain = compiling.cache_folder()
    monkeypatch.setattr("numba.core.config.BOUNDSCHECK", 1)
    assert compiling.cache_folder() != plain


@pytest.mark.slow
def test_processes_that_need_a_function_at_once_compile_it_once(tmp_path: Path) -> None:
    with ThreadPoolExecutor(3) as pool:
        made = list(pool.map(run, [tmp_path / name for name in "abc"], [tmp_path] * 3))
    assert sorted(len(lines) for lines in made) == [1, 1, 3]
    assert {lines[-1] for lines in made} == {"7"}


def test_a_process_that_is_stopped_while_it_compiles_does_not_stop_the_others(
    tmp_path: Path, monkeypatch
) -> None:
    @compiling.cached
    def add(x):
        return x + 1

    monkeypatch.setattr(compiling, "_WAITED_S", 0.1)
    with add._cache._lock_path.open("ab") as held:
        fcntl.flock(held, fcntl.LOCK_EX)
        assert add(2) == 3
    assert add._cache._lock is None


@pytest.mark.parametrize(
    ("holder", "name"),
    [
        (numba.njit(compiling.fingerprint), "_cache"),
        (Dispatcher, "enable_caching"),
        (FunctionCache, "_impl_class"),
        (FunctionCache, "cache_path"),
        (FunctionCache, "load_overload"),
        (FunctionCache, "save_overload"),
        (CompileResultCacheImpl, "_locator_classes"),
        (numba.core.config, "CACHE_DIR"),
        (numba.core.config, "BOUNDSCHECK"),
        (event, "Listener"),
        (event, "register"),
    ],
)
def test_numba_has_each_undocumented_name_that_the_cache_uses(holder, name) -> None:
    assert hasattr(holder, name), (
        f"Numba {numba.__version__} has no {name}, on which carlasc.core.compiling rests"
    )


def test_numba_asks_a_locator_for_no_more_than_ours_has() -> None:
    wanted = {
        name
        for name, value in vars(_CacheLocator).items()
        if getattr(value, "__isabstractmethod__", False)
    }
    missing = (wanted | {"ensure_cache_path", "from_function"}) - set(dir(compiling._SourceLocator))
    assert not missing, f"Numba {numba.__version__} asks locators for {sorted(missing)}"


def test_code_goes_through_our_cache_and_not_through_numbas_own() -> None:
    @compiling.cached
    def double(x):
        return 2 * x

    assert double(2) == 4
    kept = list(Path(double._cache.cache_path).glob("*.double-*"))
    assert {path.suffix for path in kept} == {".nbc", ".nbi", ".lock"}, (
        f"Numba {numba.__version__} does not use the cache"
    )
