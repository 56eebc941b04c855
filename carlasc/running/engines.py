"""What does work in parallel. Nothing of Dask is loaded here, which commands on one machine need not wait for."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Executor
from functools import cached_property
from typing import Any, Protocol


class DaskClient(Protocol):
    """What is used of a `distributed.Client`."""

    id: str
    status: str

    def map(self, func: Any, *iterables: Any, **kwargs: Any) -> Any:
        """Start tasks."""

    def gather(self, futures: Any) -> Any:
        """Return the results of tasks."""

    def nthreads(self) -> Any:
        """Return the number of threads of each worker."""


class LazyClient:
    """A client that connects when it is first used: a cluster starts no jobs for a run that has nothing to do, or wrong arguments.

    Args:
        connect: returns the client.
    """

    def __init__(self, connect: Callable[[], DaskClient]) -> None:
        self._connect = connect

    @cached_property
    def client(self) -> DaskClient:
        """The client of Dask."""
        return self._connect()


Engine = Executor | DaskClient | LazyClient
"""What does work in parallel: any `concurrent.futures.Executor`, a `distributed.Client` of Dask, or what `open_cluster` yields."""
