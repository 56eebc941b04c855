"""Reading packed stores in zarr v3: sharded arrays, consolidated metadata, codecs of the core specification.

Any zarr v3 library reads them. Here, the shards' indices and chunks are read directly, which takes a tenth of zarr-python's time per chunk.
"""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Callable, Iterable, Mapping
from functools import cached_property
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from carlasc.errors import FormatError, MissingDataError, import_extra, reading
from carlasc.storage.files import parse_json
from carlasc.storage.packed.arrays.fields import FieldLayout, open_field
from carlasc.storage.packed.arrays.reading import (
    ArrayField,
    ArraySequence,
    ArraySource,
    ArrayStore,
    check_frames,
    document_node,
    field_node,
)
from carlasc.storage.packed.arrays.shards import ZarrArray
from carlasc.storage.packed.arrays.version1 import OffsetsSequence
from carlasc.storage.packed.arrays.zarr_metadata import METADATA
from carlasc.storage.transport.remote_tree import RemoteTree
from carlasc.storage.transport.trees import Tree

_T = TypeVar("_T")


class ZarrSource(ArraySource):
    """A packed zarr store: a folder, a URL, or a zip of either."""

    newest = 2

    def __init__(self, tree: Tree) -> None:
        """Read the store's metadata.

        Raises:
            DependencyError: zarr's codecs are not installed.
            FormatError: it is another zarr store, unfinished, or of a newer version.
        """
        for module in ("numcodecs", "google_crc32c"):
            import_extra(module, "zarr")
        super().__init__(ZarrStore(tree))
        self.block = (self.store.attributes("") or {}).get("block", 1)
        if type(self.block) is not int or not 0 < self.block < 2**31:
            raise FormatError(
                tree.location,
                expected="a number of frames in block",
                found=repr(self.block),
                advice="the store is damaged",
            )

    def published_bytes(self) -> dict[str, int]:
        """Return the bytes that the published files of each field have, from the numbers of elements of the frames."""
        sizes: Counter[str] = Counter()
        for sequence in self.sequences().values():
            if isinstance(sequence, ZarrSequence):
                sizes["documents"] += sum(len(sequence.read_document(name)) for name in sequence.documents())
                for field in sorted(sequence.fields()):
                    sizes[field] += sequence.published_bytes(field)
        return dict(sizes)

    def _sequence(self, path: str, group: str) -> ArraySequence:
        kind = OffsetsSequence if self.version == 1 else ZarrSequence
        return kind(self.store, path, group)


class ZarrStore(ArrayStore):
    """The nodes of a finished zarr store, whose metadata are all in its root."""

    def __init__(self, tree: Tree) -> None:
        self.tree = tree
        self.location = tree.location
        self.local = not isinstance(tree, RemoteTree)

    @cached_property
    def _root(self) -> dict[str, Any]:
        return parse_json(bytes(self.tree.read(METADATA)), self.tree.where(METADATA))

    @cached_property
    def _sizes(self) -> dict[str, int]:
        return self.tree.sizes() if isinstance(self.tree, RemoteTree) else {}

    def forget(self) -> None:
        """Forget the metadata: they are read again."""
        vars(self).pop("_root", None)

    def attributes(self, node: str) -> dict[str, Any] | None:
        """Return a node's attributes."""
        metadata = self._metadata(node)
        if metadata is None:
            return None
        return _mapping(metadata.get("attributes", {}), f"{self.location}/{node}", "attributes")

    def read_small(self, node: str) -> NDArray[Any]:
        """Return an array of one chunk."""
        array = self.array(node)
        if 0 in array.shape:
            with reading(f"{self.location}/{node}", "the shape of an array"):
                return np.empty(array.shape, array.dtype)
        try:
            return array.read_chunk(0)[tuple(slice(n) for n in array.shape)]
        except FormatError as error:
            raise error.within(f"{self.location}/{node}") from error

    def array(self, node: str) -> ZarrArray:
        """Return an array whose chunks can be read."""
        metadata = self._metadata(node)
        if metadata is None or metadata.get("node_type") != "array":
            raise FormatError(
                f"{self.location}/{node}",
                expected="an array",
                found="none" if metadata is None else "a group",
                advice="the store is damaged",
            )
        return ZarrArray.from_metadata(self.tree, node, metadata)

    def stored_bytes(self, node: str) -> int:
        """Return the bytes of the files below a node; for a folder only."""
        if isinstance(self.tree, RemoteTree):
            prefix = f"{node}/" if node else ""
            return sum(size for path, size in self._sizes.items() if path.startswith(prefix))
        files = os.walk(f"{self.location}/{node}")
        return sum((Path(folder) / name).stat().st_size for folder, _, names in files for name in names)

    def _metadata(self, node: str) -> dict[str, Any] | None:
        if not node:
            return self._root
        consolidated = self._root.get("consolidated_metadata")
        if consolidated:
            where = self.tree.where(METADATA)
            nodes = _mapping(_mapping(consolidated, where, "consolidated_metadata").get("metadata"), where, "metadata")
            return None if node not in nodes else _mapping(nodes[node], f"{self.location}/{node}", "metadata")
        path = f"{node}/{METADATA}"
        return parse_json(bytes(self.tree.read(path)), self.tree.where(path)) if self.tree.is_file(path) else None

    def __getstate__(self) -> dict[str, Any]:
        return {key: value for key, value in self.__dict__.items() if key not in ("_root", "_sizes")}


def _mapping(value: Any, where: str, name: str) -> dict[str, Any]:
    if not isinstance(value, dict):
        raise FormatError(
            where, expected=f"an object in {name}", found=type(value).__name__, advice="the store is damaged"
        )
    return value


class ZarrSequence(ArraySequence):
    """One sequence of a zarr store of version 2: one table says how many elements each frame has in each column."""

    store: ZarrStore

    def read(self, field: str, frame: int) -> NDArray[Any]:
        """Read one field of one frame."""
        return self._read_again(lambda: super(ZarrSequence, self).read(field, frame))

    def read_many(self, field: str, frames: Iterable[int]) -> list[NDArray[Any]]:
        """Read several frames: fetched together, decoded in parallel."""
        numbers = list(frames)
        return self._read_again(lambda: super(ZarrSequence, self).read_many(field, numbers))

    def read_xyz(
        self, frames: Iterable[int], spare: list[NDArray[np.float32]] | None = None
    ) -> list[NDArray[np.float32]]:
        """Read points as they are stored, as planes: the 4th column is not read, and no rows are put together."""
        numbers = list(frames)
        return self._read_again(lambda: super(ZarrSequence, self).read_xyz(numbers, spare))

    def _read_again(self, read: Callable[[], _T]) -> _T:
        """Read once more, with what the store says now, where something does not fit: a store can grow while it is read."""
        try:
            return read()
        except FormatError:
            self.store.forget()
            self._readers = {}
            vars(self).pop("_counts", None)
            return read()

    @cached_property
    def _counts(self) -> tuple[NDArray[np.int64], Mapping[str, NDArray[np.int64]]]:
        """The frames of the sequence, and the number of elements of each in each column; -1 where the field lacks the frame."""
        try:
            return self._read_counts()
        except FormatError:  # what was added to the store since its metadata were read may have replaced them
            self.store.forget()
            return self._read_counts()

    def _read_counts(self) -> tuple[NDArray[np.int64], Mapping[str, NDArray[np.int64]]]:
        where = f"{self.location}/counts"
        frames = check_frames(self.store.read_small(f"{self.group}/frames").astype(np.int64), where)
        counts = self.store.read_small(f"{self.group}/counts").astype(np.int64)
        columns = (self.store.attributes(f"{self.group}/counts") or {}).get("columns")
        columns = columns if isinstance(columns, list) else []
        if counts.shape != (len(frames), len(columns)) or not all(isinstance(name, str) for name in columns):
            raise FormatError(
                where, expected=f"({len(frames)}, {len(columns)}) numbers of elements, of rising frames", found="others",
                advice="the store is damaged",
            )  # fmt: skip
        return frames, {column: counts[:, number] for number, column in enumerate(columns)}

    def read_document(self, name: str) -> bytes:
        """Return a text file's bytes."""
        self._check_document(name)
        path = f"{self.group}/{document_node(name)}"
        try:
            return bytes(self.store.tree.read(path))
        except MissingDataError as error:
            raise FormatError(
                error.where, expected=error.expected, found=error.found, advice="the store is damaged"
            ) from error

    def published_bytes(self, field: str) -> int:
        """Return the bytes of a field's files in the published layout, from the numbers of elements."""
        return self._field(field).published_bytes()

    def _open_field(self, field: str) -> ArrayField:
        node = f"{self.group}/{field_node(field)}"
        where = f"{self.store.location}/{node}"
        block = (self.store.attributes("") or {}).get("block", 1)
        found = FieldLayout.read(where, field, self.store.attributes(node), block)
        if found.is_grid:
            self._check_grid(field, tuple(found.attributes["shape"]))
        frames, counts = self._counts
        own = {name: counts[place] for name in found.columns if (place := f"{field_node(field)}/{name}") in counts}
        return open_field(
            where, found, frames, own, lambda name: self.store.array(f"{node}/{name}"), local=self.store.local
        )

    def __getstate__(self) -> dict[str, Any]:
        state = super().__getstate__()
        state.pop("_counts", None)  # a worker reads what it needs
        return state
