"""Writing packed stores of Parquet tables."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

from carlasc.core.arrays import AnyArray
from carlasc.errors import FormatError, import_extra
from carlasc.storage import layout
from carlasc.storage.files import (
    AnyPath,
    parse_json,
    remove,
    remove_file,
    remove_stale,
    sync_tree,
    to_json,
    write_atomic,
)
from carlasc.storage.packed.output import (
    TABLES_MARK,
    UNFINISHED_MARK,
    DeferredErrorFile,
    put_in_place,
)
from carlasc.storage.packed.stores import (
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

# level of Zstandard: from 11, points take 2% less space; above 12, it takes several times as long
_LEVEL = 12
_PAGE = 8 << 20  # bytes: one page holds one column of a scan


class ParquetSink(PackedSink):
    """Writes a folder of packed Parquet tables."""

    def __init__(
        self,
        path: AnyPath,
        options: PackOptions | None = None,
        overwrite: bool = False,
    ) -> None:
        """Start a store, or continue an interrupted run. Its completed sequences are kept.

        Raises:
            ArgumentError: `small` is given.
            ConflictError: something exists at `path`, and `overwrite` is not given.
            DependencyError: pyarrow is not installed.
        """
        import_extra("pyarrow.parquet", "parquet")
        super().__init__(path, options, overwrite)
        mark = self.part / UNFINISHED_MARK
        given = {"lossy_mm": self.options.lossy_mm, "made_from": self.options.made_from}
        run = to_json({"version": VERSION, **given})
        if not mark.is_file() or mark.read_bytes() != run:
            remove(self.part)
            write_atomic(mark, run)
        remove_stale(self.part)
        self._numbers: dict[str, int] = {}
        for file in sorted(self.part.rglob(SEQUENCE)):
            about = parse_json(file.read_bytes(), str(file))
            self.nodes[about["path"]] = file.parent.relative_to(self.part).as_posix()
            self._numbers[about["path"]] = int(about[NUMBER])

    def sequence(self, path: str) -> ParquetWriter:
        """Start a sequence. An incomplete sequence of an interrupted run is removed."""
        node = node_of(path, self.location)
        self.nodes.pop(path, None)
        remove(self.part / node)
        # A sequence that is written again keeps its number, so that the store has the same bytes as
        # without an interruption.
        number = self._numbers.setdefault(path, 1 + max(self._numbers.values(), default=-1))
        return ParquetWriter(self, path, node, number)

    def finish(self, *, incomplete: bool = False) -> None:
        """Mark the store as finished and rename it."""
        root = self.root() | {"lossy_mm": self.options.lossy_mm}
        write_atomic(self.part / TABLES_MARK, to_json(root))
        remove_file(self.part / UNFINISHED_MARK)
        put_in_place(self.part, self.path, self.overwrite)


class ParquetWriter(PackedWriter["TableWriter"]):
    """Writes one sequence of a store of tables."""

    def __init__(self, sink: ParquetSink, path: str, node: str, number: int) -> None:
        super().__init__(sink, path, node)
        self._folder = Path(self.location)
        self._number = number
        self._statistics: dict[int, dict[str, Any]] = {}

    def _start_field(self, field: str) -> TableWriter:
        return TableWriter(self._folder / f"{field}.parquet", field, self._number, self.options)

    def write(self, field: str, frame: int, array: AnyArray) -> None:
        """Append one frame as a row group.

        Raises:
            FormatError: the array does not fit the field, or `frame` is not above the previous one.
        """
        super().write(field, frame, array)
        self._statistics.setdefault(frame, {}).update(statistics(field, array))

    def _finish(self) -> None:
        self._write_frames()
        pa = import_extra("pyarrow", "parquet")
        columns = {"name": pa.array(list(self.contents), pa.string())}
        columns["data"] = pa.array(list(self.contents.values()), pa.binary())
        _write_table(pa.table(columns), self._folder / DOCUMENTS)
        sync_tree(self._folder)  # before the mark is written
        about = {NUMBER: self._number, FOOTERS: footer_checksums(self._folder)}
        write_atomic(self._folder / SEQUENCE, to_json(self.about() | about))

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
            values = np.array(rows, np.float64).reshape(len(frames), *lines.shape[1:])
            columns[name] = (
                pa.array(values)
                if name == "time_s"
                else pa.FixedSizeListArray.from_arrays(values[:, :3].reshape(-1), 12)
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
        self.attributes: dict[str, Any] = {}
        self._writer: Any = None

    def write(self, frame: int, array: AnyArray) -> int:
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
        return count

    def _start(self, pa: Any, array: AnyArray) -> None:
        parquet = import_extra("pyarrow.parquet", "parquet")
        self.attributes = {
            "type": "carlasc.table",
            "version": VERSION,
            "field": self.entry.name,
            "unit": self.entry.unit,
        } | describe(self.entry, array, self.scale_m)
        types = column_types(self.entry, self.attributes)
        is_picture = self.entry.kind == "picture"
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
        about = self.attributes | {"frames": [*self.frames], "rows": [*self.frames.values()]}
        self._writer.add_key_value_metadata({"carlasc": json.dumps(about)})
        self._writer.close()
        self._file.close()
        self._file.check()
