"""Calling one function with many items in parallel: in processes of our own, in an executor of the caller, or on a Dask cluster."""

from __future__ import annotations

import os
from collections import deque
from collections.abc import Callable, Generator, Iterable, Iterator
from concurrent.futures import BrokenExecutor, Executor, Future
from contextlib import contextmanager
from itertools import chain, islice
from typing import TypeVar

from carlasc.errors import ArgumentError, CarlascError
from carlasc.running.engines import Engine
from carlasc.running.pools import LostTaskError, OwnProcesses

Item = TypeVar("Item")
Result = TypeVar("Result")


def run_all(
    function: Callable[[Item], Result],
    items: Iterable[Item],
    *,
    workers: int | None = None,
    executor: Engine | None = None,
    lost: Callable[[Item, str], Result] | None = None,
) -> Generator[Result, None, None]:
    """Yield `function(item)` for every item, in the order of the items.

    At most twice as many items as workers are in progress at a time (four times as many on a cluster), so that memory use does not grow
    with the number of items.
    Without an executor, the work is done in new processes with one thread each or, with one worker, in this process. When the
    generator is closed or interrupted, these processes stop at once, and each removes the file that it was writing. They import the
    caller's main module again: a script must guard its work with `if __name__ == "__main__":`.

    If a worker process dies, the items that it worked on are worked on again by another, so a function may run more than once with an
    item. An item that three worker processes died of is given up.

    Args:
        function: a top-level function; it and the items are pickled.
        items: the arguments of the calls. They are taken as work proceeds, and making one may call `run_all` with the same executor.
        workers: number of processes, all cores if None. With an executor: the number of its workers.
        executor: does the work instead; it is left open.
        lost: makes the result of an item that is given up, from the item and a message. Without it, such an item is an error.

    Raises:
        ArgumentError: `workers` is not positive.
        CarlascError: an item is given up and there is no `lost`, the worker processes of a caller's executor died, or the connection to
            a cluster is lost.
    """
    workers, waiting = count_workers(workers), iter(items)
    first = list(islice(waiting, 2))
    items, is_one = chain(first, waiting), len(first) < 2
    if not first:
        return
    if executor is None and workers > 1 and not is_one:
        with _own_processes(workers) as pool:
            yield from _submit_all(pool, function, items, 2 * workers, lost)
    elif executor is None or (isinstance(executor, OwnProcesses) and is_one):
        yield from map(function, items)
    elif isinstance(executor, Executor):
        yield from _submit_all(executor, function, items, 2 * workers, lost)
    else:
        from carlasc.running.clients import run_on_cluster  # Dask and what a worker of it needs

        yield from run_on_cluster(executor, function, items, lost)


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
    executor: Executor,
    function: Callable[[Item], Result],
    items: Iterable[Item],
    limit: int,
    lost: Callable[[Item, str], Result] | None,
) -> Iterator[Result]:
    pending: deque[tuple[Item, Future[Result]]] = deque()

    def take() -> Result:
        item, future = pending.popleft()
        try:
            return future.result()
        except LostTaskError as error:
            if lost is None:
                raise
            return lost(item, str(error))

    try:
        for item in items:
            if len(pending) == limit:
                yield take()
            pending.append((item, executor.submit(function, item)))
        while pending:
            yield take()
    except BrokenExecutor as error:
        raise CarlascError(
            "a worker process died",
            problem='it ran out of memory, was killed, or was started by a script without `if __name__ == "__main__":`',
            advice="try fewer `workers` or a coarser grid",
        ) from error
    finally:
        for _, future in pending:
            future.cancel()


@contextmanager
def one_pool(workers: int, executor: Engine | None) -> Iterator[Engine | None]:
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
    pool = OwnProcesses(workers)
    try:
        yield pool
    except BaseException:
        pool.stop()
        raise
    pool.shutdown()
