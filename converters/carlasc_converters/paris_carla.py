"""Paris-CARLA-3D: towns of CARLA 0.9.10, scanned by a tilted LiDAR, one PLY file of about 100
million points per town.

The points of a file are in right-handed world coordinates. Each point has the position of the
LiDAR, its time, and the number of its scan. Only the rows of one scan are in memory at a time.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import ClassVar

import numpy as np

from carlasc.converting import Cloud, Converter, FrameHandle, Recording, Sensor, Split, Trajectory
from carlasc.core.arrays import Float32Array, FloatArray, IntArray
from carlasc.core.classes import Remap
from carlasc.core.geometry import Transform, invert, rotation_z, transform_points, translation
from carlasc.core.tables import CARLA
from carlasc.errors import FormatError
from carlasc_converters.files import no_data
from carlasc_converters.ply import PlyVertices

_POINT = ("x", "y", "z")
_LIDAR = ("x_lidar_position", "y_lidar_position", "z_lidar_position")
_PROPERTIES = (*_POINT, *_LIDAR, "timestamp", "index_frame", "instance", "semantic")
# as in the paper; all others: Train
_SPLITS: dict[str, Split] = {
    "Town01": "Test",
    "Town06": "Val",
    "Town07": "Test",
}
_HEADING_M = 1.0  # the heading is computed from positions that are at least this far apart
_HEADING_FRAMES = 20  # and at most this number of frames before and after
_MOST_RUNS = 1_000_000  # of consecutive rows of one scan: the index of a file stays small


class ParisCarla3D(Converter):
    """Reads the simulated towns of Paris-CARLA-3D, or the file of one of them."""

    title: ClassVar[str] = "Paris-CARLA-3D, its towns of CARLA"
    license = "CC BY-NC-ND 3.0"
    citation = "J.-E. Deschaud et al., Paris-CARLA-3D, Remote Sensing 13(22), 2021"
    classes = CARLA
    to_carla = Remap("paris_carla_to_carla", CARLA, CARLA, {tag: tag for tag in CARLA.names})
    sensor = "simulated Velodyne HDL-32E, tilted"
    min_range_m = 2.0
    max_range_m = 70.0

    def sequences(self) -> list[Recording]:
        """Return the towns, by name.

        Raises:
            MissingDataError: no file exists.
            FormatError: a file is not a binary PLY file with the properties of this data set, or it
                is incomplete.
        """
        source = self.source
        files = (
            [source]
            if source.is_file()
            else sorted(p for p in source.rglob("*.ply") if p.stem.startswith("Town"))
        )
        if not files:
            raise no_data(
                source,
                "files such as Town01.ply",
                "give their folder, after the archives are unpacked",
            )
        return [ParisCarlaTown(path) for path in files]


class ParisCarlaTown(Recording):
    """One town.

    Attributes:
        path: its file.
    """

    has_labels = has_instances = True
    sensors = (Sensor("lidar"),)

    def __init__(self, path: Path) -> None:
        self.path = path
        self.location = str(path)
        self.name = f"PARISCARLA_{path.stem.replace('_', '-')}"
        self.split = _SPLITS.get(path.stem, "Train")
        self._ply = PlyVertices.open(path, _PROPERTIES)
        if self._ply.lines is not None:
            raise FormatError(path, expected="a binary PLY file", found="a text file")

    @cached_property
    def _scans(self) -> list[tuple[int, tuple[tuple[int, int], ...]]]:
        """The value of index_frame of each scan, and the ranges of its rows.

        One pass over the file finds them.
        """
        values, bounds = _find_runs(self._ply)
        ranges: dict[int, list[tuple[int, int]]] = {}
        for value, start, stop in zip(
            values.tolist(), bounds[:-1].tolist(), bounds[1:].tolist(), strict=True
        ):
            ranges.setdefault(value, []).append((start, stop))
        return [(value, tuple(ranges[value])) for value in sorted(ranges)]

    @cached_property
    def _middles(self) -> tuple[FloatArray, FloatArray]:
        """(F, 3) position and (F,) time of the LiDAR at the middle point of each scan."""
        rows = [
            self._ply.rows(row, row + 1)[0]
            for row in (_middle_row(ranges) for _, ranges in self._scans)
        ]
        positions = np.array([[row[name] for name in _LIDAR] for row in rows], np.float64).reshape(
            -1, 3
        )
        return positions, np.array([row["timestamp"] for row in rows], np.float64)

    @cached_property
    def _poses(self) -> FloatArray:
        """(F, 4, 4) world_T_scan: the position of the LiDAR, upright, with the direction of motion
        as heading.
        """
        positions, times = self._middles
        if (wrong := np.flatnonzero(~(np.diff(times) > 0))).size:
            scan = self._scans[int(wrong[0])][0]
            later = self._scans[int(wrong[0]) + 1][0]
            raise FormatError(
                self.path,
                expected="times that increase from scan to scan",
                found=f"none from scan {scan} to {later}",
            )
        return np.array(
            [
                translation(at) @ rotation_z(yaw)
                for at, yaw in zip(positions, headings(positions), strict=True)
            ]
        ).reshape(-1, 4, 4)

    @cached_property
    def frames(self) -> Sequence[FrameHandle]:  # type: ignore[override]
        """The scans, numbered from 0."""
        times = self._middles[1].tolist()
        return [
            ParisCarlaFrame(
                number,
                f"{self.path}: scan {value}",
                self._ply,
                ranges,
                self._poses[number],
                times[number],
            )
            for number, (value, ranges) in enumerate(self._scans)
        ]

    def poses(self, *, force: bool = False) -> Trajectory:
        """Return the pose of each scan: see `notes`."""
        return Trajectory(self._poses, self._middles[1], str(self.path))

    def times(self) -> FloatArray:
        """Return the time of the middle point of each scan."""
        return self._middles[1]

    def notes(self) -> list[str]:
        """Return notes on the licence, and on the source of poses."""
        return [
            "Paris-CARLA-3D has the licence CC BY-NC-ND 3.0: converted data must not be shared",
            "poses are the positions of the LiDAR at the middle of each scan, upright, with the "
            "direction of motion as heading, because the data have no rotations",
        ]


@dataclass(frozen=True, eq=False)
class ParisCarlaFrame(FrameHandle):
    """One scan.

    Attributes:
        number: its place among the scans of the file.
        location: the file, and the value of index_frame.
        ply: the file.
        ranges: its rows, (start, stop).
        world_T_scan: (4, 4) pose of the frame in which points are given.
        seconds: time of the frame.
    """

    number: int
    location: str
    ply: PlyVertices
    ranges: tuple[tuple[int, int], ...]
    world_T_scan: Transform
    seconds: float

    def read(self) -> Sequence[Cloud]:
        """Read points, the origins of their rays, their times, tags, and the actors of classes that
        move.
        """
        rows = np.concatenate([self.ply.rows(start, stop) for start, stop in self.ranges])
        scan_T_world = invert(self.world_T_scan)

        def in_scan(names: tuple[str, ...]) -> Float32Array:
            return transform_points(
                scan_T_world, np.stack([rows[name] for name in names], axis=1)
            ).astype(np.float32)

        labels = rows["semantic"].astype(np.uint32)
        moves = np.isin(labels, sorted(CARLA.movable))
        points = np.zeros((len(rows), 4), np.float32)
        points[:, :3] = in_scan(_POINT)
        cloud = Cloud(
            points,
            labels,
            np.where(moves, rows["instance"], 0).astype(np.uint32),
            rows["timestamp"].astype(np.float64) - self.seconds,
            in_scan(_LIDAR),
        )
        return (cloud,)


def headings(positions: FloatArray) -> FloatArray:
    """Return the (F,) direction of motion, radians about z, at each of (F, 3) positions.

    It is the direction from an earlier to a later position, the same number of frames before and
    after, at least a metre apart. A vehicle at rest keeps its last heading.
    """
    count = len(positions)
    headings = np.full(count, np.nan)
    frames = np.arange(count)
    for away in range(1, _HEADING_FRAMES + 1):
        way = (
            positions[np.minimum(frames + away, count - 1), :2]
            - positions[np.maximum(frames - away, 0), :2]
        )
        chosen = np.isnan(headings) & (np.hypot(*way.T) >= _HEADING_M)
        headings[chosen] = np.arctan2(way[chosen, 1], way[chosen, 0])
    known = np.flatnonzero(~np.isnan(headings))
    if not known.size:
        return np.zeros(count)
    # the first known one also holds before it
    last = np.maximum(np.searchsorted(known, frames, side="right") - 1, 0)
    return headings[known[last]]


def _find_runs(ply: PlyVertices) -> tuple[IntArray, IntArray]:
    """Return the (R,) values of index_frame of the runs of consecutive rows of one scan, and the (R
    + 1,) rows where they begin and end.

    Raises:
        FormatError: the file has no rows, or the rows of a scan are scattered over it.
    """
    values: list[IntArray] = []
    starts: list[IntArray] = []
    done = 0
    runs = 0
    last = -1
    for chunk in ply.chunks():
        column = chunk["index_frame"].astype(np.int64)
        begins = np.flatnonzero(np.diff(column, prepend=last))
        values.append(column[begins])
        starts.append(begins + done)
        done = done + len(column)
        runs = runs + len(begins)
        last = int(column[-1])
        if runs > _MOST_RUNS:
            raise FormatError(
                ply.path,
                expected="the rows of each scan (index_frame) one after the other",
                found=f"more than {_MOST_RUNS} changes of the scan in {done} rows",
                advice="sort the rows by index_frame",
            )
    if not done:
        raise FormatError(ply.path, expected="points", found="none", advice="copy it again")
    return np.concatenate(values), np.append(np.concatenate(starts), done)


def _middle_row(ranges: tuple[tuple[int, int], ...]) -> int:
    """Return the row in the middle of several ranges, by number of rows."""
    left = sum(stop - start for start, stop in ranges) // 2
    for start, stop in ranges:
        if left < stop - start:
            return start + left
        left -= stop - start
    raise AssertionError  # not reached: the middle row is in one of the ranges
