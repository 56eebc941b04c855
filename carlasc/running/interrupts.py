"""Ctrl-C, postponed where it would leave a thread that nobody ends."""

from __future__ import annotations

import os
import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType


@contextmanager
def postponed_interrupts() -> Iterator[None]:
    """Within the block, Ctrl-C waits for its end.

    For blocks that give work to an executor: a thread whose start is interrupted runs, but its executor does not know it, and the interpreter waits
    for it for ever when it ends. In other threads than the main one, which Ctrl-C does not reach, nothing changes.
    """
    handler = signal.getsignal(signal.SIGINT)
    if threading.current_thread() is not threading.main_thread() or handler is None:
        yield
        return
    caught: list[tuple[int, FrameType | None]] = []
    signal.signal(signal.SIGINT, lambda number, frame: caught.append((number, frame)))
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, handler)
        if caught and callable(handler):
            handler(*caught[0])
        elif caught:
            os.kill(os.getpid(), signal.SIGINT)
