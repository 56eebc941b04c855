"""The compiled loops of the voting: they add the votes of one observation.

Rays are processed in blocks. The vectorised code of rays.py clips them to the grid and finds the voxels of their samples; where rounding
could change the voxel, rule.py finds it. Votes for free space are stored densely, votes for other classes as a linked list of candidates
per voxel.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from carlasc.core.cells import Cells, Pose, transform
from carlasc.core.compiling import cached, inlined, jit
from carlasc.groundtruth.voting.observations import NOWHERE
from carlasc.groundtruth.voting.rays import (
    CHUNK,
    DOUBTFUL,
    DROPPED,
    MARGIN,
    SURE,
    UNSURE,
    Rays,
    View,
    clip,
    empty_rays,
    narrow,
    place_cartesian,
    place_cylindrical,
    place_points,
)
from carlasc.groundtruth.voting.rule import sample_voxel, unit_ray

BLOCK = 256  # number of rays whose coordinates fit into the L1 cache
NONE = -1  # end of a voxel's list of candidates
ANYWHERE = -1  # region of votes that count in all regions
OUTSIDE = np.iinfo(np.uint16).max  # region of samples outside the grid

CANDIDATE_DTYPE = np.dtype(
    [("votes", np.int64), ("voxel", np.int32), ("next", np.int32), ("voter", np.int32), ("label", np.uint16)],
    align=True,
)
"""A class that a voxel may have: its votes, the observation that voted for it last, and the voxel's next candidate."""


class Tally(NamedTuple):
    """The votes of V voxels.

    Attributes:
        once: whether an observation has at most one vote per voxel and class, free space included.
        free: (V + 1,) votes for free space; the last element counts samples outside the grid.
        passed: (V + 1,) uint8, 1 for voxels that the current observation saw free; all 0 between observations. Empty if every sample counts.
        heads: (V,) int32, index of the first candidate of each voxel, or NONE.
        candidates: (C,) CANDIDATE_DTYPE, the candidates of all voxels.
        used: (1,) int64, number of candidates in use.
        regions: (V + 1,) uint16, region of each voxel, and OUTSIDE for the last element; empty if the grid has no regions.
        views: (V + 1,) uint16, number of observations that saw each voxel; empty if they are not counted.
        viewers: (V + 1,) int32, the last observation that saw each voxel, or NONE; empty if views are not counted.
    """

    once: bool
    free: NDArray[Any]
    passed: NDArray[np.uint8]
    heads: NDArray[np.int32]
    candidates: NDArray[Any]
    used: NDArray[np.int64]
    regions: NDArray[np.uint16]
    views: NDArray[np.uint16]
    viewers: NDArray[np.int32]


@inlined
def count_view(voxel: int, voter: int, tally: Tally) -> None:
    """Count that an observation saw a voxel, if views are counted."""
    if len(tally.views) and tally.viewers[voxel] != voter:
        tally.viewers[voxel] = voter
        tally.views[voxel] += np.uint16(1)


@jit
def vote_occupied(
    points: NDArray[np.float32],
    labels: NDArray[np.uint16],
    rays: Rays,
    hits: NDArray[np.int32],
    pose: Pose,
    cells: Cells,
    voter: int,
    region: int,
    tally: Tally,
) -> None:
    """Add the votes of a block's points for their classes, in the voxels of a region. Points labelled 0 have none."""
    for i in range(len(labels)):
        if rays.state[i] == DROPPED or labels[i] == 0:
            continue
        voxel = hits[i]
        if voxel == DOUBTFUL or rays.state[i] == UNSURE:
            _, voxel = sample_voxel(points[3 * i], points[3 * i + 1], points[3 * i + 2], 0.0, 0.0, pose, cells)
        if voxel < len(tally.heads) and (region == ANYWHERE or tally.regions[voxel] == region):
            vote_for(voxel, labels[i], voter, tally)
            count_view(voxel, voter, tally)


@inlined
def vote_for(voxel: int, label: int, voter: int, tally: Tally) -> None:
    """Add a vote for a class to a voxel."""
    candidates = tally.candidates
    entry = tally.heads[voxel]
    while entry != NONE and candidates[entry].label != label:
        entry = candidates[entry].next
    if entry == NONE:
        entry = tally.used[0]
        tally.used[0] += 1
        candidates[entry].votes = 0
        candidates[entry].voxel = voxel
        candidates[entry].next = tally.heads[voxel]
        candidates[entry].voter = NONE
        candidates[entry].label = label
        tally.heads[voxel] = entry
    if not tally.once or candidates[entry].voter != voter:
        candidates[entry].votes += 1
        candidates[entry].voter = voter


@jit
def vote_free(
    points: NDArray[np.float32],
    labels: NDArray[np.uint16],
    rays: Rays,
    pose: Pose,
    view: View,
    cells: Cells,
    free_step_m: float,
    voter: int,
    region: int,
    tally: Tally,
) -> None:
    """Add the votes of a block's free samples, which lie between the sensor and the points.

    If each sample counts, only those in `region` are added; otherwise all are marked in `passed`.
    """
    voxels = np.empty(CHUNK, np.int32)
    for i in range(len(labels)):
        if rays.state[i] == UNSURE:
            vote_free_by_rule(
                points[3 * i], points[3 * i + 1], points[3 * i + 2], pose, view, cells, free_step_m, region, tally
            )
        if rays.state[i] != SURE:
            continue
        x, y, z, dx, dy, dz = rays.x[i], rays.y[i], rays.z[i], rays.dx[i], rays.dy[i], rays.dz[i]
        step, last = rays.first[i], rays.last[i]
        while step <= last:
            # These loops are not in a function of their own: Numba would count a reference to the array at every call.
            lowest = np.int32(0)
            if view.cylindrical:
                for j in range(CHUNK):
                    back = step + j
                    voxels[j] = place_cylindrical(x - back * dx, y - back * dy, z - back * dz, view)
                    lowest = min(lowest, voxels[j])
            else:
                for j in range(CHUNK):
                    back = step + j
                    voxels[j] = place_cartesian(x - back * dx, y - back * dy, z - back * dz, view)
                    lowest = min(lowest, voxels[j])
            number = int(min(float(CHUNK), last - step + 1.0))
            if lowest == DOUBTFUL:
                for j in range(number):
                    if voxels[j] == DOUBTFUL:
                        point = points[3 * i], points[3 * i + 1], points[3 * i + 2]
                        voxels[j] = sample_voxel(point[0], point[1], point[2], step + j, free_step_m, pose, cells)[1]
            if tally.once:
                for j in range(number):
                    tally.passed[np.uint32(voxels[j])] = 1
            elif region == ANYWHERE:
                for j in range(number):
                    tally.free[np.uint32(voxels[j])] += 1
            else:
                for j in range(number):
                    tally.free[np.uint32(voxels[j])] += tally.regions[np.uint32(voxels[j])] == region
            if len(tally.views):
                for j in range(number):
                    if region == ANYWHERE or tally.regions[voxels[j]] == region:
                        count_view(voxels[j], voter, tally)
            step += CHUNK


@jit
def vote_free_by_rule(
    x: np.float32,
    y: np.float32,
    z: np.float32,
    pose: Pose,
    view: View,
    cells: Cells,
    free_step_m: float,
    region: int,
    tally: Tally,
) -> None:
    """Add the votes of one ray's free samples by rule.py alone, clipped to the grid with a wide margin."""
    norm, ux, uy, uz = unit_ray(x, y, z)
    starts = transform(view.pose, x, y, z)
    units = transform(view.pose, ux, uy, uz)
    # Bound on the rounding error, in cells or metres. It grows with the distance and is below MARGIN within `reach`.
    slack = 1.0 + MARGIN * norm / view.reach if view.reach > 0.0 else math.inf
    step, last = 1.0, math.inf
    for axis in range(3):
        stride = (units[axis] - view.pose[4 * axis + 3]) * free_step_m
        step, last = narrow(step, last, starts[axis], stride, view.low[axis] - slack, view.high[axis] + slack)
    step = np.floor(step)
    kept = step < 2.0**52  # above it, step + 1 may be equal to step
    while kept and step <= last + 1.0:
        kept, voxel = sample_voxel(x, y, z, step, free_step_m, pose, cells)
        if tally.once:
            tally.passed[voxel] = 1
        elif region == ANYWHERE or tally.regions[voxel] == region:
            tally.free[voxel] += 1
        step += 1.0


@cached
def vote(
    points: NDArray[np.float32],
    labels: NDArray[np.uint16],
    hit_labels: NDArray[np.uint16],
    pose: Pose,
    view: View,
    cells: Cells,
    free_step_m: float,
    voter: int,
    hit_region: int,
    free_region: int,
    tally: Tally,
) -> None:
    """Add the votes of one observation.

    Args:
        points: (3 N,) float32, metres, x, y, z of each point in the sensor's frame.
        labels: (N,) uint16; points labelled 0 and their rays do not vote.
        hit_labels: (N,) uint16, the classes that the points vote for; 0 where only the ray votes.
        pose: grid_T_sensor.
        view: the grid as seen from the sensor.
        cells: the cells of the grid.
        free_step_m: distance between two free samples, metres.
        voter: number of the observation.
        hit_region: region in which points vote, or ANYWHERE.
        free_region: region in which rays vote, ANYWHERE, or NOWHERE.
        tally: the votes so far, with room for N more candidates.
    """
    rays, hits = empty_rays(BLOCK), np.empty(BLOCK, np.int32)
    for begin in range(0, len(labels), BLOCK):
        block = labels[begin : begin + BLOCK]
        corner = points[3 * begin : 3 * (begin + len(block))]
        clip(corner, block, free_step_m, view, rays)
        place_points(rays, view, hits)
        own = hit_labels[begin : begin + BLOCK]
        vote_occupied(corner, own, rays, hits, pose, cells, voter, hit_region, tally)
        if free_region != NOWHERE:
            vote_free(corner, block, rays, pose, view, cells, free_step_m, voter, free_region, tally)
    if tally.once:
        if free_region != ANYWHERE:
            for v in range(len(tally.passed)):
                tally.passed[v] &= np.uint8(tally.regions[v] == free_region)
        for v in range(len(tally.passed)):
            tally.free[v] += tally.passed[v]
            tally.passed[v] = 0
