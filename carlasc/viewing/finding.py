"""Finding the sequence, the ground truth, the grids and the frames of a scene, and reading them in
one class table.
"""

from __future__ import annotations

import os
from collections.abc import Iterable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from carlasc.core.boxes import Boxes
from carlasc.core.classes import ClassTable
from carlasc.core.geometry import Transform, check_rigid
from carlasc.core.grids import Grid, GridSpec
from carlasc.core.scans import Scan
from carlasc.core.tables import TABLES, remaps_between, to_table
from carlasc.errors import ArgumentError, FormatError, MissingDataError, first_names
from carlasc.storage import Sequence, Source, as_source, layout
from carlasc.storage.folder import FolderSequence

SceneSource = str | os.PathLike[str] | Source | Sequence
"""The source of a scene: anything that `carlasc.open` takes, a grid's folder, the file of one
frame, a Source or a Sequence.
"""


@dataclass(frozen=True, eq=False)
class FoundSequence:
    """A sequence, and the grid or frame that its path names.

    Attributes:
        sequence: the sequence.
        grid: name of the grid, if the path is a grid's folder or a file in it.
        frame: frame number, if the path is the file of one frame.
        is_scan: whether the path is a file of a scan (points, labels, ...).
        note: the choice among several sequences, or None.
    """

    sequence: Sequence
    grid: str | None = None
    frame: int | None = None
    is_scan: bool = False
    note: str | None = None


def find_sequence(source: SceneSource, name: str | None = None) -> FoundSequence:
    """Find the sequence that a source and a name describe.

    Args:
        source: see `SceneSource`.
        name: path or name of the sequence in the source; None takes the first.

    Raises:
        MissingDataError: there is no sequence, or none of that name.
        FormatError: the source cannot be read.
    """
    if isinstance(source, Sequence):
        return FoundSequence(source)
    if (found := _open_part(source)) is not None:
        return found
    return _choose_sequence(as_source(source), name)


def find_truth(truth: SceneSource, prediction: Sequence) -> FoundSequence:
    """Find the ground truth of a prediction: the sequence with its path, with its name, or the only
    one.

    Raises:
        MissingDataError: no sequence matches.
        FormatError: the source cannot be read.
    """
    if isinstance(truth, Sequence):
        return FoundSequence(truth)
    if (found := _open_part(truth)) is not None:
        return found
    source = as_source(truth)
    sequences = source.sequences()
    if len(sequences) == 1:
        return FoundSequence(next(iter(sequences.values())))
    identity = (prediction.name, prediction.coordinates)
    same_name = (
        sequence
        for sequence in sequences.values()
        if (sequence.name, sequence.coordinates) == identity
    )
    match = sequences.get(prediction.path) or next(same_name, None)
    if match is None:
        raise MissingDataError(
            source.location,
            expected=f"the sequence {prediction.name} ({prediction.coordinates})",
            found=first_names(sequences),
            advice="give the folder of the sequence",
        )
    return FoundSequence(match)


def _open_part(source: str | os.PathLike[str] | Source) -> FoundSequence | None:
    """Open a grid's folder or the file of one frame; None if the source is neither."""
    if isinstance(source, Source):
        return None
    path = Path(source)
    if path.is_file() and path.suffix in (".label", ".bin"):
        return _open_file(path.absolute())
    if (path / layout.PARAMS).is_file():
        path = path.absolute()
        return FoundSequence(FolderSequence(path.parent), grid=path.name)
    return None


def _open_file(path: Path) -> FoundSequence:
    """Open the sequence that a frame's file belongs to; its folder is that of a grid or of one of a
    scan's fields.
    """
    folder = path.parent
    frame = layout.frame_of(path.name, path.suffix)
    is_scan = folder.name in layout.scan_folders()
    if frame is None or not (is_scan or (folder / layout.PARAMS).is_file()):
        raise FormatError(
            path,
            expected=f"a file named by its frame number (six digits), in a folder of scans or "
            f"beside {layout.PARAMS}",
            found="another file",
            advice=f"the geometry of a grid is in its {layout.PARAMS}",
        )
    found = FoundSequence(FolderSequence(folder.parent), frame=frame, is_scan=is_scan)
    return found if is_scan else replace(found, grid=folder.name)


def _choose_sequence(source: Source, name: str | None) -> FoundSequence:
    sequences = source.sequences()
    if not sequences:
        raise MissingDataError(source.location, expected="a sequence", found="none")
    if name is None:
        path, first = next(iter(sequences.items()))
        note = f"{source.location}: {len(sequences)} sequences found, showing the first, {path}"
        return FoundSequence(first, note=note if len(sequences) > 1 else None)
    same_name = (sequence for sequence in sequences.values() if sequence.name == name)
    match = sequences.get(name) or next(same_name, None)
    if match is None:
        raise MissingDataError(
            source.location, expected=f"the sequence {name}", found=first_names(sequences)
        )
    return FoundSequence(match)


def table_of(classes: ClassTable | str | None) -> ClassTable | None:
    """Return a class table, which may be given by its name."""
    return TABLES[classes] if isinstance(classes, str) else classes


def choose_grid(found: FoundSequence, name: str | None) -> str:
    """Return the requested grid, the grid in the path, `evaluation`, or the first grid."""
    names = list(found.sequence.grids)
    wanted = name or found.grid
    if wanted is None:
        wanted = (
            layout.EVALUATION
            if layout.EVALUATION in names
            else next(iter(names), layout.EVALUATION)
        )
    if wanted not in names:
        raise MissingDataError(
            found.sequence.location,
            expected=f"the grid {wanted}",
            found=", ".join(names) or "no grid",
        )
    return wanted


def common_table(
    data: RemappedSequence, truth: RemappedSequence | None, wanted: ClassTable | None
) -> ClassTable:
    """Return the class table for all labels: the requested one, that of the data, or that of the
    ground truth.
    """
    stored = [data.stored_table] + ([] if truth is None else [truth.stored_table])
    candidates = stored if wanted is None else [wanted]
    for table in candidates[:-1]:
        try:
            _check_remaps(stored, table)
        except ArgumentError:
            continue
        return table
    _check_remaps(stored, candidates[-1])
    return candidates[-1]


def _check_remaps(stored: Iterable[ClassTable], target: ClassTable) -> None:
    """Raise ArgumentError if labels of one of the tables cannot be shown in the target."""
    for table in stored:
        remaps_between(table, target)


def frames_with(
    data: RemappedSequence, truth: RemappedSequence | None, contents: tuple[str, ...]
) -> NDArray[np.int64]:
    """Return the frames that have all contents."""
    own = {"scan": ("points",), "flow": ("points", "flow"), "truth": ()}
    needed = [
        (data.sequence, name) for c in contents for name in own.get(c, (f"{data.grid}/labels",))
    ]
    if truth is not None and {"truth", "errors"} & set(contents):
        needed.append((truth.sequence, f"{truth.grid}/labels"))
    frames: NDArray[np.int64] | None = None
    for sequence, name in needed:
        available = sequence.frames(name)
        if not len(available):
            raise MissingDataError(
                sequence.location, expected=f"the field {name}", found=list_fields(sequence)
            )
        common = available if frames is None else np.intersect1d(frames, available)
        if frames is not None and not len(common):
            raise MissingDataError(
                sequence.location,
                expected=f"{name} of frames {describe_frames(frames)}",
                found=f"frames {describe_frames(available)}",
            )
        frames = common
    return np.empty(0, np.int64) if frames is None else frames


def list_fields(sequence: Sequence) -> str:
    """Return the names of the fields of a sequence, for a message."""
    return ", ".join(sorted(sequence.fields())) or "nothing"


def describe_frames(frames: NDArray[np.int64]) -> str:
    """Return the first and the last of some frames and their number, for a message."""
    return f"{frames[0]} to {frames[-1]} ({len(frames)} frames)"


@dataclass(frozen=True, eq=False)
class RemappedSequence:
    """A sequence whose labels are read as classes of another table.

    Attributes:
        sequence: where frames are read from.
        grid: name of the grid that is read; "" for none.
        stored: class table of the labels in the sequence; None takes those in the metadata of the
            grid and of the scans.
        shown: class table in which labels are returned; None leaves them as they are stored.
    """

    sequence: Sequence
    grid: str
    stored: ClassTable | None = None
    shown: ClassTable | None = None

    @property
    def spec(self) -> GridSpec:
        """Geometry of the grid."""
        return self.sequence.grids[self.grid]

    @property
    def stored_table(self) -> ClassTable:
        """Class table of the grid's labels as they are stored, or of the scans' if no grid is read."""
        if self.stored is not None or not self.grid:
            return self.scan_table
        return self.sequence.classes_of(self.grid)

    @property
    def scan_table(self) -> ClassTable:
        """Class table of the scans' labels as they are stored: a prediction beside them may have
        another.
        """
        return self.sequence.metadata.classes if self.stored is None else self.stored

    def read_grid(self, frame: int) -> Grid:
        """Read the grid of a frame, in the table that is shown.

        Raises:
            FormatError: the grid does not have the format, or a label is not in its class table.
        """
        grid = self.sequence.grid(self.grid, frame)
        labels = self._remap(
            grid.labels, self.stored_table, f"{self.sequence.location}: {self.grid}, frame {frame}"
        )
        return replace(grid, labels=labels)

    def read_scan(self, frame: int) -> Scan:
        """Read the scan of a frame, in the table that is shown, without points that are not finite.

        Raises:
            FormatError: the scan does not have the format, or a label is not in its class table.
        """
        scan = without_invalid_points(self.sequence.scan(frame))
        if scan.boxes is not None:
            scan = replace(scan, boxes=self._remap_boxes(scan.boxes, frame))
        if scan.labels is None:
            return scan
        where = f"{self.sequence.location}: labels, frame {frame}"
        return replace(scan, labels=self._remap(scan.labels, self.scan_table, where))

    def read_boxes(self, frame: int) -> Boxes | None:
        """Read the tracked boxes of a frame, in the table that is shown; None where it was not
        annotated.

        Raises:
            FormatError: the boxes do not have the format, or a label is not in its class table.
        """
        boxes = self.sequence.boxes(frame)
        return None if boxes is None else self._remap_boxes(boxes, frame)

    def read_pose(self, frame: int) -> Transform | None:
        """Read (4, 4) first_T_sensor of a frame; None if the sequence has no poses.

        Raises:
            FormatError: the frame has no line in the file of poses, or its line is no rigid
                transform.
        """
        try:
            pose = self.sequence.read_pose(frame)
        except MissingDataError:
            return None
        return check_rigid(pose, f"{self.sequence.location}/{layout.POSES}: frame {frame}")

    def has(self, *fields: str) -> bool:
        """Whether the sequence has all of these fields."""
        return set(fields) <= set(self.sequence.fields())

    def frames_with(self, *fields: str) -> set[int]:
        """Return the frames that have all of these fields."""
        return set.intersection(*(set(self.sequence.frames(field).tolist()) for field in fields))

    def read_part(self, part: str, frame: int) -> NDArray[Any]:
        """Read a part of the grid of a frame, such as "posterior", in the shape of the grid.

        Raises:
            MissingDataError: the frame lacks it.
            FormatError: it does not have the format.
        """
        return self.sequence.read(f"{self.grid}/{part}", frame).reshape(self.spec.size)

    def _remap_boxes(self, boxes: Boxes, frame: int) -> Boxes:
        where = f"{self.sequence.location}: boxes, frame {frame}"
        return replace(boxes, labels=self._remap(boxes.labels, self.scan_table, where))

    def _remap(
        self, labels: NDArray[np.unsignedinteger], stored: ClassTable, where: str
    ) -> NDArray[np.unsignedinteger]:
        target = self.shown or stored
        labels = to_table(labels, stored, target, where)
        target.check(labels, where)
        return labels


def without_invalid_points(scan: Scan) -> Scan:
    """Return a scan without the points that have a coordinate that is NaN or infinite."""
    finite = np.isfinite(scan.points)
    return scan if finite.all() else scan.select(np.asarray(finite.all(axis=1)))
