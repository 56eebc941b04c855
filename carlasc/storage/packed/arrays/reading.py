"""Reading packed stores of arrays: what zarr and HDF5, and both versions of the format, have in common."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cached_property
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

from carlasc.errors import FormatError, MissingDataError, reading
from carlasc.storage.arrays import check_size
from carlasc.storage.packed.arrays.chunks import StoredArray, parallel, scratch
from carlasc.storage.packed.arrays.columns import WIDE, Column, Packing, Points
from carlasc.storage.packed.protocol import PackedSequence, PackedSource
from carlasc.storage.protocol import Sequence
from carlasc.storage.transport.trees import Tree

SEQUENCE, FIELD, COLUMN, DOCUMENT = "carlasc.sequence", "carlasc.field", "carlasc.column", "carlasc.document"


class ArrayStore(ABC):
    """A tree of groups and arrays to read from. It holds no handle between two calls.

    Attributes:
        location: what to call it in errors.
        local: whether its bytes are on this machine.
        tree: the tree of files that it is in.
    """

    location: str
    tree: Tree
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
        return {path: self._sequence(path, group) for path, group in self.nodes.items()}

    @abstractmethod
    def _sequence(self, path: str, group: str) -> ArraySequence: ...

    def stored_bytes(self) -> dict[str, int]:
        """Return the bytes that each field takes."""
        sizes: Counter[str] = Counter()
        for path, sequence in self.sequences().items():
            group = self.nodes[path]
            sizes["documents"] += self.store.stored_bytes(f"{group}/documents")
            for field in sequence.fields():
                sizes[field] += self.store.stored_bytes(f"{group}/{field_node(field)}")
        return dict(sizes) | {"index": self.store.stored_bytes("") - sizes.total()}


class ArraySequence(PackedSequence["ArrayField"]):
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
        self.tree = store.tree

    def _check_grid(self, field: str, shape: tuple[int, ...]) -> None:
        """Check that the chunks of a field of a grid have the shape that the grid's params.json says.

        Raises:
            FormatError: they have another one.
        """
        grid = self.grids.get(field.rpartition("/")[0])
        if grid is None:  # written last, or not at all
            check_size(shape, np.dtype("<u4"), f"{self.location}: field {field}")
        elif shape != grid.size:
            raise FormatError(
                f"{self.location}: field {field}",
                expected=f"grids of shape {grid.size}, as in params.json",
                found=f"{shape}",
            )

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

    def files_of(self, field: str, frames: Iterable[int]) -> list[str]:
        """Return the files that hold a field of some frames: shards of a zarr store, the one file of an HDF5 store."""
        return self._field(field).files_of(list(frames))


class ArrayField:
    """A field of a sequence: its frames, and the columns that they are in."""

    def __init__(
        self,
        where: str,
        packing: Packing,
        frames: NDArray[np.int64],
        columns: Callable[[], dict[str, StoredColumn]],
        local: bool,
    ) -> None:
        """Take what is known of the field.

        Args:
            where: its name in errors.
            packing: how its columns become frames.
            frames: the numbers of its frames, in rising order.
            columns: opens the columns that are stored: those that some frame needed. Called once, when a frame is read.
            local: whether its bytes are on this machine.
        """
        self.where = where
        self.packing = packing
        self.frames = frames
        self.local = local
        self._open_columns = columns
        self._positions = {frame: position for position, frame in enumerate(frames.tolist())}

    @cached_property
    def columns(self) -> dict[str, StoredColumn]:
        """The columns that are stored."""
        return self._open_columns()

    def read(self, frames: list[int]) -> list[NDArray[Any]]:
        """Read frames: from a remote store all their chunks are fetched at once; frames are decoded in parallel."""
        positions = [self._position(frame) for frame in frames]
        tasks = {name: self._tasks(column, frames) for name, column in self.columns.items()}
        main = self.columns.get(self.packing.columns[0].name)
        outputs = self.packing.allocate([main.counts[position] if main else 0 for position in positions])

        def assemble(k: int) -> NDArray[Any]:
            with self._naming([frames[k]]):
                parts = {}
                for column in self.packing.columns:
                    name = self._stored_in(column, positions[k])
                    parts[column.name] = _empty(column) if name is None else self.columns[name].decode(tasks[name][k])
                return self.packing.join(parts, outputs[k])

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

    def published_bytes(self) -> int:
        """Return the bytes of the field's published files, from the numbers of elements."""
        return self.packing.published_bytes({name: sum(column.counts) for name, column in self.columns.items()})

    def files_of(self, frames: list[int]) -> list[str]:
        """Return the files that hold some frames, each once."""
        positions = [self._position(frame) for frame in frames]
        files = [
            column.array.files([number for task in column.tasks(positions) for number in task.chunks])
            for column in self.columns.values()
        ]
        return list(dict.fromkeys(file for found in files for file in found))

    def _stored_in(self, column: Column, position: int) -> str | None:
        """Return the name of the stored column that has a frame's elements: the column or its wide one."""
        stored = [name for name in (column.name, f"{column.name}{WIDE}") if name in self.columns]
        return next((name for name in stored if self.columns[name].counts[position]), stored[0] if stored else None)

    def _tasks(self, column: StoredColumn, frames: list[int]) -> list[_Task]:
        """Return the parts of a column to read, already fetched if the store is remote."""
        positions = [self._position(frame) for frame in frames]
        with self._naming(frames):
            tasks = column.tasks(positions)
            if not self.local:
                column.fetch(tasks)
        return tasks

    @contextmanager
    def _naming(self, frames: list[int]) -> Iterator[None]:
        """Add the field and the frames to the place of an error; columns that do not fit each other are one too."""
        where = f"{self.where}: field {self.packing.entry.name}, frame {', '.join(map(str, frames))}"
        with reading(where, "the columns of a frame", "the store is damaged"):
            try:
                yield
            except FormatError as error:
                raise error.within(where) from error

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


class StoredColumn:
    """One array of a field, and which of its chunks each frame has.

    Attributes:
        column: what is in it.
        array: its chunks.
        firsts: number of the first chunk of each frame.
        counts: number of elements of each frame; for a grid, any number above 0 says that it is there.
    """

    def __init__(
        self, column: Column, array: StoredArray, firsts: NDArray[np.int64], counts: NDArray[np.int64], is_grid: bool
    ) -> None:
        self.column = column
        self.array = array
        self.is_grid = is_grid
        self.firsts: list[int] = firsts.tolist()
        self.counts: list[int] = counts.tolist()

    def tasks(self, positions: list[int]) -> list[_Task]:
        """Return the parts that hold some frames."""
        step, found = self.array.step, []
        for position in positions:
            first, count = self.firsts[position], self.counts[position]
            chunks = min(count, 1) if self.is_grid else -(-count // step)
            if not self.is_grid:
                check_size((self.column.rows or 1, chunks, step), self.array.dtype, f"a frame of {self.array.name}")
            found.append(_Task(range(first, first + chunks), count))
        return found

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


def check_frames(frames: NDArray[np.int64], where: str) -> NDArray[np.int64]:
    """Return the numbers of frames if they rise from 0 or more.

    Raises:
        FormatError: they do not, or are not a row of numbers.
    """
    if frames.ndim != 1 or (np.diff(frames, prepend=-1) <= 0).any():
        raise FormatError(where, expected="rising numbers of frames", found="others", advice="the store is damaged")
    return frames


def check_attributes(attributes: Mapping[str, Any], where: str) -> None:
    """Check what the attributes of a field say of its values.

    Raises:
        FormatError: the step of its coordinates is not a length.
    """
    scale = attributes.get("scale_m")
    if scale is not None and not (type(scale) in (int, float) and 0 < scale <= 1):
        raise FormatError(
            where, expected="a step of coordinates above 0, up to 1 m", found=repr(scale), advice="the store is damaged"
        )


def _empty(column: Column) -> NDArray[Any]:
    return np.empty((column.rows, 0) if column.rows else 0, column.dtype)


def field_node(field: str) -> str:
    """Return the node of a field in its sequence's group."""
    return f"grids/{field}" if "/" in field else f"scans/{field}"


def document_node(name: str) -> str:
    """Return the node of a text file in its sequence's group."""
    return f"documents/{name}"
