"""One function over many things, side by side: in processes of its own, or in any `concurrent.futures.Executor`."""

from __future__ import annotations

import os
import signal
import sys
from collections import deque
from collections.abc import Callable, Generator, Iterator, Sequence
from concurrent.futures import BrokenExecutor, Executor, Future, ProcessPoolExecutor
from contextlib import contextmanager
from multiprocessing import get_context
from typing import Any, TypeVar

from carlasc.errors import ArgumentError, CarlascError

Item = TypeVar("Item")
Result = TypeVar("Result")

_TERMINATED = 128 + signal.SIGTERM
_ONE_THREAD = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS")
_GRACE_S = 3.0  # how long a worker may take to remove its half-written file


def run_all(
    function: Callable[[Item], Result],
    items: Sequence[Item],
    *,
    workers: int | None = None,
    executor: Executor | None = None,
) -> Generator[Result, None, None]:
    """Yield `function(item)` of every item, in the items' order; only so many are under way that memory stays flat.

    Without an executor the work is done in processes of its own, each with one thread, or, for one worker, here. When the
    generator is closed or interrupted those stop at once, and each removes the file it was writing. Processes import the
    caller's main module again: a script must guard its work with `if __name__ == "__main__":`.

    Args:
        function: a top-level function; it and the items are pickled.
        items: what to do.
        workers: how many work side by side, all cores if None. With an executor: how many its workers are.
        executor: does the work instead; it is left open.

    Raises:
        ArgumentError: no positive number of workers.
        CarlascError: a worker died.
    """
    workers = count_workers(workers)
    if executor is not None:
        yield from _submit_all(executor, function, items, 2 * workers)
    elif min(workers, len(items)) <= 1:
        yield from map(function, items)
    else:
        with _own_processes(min(workers, len(items))) as pool:
            yield from _submit_all(pool, _Task(function), items, 2 * workers)


def count_workers(workers: int | None) -> int:
    """Return the number of workers that is asked for: as many as this process may use cores if None.

    Raises:
        ArgumentError: no positive number.
    """
    if workers is None:
        if sys.platform == "linux":
            return len(os.sched_getaffinity(0))
        return os.cpu_count() or 1
    if workers < 1:
        raise ArgumentError("workers", expected="at least 1", found=f"{workers}")
    return workers


def _submit_all(
    executor: Executor, function: Callable[[Item], Result], items: Sequence[Item], limit: int
) -> Iterator[Result]:
    pending: deque[Future[Result]] = deque()
    try:
        for item in items:
            if len(pending) == limit:
                yield pending.popleft().result()
            pending.append(executor.submit(function, item))
        while pending:
            yield pending.popleft().result()
    except BrokenExecutor as error:
        raise CarlascError(
            "a worker process died: out of memory (try fewer workers or a coarser grid), killed from outside, or started from a script without"
            ' `if __name__ == "__main__":`'
        ) from error
    finally:
        for future in pending:
            future.cancel()


@contextmanager
def _own_processes(workers: int) -> Iterator[Executor]:
    """Processes that end with the block: at once where it fails or is interrupted."""
    pool = _Processes(workers, mp_context=get_context("spawn"), initializer=_prepare_worker)
    try:
        yield pool
    except BaseException:
        pool.stop()
        raise
    pool.shutdown()


class _Processes(ProcessPoolExecutor):
    """A pool whose processes are born deaf to Ctrl-C, with one thread each, and can be stopped in the middle of a task."""

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
        with _birth():  # a pool starts its processes as tasks come in
            return super().submit(fn, *args, **kwargs)

    def stop(self) -> None:
        """End the processes now. Each may remove the file that it was writing."""
        processes = list((self._processes or {}).values())
        self.shutdown(wait=False, cancel_futures=True)
        for process in processes:
            process.terminate()
        for process in processes:
            process.join(_GRACE_S)
            if process.is_alive():
                process.kill()


@contextmanager
def _birth() -> Iterator[None]:
    """What a process inherits that is started in the block: Ctrl-C blocked, libraries with one thread."""
    before = {name: os.environ.get(name) for name in _ONE_THREAD}
    mask = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    os.environ.update(dict.fromkeys(_ONE_THREAD, "1"))
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                os.environ.pop(name, None)
            else:
                os.environ[name] = value
        signal.pthread_sigmask(signal.SIG_SETMASK, mask)


def _prepare_worker() -> None:
    signal.signal(signal.SIGTERM, _leave)


def _leave(*_: object) -> None:
    raise SystemExit(_TERMINATED)


class _Task:
    """A function that, asked to leave, cleans up after itself and ends the process instead of taking the next task."""

    def __init__(self, function: Callable[[Any], Any]) -> None:
        self.function = function

    def __call__(self, item: Any) -> Any:
        try:
            return self.function(item)
        except SystemExit:
            os._exit(_TERMINATED)
