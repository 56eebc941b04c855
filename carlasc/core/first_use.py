"""The first use of loops on a machine: compiling takes several seconds. The user is told, and one
worker compiles before the others start.

Importing this module loads nothing heavy, so a program can ask to be told before it imports Numba.
"""

from __future__ import annotations

import sys
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from multiprocessing.synchronize import Semaphore

NoteRequest = tuple[Callable[[], None], float]
"""A function, and the compile time after which it is called, seconds."""

note_requests: list[NoteRequest] = []
"""The requests of this process. When `carlasc.core.compiling` is imported, Numba gets them."""

loop_folders: set[str] = set()
"""The folders of the compiled code of the loops that this process has loaded."""


def note_compiling(tell: Callable[[], None], after_s: float = 1.0) -> None:
    """Call a function once, after this process, or one of the worker processes that it starts
    later, has compiled for some time.

    Args:
        tell: the function. It must be picklable by name, for worker processes.
        after_s: compile time after which it is called, seconds.
    """
    note_requests.append((tell, after_s))


def say_compiling() -> None:
    """Print on stderr that loops are being compiled."""
    sys.stderr.write("compiling (once per machine) ...\n")
    sys.stderr.flush()


def note_in_workers(requests: list[NoteRequest], first: Semaphore) -> None:
    """Repeat the requests of the parent in a worker process.

    `first` is a semaphore by which only one worker calls the function.
    """
    for tell, after_s in requests:

        def once(tell: Callable[[], None] = tell) -> None:
            if first.acquire(block=False):
                tell()

        note_compiling(once, after_s)


def is_first_use(function: Callable[..., Any]) -> bool:
    """Return whether workers run a function with the loaded loops for the first time on this
    machine, and remember that they do.

    The loops are then probably not compiled yet.
    """
    if not loop_folders:
        return False
    name = getattr(function, "__qualname__", type(function).__qualname__)
    key = zlib.crc32("\n".join([name, *sorted(loop_folders)]).encode())
    try:
        Path(min(loop_folders), f"used-{key:08x}").touch(exist_ok=False)
    except OSError:  # it exists, or nothing can be kept
        return False
    return True
