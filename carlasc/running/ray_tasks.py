"""A running Ray cluster as an executor: each call is a task of Ray."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from concurrent.futures import CancelledError, Executor, Future
from contextlib import contextmanager
from functools import partial
from typing import Any

from carlasc.errors import CarlascError, import_extra
from carlasc.running.clients import AHEAD, LEAST, Session, run_task
from carlasc.running.pools import DEATHS, LostTaskError


class RayExecutor(Executor):
    """Starts tasks on the workers of the Ray cluster to which this process is connected.

    Ray moves the tasks of a worker that died to other workers.
    """

    def __init__(self, ray: Any) -> None:
        self._ray = ray
        self._session = Session.of("ray")
        self._task = ray.remote(max_retries=DEATHS - 1)(run_task)

    @property
    def window(self) -> int:
        """Number of tasks that run or wait, so that a cluster that grows has work."""
        return max(AHEAD * int(self._ray.cluster_resources().get("CPU", 1)), LEAST)

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
        """Start a task."""
        call = self._ray.cloudpickle.dumps((partial(fn, **kwargs), *args))
        future = Future[Any]()
        task = self._task.remote(self._session, call)
        future.add_done_callback(lambda one: self._ray.cancel(task) if one.cancelled() else None)
        task.future().add_done_callback(partial(self._pass_on, future))
        return future

    def _pass_on(self, future: Future[Any], result: Future[Any]) -> None:
        errors = self._ray.exceptions
        if not future.set_running_or_notify_cancel():
            return
        try:
            value = result.result()
        except errors.RayTaskError as error:
            future.set_exception(error.cause)
        except (errors.WorkerCrashedError, errors.NodeDiedError, errors.OutOfMemoryError):
            future.set_exception(LostTaskError())
        except (errors.RayError, ConnectionError, CancelledError) as error:
            lost = CarlascError("the Ray cluster", problem=f"the connection was lost: {error}")
            future.set_exception(lost)
        else:
            future.set_result(value)


@contextmanager
def connected(where: str) -> Iterator[RayExecutor]:
    """Yield the executor of a running Ray cluster, whose tasks end with the block.

    Args:
        where: its address: "ray://HOST:10001".

    Raises:
        DependencyError: Ray is not installed.
        CarlascError: no cluster answers, or it has another version of Python or Ray.
    """
    ray = import_extra("ray", "ray")
    try:
        ray.init(where, log_to_driver=False, logging_level="CRITICAL")
    except (ConnectionError, RuntimeError) as error:
        raise CarlascError(
            f"cluster {where}",
            problem=f"no cluster answers: {error}",
            advice="check the address, and that `ray start --head` runs",
        ) from error
    try:
        yield RayExecutor(ray)
    finally:
        ray.shutdown()
