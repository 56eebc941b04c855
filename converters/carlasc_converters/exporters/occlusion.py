"""Occluded voxels: those that a sensor at the origin cannot see because of occupied voxels before
them.
"""

from __future__ import annotations

from typing import NamedTuple

import numba
import numpy as np

from carlasc.core.arrays import BoolArray, FloatArray, Int32Array, Uint32Array
from carlasc.core.compiling import cached
from carlasc.core.grids import GridSpec

_BITS = 32  # voxels of a column that one integer stands for
_PARTS = 2048  # of the way to the sensor; a power of two, so that the part of a fraction is exact


class _Columns(NamedTuple):
    """The occupied voxels of a grid, by column.

    Attributes:
        runs: (2 R,) int32, per run of occupied voxels the face below the first and the face above
            the last, column by column.
        first: (X * Y + 1,) int32, place of the runs of each column in `runs`.
    """

    runs: Int32Array
    first: Int32Array


class _Heights(NamedTuple):
    """The heights of the lines of up to 32 voxels of any column.

    A new stage begins each time that a line passes a horizontal face.

    Attributes:
        times: (N + 1,) float64, the fraction of the way to the sensor at which each stage ends;
            infinite for the last one.
        stages: (_PARTS,) int32, the stage at the beginning of each part of the way.
        below: (N + 1, Z + 1) uint32, per stage and face the voxels whose lines are below it, as
            bits.
        up: the voxels whose lines go up, as bits.
        down: the other voxels, as bits.
    """

    times: FloatArray
    stages: Int32Array
    below: Uint32Array
    up: np.uint32
    down: np.uint32


def occluded_voxels(occupied: BoolArray, spec: GridSpec) -> BoolArray:
    """Return the occupied voxels, and the voxels whose line to the sensor passes through an
    occupied one.

    The line goes from the centre of a voxel to the sensor, which is at the origin, from voxel to
    voxel (Amanatides and Woo 1987): through the nearest face, and for equally near faces x before y
    before z. It ends at the sensor, or where it leaves the grid.

    The lines of all voxels of a column pass the same columns at the same times, and the times at
    which a line passes horizontal faces depend only on the height of its voxel. One walk in 2-D is
    therefore enough per column; the bits of an integer are its voxels.

    Args:
        occupied: (X, Y, Z) bool.
        spec: geometry of the grid, Cartesian.

    Returns:
        (X, Y, Z) bool.
    """
    sensor = -np.array(spec.lower) / spec.voxel_size
    columns = _columns(occupied)
    occluded = np.zeros(occupied.shape, np.bool_)
    for lowest in range(0, spec.size[2], _BITS):
        part = occluded[..., lowest : lowest + _BITS]
        _occlude(
            columns, sensor, _heights(lowest, part.shape[2], spec.size[2], float(sensor[2])), part
        )
    return occluded


def _columns(occupied: BoolArray) -> _Columns:
    padded = np.pad(occupied, ((0, 0), (0, 0), (1, 1)))
    ends = padded[..., 1:] != padded[..., :-1]
    first = np.append(0, np.cumsum(np.count_nonzero(ends, axis=2)))
    runs = np.flatnonzero(ends) % ends.shape[2]
    return _Columns(runs.astype(np.int32), first.astype(np.int32))


def _heights(lowest: int, count: int, rows: int, sensor: float) -> _Heights:
    """Return the heights of the lines of `count` voxels from the height `lowest` on, in a grid of
    `rows`; `sensor` is in voxels.
    """
    start = np.arange(lowest, lowest + count)
    bits = np.uint32(1) << np.arange(count, dtype=np.uint32)
    way = sensor - start - 0.5
    with np.errstate(divide="ignore"):
        between = 1 / np.abs(way)  # infinite at the height of the sensor
    times = np.repeat(between[:, None], rows, axis=1)
    times[:, 0] /= 2  # the first face is half a voxel away
    times = np.cumsum(times, axis=1)
    up = way > 0
    faces = start[:, None] + np.where(up[:, None], np.arange(1, rows + 1), -np.arange(rows))
    voxel, step = np.nonzero((times < 1) & (faces >= 0) & (faces <= rows))
    order = np.argsort(times[voxel, step])
    voxel = voxel[order]
    step = step[order]
    below = np.empty((len(order) + 1, rows + 1), np.uint32)
    below[0] = np.bitwise_or.reduce(
        np.where(start[:, None] < np.arange(rows + 1), bits[:, None], 0), axis=0
    )
    # A line that passes a face changes its side of this face only.
    below[1:] = 0
    below[np.arange(1, len(below)), faces[voxel, step]] = bits[voxel]
    np.bitwise_xor.accumulate(below, axis=0, out=below)
    ends = np.append(times[voxel, step], np.inf)
    stages = np.searchsorted(ends, np.arange(_PARTS) / _PARTS)
    return _Heights(
        ends, stages.astype(np.int32), below, np.uint32(bits[up].sum()), np.uint32(bits[~up].sum())
    )


@cached(error_model="python")
def _occlude(columns: _Columns, sensor: FloatArray, heights: _Heights, occluded: BoolArray) -> None:
    """Walk from every column to the sensor.

    Args:
        columns: the occupied voxels.
        sensor: (3,) its place in voxels.
        heights: the heights of the lines of some voxels.
        occluded: (X, Y, <= 32) bool output: these voxels of all columns.
    """
    for x in range(occluded.shape[0]):
        for y in range(occluded.shape[1]):
            met = _walk(columns, sensor, heights, x, y, occluded.shape[0], occluded.shape[1])
            for i in range(occluded.shape[2]):
                occluded[x, y, i] = (met >> i) & 1


@numba.njit(nogil=True)
def _walk(
    columns: _Columns,
    sensor: FloatArray,
    heights: _Heights,
    x: int,
    y: int,
    depth: int,
    width: int,
) -> np.uint32:
    """Return, as bits, the voxels of column (x, y) hidden from the sensor by an occupied one."""
    rx = sensor[0] - x - 0.5
    ry = sensor[1] - y - 0.5
    sx = 1 if rx > 0 else -1
    sy = 1 if ry > 0 else -1
    # Per axis: the fraction of the way between two faces (d), and the fraction at which the next
    # face comes (t).
    dx = 1 / abs(rx) if rx != 0 else np.inf
    dy = 1 / abs(ry) if ry != 0 else np.inf
    tx = dx / 2
    ty = dy / 2
    # stage: at `enter`, or -1
    met = np.uint32(0)
    enter = 0.0
    stage = 0
    while True:
        leave = min(tx, ty)
        first = columns.first[x * width + y]
        last = columns.first[x * width + y + 1]
        if first < last:
            before = stage if stage >= 0 else _stage(heights, enter)
            stage = _stage(heights, leave)
            for i in range(first, last, 2):
                low = columns.runs[i]
                high = columns.runs[i + 1]
                met |= heights.up & heights.below[before, high] & ~heights.below[stage, low]
                met |= heights.down & ~heights.below[before, low] & heights.below[stage, high]
            if met == heights.up | heights.down:
                return met
        else:
            stage = -1
        if leave >= 1:
            return met
        if tx <= ty:
            x += sx
            tx += dx
        else:
            y += sy
            ty += dy
        if x < 0 or y < 0 or x >= depth or y >= width:
            return met
        enter = leave


@numba.njit(nogil=True)
def _stage(heights: _Heights, time: float) -> int:
    """Return the number of faces that lines pass before a time."""
    if time >= 1:
        return len(heights.times) - 1
    stage = heights.stages[int(time * _PARTS)]
    while heights.times[stage] < time:
        stage += 1
    return stage
