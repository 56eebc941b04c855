"""Calling one function with many items in parallel: in processes of our own, or in any `concurrent.futures.Executor`."""

from __future__ import annotations

import os
import signal
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
_GRACE_S = 3.0  # time given to a worker to remove the file that it was writing


def run_all(
    function: Callable[[Item], Result],
    items: Sequence[Item],
    *,
    workers: int | None = None,
    executor: Executor | None = None,
) -> Generator[Result, None, None]:
    """Yield `function(item)` for every item, in the order of the items.

    At most twice as many items as workers are in progress at a time, so that memory use does not grow with the number of items.
    Without an executor, the work is done in new processes with one thread each or, with one worker, in this process. When the
    generator is closed or interrupted, these processes stop at once, and each removes the file that it was writing. They import the
    caller's main module again: a script must guard its work with `if __name__ == "__main__":`.

    Args:
        function: a top-level function; it and the items are pickled.
        items: the arguments of the calls.
        workers: number of processes, all cores if None. With an executor: the number of its workers.
        executor: does the work instead; it is left open.

    Raises:
        ArgumentError: `workers` is not positive.
        CarlascError: a worker process died.
    """
    workers = count_workers(workers)
    if isinstance(executor, _Processes):
        yield from (
            _submit_all(executor, _Task(function), items, 2 * workers) if len(items) > 1 else map(function, items)
        )
    elif executor is not None:
        yield from _submit_all(executor, function, items, 2 * workers)
    elif min(workers, len(items)) <= 1:
        yield from map(function, items)
    else:
        with _own_processes(min(workers, len(items))) as pool:
            yield from _submit_all(pool, _Task(function), items, 2 * workers)


def count_workers(workers: int | None) -> int:
    """Return `workers`, or the number of cores that this process may use if it is None.

    Raises:
        ArgumentError: `workers` is not positive.
    """
    if workers is None:
        cores_of = getattr(os, "sched_getaffinity", None)  # macOS does not say which cores a process may use
        return len(cores_of(0)) if cores_of else os.cpu_count() or 1
    if workers < 1:
        raise ArgumentError("workers", expected="at least 1", found=str(workers))
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
            "a worker process died",
            problem='it ran out of memory, was killed, or was started by a script without `if __name__ == "__main__":`',
            advice="try fewer `workers` or a coarser grid",
        ) from error
    finally:
        for future in pending:
            future.cancel()


@contextmanager
def one_pool(workers: int, executor: Executor | None) -> Iterator[Executor | None]:
    """Yield an executor for several calls of `run_all`, so that its processes start only once.

    It is `executor` if that is given, and None, which `run_all` takes for work in this process, with one worker.

    Args:
        workers: number of processes.
        executor: does the work instead; it is left open.
    """
    if executor is not None or workers <= 1:
        yield executor
    else:
        with _own_processes(workers) as pool:
            yield pool


@contextmanager
def _own_processes(workers: int) -> Iterator[Executor]:
    """Yield an executor whose processes end with the block, at once if the block fails or is interrupted."""
    pool = _Processes(workers, mp_context=get_context("spawn"), initializer=_prepare_worker)
    try:
        yield pool
    except BaseException:
        pool.stop()
        raise
    pool.shutdown()


class _Processes(ProcessPoolExecutor):
    """A pool whose processes ignore Ctrl-C, use one thread each, and can be stopped in the middle of a task.

    Ctrl-C reaches all processes of a terminal; only the main process handles it, and stops the others.
    """

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
        with _inherited_by_workers():  # a pool starts its processes when tasks are submitted
            return super().submit(fn, *args, **kwargs)

    def stop(self) -> None:
        """End the processes now; each is given time to remove the file that it was writing."""
        processes = list((self._processes or {}).values())
        self.shutdown(wait=False, cancel_futures=True)
        for process in processes:
            process.terminate()
        for process in processes:
            process.join(_GRACE_S)
            if process.is_alive():
                process.kill()


@contextmanager
def _inherited_by_workers() -> Iterator[None]:
    """Within the block, block Ctrl-C and limit libraries to one thread: processes that are started in it inherit both."""
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
    signal.signal(signal.SIGTERM, _exit_worker)


def _exit_worker(*_: object) -> None:
    raise SystemExit(_TERMINATED)


class _Task:
    """A function whose process ends on SIGTERM once the function has cleaned up, instead of taking the next task."""

    def __init__(self, function: Callable[[Any], Any]) -> None:
        self.function = function

    def __call__(self, item: Any) -> Any:
        try:
            return self.function(item)
        except SystemExit:
            os._exit(_TERMINATED)
