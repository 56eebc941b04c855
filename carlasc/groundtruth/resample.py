"""A grid from a finer one: each coarse voxel takes what most of the known fine cells in it are."""

from __future__ import annotations

import numpy as np

from carlasc.errors import ArgumentError
from carlasc.grids import Grid, GridSpec
from carlasc.labels import ClassTable


def resample(grid: Grid, spec: GridSpec, classes: ClassTable) -> Grid:
    """Make a coarser grid of a finer one.

    A fine cell belongs to the coarse voxel that holds its centre: where the sizes divide, those are just its whole cells. The
    class of most known cells wins, ties go to the lowest id; counts add up.

    Args:
        grid: the finer grid; both grids are in one frame.
        spec: the coarser grid.
        classes: table of the labels.

    Returns:
        The coarse grid; voxels without a known cell are unknown.

    Raises:
        ArgumentError: the grid asked for is finer on an axis, of other coordinates, or reaches beyond: what was never
            measured cannot be made up.
    """
    check_coarser(grid.spec, spec)
    known = grid.known.reshape(-1)
    centers = grid.spec.from_axes(grid.spec.centers().reshape(-1, 3)[known])
    voxel = spec.flat_index(centers)
    inside = voxel >= 0
    labels = grid.labels.reshape(-1)[known][inside].astype(np.int64)
    weights = None if grid.counts is None else grid.counts.reshape(-1)[known][inside]
    pairs, cells = np.unique(voxel[inside] * classes.num_channels + labels, return_counts=True)
    # Written in rising number of cells, and among equals from the highest id down: the last one stays.
    order = np.lexsort((-(pairs % classes.num_channels), cells))
    coarse = np.zeros(spec.num_voxels, classes.dtype)
    coarse[pairs[order] // classes.num_channels] = (pairs[order] % classes.num_channels).astype(classes.dtype)
    counts = np.bincount(voxel[inside], weights, spec.num_voxels)
    return Grid(spec, coarse.reshape(spec.size), counts.astype(np.float32).reshape(spec.size))


def check_coarser(fine: GridSpec, coarse: GridSpec) -> None:
    """Raise ArgumentError, saying why, where `coarse` cannot be made of `fine`."""
    if fine.coordinates != coarse.coordinates:
        raise ArgumentError(
            f"--source grid: expected a {fine.coordinates} grid like the one there, found {coarse.coordinates}"
        )
    if (coarse.voxel_size < fine.voxel_size * (1 - 1e-4)).any():
        sizes = [" x ".join(f"{v:.4g}" for v in spec.voxel_size) for spec in (coarse, fine)]
        raise ArgumentError(
            f"--source grid: voxels of {sizes[0]} cannot be made of voxels of {sizes[1]}: detail that was never measured"
            " cannot be made up; regrid from scans or from a capture"
        )
    slack = fine.voxel_size
    if (np.array(coarse.lower) < fine.lower - slack).any() or (np.array(coarse.upper) > fine.upper + slack).any():
        raise ArgumentError(
            f"--source grid: expected bounds within {fine.lower} .. {fine.upper}, found {coarse.lower} .. {coarse.upper}"
        )
