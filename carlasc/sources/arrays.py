"""Packed stores of arrays: what zarr and HDF5 have in common, reading. The format is docs/storage.md, section "Arrays"."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Iterable, Mapping
from functools import cached_property
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

from carlasc import layout
from carlasc.errors import FormatError, MissingDataError
from carlasc.grids import Coordinates
from carlasc.sources.base import Sequence
from carlasc.sources.chunks import StoredArray, parallel
from carlasc.sources.packed import VERSION, Column, PackedSource, Packing, packing_of

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
    """

    location: str

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
            raise FormatError(f"{self.location}: expected the sequence that the store lists, found none: damaged store")
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

    def documents(self) -> tuple[str, ...]:
        """Return the text files that are there."""
        return self._documents

    def read_document(self, name: str) -> bytes:
        """Return a text file's bytes."""
        if name not in self._documents:
            raise MissingDataError(
                f"{self.location}: expected the text file {name}, found {', '.join(self._documents) or 'none'}"
            )
        return self.store.read_small(f"{self.group}/{document_node(name)}").tobytes()

    def _field(self, field: str) -> _PackedField:
        if field not in self._packed:
            if field not in self._fields:
                raise MissingDataError(
                    f"{self.location}: expected the field {field}, found {', '.join(sorted(self._fields)) or 'none'}"
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
            raise FormatError(f"{self.where}: expected the field that the sequence lists, found nothing: damaged store")
        self.packing: Packing = packing_of(layout.field_named(field), attributes=attributes)
        if attributes.get("kind") != self.packing.kind:
            raise FormatError(
                f"{self.where}: expected a field of kind {self.packing.kind}, found {attributes.get('kind')!r}"
            )
        self.frames: NDArray[np.int64] = store.read_small(f"{node}/frames").astype(np.int64)
        self._positions = {frame: position for position, frame in enumerate(self.frames.tolist())}

    @cached_property
    def columns(self) -> dict[str, tuple[Column, StoredArray, NDArray[np.int64]]]:
        """Each column that is stored, with where each frame starts and ends in it: (F, 2)."""
        found = {}
        for column in self.packing.columns:
            node = f"{self.node}/{column.name}"
            if self.store.attributes(node) is None:
                continue  # no frame needed it
            array = self.store.array(node)
            if self.packing.kind == "grid":
                starts = np.arange(len(self.frames), dtype=np.int64)
                spans = np.stack([starts, starts + 1], axis=1)
            else:
                spans = self.store.read_small(f"{node}_offsets").astype(np.int64)
            if (
                spans.shape != (len(self.frames), 2)
                or spans.min(initial=0) < 0
                or spans.max(initial=0) > array.shape[array.axis]
            ):
                raise FormatError(
                    f"{self.where}/{column.name}: expected offsets of {len(self.frames)} frames inside the array, found others"
                )
            found[column.name] = column, array, spans
        return found

    def read(self, frames: list[int]) -> list[NDArray[Any]]:
        """Read frames: fetch the chunks of a column all at once, decode frame by frame."""
        positions = [self._position(frame) for frame in frames]
        fetched: dict[str, list[tuple[range, list[memoryview]]]] = {}
        for name, (_, array, spans) in self.columns.items():
            numbers = [_chunks(array.step, *spans[position].tolist()) for position in positions]
            try:
                parts = iter(array.fetch([number for chunks in numbers for number in chunks]))
            except FormatError as error:
                listed = ", ".join(map(str, frames))
                raise FormatError(f"{self.where}: field {self.packing.entry.name}, frame {listed}: {error}") from error
            fetched[name] = [(chunks, [next(parts) for _ in chunks]) for chunks in numbers]

        def assemble(k: int) -> NDArray[Any]:
            try:
                return self.packing.join(
                    {
                        c.name: self._column(c, positions[k], fetched[c.name][k] if c.name in fetched else None)
                        for c in self.packing.columns
                    }
                )
            except FormatError as error:
                raise FormatError(
                    f"{self.where}: field {self.packing.entry.name}, frame {frames[k]}: {error}"
                ) from error

        return parallel(assemble, range(len(frames)))

    def _column(self, column: Column, position: int, fetched: tuple[range, list[memoryview]] | None) -> NDArray[Any]:
        """Decode a frame's part of a column."""
        if fetched is None:
            return np.empty((column.rows, 0) if column.rows else 0, column.dtype)
        _, array, spans = self.columns[column.name]
        start, end = spans[position].tolist()
        numbers, parts = fetched
        if self.packing.kind == "grid":
            out = np.empty(array.chunk, array.dtype)
            array.decode(parts[0], numbers[0], out)
            return out[0]
        rows = column.room or column.rows or 1
        whole = np.empty((rows, len(numbers) * array.step), array.dtype)
        stored = column.rows or 1
        whole[stored:] = 0
        for place, (number, part) in enumerate(zip(numbers, parts, strict=True)):
            if len(numbers) == 1:  # the rule: decode into place
                array.decode(part, number, whole[:stored].reshape(array.chunk))
            else:
                out = np.empty(array.chunk, array.dtype)
                array.decode(part, number, out)
                whole[:stored, place * array.step : (place + 1) * array.step] = out
        values = whole[:, : end - start]
        return values if column.rows else values[0]

    def _position(self, frame: int) -> int:
        if frame not in self._positions:
            raise MissingDataError(f"{self.where}: expected frame {frame}, found {len(self.frames)} frames without it")
        return self._positions[frame]


def _chunks(step: int, start: int, end: int) -> range:
    """Return the chunks of a frame, which starts at the beginning of its first one."""
    return range(start // step, -(-end // step))


def check_root(attributes: Mapping[str, Any] | None, where: str) -> Mapping[str, Any]:
    """Return a store's root attributes.

    Raises:
        FormatError: it is something else, unfinished, or of a newer version.
    """
    if attributes is None or attributes.get("type") != STORE:
        raise FormatError(f"{where}: expected a store packed by carlasc, found one without its mark (type {STORE})")
    if attributes.get("version", 0) > VERSION:
        raise FormatError(
            f"{where}: expected a store of version {VERSION} or older, found version {attributes['version']}: upgrade carlasc to read it"
        )
    if not attributes.get("complete"):
        raise FormatError(
            f"{where}: expected a finished store, found one whose packing was cut off: run the same command again to finish it"
        )
    return attributes


def field_node(field: str) -> str:
    """Return where a field stands in its sequence's group."""
    return f"grids/{field}" if "/" in field else f"scans/{field}"


def document_node(name: str) -> str:
    """Return where a text file stands in its sequence's group."""
    return f"documents/{name}"
