"""Packed stores of Parquet tables, writing. The format is docs/storage.md, section "Tables"."""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from carlasc.errors import ArgumentError, FormatError, import_extra
from carlasc.storage import layout
from carlasc.storage.files import to_json, write_atomic
from carlasc.storage.packed.arrays import STORE
from carlasc.storage.packed.arraywriter import TABLES_MARK, UNFINISHED_MARK, put_in_place, refuse_existing, remove
from carlasc.storage.packed.store import VERSION, Options, PackedSink, PackedWriter
from carlasc.storage.packed.tablefields import statistics, table_field
from carlasc.storage.packed.tables import DOCUMENTS, FRAMES, SEQUENCE
from carlasc.storage.protocol import identity_of

_LEVEL = 12  # of Zstandard: from 11 on points pack better by 2 %, above 12 it takes several times longer
_PAGE = 8 << 20  # bytes: a scan's column in one page


class ParquetSink(PackedSink):
    """Writes a folder of packed Parquet tables, as a whole: it stands in its place when the sink is closed."""

    def __init__(self, path: str | os.PathLike[str], options: Options | None = None, overwrite: bool = False) -> None:
        """Start a store, or go on with one that was cut off: its finished sequences are kept.

        Raises:
            ArgumentError: `small` is asked for, which Parquet has no encoding for.
            ConflictError: something is in its place, and `overwrite` is not given.
            DependencyError: pyarrow is not installed.
        """
        import_extra("pyarrow.parquet", "parquet")
        self.path = Path(path)
        self.location = str(path)
        self.options = options or Options()
        self.overwrite = overwrite
        if self.options.small:
            raise ArgumentError(
                path,
                expected="a .zarr store with --small",
                found="Parquet, which has no PCodec",
                advice="leave --small out",
            )
        refuse_existing(self.path, overwrite)
        self._part = self.path.with_name(f"{self.path.name}.part")
        run = to_json({"lossy_mm": self.options.lossy_mm})
        if not (self._part / UNFINISHED_MARK).is_file() or (self._part / UNFINISHED_MARK).read_bytes() != run:
            remove(self._part)
            write_atomic(self._part / UNFINISHED_MARK, run)
        done = sorted(self._part.rglob(SEQUENCE))
        self._sequences = {
            json.loads(file.read_bytes())["path"]: file.parent.relative_to(self._part).as_posix() for file in done
        }

    def finished(self, path: str) -> bool:
        """Whether an earlier run, cut off later on, has written this sequence whole."""
        return path in self._sequences

    def sequence(self, path: str) -> ParquetWriter:
        """Start a sequence; what a run that was cut off left of it is removed."""
        folder = path.replace("\\", "/").strip("/") or "sequence"
        self._sequences.pop(path, None)
        remove(self._part / folder)
        return ParquetWriter(self._part, path, folder, self.options, self._sequences)

    def close(self) -> None:
        """Mark the store as whole and put it in its place."""
        root = {
            "type": STORE,
            "version": VERSION,
            "complete": True,
            "sequences": self._sequences,
            "lossy_mm": self.options.lossy_mm,
        }
        write_atomic(self._part / TABLES_MARK, to_json(root))
        (self._part / UNFINISHED_MARK).unlink()
        put_in_place(self._part, self.path, self.overwrite)


class ParquetWriter(PackedWriter):
    """Writes one sequence of a store of tables, each field's frames in rising order."""

    def __init__(self, root: Path, path: str, folder: str, options: Options, finished: dict[str, str]) -> None:
        self.location = str(root / folder)
        self.identity = identity_of(path)
        self._folder = root / folder
        self._path = path
        self._name = folder
        self._options = options
        self._finished = finished
        self._tables: dict[str, _TableWriter] = {}
        self._documents: dict[str, bytes] = {}
        self._statistics: dict[int, dict[str, Any]] = {}

    def has(self, field: str, frame: int) -> bool:
        """Whether this run has written it."""
        return field in self._tables and frame in self._tables[field].rows

    def write(self, field: str, frame: int, array: NDArray[Any]) -> None:
        """Append one frame as a row group.

        Raises:
            FormatError: it does not fit the field, or an earlier frame.
        """
        if field not in self._tables:
            self._tables[field] = _TableWriter(self._folder / f"{field}.parquet", field, self._options)
        try:
            self._tables[field].append(frame, array)
        except FormatError as error:
            raise FormatError(f"{self.location}: field {field}, frame {frame}: {error}") from error
        self._statistics.setdefault(frame, {}).update(statistics(field, array))

    def write_document(self, name: str, data: bytes) -> None:
        """Keep a text file's bytes."""
        self._documents[name] = data

    def read_document(self, name: str) -> bytes | None:
        """Return a text file's bytes, None if it is not there."""
        return self._documents.get(name)

    def close(self) -> None:
        """Finish the tables and mark the sequence as whole."""
        for table in self._tables.values():
            table.close()
        self._write_frames()
        self._write_documents()
        split, name, coordinates = self.identity
        about: dict[str, Any] = {"path": self._path, "split": split, "name": name, "coordinates": coordinates}
        about |= {"fields": sorted(self._tables), "documents": sorted(self._documents)}
        write_atomic(self._folder / SEQUENCE, to_json(about))
        self._finished[self._path] = self._name

    def _write_documents(self) -> None:
        """Write the table with one row a text file: its name and its bytes."""
        pa, parquet = import_extra("pyarrow", "parquet"), import_extra("pyarrow.parquet", "parquet")
        columns = {"name": pa.array(list(self._documents), pa.string())}
        columns["data"] = pa.array(list(self._documents.values()), pa.binary())
        self._folder.mkdir(parents=True, exist_ok=True)
        parquet.write_table(pa.table(columns), self._folder / DOCUMENTS, compression="zstd", write_page_checksum=True)

    def _write_frames(self) -> None:
        """Write the table with one row a frame: pose, time, statistics."""
        pa, parquet = import_extra("pyarrow", "parquet"), import_extra("pyarrow.parquet", "parquet")
        frames = sorted(self._statistics)
        columns: dict[str, Any] = {"frame": pa.array(frames, pa.int64())}
        for name, document, decode in (
            ("time_s", layout.TIMES, layout.decode_times),
            ("pose", layout.POSES, layout.decode_poses),
        ):
            try:
                lines = decode(self._documents[document], document)
                rows = [lines[frame if frames[-1] < len(lines) else frames.index(frame)] for frame in frames]
            except (KeyError, FormatError, IndexError):
                continue  # no such file, or one that its reader will say what is wrong with: the text is kept as it is
            values = np.array(rows, np.float64).reshape(len(frames), -1)
            columns[name] = (
                pa.array(values[:, 0])
                if name == "time_s"
                else pa.FixedSizeListArray.from_arrays(values[:, :12].reshape(-1), 12)
            )
        for name in sorted({name for row in self._statistics.values() for name in row}):
            columns[name] = pa.array([self._statistics[frame].get(name) for frame in frames])
        self._folder.mkdir(parents=True, exist_ok=True)
        parquet.write_table(pa.table(columns), self._folder / FRAMES, compression="zstd", write_page_checksum=True)


class _TableWriter:
    """One field's file, growing by row groups."""

    def __init__(self, path: Path, field: str, options: Options) -> None:
        self.kind = table_field(field)
        self.field = field
        self.path = path
        self.scale = options.lossy_mm / 1000 if field == "points" and options.lossy_mm else None
        self.rows: dict[int, int] = {}
        self.attributes: dict[str, Any] = {}
        self._writer: Any = None

    def append(self, frame: int, array: NDArray[Any]) -> None:
        if self.rows and frame <= next(reversed(self.rows)):
            raise FormatError(f"expected frames in rising order, found {frame} after {next(reversed(self.rows))}")
        layout.field_named(self.field).check(array, "its array")
        pa = import_extra("pyarrow", "parquet")
        if self._writer is None:
            self._start(pa, array)
        columns = self.kind.split(array, self.attributes)
        count = len(next(iter(columns.values())))
        if count:
            arrays = [pa.array(np.full(count, frame, np.int64))] + [
                pa.array(column) if isinstance(column, np.ndarray) else column for column in columns.values()
            ]
            self._writer.write_table(pa.table(arrays, schema=self._schema), row_group_size=count)
        self.rows[frame] = count

    def _start(self, pa: Any, array: NDArray[Any]) -> None:
        parquet = import_extra("pyarrow.parquet", "parquet")
        entry = layout.field_named(self.field)
        self.attributes = {
            "type": "carlasc.table",
            "version": VERSION,
            "field": self.field,
            "unit": entry.unit,
        } | self.kind.describe(array, self.scale)
        types, is_picture = self.kind.columns(self.attributes), entry.kind == "picture"
        self._schema = pa.schema(
            [("frame", pa.int64())] + [(name, getattr(pa, dtype)()) for name, dtype in types.items()]
        )
        split = {name: "BYTE_STREAM_SPLIT" for name in types if name in self.kind.split_bytes}
        self.path.parent.mkdir(parents=True, exist_ok=True)
        self._writer = parquet.ParquetWriter(
            self.path, self._schema, compression="none" if is_picture else "zstd", compression_level=None if is_picture else _LEVEL,
            use_dictionary=[name for name in ("frame", *types) if name not in split and not is_picture], column_encoding=split or None,
            data_page_size=_PAGE, dictionary_pagesize_limit=_PAGE, write_page_checksum=True, write_statistics=["frame"],
        )  # fmt: skip

    def close(self) -> None:
        about = self.attributes | {"frames": list(self.rows), "rows": list(self.rows.values())}
        self._writer.add_key_value_metadata({"carlasc": json.dumps(about)})
        self._writer.close()
