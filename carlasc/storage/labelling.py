"""Labels of a network as those of a data set: a copy of it, with other labels, whose other files are hard links to the same bytes."""

from __future__ import annotations

import os
import shutil
import time
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from hashlib import blake2b
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from carlasc.core.classes import ClassTable
from carlasc.core.frames import FrameRange, Frames
from carlasc.core.tables import remaps_between
from carlasc.errors import ArgumentError, ConflictError, FormatError, MissingDataError
from carlasc.running.spreading import Run
from carlasc.storage import layout
from carlasc.storage.copying import refuse_overlap
from carlasc.storage.durability import make_folder, replaced, sync_all, unfinished
from carlasc.storage.files import to_json, write_atomic
from carlasc.storage.folder import FolderSequence, FolderSource
from carlasc.storage.metadata import PREDICTED
from carlasc.storage.opening import as_source
from carlasc.storage.packed.output import remove
from carlasc.storage.predictions import (
    PredictedFiles,
    PredictionReader,
    find_predictions,
    load,
    read_table,
)
from carlasc.storage.protocol import ChosenSequences, Sequence, SequenceView, Source
from carlasc.storage.transport.trees import is_url
from carlasc.storage.unpacking import UnpackResult, unpack

_PREDICTED = ("labels", "probabilities")


@dataclass
class LabelResult(UnpackResult):
    """What `label` did: what `unpack` says of the folder, where `files` are those that were not linked, and this.

    Attributes:
        by: what made the labels.
        classes: name of the class table of the labels.
        frames: number of frames with labels.
        linked: number of files that are hard links to those of the source.
        left_out: what the data set lacks, because it was made from other labels or has other classes: grids, as "evaluation/", and "boxes".
    """

    by: str = ""
    classes: str = ""
    frames: int = 0
    linked: int = 0
    left_out: list[str] = field(default_factory=list)


def label(
    source: str | os.PathLike[str] | Source,
    out: str | os.PathLike[str],
    predictions: str | os.PathLike[str],
    *,
    classes: str | os.PathLike[str] | ClassTable | None = None,
    logits: bool = False,
    by: str | None = None,
    frames: Frames = None,
    overwrite: bool = False,
    run: Run = Run(),  # noqa: B008 (frozen)
) -> LabelResult:
    """Write a copy of a data set whose labels are those that a network predicted. The source is not changed.

    Files that do not change are hard links to those of the source, where both are folders of one file system: no file of either may be
    edited in place, which carlasc never does. Grids are left out: they were made from other labels. An interrupted run leaves
    `<out>.part`; the same call again finishes it.

    Args:
        source: what has the points: anything that `carlasc.open` takes, or a source.
        out: the folder to write: a path, or a URL of an object store.
        predictions: a folder with one file per frame, in folders such as `<split>/<sequence>/` or `<sequence>/predictions/`; for a single
            sequence they may lie in the folder itself. `.label`: uint32 per point, of which the lower 16 bits are the class. `.npy`: (N,)
            class ids, or (N, C) probabilities by class id. `.npz`: `labels` (N,), `probabilities` (N, C), or both.
        classes: class table of the predictions: its name, a JSON file, or a table; None for the one of each sequence. Labels are converted to
            the table of the sequence where carlasc knows how, otherwise the result has the table of the predictions.
        logits: whether (N, C) arrays hold scores from before the softmax.
        by: what made the labels, as carlasc.json, reports and cards name it; None for the name of the folder `predictions`.
        frames: range of the frames that get labels; the others are copied without. Each needs a file.
        overwrite: replace a data set at `out` that `label` has made.
        run: how the work is spread. Steps of progress are files.

    Returns:
        What was written.

    Raises:
        ArgumentError: `classes` or `by` is not valid.
        ConflictError: something exists at `out`, or `out` lies inside `source`, or an interrupted run had other predictions.
        MissingDataError: there are no predictions of a frame.
        FormatError: a file of predictions does not fit its scan, or its class table.
        StorageError: the files cannot be written.
    """
    began = time.perf_counter()
    run.part.refuse(overwrite)
    source, root = as_source(source), Path(predictions)
    refuse_overlap(out, source)
    by = root.resolve().name if by is None else by
    if not by.strip() or not by.isprintable():
        raise ArgumentError("by", expected="a name of one line", found=repr(by))
    table = None if classes is None else read_table(classes)
    chosen = FrameRange.of(frames)
    scans = {path: one for path, one in source.sequences().items() if len(one.frames("points"))}
    if not scans:
        raise MissingDataError(source.location, expected="sequences with points", found="none")
    files = find_predictions(root, scans, chosen)
    sequences = {
        path: _LabelledSequence(one, files[path], _reader(table, one, logits), by) for path, one in scans.items()
    }
    linked, folder, mark = 0, Path(out), None
    if not is_url(out):
        if run.part.count == 1:
            _clear(folder, overwrite=overwrite)
            folder = unfinished(folder)
            settings = {"source": source.location, "frames": str(chosen), "logits": logits, "by": by}
            settings |= {"classes": None if table is None else table.to_dict()}
            mark = _mark(folder, settings, files.values(), overwrite=overwrite)
        linked = sum(_link_files(one, folder / path) for path, one in sequences.items())
    copied = unpack(ChosenSequences(source.location, sequences), out, overwrite=overwrite and mark is None, run=run)
    if mark is not None:
        mark.unlink(missing_ok=True)
        if overwrite:
            remove(replaced(Path(out)))
    return LabelResult(
        **vars(copied) | {"kept": copied.kept - linked, "elapsed_s": time.perf_counter() - began},
        by=by,
        classes=", ".join(sorted({one.reader.target.name for one in sequences.values()})),
        frames=sum(len(one.frames) for one in files.values()),
        linked=linked,
        left_out=sorted({name for one in sequences.values() for name in one.left_out}),
    )


class _LabelledSequence(SequenceView):
    """A sequence with predicted labels instead of its own.

    Attributes:
        files: the files of predictions.
        reader: reads them.
        kept: fields of the sequence that do not change.
        left_out: what this sequence does not have: grids, and boxes of other classes.
    """

    def __init__(self, whole: Sequence, files: PredictedFiles, reader: PredictionReader, by: str) -> None:
        super().__init__(whole)
        self.files, self.reader = files, reader
        extra = {**whole.metadata.extra, "labels": f"{PREDICTED}{by}"}
        self._metadata = replace(whole.metadata, classes=reader.target, extra=extra).to_json()
        first = files.path(files.frames[0]) if files.frames else None  # the others are like the first
        self._own = frozenset(_PREDICTED[: 1 + (load(first)[1] is not None)] if first else ())
        stale = {"boxes"} if reader.target != whole.metadata.classes else set()  # their classes are of the other table
        self.kept = frozenset(name for name in whole.fields() - stale - {*_PREDICTED} if "/" not in name)
        self.left_out = stale & whole.fields() | {f"{grid}/" for grid in whole.grids}
        self._pairs: dict[int, NDArray[np.uint16]] = {}  # of frames whose labels have been read

    def fields(self) -> frozenset[str]:
        """Return the fields of the whole sequence without grids, and those that were predicted."""
        return self.kept | self._own

    def frames(self, field: str) -> NDArray[np.int64]:
        """Return the frames of a field."""
        if field in self._own:
            return np.array(self.files.frames, np.int64)
        return self.whole.frames(field) if field in self.kept else np.empty(0, np.int64)

    def read(self, field: str, frame: int) -> NDArray[Any]:
        """Read one field of one frame: probabilities of a frame whose labels were read before are not computed again."""
        if field not in self._own:
            return self.whole.read(field, frame)
        if field == "probabilities" and frame in self._pairs:
            return self._pairs.pop(frame)
        labels, pairs = self.reader.read(self.files.path(frame), len(self.whole.read("points", frame)))
        if (pairs is not None) != ("probabilities" in self._own):
            like, has = ("labels", "probabilities") if pairs is not None else ("probabilities", "labels only")
            raise FormatError(self.files.path(frame), expected=f"{like}, as in the first file", found=has)
        if pairs is None or field == "labels":
            self._pairs |= {} if pairs is None else {frame: pairs}
            return labels
        return pairs

    def documents(self) -> tuple[str, ...]:
        """Return the text files of the whole sequence without those of grids, and carlasc.json."""
        names = (name for name in self.whole.documents() if "/" not in name and name != layout.METADATA)
        return (*names, layout.METADATA)

    def read_document(self, name: str) -> bytes:
        """Return the bytes of a text file."""
        return self._metadata if name == layout.METADATA else self.whole.read_document(name)


def _reader(given: ClassTable | None, sequence: Sequence, logits: bool) -> PredictionReader:
    """Return what reads predictions for a sequence: as labels in its own table, if the given one can be converted to it."""
    own = sequence.metadata.classes
    try:
        remaps_between(given or own, own)
    except ArgumentError:
        return PredictionReader(given or own, given or own, logits)
    return PredictionReader(given or own, own, logits)


def _clear(out: Path, *, overwrite: bool) -> None:
    """Set aside a data set that `label` made, if it may be replaced: it is removed when the new one is whole.

    Raises:
        ConflictError: something exists that may not.
    """
    if not out.exists():
        return
    if not overwrite:
        advice = "choose another name, or give `overwrite=True`"
        raise ConflictError(out, expected="nothing there", found="a folder or a file", advice=advice)
    if not out.is_dir() or not all(one.metadata.predicted for one in FolderSource(out).sequences().values()):
        expected, advice = "a data set with predicted labels to overwrite", "choose another name"
        raise ConflictError(out, expected=expected, found="something else", advice=advice)
    remove(replaced(out))
    out.rename(replaced(out))


def _mark(folder: Path, settings: Mapping[str, Any], files: Iterable[PredictedFiles], *, overwrite: bool) -> Path:
    """Write beside an unfinished data set what it is made from, and return that file.

    Raises:
        ConflictError: what an interrupted run left in the folder was made from something else.
    """
    digest = blake2b(digest_size=16)
    for path in (one.path(frame) for one in files for frame in one.frames):
        found = path.stat()
        digest.update(f"{path}\0{found.st_size}\0{found.st_mtime_ns}\0".encode(errors="surrogateescape"))
    mark, data = folder.with_name(f"{folder.name}.json"), to_json({**settings, "predictions": digest.hexdigest()})
    before = mark.read_bytes() if mark.is_file() else None
    if folder.exists() and before != data:
        if before is None or not overwrite:
            expected = "what an interrupted run with the same predictions and options left"
            raise ConflictError(folder, expected=expected, found="that of another run", advice="remove it")
        shutil.rmtree(folder)
    write_atomic(mark, data)
    return mark


def _link_files(sequence: _LabelledSequence, folder: Path) -> int:
    """Make the unchanged files of a local folder hard links, as far as the file system allows, and count those of frames that are new."""
    whole, count = sequence.whole, 0
    if not isinstance(whole, FolderSequence):
        return 0
    paths = [name for name in sequence.documents() if name != layout.METADATA]
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
