"""A pool of worker processes that can be stopped at once, and that are replaced when they die."""

from __future__ import annotations

import os
import signal
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import Executor, Future, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager, suppress
from multiprocessing import parent_process
from multiprocessing.context import SpawnContext, SpawnProcess
from multiprocessing.synchronize import Semaphore
from typing import Any

from carlasc.core.first_use import NoteRequest, note_in_workers, note_requests
from carlasc.errors import CarlascError

ONE_THREAD = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS")
"""Environment variables for the number of threads of numerical libraries."""

DEATHS = 3
"""Number of deaths of worker processes after which a task is not tried again."""

_TERMINATED = 128 + signal.SIGTERM
_GRACE_S = 10.0  # for a worker to remove its unfinished files, after the disk has synced them


class LostTaskError(CarlascError):
    """A task is given up, because several worker processes died while running it."""

    def __init__(self, where: object = "a task") -> None:
        super().__init__(
            where,
            problem=f"{DEATHS} worker processes died while running it: they ran out of memory, "
            f"crashed, or were killed",
            advice="try fewer `workers` or a coarser grid",
        )


class OwnProcesses(Executor):
    """An executor of processes that ignore Ctrl-C, use one thread each, and can be stopped during a
    task.

    Ctrl-C reaches all processes of a terminal. Only the main process handles it, and stops the
    others. When a process dies, all are replaced, and the lost tasks run again, one at a time, so
    that a task that kills its process affects no other task. A task that is lost three times raises
    LostTaskError.
    """

    def __init__(self, workers: int) -> None:
        self._workers = workers
        self._pool = _ProcessGroup(workers)
        self._tasks: dict[int, _RetriedTask] = {}

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
        """Start a task. Its result must be requested in the same thread."""
        task = _RetriedTask(self, _Cleanly(fn), args, kwargs)
        if not task.start(self._pool):
            self.recover()
            # if a process has died again, the task is lost, and `result` starts it again
            task.start(self._pool)
        self._tasks[id(task)] = task
        return task

    def stop(self) -> None:
        """Stop the processes now. Each has some time to remove its unfinished file."""
        self._tasks.clear()
        self._pool.stop()

    def shutdown(self, wait: bool = True, *, cancel_futures: bool = False) -> None:
        """End the processes after their tasks."""
        self._pool.shutdown(wait, cancel_futures=cancel_futures)

    def recover(self) -> None:
        """Replace the processes after one died, and run the lost tasks again, each alone in a
        process.

        Raises:
            CarlascError: new processes die before they run a task.
        """
        self._pool.end()
        self._pool = _ProcessGroup(1)
        for task in [task for task in self._tasks.values() if task.was_lost()]:
            for _ in range(DEATHS - 1):
                self._renew(1)
                task.start(self._pool)
                if not task.was_lost():
                    break
        self._pool.end()
        self._pool = _ProcessGroup(self._workers)
        self._renew(self._workers)

    def forget(self, task: _RetriedTask) -> None:
        """Discard a task whose result was returned."""
        self._tasks.pop(id(task), None)

    def _renew(self, workers: int) -> None:
        """Replace the processes if one has died."""
        for _ in range(DEATHS):
            if self._is_alive():
                return
            self._pool.end()
            self._pool = _ProcessGroup(workers)
        if not self._is_alive():
            self._pool.end()  # so that messages of its processes on stderr come before the error
            raise CarlascError(
                "worker processes die as soon as they start",
                problem="the memory is full, or the script that starts them has no `if __name__ "
                '== "__main__":`',
                advice="try fewer `workers`, or add the guard to the script",
            )

    def _is_alive(self) -> bool:
        try:
            return self._pool.submit(int).exception() is None
        except BrokenProcessPool:
            return False


class _RetriedTask(Future[Any]):
    """A task that its pool may start several times."""

    def __init__(
        self,
        pool: OwnProcesses,
        function: Callable[..., Any],
        args: tuple[Any, ...],
        kwargs: dict[str, Any],
    ) -> None:
        super().__init__()
        self._owner = pool
        self._call = (function, args, kwargs)
        self._attempt = Future[Any]()

    def start(self, pool: ProcessPoolExecutor) -> bool:
        """Start the task, and return whether the processes were alive. If not, the task is lost."""
        function, args, kwargs = self._call
        try:
            self._attempt = pool.submit(function, *args, **kwargs)
        except BrokenProcessPool as error:
            self._attempt = Future()
            self._attempt.set_exception(error)
            return False
        return True

    def was_lost(self) -> bool:
        """Wait for the end of the task, and return whether its process died."""
        return isinstance(self._attempt.exception(), BrokenProcessPool)

    def result(self, timeout: float | None = None) -> Any:
        try:
            return self._attempt.result(timeout)
        except BrokenProcessPool:
            self._owner.recover()
        finally:
            self._owner.forget(self)
        try:
            return self._attempt.result(timeout)
        except BrokenProcessPool as error:
            raise LostTaskError from error

    def exception(self, timeout: float | None = None) -> BaseException | None:
        return self._attempt.exception(timeout)

    def done(self) -> bool:
        return self._attempt.done()

    def cancel(self) -> bool:
        self._owner.forget(self)
        return self._attempt.cancel()


class _NotingContext(SpawnContext):
    """A context that records the processes that a pool starts, because pools do not list them
    before Python 3.14.
    """

    def __init__(self) -> None:
        super().__init__()
        self.started: list[SpawnProcess] = []

    def Process(self, *args: Any, **kwargs: Any) -> SpawnProcess:  # type: ignore[override]
        process = SpawnProcess(*args, **kwargs)
        self.started.append(process)
        return process


class _ProcessGroup(ProcessPoolExecutor):
    """One generation of processes. When one dies, the others end too."""

    def __init__(self, workers: int) -> None:
        self._context = _NotingContext()
        super().__init__(
            workers,
            mp_context=self._context,
            initializer=_prepare_worker,
            initargs=(self._context.Semaphore(), note_requests),
        )

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
        try:
            with inherited_by_workers():  # pools start processes when tasks are submitted
                return super().submit(fn, *args, **kwargs)
        except (
            OSError
        ) as error:  # a process died while another was starting, and the pool has closed its queue
            raise BrokenProcessPool(f"a process cannot be started: {error}") from error

    def end(self) -> None:
        """End processes that are idle, or of which one has died.

        A broken pool ends its processes and waits for them. It misses a process that was starting
        at that moment, which would then hang; this method kills it.
        """
        self.shutdown(wait=False)
        for process in self._context.started:
            with suppress(AssertionError):  # it was never started
                process.join(_GRACE_S)
            if process.is_alive():
                process.kill()
        self.shutdown()

    def stop(self) -> None:
        processes = [process for process in self._context.started if process.is_alive()]
        self.shutdown(wait=False, cancel_futures=True)
        for process in processes:
            process.terminate()
        for process in processes:
            process.join(_GRACE_S)
            if process.is_alive():
                process.kill()


@contextmanager
def inherited_by_workers() -> Iterator[None]:
    """Block Ctrl-C and limit libraries to one thread within the block.

    Processes that are started in it inherit both.
    """
    before = {name: os.environ.get(name) for name in ONE_THREAD}
    set_mask = getattr(signal, "pthread_sigmask", None)  # POSIX only
    mask = set_mask and set_mask(signal.SIG_BLOCK, {signal.SIGINT})
    os.environ.update(dict.fromkeys(ONE_THREAD, "1"))
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                os.environ.pop(name, None)
            else:
                os.environ[name] = value
        if set_mask:
            set_mask(signal.SIG_SETMASK, mask)


def _prepare_worker(first: Semaphore, requests: list[NoteRequest]) -> None:
    note_in_workers(requests, first)
    signal.signal(signal.SIGTERM, _exit_worker)
    threading.Thread(target=_end_with_parent, daemon=True).start()


def _end_with_parent() -> None:
    """End this worker soon after the main process has ended.

    A killed main process cannot stop its workers.

    Without this, workers would hang, because each of them keeps the queue of tasks open.
    """
    parent = parent_process()
    if parent is None:
        return
    parent.join()
    os.kill(os.getpid(), signal.SIGTERM)  # the task removes its unfinished file
    time.sleep(_GRACE_S)
    os._exit(_TERMINATED)


def _exit_worker(*_: object) -> None:
    if not _Cleanly.is_working:
        # Exit immediately: after an exception while reading a task, the next worker would read the
        # rest of it as a task.
        os._exit(_TERMINATED)
    raise SystemExit(_TERMINATED)


class _Cleanly:
    """Wraps a function.

    On SIGTERM, the function cleans up and its process ends instead of taking the next task.
    """

    is_working = False

    def __init__(self, function: Callable[..., Any]) -> None:
        self.function = function

    def __call__(self, *args: Any, **kwargs: Any) -> Any:
        try:
            _Cleanly.is_working = True
            return self.function(*args, **kwargs)
        except SystemExit:
            os._exit(_TERMINATED)
        finally:
            _Cleanly.is_working = False
