"""OctoMap's files of binary trees (.bt): which cells are occupied, which are free; all others are unknown.

After a text header, each inner node is two bits for each of its eight children, 01 free, 10 occupied, 11 an inner node, 00 unknown, in the
order x + 2 y + 4 z; the inner nodes follow each other in depth-first order. A tree has 16 levels, and its middle is at the origin. See
A. Hornung et al., "OctoMap", Autonomous Robots 2013, section 5, and https://octomap.github.io.
"""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from carlasc.errors import ArgumentError
from carlasc.storage.files import write_output

_LEVELS = 16
_MIDDLE = 1 << (_LEVELS - 1)
_FREE, _OCCUPIED, _INNER = 1, 2, 3
_ALL_FREE, _ALL_OCCUPIED = 0x5555, 0xAAAA  # eight children alike, which are one leaf


def write_octomap(
    path: str | os.PathLike[str], cells: NDArray[np.integer], occupied: NDArray[np.bool_], cell_m: float
) -> None:
    """Write cells as a binary tree.

    Args:
        path: the file.
        cells: (N, 3) indices of cells, none twice: cell i begins at i times `cell_m`.
        occupied: (N,) which are occupied; the others are free.
        cell_m: size of a cell, metres.

    Raises:
        ArgumentError: a cell is farther from the origin than a tree reaches.
        StorageError: the file cannot be written; an earlier one stays.
    """
    farthest = int(np.abs(cells).max(initial=0))
    if farthest >= _MIDDLE:
        raise ArgumentError(
            "cell_m",
            expected=f"cells that reach at most {_MIDDLE * cell_m:g} m from the origin, as trees of OctoMap do",
            found=f"{farthest * cell_m:.0f} m",
            advice="take larger cells, or fewer frames",
        )
    nodes, tree = _encode(cells, occupied)
    text = f"# Octomap OcTree binary file\nid OcTree\nsize {nodes}\nres {float(cell_m)!r}\ndata\n"
    write_output(Path(path), text.encode() + tree)


def _encode(cells: NDArray[np.integer], occupied: NDArray[np.bool_]) -> tuple[int, bytes]:
    """Return the number of nodes of a tree, and its bytes."""
    code = _interleave((cells + _MIDDLE).astype(np.uint64))
    order = np.argsort(code)
    code, state = code[order], np.where(occupied[order], _OCCUPIED, _FREE).astype(np.uint16)
    nodes, first, inner = 1, [np.empty(0, np.uint64)], [np.empty(0, np.uint16)]
    depths = [np.empty(0, np.int8)]
    for depth in range(_LEVELS - 1, -1, -1):  # of the parents of these nodes
        starts = np.flatnonzero(np.diff(code >> np.uint64(3), prepend=np.uint64(1 << 63)))
        places = (np.uint64(2) * (code & np.uint64(7))).astype(np.uint16)
        masks = np.bitwise_or.reduceat(state << places, starts) if len(starts) else state
        alike = (masks == _ALL_FREE) | (masks == _ALL_OCCUPIED)
        nodes += len(code) - 8 * int(alike.sum())
        code = code[starts] >> np.uint64(3)
        first.append(code[~alike] << np.uint64(3 * (_LEVELS - depth)))
        inner.append(masks[~alike])
        depths.append(np.full(len(first[-1]), depth, np.int8))
        state = np.where(alike, masks & 3, _INNER).astype(np.uint16)
    order = np.lexsort((np.concatenate(depths), np.concatenate(first)))
    return nodes if len(cells) else 0, np.concatenate(inner)[order].astype("<u2").tobytes()


def _interleave(keys: NDArray[np.uint64]) -> NDArray[np.uint64]:
    """Return the bits of (N, 3) keys as one number each, those of z first."""
    code = np.zeros(len(keys), np.uint64)
    for bit in range(_LEVELS):
        for axis in range(3):
            code |= ((keys[:, axis] >> np.uint64(bit)) & np.uint64(1)) << np.uint64(3 * bit + axis)
    return code
