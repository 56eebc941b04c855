"""Writing blocks of frames of a field to a zarr store, from any number of processes.

A block has one object per column and a table of its frames, which is written last. New frames are
merged with an existing object, so frames of other processes are not lost.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from carlasc.storage.files import damaged, parse_json, to_json
from carlasc.storage.packed.array_fields import ArrayField
from carlasc.storage.packed.array_layout import FieldLayout, FrameTable
from carlasc.storage.packed.stores import PackOptions
from carlasc.storage.transport.trees import LocalTarget, Target
from carlasc.storage.zarr.shards import (
    METADATA,
    ZarrArray,
    column_metadata,
    encode_chunk,
    group_metadata,
    join_shard,
    split_shard,
)

BLOCKS = "blocks"  # folder of the tables
_ASKED_ONE_BY_ONE = (
    4  # up to this many blocks are looked up singly; after that, all blocks are listed
)
_FRESH_S = 1.0  # maximum age of a listing that is used for the answer "does not exist"


@dataclass(frozen=True)
class EncodedFrame:
    """An encoded frame of a field: its chunks and its number of elements, both by column."""

    counts: dict[str, int]
    chunks: dict[str, list[bytes]]


def encode_frame(field_layout: FieldLayout, array: NDArray[np.generic]) -> EncodedFrame:
    """Encode a frame for the store.

    Raises:
        FormatError: the array does not fit the field.
    """
    counts, chunks = field_layout.divide(array)
    encodings = {name: field_layout.columns[name].encoding for name in chunks}
    return EncodedFrame(
        counts,
        {
            name: [encode_chunk(chunk, encodings[name]) for chunk in parts]
            for name, parts in chunks.items()
        },
    )


@dataclass(eq=False)
class StoredField:
    """A field of a store that is being written.

    Attributes:
        node: group of the field.
        name: name of the field.
        options: options of the store.
    """

    target: Target
    node: str
    name: str
    options: PackOptions
    _layout: FieldLayout | None = None
    _tables: dict[int, FrameTable] = field(default_factory=dict)
    _listed_s: float | None = None
    _denied: set[int] = field(default_factory=set)
    _asked: int = 0

    @property
    def where(self) -> str:
        """Name of the field in errors."""
        return f"{self.target.location}/{self.node}"

    def layout(self) -> FieldLayout | None:
        """Return the layout of the field; None if the field does not exist."""
        if self._layout is None:
            path = f"{self.node}/{METADATA}"
            if (data := self.target.read(path)) is None:
                return None
            attributes = parse_json(data, self.target.tree.where(path)).get("attributes")
            self._layout = FieldLayout.read(self.where, self.name, attributes)
        return self._layout

    def create(self, typical: Callable[[], tuple[int, ...]]) -> FieldLayout:
        """Return the layout of the field.

        A new field is created; if several processes create it, the first one decides the layout.

        Args:
            typical: returns the shape of a grid, or (number of elements of a typical frame,).
        """
        if (field_layout := self.layout()) is not None:
            return field_layout
        planned = FieldLayout.plan(self.name, self.options, typical())
        self.target.put(
            f"{self.node}/{METADATA}", to_json(group_metadata(planned.attributes)), create=True
        )
        return self._known_layout()

    def _known_layout(self) -> FieldLayout:
        if (field_layout := self.layout()) is None:
            raise damaged(self.where, "the field", "none", "another program removed it")
        return field_layout

    def has(self, frame: int) -> bool:
        """Whether a frame exists.

        The first few blocks are looked up singly, then all blocks are listed. A listing is used for
        "no" at most once per frame and for at most a second, because other processes write
        meanwhile.
        """
        block = frame // self.options.block
        if self._exists(frame):
            return True
        if self._listed_s is not None:
            outdated = frame in self._denied or time.monotonic() - self._listed_s > _FRESH_S
        else:
            outdated = frame in self._denied or (
                block not in self._tables and self._asked >= _ASKED_ONE_BY_ONE
            )
        if outdated:
            self._list()
        elif self._listed_s is None and block not in self._tables:
            self._tables[block] = self.table(block)
            self._asked += 1
        if self._exists(frame):
            return True
        self._denied.add(frame)
        return False

    def refresh(self) -> None:
        """Discard the cached lists of missing frames."""
        whole = {
            block: table
            for block, table in self._tables.items()
            if len(table) == self.options.block
        }
        self._tables = dict(whole)
        self._listed_s = None
        self._denied = set()
        self._asked = 0

    def _exists(self, frame: int) -> bool:
        return frame in self._tables.get(frame // self.options.block, {})

    def _list(self) -> None:
        """Read the tables of all blocks that may have changed."""
        tables = {
            path: block
            for path in self.target.paths(f"{self.node}/{BLOCKS}")
            if (block := block_of(path)) is not None
        }
        changed = [
            path
            for path, block in tables.items()
            if len(self._tables.get(block, {})) < self.options.block
        ]
        for path, data in zip(changed, self.target.tree.read_many(changed), strict=True):
            self._tables[tables[path]] = self._parse(data, path)
        self._listed_s = time.monotonic()
        self._denied = set()

    def table(self, block: int) -> FrameTable:
        """Read the table of a block; empty if the block does not exist."""
        path = table_path(self.node, block)
        return self._parse(self.target.read(path) or b"", path)

    def _parse(self, data: bytes | memoryview, path: str) -> FrameTable:
        """Return a table; empty for an empty file, which a power failure can leave.

        The block is then written again.
        """
        return parse_table(bytes(data), self.target.tree.where(path)) if data else {}

    def read(self, frame: int) -> NDArray[np.generic] | None:
        """Read a frame; None if it does not exist."""
        block = frame // self.options.block
        field_layout = self.layout()
        if field_layout is None:
            return None
        if not self._exists(frame):
            self._tables[block] = self.table(block)
        needed = self._tables[block].get(frame)
        if needed is None:
            return None
        found = ArrayField(
            self.where,
            field_layout,
            np.array([frame]),
            {name: np.array([needed.get(name, 0)]) for name in field_layout.columns},
            lambda name: self._array(field_layout, name, block),
            local=isinstance(self.target, LocalTarget),
        )
        return found.read([frame])[0]

    def _array(self, field_layout: FieldLayout, name: str, block: int) -> ZarrArray:
        size = self.options.block
        metadata = column_metadata(
            field_layout, field_layout.columns[name], size, (block + 1) * size
        )
        return ZarrArray.from_metadata(self.target.tree, f"{self.node}/{name}", metadata)

    def columns(self, block: int, frames: Mapping[int, EncodedFrame]) -> list[str]:
        """Return the columns whose object changes when frames are written to a block: columns that
        they use, or used before.
        """
        before = self._tables.get(block, {})
        needed = {
            name
            for frame, encoded in frames.items()
            for name in (*encoded.chunks, *before.get(frame, {}))
        }
        return sorted(needed)

    def put_column(self, name: str, block: int, frames: Mapping[int, EncodedFrame]) -> None:
        """Write the object of one column of a block.

        Existing frames are kept, unless `frames` replaces them.
        """
        field_layout = self._known_layout()
        array = self._array(field_layout, name, block)
        slots = array.slots
        path = array.file(block)
        room = array.per_shard or 1
        places = {frame: frame % self.options.block * slots for frame in frames}
        new = {
            places[f] + k: chunk
            for f, e in frames.items()
            for k, chunk in enumerate(e.chunks.get(name, ()))
        }
        data = join_shard(new, room)
        if self.target.put(path, data, create=True):
            return
        taken = {first + k for first in places.values() for k in range(slots)}
        there = bytes(self.target.tree.read(path))
        while (merged := _merge(there, new, taken, room, self.target.tree.where(path))) != there:
            self.target.put(path, merged)
            # read again, because another process may have replaced it
            there = bytes(self.target.tree.read(path))

    def put_table(self, block: int, frames: Mapping[int, EncodedFrame]) -> None:
        """Write the table of a block, including its existing frames.

        Its objects must be complete.
        """
        path = table_path(self.node, block)
        ours = {f: e.counts for f, e in frames.items()}
        self._tables[block] = ours
        if not self.target.put(path, format_table(ours), create=True):
            while (there := self.table(block)) | ours != there:
                self.target.put(path, format_table(there | ours))
            self._tables[block] = there

    def remove(self, frames: set[int]) -> None:
        """Remove frames from the tables of their blocks."""
        for block in {frame // self.options.block for frame in frames}:
            path = table_path(self.node, block)
            there = self.table(block)
            self._tables[block] = {f: counts for f, counts in there.items() if f not in frames}
            if not self._tables[block]:
                self.target.remove(path)
            elif self._tables[block] != there:
                self.target.put(path, format_table(self._tables[block]))


def _merge(there: bytes, new: Mapping[int, bytes], taken: set[int], room: int, where: str) -> bytes:
    """Return the bytes of a shard with new chunks, and with the existing chunks whose slots are not
    in `taken`.
    """
    # a power failure can leave an empty file
    there_now = split_shard(there, room, where) if there else {}
    kept = {slot: chunk for slot, chunk in there_now.items() if slot not in taken}
    return join_shard({**kept, **new}, room)


def table_path(node: str, block: int) -> str:
    """Return the path of the table of a block."""
    return f"{node}/{BLOCKS}/{block:06d}.json"


def block_of(path: str) -> int | None:
    """Return the number of the block whose table is at a path; None if the path is not that of a
    table.
    """
    folder, _, name = path.rpartition("/")
    stem = name.removesuffix(".json")
    is_table = (
        folder.rpartition("/")[2] == BLOCKS and name != stem and stem.isascii() and stem.isdigit()
    )
    return int(stem) if is_table else None


def format_table(table: FrameTable) -> bytes:
    """Return the bytes of a table: {"frames": {"17": {"xyz": 120800}, ...}}, with sorted frames and
    columns.
    """
    return to_json(
        {"frames": {str(frame): dict(sorted(table[frame].items())) for frame in sorted(table)}}
    )


def parse_table(data: bytes, where: str) -> FrameTable:
    """Read a table.

    Raises:
        FormatError: it is damaged.
    """
    try:
        frames = parse_json(data, where)["frames"]
        return {
            int(frame): {str(name): int(count) for name, count in counts.items()}
            for frame, counts in frames.items()
        }
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        advice = "remove this file and run the same command again"
        raise damaged(where, "the frames of a block", "something else", advice) from error
