"""A grid from a finer one: each coarse voxel takes what most of the known fine cells in it are."""

from __future__ import annotations

import math
import os
from dataclasses import dataclass
from typing import Any

import numpy as np

from carlasc.core.classes import ClassTable
from carlasc.core.grids import Grid, GridSpec
from carlasc.errors import ArgumentError, MissingDataError
from carlasc.groundtruth.from_scans.inputs import StoredInputs, choose_frames, scan_fields
from carlasc.groundtruth.from_scans.windows import bare
from carlasc.groundtruth.inputs import FrameData, FrameInputs, FrameRange, Recipe, SequenceInputs
from carlasc.storage import open as open_source
from carlasc.storage.protocol import Sequence


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
            "--source grid", expected=f"a {fine.coordinates} grid like the one there", found=f"{coarse.coordinates}"
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
            "--source grid",
            expected=f"bounds within {fine.lower} .. {fine.upper}",
            found=f"{coarse.lower} .. {coarse.upper}",
        )


@dataclass(frozen=True)
class FinerGrid(FrameInputs):
    """One frame of a sequence whose finer grid is resampled; it holds paths only."""

    sequence: Sequence
    finer: str
    number: int
    source_frame: int

    def fields(self) -> tuple[str, ...]:
        """Return the scan fields that the frame has."""
        return scan_fields(self.sequence, self.number)

    def make(self, recipe: Recipe) -> FrameData:
        """Read the frame and resample its grid."""
        if recipe.keep_votes:
            raise ArgumentError(
                "--keep-votes", expected="grids that were voted on", found="--source grid, which only resamples"
            )
        fields = {name: self.sequence.read(name, self.number) for name in self.fields()}
        return FrameData(
            fields, resample(self.sequence.grid(self.finer, self.number), recipe.spec, recipe.classes), None
        )


class GridInputs(StoredInputs):
    """A sequence whose finer grid is resampled."""

    def __init__(self, sequence: Sequence, frames: FrameRange | None, finer: str) -> None:
        super().__init__(sequence)
        self.finer = finer
        chosen = choose_frames(sequence, sequence.frames(f"{finer}/labels"), frames)
        light = bare(sequence)
        self.frames = tuple(FinerGrid(light, finer, number, number) for number in chosen)

    def record(self) -> dict[str, Any]:
        """Return the kind of source and the finer grid."""
        return {"source": "grid", "grid": self.finer}


def grid_inputs(
    source: str | os.PathLike[str], frames: FrameRange | None, spec: GridSpec, from_grid: str | None
) -> list[SequenceInputs]:
    """Find the sequences of a source that have a finer grid of the coordinates asked for.

    Raises:
        MissingDataError: no sequence has such a grid.
        ArgumentError: the grid is not finer.
    """
    found: list[SequenceInputs] = []
    for sequence in open_source(source).sequences().values():
        grids = {n: s for n, s in sequence.grids.items() if s.coordinates == spec.coordinates and (from_grid or n) == n}
        if grids:
            finest = min(grids, key=lambda name: math.prod(grids[name].voxel_size.tolist()))
            check_coarser(grids[finest], spec)
            found.append(GridInputs(sequence, frames, finest))
    if not found:
        wanted = f"the grid {from_grid}" if from_grid else f"a {spec.coordinates} grid"
        raise MissingDataError(
            source, expected=f"{wanted} to resample", found="none", advice="make one from scans or a capture first"
        )
    return found
