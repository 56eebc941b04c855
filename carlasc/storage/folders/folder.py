"""The published layout in a folder: read and write, a file a frame and field."""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from numpy.typing import NDArray

from carlasc.errors import FormatError, MissingDataError
from carlasc.storage import layout
from carlasc.storage.files import remove_stale, write_atomic
from carlasc.storage.folders.published import PublishedSequence, PublishedSource
from carlasc.storage.folders.trees import LocalTree
from carlasc.storage.protocol import Sequence, SequenceWriter, Sink


class FolderSource(PublishedSource):
    """A folder of any level: the root with its splits, a split, a sequence, or one `<coordinates>` folder."""

    def __init__(self, root: str | os.PathLike[str]) -> None:
        """Remember the folder; it is looked at when its sequences are asked for.

        Raises:
            MissingDataError: there is no such folder.
        """
        self.root = Path(root)
        super().__init__(LocalTree(root))
        if not self.root.is_dir():
            raise MissingDataError(
                self.root, expected="a folder", found=f"{'a file' if self.root.exists() else 'nothing'}"
            )

    def sequences(self) -> Mapping[str, Sequence]:
        """Return the sequences found up to four levels down, by path.

        Raises:
            MissingDataError: there is none; says what was looked for.
        """
        return {path: FolderSequence(self.root, path) for path in super().sequences()}


class FolderSequence(PublishedSequence):
    """One `<coordinates>` folder of this machine: its fields are memory-mapped.

    Attributes:
        folder: where it is.
    """

    def __init__(self, root: Path, path: str = "") -> None:
        self.folder = root / path
        super().__init__(LocalTree(root), path)

    def _full_path(self) -> str:
        return str(self.folder.absolute())  # "." inside a sequence has a name too


class FolderSink(Sink):
    """Writes the published layout below a folder."""

    def __init__(self, root: str | os.PathLike[str]) -> None:
        self.root = Path(root)
        self.location = str(self.root)

    def sequence(self, path: str) -> FolderWriter:
        """Start, or go on with, a sequence's folder; what a killed run left half-written there is removed."""
        remove_stale(self.root / path)
        return FolderWriter(_inside(self.root, path))


class FolderWriter(SequenceWriter):
    """Writes one `<coordinates>` folder, every file atomically; pickles into workers."""

    concurrent = True

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.location = str(folder)

    def has(self, field: str, frame: int) -> bool:
        """Whether the file is there; it is whole, because files are renamed into place."""
        return (self.folder / layout.field_named(field).file(frame)).is_file()

    def write(self, field: str, frame: int, array: NDArray[Any]) -> None:
        """Write one file."""
        entry = layout.field_named(field)
        path = _inside(self.folder, entry.file(frame))
        write_atomic(path, entry.encode(array, str(path)))

    def read(self, field: str, frame: int) -> NDArray[Any]:
        """Return what is there."""
        entry = layout.field_named(field)
        path = self.folder / entry.file(frame)
        return entry.decode(path.read_bytes(), str(path))

    def remove_grid(self, grid: str) -> None:
        """Remove a grid's frames, then its params.json; other files in its folder stay."""
        parts = [layout.field_named(f"{grid}/{part}").suffix for part in layout.GRID_FIELDS]
        for path in (self.folder / grid).iterdir():
            if any(layout.frame_of(path.name, suffix) is not None for suffix in parts):
                path.unlink()
        (self.folder / layout.params_file(grid)).unlink()

    def write_document(self, name: str, data: bytes) -> None:
        """Write a text file."""
        write_atomic(_inside(self.folder, name), data)

    def read_document(self, name: str) -> bytes | None:
        """Return a text file's bytes, None if it is not there."""
        path = self.folder / name
        return path.read_bytes() if path.is_file() else None


def _inside(folder: Path, path: str) -> Path:
    """Return a path below a folder; names come from stores too, which anyone may have made."""
    if Path(path).is_absolute() or ".." in Path(path).parts:
        raise FormatError(path, expected=f"a path inside {folder}", found="one that leads elsewhere")
    return folder / path
