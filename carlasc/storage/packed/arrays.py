"""Packed stores of arrays: what zarr and HDF5 have in common, reading. The format is docs/storage.md, section "Arrays"."""

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

from carlasc.core.grids import Coordinates
from carlasc.errors import FormatError, MissingDataError
from carlasc.storage import layout
from carlasc.storage.packed.chunks import StoredArray, parallel, scratch
from carlasc.storage.packed.store import VERSION, Column, PackedSource, Packing, Points, packing_of
from carlasc.storage.protocol import Sequence

STORE, SEQUENCE, FIELD, COLUMN, DOCUMENT = (
    "carlasc.store",
    "carlasc.sequence",
    "carlasc.field",
    "carlasc.column",
    "carlasc.document",
)


class ArrayStore(ABC):
    """A tree of groups and arrays, to be read. Holds no handle between two calls.

    Attributes:
        location: what to call it in errors.
        local: whether its bytes are on this machine.
    """

    location: str
    local: bool

    @abstractmethod
    def attributes(self, node: str) -> dict[str, Any] | None:
        """Return the attributes of a group or an array, None where there is no such node."""

    @abstractmethod
    def read_small(self, node: str) -> NDArray[Any]:
        """Return the whole of an array that has one chunk."""

    @abstractmethod
    def array(self, node: str) -> StoredArray:
        """Return an array to read chunks of."""

    @abstractmethod
    def stored_bytes(self, node: str) -> int:
        """Return the bytes that a node and those below take."""


class ArraySource(PackedSource):
    """A packed store of arrays."""

    def __init__(self, store: ArrayStore) -> None:
        """Look at the store's first node.

        Raises:
            FormatError: it is something else, unfinished, or of a newer version.
        """
        self.store = store
        self.location = store.location
        self._root = check_root(store.attributes(""), self.location)

    def sequences(self) -> Mapping[str, Sequence]:
        """Return the sequences that the store lists."""
        return {path: ArraySequence(self.store, path, group) for path, group in sorted(self._root["sequences"].items())}

    def stored_bytes(self) -> dict[str, int]:
        """Return the bytes that each field takes."""
        sizes: Counter[str] = Counter()
        for sequence in self.sequences().values():
            group = cast(ArraySequence, sequence).group
            sizes["documents"] += self.store.stored_bytes(f"{group}/documents")
            for field in sequence.fields():
                sizes[field] += self.store.stored_bytes(f"{group}/{field_node(field)}")
        return dict(sizes) | {"index": self.store.stored_bytes("") - sizes.total()}


class ArraySequence(Sequence):
    """One sequence of a packed store."""

    def __init__(self, store: ArrayStore, path: str, group: str) -> None:
        self.store = store
        self.path = path
        self.group = group
        self.location = f"{store.location}/{group}"
        attributes = store.attributes(group)
        if attributes is None or attributes.get("type") != SEQUENCE:
            raise FormatError(
                self.location, expected="the sequence that the store lists", found="none", advice="damaged store"
            )
        self.split: str | None = attributes["split"]
        self.name: str = attributes["name"]
        self.coordinates = cast(Coordinates, attributes["coordinates"])
        self._fields = frozenset(attributes["fields"])
        self._documents = tuple(attributes["documents"])
        self._packed: dict[str, _PackedField] = {}

    def fields(self) -> frozenset[str]:
        """Return the fields with at least one frame."""
        return self._fields

    def frames(self, field: str) -> NDArray[np.int64]:
        """Return the frames of a field."""
        return self._field(field).frames if field in self._fields else np.empty(0, np.int64)

    def read(self, field: str, frame: int) -> NDArray[Any]:
        """Read one field of one frame."""
        return self._field(field).read([frame])[0]

    def read_many(self, field: str, frames: Iterable[int]) -> list[NDArray[Any]]:
        """Read several frames: fetched in one go, decoded side by side."""
        return self._field(field).read(list(frames))

    def read_xyz(
        self, frames: Iterable[int], spare: list[NDArray[np.float32]] | None = None
    ) -> list[NDArray[np.float32]]:
        """Read points as they are stored, as planes: the 4th column is not looked for, and nothing is put into rows."""
        return self._field("points").read_planes(list(frames), spare or [])

    def documents(self) -> tuple[str, ...]:
        """Return the text files that are there."""
        return self._documents

    def read_document(self, name: str) -> bytes:
        """Return a text file's bytes."""
        if name not in self._documents:
            raise MissingDataError(
                self.location, expected=f"the text file {name}", found=f"{', '.join(self._documents) or 'none'}"
            )
        return self.store.read_small(f"{self.group}/{document_node(name)}").tobytes()

    def _field(self, field: str) -> _PackedField:
        if field not in self._packed:
            if field not in self._fields:
                raise MissingDataError(
                    self.location, expected=f"the field {field}", found=f"{', '.join(sorted(self._fields)) or 'none'}"
                )
            self._packed[field] = _PackedField(self.store, f"{self.group}/{field_node(field)}", field)
        return self._packed[field]

    def __getstate__(self) -> dict[str, Any]:
        return self.__dict__ | {"_packed": {}}  # a worker looks up what it needs


class _PackedField:
    """A field of a sequence: its frames, and the columns that they are in."""

    def __init__(self, store: ArrayStore, node: str, field: str) -> None:
        self.store = store
        self.node = node
        self.where = f"{store.location}/{node}"
        attributes = store.attributes(node)
        if attributes is None:
            raise FormatError(
                self.where, expected="the field that the sequence lists", found="nothing", advice="damaged store"
            )
        self.packing: Packing = packing_of(layout.field_named(field), attributes=attributes)
        if attributes.get("kind") != self.packing.kind:
            raise FormatError(
                self.where, expected=f"a field of kind {self.packing.kind}", found=f"{attributes.get('kind')!r}"
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
        """Read frames: from a remote store all their chunks at once, then frame by frame, side by side."""
        positions = [self._position(frame) for frame in frames]
        tasks = {name: self._tasks(column, frames) for name, column in self.columns.items()}
        main = self.columns.get(self.packing.columns[0].name)
        rooms = self.packing.make_room([main.count(position) if main else 0 for position in positions])

        def assemble(k: int) -> NDArray[Any]:
            with self._naming([frames[k]]):
                parts = {name: column.decode(tasks[name][k]) for name, column in self.columns.items()}
                return self.packing.join(
                    {c.name: parts.get(c.name, _nothing(c)) for c in self.packing.columns}, rooms[k]
                )

        return parallel(assemble, range(len(frames)))

    def read_planes(self, frames: list[int], spare: list[NDArray[np.float32]]) -> list[NDArray[np.float32]]:
        """Read the points of frames as (N, 3), each coordinate contiguous, into the memory of `spare` as far as that goes."""
        packing, column = cast(Points, self.packing), self.columns.get("xyz")
        if column is None:
            return [np.empty((0, 3), np.float32) for _ in frames]
        tasks = self._tasks(column, frames)
        rooms = [column.room_for(task, spare) for task in tasks]

        def decode(k: int) -> NDArray[np.float32]:
            with self._naming([frames[k]]):
                return packing.to_metres(column.decode(tasks[k], rooms[k])).T

        return parallel(decode, range(len(frames)))

    def _tasks(self, column: _StoredColumn, frames: list[int]) -> list[_Task]:
        """Return what is to be read of a column; from a remote store, already fetched."""
        tasks = column.tasks([self._position(frame) for frame in frames])
        if not self.local:
            with self._naming(frames):
                column.fetch(tasks)
        return tasks

    @contextmanager
    def _naming(self, frames: list[int]) -> Iterator[None]:
        """Put the field and the frame in front of what went wrong."""
        try:
            yield
        except FormatError as error:
            listed = ", ".join(map(str, frames))
            raise FormatError(f"{self.where}: field {self.packing.entry.name}, frame {listed}: {error}") from error

    def _position(self, frame: int) -> int:
        if frame not in self._positions:
            raise MissingDataError(self.where, expected=f"frame {frame}", found=f"{len(self.frames)} frames without it")
        return self._positions[frame]


@dataclass
class _Task:
    """A frame's part of a column, to be read.

    Attributes:
        chunks: the chunks that it is in.
        count: elements of the frame.
        fetched: the chunks' bytes, where they were asked for beforehand.
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
        if not fits or self.spans.min(initial=0) < 0 or self.spans.max(initial=0) > array.shape[array.axis]:
            raise FormatError(
                node, expected=f"offsets of {frames} frames inside the array", found="others", advice="damaged store"
            )

    def count(self, position: int) -> int:
        """Return how many elements a frame has."""
        start, end = self.spans[position].tolist()
        return end - start

    def tasks(self, positions: list[int]) -> list[_Task]:
        """Return what is to be read for some frames."""
        spans = (self.spans[position].tolist() for position in positions)
        step = self.array.step
        return [_Task(range(start // step, -(-end // step)), end - start) for start, end in spans]

    def fetch(self, tasks: list[_Task]) -> None:
        """Fetch the chunks of all tasks at once."""
        parts = iter(self.array.fetch([number for task in tasks for number in task.chunks]))
        for task in tasks:
            task.fetched = [next(parts) for _ in task.chunks]

    def room_for(self, task: _Task, spare: list[NDArray[Any]]) -> NDArray[Any]:
        """Return memory to decode a frame into: that of a spare array that came from here, else fresh (whose pages take longer to touch)."""
        shape = (self.column.rows or 1, len(task.chunks) * self.array.step)
        while spare:
            memory = spare.pop().base
            if isinstance(memory, np.ndarray) and memory.shape == shape and memory.dtype == self.array.dtype:
                return memory
        return np.empty(shape, self.array.dtype)

    def decode(self, task: _Task, room: NDArray[Any] | None = None) -> NDArray[Any]:
        """Decode a frame's chunks, into `room` if it is given."""
        parts = task.fetched if task.fetched is not None else self.array.fetch(task.chunks)
        if self.is_grid:
            return self._decode_chunk(parts[0], task.chunks[0], np.empty(self.array.chunk, self.array.dtype))[0]
        step, rows = self.array.step, self.column.rows or 1
        shape, dtype = (rows, len(parts) * step), self.array.dtype
        if room is None:
            room = scratch(shape, dtype) if self.column.scratch else np.empty(shape, dtype)
        if len(parts) == 1:  # the rule: decode into place
            self._decode_chunk(parts[0], task.chunks[0], room.reshape(self.array.chunk))
        else:
            chunk = np.empty(self.array.chunk, dtype)
            for place, (number, part) in enumerate(zip(task.chunks, parts, strict=True)):
                room[:, place * step : (place + 1) * step] = self._decode_chunk(part, number, chunk)
        values = room[:, : task.count]
        return values if self.column.rows else values[0]

    def _decode_chunk(self, part: memoryview, number: int, out: NDArray[Any]) -> NDArray[Any]:
        self.array.decode(part, number, out)
        return out


def _nothing(column: Column) -> NDArray[Any]:
    return np.empty((column.rows, 0) if column.rows else 0, column.dtype)


def check_root(attributes: Mapping[str, Any] | None, where: str) -> Mapping[str, Any]:
    """Return a store's root attributes.

    Raises:
        FormatError: it is something else, unfinished, or of a newer version.
    """
    if attributes is None or attributes.get("type") != STORE:
        raise FormatError(where, expected="a store packed by carlasc", found=f"one without its mark (type {STORE})")
    if attributes.get("version", 0) > VERSION:
        raise FormatError(
            where,
            expected=f"a store of version {VERSION} or older",
            found=f"version {attributes['version']}",
            advice="upgrade carlasc to read it",
        )
    if not attributes.get("complete"):
        raise FormatError(
            where,
            expected="a finished store",
            found="one whose packing was cut off",
            advice="run the same command again to finish it",
        )
    return attributes


def field_node(field: str) -> str:
    """Return where a field stands in its sequence's group."""
    return f"grids/{field}" if "/" in field else f"scans/{field}"


def document_node(name: str) -> str:
    """Return where a text file stands in its sequence's group."""
    return f"documents/{name}"
