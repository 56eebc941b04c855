"""The hot loop of the ground truth: the votes of one observation, and what all votes of a voxel decide.

Blocks of rays are clipped to the grid and their samples placed by the vectorised code of rays.py; whatever that is not sure of is
placed by rule.py. Free votes are kept densely, occupied ones as chains of candidates, a few for each voxel that was hit.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from carlasc.core.cells import Cells, Pose, cached, fingerprint, inlined, jit, transform
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

BLOCK = 256  # rays: their coordinates stay in the first cache
NONE = -1  # end of a voxel's chain of candidates
ANYWHERE = -1  # votes that count in all regions

CANDIDATE_DTYPE = np.dtype(
    [("votes", np.int64), ("voxel", np.int32), ("next", np.int32), ("voter", np.int32), ("label", np.uint16)],
    align=True,
)
"""A class that a voxel may have: its votes, who voted last, and the voxel's next candidate."""


class Tally(NamedTuple):
    """The votes of V voxels.

    Attributes:
        once: whether an observation has at most one vote a voxel and class.
        free_once: whether it has at most one vote a voxel for free space.
        free: (V + 1,) votes for free space; the last one takes samples outside.
        passed: (V + 1,) uint8, voxels that the current observation saw free; all zero between observations. Only if `free_once`.
        heads: (V,) int32, first candidate of each voxel, or NONE.
        candidates: CANDIDATE_DTYPE, those of all voxels.
        used: (1,) int64, how many of them are in use.
        regions: (V,) uint16, region of each voxel; empty if there is only one.
    """

    once: bool
    free_once: bool
    free: NDArray[Any]
    passed: NDArray[np.uint8]
    heads: NDArray[np.int32]
    candidates: NDArray[Any]
    used: NDArray[np.int64]
    regions: NDArray[np.uint16]


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
    """Let the points of a block vote for their classes, in voxels of a region; those labelled 0 only let their rays vote."""
    for i in range(len(labels)):
        if rays.state[i] == DROPPED or labels[i] == 0:
            continue
        voxel = hits[i]
        if voxel == DOUBTFUL or rays.state[i] == UNSURE:
            _, voxel = sample_voxel(points[3 * i], points[3 * i + 1], points[3 * i + 2], 0.0, 0.0, pose, cells)
        if voxel < len(tally.heads) and (region == ANYWHERE or tally.regions[voxel] == region):
            vote_for(voxel, labels[i], voter, tally)


@inlined
def vote_for(voxel: int, label: int, voter: int, tally: Tally) -> None:
    """Give a voxel a vote for a class."""
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
    tally: Tally,
) -> None:
    """Let the samples before the points of a block vote for free space."""
    voxels = np.empty(CHUNK, np.int32)
    for i in range(len(labels)):
        if rays.state[i] == UNSURE:
            vote_free_by_rule(
                points[3 * i], points[3 * i + 1], points[3 * i + 2], pose, view, cells, free_step_m, tally
            )
        if rays.state[i] != SURE:
            continue
        x, y, z, dx, dy, dz = rays.x[i], rays.y[i], rays.z[i], rays.dx[i], rays.dy[i], rays.dz[i]
        step, last = rays.first[i], rays.last[i]
        while step <= last:
            # These loops stand here and not in a function: passing it an array would count a reference, every time.
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
            if tally.free_once:
                for j in range(number):
                    tally.passed[np.uint32(voxels[j])] = 1
            else:
                for j in range(number):
                    tally.free[np.uint32(voxels[j])] += 1
            step += CHUNK


@jit
def vote_free_by_rule(
    x: np.float32, y: np.float32, z: np.float32, pose: Pose, view: View, cells: Cells, free_step_m: float, tally: Tally
) -> None:
    """Let the samples of one ray vote for free space by the rule alone, clipped with a wide margin."""
    norm, ux, uy, uz = unit_ray(x, y, z)
    starts = transform(view.pose, x, y, z)
    units = transform(view.pose, ux, uy, uz)
    # Rounding adds less than this, in cells or metres: it grows as the distance, and is below the margin within reach.
    slack = 1.0 + MARGIN * norm / view.reach if view.reach > 0.0 else math.inf
    step, last = 1.0, math.inf
    for axis in range(3):
        stride = (units[axis] - view.pose[4 * axis + 3]) * free_step_m
        step, last = narrow(step, last, starts[axis], stride, view.low[axis] - slack, view.high[axis] + slack)
    step = np.floor(step)
    kept = step < 2.0**52  # beyond that one step more is no other number
    while kept and step <= last + 1.0:
        kept, voxel = sample_voxel(x, y, z, step, free_step_m, pose, cells)
        if tally.free_once:
            tally.passed[voxel] = 1
        else:
            tally.free[voxel] += 1
        step += 1.0


@cached
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


def _compile_vote(sources: int):  # type: ignore[no-untyped-def]
    """Return the function below. Closing over `sources` makes Numba's cache, which knows only this file, notice the others too."""

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
            points: (3 N,) float32 x, y, z of each point, sensor frame.
            labels: (N,) uint16; 0 takes no part.
            hit_labels: (N,) uint16, what the points themselves vote for; 0 leaves them their rays alone.
            pose: grid_T_sensor.
            view: the grid from there.
            cells: the grid.
            free_step_m: distance between free samples.
            voter: number of the observation.
            hit_region: region in which points vote, or ANYWHERE.
            free_region: region in which rays vote, or ANYWHERE.
            tally: the votes so far, with room for N more candidates.
        """
        _ = sources
        rays, hits = empty_rays(BLOCK), np.empty(BLOCK, np.int32)
        for begin in range(0, len(labels), BLOCK):
            block = labels[begin : begin + BLOCK]
            corner = points[3 * begin : 3 * (begin + len(block))]
            clip(corner, block, free_step_m, view, rays)
            place_points(rays, view, hits)
            own = hit_labels[begin : begin + BLOCK]
            vote_occupied(corner, own, rays, hits, pose, cells, voter, hit_region, tally)
            vote_free(corner, block, rays, pose, view, cells, free_step_m, tally)
        if tally.free_once:
            if free_region != ANYWHERE:
                for v in range(len(tally.regions)):
                    tally.passed[v] &= np.uint8(tally.regions[v] == free_region)
            for v in range(len(tally.passed)):
                tally.free[v] += tally.passed[v]
                tally.passed[v] = 0

    return vote


_SOURCES = ("rule.py", "rays.py", "kernel.py")
vote = _compile_vote(fingerprint(*(Path(__file__).parent / name for name in _SOURCES)))
