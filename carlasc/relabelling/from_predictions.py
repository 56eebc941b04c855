"""`label`: a copy of a data set with predicted labels.

Other files are hard links to the files of the source.
"""

from __future__ import annotations

import os
import time
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from carlasc.core.classes import ClassTable
from carlasc.core.frames import FrameRange, Frames
from carlasc.errors import FormatError
from carlasc.relabelling.copies import (
    PREDICTED_FIELDS,
    LabelResult,
    PredictedSequence,
    begin_predicted,
    digest_of_files,
)
from carlasc.relabelling.predictions import (
    PredictedFiles,
    PredictionReader,
    find_predictions,
    load,
    read_table,
)
from carlasc.running.spreading import Run
from carlasc.storage import as_source
from carlasc.storage.derived_copies import sequences_with_scans
from carlasc.storage.protocol import Sequence, Source


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
        classes: class table of the predictions: its name, a JSON file, or a table; None for the
            table of each sequence. Labels are converted to the table of the sequence if a remap
            exists; otherwise the result has the table of the predictions.
        logits: whether (N, C) arrays hold scores before the softmax.
        by: name of the network in carlasc.json, reports and cards; None for the name of the folder
            `predictions`.
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
    by = root.resolve().name if by is None else by
    table = None if classes is None else read_table(classes)
    chosen, scans = FrameRange.of(frames), sequences_with_scans(source)
    files = find_predictions(root, scans, chosen)
    sequences = {
        path: _LabelledSequence(one, files[path], PredictionReader.of(table, one, logits), by)
        for path, one in scans.items()
    }
    paths = (one.path(frame) for one in files.values() for frame in one.frames)
    settings = {"frames": str(chosen), "logits": logits, "predictions": digest_of_files(paths)}
    copy = begin_predicted(source, out, {**settings, "by": by}, table, overwrite, run)
    return LabelResult.of(copy.write(sequences, run), began, by, sequences.values())


class _LabelledSequence(PredictedSequence):
    """A sequence with the labels of files of predictions.

    Attributes:
        files: the files of predictions.
        reader: reads them.
    """

    def __init__(
        self, whole: Sequence, files: PredictedFiles, reader: PredictionReader, by: str
    ) -> None:
        # all files are like the first
        has_shares = bool(files.frames) and load(files.path(files.frames[0]))[1] is not None
        made = PREDICTED_FIELDS[: 1 + has_shares] if files.frames else ()
        super().__init__(
            whole, reader.target, by, dict.fromkeys(made, np.array(files.frames, np.int64))
        )
        self.files, self.reader = files, reader

    def make(self, frame: int) -> dict[str, NDArray[Any]]:
        """Return the labels of a frame, and the probabilities if the files have them."""
        path = self.files.path(frame)
        labels, pairs = self.reader.read(path, len(self.whole.read("points", frame)))
        if (pairs is not None) != ("probabilities" in self.made):
            kinds = (
                ("probabilities", "labels only") if pairs is None else ("labels", "probabilities")
            )
            raise FormatError(
                path,
                expected=f"{kinds[0]}, as in the first file",
                found=kinds[1],
                advice="predict all frames in the same form",
            )
        return {"labels": labels} | ({} if pairs is None else {"probabilities": pairs})
