"""Compiling loops with Numba once per machine, with one cache folder for all environments.

The cache of Numba is beside the source file, so each new environment compiles again. It checks the
time of one file only, so it misses changes in other files whose functions are compiled into a loop.
The key of this cache is the text of all these files, and the versions of Numba and NumPy. If
several processes need the same function, one compiles it. Importing this module loads Numba.
"""

from __future__ import annotations

import fcntl
import os
import sys
import time
import zlib
from collections.abc import Callable, Iterator
from contextlib import suppress
from functools import cache, partial
from inspect import getfile
from pathlib import Path
from tempfile import TemporaryFile
from types import FunctionType
from typing import IO, Any, ClassVar, overload

import numba
import numpy as np
from numba.core import config
from numba.core.caching import CompileResultCacheImpl, FunctionCache
from numba.core.dispatcher import Dispatcher

from carlasc.core import first_use

first_use.connect()

jit = numba.njit(nogil=True, error_model="numpy")
# inlined, because a loop with function calls is not vectorised
inlined = numba.njit(nogil=True, error_model="numpy", forceinline=True)
# Allows fused multiply-add. For code with margins that cover the different rounding.
fused = numba.njit(nogil=True, error_model="numpy", forceinline=True, fastmath={"contract"})

_KEPT_S = 90 * 86400  # how long compiled code of earlier versions of a function is kept
_WAITED_S = 60.0  # longest wait for another process that compiles the same function


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
        return partial(_compile, error_model=error_model, fastmath=fastmath)
    return _compile(function, error_model=error_model, fastmath=fastmath)


def _compile(function: FunctionType, **options: Any) -> Any:
    dispatcher: Any = numba.njit(nogil=True, **options)(function)
    try:
        dispatcher._cache = _SharedCache(function)
    except OSError:  # the source is in a zip, or the folder cannot be written to
        dispatcher.enable_caching()
    return dispatcher


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


def fingerprint(function: FunctionType) -> int:
    """Return a hash of the files of a function and of the compiled functions that it calls, and of
    the constants that they use.
    """
    files, constants = set(), []
    for part in _parts(function, set()):
        files.add(getfile(part))
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
        if isinstance(value, Dispatcher):
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


class _SourceLocator:
    """The locator of Numba for a function: its cache folder, and a name for each of its versions."""

    def __init__(self, function: FunctionType, file: str) -> None:
        self._py_file = file  # for Numba's warnings
        self._folder = cache_folder() / function.__module__
        self._stamp = fingerprint(function)
        self.ensure_cache_path()

    @classmethod
    def from_function(cls, py_func: FunctionType, py_file: str) -> _SourceLocator:
        return cls(py_func, py_file)

    def ensure_cache_path(self) -> None:
        self._folder.mkdir(parents=True, exist_ok=True)
        TemporaryFile(dir=self._folder).close()  # raises OSError if the folder is not writable

    def get_cache_path(self) -> str:
        return str(self._folder)

    def get_source_stamp(self) -> int:
        return self._stamp

    def get_disambiguator(self) -> str:
        return f"{self._stamp:08x}"


class _CompiledFiles(CompileResultCacheImpl):
    _locator_classes: ClassVar[list[Any]] = [_SourceLocator]  # type: ignore[misc]


class _SharedCache(FunctionCache):
    """The cache of a function.

    If several processes need it at the same time, one compiles it and the others wait.
    """

    _impl_class = _CompiledFiles

    def __init__(self, function: FunctionType) -> None:
        super().__init__(function)  # type: ignore[no-untyped-call]
        name = (
            f"{Path(getfile(function)).stem}.{function.__name__}-{fingerprint(function):08x}.lock"
        )
        self._versions = f"*.{function.__name__}-*"  # files
        self._lock_path = Path(self.cache_path, name)
        self._lock: IO[bytes] | None = None

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        found = super().load_overload(sig, target_context)  # type: ignore[no-untyped-call]
        if found is not None:
            return found
        self._acquire()
        found = super().load_overload(sig, target_context)  # type: ignore[no-untyped-call]
        if found is not None:
            self._release()
        return found

    def save_overload(self, sig: Any, data: Any) -> None:
        try:
            super().save_overload(sig, data)  # type: ignore[no-untyped-call]
            for old in Path(self.cache_path).glob(self._versions):
                with suppress(OSError):  # another process removes them too
                    if time.time() - old.stat().st_mtime > _KEPT_S:
                        old.unlink()
        finally:
            self._release()

    def _acquire(self) -> None:
        """Wait until no other process compiles the function, up to a limit: the other process may
        be stopped, or may have failed.
        """
        self._release()  # left by an interrupted compilation
        try:
            self._lock = self._lock_path.open("ab")
            until = time.monotonic() + _WAITED_S
            while time.monotonic() < until:
                with suppress(BlockingIOError):
                    fcntl.flock(self._lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
                    return
                time.sleep(0.02)
        except OSError:  # no locks, or no write permission: this process compiles itself
            self._release()

    def _release(self) -> None:
        lock, self._lock = self._lock, None
        if lock is not None:
            lock.close()
