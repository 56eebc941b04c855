"""Compiling loops with Numba once per machine, with one cache folder for all environments.

Numba keeps compiled code beside the source, so each new environment would compile again. It looks
at the text of one file only, so it would miss changes in other files whose functions are compiled
into a loop. Therefore each loop is compiled as if its file lay in a folder of the user's caches,
which is named by the text of all these files and by the versions of Numba and NumPy; a copy of the
file is put there. Importing this module loads Numba.
"""

from __future__ import annotations

import os
import shutil
import sys
import time
import zlib
from collections.abc import Callable, Iterator
from contextlib import suppress
from functools import cache, partial
from inspect import getfile
from pathlib import Path
from threading import Timer
from types import FunctionType
from typing import Any, overload

import numba
import numpy as np
from numba import config
from numba.core import event

from carlasc.core import first_use

jit = numba.njit(nogil=True, error_model="numpy")
# inlined, because a loop with function calls is not vectorised
inlined = numba.njit(nogil=True, error_model="numpy", forceinline=True)
# Allows fused multiply-add. For code with margins that cover the different rounding.
fused = numba.njit(nogil=True, error_model="numpy", forceinline=True, fastmath={"contract"})


class CompilingNote(event.Listener):
    """Calls a function once, after this process has compiled for a given time.

    Loading compiled code from the cache does not count.
    """

    def __init__(self, tell: Callable[[], None], after_s: float) -> None:
        """Create a note.

        Args:
            tell: the function. It is called in another thread during the compilation.
            after_s: compile time after which it is called, seconds.
        """
        self._tell = tell
        self._left_s = after_s
        self._told = False
        self._depth = 0
        self._started_s = 0.0
        self._timer: Timer | None = None

    def on_start(self, _: Any) -> None:
        """Count the time from here on, unless a loop is compiled for another loop that calls it."""
        self._depth += 1
        if self._depth == 1 and not self._told:
            self._started_s = time.perf_counter()
            self._timer = Timer(max(self._left_s, 0.0), self._finish)
            self._timer.daemon = True
            self._timer.start()

    def on_end(self, _: Any) -> None:
        """Stop counting when the outermost loop is compiled."""
        self._depth -= 1
        if self._depth == 0 and self._timer is not None:
            self._timer.cancel()
            self._timer = None
            self._left_s -= time.perf_counter() - self._started_s

    def _finish(self) -> None:
        self._told = True
        self._tell()


for _request in first_use.note_requests:
    event.register("numba:compile", CompilingNote(*_request))  # type: ignore[no-untyped-call]

_KEPT_S = 90 * 86400  # how long compiled code of earlier versions of a function is kept


@overload
def cached(function: Callable[..., Any], /) -> Any: ...


@overload
def cached(
    *, error_model: str = ..., fastmath: bool = ...
) -> Callable[[Callable[..., Any]], Any]: ...


def cached(function: Any = None, /, *, error_model: str = "numpy", fastmath: bool = False) -> Any:
    """Compile a function, including the compiled functions that it calls, and cache the compiled
    code.

    Args:
        function: the function; None returns a decorator.
        error_model: "numpy", in which a division by zero is infinite, or "python", in which it
            raises ZeroDivisionError.
        fastmath: whether sums may be reordered.
    """
    if function is None:
        return partial(cached, error_model=error_model, fastmath=fastmath)
    settings: Any = config  # without types
    if not settings.DISABLE_JIT:
        with suppress(OSError):  # the source is in a zip, or the folder cannot be written to
            copy = str(_copy_of_source(function))
            function.__code__ = function.__code__.replace(co_filename=copy)
    njit: Any = numba.njit
    loop = njit(nogil=True, cache=True, error_model=error_model, fastmath=fastmath)(function)
    if not settings.DISABLE_JIT:
        first_use.loop_folders.add(loop.stats.cache_path)
    return loop


def cache_folder() -> Path:
    """Return the folder of compiled code: `NUMBA_CACHE_DIR`, or a folder in the cache folder of the
    user (`XDG_CACHE_HOME`).
    """
    settings: Any = config  # without types
    usual = (
        "~/Library/Caches"
        if sys.platform == "darwin"
        else os.environ.get("XDG_CACHE_HOME") or "~/.cache"
    )
    base = settings.CACHE_DIR or Path(usual, "carlasc")
    checked = "-checked" if settings.BOUNDSCHECK else ""
    return (
        Path(base).expanduser()
        / f"compiled-numba{numba.__version__}-numpy{np.__version__}{checked}"
    )


def _copy_of_source(function: FunctionType) -> Path:
    """Return a copy of the file of a function, in a folder for this version of the function.

    Raises:
        OSError: the file cannot be read, or the folder cannot be written to.
    """
    versions = cache_folder() / f"{function.__module__}.{function.__name__}"
    copy = versions / f"{_fingerprint(function):08x}" / Path(getfile(function)).name
    if copy.exists():
        return copy
    copy.parent.mkdir(parents=True, exist_ok=True)
    for old in versions.iterdir():
        if time.time() - old.stat().st_mtime > _KEPT_S:
            shutil.rmtree(old, ignore_errors=True)  # another process removes it too
    whole = copy.with_name(f"{copy.name}.{os.getpid()}")  # no other process reads half a file
    shutil.copyfile(getfile(function), whole)
    return whole.replace(copy)


def _fingerprint(function: FunctionType) -> int:
    """Return a hash of the files of a function and of the compiled functions that it calls, and of
    the constants that they use.
    """
    files = set()
    constants = []
    for part in _parts(function, set()):
        files.add(part.__globals__.get("__file__", part.__code__.co_filename))
        for name, value in _names(part):
            if isinstance(value, int | float | str | bytes | tuple):
                constants.append(f"{part.__qualname__}.{name}={value!r}")
    return zlib.crc32("\n".join([*sorted(map(_sum, files)), *sorted(constants)]).encode())


@cache
def _sum(file: str) -> str:
    return f"{zlib.crc32(Path(file).read_bytes()):08x}"


def _parts(function: FunctionType, seen: set[FunctionType]) -> Iterator[FunctionType]:
    """Yield a function and every compiled function that it calls, directly or indirectly."""
    if function in seen:
        return
    seen.add(function)
    yield function
    for _, value in _names(function):
        if hasattr(value, "py_func"):  # compiled by Numba
            yield from _parts(value.py_func, seen)


def _names(function: FunctionType) -> Iterator[tuple[str, Any]]:
    """Yield the global and closure variables that a function uses, with their names."""
    code = function.__code__
    for name in code.co_names:
        if name in function.__globals__:
            yield name, function.__globals__[name]
    for name, cell in zip(code.co_freevars, function.__closure__ or (), strict=True):
        with suppress(ValueError):  # not assigned yet
            yield name, cell.cell_contents
