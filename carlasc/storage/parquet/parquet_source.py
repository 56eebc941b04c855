"""Reading packed stores of Parquet tables: one file per field, one row group per frame.

Parquet has checksums of pages, but not of the footer. With one wrong bit in a footer, pyarrow 26
terminates the process by an uncaught C++ exception. A store therefore records the checksums of its
footers, and a footer is verified before pyarrow reads it.
"""

from __future__ import annotations

import math
import zlib
from collections.abc import Container, Iterable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from carlasc.core.arrays import AnyArray
from carlasc.errors import FormatError, MissingDataError, import_extra, reading, within
from carlasc.storage import layout
from carlasc.storage.arrays import check_ratio, check_size
from carlasc.storage.files import damaged, parse_json
from carlasc.storage.packed.output import TABLES_MARK
from carlasc.storage.packed.stores import PackedSequence, PackedSource, check_scale
from carlasc.storage.parquet.table_columns import column_types, join_columns
from carlasc.storage.protocol import Sequence
from carlasc.storage.transport.remote_tree import RemoteTree
from carlasc.storage.transport.trees import LocalTree, Tree

SEQUENCE = "sequence.json"  # written last: a folder with this file holds a whole sequence
NUMBER = (
    "number"  # key for the number of the sequence, the value of the column `sequence` in the tables
)
FOOTERS = "footers"  # key for the checksums of the footers of the tables
FRAMES = "frames.parquet"  # one row per frame
DOCUMENTS = "documents.parquet"  # one row per text file
_END = 8  # bytes: the length of the footer, and "PAR1"
_MARK = b"PAR1"
_LONGEST = 1 << 28  # bytes; the footer of ten thousand frames has a few megabytes


class ParquetSource(PackedSource):
    """A folder of packed Parquet tables."""

    def __init__(self, tree: Tree) -> None:
        """Read the mark file of the store.

        Raises:
            DependencyError: pyarrow is not installed.
            FormatError: the store is unfinished, or has another version.
        """
        import_extra("pyarrow.parquet", "parquet")
        super().__init__(
            tree.location, parse_json(bytes(tree.read(TABLES_MARK)), tree.where(TABLES_MARK))
        )
        self.tree = tree

    def sequences(self) -> Mapping[str, Sequence]:
        """Return the sequences that the store lists."""
        return {
            path: ParquetSequence(self.tree, path, folder) for path, folder in self.nodes.items()
        }

    def _stored_bytes(self, group: str, name: str) -> int:
        folder = Path(self.location, group)
        files = [folder / f"{name}.parquet"] if name else folder.rglob("*")
        return sum(file.stat().st_size for file in files if file.is_file())


class ParquetSequence(PackedSequence["FieldTable"]):
    """One sequence of a store of tables."""

    tree: Tree

    def __init__(self, tree: Tree, path: str, folder: str) -> None:
        self.tree = tree
        self.folder = folder
        where = f"{folder}/{SEQUENCE}"
        about = parse_json(bytes(tree.read(where)), tree.where(where))
        super().__init__(path, tree.where(folder), about)
        self._footers = about.get(FOOTERS)

    def read(self, field: str, frame: int) -> AnyArray:
        """Read one row group."""
        table = self._field(field)
        per_voxel = layout.field_named(field).per == "voxel"
        grid = field.rpartition("/")[0]
        if per_voxel and grid not in self.grids:
            where = f"{self.location}/{layout.params_file(grid)}"
            raise damaged(where, "the geometry of the grid", "none")
        return table.read(frame, self.grids[grid].size if per_voxel else None)

    def files_of(self, field: str, frames: Iterable[int]) -> list[str]:
        """Return the table of a field."""
        return [f"{self.folder}/{field}.parquet"]

    def read_document(self, name: str) -> bytes:
        """Return a text file's bytes."""
        self._check_listed("text file", self._documents, name)
        path = f"{self.folder}/{DOCUMENTS}"
        self._check_footer(DOCUMENTS)
        with opened(self.tree, path) as file:
            columns = ["name", "data"]
            for number in range(file.metadata.num_row_groups):
                _check_ratios(file.metadata.row_group(number), columns, self.tree.where(path))
            rows = file.read(columns, use_threads=False).to_pylist()
            data = next((row["data"] for row in rows if row["name"] == name), None)
        if not isinstance(data, bytes):
            raise damaged(self.tree.where(path), f"the text file {name}", "none")
        return data

    def _check_footer(self, name: str) -> None:
        found = self._footers.get(name) if isinstance(self._footers, dict) else None
        check_footer(self.tree, f"{self.folder}/{name}", found)

    def _open_field(self, field: str) -> FieldTable:
        self._check_footer(f"{field}.parquet")
        return FieldTable(self.tree, f"{self.folder}/{field}.parquet", field)


class FieldTable:
    """The file of one field. Its footer is read once, and a row group per frame."""

    def __init__(self, tree: Tree, path: str, field: str) -> None:
        self.tree = tree
        self.path = path
        self.field = field
        self.where = tree.where(path)
        with opened(tree, path) as file:
            self._metadata = file.metadata
            written = parse_json(file.metadata.metadata[b"carlasc"], self.where)
            about = check_attributes(written, self.where)
            self._types = column_types(layout.field_named(field), about)
            _check_types(file.schema_arrow, self._types, self.where)
        self._dtypes = {
            name: np.dtype("u1" if type_ == "binary" else type_)
            for name, type_ in self._types.items()
        }
        self.attributes = about
        frames, rows = (_counts(about.get(name)) for name in ("frames", "rows"))
        if not frames or len(frames) != len(rows) or (np.diff(frames) <= 0).any():
            raise damaged(
                self.where,
                "ascending frame numbers, and the number of rows of each",
                "other values",
            )
        self.frames = np.array(frames, np.int64)
        groups = np.cumsum(np.array(rows, np.int64) > 0) - 1  # an empty frame has none
        self._groups = dict(zip(frames, zip(groups.tolist(), rows, strict=True), strict=True))

    def read(self, frame: int, shape: tuple[int, ...] | None) -> AnyArray:
        """Read one frame; reshaped to `shape` if given."""
        if frame not in self._groups:
            raise MissingDataError(
                self.where, expected=f"frame {frame}", found=f"{len(self.frames)} frames without it"
            )
        rows = self._groups[frame][1]
        where = f"{self.where}: field {self.field}, frame {frame}"
        if shape is not None and rows != math.prod(shape):
            raise damaged(where, f"{math.prod(shape)} voxels", str(rows))
        if shape is None:  # the only limit is the size of the largest possible scan
            for dtype in self._dtypes.values():
                check_size((rows,), dtype, where)
        columns = {name: np.empty(0, dtype) for name, dtype in self._dtypes.items()}
        if rows:
            columns = self._read_group(frame, where)
        with reading(where, "values of the field", "the store is damaged"):
            array = join_columns(layout.field_named(self.field), columns, self.attributes)
            return array if shape is None else array.reshape(shape)

    def _read_group(self, frame: int, where: str) -> dict[str, AnyArray]:
        """Return the columns of a frame.

        The numbers of rows and bytes are checked before decompressing.
        """
        group, rows = self._groups[frame]
        with reading(where, "the rows of a frame", "the file may be truncated or corrupted"):
            about = (
                self._metadata.row_group(group) if group < self._metadata.num_row_groups else None
            )
            if about is None or about.num_rows != rows:
                found = "none" if about is None else str(about.num_rows)
                raise damaged(where, f"{rows} rows", found)
            _check_ratios(about, self._types, where)
        with (
            within(f"field {self.field}, frame {frame}"),
            opened(self.tree, self.path, self._metadata) as file,
        ):
            table = file.read_row_group(group, columns=list(self._types), use_threads=False)
            columns = {name: _to_numpy(table[name]) for name in self._types}
        for name, column in columns.items():
            is_bytes = self._types[name] == "binary"
            if len(column) != rows or column.dtype != (object if is_bytes else self._dtypes[name]):
                raise FormatError(
                    where,
                    expected=f"{rows} values of {self._types[name]} in {name}",
                    found=f"{len(column)} of {column.dtype}",
                )
        return columns


def _check_ratios(group: Any, names: Container[str], where: str) -> None:
    """Check the compression ratios of the named columns of a row group."""
    for column in map(group.column, range(group.num_columns)):
        if column.path_in_schema in names:
            check_ratio(column.total_uncompressed_size, column.total_compressed_size, where)


@contextmanager
def opened(tree: Tree, path: str, metadata: Any = None) -> Iterator[Any]:
    """Open a Parquet file. If `metadata` is given, the footer is not read again.

    Raises:
        FormatError: it does not exist, is truncated, or the checksum of a page does not match.
    """
    parquet = import_extra("pyarrow.parquet", "parquet")
    where = tree.where(path)
    try:
        place = tree.open(path) if isinstance(tree, RemoteTree) else where
        with (
            reading(where, "a Parquet file", "the file may be truncated or corrupted"),
            parquet.ParquetFile(place, metadata=metadata, page_checksum_verification=True) as file,
        ):
            yield file
    except FormatError as error:
        if isinstance(error.__cause__, FileNotFoundError):
            raise damaged(where, "the table that the sequence lists", "none") from error
        raise


def check_attributes(about: Any, where: str) -> Mapping[str, Any]:
    """Return the checked attributes in the footer of a table.

    Raises:
        FormatError: they are missing, the step of coordinates is not a valid length, or labels do
            not have one or two bytes.
    """
    check_scale(about, where)
    label_bytes = about.get("label_bytes", 1)
    if label_bytes not in (1, 2):
        raise damaged(where, "labels of 1 or 2 bytes", repr(label_bytes))
    return {**about, "label_bytes": label_bytes}


def footer_checksum(tree: Tree, path: str) -> int:
    """Return the CRC-32 of the footer of a table, including its length and the mark at the end.

    Raises:
        MissingDataError: the file does not exist.
        FormatError: the end of the file is not that of a Parquet file.
    """
    end = bytes(tree.read_range(path, -_END, 0))
    if len(end) != _END or not end.endswith(_MARK):
        raise damaged(
            tree.where(path), "a Parquet file", "another end of the file", "it may be truncated"
        )
    length = int.from_bytes(end[:4], "little")
    if length > _LONGEST:
        raise FormatError(
            tree.where(path), expected=f"a footer of at most {_LONGEST} bytes", found=length
        )
    return zlib.crc32(tree.read_range(path, -_END - length, 0))


def footer_checksums(folder: Path) -> dict[str, int]:
    """Return the checksum of the footer of each table below a local folder, by relative path."""
    tree = LocalTree(folder, mapped=False)
    paths = sorted(path.relative_to(folder).as_posix() for path in folder.rglob("*.parquet"))
    return {path: footer_checksum(tree, path) for path in paths}


def check_footer(tree: Tree, path: str, expected: object) -> None:
    """Verify the footer of a table.

    Raises:
        FormatError: its checksum does not match, or the table does not exist.
    """
    try:
        found = footer_checksum(tree, path)
    except MissingDataError as error:
        raise damaged(tree.where(path), "the table that the sequence lists", "none") from error
    if found != expected:
        raise FormatError(
            tree.where(path),
            problem="the checksum of the footer does not match",
            advice="the store is corrupted: fetch or pack it again",
        )


def _check_types(schema: Any, types: Mapping[str, str], where: str) -> None:
    found = {
        name: str(schema.field(name).type) if name in schema.names else "nothing" for name in types
    }
    # pyarrow calls float32 "float" and float64 "double"
    short = {"float32": "float", "float64": "double", "float16": "halffloat"}
    for name, type_ in types.items():
        if found[name] != short.get(type_, type_):
            raise damaged(where, f"{type_} in {name}", found[name])


def _counts(values: object) -> list[int]:
    """Return a list of numbers from JSON; empty if it is anything else."""
    right = isinstance(values, list) and all(
        type(value) is int and 0 <= value < 2**48 for value in values
    )
    return values if right else []  # type: ignore[return-value]


def _to_numpy(column: Any) -> AnyArray:
    """Return a column of a row group, without a copy if it has one chunk and no missing values."""
    return np.asarray(
        column.chunk(0).to_numpy(zero_copy_only=False)
        if column.num_chunks == 1
        else column.to_numpy()
    )
