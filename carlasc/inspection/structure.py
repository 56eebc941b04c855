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
from carlasc.core.geometry import Transform
from carlasc.core.grids import GridSpec
from carlasc.errors import CarlascError
from carlasc.inspection.points_in_voxels import warped_voxels
from carlasc.storage.protocol import Sequence

MIN_RANGE_M = 3.0
MAX_RANGE_M = 30.0
_COLUMN_M = 0.4
_UPRIGHT_M = 0.6  # points in a column that spans less height are ground
_FOOT_M = 0.3  # lowest part of an upright column, which counts as ground
VOXEL_M = 0.4
"""Size of the cells."""

_SPACE = GridSpec(
    "cartesian",
    (int(2 * MAX_RANGE_M / VOXEL_M),) * 3,
    (-MAX_RANGE_M,) * 3,
    (MAX_RANGE_M,) * 3,
)


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
    keep = within(points, MIN_RANGE_M, MAX_RANGE_M)
    if labels is not None and bool(labels.any()):
        keep &= _static_classes(classes)[
            # packed stores keep labels in uint8
            np.minimum(labels.astype(np.int64), np.iinfo(np.uint16).max)
        ]
    else:
        keep[keep] = _is_upright(points[keep])
    if flow is not None:
        keep &= (np.abs(flow) < 0.1).all(axis=1)
    return points[np.flatnonzero(keep)].astype(np.float64)


def within(points: AnyFloatArray, nearest: float, farthest: float) -> BoolArray:
    """Return (N,) which of (N, 3) points are between two distances from the sensor.

    Points that are not finite are not.
    """
    x, y, z = points.T
    with np.errstate(invalid="ignore"):
        distance = np.sqrt(x * x + y * y + z * z)
    return np.asarray((distance > nearest) & (distance < farthest))


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
    occupied = np.zeros(_SPACE.size, np.bool_)
    cells, inside = _SPACE.index(points)
    occupied[tuple(cells[inside].T)] = True
    return occupied


def overlap(occupied: BoolArray, motion: Transform, points: FloatArray) -> float:
    """Return the share of the points of a scan that are in occupied cells of another.

    Args:
        occupied: (C, C, C) cells of the other scan: see `occupancy`.
        motion: (4, 4) other_T_scan.
        points: (N, 3) metres, N > 0.
    """
    (voxels,) = warped_voxels(points, _SPACE, np.pad(motion[None, :3], ((0, 0), (0, 0), (0, 1))))
    return np.count_nonzero(occupied.reshape(-1)[voxels[voxels < occupied.size]]) / len(points)
