"""Boxes of a table that a conversion takes, instead of those of the data set."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass
from typing import Self

import numpy as np

from carlasc.converting.assembling import AxesAndClasses, Rig, read_scan
from carlasc.converting.protocol import Recording
from carlasc.core.arrays import FloatArray, Uint32Array
from carlasc.core.boxes import Boxes
from carlasc.core.geometry import invert
from carlasc.errors import ArgumentError, CarlascError, FormatError, first_names
from carlasc.motion.box_table import BoxTable
from carlasc.storage.files import AnyPath

_SCANS = 5  # scans whose points are looked for in boxes
_NEAR_M = 30.0  # nearer boxes hold points, unless something hides them
_FLOOR_M = 0.3  # points below are of the ground, which is in boxes of other drives too
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
    def read(cls, path: AnyPath, target: AxesAndClasses) -> Self:
        """Read a table, whose classes are those of the output.

        Raises:
            MissingDataError: there is no such file.
            FormatError: a box is not valid, or has an unknown class.
        """
        table = BoxTable.read(path)
        try:
            labels = [target.classes.id_of(name) for name in table.classes]
        except ArgumentError as error:
            raise FormatError(path, expected=error.expected, found=error.where) from error
        return cls(table, str(path), np.array(labels, np.uint32))

    def at_scans(
        self, recording: Recording, times: FloatArray, first_T_scan: FloatArray, *, check: bool
    ) -> tuple[dict[int, Boxes], list[str]]:
        """Return the boxes of each scan that has any, by frame number, in the frame of the scan;
        and remarks, one line each. Tracks begin at 1.

        Args:
            recording: the recording, with the frames that are converted.
            times: (F,) seconds by frame number, by the recording's clock.
            first_T_scan: (F, 4, 4) poses by frame number, right-handed.
            check: whether scans are read, to see whether they have points in the boxes.

        Raises:
            FormatError: the boxes are those of another drive.
        """
        table, numbers = self.table, [handle.number for handle in recording.frames]
        seconds, poses = (times - times[0])[numbers], first_T_scan[numbers]
        index = table.frames_of(seconds, poses, self.where, recording.location)
        late_s = seconds[index] - table.times
        centers = table.values[:, :3] + np.nan_to_num(table.values[:, 7:10]) * late_s[:, None]
        half = table.values[:, 6] / 2
        turns = np.column_stack([np.cos(half), half * 0, half * 0, np.sin(half)])
        tracks = (table.numbers + max(1 - int(table.numbers.min()), 0)).astype(np.uint32)
        columns = (tracks, self.labels, centers, turns, table.values[:, 3:6], tracks > 0)
        boxes = dict[int, Boxes]()
        for one in np.unique(index[index >= 0]).tolist():
            own = Boxes(*(column[index == one] for column in columns))
            boxes[numbers[one]] = own.transform(invert(poses[one]))
        if check:
            self._check_points(recording, boxes)
        out = np.flatnonzero(index < 0)
        names = first_names(f"{table.numbers[row]} at {table.times[row]:g} s" for row in out)
        note = f"{len(out)} of {len(index)} boxes of {self.where} are at no scan, and are left out"
        return boxes, [f"{note}: {names}"] if len(out) else []

    def _check_points(self, recording: Recording, boxes: dict[int, Boxes]) -> None:
        """Check that some scans have points in boxes near the sensor."""
        handles = [one for one in recording.frames if one.number in boxes]
        rig, held = Rig.of(recording), np.zeros(0, np.bool_)
        for handle in handles[:: -(-len(handles) // _SCANS)]:
            own = boxes[handle.number]
            near = own.select(np.linalg.norm(own.centers, axis=1) < _NEAR_M)
            with suppress(CarlascError, OSError):  # the conversion of the frame reports the error
                points = read_scan(handle, rig, None).points[:, :3].astype(np.float64)
                held = np.append(held, near.contains(points - [0, 0, _FLOOR_M]).any(axis=1))
        if len(held) and held.mean() < _HELD:
            raise FormatError(
                self.where,
                expected=f"boxes around points of {recording.location}",
                found=f"no point in {np.count_nonzero(~held)} of {len(held)} boxes near the sensor",
                advice="give the boxes of this drive, or accept them as they are with `force=True`",
            )
