"""The compiled loops that read votes which were counted: they sort them, and find the class that the votes of a voxel decide."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from carlasc.core.compiling import cached
from carlasc.groundtruth.voting.kernel import NONE


@cached
def collect(heads: NDArray[np.int32], candidates: NDArray[Any], rows: NDArray[Any]) -> None:
    """Write the candidates of all voxels into a table, sorted by voxel, then by label.

    Args:
        heads: (V,) index of the first candidate of each voxel, or NONE.
        candidates: (C,) CANDIDATE_DTYPE.
        rows: (C,) output, `voxel`, `label`, `votes`.
    """
    end = 0
    for head in heads:
        begin, entry = end, head
        while entry != NONE:
            row = end
            while row > begin and rows[row - 1].label > candidates[entry].label:
                rows[row] = rows[row - 1]
                row -= 1
            rows[row].voxel = candidates[entry].voxel
            rows[row].label = candidates[entry].label
            rows[row].votes = candidates[entry].votes
            end += 1
            entry = candidates[entry].next


@cached
def elect(rows: NDArray[Any], labels: NDArray[Any], counts: NDArray[Any]) -> None:
    """Find the class with most votes of each voxel, where ties go to the lowest id, and the sum of its votes.

    Args:
        rows: (M,) `voxel`, `label`, `votes` of the classes other than 0, sorted by voxel, then by label.
        labels: (V,) zeros; output, the classes.
        counts: (V,) votes of class 0; output, the sums.
    """
    row = 0
    while row < len(rows):
        voxel = rows[row].voxel
        label, most = np.uint16(0), np.int64(counts[voxel])
        while row < len(rows) and rows[row].voxel == voxel:
            votes = rows[row].votes
            counts[voxel] += votes
            if votes > most:
                label, most = rows[row].label, votes
            row += 1
        labels[voxel] = label


@cached
def interleave(free: NDArray[Any], rows: NDArray[Any], votes: NDArray[Any], most: int) -> None:
    """Write the votes of all classes into one table, sorted by voxel, then by label.

    Args:
        free: (V,) votes of class 0.
        rows: (M,) `voxel`, `label`, `votes` of the other classes, in this order.
        votes: output, `voxel`, `label`, `votes`, with a row for each element of `free` that is not 0 and for each of `rows`.
        most: numbers of votes above it are written as `most`.
    """
    row, end = 0, 0
    for voxel in range(len(free)):
        if free[voxel]:
            votes[end].voxel, votes[end].label, votes[end].votes = voxel, 0, min(np.int64(free[voxel]), most)
            end += 1
        while row < len(rows) and rows[row].voxel == voxel:
            votes[end].voxel, votes[end].label = voxel, rows[row].label
            votes[end].votes = min(rows[row].votes, most)
            row, end = row + 1, end + 1
