"""Grids from finer grids: each voxel takes the most frequent class of the known cells in it."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from carlasc.core.arrays import Uint8Array
from carlasc.core.classes import ClassTable
from carlasc.core.grids import Grid, GridSpec, most_frequent
from carlasc.errors import ArgumentError, MissingDataError
from carlasc.groundtruth.inputs import (
    FrameData,
    FrameInput,
    GridPlan,
    SequenceInput,
    StoredFrame,
    StoredSequence,
    without_caches,
)
from carlasc.groundtruth.options import FromGrid
from carlasc.groundtruth.voting.ballot import Observation, count_votes
from carlasc.storage import as_source, layout
from carlasc.storage.files import AnyPath
from carlasc.storage.inputs import FrameFiles, SequenceFiles, combined
from carlasc.storage.protocol import Sequence, Source


def resample(grid: Grid, spec: GridSpec, classes: ClassTable) -> Grid:
    """Make a coarser grid from a finer one.

    A fine cell belongs to the coarse voxel that contains its centre. Each voxel takes the most
    frequent class of its known cells (ties go to the lowest id), and the sum of their counts.

    Args:
        grid: the finer grid.
        spec: the coarser grid, in the same frame.
        classes: class table of the labels.

    Returns:
        The coarse grid. Voxels without a known cell are unknown.

    Raises:
        ArgumentError: `spec` is finer than `grid` on an axis, of other coordinates, or extends
            beyond it.
    """
    check_coarser(grid.spec, spec)
    known = grid.known.reshape(-1)
    centers = grid.spec.from_axes(grid.spec.centers().reshape(-1, 3)[known])
    voxel = spec.flat_index(centers)
    inside = voxel >= 0
    labels = grid.labels.reshape(-1)[known][inside]
    weights = None if grid.counts is None else grid.counts.reshape(-1)[known][inside]
    coarse = np.zeros(spec.num_voxels, classes.dtype)
    voxels, winners = most_frequent(voxel[inside], labels)
    coarse[voxels] = winners.astype(classes.dtype)
    counts = np.bincount(voxel[inside], weights, spec.num_voxels)
    return Grid(spec, coarse.reshape(spec.size), counts.astype(np.float32).reshape(spec.size))


def _boxes(fine: Grid, spec: GridSpec) -> Uint8Array | None:
    """Return the boxes around the occupied cells of a finer grid in each voxel of a coarser one."""
    corners = np.stack(list(np.ndindex(2, 2, 2))) - 0.5
    # a corner on a border would belong to the voxel beside it
    corners *= (1 - 1e-3) * fine.spec.voxel_size
    centers = fine.spec.centers()[fine.labels > 0]
    points = (centers[:, None] + corners).reshape(-1, 3).astype(np.float32)
    seen = Observation(points, np.ones(len(points), np.uint8), np.eye(4))
    return count_votes([seen], spec, free_step_m=1e9, keep_boxes=True).boxes


def check_coarser(fine: GridSpec, coarse: GridSpec) -> None:
    """Check that a grid `coarse` can be made from a grid `fine`.

    Raises:
        ArgumentError: it cannot, with the reason.
    """
    if fine.coordinates != coarse.coordinates:
        raise ArgumentError(
            "resampling",
            expected=f"a {fine.coordinates} grid like the finer one",
            found=f"a {coarse.coordinates} one",
        )
    if (coarse.voxel_size < fine.voxel_size * (1 - 1e-4)).any():
        wanted, available = (
            " x ".join(f"{v:.4g}" for v in spec.voxel_size) for spec in (coarse, fine)
        )
        raise ArgumentError(
            "resampling",
            expected=f"voxels of at least {available}, the size of the finer grid's",
            found=wanted,
            advice="smaller voxels need new measurements: make the grid from scans or from a "
            "capture",
        )
    slack = fine.voxel_size
    if (np.array(coarse.lower) < fine.lower - slack).any() or (
        np.array(coarse.upper) > fine.upper + slack
    ).any():
        raise ArgumentError(
            "resampling",
            expected=f"bounds within {fine.lower} .. {fine.upper}",
            found=f"{coarse.lower} .. {coarse.upper}",
        )


@dataclass(frozen=True)
class ResampledFrame(StoredFrame):
    """One frame whose finer grid is resampled."""

    sequence: Sequence
    finer: str
    number: int
    source_frame: int

    def stored(self) -> Sequence:
        """Return the sequence."""
        return self.sequence

    def make(self, plan: GridPlan) -> FrameData:
        """Read the frame and resample its grid."""
        fields = self.read()
        finer = self.sequence.grid(self.finer, self.number)
        boxes = _boxes(finer, plan.spec) if plan.voting.keep_seen else None
        grid = resample(finer, plan.spec, self.sequence.metadata.classes)
        return FrameData(fields, grid, None, boxes=boxes)


class ResampledSequence(StoredSequence):
    """A sequence whose finer grid is resampled."""

    def __init__(self, sequence: Sequence, finer: str, plan: GridPlan) -> None:
        super().__init__(sequence, plan, f"{finer}/labels")
        self.finer = finer
        self._light = without_caches(sequence)

    def _frame(self, number: int) -> FrameInput:
        return ResampledFrame(self._light, self.finer, number, number)

    def files(self) -> FrameFiles:
        """Return the files of the scans and of the finer grid."""
        fields = [f"{self.finer}/{part}" for part in ("labels", "counts")]
        return SequenceFiles(without_caches(self.sequence), *fields)

    def about(self, frame: int) -> object:
        """Return all poses and times, if the cameras that see each voxel are kept."""
        texts = (layout.POSES, layout.TIMES) if self.plan.needs_all else ()
        present = self.sequence.documents()
        return [self.sequence.read_document(text) for text in texts if text in present]

    def made_from(self, number: int, own: Mapping[str, str], whole: str) -> str:
        """Return a digest of the scan and the finer grid of a frame."""
        return combined(own[str(number)], self.shared())

    def record(self) -> dict[str, Any]:
        """Return the name of the finer grid."""
        return {"observe": "grid", "grid": self.finer}


def resampled_sequences(
    source: AnyPath | Source, plan: GridPlan, observe: FromGrid
) -> list[SequenceInput]:
    """Find the sequences of a source that have a finer grid of the same coordinates.

    Raises:
        MissingDataError: no sequence has such a grid.
        ArgumentError: the grid is not finer, or votes are to be kept.
    """
    if plan.voting.keep:
        raise ArgumentError(
            "keep", expected="False for resampled grids, which have no votes", found="True"
        )
    sequences: list[SequenceInput] = []
    for sequence in as_source(source).sequences().values():
        grids = {
            name: spec
            for name, spec in sequence.grids.items()
            if spec.coordinates == plan.spec.coordinates and observe.name in (None, name)
        }
        if grids:
            finest = min(grids, key=lambda name: math.prod(grids[name].voxel_size.tolist()))
            check_coarser(grids[finest], plan.spec)
            sequences.append(ResampledSequence(sequence, finest, plan))
    if not sequences:
        wanted = f"the grid {observe.name}" if observe.name else f"a {plan.spec.coordinates} grid"
        raise MissingDataError(
            source,
            expected=f"{wanted} to resample",
            found="none",
            advice="make one from scans or a capture first",
        )
    return sequences
