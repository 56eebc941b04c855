"""Reading and writing the published layout in a folder, one file per frame and field.

The writer supports object stores too.
"""

from __future__ import annotations

import os
from collections.abc import Collection, Iterable, Mapping
from pathlib import Path
from typing import Any

from carlasc.core.arrays import AnyArray
from carlasc.errors import MissingDataError
from carlasc.storage import field_files, layout
from carlasc.storage.files import AnyPath, remove_stale
from carlasc.storage.protocol import FrameArrays, Sequence, SequenceWriter, Sink, Source
from carlasc.storage.published import PublishedSequence, PublishedSource
from carlasc.storage.transport.remote_tree import target_of
from carlasc.storage.transport.trees import LocalTarget, LocalTree, Target
from carlasc.storage.voxel_files import find_voxels

# end record of a zip without a comment, as NumPy writes it
_ZIP_END = b"PK\x05\x06"
_ZIP_END_BYTES = 22


class FolderSource(PublishedSource):
    """A folder of any level: the root with its splits, a split, a sequence, or one `<coordinates>`
    folder.
    """

    def __init__(self, source: AnyPath) -> None:
        """Keep the path of the folder. It is listed when its sequences are first used.

        Raises:
            MissingDataError: the folder does not exist.
        """
        self.folder = Path(source)
        super().__init__(LocalTree(source))
        if not self.folder.is_dir():
            raise MissingDataError(
                self.folder,
                expected="a folder",
                found="a file" if self.folder.exists() else "nothing",
            )

    def sequences(self) -> Mapping[str, Sequence]:
        """Return the sequences found up to four levels down, by path.

        A folder without any may hold voxel grids of another program, which are then presented in
        the layout.

        Raises:
            MissingDataError: no sequence was found; the message says what was expected.
        """
        sequences: dict[str, Sequence] = {}
        try:
            sequences = {**super().sequences()}
        except MissingDataError:
            if (found := find_voxels(self.folder)) is None:
                raise
            return found.sequences()
        # folders of other programs may have names of the layout, such as predictions/
        is_other = not any(sequence.fields() for sequence in sequences.values())
        voxels = find_voxels(self.folder) if is_other else None
        return sequences if voxels is None else voxels.sequences()

    def _sequence(self, path: str) -> FolderSequence:
        return FolderSequence(self.folder, path)


class FolderSequence(PublishedSequence):
    """One local `<coordinates>` folder: its fields are memory-mapped.

    Attributes:
        folder: the folder.
    """

    def __init__(self, source: Path, path: str = "") -> None:
        self.folder = source / path
        super().__init__(LocalTree(source), path)

    def _full_path(self) -> str:
        return str(self.folder.absolute())  # so that "." inside a sequence has a name


class FolderSink(Sink):
    """Writes the published layout into a folder, on this machine or in an object store.

    Attributes:
        target: where files are written.
    """

    is_readable = True

    def __init__(self, out: AnyPath | Target, **storage_options: Any) -> None:
        """Keep a folder, or its URL with options of fsspec. Nothing is written yet.

        Raises:
            ArgumentError: the URL cannot be written to.
            DependencyError: the URL needs a package that is not installed.
        """
        self.target = target_of(out, **storage_options)
        self.location = self.target.location

    def sequence(self, path: str) -> FolderWriter:
        """Start or continue the folder of a sequence.

        Temporary files of a killed run are removed.
        """
        target = self.target.below(path)
        if isinstance(target, LocalTarget):
            remove_stale(target.folder)
        return FolderWriter(target)

    def source(self) -> Source:
        """Return the folder."""
        return (
            FolderSource(self.target.folder)
            if isinstance(self.target, LocalTarget)
            else PublishedSource(self.target.tree)
        )


class FolderWriter(SequenceWriter):
    """Writes one `<coordinates>` folder, each file whole; it can be pickled into workers.

    Attributes:
        target: the folder.
    """

    concurrent = True

    def __init__(self, folder: AnyPath | Target) -> None:
        self.target = target_of(folder)
        self.location = self.target.location
        self._cells: dict[str, int] = {}  # voxels of each grid whose params.json has been read

    def has(self, field: str, frame: int) -> bool:
        """Whether the file exists and has a valid size; in an object store, only whether it exists:
        its folder is listed once.

        A power failure can leave empty and short files, unless they were written durably (see
        `carlasc.storage.files`). Checking the size costs little more than checking that the file
        exists.

        The size of a grid follows from params.json. Fields with one row per point must have as many
        rows as `points`, and `points` as many as `labels`. Tables of votes or velocities must have
        the end record of a zip. A file of boxes may be empty, and so may a scan whose points and
        labels are both empty.
        """
        entry = layout.field_named(field)
        if not isinstance(self.target, LocalTarget):
            return self.target.tree.is_file(entry.file(frame))
        size = self._size(entry, frame)
        if size is None:
            return False
        if entry.kind == "boxes":
            return True
        if entry.per == "voxel":
            cells = self._cells.get(entry.folder) or self.cells_of(entry.folder)
            if cells is None:
                return size > 0
            self._cells[entry.folder] = cells
            return size == cells * entry.row_bytes
        if entry.kind in ("votes", "velocities"):
            return self._ends_as_zip(entry.file(frame), size)
        if entry.per == "point":
            other = layout.SCAN_FIELDS["labels" if field == "points" else "points"]
            rows = size / entry.row_bytes
            beside = self._size(other, frame)
            return rows.is_integer() and (beside is None or beside / other.row_bytes == rows)
        return size > 0

    def _size(self, entry: field_files.Field, frame: int) -> int | None:
        try:
            return os.stat(f"{self.location}/{entry.file(frame)}").st_size
        except (FileNotFoundError, NotADirectoryError):
            return None

    def _ends_as_zip(self, path: str, size: int) -> bool:
        with open(f"{self.location}/{path}", "rb", buffering=0) as file:
            file.seek(max(0, size - _ZIP_END_BYTES))
            return file.read(len(_ZIP_END)) == _ZIP_END

    def refresh(self) -> None:
        """Forget the listings of folders in an object store."""
        self.target.tree.refresh()

    def write(self, field: str, frame: int, array: AnyArray) -> None:
        """Write one file."""
        self.target.put(*self._file(field, frame, array))

    def write_frames(self, frames: FrameArrays) -> None:
        """Write the files of several frames in parallel.

        The last file of each frame is written after the other files of that frame.
        """
        files = [
            [self._file(field, frame, array) for field, array in fields.items()]
            for frame, fields in frames.items()
        ]
        self.target.put_many(
            dict(file for parts in files for file in parts[:-1]),
            dict(parts[-1] for parts in files if parts),
        )

    def _file(self, field: str, frame: int, array: AnyArray) -> tuple[str, bytes | memoryview]:
        entry = layout.field_named(field)
        path = entry.file(frame)
        return path, entry.encode(array, self.target.tree.where(path))

    def read(self, field: str, frame: int) -> AnyArray:
        """Return the array of a file that exists."""
        entry = layout.field_named(field)
        path = entry.file(frame)
        return entry.decode(self.target.tree.read(path), self.target.tree.where(path))

    def remove_grid(self, grid: str) -> None:
        """Remove the report and the frames of a grid, then its params.json.

        Other files in its folder are kept.
        """
        self.target.remove(layout.report_file(grid))
        parts = [layout.field_named(f"{grid}/{part}").suffix for part in layout.GRID_FIELDS]
        names = [
            name
            for name in self.target.tree.entries(grid)
            if any(layout.frame_of(name, s) is not None for s in parts)
        ]
        self.target.remove_many(f"{grid}/{name}" for name in names)
        self.target.remove(layout.params_file(grid))
        self._cells.pop(grid, None)

    def remove_frames(self, fields: Iterable[str], frames: Collection[int]) -> None:
        """Remove files of some frames."""
        entries = [layout.field_named(field) for field in fields]
        self.target.remove_many(entry.file(frame) for entry in entries for frame in frames)

    def write_document(self, name: str, data: bytes) -> None:
        """Write a text file."""
        self.target.put(name, data)

    def remove_document(self, name: str) -> None:
        """Remove a text file, if it exists."""
        self.target.remove(name)

    def create_document(self, name: str, data: bytes) -> bool:
        """Write a text file unless it exists. An empty one is replaced."""
        if data and self.target.read(name) == b"":
            self.target.remove(name)
        return self.target.put(name, data, create=True)

    def read_document(self, name: str) -> bytes | None:
        """Return the bytes of a text file; None if it does not exist, or is empty after a power
        failure.
        """
        return self.target.read(name) or None
