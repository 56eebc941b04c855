"""A scan of a folder: one file, or one for each LiDAR, and the classes of its points from a file of
their own.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np

from carlasc.converting import Cloud, FrameHandle
from carlasc.core.arrays import Uint32Array
from carlasc.core.geometry import Transform
from carlasc.errors import FormatError
from carlasc.relabelling.predictions import load
from carlasc.storage.arrays import NUMBERS, ArrayFormat, read_npy
from carlasc_converters.files import check_labels, opening
from carlasc_converters.point_fields import (
    PointClock,
    TimeUnit,
    named_fields,
    returns,
    whole_numbers,
)
from carlasc_converters.point_files import read_columns

_NOT_ALL = {"label", "instance"}  # fields that some of the scans may lack


@dataclass(frozen=True)
class ScanOptions:
    """The options of `Scans`; see there."""

    columns: tuple[str, ...] | None
    pose_file: Path | None
    pose_of: Literal["auto", "sensor", "vehicle"]
    calibration: Path | None
    time_file: Path | None
    time_unit: TimeUnit
    label_dir: Path | None
    has_classes: bool
    axes: Transform
    deskewed: bool


@dataclass(frozen=True)
class ScanFile(FrameHandle):
    """A scan: one file, or one for each LiDAR.

    Attributes:
        number: its place in the order of the files.
        paths: a file for each LiDAR.
        labels: the file of the classes of its points, of the first LiDAR.
        fields: fields that each file must have, those of the first one.
        options: the options for the files.
        clock: how the times of points are found; None if they have none.
        stamp: nanoseconds of the scan, where times of points are those of a clock.
        world_T_scan: (4, 4) the pose of the scan, where its points are in the world frame.
    """

    number: int
    paths: tuple[str, ...]
    labels: str | None
    fields: tuple[str, ...]
    options: ScanOptions
    clock: PointClock | None
    stamp: int | None
    world_T_scan: Transform | None = None

    @property
    def location(self) -> str:  # type: ignore[override]
        """The first file."""
        return self.paths[0]

    def read(self) -> Sequence[Cloud]:
        """Read the points.

        Points whose position is not finite are left out, because they are rays without a return.
        """
        return [self._read(index, path) for index, path in enumerate(self.paths)]

    def _read(self, index: int, path: str) -> Cloud:
        columns = read_columns(Path(path), self.options.columns)
        fields = named_fields(columns, path, self.clock, self.world_T_scan)
        if set(fields) - _NOT_ALL != set(self.fields) - _NOT_ALL:
            raise FormatError(
                path,
                expected=f"the fields of the first scan ({', '.join(self.fields)})",
                found=", ".join(fields),
            )
        points = fields["points"]
        seconds = None
        if self.clock is not None:
            seconds = self.clock.seconds(columns, returns(columns), self.stamp, path)
        labels = fields.get("label")
        instances = fields.get("instance")
        if self.labels is not None and index == 0:
            labels = read_labels(Path(self.labels), len(points))
        if not self.options.has_classes:
            labels = instances = None
        elif labels is None and (self.options.label_dir or "label" in self.fields):
            labels = np.zeros(len(points), np.uint32)  # other scans have labels
        if labels is not None and instances is None and "instance" in self.fields:
            instances = np.zeros(len(points), np.uint32)
        finite = np.isfinite(points[:, :3]).all(axis=1)
        if not finite.any():
            raise FormatError(
                path, expected="points", found="none that is finite", advice="remove the scan"
            )
        points = points[finite]
        points[:, 3] = np.nan_to_num(points[:, 3])
        if not np.array_equal(self.options.axes, np.eye(4)):
            points = points.copy()
            points[:, :3] = points[:, :3] @ self.options.axes[:3, :3].T.astype(np.float32)
        return Cloud(
            points,
            labels=None if labels is None else labels[finite],
            instances=None if instances is None else instances[finite],
            seconds=None if seconds is None else seconds[finite],
            sensor=index,
        )


def read_labels(path: Path, count: int) -> Uint32Array:
    """Return the (N,) class ids of a file: .label (uint32, of which the lower 16 bits count), .npy,
    or .txt with one per line.

    Raises:
        FormatError: the file does not hold `count` whole numbers.
    """
    if path.suffix == ".label":
        values, _ = load(path)
    elif path.suffix == ".npy":
        values = read_npy(path, ArrayFormat(NUMBERS, None))
    else:
        with opening(path, "a class id for each point"):
            values = np.loadtxt(path, ndmin=1)
    labels = whole_numbers(np.asarray(values).reshape(-1), str(path))
    check_labels(labels, count, path)
    return labels
