"""Encoding a frame in few bytes for a browser: sparse voxels and thinned points, delta-coded, in byte planes, deflated."""

from __future__ import annotations

import json
import struct
import zlib
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from carlasc.core.grids import Grid
from carlasc.core.scans import Scan
from carlasc.viewing.rendering.drawings import motion_arrows

Arrays = dict[str, NDArray[Any]]

OFFSET_STEPS = (
    8  # positions of a point within its cell, per axis: 2.5 cm in a 0.2 m cell, about the noise of the sensor
)


def encode_grid(grid: Grid) -> Arrays:
    """Encode the occupied voxels of a grid.

    Returns:
        `index`: differences of the rising C-order indices of the voxels. `label`: of each voxel. If the grid has counts, also
        `votes` of each voxel, and `unknown`: lengths of the alternating runs of known and unknown cells, known ones first.
    """
    flat = grid.labels.reshape(-1)
    occupied = np.flatnonzero(flat)
    arrays: Arrays = {"index": _gaps(occupied), "label": _narrow(flat[occupied])}
    if grid.counts is not None:
        votes = grid.counts.reshape(-1)[occupied]
        whole = (votes == np.round(votes)).all() and votes.max(initial=0) < 2**32
        arrays["votes"] = _narrow(votes.astype(np.uint32)) if whole else votes.astype(np.float32)
        arrays["unknown"] = _narrow(_gaps(np.flatnonzero(np.diff(~grid.known.reshape(-1), prepend=False))))
    return arrays


def encode_evidence(grid: Grid, fields: Mapping[str, NDArray[Any]]) -> Arrays:
    """Encode what is known of the occupied voxels of a grid besides their classes (see `docs/format.md#evidence`).

    Args:
        grid: the grid.
        fields: those of "occupied", "views" and "flags" that it has, each (X, Y, Z).

    Returns:
        For each of these fields an array with a value of each occupied voxel. `occupied` is in 1/255: 255 is the probability 1.
    """
    chosen = np.flatnonzero(grid.labels.reshape(-1))
    arrays = {name: field.reshape(-1)[chosen] for name, field in fields.items()}
    if "occupied" in arrays:
        arrays["occupied"] = np.round(255 * np.clip(arrays["occupied"].astype(np.float32), 0, 1)).astype(np.uint8)
    return {name: _narrow(values) for name, values in arrays.items()}


def encode_scan(scan: Scan, cell_m: float) -> Arrays:
    """Encode a scan, thinned to one point per cell, and an arrow for each moving actor.

    Returns:
        `box` (6,) int32: first cell and number of cells along each axis. `index`: differences of the rising C-order indices of the cells
        in the box. `offset` (3 N,): position within the cell in steps, axis by axis. `label` of each point, if the scan has labels.
        `arrows` (6 M,) float32: start point (m) and vector (m/s) of each arrow, if the scan has flow.
    """
    cells = np.floor(scan.points.astype(np.float64) / cell_m).astype(np.int64)
    lower = cells.min(0) if len(cells) else np.zeros(3, np.int64)
    size = cells.max(0) - lower + 1 if len(cells) else np.ones(3, np.int64)
    flat = np.ravel_multi_index(tuple((cells - lower).T), tuple(size))
    index, first = np.unique(flat, return_index=True)
    inside = scan.points[first] / cell_m - cells[first]
    offset = np.clip(np.floor(inside * OFFSET_STEPS), 0, OFFSET_STEPS - 1).astype(np.uint8)
    arrays: Arrays = {
        "box": np.concatenate([lower, size]).astype(np.int32),
        "index": _gaps(index),
        "offset": offset.T.reshape(-1),
    }
    if scan.labels is not None:
        arrays["label"] = _narrow(scan.labels[first])
    if scan.flow is not None:
        moving = scan.select(np.linalg.norm(scan.flow, axis=1) > 0)
        arrays["arrows"] = np.concatenate(motion_arrows(moving), axis=1).astype(np.float32).reshape(-1)
    return arrays


def pack_arrays(arrays: Mapping[str, NDArray[Any]]) -> bytes:
    """Return named flat arrays as one deflated block.

    The block holds the length of a JSON header (uint32, little-endian), the header ([name, type, length], ...) and the arrays one after
    the other. An array is stored as the first bytes of all its values, then the second bytes, and so on, which compresses better.
    """
    header = json.dumps([[name, array.dtype.name, array.size] for name, array in arrays.items()]).encode()
    parts = [struct.pack("<I", len(header)), header]
    for array in arrays.values():
        little = np.ascontiguousarray(array, array.dtype.newbyteorder("<"))
        parts.append(little.view(np.uint8).reshape(-1, array.dtype.itemsize).T.tobytes())
    return zlib.compress(b"".join(parts), 6)  # level 9 takes twice as long for 1.5 % fewer bytes


def _gaps(rising: NDArray[np.integer]) -> NDArray[np.unsignedinteger]:
    """Return the first value and the differences of rising ones, in the narrowest type."""
    values = rising.astype(np.int64)
    return _narrow(np.concatenate([values[:1], values[1:] - values[:-1]]))


def _narrow(values: NDArray[np.integer]) -> NDArray[np.unsignedinteger]:
    """Return non-negative integers in the narrowest unsigned type of at most 32 bits that holds them."""
    largest = int(values.max(initial=0))
    return values.astype(next(t for t in (np.uint8, np.uint16, np.uint32) if largest <= np.iinfo(t).max))
