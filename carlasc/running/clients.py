"""Calling one function with many items on the workers of a Dask cluster.

Workers first check versions and limit threads.
"""

from __future__ import annotations

import hashlib
import os
import pickle
import platform
import time
from collections import deque
from collections.abc import Callable, Generator, Iterable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, fields
from functools import cache
from importlib.metadata import version
from itertools import islice, takewhile
from pathlib import Path
from typing import Any, Self, TypeVar

from carlasc.core.first_use import is_first_use
from carlasc.errors import CarlascError, carlasc_version, import_extra
from carlasc.running.pools import ONE_THREAD, LostTaskError
from carlasc.running.spreading import DaskClient


@dataclass(frozen=True)
class Versions:
    """The versions of software on which results depend.

    Attributes:
        carlasc: version of the package, and a digest of its source, because rules can change
            between versions.
        python: version of Python, without the patch number.
        numpy: version of NumPy.
        numba: version of Numba.
    """

    carlasc: str
    python: str
    numpy: str
    numba: str

    @classmethod
    def here(cls) -> Self:
        """Return the versions of this process."""
        return cls(
            f"{carlasc_version()} (source {_digest_of_source()})",
            ".".join(platform.python_version_tuple()[:2]),
            version("numpy"),
            version("numba"),
        )

    def check(self, other: Versions, worker: str) -> None:
        """Check that a worker has these versions.

        Raises:
            CarlascError: the worker has other versions.
        """
        names = [
            field.name
            for field in fields(self)
            if getattr(self, field.name) != getattr(other, field.name)
        ]
        if names:
            raise CarlascError(
                f"worker {worker}",
                expected=" and ".join(f"{name} {getattr(self, name)}" for name in names),
                found=" and ".join(f"{name} {getattr(other, name)}" for name in names),
                advice="install the same versions on all workers, because results may depend on "
                "them",
            )


@cache
def _digest_of_source() -> str:
    root = Path(__file__).parents[1]
    digest = hashlib.sha256()
    for file in sorted(root.rglob("*.py")):
        digest.update(f"{file.relative_to(root).as_posix()}\0".encode() + file.read_bytes())
    return digest.hexdigest()[:8]


@dataclass(frozen=True)
class Session:
    """Common data of all tasks of a run.

    Attributes:
        name: unique name of the run.
        versions: versions of the process that started the run.
        folder: current folder of that process, for relative paths.
    """

    name: str
    versions: Versions
    folder: str

    @classmethod
    def of(cls, name: str) -> Self:
        """Return a new session of this process."""
        return cls(name, Versions.here(), str(Path.cwd()))


def run_task(session: Session, call: bytes) -> Any:
    """Call a function with an item, in a worker.

    Args:
        session: the run.
        call: the pickled function and item.

    Raises:
        CarlascError: the worker has other versions, or lacks a package.
    """
    _prepare(session)
    try:
        function, item = pickle.loads(call)
    except (ImportError, AttributeError) as error:
        raise CarlascError(
            f"worker {_name()}",
            problem=f"it cannot load the function or the item: {error}",
            advice="install the same packages on all workers",
        ) from error
    return function(item)


@cache
def _prepare(session: Session) -> None:
    """Check the versions of this process, and set it up for a run."""
    session.versions.check(Versions.here(), _name())
    for name in ONE_THREAD:  # libraries that are loaded later use one thread
        os.environ.setdefault(name, "1")
    with suppress(OSError):  # without this folder, a worker can still read absolute paths and URLs
        os.chdir(session.folder)


def _name() -> str:
    with suppress(ImportError, ValueError):  # a worker of Ray
        from distributed import get_worker

        return str(get_worker().address)
    return platform.node()


Item = TypeVar("Item")
Result = TypeVar("Result")

AHEAD = 4  # submitted tasks per thread of the workers
LEAST = 32  # minimum number of submitted tasks, so that one call can submit several
_TOGETHER = 16  # maximum number of results that are fetched together
_COUNT_S = 1.0  # workers are counted again after this time


def run_on_cluster(
    client: DaskClient,
    function: Callable[[Item], Result],
    items: Iterable[Item],
    lost: Callable[[Item, str], Result] | None,
) -> Generator[Result, None, None]:
    """Yield `function(item)` for every item, in the order of the items; see
    `carlasc.running.run_all`.

    A few tasks per worker are submitted at a time. The scheduler moves the tasks of a worker that
    died to other workers. A result stays on its worker until it is fetched; then the task is
    released.

    Raises:
        CarlascError: the connection to the scheduler is lost, a worker has other versions, or an
            item is given up and `lost` is None.
    """
    distributed = import_extra("distributed", "cluster")
    with one_line_if_lost(client):
        tasks = _Tasks(client, function, distributed)
        waiting = iter(items)
        try:
            if is_first_use(function):  # one worker compiles before the others start
                tasks.submit(list(islice(waiting, 1)))
                tasks.pending[0][1].exception()  # waits for its end
            tasks.submit(list(islice(waiting, tasks.window)))
            while tasks.pending:
                yield from tasks.take(lost)
                # several at once, because a call costs as much as a task
                if len(tasks.pending) <= tasks.window // 2:
                    tasks.submit(list(islice(waiting, tasks.window - len(tasks.pending))))
        finally:
            _release(tasks.pending)


class _Tasks:
    """The submitted tasks of a run, in the order of the items."""

    def __init__(
        self, client: DaskClient, function: Callable[[Any], Any], distributed: Any
    ) -> None:
        import cloudpickle

        self.pending: deque[tuple[Any, Any]] = deque()
        self._client = client
        self._function = function
        self._session = Session.of(client.id)
        self._dumps = cloudpickle.dumps
        self._killed = distributed.scheduler.KilledWorker
        self._threads = 1
        self._counted = -_COUNT_S

    @property
    def window(self) -> int:
        """Maximum number of submitted tasks. It grows when workers are added."""
        if time.monotonic() - self._counted > _COUNT_S:
            self._threads = sum(self._client.nthreads().values())
            self._counted = time.monotonic()
        return max(AHEAD * self._threads, LEAST)

    def submit(self, items: list[Any]) -> None:
        """Submit tasks for some items."""
        if items:
            calls = [self._dumps((self._function, item)) for item in items]
            name = os.urandom(8).hex()
            keys = [f"carlasc-{name}-{number}" for number in range(len(calls))]
            futures = self._client.map(run_task, [self._session] * len(calls), calls, key=keys)
            self.pending.extend(zip(items, futures, strict=True))

    def take(self, lost: Callable[[Any, str], Any] | None) -> Iterator[Any]:
        """Yield the result of the first task, and of the following tasks that are also done."""
        self.pending[0][1].exception()  # waits for its end
        done = list(
            takewhile(lambda entry: entry[1].status == "finished", islice(self.pending, _TOGETHER))
        )
        batch = [self.pending.popleft() for _ in range(max(len(done), 1))]
        try:
            yield from self._results(batch, lost, together=bool(done))
        finally:
            _release(batch)

    def _results(
        self,
        batch: list[tuple[Any, Any]],
        lost: Callable[[Any, str], Any] | None,
        *,
        together: bool,
    ) -> Iterator[Any]:
        if together:
            # the worker with the result died, and so did the worker that repeated the task
            with suppress(self._killed):
                yield from self._client.gather([future for _, future in batch])
                return
        for item, future in batch:
            try:
                result = future.result()
            except self._killed as error:
                if lost is None:
                    raise LostTaskError from error
                result = lost(item, str(LostTaskError()))
            yield result


def _release(tasks: Iterable[tuple[Any, Any]]) -> None:
    """Release tasks. The scheduler cancels tasks that are not done."""
    for _, future in tasks:
        future.release()


@contextmanager
def one_line_if_lost(client: DaskClient) -> Iterator[None]:
    """Raise a one-line CarlascError if the connection to the scheduler is lost in the block."""
    from distributed.client import CancelledError
    from distributed.comm import CommClosedError

    try:
        yield
    except CarlascError:
        raise
    except Exception as error:
        if client.status == "running" and not isinstance(error, CancelledError | CommClosedError):
            raise  # an error of the function, not of the connection
        raise CarlascError(
            f"the scheduler {getattr(getattr(client, 'scheduler', None), 'address', '')}".rstrip(),
            problem="the connection was lost",
            advice="check that the scheduler is running, and run the same command again to "
            "continue",
        ) from error
