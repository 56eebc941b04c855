"""The published layout in a folder: read and write, a file a frame and field."""

from __future__ import annotations

import mmap
import os
from collections.abc import Iterator, Mapping
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from carlasc import layout
from carlasc.errors import FormatError, MissingDataError
from carlasc.files import write_atomic
from carlasc.sources.base import Sequence, SequenceWriter, Sink, Source, identity_of

_MARKS = {field.folder for field in layout.SCAN_FIELDS.values()} | {layout.EVALUATION, layout.POSES}
_DEPTH = 4  # <root>/<split>/<sequence>/<coordinates>, and one folder that a zip may have put around it


class FolderSource(Source):
    """A folder of any level: the root with its splits, a split, a sequence, or one `<coordinates>` folder."""

    def __init__(self, root: str | os.PathLike[str]) -> None:
        """Remember the folder; it is looked at when its sequences are asked for.

        Raises:
            MissingDataError: there is no such folder.
        """
        self.root = Path(root)
        self.location = str(self.root)
        if not self.root.is_dir():
            raise MissingDataError(
                f"{self.root}: expected a folder, found {'a file' if self.root.exists() else 'nothing'}"
            )

    def sequences(self) -> Mapping[str, Sequence]:
        """Return the sequences found up to four levels down, by path.

        Raises:
            MissingDataError: there is none; says what was looked for.
        """
        found = {
            path: FolderSequence(self.root / path, path) for path in sorted(_find_sequences(self.root, "", _DEPTH))
        }
        if not found:
            raise MissingDataError(
                f"{self.root}: expected a data set, a split, a sequence or its cartesian/ or cylindrical/ folder, found none of"
                f" {', '.join(sorted(_MARKS))} down to four levels: give the folder that holds Train, Val and Test, or one inside it"
            )
        return found


class FolderSequence(Sequence):
    """One `<coordinates>` folder."""

    def __init__(self, folder: Path, path: str = "") -> None:
        self.folder = folder
        self.path = path
        self.location = str(folder)
        self.split, self.name, self.coordinates = identity_of(str(folder.absolute()))

    @cached_property
    def _listing(self) -> dict[str, layout.Field]:
        """The fields whose folders are there: one look at the sequence's folder and one file in each of its grids'."""
        folders = {entry.name for entry in os.scandir(self.folder) if entry.is_dir()}
        fields = {name: field for name, field in layout.SCAN_FIELDS.items() if field.folder in folders}
        scan_folders = {field.folder for field in layout.SCAN_FIELDS.values()}
        for grid in sorted(folders - scan_folders):
            if (self.folder / layout.params_file(grid)).is_file():
                fields |= {f"{grid}/{part}": layout.field_named(f"{grid}/{part}") for part in layout.GRID_FIELDS}
        return fields

    @cached_property
    def _frames(self) -> dict[str, NDArray[np.int64]]:
        return {}

    def fields(self) -> frozenset[str]:
        """Return the fields with at least one frame."""
        return frozenset(name for name in self._listing if len(self.frames(name)))

    def frames(self, field: str) -> NDArray[np.int64]:
        """Return the frames of a field, from one listing of its folder."""
        if field not in self._frames:
            self._list_folder_of(field)
        return self._frames[field]

    def _list_folder_of(self, field: str) -> None:
        if field not in self._listing:
            self._frames[field] = np.empty(0, np.int64)
            return
        folder = self._listing[field].folder
        names = os.listdir(self.folder / folder)
        for sibling in (f for f in self._listing.values() if f.folder == folder):  # a grid's three fields share one
            numbers = [number for name in names if (number := layout.frame_of(name, sibling.suffix)) is not None]
            self._frames[sibling.name] = np.array(sorted(numbers), np.int64)

    def read(self, field: str, frame: int) -> NDArray[Any]:
        """Read one field of one frame, memory-mapped: read-only, and no byte is touched before it is used."""
        if field not in self._listing:
            raise MissingDataError(
                f"{self.location}: expected the field {field}, found {', '.join(sorted(self.fields())) or 'none'}"
            )
        entry = self._listing[field]
        path = f"{self.location}/{entry.file(frame)}"
        shape = self.grids[entry.folder].size if field.endswith(("/labels", "/counts")) else None
        return entry.decode(_map_file(path), path, shape)

    def documents(self) -> tuple[str, ...]:
        """Return the text files that are there."""
        names = [name for name in (layout.POSES, layout.TIMES, layout.METADATA) if (self.folder / name).is_file()]
        grids = sorted({field.folder for name, field in self._listing.items() if "/" in name})
        return (*names, *(layout.params_file(grid) for grid in grids))

    def read_document(self, name: str) -> bytes:
        """Return a text file's bytes."""
        try:
            return (self.folder / name).read_bytes()
        except FileNotFoundError as error:
            raise MissingDataError(f"{self.folder / name}: expected a file, found nothing") from error


class FolderSink(Sink):
    """Writes the published layout below a folder."""

    def __init__(self, root: str | os.PathLike[str]) -> None:
        self.root = Path(root)
        self.location = str(self.root)

    def sequence(self, path: str) -> FolderWriter:
        """Start, or go on with, a sequence's folder."""
        return FolderWriter(self.root / path)


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
        path = self.folder / entry.file(frame)
        write_atomic(path, entry.encode(array, str(path)))

    def write_document(self, name: str, data: bytes) -> None:
        """Write a text file."""
        write_atomic(self.folder / name, data)

    def read_document(self, name: str) -> bytes | None:
        """Return a text file's bytes, None if it is not there."""
        path = self.folder / name
        return path.read_bytes() if path.is_file() else None


def _find_sequences(folder: Path, path: str, depth: int) -> Iterator[str]:
    with os.scandir(folder) as entries:
        children = {entry.name: entry for entry in entries if not entry.name.startswith(".")}
    if _MARKS & set(children) or any(name.startswith(f"{layout.EVALUATION}_") for name in children):
        yield path
        return
    if depth == 0:
        return
    for name, entry in children.items():
        if entry.is_dir() and name != "raw":  # a capture (carlasc.capture) is no sequence of the layout
            yield from _find_sequences(folder / name, f"{path}/{name}" if path else name, depth - 1)


def _map_file(path: str) -> bytes | memoryview:
    try:
        descriptor = os.open(path, os.O_RDONLY)
    except FileNotFoundError as error:
        raise MissingDataError(f"{path}: expected a file, found nothing") from error
    except OSError as error:
        raise FormatError(f"{path}: cannot be read: {error.strerror}") from error
    try:
        if os.fstat(descriptor).st_size == 0:
            return b""  # an empty file cannot be mapped, and is an empty scan
        return memoryview(mmap.mmap(descriptor, 0, prot=mmap.PROT_READ))
    finally:
        os.close(descriptor)
