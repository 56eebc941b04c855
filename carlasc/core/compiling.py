"""Loops that Numba compiles, once per machine: what is compiled is kept in one folder for all environments.

Numba's own cache lies beside the source, so that each new environment compiles again, and looks at the time of one file, so that it misses changes in
the other files whose functions are compiled into a loop. The cache here is found by what the code is: the text of every file that takes part,
and the versions of Numba and NumPy. Of several processes that need the same function, one compiles it. Importing this module loads Numba.
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
inlined = numba.njit(nogil=True, error_model="numpy", forceinline=True)  # a loop that calls others is not vectorised
# Where margins cover the rounding, a product and a sum may become one operation.
fused = numba.njit(nogil=True, error_model="numpy", forceinline=True, fastmath={"contract"})

_KEPT_S = 90 * 86400  # how long what earlier versions of a function compiled is kept
_WAITED_S = 60.0  # for another process that compiles the same function


@overload
def cached(function: Callable[..., Any], /) -> Any: ...


@overload
def cached(*, error_model: str = ..., fastmath: bool = ...) -> Callable[[Callable[..., Any]], Any]: ...


def cached(function: Any = None, /, *, error_model: str = "numpy", fastmath: bool = False) -> Any:
    """Compile a function that Python calls, and keep what is compiled; the functions that it calls are compiled into it.

    Args:
        function: the function. None: the result is a decorator.
        error_model: "numpy", in which a division by zero is infinite, or "python", in which it raises ZeroDivisionError.
        fastmath: whether sums may be taken in any order.
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
    """Return the folder of what is compiled: `NUMBA_CACHE_DIR`, or that of the user's caches (`XDG_CACHE_HOME`)."""
    settings: Any = config  # without types
    usual = "~/Library/Caches" if sys.platform == "darwin" else os.environ.get("XDG_CACHE_HOME") or "~/.cache"
    base = settings.CACHE_DIR or Path(usual, "carlasc")
    checked = "-checked" if settings.BOUNDSCHECK else ""
    return Path(base).expanduser() / f"compiled-numba{numba.__version__}-numpy{np.__version__}{checked}"


def fingerprint(function: FunctionType) -> int:
    """Return a number that changes with the files of a function and of the compiled functions that it calls, and with the constants that they use."""
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
    """Yield a function and every compiled function that it calls, directly or through others."""
    if function in seen:
        return
    seen.add(function)
    yield function
    for _, value in _names(function):
        if isinstance(value, Dispatcher):
            yield from _parts(value.py_func, seen)


def _names(function: FunctionType) -> Iterator[tuple[str, Any]]:
    """Yield the globals and the enclosed values that a function uses, with their names."""
    code = function.__code__
    for name in code.co_names:
        if name in function.__globals__:
            yield name, function.__globals__[name]
    for name, cell in zip(code.co_freevars, function.__closure__ or (), strict=True):
        with suppress(ValueError):  # not assigned yet
            yield name, cell.cell_contents


class _SourceLocator:
    """Where a function is kept, and the name that tells its versions apart: what Numba asks of a locator."""

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
        TemporaryFile(dir=self._folder).close()  # raises OSError where nothing can be written

    def get_cache_path(self) -> str:
        return str(self._folder)

    def get_source_stamp(self) -> int:
        return self._stamp

    def get_disambiguator(self) -> str:
        return f"{self._stamp:08x}"


class _CompiledFiles(CompileResultCacheImpl):
    _locator_classes: ClassVar[list[Any]] = [_SourceLocator]  # type: ignore[misc]


class _SharedCache(FunctionCache):
    """Keeps what is compiled of a function. Of the processes that need it at the same time, one compiles it and the others wait for that one."""

    _impl_class = _CompiledFiles

    def __init__(self, function: FunctionType) -> None:
        super().__init__(function)  # type: ignore[no-untyped-call]
        name = f"{Path(getfile(function)).stem}.{function.__name__}-{fingerprint(function):08x}.lock"
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
        """Wait until no other process compiles the function, but not for ever: it may have been stopped, or its compiling has failed."""
        self._release()  # what a compilation has left that was interrupted
        try:
            self._lock = self._lock_path.open("ab")
            until = time.monotonic() + _WAITED_S
            while time.monotonic() < until:
                with suppress(BlockingIOError):
                    fcntl.flock(self._lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
                    return
                time.sleep(0.02)
        except OSError:  # no locks, or no right to write: this process compiles by itself
            self._release()

    def _release(self) -> None:
        lock, self._lock = self._lock, None
        if lock is not None:
            lock.close()
