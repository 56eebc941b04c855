"""What a path means to `render`: a sequence of any source, a grid's folder, or one frame's file."""

from __future__ import annotations

import os
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from carlasc.core.classes import ClassTable
from carlasc.core.grids import Grid
from carlasc.core.scans import Scan
from carlasc.core.tables import remaps_between, table_named, to_table
from carlasc.errors import ArgumentError, FormatError, MissingDataError
from carlasc.storage import Sequence, Source, layout
from carlasc.storage import open as open_source
from carlasc.storage.folders.folder import FolderSequence

Path_ = str | os.PathLike[str]


@dataclass(frozen=True, eq=False)
class Input:
    """A sequence, and what the path told beyond it.

    Attributes:
        sequence: where frames are read from.
        table: the classes shown: all labels are brought to them.
        stored: class table of all labels there, if a caller says it; None goes by what stands beside them.
        grid: the grid that the path named, or None.
        frame: the frame that the path named, or None.
        scan: the path named a file of a scan.
        note: what was chosen where there was a choice, or None.
    """

    sequence: Sequence
    table: ClassTable
    stored: ClassTable | None = None
    grid: str | None = None
    frame: int | None = None
    scan: bool = False
    note: str | None = None

    def stored_table(self, grid: str) -> ClassTable:
        """Return the class table of a grid's labels, with "" of the scans': a prediction's beside them may be another."""
        if self.stored is not None:
            return self.stored
        return self.sequence.classes_of(grid) if grid else self.sequence.metadata.classes

    def shown_as(self, target: ClassTable, grid: str) -> Input:
        """Return the input with its labels remapped to a table.

        Raises:
            ArgumentError: there is no way from the grid's classes (with "", the scans') to those.
        """
        remaps_between(self.stored_table(grid), target)
        return replace(self, table=target)

    def read_grid(self, grid: str, frame: int) -> Grid:
        """Read a grid, remapped."""
        found = self.sequence.grid(grid, frame)
        where = f"{self.sequence.location}: {grid}, frame {frame}"
        return replace(found, labels=to_table(found.labels, self.stored_table(grid), self.table, where))

    def read_scan(self, frame: int) -> Scan:
        """Read a scan, remapped."""
        scan = self.sequence.scan(frame)
        if scan.labels is None:
            return scan
        where = f"{self.sequence.location}: labels, frame {frame}"
        return replace(scan, labels=to_table(scan.labels, self.stored_table(""), self.table, where))

    def choose_grid(self, name: str | None) -> str:
        """Return the grid that is meant: the one named, `evaluation`, or the first.

        Raises:
            MissingDataError: it is not there.
        """
        names = list(self.sequence.grids)
        wanted = name or self.grid
        if wanted is None:
            wanted = layout.EVALUATION if layout.EVALUATION in names else next(iter(names), layout.EVALUATION)
        if wanted not in names:
            raise MissingDataError(
                self.sequence.location, expected=f"the grid {wanted}", found=f"{', '.join(names) or 'no grid'}"
            )
        return wanted


def open_input(path: Path_ | Source | Sequence, sequence: str | None = None, classes: str | None = None) -> Input:
    """Find the sequence that is meant.

    Args:
        path: anything `carlasc.open` takes, a grid's folder, a file of a frame in either, a Source or a Sequence.
        sequence: path or name of the sequence, where there are several; None takes the first.
        classes: class table of its labels, where nothing beside them says; None goes by carlasc.json.

    Raises:
        MissingDataError: there is nothing, or not what was named.
        FormatError: it is no such thing.
    """
    if isinstance(path, Sequence):
        found = Input(path, path.metadata.classes)
    elif isinstance(path, Source):
        found = _choose(path, sequence)
    elif (local := Path(os.fspath(path))).is_file() and local.suffix in (".label", ".bin"):
        found = _open_file(local)
    elif (local / layout.PARAMS).is_file():
        found = _in_folder(local.absolute().parent, grid=local.absolute().name)
    else:
        found = _choose(open_source(path), sequence)
    return found if classes is None else replace(found, table=_table(classes), stored=_table(classes))


def find_truth(truth: Path_ | Source | Sequence, of: Sequence) -> Input:
    """Find the truth's sequence that belongs to a prediction's: its path, its name, or the only one there is.

    Raises:
        MissingDataError: none does.
    """
    if isinstance(truth, Sequence) or (not isinstance(truth, Source) and (Path(truth) / layout.PARAMS).is_file()):
        return open_input(truth)
    if not isinstance(truth, Source) and Path(truth).is_file() and Path(truth).suffix in (".label", ".bin"):
        return open_input(truth)
    source = truth if isinstance(truth, Source) else open_source(truth)
    sequences = source.sequences()
    if len(sequences) == 1:
        (only,) = sequences.values()
        return Input(only, only.metadata.classes)
    match = sequences.get(of.path) or next(
        (s for s in sequences.values() if (s.name, s.coordinates) == (of.name, of.coordinates)), None
    )
    if match is None:
        raise MissingDataError(
            source.location,
            expected=f"the sequence {of.name} ({of.coordinates})",
            found=f"{_listed(list(sequences))}",
            advice="give its folder",
        )
    return Input(match, match.metadata.classes)


def in_one_table(
    data: Input, grid: str, truth: Input | None, truth_grid: str, classes: str | None
) -> tuple[Input, Input | None]:
    """Bring a grid and its truth to the classes asked for, or to the same ones; "" stands for the scans, where no grid is shown.

    Raises:
        ArgumentError: no class table of that name, or no way from the labels' classes to it.
    """
    own = data.stored_table(grid)
    if truth is None:
        return data.shown_as(own if classes is None else _table(classes), grid), None
    if classes is not None:
        return data.shown_as(_table(classes), grid), truth.shown_as(_table(classes), truth_grid)
    try:
        return data.shown_as(own, grid), truth.shown_as(own, truth_grid)
    except ArgumentError:
        other = truth.stored_table(truth_grid)
        return data.shown_as(other, grid), truth.shown_as(other, truth_grid)


def _table(name: str) -> ClassTable:
    try:
        return table_named(name)
    except FormatError as error:
        raise ArgumentError(str(error)) from error


def _open_file(path: Path) -> Input:
    """A file of one frame: its folder is a grid's or one of a scan's fields."""
    folder = path.absolute().parent
    frame = layout.frame_of(path.name, path.suffix)
    is_scan = folder.name in layout.scan_folders()
    if frame is None or not (is_scan or (folder / layout.PARAMS).is_file()):
        raise FormatError(
            f"{path}: expected a frame of six digits with {layout.PARAMS} beside it, or in one of a scan's folders: the grid's geometry is not known"
        )
    return replace(_in_folder(folder.parent, grid=None if is_scan else folder.name), frame=frame, scan=is_scan)


def _in_folder(folder: Path, grid: str | None) -> Input:
    sequence = FolderSequence(folder)
    return Input(sequence, sequence.metadata.classes, grid=grid)


def _choose(source: Source, name: str | None) -> Input:
    sequences = source.sequences()
    if not sequences:
        raise MissingDataError(source.location, expected="a sequence", found="none")
    if name is None:
        path, sequence = next(iter(sequences.items()))
        note = f"{len(sequences)} sequences there: took {path}; choose with --sequence" if len(sequences) > 1 else None
        return Input(sequence, sequence.metadata.classes, note=note)
    match = sequences.get(name) or next((s for s in sequences.values() if s.name == name), None)
    if match is None:
        raise MissingDataError(source.location, expected=f"the sequence {name}", found=f"{_listed(list(sequences))}")
    return Input(match, match.metadata.classes)


def _listed(names: list[str]) -> str:
    return ", ".join(names[:8]) + (f" and {len(names) - 8} more" if len(names) > 8 else "")


def frames_in(available: np.ndarray, wanted: tuple[int | None, int | None] | None) -> list[int]:
    """Return the frames of a half-open range."""
    start, stop = wanted or (None, None)
    keep = (available >= (0 if start is None else start)) & (True if stop is None else available < stop)
    return [int(frame) for frame in available[keep]]
