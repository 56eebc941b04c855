"""The exact rule that places the samples of a ray in voxels, and its fast twin, which always gives
the same voxel.

`sample_voxel` is the rule, bit for bit, one sample at a time (see the format page,
`docs/format.md#votes`): norm and unit ray are float32, as the points are; distances, differences
and the transform are float64; the cell is that of `carlasc.core.cells.find_voxel`.

The twin finds the voxels of many samples at once, in vectorised code. Rays are clipped to the box
of the grid. Samples are computed in working coordinates: cells from the lower corner of the grid
(for a cylindrical grid: metres in x and y, cells in z). There a sample is `start - step * stride`,
which differs from the rule by rounding only, by far less than `MARGIN` cells. A sample that is
farther than this from the edges of its cell is in the same voxel as by the rule. The few others,
some in a million, are DOUBTFUL, and the rule finds their voxels.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from carlasc.core.arrays import Float32Array, FloatArray, Int32Array, Uint16Array
from carlasc.core.cells import (
    AZIMUTH_ERROR,
    Cells,
    Pose,
    Real,
    Triple,
    fast_azimuth,
    find_voxel,
    transform,
)
from carlasc.core.compiling import fused, inlined, jit

DOUBTFUL = -1  # index of a sample that is too near to an edge of its cell

# The states of a ray:
SURE = 0.0
DROPPED = 1.0  # it does not vote
UNSURE = 2.0  # the rule must find its samples: they are too far away, or one is at the sensor

CHUNK = 8  # number of samples of a ray that are processed at once: the width of a vector register
MARGIN = 1e-7  # cells
# bound on the relative error of a coordinate: 16 times the error of its dozen operations
_ROUNDING = 2.0**-48
# azimuths are exact to the margin down to 1 / 256 of the radius at which cells are as wide as deep
_NEAR_AXIS = 256.0


@inlined
def point_of(points: Float32Array, row: int) -> tuple[Real, Real, Real]:
    """Return one of (3 n,) points."""
    return points[3 * row], points[3 * row + 1], points[3 * row + 2]


@inlined
def unit_ray(x: Real, y: Real, z: Real) -> tuple[Real, Real, Real, Real]:
    """Return the norm of a point and the unit ray to it, all float32."""
    # Points are float32, and NumPy computes with them in float32: the published grids were made so.
    norm = np.sqrt(x * x + y * y + z * z)
    return norm, x / norm, y / norm, z / norm


@inlined
def before_sensor(x: Real, ux: Real) -> bool:
    """Return whether a sample is kept: its x over the x of the unit ray is positive.

    Rays with x = 0 have no samples.
    """
    return bool(x / ux > 0.0 and ux != 0.0)


@jit
def sample_voxel(
    point: tuple[Real, Real, Real], step: float, free_step_m: float, pose: Pose, cells: Cells
) -> tuple[bool, int]:
    """Return whether the sample `step` steps back from a point (0: the point itself) is kept, and
    its voxel.
    """
    x, y, z = point
    _, ux, uy, uz = unit_ray(x, y, z)
    back = step * free_step_m
    sx = np.float64(x) - ux * back
    sy = np.float64(y) - uy * back
    sz = np.float64(z) - uz * back
    if not before_sensor(sx, ux):
        return False, cells.size[0] * cells.size[1] * cells.size[2]
    gx, gy, gz = transform(pose, sx, sy, sz)
    return True, find_voxel(gx, gy, gz, cells)


class GridView(NamedTuple):
    """The grid in the working coordinates of one sensor.

    Attributes:
        cylindrical: whether the grid is cylindrical.
        pose: work_T_sensor: a scaled grid_T_sensor.
        low: lower corner of the box that rays are clipped to, which is the grid enlarged by a
            margin.
        high: its upper corner.
        top: number of cells per axis.
        scale: cells per metre of radius, and per radian of azimuth.
        offset: cells from zero to the lower bound, of radius and azimuth.
        turn: cells of azimuth in a full circle.
        axis: smallest radius at which azimuths are exact to the margin, metres.
        sure: greatest distance from the middle of a cell, in cells, at which a sample is certainly
            inside.
        reach: distance of the farthest point for which these errors hold, metres.
    """

    cylindrical: bool
    pose: Pose
    low: Triple
    high: Triple
    top: Triple
    scale: tuple[float, float]
    offset: tuple[float, float]
    turn: float
    axis: float
    sure: float
    reach: float


@inlined
def _largest(x: float, y: float, z: float) -> float:
    """Return the largest absolute value."""
    return max(abs(x), abs(y), abs(z))


@jit
def view_from(pose: Pose, cells: Cells) -> GridView:
    """Return the view of a grid from a sensor at `pose` (grid_T_sensor)."""
    lower = cells.lower
    upper = cells.upper
    voxel = cells.voxel_size
    curved = cells.cylindrical
    nx = float(cells.size[0])
    ny = float(cells.size[1])
    nz = float(cells.size[2])
    # The published size of a cell is a float32 difference divided by n, so n cells may not end
    # exactly at the upper bound.
    ex = (upper[0] - lower[0]) / voxel[0]
    ey = (upper[1] - lower[1]) / voxel[1]
    ez = (upper[2] - lower[2]) / voxel[2]
    margin = (
        MARGIN + _largest(ex - nx, ey - ny, ez - nz) + (AZIMUTH_ERROR / voxel[1] if curved else 0.0)
    )
    edge = MARGIN / 2
    low = (-edge, -edge, -edge)
    high = (max(ex, nx) + edge, max(ey, ny) + edge, max(ez, nz) + edge)
    sx, sy, sz = 1 / voxel[0], 1 / voxel[1], 1 / voxel[2]
    origin, finest = (lower[0], lower[1]), min(voxel[0], voxel[1], voxel[2])
    if curved:
        around = upper[0] + MARGIN
        low = (-around, -around, -edge)
        high = (around, around, high[2])
        sx, sy, origin, finest = 1.0, 1.0, (0.0, 0.0), min(voxel[0], voxel[2])
    # Rounding may take at most a quarter of the margin. This limits the distance of a point, and
    # its nearness to the axis.
    allowed = MARGIN / 4 * finest / (_NEAR_AXIS if curved else 1.0)
    known = _largest(pose[3], pose[7], pose[11]) + _largest(*lower) + _largest(*upper)
    return GridView(
        curved,
        (
            *(pose[0] * sx, pose[1] * sx, pose[2] * sx, (pose[3] - origin[0]) * sx),
            *(pose[4] * sy, pose[5] * sy, pose[6] * sy, (pose[7] - origin[1]) * sy),
            *(pose[8] * sz, pose[9] * sz, pose[10] * sz, (pose[11] - lower[2]) * sz),
        ),
        low,
        high,
        (nx, ny, nz),
        (1 / voxel[0], 1 / voxel[1]),
        (lower[0] / voxel[0], lower[1] / voxel[1]),
        2 * math.pi / voxel[1],
        finest / voxel[1] / _NEAR_AXIS,
        0.5 - margin,
        (allowed / _ROUNDING - known) / 4,
    )


class RayBlock(NamedTuple):
    """A block of rays in working coordinates, (n,) float64 each.

    Attributes:
        x: x of the point; likewise y and z.
        dx: difference in x from a sample to its neighbour nearer to the point; likewise dy and dz.
        first: number of the first free sample inside the box, counted from the point.
        last: number of the last one; less than `first` if there is none.
        state: SURE, DROPPED or UNSURE.
    """

    x: FloatArray
    y: FloatArray
    z: FloatArray
    dx: FloatArray
    dy: FloatArray
    dz: FloatArray
    first: FloatArray
    last: FloatArray
    state: FloatArray


@jit
def empty_rays(n: int) -> RayBlock:
    """Return memory for a block of `n` rays."""
    return RayBlock(
        np.empty(n),
        np.empty(n),
        np.empty(n),
        np.empty(n),
        np.empty(n),
        np.empty(n),
        np.empty(n),
        np.empty(n),
        np.empty(n),
    )


@inlined
def narrow(
    first: Real, last: Real, start: float, stride: Real, low: Real, high: Real
) -> tuple[Real, Real]:
    """Return the steps from `first` to `last` at which `start - step * stride` is between `low` and
    `high`.

    The range is empty if there is no such step. A coordinate that stays on a bound (0 / 0) does not
    change the range.
    """
    # Comparisons with NaN are false, so 0 / 0 leaves both ends as they are. One division and two
    # products are faster than two divisions, and the margin of the box covers the rounding.
    inverse = 1.0 / stride
    a, b = (start - low) * inverse, (start - high) * inverse
    near, far = (a, b) if a < b else (b, a)
    return (near if near > first else first), (far if far < last else last)


@jit
def clip(
    points: Float32Array,
    labels: Uint16Array,
    free_step_m: float,
    view: GridView,
    rays: RayBlock,
) -> None:
    """Transform points (3 n,) with labels (n,) to working coordinates, and find the free samples
    inside the grid's box.
    """
    low, high = view.low, view.high
    for i in range(len(labels)):
        x, y, z = point_of(points, i)
        norm, ux, uy, uz = unit_ray(x, y, z)
        cx, cy, cz = transform(view.pose, x, y, z)
        ox, oy, oz = view.pose[3], view.pose[7], view.pose[11]
        # The transform of the unit ray minus the position of the sensor is the direction of the
        # ray.
        px, py, pz = transform(view.pose, ux, uy, uz)
        dx = (px - ox) * free_step_m
        dy = (py - oy) * free_step_m
        dz = (pz - oz) * free_step_m

        # Samples up to this step are in front of the sensor; this is uncertain for a sample that is
        # almost at the sensor.
        length = (np.float64(x) / np.float64(ux)) / free_step_m
        whole = np.floor(length)
        slack = length * 1e-14 + 1e-12
        unsure = (length - whole < slack) | (length - whole > 1.0 - slack) | (norm > view.reach)

        first, last = narrow(1.0, whole, cx, dx, low[0], high[0])
        first, last = narrow(first, last, cy, dy, low[1], high[1])
        first, last = narrow(first, last, cz, dz, low[2], high[2])
        first, last = np.ceil(first), np.floor(last)
        dropped = (labels[i] == 0) | (not before_sensor(x, ux))
        rays.x[i], rays.y[i], rays.z[i] = cx, cy, cz
        rays.dx[i], rays.dy[i], rays.dz[i] = dx, dy, dz
        rays.first[i], rays.last[i] = first, last
        rays.state[i] = DROPPED if dropped else (UNSURE if unsure else SURE)


@jit
def place_points(rays: RayBlock, view: GridView, voxels: Int32Array) -> None:
    """Find the voxels of the points of a block: their index, the number of voxels for points
    outside the grid, or DOUBTFUL.
    """
    if view.cylindrical:
        for i in range(len(voxels)):
            voxels[i] = place_cylindrical(rays.x[i], rays.y[i], rays.z[i], view)
    else:
        for i in range(len(voxels)):
            voxels[i] = place_cartesian(rays.x[i], rays.y[i], rays.z[i], view)


@fused
def place_cartesian(u: float, v: float, w: float, view: GridView) -> np.int32:
    """Return the voxel of a sample given in cells: its index, the number of voxels for a sample
    outside the grid, or DOUBTFUL.
    """
    return voxel_of(u, v, w, 0.0, view)


@fused
def place_cylindrical(x: float, y: float, w: float, view: GridView) -> np.int32:
    """Return the voxel of a sample given in metres in x and y, and cells in z, as `place_cartesian`
    does.
    """
    # Near the axis, a small error of x or y is a large one of the azimuth: `off` of 1 makes these
    # samples DOUBTFUL.
    radius = np.sqrt(x * x + y * y)
    v = fast_azimuth(x, y) * view.scale[1] - view.offset[1]
    off = from_middle(v)
    off = off if radius > view.axis else 1.0
    v = v + view.turn if v < 0.0 else (v - view.turn if v >= view.top[1] else v)
    return voxel_of(radius * view.scale[0] - view.offset[0], v, w, off, view)


@fused
def voxel_of(u: float, v: float, w: float, off: float, view: GridView) -> np.int32:
    """Return the voxel of a sample given in cells; DOUBTFUL also if `off`, a distance from the
    middle of a cell, is too large.
    """
    # Only selections, no branches: the loop over a chunk is vectorised then.
    i, j, k = np.floor(u), np.floor(v), np.floor(w)
    a, b, c = from_middle(u), from_middle(v), from_middle(w)
    a = a if a > b else b
    c = c if c > off else off
    inside = (
        (i >= 0.0)
        & (j >= 0.0)
        & (k >= 0.0)
        & (i < view.top[0])
        & (j < view.top[1])
        & (k < view.top[2])
    )
    index = (i * view.top[1] + j) * view.top[2] + k
    index = index if inside else view.top[0] * view.top[1] * view.top[2]
    return np.int32(index if (a <= view.sure) & (c <= view.sure) else np.float64(DOUBTFUL))


@fused
def from_middle(cell: float) -> float:
    """Return the distance of a coordinate, in cells, from the middle of its cell."""
    return abs(cell - np.floor(cell) - 0.5)
