"""The order of samples in training: shards in random order, and frames shuffled within a window of
shards.

Frames that are stored together are read at about the same time, so that each file of an object
store is fetched once. Threads fetch the files of the next samples into the cache of a remote store
during training.
"""

from __future__ import annotations

import math
import sys
import threading
import time
import zlib
from collections import deque
from collections.abc import Iterator, Mapping
from contextlib import suppress
from typing import TYPE_CHECKING, Any, Self

import numpy as np

from carlasc.core.arrays import IntArray
from carlasc.dataset.samples import Dataset
from carlasc.dataset.torch_bases import NoBase, inherit
from carlasc.errors import ArgumentError, CarlascError, check_types
from carlasc.storage.transport.caching import CachedTree

_STORED_TOGETHER = 16  # frames per file of packed zarr stores
# minimum length of a shard, relative to the additional frames that are read for histories
_READ_AGAIN = 4

if TYPE_CHECKING:
    from torch.utils.data import Sampler as TorchSampler

    _Sampler = TorchSampler[int]
else:
    _Sampler = NoBase  # until torch is imported


class ShardSampler(_Sampler):
    """Yields the indices of the samples of a Dataset in random order, as the `sampler` of a torch
    DataLoader.

    A shard is a run of consecutive frames of one sequence. Shards are shuffled, and each frame
    moves to a random position within the next `window` shards, so that frames of at most `window`
    shards are mixed at any time. The order depends only on the data, the seed, the epoch, `shard`
    and `window`, not on the number of processes or of workers of a loader.

    Process r of n takes every n-th sample, beginning with the r-th: with batches of B / n samples
    per process, step s uses the same B samples for every n. If n does not divide the number of
    samples, the first samples are repeated, so that all processes make the same number of steps (as
    with the DistributedSampler of torch).

    If the data are opened with a cache (`carlasc.open(url, cache=folder)`), threads fetch the files
    of the next shards into it during an epoch. They end with the iteration.

        source = carlasc.open("s3://bucket/carlasc.zarr", cache="/scratch/cache")
        dataset = Dataset(source, "train", history=16)
        sampler = ShardSampler(dataset, seed=0)
        loader = torch.utils.data.DataLoader(dataset, batch_size=4, sampler=sampler, num_workers=2)
        for epoch in range(epochs):
            sampler.set_epoch(epoch)
            for batch in loader: ...

    Attributes:
        seed: seed of the order.
        epoch: the current or next epoch.
        shard: number of frames per shard.
        window: number of shards whose frames are mixed.
        num_replicas: number of processes.
        rank: number of this process.
    """

    def __init__(
        self,
        dataset: Dataset,
        *,
        seed: int = 0,
        shard: int | None = None,
        window: int = 8,
        num_replicas: int | None = None,
        rank: int | None = None,
        read_ahead: int = 2,
    ) -> None:
        """Number the shards. No data are read.

        Args:
            dataset: the samples. To sample a part of them, give a Dataset of this part.
            seed: seed of the order, 0 or more.
            shard: number of frames per shard, a multiple of 16 if files of a store have 16 frames.
                None takes 16 for samples with one scan, otherwise 64 or more, because each shard
                also needs earlier frames for the histories of its first samples.
            window: number of shards whose frames are mixed. A larger window mixes better, and needs
                a larger cache.
            num_replicas: number of processes that train together. None: those of the process group
                of torch.distributed, or 1 without one.
            rank: number of this process, from 0. None: that in the process group.
            read_ahead: number of shards that are fetched in advance; 0 turns this off.

        Raises:
            ArgumentError: an argument is not valid.
        """
        if not isinstance(dataset, Dataset):
            raise ArgumentError(
                "dataset",
                expected="a carlasc.Dataset",
                found=repr(dataset),
                advice="for a part of one, give a slice: dataset[:100]",
            )
        check_types(ShardSampler.__init__, locals())
        group = sys.modules.get("torch.distributed")
        group = group if group and group.is_available() and group.is_initialized() else None
        if num_replicas is None:
            num_replicas = group.get_world_size() if group else 1
        if rank is None:
            rank = group.get_rank() if group else 0
        given = {
            "seed": (seed, 0),
            "shard": (1 if shard is None else shard, 1),
            "window": (window, 1),
            "num_replicas": (num_replicas, 1),
            "rank": (rank, 0),
            "read_ahead": (read_ahead, 0),
        }
        for name, (value, least) in given.items():
            if value < least:
                raise ArgumentError(name, expected=f"{least} or more", found=value)
        if rank >= num_replicas:
            expected = f"0 to {num_replicas - 1}, for {num_replicas} processes"
            raise ArgumentError("rank", expected=expected, found=rank)
        self.dataset = dataset
        self.seed = seed
        self.epoch = 0
        before = -(-(dataset.history - 1) // _STORED_TOGETHER) * _STORED_TOGETHER
        self.shard = max(_STORED_TOGETHER, _READ_AGAIN * before) if shard is None else shard
        self.window = window
        self.num_replicas = num_replicas
        self.rank = rank
        self.read_ahead = read_ahead
        self._shards = _number_shards(dataset, self.shard)
        self._next = 0  # first position of the next iteration
        self._begun = 0  # first position of the current iteration
        self._drawn = 0  # number of samples drawn so far by all processes

    def __repr__(self) -> str:
        names = "seed epoch shard window num_replicas rank".split()
        values = ", ".join(f"{name}={getattr(self, name)}" for name in names)
        return f"ShardSampler({self.dataset!r}, {values})"

    def __len__(self) -> int:
        """Return the number of samples per epoch of this process."""
        return math.ceil(len(self._shards) / self.num_replicas)

    def set_epoch(self, epoch: int) -> None:
        """Set the next epoch.

        For the epoch of `load_state_dict`, the iteration continues at its position.
        """
        if epoch != self.epoch:
            self._next = self._begun = self._drawn = 0
        self.epoch = epoch

    def order(self, epoch: int) -> IntArray:
        """Return the (N,) indices of all samples, for all processes together, in the order of an
        epoch.
        """
        drawn = np.random.default_rng([self.seed, epoch])
        place = np.argsort(
            np.argsort(drawn.random(int(self._shards[-1]) + 1), kind="stable"), kind="stable"
        )
        return np.argsort(
            place[self._shards] + self.window * drawn.random(len(self._shards)), kind="stable"
        )

    def __iter__(self) -> Iterator[int]:
        """Iterate over an epoch, or over the rest of it after `load_state_dict`."""
        epoch = self.epoch
        start = self._next
        self._next = self._begun = self._drawn = 0
        # the state of a finished epoch was loaded: continue with the next epoch
        if start == len(self._shards):
            self.epoch += 1
        else:
            self._begun = self._drawn = start
        return self._iterate(epoch, start)

    def _iterate(self, epoch: int, start: int) -> Iterator[int]:
        order = self.order(epoch)
        left = order[start:]
        mine = np.resize(left, -(-len(left) // self.num_replicas) * self.num_replicas)[
            self.rank :: self.num_replicas
        ]
        with ReadAhead(self.dataset, order, self._shards, start, self.read_ahead) as ahead:
            for count, index in enumerate(mine.tolist(), 1):
                self._drawn = min(start + count * self.num_replicas, len(order))
                ahead.draw(self._drawn)
                yield index

    def state_dict(self, trained: int | None = None) -> dict[str, int]:
        """Return the position in the epoch.

        A sampler of the same data can load it, with any number of processes.

        A DataLoader with workers draws samples in advance. Pass the number of samples that were
        trained on:

            for step, batch in enumerate(loader):
                ...
                torch.save({"sampler": sampler.state_dict(trained=(step + 1) * batch_size), ...},
                path)

        Args:
            trained: number of samples that were trained on since the start of the iteration, summed
                over all processes. None takes all drawn samples, for the StatefulDataLoader of
                torchdata, which counts itself.
        """
        position = self._drawn if trained is None else min(self._begun + trained, len(self._shards))
        return {"seed": self.seed, "epoch": self.epoch, "position": position} | self._about()

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Continue at a position.

        The next iteration yields the rest of its epoch, later iterations whole epochs.

        Raises:
            ArgumentError: the state is from a sampler of other data, or with another `shard` or
                `window`.
        """
        different = [name for name, value in self._about().items() if state.get(name) != value]
        if different or not 0 <= state.get("position", -1) <= len(self._shards):
            raise ArgumentError(
                "state",
                expected=f"the state of a ShardSampler with {self._about()}",
                found={name: state.get(name) for name in different or ("position",)},
                advice="the data and the arguments `shard` and `window` must be the same",
            )
        self.seed = int(state["seed"])
        self.epoch = int(state["epoch"])
        self._next = self._begun = self._drawn = int(state["position"])

    def _about(self) -> dict[str, int]:
        """Return the values on which the order depends, except the seed and the epoch."""
        digest = 0
        for sequence, frames in zip(self.dataset.sequences, self.dataset.frames, strict=True):
            digest = zlib.crc32(sequence.name.encode(), digest)
            digest = zlib.crc32(np.asarray(frames, "<i8").tobytes(), digest)
        return {
            "samples": len(self._shards),
            "data": digest,
            "shard": self.shard,
            "window": self.window,
        }


inherit(ShardSampler, "Sampler")


def _number_shards(dataset: Dataset, length: int) -> IntArray:
    """Return (N,) the shard number of each sample. Numbers are consecutive from 0."""
    numbers: list[IntArray] = []
    first = 0
    for frames in dataset.frames:
        if len(frames):
            _, number = np.unique(frames // length, return_inverse=True)
            numbers.append(number.reshape(-1) + first)
            first = int(numbers[-1][-1]) + 1
    return np.concatenate(numbers)


_THREADS = 3  # files that are fetched in parallel, each in several ranges


class ReadAhead:
    """Threads that fetch the files of shards, in the order of their first samples, inside a `with`
    block.

    They start when the first sample is drawn, after a loader has forked its workers. Without a
    cache, no thread is started.
    """

    # Class attributes, because at interpreter exit the globals of this module may be deleted during
    # an iteration.
    _clock = staticmethod(time.monotonic)
    _this_thread = staticmethod(threading.current_thread)
    # longest wait for running fetches at the end: requests to a lost server are repeated for
    # minutes
    _stop_s = 5.0

    def __init__(
        self,
        dataset: Dataset,
        order: IntArray,
        shards: IntArray,
        start: int,
        count: int,
    ) -> None:
        """Compute the order in which shards are needed.

        Args:
            dataset: the samples.
            order: (N,) indices of the samples in the order in which they are drawn.
            shards: (N,) number of the shard of each sample, by the sample's index.
            start: first position in `order`.
            count: number of shards that are fetched in advance.
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
            self._next_shards = deque()
            self._firsts = np.empty(0, np.int64)

    def draw(self, position: int) -> None:
        """Record the position in the order that was drawn last."""
        if not len(self._firsts):
            return
        with self._changed:
            self._drawn = position
            self._changed.notify_all()
        if not self._threads:
            self._threads = [
                threading.Thread(target=self._run, name="carlasc-read-ahead", daemon=True)
                for _ in range(_THREADS)
            ]
            for thread in self._threads:
                thread.start()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        with self._changed:
            self._stopped = True
            self._changed.notify_all()
        end = self._clock() + self._stop_s
        for thread in self._threads:
            # the garbage collector may close an iterator in any thread
            if thread is not self._this_thread():
                thread.join(max(0.0, end - self._clock()))

    def _run(self) -> None:
        while True:
            with self._changed:
                self._changed.wait_for(
                    lambda: self._stopped or self._waiting or self._may_begin_shard()
                )
                if self._stopped:
                    return
                file = self._waiting.popleft() if self._waiting else None
                shard = self._next_shards.popleft() if file is None else -1
            # the reader of the file gets the same error, and reports it
            with suppress(CarlascError):
                if file is not None:
                    tree, path = file
                    tree.fetch(path, wait=False)
                    continue
                paths = self._dataset.cached_files(np.flatnonzero(self._shards == shard).tolist())
                with self._changed:
                    self._waiting.extend(paths)
                    self._changed.notify_all()

    def _may_begin_shard(self) -> bool:
        """Whether the next shard is among the first `count` shards without drawn samples."""
        begun = len(self._firsts) - len(self._next_shards)
        open_shards = int(np.searchsorted(self._firsts, self._drawn, "right"))
        return bool(self._next_shards) and begun < open_shards + self._count
