"""Grids in the geometry of other data sets: resampling, and the coordinate frames of other data
sets.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, TypeVar

import numpy as np
from numpy.typing import NDArray

from carlasc.core.arrays import BoolArray, IntArray, LabelArray
from carlasc.core.cells import run_starts
from carlasc.core.choices import Axes
from carlasc.core.grids import GridSpec, mirror_grid, mirror_spec, most_frequent

_Scalar = TypeVar("_Scalar", bound=np.generic)

_SNAP = 1e-6  # in voxels: a centre that is on a face, up to rounding, belongs to the voxel above it
_SAME = (
    1e-4  # relative difference of voxel sizes that are equal up to the float32 bounds of the layout
)


@dataclass(frozen=True)
class TargetFrame:
    """The frame of another data set's grids, as seen from a scan of the layout in right-handed axes
    (x forward, y to the left).

    Attributes:
        height_m: height of the scan's origin, which is the sensor, above the origin of the other
            frame.
        forward: axis that points forward: "x", with y to the left, or "y", with x to the right.
    """

    height_m: float = 0.0
    forward: Literal["x", "y"] = "x"

    def turn(self, grid: NDArray[_Scalar], axes: Axes) -> NDArray[_Scalar]:
        """Return an array of a grid of the layout, (X, Y, Z), with the axes of the frame.

        It is a view.
        """
        right = grid if axes == "right" else mirror_grid(grid)
        return right if self.forward == "x" else right[:, ::-1].transpose(1, 0, 2)

    def spec_in(self, spec: GridSpec, axes: Axes) -> GridSpec:
        """Return the geometry of a grid of the layout in this frame."""
        right = spec if axes == "right" else mirror_spec(spec)
        return self._moved(right, self.height_m, quarters=1)

    def spec_from(self, spec: GridSpec, axes: Axes) -> GridSpec:
        """Return the grid of the layout that has a geometry in this frame: the inverse of
        `spec_in`.
        """
        right = self._moved(spec, -self.height_m, quarters=3)
        return right if axes == "right" else mirror_spec(right)

    def _moved(self, spec: GridSpec, up_m: float, quarters: int) -> GridSpec:
        """Return a geometry moved up and, where y points forward, turned by quarters of a turn."""
        x0, y0, z0 = spec.lower
        x1, y1, z1 = spec.upper
        nx, ny, nz = spec.size
        for _ in range(quarters if self.forward == "y" else 0):
            nx, ny = ny, nx
            x0, x1, y0, y1 = -y1, -y0, x0, x1
        return GridSpec("cartesian", (nx, ny, nz), (x0, y0, z0 + up_m), (x1, y1, z1 + up_m))


def is_same(one: GridSpec, other: GridSpec) -> bool:
    """Return whether two Cartesian grids have the same voxels, up to the rounding of bounds."""
    near = [
        np.allclose(getattr(one, bound), getattr(other, bound), rtol=0, atol=_SAME)
        for bound in ("lower", "upper")
    ]
    return one.size == other.size and all(near)


def resample_to(
    labels: LabelArray,
    known: BoolArray,
    source: GridSpec,
    target: GridSpec,
) -> tuple[LabelArray, BoolArray]:
    """Express a Cartesian grid in the voxels of another one, in the same frame.

    Along an axis on which the target is not finer, a voxel of the source belongs to the voxel of
    the target that contains its centre. Along an axis on which it is finer, a voxel of the target
    takes the voxel of the source that contains its own centre. Of the voxels of the source that
    belong to a voxel of the target:

    - if any is occupied, the voxel takes the most frequent class of the occupied ones (the lowest
      id of equally frequent ones);
    - otherwise, if any is known, the voxel is free;
    - otherwise it is unknown.

    In `carlasc.groundtruth.resample`, which makes ground truth from finer ground truth, free voxels
    can outvote occupied ones. Here they cannot, so that thin objects stay.

    Args:
        labels: (X, Y, Z) class ids of the source; 0 is free. Those of unknown voxels do not matter.
        known: (X, Y, Z) bool.
        source: geometry of the source.
        target: geometry of the target.

    Returns:
        Labels of the target, 0 where it is free or unknown, and which of its voxels are known.
    """
    pairs = [_pair_axis(source, target, axis) for axis in range(3)]
    cells = np.nonzero((labels != 0) & known)
    rows = np.arange(len(cells[0]))
    places: list[IntArray] = []
    for axis, pair in enumerate(pairs):  # a cell may go to several voxels of the target
        kept, place = _targets_of(cells[axis][rows], pair, source.size[axis])
        rows = rows[kept]
        places = [earlier[kept] for earlier in places] + [place]
    classes = labels[tuple(cell[rows] for cell in cells)]
    resampled = np.zeros(target.num_voxels, labels.dtype)
    voxels, winners = most_frequent(np.ravel_multi_index(tuple(places), target.size), classes)
    resampled[voxels] = winners.astype(labels.dtype)
    seen = known
    # largest reduction first
    for axis in sorted(range(3), key=lambda axis: target.size[axis] / source.size[axis]):
        seen = _any_by_target(seen, pairs[axis], target.size[axis], axis)
    return resampled.reshape(target.size), seen


def _pair_axis(source: GridSpec, target: GridSpec, axis: int) -> tuple[IntArray, IntArray]:
    """Return which cells of the source go to which cells of the target along an axis: two arrays,
    which do not decrease.
    """
    finer = target.voxel_size[axis] < source.voxel_size[axis] * (1 - _SAME)
    # each cell of one has one cell of the other
    one, other = (target, source) if finer else (source, target)
    cells = np.arange(one.size[axis])
    centers = one.lower[axis] + (cells + 0.5) * one.voxel_size[axis]
    places = np.floor((centers - other.lower[axis]) / other.voxel_size[axis] + _SNAP).astype(
        np.int64
    )
    inside = (places >= 0) & (places < other.size[axis])
    return (places[inside], cells[inside]) if finer else (cells[inside], places[inside])


def _targets_of(
    cells: IntArray, pair: tuple[IntArray, IntArray], size: int
) -> tuple[IntArray, IntArray]:
    """Return the cells of the target that cells of the source go to along an axis.

    Args:
        cells: (N,) cells of the source.
        pair: which cells of the source go to which of the target.
        size: number of cells of the source along the axis.

    Returns:
        (M,) rows of `cells`, each as often as it goes to a cell of the target, and (M,) these
        cells.
    """
    count = np.bincount(pair[0], minlength=size)
    start = np.cumsum(count) - count
    times = count[cells]
    rows = np.repeat(np.arange(len(cells)), times)
    within = np.arange(len(rows)) - np.repeat(np.cumsum(times) - times, times)
    return rows, pair[1][start[cells[rows]] + within]


def _any_by_target(
    values: BoolArray,
    pair: tuple[IntArray, IntArray],
    size: int,
    axis: int,
) -> BoolArray:
    """Return `values` with the cells of the target along an axis: each is true if any of its cells
    of the source is true.
    """
    values = np.moveaxis(values, axis, 0)
    result = np.zeros((size, *values.shape[1:]), np.bool_)
    cells, places = pair
    first = run_starts(places)
    rank = np.arange(len(places)) - np.repeat(first, np.diff(first, append=len(places)))
    # no voxel of the target occurs twice in a pass
    for number in range(int(rank.max(initial=-1)) + 1):
        now = rank == number
        result[places[now]] |= values[cells[now]]
    return np.moveaxis(result, 0, axis)


def resampling_notes(source: GridSpec, target: GridSpec, name: str) -> list[str]:
    """Return what is lost if a grid is expressed in the voxels of another one, one line each; empty
    if the voxels are the same.

    Args:
        source: geometry of the grid, in the target's frame.
        target: geometry of the other data set's grids.
        name: name of the grid.
    """
    notes = []
    if (source.voxel_size > target.voxel_size * (1 + _SAME)).any():
        sizes = (" x ".join(f"{size:.3g}" for size in spec.voxel_size) for spec in (source, target))
        notes.append(
            "the voxels of the grid {} are larger than those that are written: {} m, not "
            "{} m".format(name, *sizes)
        )
    slack = source.voxel_size / 2
    if (np.array(source.lower) > target.lower + slack).any() or (
        np.array(source.upper) < target.upper - slack
    ).any():
        low = np.maximum(source.lower, target.lower)
        high = np.minimum(source.upper, target.upper)
        share = float(
            np.prod(np.maximum(high - low, 0)) / np.prod(np.subtract(target.upper, target.lower))
        )
        notes.append(
            f"the grid {name} covers {100 * share:.0f}% of the volume that is written: the rest "
            f"is unknown"
        )
    return notes
