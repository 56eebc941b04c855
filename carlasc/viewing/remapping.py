"""Reading a sequence whose labels are wanted in another class table."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from carlasc.core.boxes import Boxes
from carlasc.core.classes import ClassTable
from carlasc.core.geometry import Transform, check_rigid
from carlasc.core.grids import Grid, GridSpec
from carlasc.core.scans import Scan
from carlasc.core.tables import to_table
from carlasc.errors import MissingDataError
from carlasc.storage import Sequence, layout


@dataclass(frozen=True, eq=False)
class RemappedSequence:
    """A sequence whose labels are read as classes of another table.

    Attributes:
        sequence: where frames are read from.
        grid: name of the grid that is read; "" for none.
        stored: class table of the labels in the sequence; None takes what the metadata of the grid and of the scans say.
        shown: class table that labels are read in; None leaves them as they are stored.
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
        """Class table of the scans' labels as they are stored: a prediction beside them may have another."""
        return self.sequence.metadata.classes if self.stored is None else self.stored

    def read_grid(self, frame: int) -> Grid:
        """Read the grid of a frame, in the table that is shown.

        Raises:
            FormatError: the grid does not have the format, or a label is not in its class table.
        """
        grid = self.sequence.grid(self.grid, frame)
        labels = self._remap(grid.labels, self.stored_table, f"{self.sequence.location}: {self.grid}, frame {frame}")
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
        """Read the tracked boxes of a frame, in the table that is shown; None where it was not annotated.

        Raises:
            FormatError: the boxes do not have the format, or a label is not in its class table.
        """
        boxes = self.sequence.boxes(frame)
        return None if boxes is None else self._remap_boxes(boxes, frame)

    def read_pose(self, frame: int) -> Transform | None:
        """Read (4, 4) first_T_sensor of a frame; None if the sequence has no poses.

        Raises:
            FormatError: the frame has no line in the file of poses, or its line is no rigid transform.
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
    finite = np.asarray(np.isfinite(scan.points).all(axis=1))
    return scan if finite.all() else scan.select(finite)
