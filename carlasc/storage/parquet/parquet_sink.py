"""Writing packed stores of Parquet tables."""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Any

import numpy as np

from carlasc.core.arrays import AnyArray
from carlasc.errors import ArgumentError, FormatError, import_extra
from carlasc.storage import layout
from carlasc.storage.files import (
    parse_json,
    remove_file,
    remove_stale,
    sync_tree,
    to_json,
    unfinished,
    write_atomic,
)
from carlasc.storage.packed.output import (
    TABLES_MARK,
    UNFINISHED_MARK,
    DeferredErrorFile,
    put_in_place,
    refuse_existing,
    remove,
)
from carlasc.storage.packed.stores import (
    STORE,
    VERSION,
    FieldWriter,
    PackedSink,
    PackedWriter,
    PackOptions,
    node_of,
)
from carlasc.storage.parquet.parquet_source import (
    DOCUMENTS,
    FOOTERS,
    FRAMES,
    NUMBER,
    SEQUENCE,
    footer_checksums,
)
from carlasc.storage.parquet.table_columns import (
    AXES,
    column_types,
    describe,
    split_columns,
    statistics,
)

# level of Zstandard: from 11, points take 2 % less space; above 12, it takes several times as long
_LEVEL = 12
_PAGE = 8 << 20  # bytes: one page holds one column of a scan


class ParquetSink(PackedSink):
    """Writes a folder of packed Parquet tables.

    It gets its final name only when the sink is finished.
    """

    def __init__(
        self,
        path: str | os.PathLike[str],
        options: PackOptions | None = None,
        overwrite: bool = False,
    ) -> None:
        """Start a store, or continue an interrupted run. Its completed sequences are kept.

        Raises:
            ArgumentError: `small` is given, but Parquet has no PCodec encoding.
            ConflictError: something exists at `path`, and `overwrite` is not given.
            DependencyError: pyarrow is not installed.
        """
        import_extra("pyarrow.parquet", "parquet")
        self.path = Path(path)
        self.location = str(path)
        self.options = options or PackOptions()
        self.overwrite = overwrite
        if self.options.small:
            raise ArgumentError(
                "small",
                expected="a .zarr store",
                found=f"{path}: Parquet has no PCodec",
                advice="leave `small` out",
            )
        refuse_existing(self.path, overwrite)
        self._part = unfinished(self.path)
        run = to_json({"version": VERSION, "lossy_mm": self.options.lossy_mm})
        if (
            not (self._part / UNFINISHED_MARK).is_file()
            or (self._part / UNFINISHED_MARK).read_bytes() != run
        ):
            remove(self._part)
            write_atomic(self._part / UNFINISHED_MARK, run)
        remove_stale(self._part)
        done = {
            file: parse_json(file.read_bytes(), str(file))
            for file in sorted(self._part.rglob(SEQUENCE))
        }
        self._sequences = {
            about["path"]: file.parent.relative_to(self._part).as_posix()
            for file, about in done.items()
        }
        self._numbers = {str(about["path"]): int(about[NUMBER]) for about in done.values()}

    def finished(self, path: str) -> bool:
        """Whether an interrupted run has completed this sequence."""
        return path in self._sequences

    def sequence(self, path: str) -> ParquetWriter:
        """Start a sequence. An incomplete sequence of an interrupted run is removed."""
        folder = node_of(path, self.location)
        self._sequences.pop(path, None)
        remove(self._part / folder)
        # A sequence that is written again keeps its number, so that the store has the same bytes as
        # without an interruption.
        number = self._numbers.setdefault(path, 1 + max(self._numbers.values(), default=-1))
        return ParquetWriter(self._part, path, folder, number, self.options, self._sequences)

    def finish(self, *, incomplete: bool = False) -> None:
        """Mark the store as finished and rename it."""
        root = {
            "type": STORE,
            "version": VERSION,
            "complete": True,
            "sequences": self._sequences,
            "lossy_mm": self.options.lossy_mm,
        }
        write_atomic(self._part / TABLES_MARK, to_json(root))
        remove_file(self._part / UNFINISHED_MARK)
        put_in_place(self._part, self.path, self.overwrite)


class ParquetWriter(PackedWriter):
    """Writes one sequence of a store of tables."""

    def __init__(
        self,
        root: Path,
        path: str,
        folder: str,
        number: int,
        options: PackOptions,
        finished: dict[str, str],
    ) -> None:
        super().__init__(str(root / folder), path)
        self._folder = root / folder
        self._name = folder
        self._number = number
        self._options = options
        self._finished = finished
        self._statistics: dict[int, dict[str, Any]] = {}

    def _start_field(self, field: str) -> FieldWriter:
        return TableWriter(self._folder / f"{field}.parquet", field, self._number, self._options)

    def write(self, field: str, frame: int, array: AnyArray) -> None:
        """Append one frame as a row group.

        Raises:
            FormatError: the array does not fit the field, or `frame` is not above the previous one.
        """
        super().write(field, frame, array)
        self._statistics.setdefault(frame, {}).update(statistics(field, array))

    def close(self) -> None:
        """Finish the tables and mark the sequence as complete."""
        for table in self.writers.values():
            table.close()
        self._write_frames()
        self._write_documents()
        sync_tree(self._folder)  # before the mark is written
        about = {NUMBER: self._number, FOOTERS: footer_checksums(self._folder)}
        write_atomic(self._folder / SEQUENCE, to_json(self.about() | about))
        self._finished[self.path] = self._name

    def _write_documents(self) -> None:
        """Write the table with one row per text file: its name and its bytes."""
        pa = import_extra("pyarrow", "parquet")
        columns = {"name": pa.array(list(self.contents), pa.string())}
        columns["data"] = pa.array(list(self.contents.values()), pa.binary())
        _write_table(pa.table(columns), self._folder / DOCUMENTS)

    def _write_frames(self) -> None:
        """Write the table with one row per frame: its sequence, pose, time, statistics."""
        pa = import_extra("pyarrow", "parquet")
        frames = sorted(self._statistics)
        columns: dict[str, Any] = {
            "sequence": pa.array([self._number] * len(frames), pa.int32()),
            "path": pa.array([self.path] * len(frames), pa.string()),
            "frame": pa.array(frames, pa.int64()),
        }
        for name, document, decode in (
            ("time_s", layout.TIMES, layout.decode_times),
            ("pose", layout.POSES, layout.decode_poses),
        ):
            try:
                lines = decode(self.contents[document], document)
                rows = [
                    lines[frame if frames[-1] < len(lines) else frames.index(frame)]
                    for frame in frames
                ]
            except (KeyError, FormatError, IndexError):
                # missing, or not numbers: the text is kept unchanged, and its reader reports the
                # error
                continue
            values = np.array(rows, np.float64).reshape(len(frames), 1 if name == "time_s" else 16)
            columns[name] = (
                pa.array(values[:, 0])
                if name == "time_s"
                else pa.FixedSizeListArray.from_arrays(values[:, :12].reshape(-1), 12)
            )
        for name in sorted({name for row in self._statistics.values() for name in row}):
            columns[name] = pa.array([self._statistics[frame].get(name) for frame in frames])
        _write_table(pa.table(columns), self._folder / FRAMES)


def _write_table(table: Any, path: Path) -> None:
    file = DeferredErrorFile(path, path)
    import_extra("pyarrow.parquet", "parquet").write_table(
        table, file, compression="zstd", write_page_checksum=True
    )
    file.close()
    file.check()


class TableWriter(FieldWriter):
    """Writes one field's file, row group by row group."""

    def __init__(self, path: Path, field: str, number: int, options: PackOptions) -> None:
        super().__init__(field)
        self._number = number
        self.path = path
        self.scale_m = options.scale_m if field == "points" else None
        self.rows: list[int] = []  # number of rows of each frame
        self.attributes: dict[str, Any] = {}
        self._writer: Any = None

    def write(self, frame: int, array: AnyArray) -> None:
        """Append one row group. An empty frame has no row group."""
        pa = import_extra("pyarrow", "parquet")
        if self._writer is None:
            self._start(pa, array)
        columns = split_columns(self.entry, array, self.attributes)
        count = len(next(iter(columns.values())))
        if count:
            place = (np.full(count, self._number, np.int32), np.full(count, frame, np.int64))
            arrays = [*map(pa.array, place), *map(pa.array, columns.values())]
            self._writer.write_table(pa.table(arrays, schema=self._schema), row_group_size=count)
            self._file.check()
        self.rows.append(count)

    def _start(self, pa: Any, array: AnyArray) -> None:
        parquet = import_extra("pyarrow.parquet", "parquet")
        self.attributes = {
            "type": "carlasc.table",
            "version": VERSION,
            "field": self.entry.name,
            "unit": self.entry.unit,
        } | describe(self.entry, array, self.scale_m)
        types, is_picture = column_types(self.entry, self.attributes), self.entry.kind == "picture"
        self._schema = pa.schema(
            [("sequence", pa.int32()), ("frame", pa.int64())]
            + [(name, getattr(pa, dtype)()) for name, dtype in types.items()]
        )
        split = {
            name: "BYTE_STREAM_SPLIT"
            for name in types
            if self.entry.kind == "position" and name in AXES
        }
        self._file = DeferredErrorFile(self.path, self.path)
        self._writer = parquet.ParquetWriter(
            self._file,
            self._schema,
            compression="none" if is_picture else "zstd",
            compression_level=None if is_picture else _LEVEL,
            use_dictionary=[
                name
                for name in ("sequence", "frame", *types)
                if name not in split and not is_picture
            ],
            column_encoding=split or None,
            data_page_size=_PAGE,
            dictionary_pagesize_limit=_PAGE,
            write_page_checksum=True,
            write_statistics=["sequence", "frame"],
        )  # fmt: skip

    def close(self) -> None:
        """Write the footer."""
        about = self.attributes | {"frames": list(self.frames), "rows": self.rows}
        self._writer.add_key_value_metadata({"carlasc": json.dumps(about)})
        self._writer.close()
        self._file.close()
        self._file.check()
