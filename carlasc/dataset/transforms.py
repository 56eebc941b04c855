"""Augmentations of samples: they change everything that a sample holds alike, and are told the grid they work on."""

from __future__ import annotations

import math
import multiprocessing
import zlib
from collections.abc import Callable, Iterable
from multiprocessing.context import get_spawning_popen
from typing import Any

import numpy as np
from numpy.typing import NDArray

from carlasc.core.grids import GridSpec
from carlasc.errors import ArgumentError

Sample = dict[str, Any]

_AXES = ("x", "y")
_CLOSE = 1e-5  # the published azimuth bounds are a float32 pi: off by 9e-8
_FIRST_GRID_AXIS = {"occupancy": 1, "density": 1, "labels": 0, "known": 0, "counts": 0}


class Flip:
    """Mirrors samples in x and in y, each with its own coin: grids, points, flow and poses together.

    In a Cartesian grid a flip reverses the grid's axis. In a cylindrical one a flip of y reverses the azimuth, a flip of x
    reverses it and rolls it by half a turn; the radius is never flipped. Poses are conjugated with the reflection, so
    they still move the flipped scans onto each other.

    With a seed, the coins of a sample follow from the seed, the epoch, and the sample's `sequence` and `frame`: the same in
    whichever worker process it is loaded. `set_epoch` reaches the workers, persistent ones too; without it every
    epoch flips alike. Without a seed every call tosses anew.

        dataset.transform = Flip(dataset.spec, seed=0)
        for epoch in range(epochs):
            dataset.transform.set_epoch(epoch)
            for batch in loader: ...
    """

    def __init__(
        self,
        spec: GridSpec | None,
        axes: Iterable[str] = _AXES,
        *,
        probability: float = 0.5,
        seed: int | None = None,
    ) -> None:
        """Check that the grid can be flipped.

        Args:
            spec: the samples' grid, `dataset.spec`; None where they hold no grid.
            axes: which of "x" and "y" may be flipped.
            probability: of a flip, for each axis.
            seed: makes the flips repeatable; None tosses anew each time.

        Raises:
            ArgumentError: an axis that the grid is not symmetric about, or an argument that makes no sense.
        """
        self.axes = tuple(axes)
        if not set(self.axes) <= set(_AXES):
            raise ArgumentError("flip axes", expected="some of x and y", found=f"{', '.join(map(repr, self.axes))}")
        if not 0 <= probability <= 1:
            raise ArgumentError("flip probability", expected="0..1", found=f"{probability}")
        if seed is not None and seed < 0:
            raise ArgumentError("flip seed", expected="0 or more", found=f"{seed}")
        self.spec = spec
        self.probability = probability
        self.seed = seed
        self._epoch = _SharedNumber()
        if spec is not None:
            for axis in self.axes:
                _check_symmetric(spec, axis)

    def set_epoch(self, epoch: int) -> None:
        """Say which epoch begins: before the DataLoader is iterated, as with a DistributedSampler."""
        self._epoch.value = epoch

    def __call__(self, sample: Sample) -> Sample:
        """Return the sample, flipped or not; the input is left as it is."""
        coins = self._generator(sample).random(len(_AXES)) < self.probability
        for axis, coin in zip(_AXES, coins, strict=True):
            if coin and axis in self.axes:
                sample = flip(sample, axis, self.spec)
        return sample

    def _generator(self, sample: Sample) -> np.random.Generator:
        if self.seed is None:
            return np.random.default_rng()
        name = zlib.crc32(sample["sequence"].encode())
        return np.random.default_rng([self.seed, self._epoch.value, name, sample["frame"]])


def flip(sample: Sample, axis: str, spec: GridSpec | None) -> Sample:
    """Return a sample mirrored in "x" or "y".

    Args:
        sample: as a Dataset gives it; what is neither grid, points, flow nor poses is passed on.
        axis: "x" or "y".
        spec: the sample's grid; None where it holds none.

    Raises:
        ArgumentError: the grid is not symmetric about the axis.
    """
    column = _AXES.index(axis)
    flipped = dict(sample)
    if spec is not None:
        _check_symmetric(spec, axis)
        for name in _FIRST_GRID_AXIS.keys() & sample.keys():
            flipped[name] = _flip_grid(sample[name], _FIRST_GRID_AXIS[name], column, spec)
    for name in {"points", "flow"} & sample.keys():
        flipped[name] = sample[name].copy()
        flipped[name][:, column] *= -1
    if "poses" in sample:
        mirror = np.eye(4)
        mirror[column, column] = -1
        flipped["poses"] = mirror @ sample["poses"] @ mirror
    return flipped


def _flip_grid(grid: NDArray[Any], first: int, column: int, spec: GridSpec) -> NDArray[Any]:
    """Mirror a grid whose x or radius is axis `first`."""
    if spec.coordinates == "cartesian":
        return np.ascontiguousarray(np.flip(grid, first + column))
    azimuth = first + 1
    mirrored = np.flip(grid, azimuth)  # y: azimuth -> -azimuth
    if column == 0:  # x: azimuth -> pi - azimuth
        mirrored = np.roll(mirrored, spec.size[1] // 2, azimuth)
    return np.ascontiguousarray(mirrored)


def _check_symmetric(spec: GridSpec, axis: str) -> None:
    column = _AXES.index(axis)
    bounds = 1 if spec.coordinates == "cylindrical" else column
    lower, upper = spec.lower[bounds], spec.upper[bounds]
    if not math.isclose(lower, -upper, abs_tol=_CLOSE):
        raise ArgumentError(f"flip of {axis}", expected="a grid symmetric about 0", found=f"{lower}..{upper} ({spec})")
    if spec.coordinates == "cylindrical" and axis == "x":
        turn = math.isclose(upper - lower, 2 * math.pi, abs_tol=_CLOSE)
        if not turn or spec.size[1] % 2:
            raise ArgumentError(
                "flip of x",
                expected="a whole turn in an even number of cells",
                found=f"{spec.size[1]} over {lower}..{upper} rad",
            )


class _SharedNumber:
    """A number that worker processes see changing: workers that outlive an epoch hold a copy of everything else."""

    def __init__(self, value: int = 0) -> None:
        self._cell = multiprocessing.Value("q", value, lock=False)

    @property
    def value(self) -> int:
        return int(self._cell.value)

    @value.setter
    def value(self, value: int) -> None:
        self._cell.value = value

    def __reduce__(self) -> tuple[Callable[..., _SharedNumber], tuple[Any, ...]]:
        """Share the memory with a process being spawned; in any other pickle go as a plain number."""
        if get_spawning_popen() is not None:
            return _share, (self._cell,)
        return _SharedNumber, (self.value,)


def _share(cell: Any) -> _SharedNumber:
    shared = _SharedNumber.__new__(_SharedNumber)
    shared._cell = cell
    return shared
