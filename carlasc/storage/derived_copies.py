"""Copies of a data set with some fields or text files replaced.

Unchanged files are hard links to the files of the source.

Grids are left out, because they were made from the replaced data. A copy is written like the output
of `unpack`: after an interruption, the same call finishes it. A mark beside the unfinished copy
records its input and options, so that only the same call continues it.
"""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np

from carlasc.core.arrays import AnyArray, IntArray
from carlasc.errors import CarlascError, CompleteError, ConflictError, MissingDataError
from carlasc.running.spreading import Run
from carlasc.storage import layout
from carlasc.storage.copying import UnpackResult, refuse_overlap, unpack, write_files
from carlasc.storage.files import (
    AnyPath,
    has_content,
    make_folder,
    remove,
    remove_stale_of,
    replaced,
    sync_all,
    to_json,
    unfinished,
    write_atomic,
)
from carlasc.storage.folder import FolderSequence, FolderSink, FolderSource
from carlasc.storage.inputs import combined, sequence_states
from carlasc.storage.layout import Metadata
from carlasc.storage.protocol import Sequence, SequenceWriter, Source
from carlasc.storage.shares import Share
from carlasc.storage.transport.trees import is_url
from carlasc.storage.views import ChosenSequences, SequenceView

_MOST_UNREAD = 64  # frames
_RECORD = layout.record_file("copy")  # of the input and options, in the finished copy


@dataclass
class CopyResult(UnpackResult):
    """Result of writing a copy: the attributes of `UnpackResult`, where `files` counts files that
    are not links, and these.

    Attributes:
        linked: number of files that are hard links to files of the source.
        left_out: names of grids, such as "evaluation/", and fields that are not copied, because
            they do not fit the replaced data.
    """

    linked: int = 0
    left_out: list[str] = field(default_factory=list)


class DerivedSequence(SequenceView):
    """A sequence without grids, in which some fields and text files are replaced, added or left
    out.

    Attributes:
        texts: the replaced or new text files by name.
        made: the replaced or new fields, each with its frames; a subclass makes them.
        kept: the unchanged fields.
        left_out: names of the grids and fields that are left out.
    """

    def __init__(
        self,
        whole: Sequence,
        texts: Mapping[str, bytes],
        *,
        made: Mapping[str, IntArray] = MappingProxyType({}),
        stale: Collection[str] = (),
    ) -> None:
        """Wrap a sequence.

        Args:
            whole: the sequence.
            texts: the replaced or new text files by name.
            made: the replaced or new fields, each with its frames.
            stale: fields that are left out.
        """
        super().__init__(whole)
        self.texts = dict(texts)
        self.made = dict(made)
        self.kept = frozenset(name for name in whole.fields() - {*made, *stale} if "/" not in name)
        self._unread: dict[int, dict[str, AnyArray]] = {}
        self.left_out = {*stale} & whole.fields() | {f"{grid}/" for grid in whole.grids}

    def fields(self) -> frozenset[str]:
        """Return the unchanged fields and the replaced or new ones."""
        return self.kept | self.made.keys()

    def frames(self, field: str) -> IntArray:
        """Return the frames of a field."""
        return (
            self.whole.frames(field)
            if field in self.kept
            else self.made.get(field, np.empty(0, np.int64))
        )

    def make(self, frame: int) -> dict[str, AnyArray]:
        """Return the replaced or new fields of a frame."""
        return {}

    def read(self, field: str, frame: int) -> AnyArray:
        """Read one field of one frame.

        All made fields of a frame are kept in memory until the last of them, by name, is read.
        """
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
        """Return the text files of the whole sequence, without the ones of grids, and the new text
        files.
        """
        return (*self.unchanged_documents(), *self.texts)

    def unchanged_documents(self) -> tuple[str, ...]:
        """Return the unchanged text files."""
        return tuple(
            name for name in self.whole.documents() if "/" not in name and name not in self.texts
        )

    def read_document(self, name: str) -> bytes:
        """Return the bytes of a text file."""
        return self.texts[name] if name in self.texts else self.whole.read_document(name)


def sequences_with_scans(source: Source) -> dict[str, Sequence]:
    """Return the sequences of a source that have points, by path; a part may have none.

    Raises:
        MissingDataError: no sequence has points.
    """
    found = {path: one for path, one in source.sequences().items() if len(one.frames("points"))}
    if not (found or (isinstance(source, Share) and source.others)):
        raise MissingDataError(source.location, expected="sequences with points", found="none")
    return found


class DerivedCopy:
    """A copy of a data set that is being written.

    Attributes:
        source: the source of the copy.
        out: the folder to write: a path, or a URL of an object store.
        overwrite: whether it replaces an existing copy.
        part: the part of the run.
        made_from: digest of input and options.
        mark: the file that records input and options of the unfinished copy; None in object stores,
            and in runs of several parts.
    """

    def __init__(
        self,
        source: Source,
        out: AnyPath,
        made_from: Mapping[str, Any],
        *,
        kind: str,
        is_kind: Callable[[Metadata], bool],
        overwrite: bool,
        run: Run,
    ) -> None:
        """Begin a copy, or continue an interrupted one.

        Args:
            source: the data set to copy.
            out: the folder to write: a path, or a URL of an object store.
            made_from: the options, and a digest of other input files. An interrupted run is
                continued only if these are equal.
            kind: name of the replaced data, such as "predicted labels". Only a data set with such
                data is overwritten.
            is_kind: returns whether a sequence with this metadata has such data.
            overwrite: whether a copy at `out` is replaced; it is removed when the new copy is
                complete.
            run: how the work is distributed.

        Raises:
            ConflictError: something at `out` may not be replaced, `out` lies inside `source`, or an
                interrupted run had another input or other options.
            CompleteError: `out` is the copy that this call would make.
        """
        run.part.refuse(overwrite)
        refuse_overlap(out, source)
        self.source = source
        self.out = out
        self.overwrite = overwrite
        self.part = run.part
        self.folder = Path(out)
        self.partial, self.older = unfinished(self.folder), replaced(self.folder)
        # beside an unfinished copy; records its input and options
        self.mark: Path | None = None
        inputs = sequence_states(source)
        about = {"source": source.location, "kind": kind, "inputs": inputs, **made_from}
        settings = to_json(about)
        self.made_from = combined(settings)
        if not (is_url(out) or run.part.count > 1):
            self.mark = self.partial.with_name(f"{self.partial.name}.json")
            if not overwrite and self.folder.exists():
                if self._was_finished(settings):
                    self._finish(FolderSource(out).sequences())
                if has_content(record := self.folder / _RECORD):
                    check_complete(out, record.read_bytes() == settings)
            _check_replaceable(self.folder, kind, is_kind, overwrite=overwrite)
            _begin(self.mark, self.partial, settings, overwrite=overwrite)
            if self.folder.exists():  # an older copy, removed when the new one is complete
                remove(self.older)
                self.folder.rename(self.older)

    def writer(self, path: str) -> SequenceWriter | None:
        """Return the writer for data derived from a sequence, kept until the copy is complete; None
        if they cannot be kept.
        """
        return None if self.mark is None else FolderSink(self.partial).sequence(path)

    def write(self, sequences: Mapping[str, DerivedSequence], run: Run) -> CopyResult:
        """Write the sequences of the copy.

        Args:
            sequences: the sequences by path.
            run: how the work on these is distributed. Progress counts files.

        Raises:
            StorageError: the files cannot be written.
        """
        linked = 0
        if not is_url(self.out):
            folder = self.folder if self.mark is None else self.partial
            linked = sum(_link_files(one, folder / path) for path, one in sequences.items())
        with self._naming_older():
            if self.mark is None:
                copied = UnpackResult(str(self.out) if is_url(self.out) else self.folder)
                write_files(
                    sequences,
                    FolderSink(self.out),
                    copied,
                    run,
                    self.part,
                    self.made_from,
                    again=self.overwrite,
                )
            else:
                copied = unpack(ChosenSequences(self.source.location, sequences), self.out, run=run)
        self._finish(sequences)
        return CopyResult(
            **vars(copied) | {"kept": copied.kept - linked},
            linked=linked,
            left_out=sorted({name for one in sequences.values() for name in one.left_out}),
        )

    def _was_finished(self, settings: bytes) -> bool:
        """Whether a killed run had these settings, and all files of the copy have their place."""
        mark = self.mark
        if mark is None or self.partial.exists() or not has_content(mark):
            return False
        return mark.read_bytes() == settings

    def _finish(self, paths: Iterable[str]) -> None:
        """Write the record of the copy, and remove what was kept until it is complete."""
        if self.mark is None:
            return
        for path in paths:
            shutil.rmtree(self.folder / path / layout.DERIVED, ignore_errors=True)
        write_atomic(self.folder / _RECORD, self.mark.read_bytes())
        self.mark.unlink(missing_ok=True)
        if self.overwrite:
            remove(self.older)

    @contextmanager
    def _naming_older(self) -> Iterator[None]:
        """Say in errors where the older copy is that was moved aside."""
        try:
            yield
        except CarlascError as error:
            if self.older.exists() and not self.folder.exists():
                where = f"the data set that was in {self.folder.name} is in {self.older}"
                error.advice = "; ".join(part for part in (error.advice, where) if part)
            raise


def check_complete(out: AnyPath, is_complete: bool) -> None:
    """Say that an output needs no work.

    Raises:
        CompleteError: it is complete.
    """
    if is_complete:
        problem = "it is complete, and nothing changed"
        advice = "`overwrite=True` makes it again"
        raise CompleteError(out, problem=problem, advice=advice)


def _check_replaceable(
    out: Path, kind: str, is_kind: Callable[[Metadata], bool], *, overwrite: bool
) -> None:
    """Check that nothing is at `out`, or an older copy that may be replaced.

    Raises:
        ConflictError: the existing files may not be replaced.
    """
    if not out.exists():
        return
    if not overwrite:
        advice = "choose another name, or give `overwrite=True`"
        raise ConflictError(out, expected="a new path", found="a folder or a file", advice=advice)
    if not out.is_dir() or not all(
        is_kind(one.metadata) for one in FolderSource(out).sequences().values()
    ):
        expected = f"a data set with {kind} to overwrite"
        advice = "choose another name"
        raise ConflictError(out, expected=expected, found="something else", advice=advice)


def _begin(mark: Path, folder: Path, data: bytes, *, overwrite: bool) -> None:
    """Write input and options of an unfinished copy into its mark.

    Raises:
        ConflictError: the folder holds the files of an interrupted run with another input or other
            options.
    """
    remove_stale_of(mark)
    before = mark.read_bytes() if mark.is_file() else None
    if folder.exists() and before != data:
        if before is None or not overwrite:
            expected = "the files of an interrupted run with the same input and options"
            raise ConflictError(
                folder, expected=expected, found="files of another run", advice="remove the folder"
            )
        shutil.rmtree(folder)
    write_atomic(mark, data)


def _link_files(sequence: DerivedSequence, folder: Path) -> int:
    """Make hard links to the unchanged files of a local folder, if the file system supports it, and
    return the number of new frame files.
    """
    whole = sequence.whole
    count = 0
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
        except FileExistsError:  # from an interrupted run, or from another part of this run
            continue
        except (
            OSError
        ):  # the file system has no hard links, or is another one: the remaining files are copied
            break
    sync_all(folders)
    return count
