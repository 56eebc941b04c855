"""Reading packed stores of arrays: zarr and HDF5."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Callable, Iterable, Mapping
from functools import cached_property
from typing import Any, TypeVar

import numpy as np

from carlasc.core.arrays import AnyArray, Float32Array, IntArray
from carlasc.errors import FormatError, within
from carlasc.storage.arrays import check_size
from carlasc.storage.files import damaged
from carlasc.storage.packed.array_fields import ArrayField
from carlasc.storage.packed.array_layout import SEQUENCE, FieldLayout, document_node, field_node
from carlasc.storage.packed.chunks import StoredArray
from carlasc.storage.packed.stores import PackedSequence, PackedSource
from carlasc.storage.transport.trees import Tree

_T = TypeVar("_T")


class ArrayStore(ABC):
    """A tree of groups and arrays to read from. It keeps no handle open between calls.

    Attributes:
        location: name of the store in errors.
        local: whether the store is on this machine.
        tree: the tree of files with the store.
    """

    location: str
    tree: Tree
    local: bool

    @abstractmethod
    def attributes(self, node: str) -> dict[str, Any] | None:
        """Return the attributes of a group or an array; None if the node does not exist."""

    @abstractmethod
    def read_small(self, node: str) -> AnyArray:
        """Return a whole array of one chunk."""

    @abstractmethod
    def read_document(self, node: str) -> bytes:
        """Return the bytes of a text file that a sequence lists."""

    @abstractmethod
    def array(self, node: str) -> StoredArray:
        """Return an array whose chunks can be read."""

    @abstractmethod
    def stored_bytes(self, node: str) -> int:
        """Return the stored bytes of a node and the nodes below it."""

    def forget(self) -> bool:
        """Discard cached metadata; return whether the store may have grown since it was opened."""
        return False


class ArraySource(PackedSource):
    """A packed store of arrays."""

    def __init__(self, store: ArrayStore) -> None:
        """Read the attributes of the store's root.

        Raises:
            FormatError: it is not a packed store, is unfinished, or has another version.
        """
        super().__init__(store.location, store.attributes(""))
        self.store = store

    def sequences(self) -> Mapping[str, ArraySequence]:
        """Return the sequences that the store lists."""
        return {path: ArraySequence(self.store, path, group) for path, group in self.nodes.items()}

    def published_bytes(self) -> dict[str, int]:
        """Return the size of the published files by field, from the numbers of elements."""
        sizes: Counter[str] = Counter()
        for sequence in self.sequences().values():
            sizes["documents"] += sum(
                len(sequence.read_document(name)) for name in sequence.documents()
            )
            for field in sorted(sequence.fields()):
                sizes[field] += sequence.published_bytes(field)
        return dict(sizes)

    def _stored_bytes(self, group: str, name: str) -> int:
        node = name if name == "documents" else field_node(name)
        return self.store.stored_bytes(f"{group}/{node}" if group else "")


class ArraySequence(PackedSequence[ArrayField]):
    """One sequence of a packed store of arrays.

    A table holds the number of elements per frame and column.
    """

    def __init__(self, store: ArrayStore, path: str, group: str) -> None:
        """Read the attributes of the sequence's group.

        Raises:
            FormatError: the group does not exist or is damaged.
        """
        self.store = store
        self.group = group
        location = f"{store.location}/{group}"
        attributes = store.attributes(group)
        if attributes is None or attributes.get("type") != SEQUENCE:
            raise damaged(location, "the sequence that the store lists", "none")
        super().__init__(path, location, attributes)
        self.tree = store.tree

    def read(self, field: str, frame: int) -> AnyArray:
        """Read one field of one frame."""
        return self.read_many(field, [frame])[0]

    def read_many(self, field: str, frames: Iterable[int]) -> list[AnyArray]:
        """Read several frames. They are fetched together and decoded in parallel."""
        numbers = list(frames)
        return self._read_again(lambda: self._field(field).read(numbers))

    def read_xyz(
        self, frames: Iterable[int], spare: list[Float32Array] | None = None
    ) -> list[Float32Array]:
        """Read the coordinates of points as contiguous planes, as they are stored.

        The 4th column is not read.
        """
        numbers = list(frames)
        return self._read_again(lambda: self._field("points").read_planes(numbers, spare or []))

    def read_document(self, name: str) -> bytes:
        """Return a text file's bytes."""
        self._check_listed("text file", self._documents, name)
        return self.store.read_document(f"{self.group}/{document_node(name)}")

    def files_of(self, field: str, frames: Iterable[int]) -> list[str]:
        """Return the files that hold a field of some frames: shards of a zarr store, the one file
        of an HDF5 store.
        """
        with within(self.location):
            return self._field(field).files_of(list(frames))

    def published_bytes(self, field: str) -> int:
        """Return the size of the published files of a field, from the numbers of elements."""
        return self._field(field).published_bytes()

    def _read_again(self, read: Callable[[], _T]) -> _T:
        """Call `read`; after an error, once more with new metadata, because the store may have
        grown meanwhile.
        """
        try:
            return read()
        except FormatError:
            if not self.store.forget():
                raise
            self._readers = {}
            vars(self).pop("_counts", None)
            return read()

    @cached_property
    def _counts(self) -> tuple[IntArray, Mapping[str, IntArray]]:
        """The frames of the sequence, and the number of elements per frame by column; -1 if the
        field lacks the frame.
        """
        try:
            return self._read_counts()
        except FormatError:  # new frames may have replaced the arrays since the metadata were read
            if not self.store.forget():
                raise
            return self._read_counts()

    def _read_counts(self) -> tuple[IntArray, Mapping[str, IntArray]]:
        where = f"{self.location}/counts"
        frames = self.store.read_small(f"{self.group}/frames").astype(np.int64)
        if frames.ndim != 1 or (np.diff(frames, prepend=-1) <= 0).any():
            raise damaged(where, "ascending frame numbers", "other values")
        counts = self.store.read_small(f"{self.group}/counts").astype(np.int64)
        columns = (self.store.attributes(f"{self.group}/counts") or {}).get("columns")
        columns = columns if isinstance(columns, list) else []
        if counts.shape != (len(frames), len(columns)) or not all(
            isinstance(name, str) for name in columns
        ):
            raise damaged(where, f"({len(frames)}, {len(columns)}) numbers of elements, with "
                                f"ascending frame numbers", "other values")  # fmt: skip
        return frames, {column: counts[:, number] for number, column in enumerate(columns)}

    def _open_field(self, field: str) -> ArrayField:
        node = f"{self.group}/{field_node(field)}"
        where = f"{self.store.location}/{node}"
        found = FieldLayout.read(where, field, self.store.attributes(node))
        if found.is_grid:
            self._check_grid(field, tuple(found.attributes["shape"]))
        frames, counts = self._counts
        own = {
            name: counts[place]
            for name in found.columns
            if (place := f"{field_node(field)}/{name}") in counts
        }
        return ArrayField(
            where,
            found,
            frames,
            own,
            lambda name: self.store.array(f"{node}/{name}"),
            local=self.store.local,
        )

    def _check_grid(self, field: str, shape: tuple[int, ...]) -> None:
        """Check that the chunks of a field of a grid have the shape of the grid in params.json.

        Raises:
            FormatError: they have another shape.
        """
        grid = self.grids.get(field.rpartition("/")[0])
        if grid is None:  # params.json is written last, and may be missing
            check_size(shape, np.dtype("<u4"), f"{self.location}: field {field}")
        elif shape != grid.size:
            raise damaged(
                f"{self.location}: field {field}",
                f"grids of shape {grid.size}, as in params.json",
                f"{shape}",
            )

    def __getstate__(self) -> dict[str, Any]:
        state = super().__getstate__()
        state.pop("_counts", None)  # a worker process reads them again
        return state
