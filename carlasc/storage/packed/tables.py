"""Packed stores of Parquet tables: a file a field, a row group a frame. The format is docs/storage.md, section "Tables".

Parquet's own dictionaries and byte-stream split do here what `packed` does for arrays: values keep their published types.
"""

from __future__ import annotations

import json
import os
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

from carlasc.core.grids import Coordinates
from carlasc.errors import FormatError, MissingDataError, import_extra
from carlasc.storage.files import parse_json
from carlasc.storage.folders.trees import RemoteTree, Tree
from carlasc.storage.packed.arrays import check_root
from carlasc.storage.packed.arraywriter import TABLES_MARK
from carlasc.storage.packed.store import PackedSource
from carlasc.storage.packed.tablefields import table_field
from carlasc.storage.protocol import Sequence

SEQUENCE = "sequence.json"  # written last: a sequence is whole where it stands
FRAMES = "frames.parquet"  # one row a frame
DOCUMENTS = "documents.parquet"  # one row a text file


class ParquetSource(PackedSource):
    """A folder of packed Parquet tables."""

    def __init__(self, tree: Tree) -> None:
        """Read the store's mark.

        Raises:
            DependencyError: pyarrow is not installed.
            FormatError: it is unfinished, or of a newer version.
        """
        import_extra("pyarrow.parquet", "parquet")
        self.tree = tree
        self.location = tree.location
        self._root = check_root(parse_json(bytes(tree.read(TABLES_MARK)), tree.where(TABLES_MARK)), tree.location)

    def sequences(self) -> Mapping[str, Sequence]:
        """Return the sequences that the store lists."""
        return {
            path: ParquetSequence(self.tree, path, folder) for path, folder in sorted(self._root["sequences"].items())
        }

    def stored_bytes(self) -> dict[str, int]:
        """Return the bytes of each field's file; of a folder of this machine only."""
        sizes: Counter[str] = Counter()
        for sequence in cast(Iterable[ParquetSequence], self.sequences().values()):
            folder = Path(self.location) / sequence.folder
            sizes["documents"] += (folder / DOCUMENTS).stat().st_size
            for field in sequence.fields():
                sizes[field] += (folder / f"{field}.parquet").stat().st_size
        files = (Path(folder) / name for folder, _, names in os.walk(self.location) for name in names)
        return dict(sizes) | {"index": sum(file.stat().st_size for file in files) - sizes.total()}


class ParquetSequence(Sequence):
    """One sequence of a store of tables."""

    def __init__(self, tree: Tree, path: str, folder: str) -> None:
        self.tree = tree
        self.path = path
        self.folder = folder
        self.location = tree.where(folder)
        about = parse_json(bytes(tree.read(f"{folder}/{SEQUENCE}")), tree.where(f"{folder}/{SEQUENCE}"))
        self.split, self.name = about["split"], about["name"]
        self.coordinates = cast(Coordinates, about["coordinates"])
        self._fields = frozenset(about["fields"])
        self._documents = tuple(about["documents"])
        self._tables: dict[str, _Table] = {}

    def fields(self) -> frozenset[str]:
        """Return the fields with at least one frame."""
        return self._fields

    def frames(self, field: str) -> NDArray[np.int64]:
        """Return the frames of a field."""
        return self._table(field).frames if field in self._fields else np.empty(0, np.int64)

    def read(self, field: str, frame: int) -> NDArray[Any]:
        """Read one row group."""
        if field not in self._fields:
            raise MissingDataError(
                self.location, expected=f"the field {field}", found=f"{', '.join(sorted(self._fields)) or 'none'}"
            )
        shape = self.grids[field.rpartition("/")[0]].size if field.endswith(("/labels", "/counts")) else None
        return self._table(field).read(frame, shape)

    def documents(self) -> tuple[str, ...]:
        """Return the text files that are there."""
        return self._documents

    def read_document(self, name: str) -> bytes:
        """Return a text file's bytes."""
        if name not in self._documents:
            found = ", ".join(self._documents) or "none"
            raise MissingDataError(self.location, expected=f"the text file {name}", found=f"{found}")
        with opened(self.tree, f"{self.folder}/{DOCUMENTS}") as file:
            rows = file.read(use_threads=False).to_pylist()
        return next(row["data"] for row in rows if row["name"] == name)

    def _table(self, field: str) -> _Table:
        if field not in self._tables:
            self._tables[field] = _Table(self.tree, f"{self.folder}/{field}.parquet", field)
        return self._tables[field]

    def __getstate__(self) -> dict[str, Any]:
        return self.__dict__ | {"_tables": {}}  # pyarrow's metadata are looked up again


class _Table:
    """One field's file: its footer is read once, a frame's row group when it is asked for."""

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
                raise FormatError(f"{error} (field {self.field}, frame {frame})") from error
            if table.num_rows != rows:
                raise FormatError(
                    f"{self.where}: field {self.field}, frame {frame}",
                    expected=f"{rows} rows",
                    found=f"{table.num_rows}",
                )
            columns = {name: _to_numpy(table[name]) for name in columns}
        array = kind.join(columns, self.attributes)
        if shape is not None and array.size != int(np.prod(shape)):
            raise FormatError(
                f"{self.where}: field {self.field}, frame {frame}",
                expected=f"{np.prod(shape)} voxels",
                found=f"{array.size}",
            )
        return array if shape is None else array.reshape(shape)


@contextmanager
def opened(tree: Tree, path: str, metadata: Any = None) -> Iterator[Any]:
    """Open a Parquet file for one look; its footer need not be read again where it is known.

    Raises:
        FormatError: it is not there, cut short, or a page's checksum does not fit.
    """
    parquet = import_extra("pyarrow.parquet", "parquet")
    where = tree.where(path)
    try:
        place = tree.open(path) if isinstance(tree, RemoteTree) else where
        with parquet.ParquetFile(place, metadata=metadata, page_checksum_verification=True) as file:
            yield file
    except FileNotFoundError as error:
        raise FormatError(
            where, expected="the table that the sequence lists", found="nothing", advice="damaged store"
        ) from error
    except (OSError, ValueError) as error:  # pyarrow's errors are kinds of these
        raise FormatError(f"{where}: cannot be read as Parquet: {error}: cut short or corrupted") from error


def _to_numpy(column: Any) -> NDArray[Any]:
    """Return a row group's column; without a copy where it is one piece without gaps."""
    return np.asarray(column.chunk(0).to_numpy(zero_copy_only=False) if column.num_chunks == 1 else column.to_numpy())
