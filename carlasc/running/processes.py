"""Calling one function with many items in parallel: in new processes, in an executor of the caller,
or on a Dask cluster.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Generator, Iterable, Iterator
from concurrent.futures import BrokenExecutor, Executor, Future
from contextlib import contextmanager
from dataclasses import replace
from itertools import chain, islice
from typing import TypeVar

from carlasc.core.first_use import is_first_use
from carlasc.errors import CarlascError
from carlasc.running.pools import LostTaskError, OwnProcesses
from carlasc.running.spreading import LazyClient, Run

Item = TypeVar("Item")
Result = TypeVar("Result")


def run_all(
    function: Callable[[Item], Result],
    items: Iterable[Item],
    run: Run = Run(),  # noqa: B008 (frozen)
    *,
    lost: Callable[[Item, str], Result] | None = None,
) -> Generator[Result, None, None]:
    """Yield `function(item)` for every item, in the order of the items.

    At most two items per worker (four on a cluster) are in progress at a time, so memory use does
    not grow with the number of items. The first time on a machine, the first item is done before
    the others start, so that loops are compiled once and not by all workers.

    Without an executor, the function runs in new processes with one thread each, or in this process
    if `workers` is 1. When the generator is closed or interrupted, these processes stop
    immediately, and each removes its unfinished file. They import the main module of the caller
    again: a script must guard its work with `if __name__ == "__main__":`.

    If a worker process dies, another one repeats its items, so the function may run more than once
    with an item. An item is given up after three worker processes died while working on it.

    Args:
        function: a top-level function; it and the items are pickled.
        items: the arguments of the calls, taken one by one. The iterable itself may call `run_all`
            with the same executor.
        run: number of processes, or the executor.
        lost: returns the result for an item that is given up, from the item and a message. With
            None, such an item is an error.

    Raises:
        CarlascError: an item is given up and `lost` is None, the worker processes of an executor of
            the caller died, or the connection to a cluster is lost.
    """
    workers = run.processes
    executor = run.executor
    waiting = iter(items)
    first = list(islice(waiting, 2))
    items = chain(first, waiting)
    is_one = len(first) < 2
    if not first:
        return
    if isinstance(executor, LazyClient):
        executor = executor.client
    if executor is None and workers > 1 and not is_one:
        with own_processes(workers) as pool:
            yield from _submit_all(pool, function, items, 2 * workers, lost)
    elif executor is None or (isinstance(executor, OwnProcesses) and is_one):
        yield from map(function, items)
    elif isinstance(executor, Executor):
        yield from _submit_all(
            executor, function, items, getattr(executor, "window", 2 * workers), lost
        )
    else:
        from carlasc.running.clients import run_on_cluster  # imports Dask

        yield from run_on_cluster(executor, function, items, lost)


def _submit_all(
    executor: Executor,
    function: Callable[[Item], Result],
    items: Iterable[Item],
    limit: int,
    lost: Callable[[Item, str], Result] | None,
) -> Iterator[Result]:
    pending: deque[tuple[Item, Future[Result]]] = deque()
    compiles = is_first_use(function)  # then the first item is done alone

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
            if compiles:
                pending[0][1].exception()  # waits for its end
                compiles = False
        while pending:
            yield take()
    except BrokenExecutor as error:
        raise CarlascError(
            "a worker process died",
            problem="it ran out of memory, was killed, or the script that started it has no `if "
            '__name__ == "__main__":`',
            advice="try fewer `workers` or a coarser grid",
        ) from error
    finally:
        for _, future in pending:
            future.cancel()


@contextmanager
def one_pool(run: Run) -> Iterator[Run]:
    """Yield a run with one executor for several calls of `run_all`, so that processes start only
    once.

    A run that already has an executor, or has one worker, is yielded unchanged.

    Args:
        run: number of processes, or the executor.
    """
    if run.executor is not None or run.is_alone:
        yield run
    else:
        with own_processes(run.processes) as pool:
            yield replace(run, executor=pool)


@contextmanager
def own_processes(workers: int) -> Iterator[Executor]:
    """Yield an executor whose processes end with the block, immediately if the block fails or is
    interrupted.
    """
    pool = OwnProcesses(workers)
    try:
        yield pool
    except BaseException:
        pool.stop()
        raise
    pool.shutdown()
