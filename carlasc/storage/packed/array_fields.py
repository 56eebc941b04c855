"""Reading the frames of a field in a store of arrays: finding, fetching and decoding the chunks of
a frame.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cached_property
from typing import cast

import numpy as np

from carlasc.core.arrays import AnyArray, Float32Array, IntArray
from carlasc.errors import MissingDataError, reading, within
from carlasc.storage.arrays import check_size
from carlasc.storage.packed.array_layout import FieldLayout
from carlasc.storage.packed.chunks import StoredArray, parallel, scratch
from carlasc.storage.packed.columns import WIDE, Column, PointsPacking


class ArrayField:
    """A field of a sequence in a store of arrays: its frames and its columns."""

    def __init__(
        self,
        where: str,
        field_layout: FieldLayout,
        frames: IntArray,
        counts: Mapping[str, IntArray],
        array_of: Callable[[str], StoredArray],
        *,
        local: bool,
    ) -> None:
        """Create a field.

        Args:
            where: name of the sequence in errors.
            field_layout: layout of the field.
            frames: (n,) sorted frame numbers.
            counts: (n,) number of elements of each frame, by column; -1 if the field does not have
                the frame.
            array_of: returns the array of a column. Called on the first read, for the columns that
                are in use.
            local: whether the store is on this machine.
        """
        exists = np.zeros(len(frames), np.bool_)
        for column in counts.values():
            exists |= column >= 0
        self.where = where
        self.layout = field_layout
        self.packing = field_layout.packing
        self.frames = frames[exists]
        self.local = local
        self._counts = {
            name: column[exists] for name, column in counts.items() if (column > 0).any()
        }
        self._array_of = array_of
        self._positions = {frame: position for position, frame in enumerate(self.frames.tolist())}

    @cached_property
    def columns(self) -> dict[str, StoredColumn]:
        """The columns that are stored."""
        columns = {}
        for name, counts in self._counts.items():
            column = self.layout.columns[name]
            array = self._array_of(name)
            self.layout.check(
                array, column, int(self.frames[-1]), int(counts.max()), f"{self.where}/{name}"
            )
            firsts = self.frames * array.slots
            elements = np.maximum(counts, 0)
            columns[name] = StoredColumn(
                column, array, firsts.tolist(), elements.tolist(), self.layout.is_grid
            )
        return columns

    def read(self, frames: list[int]) -> list[AnyArray]:
        """Read frames.

        All their chunks are fetched at once from a remote store, and frames are decoded in
        parallel.
        """
        positions = [self._position(frame) for frame in frames]
        tasks = {name: self._parts(column, frames) for name, column in self.columns.items()}
        main = self.columns.get(self.packing.columns[0].name)
        outputs = self.packing.allocate(
            [main.counts[position] if main else 0 for position in positions]
        )

        def assemble(k: int) -> AnyArray:
            with self._naming([frames[k]]):
                parts = {}
                for column in self.packing.columns:
                    name = self._stored_in(column, positions[k])
                    parts[column.name] = (
                        _empty(column)
                        if name is None
                        else self.columns[name].decode(tasks[name][k])
                    )
                return self.packing.join(parts, outputs[k])

        return parallel(assemble, range(len(frames)))

    def read_planes(self, frames: list[int], spare: list[Float32Array]) -> list[Float32Array]:
        """Read the points of frames as (N, 3), each coordinate contiguous, into the memory of
        `spare` where it fits.
        """
        packing = cast(PointsPacking, self.packing)
        column = self.columns.get("xyz")
        if column is None:
            return [np.empty((0, 3), np.float32) for _ in frames]
        tasks = self._parts(column, frames)
        outputs = [column.memory_for(task, spare) for task in tasks]

        def decode(k: int) -> Float32Array:
            with self._naming([frames[k]]):
                return packing.to_metres(column.decode(tasks[k], outputs[k])).T

        return parallel(decode, range(len(frames)))

    def published_bytes(self) -> int:
        """Return the bytes of the field's published files, from the numbers of elements."""
        return self.packing.published_bytes(
            {name: sum(column.counts) for name, column in self.columns.items()}
        )

    def files_of(self, frames: list[int]) -> list[str]:
        """Return the files that hold some frames, each once."""
        positions = [self._position(frame) for frame in frames]
        files = [
            column.array.files(
                [number for task in column.parts(positions) for number in task.chunks]
            )
            for column in self.columns.values()
        ]
        return list(dict.fromkeys(file for names in files for file in names))

    def _stored_in(self, column: Column, position: int) -> str | None:
        """Return the name of the stored column with the elements of a frame: the column or its wide
        column.
        """
        stored = [name for name in (column.name, f"{column.name}{WIDE}") if name in self.columns]
        return next(
            (name for name in stored if self.columns[name].counts[position]),
            stored[0] if stored else None,
        )

    def _parts(self, column: StoredColumn, frames: list[int]) -> list[FramePart]:
        """Return the parts of a column to read, already fetched if the store is remote."""
        positions = [self._position(frame) for frame in frames]
        with self._naming(frames):
            tasks = column.parts(positions)
            if not self.local:
                column.fetch(tasks)
        return tasks

    @contextmanager
    def _naming(self, frames: list[int]) -> Iterator[None]:
        """Add the field and the frames to errors, and turn errors of inconsistent columns into a
        FormatError.
        """
        where = (
            f"{self.where}: field {self.packing.entry.name}, frame {', '.join(map(str, frames))}"
        )
        with reading(where, "the columns of a frame", "the store is damaged"), within(where):
            yield

    def _position(self, frame: int) -> int:
        if frame not in self._positions:
            raise MissingDataError(
                self.where, expected=f"frame {frame}", found=f"{len(self.frames)} frames without it"
            )
        return self._positions[frame]


@dataclass
class FramePart:
    """A frame's part of a column.

    Attributes:
        chunks: numbers of the chunks that hold it.
        count: elements of the frame.
        fetched: the bytes of the chunks, if they are already fetched.
    """

    chunks: range
    count: int
    fetched: list[memoryview] | None = None


@dataclass(eq=False)
class StoredColumn:
    """One array of a field, and the chunks of each frame in it.

    Attributes:
        column: description of the column.
        array: the chunks.
        firsts: number of the first chunk of each frame.
        counts: number of elements of each frame; for a grid, a number above 0 means that the frame
            exists.
        is_grid: whether the field has one value per voxel.
    """

    column: Column
    array: StoredArray
    firsts: list[int]
    counts: list[int]
    is_grid: bool

    def parts(self, positions: list[int]) -> list[FramePart]:
        """Return the parts that hold some frames."""
        step = self.array.step
        parts = []
        for position in positions:
            first = self.firsts[position]
            count = self.counts[position]
            chunks = min(count, 1) if self.is_grid else -(-count // step)
            if not self.is_grid:
                check_size(
                    (self.column.rows or 1, chunks, step),
                    self.array.dtype,
                    f"a frame of {self.array.name}",
                )
            parts.append(FramePart(range(first, first + chunks), count))
        return parts

    def fetch(self, tasks: list[FramePart]) -> None:
        """Fetch the chunks of all tasks at once."""
        data = iter(self.array.fetch([number for task in tasks for number in task.chunks]))
        for task in tasks:
            task.fetched = [next(data) for _ in task.chunks]

    def memory_for(self, task: FramePart, spare: list[AnyArray]) -> AnyArray:
        """Return memory to decode a frame into: a spare array of the same shape, otherwise new
        memory, which is slower to write to.
        """
        shape = (self.column.rows or 1, len(task.chunks) * self.array.step)
        while spare:
            memory = spare.pop().base
            if (
                isinstance(memory, np.ndarray)
                and memory.shape == shape
                and memory.dtype == self.array.dtype
            ):
                return memory
        return np.empty(shape, self.array.dtype)

    def decode(self, task: FramePart, out: AnyArray | None = None) -> AnyArray:
        """Decode a frame's chunks, into `out` if it is given."""
        parts = task.fetched if task.fetched is not None else self.array.fetch(task.chunks)
        if self.is_grid:
            return self._decode_chunk(
                parts[0], task.chunks[0], np.empty(self.array.chunk, self.array.dtype)
            )[0]
        step = self.array.step
        rows = self.column.rows or 1
        shape = (rows, len(parts) * step)
        dtype = self.array.dtype
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

    def _decode_chunk(self, part: memoryview, number: int, out: AnyArray) -> AnyArray:
        self.array.decode(part, number, out)
        return out


def _empty(column: Column) -> AnyArray:
    return np.empty((column.rows, 0) if column.rows else 0, column.dtype)
