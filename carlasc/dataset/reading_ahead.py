"""Fetching the files of the next samples into the cache of a remote store, while earlier samples are trained on."""

from __future__ import annotations

import threading
import time
from collections import deque
from contextlib import suppress
from types import TracebackType
from typing import Self

import numpy as np
from numpy.typing import NDArray

from carlasc.dataset.samples import Dataset
from carlasc.errors import CarlascError
from carlasc.storage.transport.caching import CachedTree

_THREADS = 3  # files that are fetched side by side, each in several ranges
_STOP_S = (
    5.0  # how long the end of an iteration waits for files being fetched: a server that is lost is asked for minutes
)


class ReadAhead:
    """Threads that fetch the files of shards, in the order of their first samples, inside a `with` block.

    They start with the first sample that is drawn: a loader forks its workers before that. Data that were opened without a cache need
    no thread.
    """

    def __init__(
        self, dataset: Dataset, order: NDArray[np.int64], shards: NDArray[np.int64], start: int, count: int
    ) -> None:
        """Find which shards are needed, and from when.

        Args:
            dataset: the samples.
            order: (N,) indices of the samples in the order in which they are drawn.
            shards: (N,) number of the shard of each sample, by the sample's index.
            start: the position in `order` that is drawn first.
            count: number of shards that are fetched before their first sample is drawn.
        """
        self._dataset = dataset
        self._shards = shards
        self._count = count
        self._drawn = start
        self._waiting: deque[tuple[CachedTree, str]] = deque()
        self._changed = threading.Condition()
        self._stopped = False
        self._threads: list[threading.Thread] = []
        if count and dataset.is_cached:
            numbers, firsts = np.unique(shards[order], return_index=True)
            left = np.isin(numbers, shards[order[start:]])
            by_first = np.argsort(firsts[left], kind="stable")
            self._next_shards = deque(numbers[left][by_first].tolist())
            self._firsts = firsts[left][by_first]
        else:
            self._next_shards, self._firsts = deque(), np.empty(0, np.int64)

    def draw(self, position: int) -> None:
        """Say how many samples of the order were drawn."""
        if not len(self._firsts):
            return
        with self._changed:
            self._drawn = position
            self._changed.notify_all()
        if not self._threads:
            self._threads = [
                threading.Thread(target=self._run, name="carlasc-read-ahead", daemon=True) for _ in range(_THREADS)
            ]
            for thread in self._threads:
                thread.start()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        with self._changed:
            self._stopped = True
            self._changed.notify_all()
        end = time.monotonic() + _STOP_S
        for thread in self._threads:
            if thread is not threading.current_thread():  # a thread that collects garbage may close an iterator
                thread.join(max(0.0, end - time.monotonic()))

    def _run(self) -> None:
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._stopped or self._waiting or self._may_begin_shard())
                if self._stopped:
                    return
                file = self._waiting.popleft() if self._waiting else None
                shard = self._next_shards.popleft() if file is None else -1
            with suppress(CarlascError):  # whoever needs the file meets the error again, and reports it
                if file is not None:
                    tree, path = file
                    tree.fetch(path, wait=False)
                    continue
                found = self._dataset.cached_files(np.flatnonzero(self._shards == shard).tolist())
                with self._changed:
                    self._waiting.extend(found)
                    self._changed.notify_all()

    def _may_begin_shard(self) -> bool:
        """Whether the next shard is among the first `count` ones whose samples are not drawn yet."""
        begun = len(self._firsts) - len(self._next_shards)
        open_shards = int(np.searchsorted(self._firsts, self._drawn, "right"))
        return bool(self._next_shards) and begun < open_shards + self._count
