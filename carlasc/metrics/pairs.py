"""Matching the predicted grids with the true ones, in Sources and in plain folders of `.label` files."""

from __future__ import annotations

import os
from abc import ABC, abstractmethod
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from carlasc.core.classes import ClassTable
from carlasc.core.grids import GridSpec
from carlasc.errors import FormatError, MissingDataError
from carlasc.storage import Sequence, Source, as_source, layout

Place = str | os.PathLike[str] | Source
_BITS = 8  # voxels per byte of an .invalid file


class GridFrames(ABC):
    """The frames of one grid.

    Attributes:
        path: of the sequence; "" for a plain folder.
        location: what to call the grid in errors.
        spec: its geometry; None if it is not known.
        classes: the class table of its ids; None if it is not known.
    """

    path: str
    location: str
    spec: GridSpec | None
    classes: ClassTable | None

    @abstractmethod
    def frames(self) -> NDArray[np.int64]:
        """Return the sorted frames that have labels."""

    @abstractmethod
    def labels(self, frame: int) -> NDArray[np.unsignedinteger]:
        """Return the labels of a frame: (X, Y, Z), or (X * Y * Z,) if the geometry is not known."""

    @abstractmethod
    def known(self, frame: int) -> NDArray[np.bool_] | None:
        """Return which voxels of a frame are known (counts > 0, or not invalid); None if the data do not say."""


class SequenceGrid(GridFrames):
    """A grid of a sequence of a Source."""

    def __init__(self, sequence: Sequence, grid: str) -> None:
        self.sequence, self.grid = sequence, grid
        self.path, self.location = sequence.path, f"{sequence.location}/{grid}"
        self.spec, self.classes = sequence.grids[grid], sequence.classes_of(grid)

    def frames(self) -> NDArray[np.int64]:
        """Return the sorted frames that have labels."""
        return self.sequence.frames(f"{self.grid}/labels")

    def labels(self, frame: int) -> NDArray[np.unsignedinteger]:
        """Return (X, Y, Z) labels."""
        return self.sequence.read(f"{self.grid}/labels", frame)

    def known(self, frame: int) -> NDArray[np.bool_] | None:
        """Return (X, Y, Z) which voxels have votes; None for a grid without counts."""
        field = f"{self.grid}/counts"
        return self.sequence.read(field, frame) > 0 if field in self.sequence.fields() else None


class LabelFolder(GridFrames):
    """A folder of `000000.label` files without params.json, as other tools write it.

    The same folder may hold counts (`000000.bin`, float32) or SemanticKITTI's masks (`000000.invalid`, one bit per voxel). Labels are uint32,
    as in the layout, or uint16 where the ground truth is SemanticKITTI's.

    Attributes:
        dtype: type of the labels in the files.
        voxels: number of voxels per frame; None if it is not known.
    """

    spec = None
    classes = None

    def __init__(self, folder: Path) -> None:
        self.folder, self.path, self.location = folder, "", str(folder)
        self.dtype: np.dtype[np.unsignedinteger] = np.dtype("<u4")
        self.voxels: int | None = None
        if len(self.frames()):
            self._read_size(int(self.frames()[0]))

    def _read_size(self, frame: int) -> None:
        """Find the number of voxels, and whether the labels are SemanticKITTI's, from the size of the frame's other file."""
        if (counts := self._file(frame, ".bin")).is_file():
            self.voxels = counts.stat().st_size // 4
        elif (invalid := self._file(frame, ".invalid")).is_file():
            self.voxels, self.dtype = invalid.stat().st_size * _BITS, np.dtype("<u2")

    @cached_property
    def _frames(self) -> NDArray[np.int64]:
        numbers = [layout.frame_of(name, ".label") for name in os.listdir(self.folder)]
        return np.array(sorted(number for number in numbers if number is not None), np.int64)

    def frames(self) -> NDArray[np.int64]:
        """Return the sorted frames that have a `.label` file."""
        return self._frames

    def labels(self, frame: int) -> NDArray[np.unsignedinteger]:
        """Return (X * Y * Z,) labels.

        Raises:
            FormatError: the file does not have the size of a grid.
        """
        path = self._file(frame, ".label")
        size, width = path.stat().st_size, self.dtype.itemsize
        if size % width or (self.voxels is not None and size != width * self.voxels):
            number = "labels" if self.voxels is None else f"{self.voxels} labels"
            raise FormatError(
                path,
                expected=f"{number} of {width} bytes ({self.dtype.name})",
                found=f"{size} bytes",
                advice="the file is truncated, of another grid, or of another type",
            )
        return np.fromfile(path, self.dtype)

    def known(self, frame: int) -> NDArray[np.bool_] | None:
        """Return (X * Y * Z,) which voxels have votes, or are not invalid; None if there is no such file."""
        if (counts := self._file(frame, ".bin")).is_file():
            return np.fromfile(counts, "<f4") > 0
        if (invalid := self._file(frame, ".invalid")).is_file():
            return np.unpackbits(np.fromfile(invalid, np.uint8)) == 0
        return None

    def _file(self, frame: int, suffix: str) -> Path:
        return self.folder / f"{frame:06d}{suffix}"


@dataclass(frozen=True)
class Pair:
    """A predicted grid and the true one."""

    prediction: GridFrames
    truth: GridFrames


def pair_grids(source: Place, truth: Place, grid: str | None, truth_grid: str | None) -> list[Pair]:
    """Match predictions with the ground truth: by the paths of their sequences, or, if each side has one sequence, that one.

    Args:
        source: the predictions, as for `evaluate`.
        truth: the ground truth.
        grid: name of the predicted grid; None takes `truth_grid`.
        truth_grid: name of the true grid; None takes `evaluation`, or the only grid of a sequence.

    Raises:
        MissingDataError: a side has no grid, or a predicted sequence has no ground truth.
    """
    truths = {grids.path: grids for grids in _open_grids(truth, truth_grid)}
    predictions = list(_open_grids(source, grid or truth_grid))
    if len(predictions) == len(truths) == 1:
        pairs = [Pair(predictions[0], next(iter(truths.values())))]
    else:
        pairs = []
        for prediction in predictions:
            if prediction.path not in truths:
                raise MissingDataError(
                    prediction.location,
                    expected=f"ground truth for the sequence {prediction.path!r}",
                    found=_shorten(truths),
                    advice="give both sides from the same level, such as two data sets or two splits",
                )
            pairs.append(Pair(prediction, truths[prediction.path]))
    for pair in pairs:
        _share_size(pair)
    return pairs


def _share_size(pair: Pair) -> None:
    """Give a plain folder of predictions the number of voxels, and the type of SemanticKITTI's labels, from the ground truth."""
    if isinstance(pair.prediction, LabelFolder):
        if pair.truth.spec is not None:
            pair.prediction.voxels = int(np.prod(pair.truth.spec.size))
        elif isinstance(pair.truth, LabelFolder):
            pair.prediction.voxels, pair.prediction.dtype = pair.truth.voxels, pair.truth.dtype


def _open_grids(place: Place, grid: str | None) -> Iterator[GridFrames]:
    if not isinstance(place, Source):
        folder = Path(place)
        if (folder / layout.PARAMS).is_file():  # the folder of one grid: its sequence is the folder above
            place, grid = folder.absolute().parent, folder.absolute().name
        elif folder.is_dir() and len((plain := LabelFolder(folder)).frames()):
            yield plain
            return
    source = as_source(place)
    found = False
    for sequence in source.sequences().values():
        if name := _choose_grid(sequence, grid):
            found = True
            yield SequenceGrid(sequence, name)
    if not found:
        raise MissingDataError(
            source.location, expected=f"a grid {grid or 'with labels'} in at least one sequence", found="none"
        )


def _choose_grid(sequence: Sequence, grid: str | None) -> str | None:
    """Return the grid of that name; without a name `evaluation`, or the only grid; None if the sequence has no such grid."""
    names = [name for name in sequence.grids if f"{name}/labels" in sequence.fields()]
    if grid is not None:
        return grid if grid in names else None
    if layout.EVALUATION in names:
        return layout.EVALUATION
    if len(names) > 1:
        raise MissingDataError(
            sequence.location,
            expected=f"the grid {layout.EVALUATION}",
            found=", ".join(names),
            advice="choose one with `grid` or `truth_grid`",
        )
    return names[0] if names else None


def _shorten(paths: dict[str, GridFrames]) -> str:
    return ", ".join(list(paths)[:3]) + (", ..." if len(paths) > 3 else "")
