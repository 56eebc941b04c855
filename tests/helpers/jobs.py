"""Functions that a worker process can import: work for the tests of `carlasc.running.processes`."""

from __future__ import annotations

import os
import signal
import time
from pathlib import Path

from carlasc.storage.files import write_atomic


def square(number: int) -> int:
    return number * number


def name_of_process(_: object) -> int:
    time.sleep(0.05)
    return os.getpid()


def fail_at_three(number: int) -> int:
    if number == 3:
        raise ValueError("three")
    return number


def raise_error(error: Exception) -> None:
    raise error


def environment(name: str) -> str | None:
    return os.environ.get(name)


def ignores_interrupt(_: object) -> bool:
    os.kill(os.getpid(), signal.SIGINT)
    return True


def kill_itself(_: object) -> None:
    os.kill(os.getpid(), signal.SIGKILL)


def write_for_a_minute(path: Path) -> None:
    """Write a file that takes long; a mark beside it says that it has begun."""

    def write_slowly(file: object) -> None:
        path.with_suffix(".begun").touch()
        time.sleep(60)

    if path.suffix:
        write_atomic(path, write_slowly)
