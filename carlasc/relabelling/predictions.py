"""`label`: a copy of a data set with the labels of files of network predictions: a class per point,
and optional probabilities.

See `docs/commands/label.md`.
"""

from __future__ import annotations

import os
import time
from collections.abc import Collection, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Self

import numpy as np

from carlasc.core.arrays import (
    AnyArray,
    AnyFloatArray,
    AnyIntArray,
    Float32Array,
    Uint16Array,
    Uint32Array,
)
from carlasc.core.classes import ClassTable
from carlasc.core.frames import FrameRange, Frames
from carlasc.core.tables import remaps_between, to_table
from carlasc.errors import ArgumentError, FormatError, MissingDataError, check_types, reading
from carlasc.relabelling.copies import (
    PREDICTED_FIELDS,
    LabelResult,
    PredictedSequence,
    begin_predicted,
    digest_of_files,
)
from carlasc.running.spreading import Run
from carlasc.storage import as_source, layout
from carlasc.storage.arrays import NUMBERS, WHOLE_NUMBERS, ArrayFormat, open_npz, read_npy
from carlasc.storage.class_files import read_classes
from carlasc.storage.derived_copies import sequences_with_scans
from carlasc.storage.files import AnyPath
from carlasc.storage.protocol import Sequence, Source
from carlasc.storage.shares import Share

SUFFIXES = (".label", ".npy", ".npz")
_LEAVES = ("labels", "predictions")  # names of folders with the files of one sequence
_FLOATS = tuple(kind for kind in NUMBERS if kind not in WHOLE_NUMBERS)
_TOLERANCE = 1e-3  # allowed deviation of the sum of probabilities of a point from 1
_PAIRS = 3  # number of classes per point that are stored with their probabilities
_NAMED = 5  # number of frames that a message lists


def label(
    source: AnyPath | Source,
    out: AnyPath,
    predictions: AnyPath,
    *,
    classes: AnyPath | ClassTable | None = None,
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
    check_types(label, locals())
    began = time.perf_counter()
    share = Share(as_source(source), run)
    root = Path(predictions)
    by = root.resolve().name if by is None else by
    table = None if classes is None else read_classes(classes)[0]
    chosen = FrameRange.of(frames)
    scans = sequences_with_scans(share)
    others = {place.rpartition("/")[2] for place in share.others} - {
        one.name for one in scans.values()
    }
    files = find_predictions(root, scans, chosen, others)
    sequences = {
        path: _LabelledSequence(one, files[path], PredictionReader.of(table, one, logits), by)
        for path, one in scans.items()
    }
    paths = (one.path(frame) for one in files.values() for frame in one.frames)
    settings = {"frames": str(chosen), "logits": logits, "predictions": digest_of_files(paths)}
    copy = begin_predicted(share, out, {**settings, "by": by}, table, overwrite, run)
    return LabelResult.of(copy.write(sequences, share.run), began, by, sequences.values())


@dataclass(frozen=True)
class PredictedFiles:
    """The files of one sequence: `<folder>/000000<suffix>` for each of the sorted frames."""

    folder: Path
    suffix: str
    frames: tuple[int, ...]

    def path(self, frame: int) -> Path:
        """Return the file of a frame."""
        return self.folder / f"{frame:06d}{self.suffix}"


def find_predictions(
    root: Path,
    sequences: Mapping[str, Sequence],
    chosen: FrameRange,
    left_out: Collection[str] = (),
) -> dict[str, PredictedFiles]:
    """Return the files of the chosen frames of each sequence. Folders with some names are
    not listed.

    The files of a sequence are in the only folder whose path contains the name of the sequence, and
    no name of another split or other coordinates. If there are several such folders, the one named
    labels or predictions is used. The files of a single sequence may also be in `root` itself, or
    in a folder with one of these two names.

    Raises:
        MissingDataError: a sequence has no folder, or a frame no file.
        FormatError: a sequence has several folders, or a folder has files with several suffixes.
    """
    by_folder: dict[tuple[str, ...], PredictedFiles] = {}
    for folder, below, names in os.walk(root):
        below[:] = [name for name in below if name not in left_out]
        for suffix in SUFFIXES:
            stems = [
                name.removesuffix(suffix)
                for name in names
                if layout.frame_of(name, suffix) is not None
            ]
            if numbers := sorted(int(stem) for stem in stems if stem == f"{int(stem):06d}"):
                parts = Path(folder).relative_to(root).parts
                if parts in by_folder:
                    raise FormatError(
                        folder,
                        expected="files with one suffix",
                        found=f"{by_folder[parts].suffix} and {suffix}",
                    )
                by_folder[parts] = PredictedFiles(Path(folder), suffix, tuple(numbers))
    result = {}
    lacking = []
    for path, sequence in sequences.items():
        # names of splits and coordinates that do not belong to the sequence
        others = {*layout.SPLITS, *layout.COORDINATES} - {sequence.split, sequence.coordinates}
        matching = [
            parts for parts in by_folder if sequence.name in parts and not others & set(parts)
        ]
        if not matching and len(sequences) == 1 and not left_out:
            matching = [parts for parts in by_folder if "/".join(parts) in ("", *_LEAVES)]
        matching = [parts for parts in matching if parts and parts[-1] in _LEAVES] or matching
        if len(matching) != 1:
            folders = (
                ", ".join(
                    "/".join(parts) or "." for parts in sorted(matching or by_folder)[:_NAMED]
                )
                or "none"
            )
            expected = f"one folder of files such as {sequence.name}/000000{SUFFIXES[0]} "
            expected += f"({', '.join(SUFFIXES[1:])})"
            raise (FormatError if matching else MissingDataError)(
                root, expected=expected, found=folders
            )
        files = by_folder[matching[0]]
        wanted = chosen.select(sequence.frames("points"))
        if len(missing := np.setdiff1d(wanted, files.frames)):
            first = ", ".join(f"{frame:06d}" for frame in missing[:_NAMED]) + ", ..." * (
                len(missing) > _NAMED
            )
            lacking.append(
                f"none for {len(missing)} of {len(wanted)} frames of {path or sequence.name} "
                f"({first})"
            )
        result[path] = replace(files, frames=tuple(wanted.tolist()))
    if lacking:
        advice = "predict these frames too, or leave them out with `frames`"
        raise MissingDataError(
            root, expected="a file for each frame", found="; ".join(lacking), advice=advice
        )
    return result


@dataclass(frozen=True)
class PredictionReader:
    """Reads files of predictions as fields of the layout.

    Attributes:
        classes: class table of the files.
        target: class table of the result.
        logits: whether the files hold scores before the softmax.
    """

    classes: ClassTable
    target: ClassTable
    logits: bool = False

    @classmethod
    def of(cls, given: ClassTable | None, sequence: Sequence, logits: bool) -> Self:
        """Return a reader of predictions for a sequence.

        It converts labels to the table of the sequence, if a remap from the given table exists.
        """
        own = sequence.metadata.classes
        classes = given or own
        try:
            remaps_between(classes, own)
        except ArgumentError:
            return cls(classes, classes, logits)
        return cls(classes, own, logits)

    def read(self, path: Path, count: int) -> tuple[Uint32Array, Uint16Array | None]:
        """Return the (N,) labels of the `count` points of a scan, and the (N, 6) field
        `probabilities`, or None if the file has none.

        Raises:
            MissingDataError: the file does not exist.
            FormatError: it is damaged, has not one row per point, has classes that the table lacks,
                or has rows that are not probabilities.
        """
        labels, scores = load(path)
        for rows in (labels, scores):
            if rows is not None and len(rows) != count:
                raise FormatError(path, expected=f"{count} rows, one per point", found=len(rows))
        if scores is not None:
            scores = self.probabilities(scores, str(path))
            labels = scores.argmax(axis=1) if labels is None else labels
        if labels is None:
            raise FormatError(path, expected="labels or probabilities", found="neither")
        self.check(np.unique(labels), str(path))
        converted = to_table(labels.astype(np.uint32), self.classes, self.target, str(path))
        pairs = None if scores is None else self.pairs(scores, str(path))
        return converted.astype(np.uint32), pairs

    def check(self, ids: AnyIntArray, where: str) -> None:
        """Check that the class table of the files contains the ids.

        Raises:
            FormatError: an id is missing in the table.
        """
        if len(unknown := ids[~np.isin(ids, list(self.classes.names))]):
            expected = (
                f"ids of the class table {self.classes.name}, up to {max(self.classes.names)}"
            )
            advice = "give the class table of the predictions as `classes`"
            raise FormatError(where, expected=expected, found=unknown[0], advice=advice)

    def probabilities(self, scores: AnyFloatArray, where: str) -> Float32Array:
        """Return (N, C) scores as float32 probabilities.

        Raises FormatError if they are not probabilities.
        """
        shares = scores.astype(np.float32)
        with np.errstate(invalid="ignore", over="ignore"):
            if self.logits:
                shares = np.exp(shares - shares.max(axis=1, keepdims=True))
                shares /= shares.sum(axis=1, keepdims=True)
            sums = shares.sum(axis=1)
            wrong = ~((np.abs(sums - 1) <= _TOLERANCE) & (shares.min(axis=1) >= 0))
        if wrong.any():
            row = int(wrong.argmax())
            found = f"a sum of {sums[row]:g} and a minimum of {shares[row].min():g} at point {row}"
            expected = "class probabilities that are at least 0 and sum to 1 within "
            expected += f"{_TOLERANCE} per point"
            advice = (
                "" if self.logits else "give `logits=True` if these are scores before the softmax"
            )
            raise FormatError(where, expected=expected, found=found, advice=advice)
        return shares

    def pairs(self, shares: Float32Array, where: str) -> Uint16Array:
        """Return the most probable classes of each point of (N, C) probabilities, with their
        probabilities. Merged classes are added up.
        """
        columns = np.flatnonzero(shares.max(axis=0, initial=0) * layout.CERTAIN >= 1).astype(
            np.uint32
        )
        self.check(columns, where)
        ids, place = np.unique(
            to_table(columns, self.classes, self.target, where), return_inverse=True
        )
        rest = np.zeros((len(shares), len(ids)), np.float32)
        for column, target in zip(columns.tolist(), place.reshape(-1).tolist(), strict=True):
            rest[:, target] += shares[:, column]
        pairs = np.zeros((len(shares), 2 * _PAIRS), np.uint16)
        rows = np.arange(len(shares))
        for k in range(min(_PAIRS, len(ids))):
            best = rest.argmax(axis=1)
            share = np.rint(np.clip(rest[rows, best], 0, 1) * layout.CERTAIN)
            pairs[:, 2 * k] = np.where(share > 0, ids[best], 0)
            pairs[:, 2 * k + 1] = share
            rest[rows, best] = -1
        return pairs


def load(path: Path) -> tuple[AnyArray | None, AnyArray | None]:
    """Return the labels, (N,) integers, and the scores, (N, C) floats, of a file; None for what it
    does not contain.
    """
    if path.suffix == ".npz":
        forms = ArrayFormat(WHOLE_NUMBERS, (None,)), ArrayFormat(_FLOATS, (None, None))
        with open_npz(path) as archive:
            labels, scores = (
                archive.read(name, form) if name in archive.names else None
                for name, form in zip(("labels", "probabilities"), forms, strict=True)
            )
        return labels, scores
    if path.suffix == ".npy":
        array = read_npy(path, ArrayFormat(NUMBERS, None))
        is_float = array.dtype.kind == "f"
        if array.ndim != 1 + is_float:
            found = f"{array.dtype.name} of shape {array.shape}"
            raise FormatError(
                path,
                expected="(N,) integers, or (N, C) floats with one column per class",
                found=found,
            )
        return (None, array) if is_float else (array, None)
    with reading(path, "a file that can be read"):
        data = path.read_bytes()
    if len(data) % 4:
        raise FormatError(
            path, expected="a multiple of 4 bytes (uint32 per point)", found=len(data)
        )
    return np.frombuffer(data, "<u4") & np.uint32(0xFFFF), None


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
        self.files = files
        self.reader = reader

    def make(self, frame: int) -> dict[str, AnyArray]:
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
