"""The published layout in a folder: reading and writing, one file per frame and field."""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from numpy.typing import NDArray

from carlasc.errors import FormatError, MissingDataError
from carlasc.storage import layout
from carlasc.storage.files import remove_stale, write_atomic
from carlasc.storage.folders.names import leads_outside
from carlasc.storage.folders.published import PublishedSequence, PublishedSource
from carlasc.storage.folders.trees import LocalTree
from carlasc.storage.protocol import Sequence, SequenceWriter, Sink


class FolderSource(PublishedSource):
    """A folder of any level: the root with its splits, a split, a sequence, or one `<coordinates>` folder."""

    def __init__(self, source: str | os.PathLike[str]) -> None:
        """Remember the folder; it is listed when its sequences are asked for.

        Raises:
            MissingDataError: the folder does not exist.
        """
        self.folder = Path(source)
        super().__init__(LocalTree(source))
        if not self.folder.is_dir():
            raise MissingDataError(
                self.folder, expected="a folder", found="a file" if self.folder.exists() else "nothing"
            )

    def sequences(self) -> Mapping[str, Sequence]:
        """Return the sequences found up to four levels down, by path.

        Raises:
            MissingDataError: no sequence was found; says what was looked for.
        """
        return {path: FolderSequence(self.folder, path) for path in super().sequences()}


class FolderSequence(PublishedSequence):
    """One local `<coordinates>` folder: its fields are memory-mapped.

    Attributes:
        folder: the folder.
    """

    def __init__(self, source: Path, path: str = "") -> None:
        self.folder = source / path
        super().__init__(LocalTree(source), path)

    def _full_path(self) -> str:
        return str(self.folder.absolute())  # so that "." inside a sequence has a name too


class FolderSink(Sink):
    """Writes the published layout into a folder."""

    def __init__(self, out: str | os.PathLike[str]) -> None:
        self.folder = Path(out)
        self.location = str(self.folder)

    def sequence(self, path: str) -> FolderWriter:
        """Start or continue a sequence's folder; the unfinished files of a run that was killed are removed."""
        folder = _inside(self.folder, path)
        remove_stale(folder)
        return FolderWriter(folder)


class FolderWriter(SequenceWriter):
    """Writes one `<coordinates>` folder, each file atomically; it can be pickled into workers."""

    concurrent = True

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.location = str(folder)

    def has(self, field: str, frame: int) -> bool:
        """Whether the file exists; it is whole then, because files are renamed into place."""
        return (self.folder / layout.field_named(field).file(frame)).is_file()

    def write(self, field: str, frame: int, array: NDArray[Any]) -> None:
        """Write one file."""
        entry = layout.field_named(field)
        path = _inside(self.folder, entry.file(frame))
        write_atomic(path, entry.encode(array, str(path)))

    def read(self, field: str, frame: int) -> NDArray[Any]:
        """Return the array of a file that exists."""
        entry = layout.field_named(field)
        path = self.folder / entry.file(frame)
        return entry.decode(path.read_bytes(), str(path))

    def remove_grid(self, grid: str) -> None:
        """Remove the report and the frames of a grid, then its params.json; other files in its folder stay."""
        (self.folder / layout.report_file(grid)).unlink(missing_ok=True)
        parts = [layout.field_named(f"{grid}/{part}").suffix for part in layout.GRID_FIELDS]
        for path in _inside(self.folder, grid).iterdir():
            if any(layout.frame_of(path.name, suffix) is not None for suffix in parts):
                path.unlink()
        (self.folder / layout.params_file(grid)).unlink()

    def write_document(self, name: str, data: bytes) -> None:
        """Write a text file."""
        write_atomic(_inside(self.folder, name), data)

    def read_document(self, name: str) -> bytes | None:
        """Return a text file's bytes, None if it does not exist."""
        path = self.folder / name
        return path.read_bytes() if path.is_file() else None


def _inside(folder: Path, path: str) -> Path:
    """Return a path inside a folder; it may come from a store, which anybody may have made."""
    if leads_outside(path):
        raise FormatError(path, expected=f"a path inside {folder}", found="one that leads elsewhere")
    return folder / path
