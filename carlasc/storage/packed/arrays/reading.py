"""Reading packed stores of arrays: what zarr and HDF5 have in common."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cached_property
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

from carlasc.errors import FormatError, MissingDataError
from carlasc.storage import layout
from carlasc.storage.packed.arrays.chunks import StoredArray, parallel, scratch
from carlasc.storage.packed.arrays.columns import Column, Packing, Points, packing_of
from carlasc.storage.packed.protocol import PackedSequence, PackedSource
from carlasc.storage.protocol import Sequence

SEQUENCE, FIELD, COLUMN, DOCUMENT = "carlasc.sequence", "carlasc.field", "carlasc.column", "carlasc.document"


class ArrayStore(ABC):
    """A tree of groups and arrays to read from. It holds no handle between two calls.

    Attributes:
        location: what to call it in errors.
        local: whether its bytes are on this machine.
    """

    location: str
    local: bool

    @abstractmethod
    def attributes(self, node: str) -> dict[str, Any] | None:
        """Return the attributes of a group or an array, None if there is no such node."""

    @abstractmethod
    def read_small(self, node: str) -> NDArray[Any]:
        """Return a whole array, which has one chunk."""

    @abstractmethod
    def array(self, node: str) -> StoredArray:
        """Return an array whose chunks can be read."""

    @abstractmethod
    def stored_bytes(self, node: str) -> int:
        """Return the bytes that a node and those below take."""


class ArraySource(PackedSource):
    """A packed store of arrays."""

    def __init__(self, store: ArrayStore) -> None:
        """Read the attributes of the store's root.

        Raises:
            FormatError: it is something else, unfinished, or of a newer version.
        """
        super().__init__(store.location, store.attributes(""))
        self.store = store

    def sequences(self) -> Mapping[str, Sequence]:
        """Return the sequences that the store lists."""
        return {path: ArraySequence(self.store, path, group) for path, group in self.nodes.items()}

    def stored_bytes(self) -> dict[str, int]:
        """Return the bytes that each field takes."""
        sizes: Counter[str] = Counter()
        for path, sequence in self.sequences().items():
            group = self.nodes[path]
            sizes["documents"] += self.store.stored_bytes(f"{group}/documents")
            for field in sequence.fields():
                sizes[field] += self.store.stored_bytes(f"{group}/{field_node(field)}")
        return dict(sizes) | {"index": self.store.stored_bytes("") - sizes.total()}


class ArraySequence(PackedSequence["_ArrayField"]):
    """One sequence of a packed store of arrays."""

    def __init__(self, store: ArrayStore, path: str, group: str) -> None:
        self.store = store
        self.group = group
        location = f"{store.location}/{group}"
        attributes = store.attributes(group)
        if attributes is None or attributes.get("type") != SEQUENCE:
            raise FormatError(
                location, expected="the sequence that the store lists", found="none", advice="the store is damaged"
            )
        super().__init__(path, location, attributes)

    def read(self, field: str, frame: int) -> NDArray[Any]:
        """Read one field of one frame."""
        return self._field(field).read([frame])[0]

    def read_many(self, field: str, frames: Iterable[int]) -> list[NDArray[Any]]:
        """Read several frames: fetched together, decoded in parallel."""
        return self._field(field).read(list(frames))

    def read_xyz(
        self, frames: Iterable[int], spare: list[NDArray[np.float32]] | None = None
    ) -> list[NDArray[np.float32]]:
        """Read points as they are stored, as planes: the 4th column is not read, and no rows are put together."""
        return self._field("points").read_planes(list(frames), spare or [])

    def read_document(self, name: str) -> bytes:
        """Return a text file's bytes."""
        self._check_document(name)
        return self.store.read_small(f"{self.group}/{document_node(name)}").tobytes()

    def _open_field(self, field: str) -> _ArrayField:
        return _ArrayField(self.store, f"{self.group}/{field_node(field)}", field)


class _ArrayField:
    """A field of a sequence: its frames, and the columns that they are in."""

    def __init__(self, store: ArrayStore, node: str, field: str) -> None:
        self.store = store
        self.node = node
        self.where = f"{store.location}/{node}"
        attributes = store.attributes(node)
        if attributes is None:
            raise FormatError(
                self.where, expected="the field that the sequence lists", found="none", advice="the store is damaged"
            )
        self.packing: Packing = packing_of(layout.field_named(field), attributes=attributes)
        if attributes.get("kind") != self.packing.kind:
            raise FormatError(
                self.where, expected=f"a field of kind {self.packing.kind}", found=repr(attributes.get("kind"))
            )
        self.local = store.local
        self.frames: NDArray[np.int64] = store.read_small(f"{node}/frames").astype(np.int64)
        self._positions = {frame: position for position, frame in enumerate(self.frames.tolist())}

    @cached_property
    def columns(self) -> dict[str, _StoredColumn]:
        """The columns that are stored: those that some frame needed."""
        nodes = {column: f"{self.node}/{column.name}" for column in self.packing.columns}
        is_grid = self.packing.kind == "grid"
        return {
            column.name: _StoredColumn(self.store, node, column, len(self.frames), is_grid)
            for column, node in nodes.items()
            if self.store.attributes(node) is not None
        }

    def read(self, frames: list[int]) -> list[NDArray[Any]]:
        """Read frames: from a remote store all their chunks are fetched at once; frames are decoded in parallel."""
        positions = [self._position(frame) for frame in frames]
        tasks = {name: self._tasks(column, frames) for name, column in self.columns.items()}
        main = self.columns.get(self.packing.columns[0].name)
        outputs = self.packing.allocate([main.count(position) if main else 0 for position in positions])

        def assemble(k: int) -> NDArray[Any]:
            with self._naming([frames[k]]):
                parts = {name: column.decode(tasks[name][k]) for name, column in self.columns.items()}
                return self.packing.join(
                    {c.name: parts.get(c.name, _empty(c)) for c in self.packing.columns}, outputs[k]
                )

        return parallel(assemble, range(len(frames)))

    def read_planes(self, frames: list[int], spare: list[NDArray[np.float32]]) -> list[NDArray[np.float32]]:
        """Read the points of frames as (N, 3), each coordinate contiguous, into the memory of `spare` where it fits."""
        packing, column = cast(Points, self.packing), self.columns.get("xyz")
        if column is None:
            return [np.empty((0, 3), np.float32) for _ in frames]
        tasks = self._tasks(column, frames)
        outputs = [column.memory_for(task, spare) for task in tasks]

        def decode(k: int) -> NDArray[np.float32]:
            with self._naming([frames[k]]):
                return packing.to_metres(column.decode(tasks[k], outputs[k])).T

        return parallel(decode, range(len(frames)))

    def _tasks(self, column: _StoredColumn, frames: list[int]) -> list[_Task]:
        """Return the parts of a column to read, already fetched if the store is remote."""
        tasks = column.tasks([self._position(frame) for frame in frames])
        if not self.local:
            with self._naming(frames):
                column.fetch(tasks)
        return tasks

    @contextmanager
    def _naming(self, frames: list[int]) -> Iterator[None]:
        """Add the field and the frames to the place of an error."""
        try:
            yield
        except FormatError as error:
            listed = ", ".join(map(str, frames))
            raise error.within(f"{self.where}: field {self.packing.entry.name}, frame {listed}") from error

    def _position(self, frame: int) -> int:
        if frame not in self._positions:
            raise MissingDataError(self.where, expected=f"frame {frame}", found=f"{len(self.frames)} frames without it")
        return self._positions[frame]


@dataclass
class _Task:
    """A frame's part of a column.

    Attributes:
        chunks: numbers of the chunks that hold it.
        count: elements of the frame.
        fetched: the bytes of the chunks, if they were fetched before.
    """

    chunks: range
    count: int
    fetched: list[memoryview] | None = None


class _StoredColumn:
    """One array of a field, and where each frame starts and ends in it: (F, 2)."""

    def __init__(self, store: ArrayStore, node: str, column: Column, frames: int, is_grid: bool) -> None:
        self.column = column
        self.array = store.array(node)
        self.is_grid = is_grid
        array, step = self.array, self.array.step
        if is_grid:
            self.spans = np.stack([np.arange(frames), np.arange(frames) + 1], axis=1)
        else:
            self.spans = store.read_small(f"{node}_offsets").astype(np.int64)
        fits = self.spans.shape == (frames, 2) and (self.spans[:, 0] % step == 0).all()
        fits = fits and (self.spans[:, 0] <= self.spans[:, 1]).all()
        if not fits or self.spans.min(initial=0) < 0 or self.spans.max(initial=0) > array.shape[array.axis]:
            raise FormatError(
                f"{store.location}/{node}_offsets",
                expected=f"offsets of {frames} frames inside the array",
                found="others",
                advice="the store is damaged",
            )

    def count(self, position: int) -> int:
        """Return how many elements a frame has."""
        start, end = self.spans[position].tolist()
        return end - start

    def tasks(self, positions: list[int]) -> list[_Task]:
        """Return the parts that hold some frames."""
        spans = (self.spans[position].tolist() for position in positions)
        step = self.array.step
        return [_Task(range(start // step, -(-end // step)), end - start) for start, end in spans]

    def fetch(self, tasks: list[_Task]) -> None:
        """Fetch the chunks of all tasks at once."""
        parts = iter(self.array.fetch([number for task in tasks for number in task.chunks]))
        for task in tasks:
            task.fetched = [next(parts) for _ in task.chunks]

    def memory_for(self, task: _Task, spare: list[NDArray[Any]]) -> NDArray[Any]:
        """Return memory to decode a frame into: that of a spare array of the same shape, or new memory, which is slower to write to."""
        shape = (self.column.rows or 1, len(task.chunks) * self.array.step)
        while spare:
            memory = spare.pop().base
            if isinstance(memory, np.ndarray) and memory.shape == shape and memory.dtype == self.array.dtype:
                return memory
        return np.empty(shape, self.array.dtype)

    def decode(self, task: _Task, out: NDArray[Any] | None = None) -> NDArray[Any]:
        """Decode a frame's chunks, into `out` if it is given."""
        parts = task.fetched if task.fetched is not None else self.array.fetch(task.chunks)
        if self.is_grid:
            return self._decode_chunk(parts[0], task.chunks[0], np.empty(self.array.chunk, self.array.dtype))[0]
        step, rows = self.array.step, self.column.rows or 1
        shape, dtype = (rows, len(parts) * step), self.array.dtype
        if out is None:
            out = scratch(shape, dtype) if self.column.scratch else np.empty(shape, dtype)
        if len(parts) == 1:  # nearly always
            self._decode_chunk(parts[0], task.chunks[0], out.reshape(self.array.chunk))
        else:
            chunk = np.empty(self.array.chunk, dtype)
            for place, (number, part) in enumerate(zip(task.chunks, parts, strict=True)):
                out[:, place * step : (place + 1) * step] = self._decode_chunk(part, number, chunk)
        values = out[:, : task.count]
        return values if self.column.rows else values[0]

    def _decode_chunk(self, part: memoryview, number: int, out: NDArray[Any]) -> NDArray[Any]:
        self.array.decode(part, number, out)
        return out


def _empty(column: Column) -> NDArray[Any]:
    return np.empty((column.rows, 0) if column.rows else 0, column.dtype)


def field_node(field: str) -> str:
    """Return the node of a field in its sequence's group."""
    return f"grids/{field}" if "/" in field else f"scans/{field}"


def document_node(name: str) -> str:
    """Return the node of a text file in its sequence's group."""
    return f"documents/{name}"
