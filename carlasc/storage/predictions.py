"""The predictions of a network in files: a class for each point, and probabilities where the files have them. See `docs/commands/label.md`."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from carlasc.core.classes import ClassTable
from carlasc.core.frames import FrameRange
from carlasc.core.tables import TABLES, table_from_json, to_table
from carlasc.errors import ArgumentError, FormatError, MissingDataError
from carlasc.storage import layout
from carlasc.storage.arrays import NUMBERS, WHOLE_NUMBERS, ArrayFormat, open_npz, read_npy
from carlasc.storage.files import parse_json
from carlasc.storage.protocol import Sequence

SUFFIXES = (".label", ".npy", ".npz")
_LEAVES = ("labels", "predictions")  # folders of the files of one sequence
_FLOATS = tuple(kind for kind in NUMBERS if kind not in WHOLE_NUMBERS)
_TOLERANCE = 1e-3  # of the sum of the probabilities of a point
_PAIRS = 3  # classes of a point that are kept with their probabilities
_NAMED = 5  # frames that a message names


@dataclass(frozen=True)
class PredictedFiles:
    """The files of one sequence: `<folder>/000000<suffix>` for each of some frames, which are sorted."""

    folder: Path
    suffix: str
    frames: tuple[int, ...]

    def path(self, frame: int) -> Path:
        """Return the file of a frame."""
        return self.folder / f"{frame:06d}{self.suffix}"


def find_predictions(root: Path, sequences: Mapping[str, Sequence], chosen: FrameRange) -> dict[str, PredictedFiles]:
    """Return the files of the frames of each sequence that are in a range.

    The files of a sequence are in the only folder whose path has the name of the sequence, and no other split and coordinates than its own; of
    several, in the one called labels or predictions. Those of a single sequence may be in `root` itself, or in a folder of these two names.

    Raises:
        MissingDataError: a sequence has no folder, or a frame no file.
        FormatError: a sequence has several folders, or a folder files of several endings.
    """
    found: dict[tuple[str, ...], PredictedFiles] = {}
    for folder, _, names in os.walk(root):
        for suffix in SUFFIXES:
            stems = [name.removesuffix(suffix) for name in names if layout.frame_of(name, suffix) is not None]
            if numbers := sorted(int(stem) for stem in stems if stem == f"{int(stem):06d}"):
                parts = Path(folder).relative_to(root).parts
                if parts in found:
                    raise FormatError(
                        folder, expected="files of one ending", found=f"{found[parts].suffix} and {suffix}"
                    )
                found[parts] = PredictedFiles(Path(folder), suffix, tuple(numbers))
    result, lacking = {}, []
    for path, sequence in sequences.items():
        named = [parts for parts in found if sequence.name in parts and not _others(sequence) & set(parts)]
        if not named and len(sequences) == 1:
            named = [parts for parts in found if parts in ((), *((leaf,) for leaf in _LEAVES))]
        named = [parts for parts in named if parts and parts[-1] in _LEAVES] or named
        if len(named) != 1:
            folders = ", ".join("/".join(parts) or "." for parts in sorted(named or found)[:_NAMED]) or "none"
            expected = f"one folder of files such as {sequence.name}/000000{SUFFIXES[0]} ({', '.join(SUFFIXES[1:])})"
            raise (FormatError if named else MissingDataError)(root, expected=expected, found=folders)
        files = found[named[0]]
        wanted = chosen.select(sequence.frames("points"))
        if len(missing := np.setdiff1d(wanted, files.frames)):
            first = ", ".join(f"{frame:06d}" for frame in missing[:_NAMED]) + ", ..." * (len(missing) > _NAMED)
            lacking.append(f"none for {len(missing)} of {len(wanted)} frames of {path or sequence.name} ({first})")
        result[path] = replace(files, frames=tuple(wanted.tolist()))
    if lacking:
        advice = "predict them too, or leave them out with `frames`"
        raise MissingDataError(root, expected="a file for each frame", found="; ".join(lacking), advice=advice)
    return result


def _others(sequence: Sequence) -> set[str]:
    """Return the names of splits and coordinates that a path to files of the sequence does not have."""
    return {*layout.SPLITS, *layout.COORDINATES} - {sequence.split or "", sequence.coordinates}


def read_table(classes: str | os.PathLike[str] | ClassTable) -> ClassTable:
    """Return a class table: itself, the one of this name, or that of a JSON file: a table as carlasc.json has it, or a carlasc.json.

    Raises:
        ArgumentError: it is neither a name nor a file.
        FormatError: the file holds no class table.
    """
    if isinstance(classes, ClassTable) or str(classes) in TABLES:
        return classes if isinstance(classes, ClassTable) else TABLES[str(classes)]
    if not (path := Path(classes)).is_file():
        raise ArgumentError("classes", expected=f"one of {', '.join(TABLES)}, or a JSON file", found=repr(str(classes)))
    values = parse_json(path.read_bytes(), str(path))
    return table_from_json(values.get("classes", values), str(path))


@dataclass(frozen=True)
class PredictionReader:
    """Reads files of predictions as fields of the layout.

    Attributes:
        classes: class table of the files.
        target: class table of the result.
        logits: whether scores are taken before the softmax.
    """

    classes: ClassTable
    target: ClassTable
    logits: bool = False

    def read(self, path: Path, count: int) -> tuple[NDArray[np.uint32], NDArray[np.uint16] | None]:
        """Return the (N,) labels of the `count` points of a scan, and the (N, 6) field `probabilities`, None without probabilities.

        Raises:
            MissingDataError: the file does not exist.
            FormatError: it is damaged, has not one row for each point, other classes than the table, or rows that are no probabilities.
        """
        labels, scores = load(path)
        for rows in (labels, scores):
            if rows is not None and len(rows) != count:
                raise FormatError(path, expected=f"{count} rows, one for each point", found=str(len(rows)))
        if scores is not None:
            scores = self.probabilities(scores, str(path))
            labels = scores.argmax(axis=1) if labels is None else labels
        if labels is None:
            raise FormatError(path, expected="labels or probabilities", found="neither")
        self.check(np.unique(labels), str(path))
        converted = to_table(labels.astype(np.uint32), self.classes, self.target, str(path)).astype(np.uint32)
        return converted, None if scores is None else self.pairs(scores, str(path))

    def check(self, ids: NDArray[np.integer], where: str) -> None:
        """Check that the class table of the files has some ids.

        Raises:
            FormatError: it lacks one.
        """
        if len(unknown := ids[~np.isin(ids, list(self.classes.names))]):
            expected = f"ids of the class table {self.classes.name}, up to {max(self.classes.names)}"
            advice = "give the class table of the predictions as `classes`"
            raise FormatError(where, expected=expected, found=str(unknown[0]), advice=advice)

    def probabilities(self, scores: NDArray[np.floating], where: str) -> NDArray[np.float32]:
        """Return the (N, C) float32 probabilities that scores are, after checking that they are such."""
        shares = scores.astype(np.float32)
        with np.errstate(invalid="ignore", over="ignore"):
            if self.logits:
                shares = np.exp(shares - shares.max(axis=1, keepdims=True))
                shares /= shares.sum(axis=1, keepdims=True)
            sums = shares.sum(axis=1)
            wrong = ~((np.abs(sums - 1) <= _TOLERANCE) & (shares.min(axis=1) >= 0))
        if wrong.any():
            row = int(wrong.argmax())
            found = f"a sum of {sums[row]:g}, the least {shares[row].min():g}, at point {row}"
            expected = f"probabilities of classes, of which those of each point sum to 1 within {_TOLERANCE}"
            advice = "" if self.logits else "give `logits=True` if these are scores before the softmax"
            raise FormatError(where, expected=expected, found=found, advice=advice)
        return shares

    def pairs(self, shares: NDArray[np.float32], where: str) -> NDArray[np.uint16]:
        """Return the likeliest classes of each point of (N, C) probabilities, and their probabilities, added up where classes become one."""
        columns = np.flatnonzero(shares.max(axis=0, initial=0) * layout.CERTAIN >= 1).astype(np.uint32)
        self.check(columns, where)
        ids, place = np.unique(to_table(columns, self.classes, self.target, where), return_inverse=True)
        rest = np.zeros((len(shares), len(ids)), np.float32)
        for column, target in zip(columns.tolist(), place.reshape(-1).tolist(), strict=True):
            rest[:, target] += shares[:, column]
        pairs, rows = np.zeros((len(shares), 2 * _PAIRS), np.uint16), np.arange(len(shares))
        for k in range(min(_PAIRS, len(ids))):
            best = rest.argmax(axis=1)
            share = np.rint(np.clip(rest[rows, best], 0, 1) * layout.CERTAIN)
            pairs[:, 2 * k], pairs[:, 2 * k + 1] = np.where(share > 0, ids[best], 0), share
            rest[rows, best] = -1
        return pairs


def load(path: Path) -> tuple[NDArray[Any] | None, NDArray[Any] | None]:
    """Return the labels, (N,) whole numbers, and the scores, (N, C) floats, of a file, each if it has some."""
    labels: NDArray[Any] | None = None
    scores: NDArray[Any] | None = None
    if path.suffix == ".npz":
        with open_npz(path) as archive:
            if "labels" in archive.names:
                labels = archive.read("labels", ArrayFormat(WHOLE_NUMBERS, (None,)))
            if "probabilities" in archive.names:
                scores = archive.read("probabilities", ArrayFormat(_FLOATS, (None, None)))
        return labels, scores
    if path.suffix == ".npy":
        array = read_npy(path, ArrayFormat(NUMBERS, None))
        is_float = array.dtype.kind == "f"
        if array.ndim != 1 + is_float:
            found = f"{array.dtype.name} of shape {array.shape}"
            raise FormatError(path, expected="(N,) whole numbers, or (N, C) floats: a column per class", found=found)
        return (None, array) if is_float else (array, None)
    data = path.read_bytes()
    if len(data) % 4:
        raise FormatError(path, expected="a multiple of 4 bytes (uint32 per point)", found=str(len(data)))
    return np.frombuffer(data, "<u4") & np.uint32(0xFFFF), None
