# ruff: noqa: PLR0917 (compiled functions take scalars and arrays, by position)
"""The hot loop of the ground truth: samples along rays, the voxels they fall in, and the votes of those voxels.

The rule is FORMAT section 4, bit for bit: norm and unit ray in float32; distances, differences and the transform in float64; cells
half-open, floor, clamp.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numba
import numpy as np
from numpy.typing import NDArray

from carlasc.geometry import Transform
from carlasc.grids import GridSpec

OUTSIDE = -1  # index of a sample that lies in no voxel
NONE = -1  # end of a voxel's chain of candidates

CANDIDATE_DTYPE = np.dtype(
    [("votes", np.int64), ("voxel", np.int32), ("next", np.int32), ("voter", np.int32), ("label", np.uint16)],
    align=True,
)
"""A class that a voxel may have: its votes, who voted last, and the voxel's next candidate."""

_jit = numba.njit(cache=True, nogil=True, error_model="numpy")


class Cells(NamedTuple):
    """A GridSpec as scalars that compiled code can keep in registers."""

    cylindrical: bool
    size: tuple[int, int, int]
    lower: tuple[float, float, float]
    upper: tuple[float, float, float]
    voxel_size: tuple[float, float, float]

    @classmethod
    def of(cls, spec: GridSpec) -> Cells:
        """Return the cells of a grid."""
        x, y, z = spec.voxel_size.tolist()
        return cls(spec.coordinates == "cylindrical", spec.size, spec.lower, spec.upper, (x, y, z))


Pose = tuple[float, float, float, float, float, float, float, float, float, float, float, float]
"""The upper 3 x 4 of a transform, row-major, as scalars."""


def as_pose(dst_T_src: Transform) -> Pose:
    """Return a (4, 4) transform as scalars."""
    pose: Pose = tuple(np.asarray(dst_T_src, np.float64)[:3].ravel().tolist())  # type: ignore[assignment]
    return pose


@_jit
def to_grid_frame(x: float, y: float, z: float, pose: Pose) -> tuple[float, float, float]:
    """Return R @ p + t, summed from the left."""
    return (
        pose[0] * x + pose[1] * y + pose[2] * z + pose[3],
        pose[4] * x + pose[5] * y + pose[6] * z + pose[7],
        pose[8] * x + pose[9] * y + pose[10] * z + pose[11],
    )


@_jit
def exact_voxel(x: float, y: float, z: float, cells: Cells) -> int:
    """Return the flat index of the voxel of a point in the grid's frame, as GridSpec.flat_index does."""
    first, second = x, y
    if cells.cylindrical:
        first, second = math.sqrt(x * x + y * y), math.atan2(y, x)
        turned = second
        if second < cells.lower[1]:
            turned = second + 2 * math.pi
        elif second >= cells.upper[1]:
            turned = second - 2 * math.pi
        if cells.lower[1] <= turned < cells.upper[1]:
            second = turned
    if not (
        cells.lower[0] <= first < cells.upper[0]
        and cells.lower[1] <= second < cells.upper[1]
        and cells.lower[2] <= z < cells.upper[2]
    ):
        return OUTSIDE
    i = min(int((first - cells.lower[0]) / cells.voxel_size[0]), cells.size[0] - 1)
    j = min(int((second - cells.lower[1]) / cells.voxel_size[1]), cells.size[1] - 1)
    k = min(int((z - cells.lower[2]) / cells.voxel_size[2]), cells.size[2] - 1)
    return (i * cells.size[1] + j) * cells.size[2] + k


@_jit
def exact_sample(
    x: np.float32, y: np.float32, z: np.float32, step: int, free_step_m: float, pose: Pose, cells: Cells
) -> tuple[bool, int]:
    """Return whether the sample `step` steps before the point (0: the point itself) is before the sensor, and its voxel."""
    norm = np.sqrt(x * x + y * y + z * z)
    ux, uy, uz = x / norm, y / norm, z / norm
    back = step * free_step_m
    sx, sy, sz = np.float64(x) - ux * back, np.float64(y) - uy * back, np.float64(z) - uz * back
    if not (sx / ux > 0.0 and ux != 0.0):
        return False, OUTSIDE
    gx, gy, gz = to_grid_frame(sx, sy, sz, pose)
    return True, exact_voxel(gx, gy, gz, cells)


@_jit
def vote_occupied(
    voxel: int, label: int, voter: int, once: bool, heads: NDArray[Any], candidates: NDArray[Any], used: int
) -> int:
    """Give a voxel a vote for a class, at most one a voter if `once`; returns how many candidates are in use."""
    entry = heads[voxel]
    while entry != NONE and candidates[entry].label != label:
        entry = candidates[entry].next
    if entry == NONE:
        entry = used
        candidates[entry].votes = 0
        candidates[entry].voxel = voxel
        candidates[entry].next = heads[voxel]
        candidates[entry].voter = NONE
        candidates[entry].label = label
        heads[voxel] = entry
        used += 1
    if not once or candidates[entry].voter != voter:
        candidates[entry].votes += 1
        candidates[entry].voter = voter
    return used


@_jit
def vote(
    points: NDArray[np.float32],
    labels: NDArray[np.uint16],
    pose: Pose,
    cells: Cells,
    free_step_m: float,
    voter: int,
    once: bool,
    free: NDArray[Any],
    passed: NDArray[np.uint8],
    heads: NDArray[np.int32],
    candidates: NDArray[Any],
    used: int,
) -> int:
    """Add the votes of one observation.

    Args:
        points: (3 N,) float32 x, y, z of each point, sensor frame.
        labels: (N,) uint16.
        pose: grid_T_sensor.
        cells: the grid.
        free_step_m: distance between free samples.
        voter: number of the observation.
        once: at most one vote a voxel and class.
        free: (V,) free votes, added to.
        passed: (V,) uint8, all zero, and left so: voxels that this observation saw free.
        heads: (V,) int32, first candidate of each voxel.
        candidates: candidates of all voxels, with room for N more.
        used: how many are in use.

    Returns:
        How many candidates are in use now.
    """
    for i in range(len(labels)):
        if labels[i] == 0:
            continue
        x, y, z = points[3 * i], points[3 * i + 1], points[3 * i + 2]
        kept, voxel = exact_sample(x, y, z, 0, free_step_m, pose, cells)
        if kept and voxel != OUTSIDE:
            used = vote_occupied(voxel, labels[i], voter, once, heads, candidates, used)
        step = 1
        while kept:
            kept, voxel = exact_sample(x, y, z, step, free_step_m, pose, cells)
            if voxel != OUTSIDE:
                if once:
                    passed[voxel] = 1
                else:
                    free[voxel] += 1
            step += 1
    if once:
        for v in range(len(free)):
            free[v] += passed[v]
            passed[v] = 0
    return used


@_jit
def elect(
    free: NDArray[Any], candidates: NDArray[Any], labels: NDArray[Any], best: NDArray[Any], counts: NDArray[Any]
) -> None:
    """Find the class with most votes of each voxel, ties to the lowest id, and the sum of all votes.

    Args:
        free: (V,) votes of class 0.
        candidates: `voxel`, `label`, `votes` of the other classes, in any order.
        labels: (V,) output.
        best: (V,) scratch.
        counts: (V,) output.
    """
    for v in range(len(free)):
        labels[v] = 0
        best[v] = free[v]
        counts[v] = free[v]
    for entry in candidates:
        v, votes = entry.voxel, entry.votes
        counts[v] += votes
        if votes > best[v] or (votes == best[v] and entry.label < labels[v]):
            best[v] = votes
            labels[v] = entry.label
