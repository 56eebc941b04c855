"""The published layout in any tree of files: its sequences and their fields, one file per frame and
field.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator, Mapping
from functools import cached_property
from pathlib import PurePosixPath
from typing import Any

import numpy as np

from carlasc.core.arrays import AnyArray, IntArray
from carlasc.core.frames import compact, expand
from carlasc.errors import MissingDataError
from carlasc.storage import field_files, layout
from carlasc.storage.layout import identity_of
from carlasc.storage.protocol import Sequence, Source
from carlasc.storage.transport.trees import Tree

_DEPTH = 4  # <split>/<sequence>/<coordinates>, and one folder around them in some zips
_TEXTS = (layout.POSES, layout.TIMES, layout.METADATA, layout.CAMERAS)
_CONTAINERS = (".zip", ".zarr", ".h5", ".hdf5", ".parquet")


class PublishedSource(Source):
    """The published layout in a tree of files: the root with its splits, a split, a sequence, or
    one `<coordinates>` folder.
    """

    def __init__(self, tree: Tree) -> None:
        self.tree = tree
        self.location = tree.location

    def sequences(self) -> Mapping[str, Sequence]:
        """Return the sequences found up to four levels down, by path.

        Raises:
            MissingDataError: no sequence was found; the message says what was expected and found.
        """
        if not (found := self.sequences_in([""])):
            raise self._nothing_found()
        return found

    def places(self) -> list[str]:
        """Return the folders as deep as the first sequence or capture: only folders above are
        listed.
        """
        first = _first_place(self.tree, "", _DEPTH)
        depth = len(first.split("/")) if first else 0
        return list(_folders_at(self.tree, "", depth))

    def sequences_in(self, places: Collection[str]) -> Mapping[str, Sequence]:
        """Return the sequences in some folders."""
        paths = list[str]()
        for place in places:
            depth = _DEPTH - len(PurePosixPath(place).parts)
            paths += _find_sequences(self.tree, place, depth)
        return {path: self._sequence(path) for path in sorted(paths)}

    def _sequence(self, path: str) -> PublishedSequence:
        return PublishedSequence(self.tree, path)

    def _nothing_found(self) -> MissingDataError:
        entries = self.tree.entries()
        expected = "a sequence or a folder above it"
        suffixes = {field.suffix for field in layout.SCAN_FIELDS.values()} | {".label", ".bin"}
        if layout.PARAMS in entries or any(_is_frame(name, suffixes) for name in entries):
            found = "the files of one field"
            advice = "give the folder above this one"
        elif stores := sorted(name for name in entries if name.endswith(_CONTAINERS)):
            found = ", ".join(stores[:4])
            advice = "give one of these"
        elif entries.get("raw"):
            found = "a raw capture"
            advice = "make grids of it first (carlasc regrid)"
        else:
            expected = "a data set, a split, a sequence or its cartesian/ or cylindrical/ folder"
            found = f"none of {', '.join(sorted(_marks()))} within four levels of folders"
            advice = "give the folder that holds Train, Val and Test, or one inside it"
        return MissingDataError(self.location, expected=expected, found=found, advice=advice)


class PublishedSequence(Sequence):
    """One `<coordinates>` folder."""

    tree: Tree

    def __init__(self, tree: Tree, path: str = "") -> None:
        self.tree = tree
        self.path = path
        self.location = tree.where(path)
        self._prefix = f"{path}/" if path else ""
        self.split, self.name, self.coordinates = identity_of(self._full_path())

    def _full_path(self) -> str:
        return self.location

    @cached_property
    def _listing(self) -> dict[str, field_files.Field]:
        """The fields whose folders exist.

        Lists the folder of the sequence, and checks for params.json in the folder of each grid.
        """
        folders = {name for name, is_folder in self.tree.entries(self.path).items() if is_folder}
        names = [name for name, field in layout.SCAN_FIELDS.items() if field.folder in folders]
        for folder in sorted(folders & layout.IMAGE_FOLDERS.keys()):
            for camera, is_folder in self.tree.entries(self._prefix + folder).items():
                suffixes = layout.IMAGE_SUFFIXES if is_folder else ()
                names += [f"{folder}.{camera}.{suffix}" for suffix in suffixes]
        for grid in sorted(folders - layout.scan_folders() - layout.IMAGE_FOLDERS.keys()):
            if self.tree.is_file(self._prefix + layout.params_file(grid)):
                names += [f"{grid}/{part}" for part in layout.GRID_FIELDS]
        return {name: layout.field_named(name) for name in names}

    @cached_property
    def _frames(self) -> dict[str, IntArray]:
        return {}

    def fields(self) -> frozenset[str]:
        """Return the fields with at least one frame."""
        present = set()
        for name in self._listing:  # in Python 3.11, a comprehension is a level of calls
            if len(self.frames(name)):
                present.add(name)
        return frozenset(present)

    def frames(self, field: str) -> IntArray:
        """Return the frames of a field. Its folder is listed once."""
        if field not in self._frames:
            if field not in self._listing:
                return np.empty(0, np.int64)
            folder = self._listing[field].folder
            names = self.tree.entries(self._prefix + folder)
            # fields of a grid share a folder
            for sibling in (f for f in self._listing.values() if f.folder == folder):
                numbers = (layout.frame_of(name, sibling.suffix) for name in names)
                found = sorted(number for number in numbers if number is not None)
                self._frames[sibling.name] = np.array(found, np.int64)
        return self._frames[field]

    def __getstate__(self) -> dict[str, Any]:
        return super().__getstate__() | {
            "_frames": {name: compact(frames) for name, frames in self._frames.items()}
        }

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(
            state, _frames={name: expand(frames) for name, frames in state["_frames"].items()}
        )

    def read(self, field: str, frame: int) -> AnyArray:
        """Read one file.

        A local file is memory-mapped: the array is read-only, and its bytes are read on access.
        """
        return self.read_many(field, [frame])[0]

    def read_many(self, field: str, frames: Iterable[int]) -> list[AnyArray]:
        """Read several files; all at once from a remote tree."""
        entry = self._entry(field)
        paths = list[str]()
        arrays = list[AnyArray]()
        for frame in frames:  # in Python 3.11, a comprehension is a level of calls
            paths.append(self._prefix + entry.file(frame))
        with_shape = entry.per in ("voxel", "vote", "moving voxel")
        shape = self.grids[entry.folder].size if with_shape else None
        for path, data in zip(paths, self.tree.read_many(paths, entry.size_of(shape)), strict=True):
            arrays.append(entry.decode(data, self.tree.where(path), shape))
        return arrays

    def files_of(self, field: str, frames: Iterable[int]) -> list[str]:
        """Return the file of each frame."""
        return [self._prefix + self._entry(field).file(frame) for frame in frames]

    def _entry(self, field: str) -> field_files.Field:
        if field not in self._listing:
            raise MissingDataError(
                self.location,
                expected=f"the field {field}",
                found=", ".join(sorted(self.fields())) or "none",
            )
        return self._listing[field]

    def documents(self) -> tuple[str, ...]:
        """Return the names of the text files."""
        grids = sorted({field.folder for name, field in self._listing.items() if "/" in name})
        texts, reports = (
            [name for name in names if self.tree.is_file(self._prefix + name)]
            for names in (_TEXTS, map(layout.report_file, grids))
        )
        return (*texts, *map(layout.params_file, grids), *reports)

    def read_document(self, name: str) -> bytes:
        """Return a text file's bytes."""
        return bytes(self.tree.read_many([self._prefix + name])[0])

    def unknown_files(self) -> tuple[str, ...]:
        """Return the files and folders of the sequence that are not part of the layout; names of
        folders end in "/".
        """
        suffixes: dict[str, set[str]] = {}
        for field in self._listing.values():
            suffixes.setdefault(field.folder, set()).add(field.suffix)
        known = {folder.partition("/")[0] for folder in suffixes}
        unknown = [
            f"{name}/" if is_folder else name
            for name, is_folder in self.tree.entries(self.path).items()
            if name not in {*known, *_TEXTS, layout.DERIVED}
        ]
        for folder, of_fields in suffixes.items():
            of_grid = () if folder in layout.scan_folders() else (layout.PARAMS, layout.REPORT)
            unknown += [
                f"{folder}/{name}"
                for name in self.tree.entries(self._prefix + folder)
                if name not in of_grid and not _is_frame(name, of_fields)
            ]
        return tuple(sorted(unknown))


def _marks() -> frozenset[str]:
    """Return the names by which a `<coordinates>` folder is recognised."""
    return layout.scan_folders() | {layout.EVALUATION, layout.POSES}


def _is_place(names: Iterable[str]) -> bool:
    """Whether a folder with these entries is that of a sequence or of a capture."""
    known = {*_marks(), *layout.COORDINATES, "raw"}
    return any(name in known or name.startswith(f"{layout.EVALUATION}_") for name in names)


def _first_place(tree: Tree, path: str, depth: int) -> str | None:
    """Return the first folder of a sequence or a capture, in sorted order."""
    entries = tree.entries(path)
    if _is_place(entries):
        return path
    for name in _folders(entries) if depth else ():
        if (found := _first_place(tree, f"{path}/{name}".lstrip("/"), depth - 1)) is not None:
            return found
    return None


def _folders_at(tree: Tree, path: str, depth: int) -> Iterator[str]:
    """Yield the folders at a depth, and those of sequences and captures above it."""
    entries = tree.entries(path) if depth else {}
    if not depth or _is_place(entries):
        yield path
        return
    for name in _folders(entries):
        yield from _folders_at(tree, f"{path}/{name}".lstrip("/"), depth - 1)


def _folders(entries: Mapping[str, bool]) -> list[str]:
    found = [name for name, is_folder in entries.items() if is_folder]
    return sorted(name for name in found if not name.startswith("."))


def _find_sequences(tree: Tree, path: str, depth: int) -> Iterator[str]:
    children = {
        name: is_folder
        for name, is_folder in tree.entries(path).items()
        if not name.startswith(".")
    }
    if _marks() & set(children) or any(
        name.startswith(f"{layout.EVALUATION}_") for name in children
    ):
        yield path
        return
    if depth == 0:
        return
    for name, is_folder in children.items():
        # a capture (carlasc.captures.raw) is not a sequence of the layout
        if is_folder and name != "raw":
            yield from _find_sequences(tree, f"{path}/{name}" if path else name, depth - 1)


def _is_frame(name: str, suffixes: Iterable[str]) -> bool:
    return any(layout.frame_of(name, suffix) is not None for suffix in suffixes)
