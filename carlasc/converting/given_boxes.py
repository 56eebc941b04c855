"""Boxes of a table that a conversion takes, instead of those of the data set."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Self

import numpy as np

from carlasc.converting.assembling import AxesAndClasses
from carlasc.converting.protocol import Recording
from carlasc.core.arrays import Float32Array, FloatArray, Uint32Array
from carlasc.core.boxes import Boxes
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
        self, recording: Recording, times: FloatArray, first_T_scan: FloatArray | None
    ) -> tuple[dict[int, Boxes], list[str]]:
        """Return the boxes of each scan that has any, by frame number, in the frame of the scan;
        and remarks, one line each. Tracks begin at 1.

        Args:
            recording: the recording, with the frames that are converted.
            times: (F,) seconds by frame number, by the recording's clock.
            first_T_scan: (F, 4, 4) poses by frame number, right-handed; None if they are not
                estimated yet: then times are checked, and no box is returned.

        Raises:
            FormatError: the boxes are those of another drive.
        """
        table, numbers = self.table, [handle.number for handle in recording.frames]
        seconds = (times - times[0])[numbers]
        poses = None if first_T_scan is None else first_T_scan[numbers]
        index = table.frames_of(seconds, poses, self.where, recording.location)
        if poses is None:
            return {}, []
        placed = table.boxes_at(index, seconds, poses, self.labels)
        out = np.flatnonzero(index < 0)
        names = first_names(f"{table.numbers[row]} at {table.times[row]:g} s" for row in out)
        note = f"{len(out)} of {len(index)} boxes of {self.where} are at no scan, and are left out"
        boxes = {numbers[one]: own for one, own in placed.items()}
        return boxes, [f"{note}: {names}"] if len(out) else []

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
