"""Functions that a worker process can import: work for the tests of `carlasc.running.processes`."""

from __future__ import annotations

import os
import signal
import time
from collections.abc import Callable
from pathlib import Path

from carlasc import Run
from carlasc.running.processes import run_all
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
        write_atomic(path.with_suffix(".begun"), str(os.getpid()).encode())
        time.sleep(60)

    if path.suffix:
        write_atomic(path, write_slowly)


def write_on_a_slow_disk(path: Path) -> None:
    """Write a file whose last bytes take four seconds, in which the system holds signals back."""

    def sync_slowly(file: object) -> None:
        signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGTERM})
        write_atomic(path.with_suffix(".begun"), str(os.getpid()).encode())
        time.sleep(4)
        signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGTERM})
        time.sleep(60)

    if path.suffix:
        write_atomic(path, sync_slowly)


def write_in_two_workers(paths: list[Path]) -> None:
    list(run_all(write_for_a_minute, paths, run=Run(workers=2)))


def kill_itself_at_three(number: int) -> int:
    if number == 3:
        os.kill(os.getpid(), signal.SIGKILL)
    return number


def die_once(mark: Path) -> str:
    """Kill the process that comes here first."""
    try:
        mark.touch(exist_ok=False)
    except FileExistsError:
        return mark.name
    os.kill(os.getpid(), signal.SIGKILL)
    return ""


def name_of_process_soon(_: object) -> int:
    time.sleep(0.005)
    return os.getpid()


def wait_until(condition: Callable[[], bool], seconds: float = 10) -> None:
    """Wait until a condition holds; for tests, in the main process."""
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, "it did not happen in time"
        time.sleep(0.01)


def write_own_number(path: Path) -> int:
    """Write the number that a file is named after into it, slowly enough to be killed."""
    time.sleep(0.005)
    write_atomic(path, path.name.encode())
    return int(path.name)


def compile_something(_: object) -> tuple[int, int]:
    """Return this process, and how often it compiled a function that it did not find in the cache."""
    from helpers.processes.compiled import add_one

    assert add_one(1) == 2
    time.sleep(0.1)
    return os.getpid(), sum(add_one.stats.cache_misses.values())
