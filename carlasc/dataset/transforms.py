"""Augmentations of samples. They change all fields of a sample consistently."""

from __future__ import annotations

import math
import multiprocessing
import zlib
from collections.abc import Callable, Iterable
from multiprocessing.context import get_spawning_popen
from typing import Any, cast

import numpy as np

from carlasc.core.arrays import AnyArray
from carlasc.core.grids import GridSpec
from carlasc.dataset.fields import Sample, Values
from carlasc.dataset.labels import OF_GRID
from carlasc.errors import ArgumentError

_DIRECTIONS = ("x", "y")
_TOLERANCE = 1e-5  # the published azimuth bounds are pi as float32, with an error of 9e-8
# dimension of a field that is x or the radius
_FIRST_GRID_AXIS = dict.fromkeys(OF_GRID, 0) | dict.fromkeys(
    ("occupancy", "density", "visibility", "posterior"), 1
)


class Flip:
    """Mirrors samples at random along x and along y, independently: grids, points, flow and poses.

    In a Cartesian grid, a flip reverses an axis. In a cylindrical grid, a flip of y reverses the
    azimuth, and a flip of x reverses the azimuth and rolls it by half a turn; the radius is never
    flipped. Poses are conjugated with the reflection, so they still align the flipped scans.

    With a seed, the flips of a sample depend only on the seed, the epoch, and `sequence` and
    `frame` of the sample: they are equal in every worker process. `set_epoch` also reaches
    persistent workers; without it, every epoch has the same flips. Without a seed, every call is
    random.

        dataset.transform = flips = Flip(dataset.spec, seed=0)
        for epoch in range(epochs):
            flips.set_epoch(epoch)
            for batch in loader: ...
    """

    def __init__(
        self,
        spec: GridSpec | None,
        directions: Iterable[str] = _DIRECTIONS,
        *,
        probability: float = 0.5,
        seed: int | None = None,
    ) -> None:
        """Check that the grid can be flipped.

        Args:
            spec: the grid of the samples, `dataset.spec`; None if samples have no grid.
            directions: directions in which samples may be flipped: "x", "y" or both.
            probability: probability of a flip, for each direction.
            seed: seed for reproducible flips; None for random flips at each call.

        Raises:
            ArgumentError: the grid is not symmetric in a direction, or an argument is not valid.
        """
        self.directions = tuple(directions)
        if not set(self.directions) <= set(_DIRECTIONS):
            raise ArgumentError(
                "directions", expected="x, y or both", found=", ".join(map(repr, self.directions))
            )
        if not 0 <= probability <= 1:
            raise ArgumentError("probability", expected="0..1", found=str(probability))
        if seed is not None and seed < 0:
            raise ArgumentError("seed", expected="0 or more", found=str(seed))
        self.spec = spec
        self.probability = probability
        self.seed = seed
        self._epoch = _SharedNumber()
        if spec is not None:
            for direction in self.directions:
                _check_symmetric(spec, direction)

    def set_epoch(self, epoch: int) -> None:
        """Set the next epoch.

        Call this before iterating over the DataLoader, as with a DistributedSampler.
        """
        self._epoch.cell.value = epoch

    def __call__(self, sample: Sample) -> Sample:
        """Return the sample, possibly flipped. The input is not changed."""
        seed: list[int] | None = None
        if self.seed is not None:
            seed = [
                self.seed,
                self._epoch.cell.value,
                zlib.crc32(sample["sequence"].encode()),
                sample["frame"],
            ]
        drawn = np.random.default_rng(seed).random(len(_DIRECTIONS)) < self.probability
        for direction, flipped in zip(_DIRECTIONS, drawn, strict=True):
            if flipped and direction in self.directions:
                sample = flip(sample, direction, self.spec)
        return sample


def flip(sample: Sample, direction: str, spec: GridSpec | None) -> Sample:
    """Return a sample mirrored in "x" or "y".

    Args:
        sample: a sample of a Dataset. Fields other than grids, points, flow and poses are
            unchanged.
        direction: "x" or "y".
        spec: the grid of the sample; None if it has no grid.

    Raises:
        ArgumentError: the grid is not symmetric in this direction, or the sample has images.
    """
    if {"images", "cameras"} & sample.keys():
        raise ArgumentError(
            "sample",
            expected="a sample without images and cameras",
            found="one with them",
            advice="leave `images` and `cameras` out of `fields`, or do not flip",
        )
    column, given = _DIRECTIONS.index(direction), cast(Values, sample)
    flipped = dict(given)
    if spec is not None:
        _check_symmetric(spec, direction)
        for name in _FIRST_GRID_AXIS.keys() & given.keys():
            flipped[name] = _flip_grid(given[name], _FIRST_GRID_AXIS[name], column, spec)
    for name in {"points", "flow", "voxel_flow"} & given.keys():
        flipped[name] = flipped[name].copy()
        flipped[name][..., column] *= -1
    if "poses" in sample:
        mirror = np.eye(4)
        mirror[column, column] = -1
        flipped["poses"] = mirror @ sample["poses"] @ mirror
    return cast(Sample, flipped)


def _flip_grid(grid: AnyArray, first: int, column: int, spec: GridSpec) -> AnyArray:
    """Mirror an array whose dimension `first` is x or the radius."""
    if spec.coordinates == "cartesian":
        return np.ascontiguousarray(np.flip(grid, first + column))
    azimuth = first + 1
    mirrored = np.flip(grid, azimuth)  # y: azimuth -> -azimuth
    if column == 0:  # x: azimuth -> pi - azimuth
        mirrored = np.roll(mirrored, spec.size[1] // 2, azimuth)
    return np.ascontiguousarray(mirrored)


def _check_symmetric(spec: GridSpec, direction: str) -> None:
    column = _DIRECTIONS.index(direction)
    bounds = 1 if spec.coordinates == "cylindrical" else column
    lower, upper = spec.lower[bounds], spec.upper[bounds]
    if not math.isclose(lower, -upper, abs_tol=_TOLERANCE):
        raise ArgumentError(
            f"flip of {direction}",
            expected="a grid that is symmetric about 0",
            found=f"{lower}..{upper} ({spec})",
        )
    if spec.coordinates == "cylindrical" and direction == "x":
        turn = math.isclose(upper - lower, 2 * math.pi, abs_tol=_TOLERANCE)
        if not turn or spec.size[1] % 2:
            raise ArgumentError(
                "flip of x",
                expected="a full turn in an even number of cells",
                found=f"{spec.size[1]} cells over {lower}..{upper} rad",
            )


class _SharedNumber:
    """A number in shared memory. Persistent workers have copies of all other attributes."""

    def __init__(self, value: int = 0, cell: Any = None) -> None:
        self.cell = multiprocessing.Value("q", value, lock=False) if cell is None else cell

    def __reduce__(self) -> tuple[Callable[..., _SharedNumber], tuple[Any, ...]]:
        """Share the memory when a process is spawned; in any other pickle, store the number."""
        if get_spawning_popen() is not None:
            return _SharedNumber, (0, self.cell)
        return _SharedNumber, (int(self.cell.value),)
