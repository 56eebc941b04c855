"""The compiled loops of voting: they add the votes of one observation, or of points without rays,
and collect the counted votes.

Rays are processed in blocks. The vectorised code of rays.py clips them to the grid and finds the
voxels of their samples. Where rounding could change the voxel, the exact rule finds it. Votes for
free space are stored densely, votes for other classes as a linked list of candidates per voxel.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from carlasc.core.arrays import (
    AnyArray,
    Float32Array,
    FloatArray,
    Int32Array,
    IntArray,
    Uint8Array,
    Uint16Array,
)
from carlasc.core.cells import Cells, Pose, find_voxel, pose_of, transform
from carlasc.core.compiling import cached, inlined, jit
from carlasc.groundtruth.voting.rays import (
    CHUNK,
    DOUBTFUL,
    DROPPED,
    MARGIN,
    SURE,
    UNSURE,
    GridView,
    RayBlock,
    clip,
    empty_rays,
    narrow,
    place_cartesian,
    place_cylindrical,
    place_points,
    point_of,
    sample_voxel,
    unit_ray,
    view_from,
)

BLOCK = 256  # number of rays whose coordinates fit into the L1 cache
NONE = -1  # end of a voxel's list of candidates

CANDIDATE_DTYPE = np.dtype(
    [
        ("votes", np.int64),
        ("voxel", np.int32),
        ("next", np.int32),
        ("voter", np.int32),
        ("voters", np.int32),
        ("doubt", np.float32),
        ("label", np.uint16),
    ],
    align=True,
)
"""A candidate class of a voxel: its votes, its last voter, its number of voters, the summed doubt
of its votes, and the next candidate.
"""

HIT_DTYPE = np.dtype([("votes", np.int32), ("voters", np.uint16), ("last", np.uint16)])
"""The votes of a voxel for a class, the number of their voters, and the last voter. It is small, as
there is one for each voxel: a window has less than 65,536 scans.
"""


class Tally(NamedTuple):
    """The votes of V voxels.

    Attributes:
        once: whether an observation has at most one vote per voxel and class, free space included.
        free: (V + 1,) votes for free space; the last element counts samples outside the grid.
        passed: (V + 1,) uint8, 1 for voxels that the current observation saw free; all 0 between
            observations. Empty if every sample counts.
        heads: (V,) int32, index of the first candidate of each voxel, or NONE.
        candidates: (C,) CANDIDATE_DTYPE, the candidates of all voxels.
        used: (1,) int64, number of candidates in use.
    """

    once: bool
    free: AnyArray
    passed: Uint8Array
    heads: Int32Array
    candidates: AnyArray
    used: IntArray


class Voters(NamedTuple):
    """The voters of one observation: its points, labels and poses.

    Attributes:
        points: (3 N,) float32, metres, x, y, z of each point from the origin of its ray, on the
            axes of the sensor.
        labels: (N,) uint16; points labelled 0 and their rays do not vote.
        poses: (K, 12) grid_T_place of the origins of rays; each one is a voter.
        ends: (K,) index after the last point of each origin.
    """

    points: Float32Array
    labels: Uint16Array
    poses: FloatArray
    ends: IntArray


@inlined
def find_candidate(voxel: int, label: int, tally: Tally) -> int:
    """Return the index of the candidate of a class in a voxel, which is made if there is none."""
    heads, candidates = tally.heads, tally.candidates
    entry = heads[voxel]
    while entry != NONE and candidates[entry].label != label:
        entry = candidates[entry].next
    if entry == NONE:
        entry = tally.used[0]
        tally.used[0] += 1
        candidates[entry].votes = candidates[entry].voters = 0
        candidates[entry].doubt = 0
        candidates[entry].voxel = voxel
        # A new candidate becomes the head of the list: classes seen last are looked up first, and
        # points that follow each other often have one class.
        candidates[entry].next = heads[voxel]
        candidates[entry].voter = NONE
        candidates[entry].label = label
        heads[voxel] = entry
    return entry


@jit
def vote_occupied(
    points: Float32Array,
    labels: Uint16Array,
    rays: RayBlock,
    voxels: Int32Array,
    pose: Pose,
    cells: Cells,
    voter: int,
    tally: Tally,
) -> None:
    """Add the votes of the points of a block for their classes."""
    # `entry` is the candidate of the pair (last, label) for which the point before voted, and
    # `more` its votes that are not written yet: neighbouring points are often in one voxel.
    # Arrays are taken out of the tuples once: Numba counts a reference each time.
    heads = tally.heads
    candidates = tally.candidates
    states = rays.state
    once = tally.once
    entry, last, label, more = 0, NONE, np.uint16(0), 0
    for i in range(len(labels)):
        if states[i] == DROPPED:
            continue
        voxel = voxels[i]
        if voxel == DOUBTFUL or states[i] == UNSURE:
            _, voxel = sample_voxel(point_of(points, i), 0.0, 0.0, pose, cells)
        if voxel >= len(heads):
            continue
        if voxel == last and labels[i] == label:
            more += not once
        else:
            if more:
                candidates[entry].votes += more
            last, label, more = voxel, labels[i], 0
            entry = find_candidate(voxel, label, tally)
            # A sum of conditions instead of the branch would make the kernel 1.5 times slower.
            if not once or candidates[entry].voter != voter:
                candidates[entry].votes += 1
                candidates[entry].voters += candidates[entry].voter != voter
                candidates[entry].voter = voter
    if more:
        candidates[entry].votes += more


@jit
def vote_free(
    points: Float32Array,
    labels: Uint16Array,
    rays: RayBlock,
    pose: Pose,
    view: GridView,
    cells: Cells,
    free_step_m: float,
    tally: Tally,
) -> None:
    """Add the votes of the free samples of a block, which lie between the sensor and the points.

    Each sample is added, or marked in `passed` if an observation has one vote per voxel.
    """
    voxels = np.empty(CHUNK, np.int32)
    for i in range(len(labels)):
        if rays.state[i] == UNSURE:
            vote_free_by_rule(point_of(points, i), pose, view, cells, free_step_m, tally)
        if rays.state[i] != SURE:
            continue
        x = rays.x[i]
        y = rays.y[i]
        z = rays.z[i]
        dx = rays.dx[i]
        dy = rays.dy[i]
        dz = rays.dz[i]
        step, last = rays.first[i], rays.last[i]
        while step <= last:
            # These loops are inline: in a function, Numba would count a reference to the array at
            # every call.
            # A whole chunk is computed also at the end of a ray, without a branch; `number` leaves
            # out the samples after the last one.
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
            # DOUBTFUL is the only negative index: the lowest one says whether any is.
            if lowest == DOUBTFUL:
                for j in range(number):
                    if voxels[j] == DOUBTFUL:
                        point = point_of(points, i)
                        _, voxels[j] = sample_voxel(point, step + j, free_step_m, pose, cells)
            if tally.once:
                for j in range(number):
                    tally.passed[np.uint32(voxels[j])] = 1
            else:
                for j in range(number):
                    tally.free[np.uint32(voxels[j])] += np.uint32(1)
            step += CHUNK


@jit
def vote_free_by_rule(
    point: tuple[np.float32, np.float32, np.float32],
    pose: Pose,
    view: GridView,
    cells: Cells,
    free_step_m: float,
    tally: Tally,
) -> None:
    """Add the votes of the free samples of one ray by the exact rule, clipped to the grid with a
    wide margin.
    """
    x, y, z = point
    norm, ux, uy, uz = unit_ray(x, y, z)
    starts = transform(view.pose, x, y, z)
    units = transform(view.pose, ux, uy, uz)
    # Bound on the rounding error, in cells or metres. It grows with the distance and is below
    # MARGIN within `reach`.
    slack = 1.0 + MARGIN * norm / view.reach if view.reach > 0.0 else math.inf
    step, last = 1.0, math.inf
    for axis in range(3):
        stride = (units[axis] - view.pose[4 * axis + 3]) * free_step_m
        step, last = narrow(
            step, last, starts[axis], stride, view.low[axis] - slack, view.high[axis] + slack
        )
    # The range is wider than needed; the rule decides for each sample.
    step = np.floor(step)
    kept = step < 2.0**52  # above it, step + 1 may be equal to step
    while kept and step <= last + 1.0:
        kept, voxel = sample_voxel(point, step, free_step_m, pose, cells)
        if tally.once:
            tally.passed[voxel] = 1
        else:
            tally.free[voxel] += np.uint32(1)
        step += 1.0


@cached
def vote(cast: Voters, cells: Cells, free_step_m: float, voter: int, tally: Tally) -> None:
    """Add the votes of one observation.

    Args:
        cast: the observation.
        cells: the cells of the grid.
        free_step_m: distance between two free samples, metres.
        voter: number of the first voter.
        tally: the votes so far, with room for N more candidates.
    """
    points, labels, poses, ends = cast
    rays, voxels, begin = empty_rays(BLOCK), np.empty(BLOCK, np.int32), 0
    for place in range(len(ends)):
        pose = pose_of(poses, place)
        view = view_from(pose, cells)
        # Blocks fit into the cache: what one of the passes over a block writes, the next one reads.
        while begin < ends[place]:
            end = min(begin + BLOCK, ends[place])
            corner, block = points[3 * begin : 3 * end], labels[begin:end]
            clip(corner, block, free_step_m, view, rays)
            place_points(rays, view, voxels[: end - begin])
            vote_occupied(corner, block, rays, voxels, pose, cells, voter + place, tally)
            vote_free(corner, block, rays, pose, view, cells, free_step_m, tally)
            begin = end
        if tally.once:
            for v in range(len(tally.passed)):
                tally.free[v] += tally.passed[v]
                tally.passed[v] = 0


@cached
def count_hits(
    points: Float32Array,
    sure: Float32Array,
    pose: Pose,
    cells: Cells,
    voter: int,
    hits: AnyArray,
    doubt: Float32Array,
    hit: Int32Array,
    number: int,
) -> int:
    """Count the points of one class of one voter, and return the number of voxels with votes.

    Most voxels have points of many scans. A dense count finds them faster than lists of candidates.

    Args:
        points: (3, N) metres.
        sure: (N,) probability of the class of each point; empty: 1.
        pose: grid_T_points.
        cells: the cells of the grid.
        voter: number of the voter, from 1: `last` is 0 without one.
        hits: (V + 1,) HIT_DTYPE, 0 without votes; the last element counts points outside.
        doubt: (V + 1,) the summed doubt; empty if all classes are certain.
        hit: (N,) the voxels with votes, in the order of their first votes.
        number: how many of them there were before.
    """
    view, voxels, begin = view_from(pose, cells), np.empty(BLOCK, np.int32), 0
    doubts, own = len(sure) > 0, np.uint16(voter)
    while begin < points.shape[1]:
        # Places of a block first, in vectorised code: from slices, as Numba would look for negative
        # values of another index, and the processor would gather the numbers one by one.
        end = min(begin + BLOCK, points.shape[1])
        xs, ys, zs = points[0, begin:end], points[1, begin:end], points[2, begin:end]
        if view.cylindrical:
            for i in range(len(xs)):
                x, y, z = transform(view.pose, xs[i], ys[i], zs[i])
                voxels[i] = place_cylindrical(x, y, z, view)
        else:
            for i in range(len(xs)):
                x, y, z = transform(view.pose, xs[i], ys[i], zs[i])
                voxels[i] = place_cartesian(x, y, z, view)
        for i in range(len(xs)):
            voxel = voxels[i]
            if voxel == DOUBTFUL:
                x, y, z = transform(pose, xs[i], ys[i], zs[i])
                voxel = find_voxel(x, y, z, cells)
            if hits[voxel].votes == 0:
                hit[number] = voxel
                number += 1
            hits[voxel].votes += 1
            hits[voxel].voters += hits[voxel].last != own
            hits[voxel].last = own
            # The doubt is summed, not the certainty: it is 0 for labels without probabilities.
            if doubts:
                doubt[voxel] += np.float32(1) - sure[begin + i]
        begin = end
    return number


@cached
def add_hits(
    label: int,
    hits: AnyArray,
    doubt: Float32Array,
    hit: Int32Array,
    regions: Uint16Array,
    region: int,
    tally: Tally,
) -> None:
    """Add the counted votes to the candidates, for which there must be room, and clear them.

    Args:
        label: the class.
        hits: (V + 1,) HIT_DTYPE.
        doubt: (V + 1,) the summed doubt, or empty.
        hit: (N,) the voxels that have votes.
        regions: (V,) region of each voxel; empty: all voxels count.
        region: the region whose voxels count.
        tally: the votes so far.
    """
    for voxel in hit:
        if voxel < len(tally.heads) and (len(regions) == 0 or regions[voxel] == region):
            entry = find_candidate(voxel, label, tally)
            candidate = tally.candidates[entry]
            candidate.votes += hits[voxel].voters if tally.once else hits[voxel].votes
            candidate.voters += hits[voxel].voters
            candidate.doubt += doubt[voxel] if len(doubt) else np.float32(0)
            candidate.voter = NONE  # the next observation is another voter
        hits[voxel].votes = hits[voxel].voters = hits[voxel].last = 0


@cached
def collect(heads: Int32Array, candidates: AnyArray, rows: AnyArray) -> None:
    """Write the candidates of all voxels into a table, sorted by voxel, then by label.

    Args:
        heads: (V,) index of the first candidate of each voxel, or NONE.
        candidates: (C,) CANDIDATE_DTYPE.
        rows: (C,) output, `voxel`, `label`, `votes`, `voters`, `sure`.
    """
    end = 0
    for head in heads:
        begin, entry = end, head
        # Insertion sort: rows from `begin` to `end` are sorted by label. Lists are short.
        while entry != NONE:
            row = end
            while row > begin and rows[row - 1].label > candidates[entry].label:
                rows[row] = rows[row - 1]
                row -= 1
            rows[row].voxel = candidates[entry].voxel
            rows[row].label = candidates[entry].label
            rows[row].votes = candidates[entry].votes
            rows[row].voters = candidates[entry].voters
            rows[row].sure = candidates[entry].votes - candidates[entry].doubt
            end += 1
            entry = candidates[entry].next


@cached
def elect(rows: AnyArray, labels: AnyArray, counts: AnyArray) -> None:
    """Find the class with most votes in each voxel, where ties go to the lowest id, and the sum of
    its votes.

    Args:
        rows: (M,) `voxel`, `label`, `votes` of the classes other than 0, sorted by voxel, then by
            label.
        labels: (V,) zeros; output, the classes.
        counts: (V,) votes of class 0; output, the sums.
    """
    row = 0
    while row < len(rows):
        voxel = rows[row].voxel
        # Labels rise within a voxel, and only more votes replace a class: ties go to the lowest.
        label, most = np.uint16(0), np.int64(counts[voxel])
        while row < len(rows) and rows[row].voxel == voxel:
            votes = rows[row].votes
            counts[voxel] += votes
            if votes > most:
                label, most = rows[row].label, votes
            row += 1
        labels[voxel] = label


@cached
def interleave(free: AnyArray, rows: AnyArray, votes: AnyArray, most: int) -> None:
    """Write the votes of all classes into one table, sorted by voxel, then by label.

    Args:
        free: (V,) votes of class 0.
        rows: (M,) `voxel`, `label`, `votes` of the other classes, in this order.
        votes: output, `voxel`, `label`, `votes`, with a row for each element of `free` that is not
            0 and for each of `rows`.
        most: numbers of votes above it are written as `most`.
    """
    row, end = 0, 0
    for voxel in range(len(free)):
        # `row` is the first row of this voxel or of a later one; free space is label 0, the lowest.
        if free[voxel]:
            votes[end].voxel, votes[end].label = voxel, 0
            votes[end].votes = min(np.int64(free[voxel]), most)
            end += 1
        while row < len(rows) and rows[row].voxel == voxel:
            votes[end].voxel, votes[end].label = voxel, rows[row].label
            votes[end].votes = min(rows[row].votes, most)
            row, end = row + 1, end + 1
