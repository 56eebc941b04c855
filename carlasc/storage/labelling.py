"""`label`: a copy of a data set with predicted labels.

Other files are hard links to the files of the source.
"""

from __future__ import annotations

import os
import time
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from hashlib import blake2b
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from carlasc.core.classes import ClassTable
from carlasc.core.frames import FrameRange, Frames
from carlasc.core.tables import remaps_between
from carlasc.errors import ArgumentError, FormatError
from carlasc.running.spreading import Run
from carlasc.storage import layout
from carlasc.storage.derived_copies import (
    CopyResult,
    DerivedCopy,
    DerivedSequence,
    sequences_with_scans,
)
from carlasc.storage.metadata import PREDICTED
from carlasc.storage.opening import as_source
from carlasc.storage.predictions import (
    PredictedFiles,
    PredictionReader,
    find_predictions,
    load,
    read_table,
)
from carlasc.storage.protocol import Sequence, Source

_PREDICTED = ("labels", "probabilities")


@dataclass
class LabelResult(CopyResult):
    """Result of `label`. Boxes are left out if the labels have another class table.

    Attributes:
        by: name of the network that predicted the labels.
        classes: name of the class table of the labels.
        frames: number of frames with labels.
    """

    by: str = ""
    classes: str = ""
    frames: int = 0


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
    """Write a copy of a data set with the predicted labels of a network. The source is not changed.

    Unchanged files are hard links to the files of the source, if both are folders of one file
    system. Do not edit files of either in place; carlasc never does. Grids are left out, because
    they were made from other labels. An interrupted run leaves `<out>.part`; the same call finishes
    it.

    Args:
        source: the data set with the points: anything that `carlasc.open` takes, or a source.
        out: the folder to write: a path, or a URL of an object store.
        predictions: a folder with one file per frame, in folders such as `<split>/<sequence>/` or
            `<sequence>/predictions/`; for a single sequence they may be in the folder itself.
            `.label`: uint32 per point, of which the lower 16 bits are the class. `.npy`: (N,) class
            ids, or (N, C) probabilities by class id. `.npz`: `labels` (N,), `probabilities` (N, C),
            or both.
        classes: class table of the predictions: its name, a JSON file, or a table. Labels are
            converted to the table of the sequence if a remap exists; otherwise the result has the
            table of the predictions. None: the table of each sequence.
        logits: the predicted class scores are logits (before the softmax).
        by: name of the network, for the metadata, reports and cards. None: the name of the folder
            of predictions.
        frames: range of frames that get labels; each needs a file. Other frames are copied without
            labels.
        overwrite: replace a data set at `out` that `label` has made.
        run: how the work is distributed. Progress counts files.

    Returns:
        What was written.

    Raises:
        ArgumentError: `classes` or `by` is not valid.
        ConflictError: something exists at `out`, `out` lies inside `source`, or an interrupted run
            had other predictions.
        MissingDataError: a frame has no predictions.
        FormatError: a file of predictions does not fit its scan or its class table.
        StorageError: the files cannot be written.
    """
    began = time.perf_counter()
    source, root = as_source(source), Path(predictions)
    by = checked_name(root.resolve().name if by is None else by)
    table = None if classes is None else read_table(classes)
    chosen = FrameRange.of(frames)
    scans = sequences_with_scans(source)
    files = find_predictions(root, scans, chosen)
    sequences = {
        path: _LabelledSequence(one, files[path], reader_for(table, one, logits), by)
        for path, one in scans.items()
    }
    settings = {
        "frames": str(chosen),
        "logits": logits,
        "by": by,
        "predictions": _digest(files.values()),
    }
    settings |= {"classes": None if table is None else table.to_dict()}
    copy = begin_labelled(source, out, settings, overwrite, run)
    copied = copy.write(sequences, run)
    return LabelResult(
        **vars(copied) | {"elapsed_s": time.perf_counter() - began},
        by=by,
        classes=", ".join(sorted({one.reader.target.name for one in sequences.values()})),
        frames=sum(len(one.frames) for one in files.values()),
    )


def checked_name(by: str) -> str:
    """Return the name of the network that predicted labels, if it is valid.

    Raises:
        ArgumentError: it is empty, or has several lines.
    """
    if not by.strip() or not by.isprintable():
        raise ArgumentError("by", expected="a name in one line", found=repr(by))
    return by


def begin_labelled(
    source: Source,
    out: str | os.PathLike[str],
    settings: Mapping[str, Any],
    overwrite: bool,
    run: Run,
) -> DerivedCopy:
    """Begin a copy with predicted labels; see `DerivedCopy.begin`."""
    return DerivedCopy.begin(
        source,
        out,
        settings,
        kind="predicted labels",
        is_kind=lambda metadata: metadata.predicted is not None,
        overwrite=overwrite,
        run=run,
    )


class _LabelledSequence(DerivedSequence):
    """A sequence with predicted labels instead of its own.

    Attributes:
        files: the files of predictions.
        reader: reads them.
    """

    def __init__(
        self, whole: Sequence, files: PredictedFiles, reader: PredictionReader, by: str
    ) -> None:
        extra = {**whole.metadata.extra, "labels": f"{PREDICTED}{by}"}
        metadata = replace(whole.metadata, classes=reader.target, extra=extra).to_json()
        # boxes have classes of the other table
        stale = {"boxes"} if reader.target != whole.metadata.classes else set()
        # all files are like the first
        first = files.path(files.frames[0]) if files.frames else None
        own = _PREDICTED[: 1 + (load(first)[1] is not None)] if first else ()
        made = dict.fromkeys(own, np.array(files.frames, np.int64))
        super().__init__(
            whole, {layout.METADATA: metadata}, made=made, stale={*stale, *_PREDICTED} - {*own}
        )
        self.files, self.reader = files, reader

    def make(self, frame: int) -> dict[str, NDArray[Any]]:
        """Return the labels of a frame, and the probabilities if the files have them."""
        path = self.files.path(frame)
        found = dict(
            zip(
                _PREDICTED,
                self.reader.read(path, len(self.whole.read("points", frame))),
                strict=True,
            )
        )
        if (found["probabilities"] is not None) != ("probabilities" in self.made):
            words = (
                ("labels", "probabilities")
                if "probabilities" not in self.made
                else ("probabilities", "labels only")
            )
            advice = "predict all frames in the same form"
            raise FormatError(
                path, expected=f"{words[0]}, as in the first file", found=words[1], advice=advice
            )
        return {name: array for name, array in found.items() if array is not None}


def reader_for(given: ClassTable | None, sequence: Sequence, logits: bool) -> PredictionReader:
    """Return a reader of predictions for a sequence.

    It converts labels to the table of the sequence, if a remap exists.
    """
    own = sequence.metadata.classes
    try:
        remaps_between(given or own, own)
    except ArgumentError:
        return PredictionReader(given or own, given or own, logits)
    return PredictionReader(given or own, own, logits)


def _digest(files: Iterable[PredictedFiles]) -> str:
    """Return a digest of names, sizes and times of files."""
    digest = blake2b(digest_size=16)
    for path in (one.path(frame) for one in files for frame in one.frames):
        found = path.stat()
        digest.update(
            f"{path}\0{found.st_size}\0{found.st_mtime_ns}\0".encode(errors="surrogateescape")
        )
    return digest.hexdigest()
