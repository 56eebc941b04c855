"""Votes of the points of one class, without rays: points of many scans are counted densely, and
then become candidates of the ballot.
"""

from __future__ import annotations

import numpy as np

from carlasc.core.arrays import AnyArray, Float32Array, Int32Array, IntArray, Uint16Array
from carlasc.core.cells import Cells, Pose, find_voxel, transform
from carlasc.core.compiling import cached
from carlasc.groundtruth.voting.kernel import BLOCK, NONE, Tally, find_candidate
from carlasc.groundtruth.voting.rays import (
    DOUBTFUL,
    place_cartesian,
    place_cylindrical,
    view_from,
)

HIT_DTYPE = np.dtype([("votes", np.int32), ("voters", np.uint16), ("last", np.uint16)])
"""The votes of a voxel for the class, the number of their voters, and the last voter."""


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
    used: IntArray,
) -> None:
    """Count the points of one class of one voter.

    Args:
        points: (3, N) metres.
        sure: (N,) probability of the class of each point; empty: 1.
        pose: grid_T_points.
        cells: the cells of the grid.
        voter: number of the voter, from 1.
        hits: (V + 1,) HIT_DTYPE, 0 without votes; the last element counts points outside.
        doubt: (V + 1,) the summed doubt; empty if all classes are certain.
        hit: (N,) the voxels that are not 0.
        used: (1,) how many of them there are.
    """
    view, voxels, begin = view_from(pose, cells), np.empty(BLOCK, np.int32), 0
    xs, ys, zs = points[0], points[1], points[2]
    doubts, number, own = len(sure) > 0, used[0], np.uint16(voter)
    while begin < len(xs):
        # Places of a block first, in vectorised code.
        size = min(BLOCK, len(xs) - begin)
        if view.cylindrical:
            for i in range(size):
                x, y, z = transform(view.pose, xs[begin + i], ys[begin + i], zs[begin + i])
                voxels[i] = place_cylindrical(x, y, z, view)
        else:
            for i in range(size):
                x, y, z = transform(view.pose, xs[begin + i], ys[begin + i], zs[begin + i])
                voxels[i] = place_cartesian(x, y, z, view)
        for i in range(size):
            voxel = voxels[i]
            if voxel == DOUBTFUL:
                x, y, z = transform(pose, xs[begin + i], ys[begin + i], zs[begin + i])
                voxel = find_voxel(x, y, z, cells)
            if hits[voxel].votes == 0:
                hit[number] = voxel
                number += 1
            hits[voxel].votes += 1
            hits[voxel].voters += hits[voxel].last != own
            hits[voxel].last = own
            # the doubt is summed, not the certainty: it is 0 for labels without probabilities
            if doubts:
                doubt[voxel] += np.float32(1) - sure[begin + i]
        begin += size
    used[0] = number


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
            candidate.voter = NONE
        hits[voxel].votes = hits[voxel].voters = hits[voxel].last = 0
