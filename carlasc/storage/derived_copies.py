"""Copies of a data set in which some fields or text files are others: the files that do not change are hard links to the same bytes.

Grids are left out, because they were made from what changes. A copy is written as `unpack` writes: whatever interrupts it, the same call
again finishes it. Beside the unfinished copy, a mark says what it is made from, so that no other call does.
"""

from __future__ import annotations

import os
import shutil
import time
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from types import MappingProxyType
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from carlasc.errors import ConflictError, MissingDataError
from carlasc.running.spreading import Run
from carlasc.storage import layout
from carlasc.storage.copying import UnpackResult, refuse_overlap, unpack
from carlasc.storage.files import make_folder, replaced, sync_all, to_json, unfinished, write_atomic
from carlasc.storage.folder import FolderSequence, FolderSink, FolderSource
from carlasc.storage.metadata import Metadata
from carlasc.storage.packed.output import remove
from carlasc.storage.protocol import Sequence, Source
from carlasc.storage.sinks import SequenceWriter
from carlasc.storage.transport.trees import is_url
from carlasc.storage.views import ChosenSequences, SequenceView

_MOST_UNREAD = 64  # frames


@dataclass
class CopyResult(UnpackResult):
    """What writing a copy did: what `unpack` says of the folder, where `files` are those that were not linked, and this.

    Attributes:
        linked: number of files that are hard links to those of the source.
        left_out: what the copy lacks, because it does not fit what changed: grids, as "evaluation/", and fields.
    """

    linked: int = 0
    left_out: list[str] = field(default_factory=list)


class DerivedSequence(SequenceView):
    """A sequence without grids, some of whose fields and text files are others, or are left out.

    Attributes:
        texts: the text files that are others, or new, by name.
        made: the fields that are others, or new, each with its frames; a subclass makes them.
        kept: fields of the sequence that do not change.
        left_out: what the sequence has and this one does not.
    """

    def __init__(
        self,
        whole: Sequence,
        texts: Mapping[str, bytes],
        *,
        made: Mapping[str, NDArray[np.int64]] = MappingProxyType({}),
        stale: Collection[str] = (),
    ) -> None:
        """Show a sequence.

        Args:
            whole: the sequence.
            texts: the text files that are others, or new, by name.
            made: fields that are not taken from the sequence, each with its frames.
            stale: fields that are left out.
        """
        super().__init__(whole)
        self.texts, self.made = dict(texts), dict(made)
        self.kept = frozenset(name for name in whole.fields() - {*made, *stale} if "/" not in name)
        self._unread: dict[int, dict[str, NDArray[Any]]] = {}
        self.left_out = {*stale} & whole.fields() | {f"{grid}/" for grid in whole.grids}

    def fields(self) -> frozenset[str]:
        """Return the fields that do not change, and those that are made."""
        return self.kept | self.made.keys()

    def frames(self, field: str) -> NDArray[np.int64]:
        """Return the frames of a field."""
        return self.whole.frames(field) if field in self.kept else self.made.get(field, np.empty(0, np.int64))

    def make(self, frame: int) -> dict[str, NDArray[Any]]:
        """Return the fields of a frame that are made."""
        return {}

    def read(self, field: str, frame: int) -> NDArray[Any]:
        """Read one field of one frame. Those that are made are kept until the last one, in the order of their names, is read."""
        if field not in self.made:
            return self.whole.read(field, frame)
        if frame not in self._unread:
            if len(self._unread) == _MOST_UNREAD:
                self._unread.clear()
            self._unread[frame] = self.make(frame)
        array = self._unread[frame][field]
        if field == max(self.made):
            del self._unread[frame]
        return array

    def documents(self) -> tuple[str, ...]:
        """Return the text files of the whole sequence without those of grids, and the new ones."""
        return (*self.unchanged_documents(), *self.texts)

    def unchanged_documents(self) -> tuple[str, ...]:
        """Return the text files that do not change."""
        return tuple(name for name in self.whole.documents() if "/" not in name and name not in self.texts)

    def read_document(self, name: str) -> bytes:
        """Return the bytes of a text file."""
        return self.texts[name] if name in self.texts else self.whole.read_document(name)


def sequences_with_scans(source: Source) -> dict[str, Sequence]:
    """Return the sequences of a source that have points, by path.

    Raises:
        MissingDataError: there are none.
    """
    found = {path: one for path, one in source.sequences().items() if len(one.frames("points"))}
    if not found:
        raise MissingDataError(source.location, expected="sequences with points", found="none")
    return found


@dataclass(frozen=True)
class DerivedCopy:
    """A copy that is being written.

    Attributes:
        source: what it is a copy of.
        out: the folder to write: a path, or a URL of an object store.
        overwrite: whether it replaces another one.
        mark: the file that says what the unfinished copy is made from; None where there is none: in object stores, and where only a part
            of the files is written.
    """

    source: Source
    out: str | os.PathLike[str]
    overwrite: bool
    mark: Path | None

    @classmethod
    def begin(
        cls,
        source: Source,
        out: str | os.PathLike[str],
        made_from: Mapping[str, Any],
        *,
        kind: str,
        is_kind: Callable[[Metadata], bool],
        overwrite: bool,
        run: Run,
    ) -> Self:
        """Begin a copy, or continue an interrupted one.

        Args:
            source: what is copied.
            out: the folder to write: a path, or a URL of an object store.
            made_from: the options, and a digest of what is read beside the source, which an interrupted run must have had too.
            kind: what the copy has: "predicted labels". Only a data set that has it is replaced.
            is_kind: whether a sequence has it.
            overwrite: whether a copy at `out` is replaced; it is removed when the new one is whole.
            run: how the work is spread.

        Raises:
            ConflictError: something exists at `out` that may not be replaced, or `out` lies inside `source`, or an interrupted run was
                made from something else.
        """
        run.part.refuse(overwrite)
        refuse_overlap(out, source)
        mark = None
        if not is_url(out) and run.part.count == 1:
            _clear(Path(out), kind, is_kind, overwrite=overwrite)
            settings = {"source": source.location, "kind": kind, **made_from}
            mark = _mark(unfinished(Path(out)), settings, overwrite=overwrite)
        return cls(source, out, overwrite, mark)

    def writer(self, path: str) -> SequenceWriter | None:
        """Return where something derived of a sequence is kept until the copy is whole; None where there is no such place."""
        return None if self.mark is None else FolderSink(unfinished(Path(self.out))).sequence(path)

    def write(self, sequences: Mapping[str, DerivedSequence], run: Run) -> CopyResult:
        """Write the sequences of the copy.

        Args:
            sequences: the sequences by path.
            run: how the work is spread. Steps of progress are files.

        Raises:
            StorageError: the files cannot be written.
        """
        began, linked = time.perf_counter(), 0
        if not is_url(self.out):
            folder = Path(self.out) if self.mark is None else unfinished(Path(self.out))
            linked = sum(_link_files(one, folder / path) for path, one in sequences.items())
        chosen = ChosenSequences(self.source.location, sequences)
        copied = unpack(chosen, self.out, overwrite=self.overwrite and self.mark is None, run=run)
        if self.mark is not None:
            for path in sequences:
                shutil.rmtree(Path(self.out) / path / layout.DERIVED, ignore_errors=True)
            self.mark.unlink(missing_ok=True)
            if self.overwrite:
                remove(replaced(Path(self.out)))
        return CopyResult(
            **vars(copied) | {"kept": copied.kept - linked, "elapsed_s": time.perf_counter() - began},
            linked=linked,
            left_out=sorted({name for one in sequences.values() for name in one.left_out}),
        )


def _clear(out: Path, kind: str, is_kind: Callable[[Metadata], bool], *, overwrite: bool) -> None:
    """Set aside an older copy, if it may be replaced: it is removed when the new one is whole.

    Raises:
        ConflictError: something exists that may not.
    """
    if not out.exists():
        return
    if not overwrite:
        advice = "choose another name, or give `overwrite=True`"
        raise ConflictError(out, expected="nothing there", found="a folder or a file", advice=advice)
    if not out.is_dir() or not all(is_kind(one.metadata) for one in FolderSource(out).sequences().values()):
        expected, advice = f"a data set with {kind} to overwrite", "choose another name"
        raise ConflictError(out, expected=expected, found="something else", advice=advice)
    remove(replaced(out))
    out.rename(replaced(out))


def _mark(folder: Path, settings: Mapping[str, Any], *, overwrite: bool) -> Path:
    """Write beside an unfinished copy what it is made from, and return that file.

    Raises:
        ConflictError: what an interrupted run left in the folder was made from something else.
    """
    mark, data = folder.with_name(f"{folder.name}.json"), to_json(dict(settings))
    before = mark.read_bytes() if mark.is_file() else None
    if folder.exists() and before != data:
        if before is None or not overwrite:
            expected = "what an interrupted run with the same input and options left"
            raise ConflictError(folder, expected=expected, found="that of another run", advice="remove it")
        shutil.rmtree(folder)
    write_atomic(mark, data)
    return mark


def _link_files(sequence: DerivedSequence, folder: Path) -> int:
    """Make the unchanged files of a local folder hard links, as far as the file system allows, and count those of frames that are new."""
    whole, count = sequence.whole, 0
    if not isinstance(whole, FolderSequence):
        return 0
    paths = list(sequence.unchanged_documents())
    for name in sorted(sequence.kept):
        paths += map(layout.field_named(name).file, whole.frames(name).tolist())
    folders = {(folder / path).parent for path in paths}
    for place in sorted(folders):
        make_folder(place)
    for path in paths:
        try:
            os.link(os.path.realpath(whole.folder / path), folder / path)
            count += "/" in path  # text files are not counted
        except FileExistsError:  # of a run that was interrupted, or of another part of this one
            continue
        except OSError:  # the file system has no hard links, or not to that place: the other files are copied
            break
    sync_all(folders)
    return count
