"""A pool of processes of our own, which stop at once when they are told to, and which are replaced when they die."""

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

from carlasc.core.first_use import note_in_workers, wishes
from carlasc.errors import CarlascError

ONE_THREAD = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS")
"""Variables of the environment that set the number of threads of the libraries that compute."""

DEATHS = 3
"""A task whose worker process died so many times is not tried again."""

_TERMINATED = 128 + signal.SIGTERM
_GRACE_S = 3.0  # time given to a worker to remove the file that it was writing


class LostTaskError(CarlascError):
    """A task killed every worker process that tried it, or was there when they were killed."""

    def __init__(self, where: object = "a task") -> None:
        super().__init__(
            where,
            problem=f"{DEATHS} worker processes died while they did it: they ran out of memory, crashed, or were killed",
            advice="try fewer `workers` or a coarser grid",
        )


class OwnProcesses(Executor):
    """Processes that ignore Ctrl-C, use one thread each, and can be stopped in the middle of a task.

    Ctrl-C reaches all processes of a terminal; only the main process handles it, and stops the others. When a process dies, all are
    replaced, and the tasks that were lost run again, one at a time: so one that kills its process takes no other with it. A task that
    is lost three times raises LostTaskError.
    """

    def __init__(self, workers: int) -> None:
        self._workers, self._pool = workers, _ProcessGroup(workers)
        self._tasks: dict[int, _RetriedTask] = {}

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
        """Start a task. Its result is asked for in the thread that submits."""
        task = _RetriedTask(self, _Cleanly(fn), args, kwargs)
        if not task.start(self._pool):
            self.recover()
            task.start(self._pool)  # where a process dies again, the task is lost, and its result starts it again
        self._tasks[id(task)] = task
        return task

    def stop(self) -> None:
        """End the processes now; each is given time to remove the file that it was writing."""
        self._tasks.clear()
        self._pool.stop()

    def shutdown(self, wait: bool = True, *, cancel_futures: bool = False) -> None:
        """End the processes when they have done their tasks."""
        self._pool.shutdown(wait, cancel_futures=cancel_futures)

    def recover(self) -> None:
        """Do the tasks again that were lost when a process died, each alone in a process, and replace the processes.

        Raises:
            CarlascError: new processes die before they do anything.
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
        """Forget a task whose result was taken."""
        self._tasks.pop(id(task), None)

    def _renew(self, workers: int) -> None:
        """Replace the processes if one has died."""
        for _ in range(DEATHS):
            if self._is_alive():
                return
            self._pool.end()
            self._pool = _ProcessGroup(workers)
        if not self._is_alive():
            self._pool.end()  # what its processes say on stderr comes before the error, not after it
            raise CarlascError(
                "worker processes die as soon as they start",
                problem='there is no memory for them, or they are started by a script without `if __name__ == "__main__":`',
                advice="try fewer `workers`",
            )

    def _is_alive(self) -> bool:
        try:
            return self._pool.submit(int).exception() is None
        except BrokenProcessPool:
            return False


class _RetriedTask(Future[Any]):
    """A task that its pool may start several times."""

    def __init__(
        self, pool: OwnProcesses, function: Callable[..., Any], args: tuple[Any, ...], kwargs: dict[str, Any]
    ) -> None:
        super().__init__()
        self._owner, self._call, self._attempt = pool, (function, args, kwargs), Future[Any]()

    def start(self, pool: ProcessPoolExecutor) -> bool:
        """Start the task; return whether the processes were alive. If not, the task is lost."""
        function, args, kwargs = self._call
        try:
            self._attempt = pool.submit(function, *args, **kwargs)
        except BrokenProcessPool as error:
            self._attempt = Future()
            self._attempt.set_exception(error)
            return False
        return True

    def was_lost(self) -> bool:
        """Return whether the process died; waits for the end of the task."""
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

    def cancel(self) -> bool:
        self._owner.forget(self)
        return self._attempt.cancel()


class _NotingContext(SpawnContext):
    """How a pool starts its processes; notes them, because a pool does not tell which they are before Python 3.14."""

    def __init__(self) -> None:
        super().__init__()
        self.started: list[SpawnProcess] = []

    def Process(self, *args: Any, **kwargs: Any) -> SpawnProcess:  # type: ignore[override]
        process = SpawnProcess(*args, **kwargs)
        self.started.append(process)
        return process


class _ProcessGroup(ProcessPoolExecutor):
    """The processes of a moment: when one dies, the others end too."""

    def __init__(self, workers: int) -> None:
        self._context = _NotingContext()
        super().__init__(
            workers,
            mp_context=self._context,
            initializer=_prepare_worker,
            initargs=(self._context.Semaphore(), wishes()),
        )

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
        try:
            with inherited_by_workers():  # a pool starts its processes when tasks are submitted
                return super().submit(fn, *args, **kwargs)
        except OSError as error:  # a process died while another was started, and the pool has closed the queue for it
            raise BrokenProcessPool(f"a process cannot be started: {error}") from error

    def end(self) -> None:
        """End processes that have nothing to do, or of which one has died.

        A pool that breaks tells its processes to end and waits for them, but does not tell one that was started at that moment, which
        waits for a task for ever: it is killed here.
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
    """Within the block, block Ctrl-C and limit libraries to one thread: processes that are started in it inherit both."""
    before = {name: os.environ.get(name) for name in ONE_THREAD}
    mask = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    os.environ.update(dict.fromkeys(ONE_THREAD, "1"))
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                os.environ.pop(name, None)
            else:
                os.environ[name] = value
        signal.pthread_sigmask(signal.SIG_SETMASK, mask)


def _prepare_worker(first: Semaphore, wishes: tuple[tuple[Callable[[], None], float], ...]) -> None:
    note_in_workers(wishes, first)
    signal.signal(signal.SIGTERM, _exit_worker)
    threading.Thread(target=_end_with_parent, daemon=True).start()


def _end_with_parent() -> None:
    """End this worker soon after the main process, which cannot tell its workers to stop when it is killed itself.

    Without this they would wait for tasks for ever: each of them keeps the queue of tasks open.
    """
    parent = parent_process()
    if parent is None:
        return
    parent.join()
    os.kill(os.getpid(), signal.SIGTERM)  # the task removes the file that it is writing
    time.sleep(_GRACE_S)
    os._exit(_TERMINATED)


def _exit_worker(*_: object) -> None:
    if not _Cleanly.is_working:
        # At once: an exception in the middle of reading a task would leave its rest to the next worker, who takes it for a task.
        os._exit(_TERMINATED)
    raise SystemExit(_TERMINATED)


class _Cleanly:
    """A function whose process ends on SIGTERM once the function has cleaned up, instead of taking the next task."""

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
