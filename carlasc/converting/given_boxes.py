"""Boxes of a table that a conversion or an export takes, instead of those of the data set."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Self

import numpy as np

from carlasc.core.arrays import Float32Array, FloatArray, IntArray, Uint32Array
from carlasc.core.boxes import Boxes
from carlasc.core.classes import ClassTable
from carlasc.core.geometry import invert
from carlasc.errors import ArgumentError, FormatError, first_names
from carlasc.motion.box_table import BoxTable
from carlasc.storage.files import AnyPath

_NEAR_M = 30.0  # nearer boxes hold points, unless something hides them
_FLOOR = np.array([0, 0, 0.3])  # metres: what is lower is ground, as in boxes of other drives
# share of the near boxes with points: 0.97 or more with their own drive, 0.31 or less with another
# one (towns 51 and 52, streets 201 and 202)
_HELD = 0.4


@dataclass(frozen=True)
class GivenBoxes:
    """The boxes of a table.

    Attributes:
        table: the boxes.
        where: its file.
        labels: (R,) class ids of the output.
    """

    table: BoxTable
    where: str
    labels: Uint32Array

    @classmethod
    def read(cls, path: AnyPath, classes: ClassTable) -> Self:
        """Read a table with classes of a class table.

        Raises:
            MissingDataError: there is no such file.
            FormatError: a box is not valid, or has an unknown class.
        """
        table = BoxTable.read(path)
        try:
            labels = [classes.id_of(name) for name in table.classes]
        except ArgumentError as error:
            raise FormatError(path, expected=error.expected, found=error.where) from error
        return cls(table, str(path), np.array(labels, np.uint32))

    def at_scans(
        self, numbers: Sequence[int], times: FloatArray, poses: FloatArray | None, drive: str
    ) -> tuple[dict[int, Boxes], list[IntArray], list[str]]:
        """Return the boxes of each scan that has any, by frame number, in the frame of the scan;
        their rows in the table, in the same order; and remarks, one line each.

        Each box is moved by its velocity to the time of its scan. Tracks begin at 1.

        Args:
            numbers: the frame numbers of the F scans.
            times: (F,) seconds since the first frame of the drive, increasing.
            poses: (F, 4, 4) first_T_scan, right-handed; None if they are not estimated yet: then
                times are checked, and no box is returned.
            drive: the recording or the sequence, for errors.

        Raises:
            FormatError: the boxes are those of another drive.
        """
        table = self.table
        index = table.frames_of(times, poses, self.where, drive)
        if poses is None:
            return {}, [], []
        late_s = times[index] - table.times
        velocity = np.nan_to_num(table.values[:, 7:10])
        centers = table.values[:, :3] + velocity * late_s[:, None]
        half = table.values[:, 6] / 2
        turns = np.column_stack([np.cos(half), half * 0, half * 0, np.sin(half)])
        more = max(1 - int(table.numbers.min()), 0)
        tracks = (table.numbers + more).astype(np.uint32)
        columns = (tracks, self.labels, centers, turns, table.values[:, 3:6], tracks > 0)
        boxes = dict[int, Boxes]()
        rows = list[IntArray]()
        for one in np.unique(index[index >= 0]).tolist():
            rows.append(np.flatnonzero(index == one))
            own = Boxes(*(column[index == one] for column in columns))
            boxes[numbers[one]] = own.transform(invert(poses[one]))
        out = np.flatnonzero(index < 0)
        names = first_names(f"{table.numbers[row]} at {table.times[row]:g} s" for row in out)
        note = f"{len(out)} of {len(index)} boxes of {self.where} are at no scan, and are left out"
        return boxes, rows, [f"{note}: {names}"] if len(out) else []

    def check(self, boxes: Mapping[int, Boxes], scans: Mapping[int, Float32Array]) -> None:
        """Check that scans have points in the boxes near the sensor, or in the nearest one; both
        are by frame number.

        Raises:
            FormatError: the boxes are those of another drive.
        """
        held = np.zeros(0, np.bool_)
        for number, points in scans.items():
            away = np.linalg.norm(boxes[number].centers, axis=1)
            near = boxes[number].select(away <= max(_NEAR_M, away.min()))
            held = np.append(held, near.contains(points[:, :3] - _FLOOR).any(axis=1))
        if len(held) and held.mean() < _HELD:
            raise FormatError(
                self.where,
                expected="boxes around points of the scans",
                found=f"no point in {np.count_nonzero(~held)} of {len(held)} boxes near the sensor",
                advice="give the boxes of this drive, or accept them as they are with `force=True`",
            )
