"""The structure of a scan: points on static, upright objects, which show the motion of the sensor;
and the overlap of two structures.

Points on the ground are left out: on flat ground, the rings of a LiDAR move with the sensor, so
that they match best under the poses of a sensor that does not move. Points on moving objects, and
points so near that they may be on the ego vehicle, are left out too.
"""

from __future__ import annotations

import numpy as np

from carlasc.core.arrays import AnyArray, AnyFloatArray, BoolArray, FloatArray
from carlasc.core.classes import ClassTable
from carlasc.core.compiling import cached
from carlasc.core.geometry import Transform
from carlasc.errors import CarlascError
from carlasc.storage.protocol import Sequence

MIN_RANGE_M = 3.0
MAX_RANGE_M = 30.0
_COLUMN_M = 0.4
_UPRIGHT_M = 0.6  # points in a column that spans less height are ground
_FOOT_M = 0.3  # lowest part of an upright column, which counts as ground
VOXEL_M = 0.4
"""Size of the cells."""

_CELLS = int(2 * MAX_RANGE_M / VOXEL_M)


def static_structure(sequence: Sequence, frame: int) -> FloatArray:
    """Read the structure of a scan.

    Args:
        sequence: has the field `points`; `labels` and `flow` are used if the sequence has them and
            they fit.
        frame: frame number.

    Returns:
        (M, 3) float64 points, metres, in the frame of the sensor.

    Raises:
        CarlascError: the points cannot be read.
    """
    points = np.asarray(sequence.read("points", frame))[:, :3]
    labels = _per_point(sequence, "labels", frame, len(points))
    flow = _per_point(sequence, "flow", frame, len(points))
    return structure_of(points, labels, flow, sequence.metadata.classes)


def structure_of(
    points: AnyFloatArray,
    labels: AnyArray | None,
    flow: AnyArray | None,
    classes: ClassTable,
) -> FloatArray:
    """Return the structure of a scan.

    Args:
        points: (N, 3) metres, in the frame of the sensor.
        labels: (N,) class ids; None if the scan has none.
        flow: (N, 3) velocity over ground, m/s; None if it is not known.
        classes: table of the ids.

    Returns:
        (M, 3) float64 points, metres, in the frame of the sensor.
    """
    keep = within(points, points.dtype.type(MIN_RANGE_M), points.dtype.type(MAX_RANGE_M))
    if labels is not None and bool(labels.any()):
        keep &= _static_classes(classes)[
            # packed stores keep labels in uint8
            np.minimum(labels.astype(np.int64), np.iinfo(np.uint16).max)
        ]
    else:
        keep[keep] = _is_upright(points[keep])
    if flow is not None:
        keep &= _rows(np.abs(flow) < 0.1)
    return points[np.flatnonzero(keep)].astype(np.float64)


@cached(error_model="python")
def within(points: AnyFloatArray, nearest: float, farthest: float) -> BoolArray:
    """Return (N,) which of (N, 3) points are between two distances from the sensor.

    Points that are not finite are not.
    """
    is_within = np.empty(len(points), np.bool_)
    for i in range(len(points)):
        x, y, z = points[i, 0], points[i, 1], points[i, 2]
        is_within[i] = nearest < np.sqrt(x * x + y * y + z * z) < farthest
    return is_within


def _per_point(sequence: Sequence, field: str, frame: int, count: int) -> AnyArray | None:
    """Return a field of the points; None if it is missing or cannot be read (other checks report
    that).
    """
    if field not in sequence.fields():
        return None
    try:
        array = sequence.read(field, frame)
    except CarlascError:
        return None
    return array if len(array) == count else None


def _rows(mask: BoolArray) -> BoolArray:
    """Return which rows of an (N, 3) mask are all true: `mask.all(axis=1)` in a seventh of its
    time.
    """
    return mask[:, 0] & mask[:, 1] & mask[:, 2]


def _static_classes(table: ClassTable) -> BoolArray:
    """Return which ids are static objects above the ground.

    If no class contains only moving objects, all movable classes are left out.
    """
    static = np.zeros(np.iinfo(np.uint16).max + 1, np.bool_)
    static[sorted(set(table.names) - {0} - table.ground - (table.moving or table.movable))] = True
    return static


def _is_upright(points: AnyFloatArray) -> BoolArray:
    """Return (N,) which points are on upright objects, from the range of heights in columns of 0.4
    m.
    """
    columns = np.floor((points[:, :2] + MAX_RANGE_M) / _COLUMN_M).astype(np.int64)
    width = int(2 * MAX_RANGE_M / _COLUMN_M) + 1
    column = columns[:, 0] * width + columns[:, 1]
    lowest = np.full(width * width, np.inf)
    highest = np.full(width * width, -np.inf)
    np.minimum.at(lowest, column, points[:, 2])
    np.maximum.at(highest, column, points[:, 2])
    upright: BoolArray = (highest - lowest)[column] > _UPRIGHT_M
    return upright & (points[:, 2] > lowest[column] + _FOOT_M)


def occupancy(points: FloatArray) -> BoolArray:
    """Return the (C, C, C) cells about the sensor that hold points, (N, 3) metres, sensor frame."""
    occupied = np.zeros((_CELLS, _CELLS, _CELLS), np.bool_)
    occupy(occupied, points, MAX_RANGE_M, VOXEL_M)
    return occupied


def overlap(occupied: BoolArray, motion: Transform, points: FloatArray) -> float:
    """Return the share of the points of a scan that are in occupied cells of another.

    Args:
        occupied: (C, C, C) cells of the other scan: see `occupancy`.
        motion: (4, 4) other_T_scan.
        points: (N, 3) metres, N > 0.
    """
    return count_occupied(occupied, motion, points, MAX_RANGE_M, VOXEL_M) / len(points)


@cached(error_model="python")
def occupy(occupied: BoolArray, points: FloatArray, reach_m: float, voxel_m: float) -> None:
    """Mark the cells of a grid that hold points; the arguments are those of `count_occupied`."""
    cells = len(occupied)
    for i in range(len(points)):
        x, y, z = points[i, 0], points[i, 1], points[i, 2]
        a, b, c = (x + reach_m) / voxel_m, (y + reach_m) / voxel_m, (z + reach_m) / voxel_m
        if 0 <= a < cells and 0 <= b < cells and 0 <= c < cells:
            occupied[int(a), int(b), int(c)] = True


@cached(error_model="python")
def count_occupied(
    occupied: BoolArray,
    motion: FloatArray,
    points: FloatArray,
    reach_m: float,
    voxel_m: float,
) -> int:
    """Return the number of points that are in occupied cells of a grid when they are moved.

    Args:
        occupied: (C, C, C) cells.
        motion: (4, 4) from the frame of the points to that of the grid.
        points: (N, 3) metres.
        reach_m: distance of the lower bounds of the grid from the origin.
        voxel_m: size of a cell.
    """
    count, cells, cell = 0, len(occupied), np.empty(3)
    for i in range(len(points)):
        x, y, z = points[i, 0], points[i, 1], points[i, 2]
        for a in range(3):  # the operations of `transform_points`, in their order
            moved = (x * motion[a, 0] + y * motion[a, 1] + z * motion[a, 2]) + motion[a, 3]
            cell[a] = (moved + reach_m) / voxel_m
        if 0 <= cell[0] < cells and 0 <= cell[1] < cells and 0 <= cell[2] < cells:
            count += occupied[int(cell[0]), int(cell[1]), int(cell[2])]
    return count
