"""Voxel grids: the geometry of cells (GridSpec), their content (Grid), and flags about it
(VoxelFlag).

Axes are x, y, z in a Cartesian grid and radius, azimuth = atan2(y, x), z in a cylindrical one;
points are Cartesian in both.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from enum import IntFlag
from numbers import Real
from typing import Any, TypeVar, cast

import numpy as np
from numpy.typing import NDArray

from carlasc.core.arrays import (
    AnyArray,
    AnyFloatArray,
    AnyIntArray,
    BoolArray,
    FloatArray,
    Int32Array,
    IntArray,
    LabelArray,
    Uint8Array,
)
from carlasc.core.choices import Coordinates as Coordinates  # noqa: PLC0414 (part of this module)
from carlasc.core.choices import Preset
from carlasc.core.notebook import describe
from carlasc.errors import ArgumentError, FormatError, check_choice, check_types

_Scalar = TypeVar("_Scalar", bound=np.generic)
Triple = tuple[float, float, float]

# a little above pi: an azimuth of exactly pi is inside the published bounds
_PI32 = float(np.float32(np.pi))
_SIDE = float(np.float32(25.6))
_PIXELS = 200  # width and height of a small picture
# brightness of the lowest layer, for heights and for classes; the highest layer has 1
_DARKEST = (
    0.3,
    0.8,
)
_PROPORTION = 128 * 0.234375  # azimuth cells times radial cell of the published cylindrical grid


@dataclass(frozen=True)
class GridSpec:
    """The geometry of a voxel grid. Cells are half-open: `lower <= p < upper`.

    Attributes:
        coordinates: "cartesian" (x, y, z) or "cylindrical" (radius, azimuth, z).
        size: number of cells per axis.
        lower: lower bound per axis; metres, radians for azimuth.
        upper: upper bound per axis.

    Raises:
        ArgumentError: the sizes or bounds are not valid.
    """

    coordinates: Coordinates
    size: tuple[int, int, int]
    lower: Triple
    upper: Triple

    def __post_init__(self) -> None:
        check_types(GridSpec, vars(self))
        check_choice("coordinates", self.coordinates, Coordinates)
        for name, kind in (("size", int), ("lower", float), ("upper", float)):
            given = tuple(getattr(self, name))
            values = tuple(map(kind, given)) if all(map(is_finite, given)) else ()
            if len(values) != 3:
                raise ArgumentError(
                    f"grid {name}", expected="three finite numbers", found=getattr(self, name)
                )
            object.__setattr__(self, name, values)
        if math.prod(self.size) >= 2**31:
            raise ArgumentError(
                "grid size",
                expected="fewer than 2^31 cells",
                found=" x ".join(map(str, self.size)),
                advice="use a coarser resolution",
            )
        cylindrical = self.coordinates == "cylindrical"
        turn = self.upper[1] - self.lower[1]
        bounds = f"{self.lower} and {self.upper}"
        for wrong, name, expected, found in (
            (min(self.size) < 1, "size", "at least one cell per axis", self.size),
            (
                np.any(np.greater_equal(self.lower, self.upper)),
                "bounds",
                "lower < upper on every axis",
                bounds,
            ),
            (cylindrical and self.lower[0] < 0, "bounds", "a radius of 0 or more", self.lower[0]),
            (
                cylindrical and turn > 2 * _PI32,
                "bounds",
                "an azimuth range of at most 2 pi",
                f"{turn} rad",
            ),
        ):
            if wrong:
                raise ArgumentError(f"grid {name}", expected=expected, found=found)

    @classmethod
    def published(cls, name: Preset | Coordinates = "coarse") -> GridSpec:
        """Return a grid of the published data set: "coarse", "fine" or "cylindrical"; see
        `docs/format.md#layout`.

        The names of coordinates give the grid in which predictions are evaluated: "cartesian" is
        the coarse grid.
        """
        presets = {
            "coarse": cls("cartesian", (128, 128, 8), (-_SIDE, -_SIDE, -2.0), (_SIDE, _SIDE, 1.0)),
            "fine": cls("cartesian", (256, 256, 16), (-_SIDE, -_SIDE, -2.0), (_SIDE, _SIDE, 1.0)),
            "cylindrical": cls(
                "cylindrical", (128, 128, 8), (0.0, -_PI32, -2.0), (30.0, _PI32, 1.0)
            ),
        }
        check_choice("published grid", name, (*presets, "cartesian"))
        return presets["coarse" if name == "cartesian" else name]

    @classmethod
    def of(cls, spec: GridSpec | str | float) -> GridSpec:
        """Return a grid, given by itself, by the name of a published grid, or by the size of its
        cells in metres, within the bounds of the published grid.

        Raises:
            ArgumentError: no grid has that name, or the size is not positive.
        """
        if isinstance(spec, GridSpec):
            return spec
        if isinstance(spec, str):
            check_choice("spec", spec, Preset)
            return cls.published(cast(Preset, spec))
        if not (is_finite(spec) and spec > 0):
            expected = "a GridSpec, the name of a published grid, or the size of cells in metres"
            raise ArgumentError("spec", expected=expected, found=repr(spec))
        return cls.published().with_resolution(spec)

    @classmethod
    def from_params(cls, params: Mapping[str, Any], where: str = "params.json") -> GridSpec:
        """Return the grid from the keys of a params.json, with unchanged numbers.

        `where` is the file named in errors.

        Raises:
            FormatError: a key is missing, or a value is not valid.
        """
        try:
            size = [float(v) for v in params["grid_size"]]
            if any(v != int(v) for v in size):
                raise FormatError(where, expected="integers in grid_size", found=size)
            lower = _three(params["min_bound"])
            upper = _three(params["max_bound"])
            return cls(params["coordinates"], _three(map(int, size)), lower, upper)
        except FormatError:
            raise  # a FormatError is a ValueError
        except KeyError as error:
            raise FormatError(
                where, expected=f"the key {error}", found=f"{', '.join(params) or 'none'}"
            ) from error
        except (ArgumentError, TypeError, ValueError, OverflowError) as error:
            raise FormatError(where, problem=str(error)) from error

    def to_params(self, num_channels: int = 25) -> dict[str, Any]:
        """Return the five published keys of params.json.

        Sizes are floats, as in the published files.
        """
        return {
            "grid_size": [float(n) for n in self.size],
            "min_bound": list(self.lower),
            "max_bound": list(self.upper),
            "num_channels": num_channels,
            "coordinates": self.coordinates,
        }

    def with_size(self, size: Sequence[int]) -> GridSpec:
        """Return a grid with the same bounds and `size` cells."""
        return replace(self, size=_three(size))

    def with_bounds(self, lower: Sequence[float], upper: Sequence[float]) -> GridSpec:
        """Return the grid with other bounds, rounded to float32 like the published bounds."""
        return replace(self, lower=_three(map(_float32, lower)), upper=_three(map(_float32, upper)))

    def with_resolution(self, resolution: float | Sequence[float]) -> GridSpec:
        """Return a grid of cells of the given size that covers these bounds (the rule of `--res`).

        Let w be the width of the bounds along an axis. The number of cells n is w / R, rounded to
        the nearest integer if it is within 1e-4 of it, otherwise rounded up. The bounds grow to n
        R: symmetrically about the centre for x and y, upwards from the lower bound for z and the
        radius. The bounds of the azimuth do not change. In a cylindrical grid, a single R applies
        to the radius and to z, and the azimuth keeps the published proportion.

        Args:
            resolution: metres, or one value per axis (cylindrical: metres, radians, metres).

        Raises:
            ArgumentError: a resolution is not a positive number.
        """
        per_axis = list(resolution) if isinstance(resolution, Iterable) else [resolution]
        positive = all(is_finite(r) and r > 0 for r in per_axis)
        if len(per_axis) not in (1, 3) or not positive:
            raise ArgumentError(
                "resolution",
                expected="one or three positive numbers",
                found=", ".join(map(str, per_axis)),
            )
        size = list(self.size)
        lower = list(self.lower)
        upper = list(self.upper)
        for axis, step in enumerate(per_axis * (3 // len(per_axis))):
            width = self.upper[axis] - self.lower[axis]
            cells = _cells(width, step)
            if self.coordinates == "cylindrical" and axis == 1:
                size[1] = (
                    cells
                    if len(per_axis) == 3
                    else max(1, round(_PROPORTION * width / (2 * _PI32) / step))
                )
                continue
            size[axis] = cells
            if axis == 2 or self.coordinates == "cylindrical":
                lower[axis] = _float32(self.lower[axis])
                upper[axis] = _float32(self.lower[axis] + cells * step)
            else:
                centre = (self.lower[axis] + self.upper[axis]) / 2
                lower[axis] = _float32(centre - cells * step / 2)
                upper[axis] = _float32(centre + cells * step / 2)
        return GridSpec(self.coordinates, _three(size), _three(lower), _three(upper))

    @property
    def num_voxels(self) -> int:
        """Number of cells."""
        return math.prod(self.size)

    @property
    def voxel_size(self) -> FloatArray:
        """(3,) size of a cell per axis: the float32 difference of the bounds divided by the size;
        see `docs/format.md#cells`.

        If the bounds are not float32 numbers, their exact difference is used.
        """
        lower = np.array(self.lower)
        upper = np.array(self.upper)
        rounded = (upper.astype(np.float32) - lower.astype(np.float32)).astype(np.float64)
        exact = (lower != lower.astype(np.float32)) | (upper != upper.astype(np.float32))
        return np.where(exact, upper - lower, rounded) / np.array(self.size, np.float64)

    def to_axes(self, points: AnyFloatArray) -> AnyFloatArray:
        """Convert Cartesian points to the axes of the grid: unchanged in a Cartesian grid,
        otherwise radius, azimuth, z.

        An azimuth outside the bounds is changed by a full turn if it is then inside. An azimuth of
        exactly +pi is therefore in the first cell if the upper bound is pi.

        Args:
            points: (N, 3) metres, in the frame of the grid.

        Returns:
            (N, 3), same dtype.
        """
        if self.coordinates == "cartesian":
            return points
        azimuth = np.arctan2(points[:, 1], points[:, 0])
        turned = azimuth + np.where(
            azimuth < self.lower[1], 2 * np.pi, np.where(azimuth >= self.upper[1], -2 * np.pi, 0.0)
        ).astype(azimuth.dtype)
        inside = (turned >= self.lower[1]) & (turned < self.upper[1])
        return np.stack(
            [
                np.sqrt(points[:, 0] ** 2 + points[:, 1] ** 2),
                np.where(inside, turned, azimuth),
                points[:, 2],
            ],
            axis=1,
        )

    def from_axes(self, axes: AnyFloatArray) -> AnyFloatArray:
        """Convert (..., 3) coordinates on the axes of the grid to Cartesian points."""
        if self.coordinates == "cartesian":
            return axes
        radius, azimuth, z = np.moveaxis(axes, -1, 0)
        return np.stack([radius * np.cos(azimuth), radius * np.sin(azimuth), z], axis=-1)

    def index(self, axes: AnyFloatArray) -> tuple[Int32Array, BoolArray]:
        """Return the cells of points on the axes of the grid: half-open, floor, clip; see
        `docs/format.md#cells`.

        Args:
            axes: (N, 3) result of `to_axes`.

        Returns:
            (N, 3) int32 cells, clamped to the grid, and (N,) bool: whether the point is inside. NaN
            is outside.
        """
        lower = np.array(self.lower)
        upper = np.array(self.upper)
        inside: BoolArray = np.all((axes >= lower) & (axes < upper), axis=1)
        cells = np.floor((np.where(inside[:, None], axes, lower) - lower) / self.voxel_size)
        return np.clip(cells, 0, np.array(self.size) - 1).astype(np.int32), inside

    def flat_index(self, points: AnyFloatArray) -> IntArray:
        """Return (N,) C-order voxel indices of (N, 3) Cartesian points, -1 outside.

        The steps are `to_axes`, `index`, ravel.
        """
        cells, inside = self.index(self.to_axes(points))
        return np.where(inside, np.ravel_multi_index(tuple(cells.T), self.size), -1)

    def seen_from_above(
        self,
        labels: AnyIntArray,
        palette: Uint8Array | None = None,
        *,
        left_handed: bool = True,
    ) -> Uint8Array:
        """Return a small picture, (H, W, 3) RGB, of the highest occupied voxel of each column: x
        points up, y to the right.

        Args:
            labels: (X, Y, Z) class ids, 0 is free.
            palette: (K, 3) RGB by class id; None draws heights in grey.
            left_handed: False for data with y to the left; y then points to the left of the
                picture.
        """
        occupied = labels > 0
        layers = self.size[2]
        top = layers - 1 - np.argmax(occupied[:, :, ::-1], axis=2)
        highest = np.take_along_axis(labels, top[:, :, None], axis=2)[:, :, 0]
        colors = (
            np.full((*highest.shape, 3), 255.0)
            if palette is None
            else palette[highest].astype(np.float64)
        )
        darkest = _DARKEST[palette is not None]
        colors *= darkest + (1 - darkest) * top[:, :, None] / max(layers - 1, 1)
        colors[~occupied.any(axis=2)] = 255
        radius = self.upper[0]
        steps = (np.arange(_PIXELS) + 0.5) / _PIXELS
        ends = (
            [(-radius, radius)] * 2
            if self.coordinates == "cylindrical"
            else [*zip(self.lower, self.upper, strict=True)][:2]
        )
        x, y = (low + (high - low) * steps for low, high in ends)
        above = np.stack(
            np.broadcast_arrays(x[::-1, None], y if left_handed else y[::-1], self.lower[2]),
            axis=-1,
        )
        cells, inside = self.index(self.to_axes(above.reshape(-1, 3)))
        picture = np.where(inside[:, None], colors[cells[:, 0], cells[:, 1]], 255)
        return picture.astype(np.uint8).reshape(_PIXELS, _PIXELS, 3)

    def edges(self, axis: int) -> FloatArray:
        """Return the (n + 1,) cell edges along an axis."""
        return self.lower[axis] + np.arange(self.size[axis] + 1) * self.voxel_size[axis]

    def centers(self) -> FloatArray:
        """Return the (X, Y, Z, 3) centres of the cells, on the axes of the grid."""
        lines = [
            self.lower[a] + (np.arange(self.size[a]) + 0.5) * self.voxel_size[a] for a in range(3)
        ]
        return np.stack(np.meshgrid(*lines, indexing="ij"), axis=-1)

    def centers_of(self, voxels: AnyIntArray) -> FloatArray:
        """Return the (N, 3) centres of voxels, metres, from their (N,) flat indices."""
        index = np.stack(np.unravel_index(voxels, self.size), axis=-1)
        axes = np.asarray(self.lower) + (index + 0.5) * self.voxel_size
        return self.from_axes(axes).astype(np.float64)

    def __str__(self) -> str:
        return f"{self.coordinates} {' x '.join(map(str, self.size))}"


@dataclass(frozen=True)
class Grid:
    """The labels and the counts of the cells of a grid.

    Attributes:
        spec: geometry of the cells.
        labels: (X, Y, Z) unsigned integer class ids. 0 is free space, and also unknown space.
        counts: (X, Y, Z) number of votes. 0 means unknown (never evaluated). None if the grid has
            no counts.

    Raises:
        FormatError: the shape of an array is not the size of the spec.
    """

    spec: GridSpec
    labels: LabelArray
    counts: AnyArray | None = None

    def __post_init__(self) -> None:
        check_types(Grid, vars(self))
        for name, array in (("labels", self.labels), ("counts", self.counts)):
            if array is not None and array.shape != self.spec.size:
                raise FormatError(
                    f"grid {name}", expected=f"shape {self.spec.size}", found=array.shape
                )

    @property
    def known(self) -> BoolArray:
        """(X, Y, Z) bool: voxels with at least one vote; all voxels if the grid has no counts."""
        return np.ones(self.spec.size, np.bool_) if self.counts is None else self.counts > 0

    def __repr__(self) -> str:
        occupied = np.count_nonzero(self.labels)
        free = np.count_nonzero(self.known & (self.labels == 0))
        return f"<Grid {self.spec}: {occupied:,} occupied and {free:,} free voxels>"

    def _repr_html_(self) -> str:
        """Return the HTML for notebooks: the geometry, and the heights of the occupied voxels from
        above.
        """
        spec = self.spec
        rows = {
            "bounds": f"{spec.lower} to {spec.upper}",
            "classes": np.unique(self.labels[self.labels > 0]).tolist(),
        }
        return describe(repr(self), rows, spec.seen_from_above(self.labels))


def is_finite(value: Any) -> bool:
    """Whether a value is a number, neither NaN nor infinite."""
    return isinstance(value, Real) and math.isfinite(value)


def _three(values: Iterable[Any]) -> Any:
    """Return the values of the axes as the fields of a `GridSpec`, which checks their number."""
    return tuple(values)


def _float32(value: float) -> float:
    return float(np.float32(value))


def _cells(width: float, step: float) -> int:
    """Return the number of cells of size `step` that cover `width`.

    The tolerance accounts for the float32 bounds of the format.
    """
    ratio = width / step
    return max(1, round(ratio) if abs(ratio - round(ratio)) <= 1e-4 else math.ceil(ratio))


def most_frequent(cells: AnyIntArray, labels: AnyIntArray) -> tuple[IntArray, IntArray]:
    """Return the most frequent label in each cell; for a tie, the lowest of them.

    Args:
        cells: (N,) cell numbers of 0 or more. The largest one times the number of labels must be
            below 2**63.
        labels: (N,) labels of 0 or more.

    Returns:
        (C,) unique cells, increasing, and (C,) their labels.
    """
    channels = int(labels.max(initial=0)) + 1
    pairs, counts = np.unique(cells.astype(np.int64) * channels + labels, return_counts=True)
    owners = pairs // channels
    order = np.lexsort((pairs, -counts, owners))
    best = order[np.flatnonzero(np.diff(owners[order], prepend=-1))]
    return owners[best], pairs[best] % channels


class VoxelFlag(IntFlag):
    """The bits of the field `<grid>/flags`: uint8 per voxel.

    `(flags & VoxelFlag.INFERRED) != 0` is true for inferred voxels.

    Attributes:
        INFERRED: no scan saw the voxel; it was completed from other parts of the same object.
        CONTESTED: traffic passes through the voxel at other times of the window.
        SEEN_NOW: the scan of the frame itself saw the voxel.
        IN_ACTOR: the voxel is in the body of an actor.
    """

    INFERRED = 1
    CONTESTED = 2
    SEEN_NOW = 4
    IN_ACTOR = 8


def is_confident(occupied: AnyFloatArray, min_confidence: float) -> BoolArray:
    """Return which voxels are free or occupied with a minimum probability.

    Args:
        occupied: probability that each voxel is occupied, of any shape. It is compared as float16,
            as in the file, so that a grid and its file give the same result.
        min_confidence: minimum of max(p, 1 - p); 0 to 0.5 accepts every voxel.

    Returns:
        bool array of the same shape; False where the probability is NaN.
    """
    p = np.asarray(occupied, np.float16)
    confident: BoolArray = np.maximum(p, 1 - p) >= np.float16(min_confidence)
    return confident


def mirror_grid(grid: NDArray[_Scalar]) -> NDArray[_Scalar]:
    """Mirror an (X, Y, Z) grid along its second axis: y (Cartesian) or azimuth (cylindrical)."""
    mirrored: AnyArray = grid[:, ::-1]
    return mirrored


def mirror_spec(spec: GridSpec) -> GridSpec:
    """Return the geometry of a mirrored grid: the bounds of y, or of the azimuth, are swapped and
    negated.
    """
    (x0, y0, z0), (x1, y1, z1) = spec.lower, spec.upper
    return GridSpec(spec.coordinates, spec.size, (x0, -y1, z0), (x1, -y0, z1))


def mirror_voxels(grid: Grid) -> Grid:
    """Mirror a grid with its geometry."""
    counts = None if grid.counts is None else mirror_grid(grid.counts)
    return Grid(mirror_spec(grid.spec), mirror_grid(grid.labels), counts)
