"""Who is told that Numba compiles: on the first use on a machine, loops are compiled for seconds before anything is computed.

Importing this module loads nothing heavy, so that a program can ask before it knows whether anything will be compiled. `carlasc.core.compiling`,
from which compiled loops take their decorators, connects what was asked for with Numba.
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
_wishes: list[tuple[Callable[[], None], float]] = []  # what workers are given


class CompilingNote:
    """Calls a function once, as soon as this process has spent a given time compiling. Loading compiled code from the cache does not count."""

    def __init__(self, tell: Callable[[], None], after_s: float) -> None:
        """Prepare the note.

        Args:
            tell: the function. It is called in another thread, while the compiler works.
            after_s: time of compiling after which it is called, seconds.
        """
        self._tell, self._left_s, self._told = tell, after_s, False
        self._depth, self._started_s = 0, 0.0
        self._timer: Timer | None = None

    def start(self) -> None:
        """Take note that the compiler starts. To compile a loop, it may start again for a loop that this one calls."""
        self._depth += 1
        if self._depth == 1 and not self._told:
            self._started_s = time.perf_counter()
            self._timer = Timer(max(self._left_s, 0.0), self._finish)
            self._timer.daemon = True
            self._timer.start()

    def end(self) -> None:
        """Take note that the compiler ends."""
        self._depth -= 1
        if self._depth == 0 and self._timer is not None:
            self._timer.cancel()
            self._timer = None
            self._left_s -= time.perf_counter() - self._started_s

    def _finish(self) -> None:
        self._told = True
        self._tell()


def note_compiling(tell: Callable[[], None], after_s: float = 1.0) -> None:
    """Call a function once this process, or the first of the worker processes that it starts later, has compiled for some time.

    Args:
        tell: the function; workers find it by its name in its module.
        after_s: the time, seconds.
    """
    _wishes.append((tell, after_s))
    _asked.append(CompilingNote(tell, after_s))


def say_compiling() -> None:
    """Say on stderr that loops are compiled."""
    sys.stderr.write("compiling (once per machine) ...\n")
    sys.stderr.flush()


def wishes() -> tuple[tuple[Callable[[], None], float], ...]:
    """Return (function, time) of what `note_compiling` was asked in this process."""
    return tuple(_wishes)


def note_in_workers(wishes: tuple[tuple[Callable[[], None], float], ...], first: Semaphore) -> None:
    """Do in a worker process what its parent was asked; `first` lets one worker tell and no other."""
    for tell, after_s in wishes:

        def once(tell: Callable[[], None] = tell) -> None:
            if first.acquire(block=False):
                tell()

        note_compiling(once, after_s)


def connect() -> None:
    """Connect the notes that were asked for with Numba, which the caller has loaded."""
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
