"""Notification that Numba is compiling.

On the first use on a machine, compiling loops takes several seconds.

Importing this module loads nothing heavy, so a program can request the notification before it
imports Numba. `carlasc.core.compiling` connects the requests with Numba.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from threading import Timer
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from multiprocessing.synchronize import Semaphore

_asked: list[CompilingNote] = []
_wishes: list[tuple[Callable[[], None], float]] = []  # passed on to worker processes


class CompilingNote:
    """Calls a function once, after this process has compiled for a given time.

    Loading compiled code from the cache does not count.
    """

    def __init__(self, tell: Callable[[], None], after_s: float) -> None:
        """Create a note.

        Args:
            tell: the function. It is called in another thread during the compilation.
            after_s: compile time after which it is called, seconds.
        """
        self._tell, self._left_s, self._told = tell, after_s, False
        self._depth, self._started_s = 0, 0.0
        self._timer: Timer | None = None

    def start(self) -> None:
        """Record that the compiler starts.

        Calls may be nested, for a loop that another loop calls.
        """
        self._depth += 1
        if self._depth == 1 and not self._told:
            self._started_s = time.perf_counter()
            self._timer = Timer(max(self._left_s, 0.0), self._finish)
            self._timer.daemon = True
            self._timer.start()

    def end(self) -> None:
        """Record that the compiler ends."""
        self._depth -= 1
        if self._depth == 0 and self._timer is not None:
            self._timer.cancel()
            self._timer = None
            self._left_s -= time.perf_counter() - self._started_s

    def _finish(self) -> None:
        self._told = True
        self._tell()


def note_compiling(tell: Callable[[], None], after_s: float = 1.0) -> None:
    """Call a function once, after this process, or one of the worker processes that it starts
    later, has compiled for some time.

    Args:
        tell: the function. It must be picklable by name, for worker processes.
        after_s: compile time after which it is called, seconds.
    """
    _wishes.append((tell, after_s))
    _asked.append(CompilingNote(tell, after_s))


def say_compiling() -> None:
    """Print on stderr that loops are being compiled."""
    sys.stderr.write("compiling (once per machine) ...\n")
    sys.stderr.flush()


def wishes() -> tuple[tuple[Callable[[], None], float], ...]:
    """Return the (function, time) pairs given to `note_compiling` in this process."""
    return tuple(_wishes)


def note_in_workers(wishes: tuple[tuple[Callable[[], None], float], ...], first: Semaphore) -> None:
    """Repeat the requests of the parent in a worker process.

    `first` is a semaphore by which only one worker calls the function.
    """
    for tell, after_s in wishes:

        def once(tell: Callable[[], None] = tell) -> None:
            if first.acquire(block=False):
                tell()

        note_compiling(once, after_s)


def connect() -> None:
    """Connect the requested notes with Numba, which must be imported."""
    from numba.core import event

    class Compiling(event.Listener):
        def __init__(self, note: CompilingNote) -> None:
            self._note = note

        def on_start(self, event: Any) -> None:
            self._note.start()

        def on_end(self, event: Any) -> None:
            self._note.end()

    while _asked:
        event.register("numba:compile", Compiling(_asked.pop()))  # type: ignore[no-untyped-call]
