"""Finding which predicted grid belongs to which true one, in Sources and in plain folders of `.label` files."""

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

Where = str | os.PathLike[str] | Source
_BITS = 8


class GridFrames(ABC):
    """The frames of one grid.

    Attributes:
        path: of the sequence; "" where there is just one.
        location: what to call it in errors.
        spec: its geometry, None where nothing says.
        classes: the table of its ids, None where nothing says.
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
        """Return a frame's labels: (X, Y, Z), or flat where the geometry is not known."""

    @abstractmethod
    def known(self, frame: int) -> NDArray[np.bool_] | None:
        """Return which voxels of a frame are known (counts > 0, or not invalid), None where nothing says."""


class SequenceGrid(GridFrames):
    """A grid of a sequence of a Source."""

    def __init__(self, sequence: Sequence, grid: str) -> None:
        self.sequence, self.grid = sequence, grid
        self.path, self.location = sequence.path, f"{sequence.location}/{grid}"
        self.spec, self.classes = sequence.grids[grid], sequence.classes_of(grid)

    def frames(self) -> NDArray[np.int64]:
        """Return the frames with labels."""
        return self.sequence.frames(f"{self.grid}/labels")

    def labels(self, frame: int) -> NDArray[np.unsignedinteger]:
        """Return (X, Y, Z) labels."""
        return self.sequence.read(f"{self.grid}/labels", frame)

    def known(self, frame: int) -> NDArray[np.bool_] | None:
        """Return where the counts are above 0."""
        field = f"{self.grid}/counts"
        return self.sequence.read(field, frame) > 0 if field in self.sequence.fields() else None


class LabelFolder(GridFrames):
    """A plain folder of `000000.label` files without params.json, as other tools leave it.

    Beside them, `000000.bin` holds counts (float32), or `000000.invalid` SemanticKITTI's bit-packed mask. Labels are uint32, the layout's
    type; uint16 on both sides where the truth is SemanticKITTI's.
    """

    spec = None
    classes = None

    def __init__(self, folder: Path) -> None:
        self.folder, self.path, self.location = folder, "", str(folder)
        self.dtype: np.dtype[np.unsignedinteger] = np.dtype("<u4")
        self.voxels: int | None = None  # of a frame, where something says
        if len(self.frames()):
            self._look_beside(int(self.frames()[0]))

    def _look_beside(self, frame: int) -> None:
        """Learn from the files beside the labels how many voxels there are, and whether they are SemanticKITTI's."""
        if (counts := self._file(frame, ".bin")).is_file():
            self.voxels = counts.stat().st_size // 4
        elif (invalid := self._file(frame, ".invalid")).is_file():
            self.voxels, self.dtype = invalid.stat().st_size * _BITS, np.dtype("<u2")

    @cached_property
    def _frames(self) -> NDArray[np.int64]:
        numbers = [layout.frame_of(name, ".label") for name in os.listdir(self.folder)]
        return np.array(sorted(number for number in numbers if number is not None), np.int64)

    def frames(self) -> NDArray[np.int64]:
        """Return the frames of the files."""
        return self._frames

    def labels(self, frame: int) -> NDArray[np.unsignedinteger]:
        """Return flat labels."""
        path = self._file(frame, ".label")
        size, width = path.stat().st_size, self.dtype.itemsize
        if size % width or (self.voxels is not None and size != width * self.voxels):
            expected = "labels" if self.voxels is None else f"{self.voxels} labels"
            raise FormatError(
                path,
                expected=f"{expected} of {width} bytes ({self.dtype.name})",
                found=f"{size} bytes",
                advice="cut short, of another grid, or of another type",
            )
        return np.fromfile(path, self.dtype)

    def known(self, frame: int) -> NDArray[np.bool_] | None:
        """Return where counts are above 0, or SemanticKITTI's voxels that are not invalid."""
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

    pred: GridFrames
    truth: GridFrames


def pair_grids(pred: Where, truth: Where, pred_grid: str | None, truth_grid: str | None) -> list[Pair]:
    """Match predictions with truth: by the sequence's path, or, where each side has just one, by that.

    Raises:
        MissingDataError: a side has no grid, or a prediction has no truth.
    """
    truths = {grids.path: grids for grids in _open_grids(truth, truth_grid)}
    preds = list(_open_grids(pred, pred_grid or truth_grid))
    if len(preds) == len(truths) == 1:
        pairs = [Pair(preds[0], next(iter(truths.values())))]
    else:
        pairs = []
        for grids in preds:
            if grids.path not in truths:
                raise MissingDataError(
                    grids.location,
                    expected=f"truth for the sequence {grids.path!r}",
                    found=f"{_shorten(truths)}",
                    advice="give both sides from the same level",
                )
            pairs.append(Pair(grids, truths[grids.path]))
    for pair in pairs:
        _tell_size(pair)
    return pairs


def _tell_size(pair: Pair) -> None:
    """Let a plain folder of predictions know the size and, of SemanticKITTI's, the type that the truth says."""
    if isinstance(pair.pred, LabelFolder):
        if pair.truth.spec is not None:
            pair.pred.voxels = int(np.prod(pair.truth.spec.size))
        elif isinstance(pair.truth, LabelFolder):
            pair.pred.voxels, pair.pred.dtype = pair.truth.voxels, pair.truth.dtype


def _open_grids(where: Where, grid: str | None) -> Iterator[GridFrames]:
    if not isinstance(where, Source):
        folder = Path(where)
        if (folder / layout.PARAMS).is_file():  # one grid's folder: the sequence is the folder above
            where, grid = folder.absolute().parent, folder.absolute().name
        elif folder.is_dir() and len((plain := LabelFolder(folder)).frames()):
            yield plain
            return
    source = as_source(where)
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
    """The grid of that name; without a name the published one, or the only one there is."""
    names = [name for name in sequence.grids if f"{name}/labels" in sequence.fields()]
    if grid is not None:
        return grid if grid in names else None
    if layout.EVALUATION in names:
        return layout.EVALUATION
    if len(names) > 1:
        raise MissingDataError(
            sequence.location,
            expected=f"the grid {layout.EVALUATION}",
            found=f"{', '.join(names)}",
            advice="choose one by name",
        )
    return names[0] if names else None


def _shorten(paths: dict[str, GridFrames]) -> str:
    return ", ".join(list(paths)[:3]) + (", ..." if len(paths) > 3 else "")
