"""Runs a command and sends its whole process group a signal after so many frames: `python
interrupted.py SIGNAL FRAMES COMMAND ARGS...`

A terminal does the same when somebody presses Ctrl-C: every process of the group gets SIGINT.
"""

from __future__ import annotations

import os
import signal
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from carlasc.cli import flags, main


@contextmanager
def interrupting_bar(
    description: str, unit: str = "frames"
) -> Iterator[Callable[[int, int], None]]:
    def interrupt(done: int, total: int) -> None:
        if done >= frames:
            os.killpg(os.getpgrp(), number)

    yield interrupt


if __name__ == "__main__":
    signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell's background job ignores it
    number, frames = signal.Signals[sys.argv.pop(1)], int(sys.argv.pop(1))
    flags.progress_bar = interrupting_bar  # type: ignore[assignment]
    main()
