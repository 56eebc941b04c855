"""Reading packed stores of Parquet tables: one file per field, one row group per frame."""

from __future__ import annotations

import json
import os
from collections import Counter
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from carlasc.errors import FormatError, MissingDataError, import_extra
from carlasc.storage import layout
from carlasc.storage.files import parse_json
from carlasc.storage.folders.trees import RemoteTree, Tree
from carlasc.storage.packed.output import TABLES_MARK
from carlasc.storage.packed.protocol import PackedSequence, PackedSource
from carlasc.storage.packed.tables.columns import table_field
from carlasc.storage.protocol import Sequence

SEQUENCE = "sequence.json"  # written last: a folder with this file holds a whole sequence
FRAMES = "frames.parquet"  # one row per frame
DOCUMENTS = "documents.parquet"  # one row per text file


class ParquetSource(PackedSource):
    """A folder of packed Parquet tables."""

    def __init__(self, tree: Tree) -> None:
        """Read the file that marks the store.

        Raises:
            DependencyError: pyarrow is not installed.
            FormatError: the store is unfinished, or of a newer version.
        """
        import_extra("pyarrow.parquet", "parquet")
        super().__init__(tree.location, parse_json(bytes(tree.read(TABLES_MARK)), tree.where(TABLES_MARK)))
        self.tree = tree

    def sequences(self) -> Mapping[str, Sequence]:
        """Return the sequences that the store lists."""
        return {path: ParquetSequence(self.tree, path, folder) for path, folder in self.nodes.items()}

    def stored_bytes(self) -> dict[str, int]:
        """Return the bytes of each field's file; for a local folder only."""
        sizes: Counter[str] = Counter()
        for path, sequence in self.sequences().items():
            folder = Path(self.location) / self.nodes[path]
            sizes["documents"] += (folder / DOCUMENTS).stat().st_size
            for field in sequence.fields():
                sizes[field] += (folder / f"{field}.parquet").stat().st_size
        files = (Path(folder) / name for folder, _, names in os.walk(self.location) for name in names)
        return dict(sizes) | {"index": sum(file.stat().st_size for file in files) - sizes.total()}


class ParquetSequence(PackedSequence["_Table"]):
    """One sequence of a store of tables."""

    tree: Tree

    def __init__(self, tree: Tree, path: str, folder: str) -> None:
        self.tree = tree
        self.folder = folder
        where = f"{folder}/{SEQUENCE}"
        super().__init__(path, tree.where(folder), parse_json(bytes(tree.read(where)), tree.where(where)))

    def read(self, field: str, frame: int) -> NDArray[Any]:
        """Read one row group."""
        table = self._field(field)
        per_voxel = layout.field_named(field).per == "voxel"
        return table.read(frame, self.grids[field.rpartition("/")[0]].size if per_voxel else None)

    def read_document(self, name: str) -> bytes:
        """Return a text file's bytes."""
        self._check_document(name)
        with opened(self.tree, f"{self.folder}/{DOCUMENTS}") as file:
            rows = file.read(use_threads=False).to_pylist()
        return next(row["data"] for row in rows if row["name"] == name)

    def _open_field(self, field: str) -> _Table:
        return _Table(self.tree, f"{self.folder}/{field}.parquet", field)


class _Table:
    """One field's file: its footer is read once, a row group when its frame is read."""

    def __init__(self, tree: Tree, path: str, field: str) -> None:
        self.tree = tree
        self.path = path
        self.field = field
        self.where = tree.where(path)
        with opened(tree, path) as file:
            self._metadata = file.metadata
            about = json.loads(file.metadata.metadata[b"carlasc"])
        self.attributes = about
        self.frames = np.array(about["frames"], np.int64)
        groups = np.cumsum(np.array(about["rows"], np.int64) > 0) - 1  # an empty frame has none
        self._groups = dict(zip(about["frames"], zip(groups.tolist(), about["rows"], strict=True), strict=True))

    def read(self, frame: int, shape: tuple[int, ...] | None) -> NDArray[Any]:
        if frame not in self._groups:
            raise MissingDataError(self.where, expected=f"frame {frame}", found=f"{len(self.frames)} frames without it")
        group, rows = self._groups[frame]
        kind = table_field(self.field)
        columns = {
            name: np.empty(0, dtype if dtype != "binary" else "u1")
            for name, dtype in kind.columns(self.attributes).items()
        }
        if rows:
            try:
                with opened(self.tree, self.path, self._metadata) as file:
                    table = file.read_row_group(group, columns=list(columns), use_threads=False)
            except FormatError as error:
                raise error.within(f"field {self.field}, frame {frame}") from error
            if table.num_rows != rows:
                raise FormatError(
                    f"{self.where}: field {self.field}, frame {frame}",
                    expected=f"{rows} rows",
                    found=str(table.num_rows),
                )
            columns = {name: _to_numpy(table[name]) for name in columns}
        array = kind.join(columns, self.attributes)
        if shape is not None and array.size != int(np.prod(shape)):
            raise FormatError(
                f"{self.where}: field {self.field}, frame {frame}",
                expected=f"{np.prod(shape)} voxels",
                found=str(array.size),
            )
        return array if shape is None else array.reshape(shape)


@contextmanager
def opened(tree: Tree, path: str, metadata: Any = None) -> Iterator[Any]:
    """Open a Parquet file; its footer is not read again where `metadata` is given.

    Raises:
        FormatError: it does not exist, is truncated, or the checksum of a page does not match.
    """
    parquet = import_extra("pyarrow.parquet", "parquet")
    where = tree.where(path)
    try:
        place = tree.open(path) if isinstance(tree, RemoteTree) else where
        with parquet.ParquetFile(place, metadata=metadata, page_checksum_verification=True) as file:
            yield file
    except FileNotFoundError as error:
        raise FormatError(
            where, expected="the table that the sequence lists", found="none", advice="the store is damaged"
        ) from error
    except FormatError:
        raise
    except (OSError, ValueError) as error:  # pyarrow's errors are subclasses of these
        raise FormatError(
            where, problem=f"cannot be read as Parquet: {error}", advice="is it truncated or corrupted?"
        ) from error


def _to_numpy(column: Any) -> NDArray[Any]:
    """Return a row group's column, without a copy where it has one chunk and no missing values."""
    return np.asarray(column.chunk(0).to_numpy(zero_copy_only=False) if column.num_chunks == 1 else column.to_numpy())
