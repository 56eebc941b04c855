"""Augmentations of samples. They change all fields of a sample consistently."""

from __future__ import annotations

import math
import multiprocessing
import sys
import zlib
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import lru_cache
from multiprocessing.context import get_spawning_popen
from numbers import Real
from typing import Any, cast

import numpy as np

from carlasc.core.arrays import AnyArray, BoolArray, IntArray
from carlasc.core.geometry import Transform, rotate_vectors, rotation_z, transform_points
from carlasc.core.grids import GridSpec, is_finite
from carlasc.dataset.fields import RAGGED, STACKS, Sample, Values
from carlasc.dataset.labels import OF_GRID
from carlasc.errors import ArgumentError, check_types

_DIRECTIONS = ("x", "y")
_TOLERANCE = 1e-5  # the published azimuth bounds are pi as float32, with an error of 9e-8
# dimension of a field that is x or the radius
_FIRST_GRID_AXIS = dict.fromkeys(OF_GRID, 0) | dict.fromkeys((*STACKS, "posterior"), 1)
_OUTSIDE = {"occupied": 0.5}  # outside of the old grid nothing is known; 0 in other fields


@dataclass(frozen=True)
class Placement:
    """Where an augmentation places a sample, and which points it keeps.

    Attributes:
        new_T_old: (4, 4) float64, from the sensor frame of the frame to the frame of the sample: a
            rotation or reflection, a scale and a translation.
        drop: share of points that are left out.
        seed: seed of the choice of points.
    """

    new_T_old: Transform
    drop: float = 0.0
    seed: int = 0

    def kept(self, points: int, age: int = 0) -> BoolArray:
        """Return (N,) bool: which points of the scan before `age` frames are kept."""
        return np.random.default_rng([self.seed, age]).random(points) >= self.drop


class Augment:
    """Moves samples at random: mirrors, rotates about z, scales and shifts them, and drops points.

    All fields are changed together: grids, points, flow, instances, poses and cameras. As the
    `transform` of a Dataset, stacks are binned from the moved points. Fields of the ground truth,
    which exist as voxels only, take the value of the old voxel that contains the centre of the new
    one; what lies outside of the old grid is unknown (`known` is false, labels are 0). This is
    exact for flips, quarter turns of a square grid, and rotations of a cylindrical grid by whole
    cells.

    With a seed, the changes of a sample depend only on the seed, the epoch, and `sequence` and
    `frame` of the sample: they are equal for every number of workers. `set_epoch` also reaches
    persistent workers; without it, every epoch has the same changes. Without a seed, every access
    draws from the generator of torch (in a worker, from that of the worker), or from that of NumPy
    if torch is not imported.

        dataset.transform = augment = Augment(
            directions="y", rotate_rad=0.1, scale=0.05, translate_m=(0.5, 0.5, 0), seed=0
        )
        for epoch in range(epochs):
            augment.set_epoch(epoch)
            for batch in loader: ...
    """

    def __init__(
        self,
        spec: GridSpec | str | float | None = None,
        directions: str | Iterable[str] = (),
        *,
        probability: float = 0.5,
        rotate_rad: float | Iterable[float] = 0.0,
        scale: float = 0.0,
        translate_m: float | Iterable[float] = 0.0,
        drop: float = 0.0,
        seed: int | None = None,
    ) -> None:
        """Check the arguments.

        Args:
            spec: the grid of the samples. None takes that of the Dataset.
            directions: directions in which samples may be mirrored: "x", "y" or both.
            probability: probability of mirroring, for each direction.
            rotate_rad: largest angle about z, in both directions; or the angles to choose from.
            scale: largest change of lengths: 0.05 scales by 0.95 to 1.05.
            translate_m: largest shift along each axis, in both directions: one value for x and y,
                or three values.
            drop: largest share of points that are left out; each sample draws its own share.
            seed: seed for reproducible changes; None draws again at each access.

        Raises:
            ArgumentError: the grid is not symmetric in a direction, or an argument is not valid.
        """
        check_types(Augment.__init__, locals())
        for name, value, most in (
            ("probability", probability, 1.0),
            ("scale", scale, 0.9),
            ("drop", drop, 1.0),
        ):
            if not 0 <= value <= most:
                raise ArgumentError(name, expected=f"0..{most:g}", found=value)
        if seed is not None and seed < 0:
            raise ArgumentError("seed", expected="0 or more", found=seed)
        if not set(directions) <= set(_DIRECTIONS):
            raise ArgumentError("directions", expected="x, y or both", found=repr(directions))
        self.directions = tuple(directions)
        self.spec = spec = None if spec is None else GridSpec.of(spec)
        self.probability = probability
        self.rotate_rad = _numbers("rotate_rad", rotate_rad)
        self.scale = scale
        shift = _numbers("translate_m", translate_m)
        self.translate_m = (shift[0], shift[0], 0.0) if len(shift) == 1 else shift
        if len(self.translate_m) != 3:
            raise ArgumentError("translate_m", expected="one or three lengths", found=shift)
        self._chooses = not isinstance(rotate_rad, Real)
        self.drop = drop
        self.seed = seed
        self._epoch = _SharedNumber()
        if spec is not None:
            self._check(spec)

    def __repr__(self) -> str:
        names = "directions probability rotate_rad scale translate_m drop seed"
        values = (f"{name}={getattr(self, name)!r}" for name in names.split())
        return f"{type(self).__name__}({self.spec!r}, {', '.join(values)})"

    def set_epoch(self, epoch: int) -> None:
        """Set the next epoch.

        Call this before iterating over the DataLoader, as with a DistributedSampler.
        """
        self._epoch.cell.value = epoch

    def place(self, sequence: str, frame: int, spec: GridSpec | None) -> Placement:
        """Draw the changes of a sample.

        Args:
            sequence: name of the sequence.
            frame: number of the frame.
            spec: the grid of the sample; None if it has none.

        Raises:
            ArgumentError: the grid is another one than that of the augmentation, or not symmetric.
        """
        if self.spec is not None and spec not in (None, self.spec):
            raise ArgumentError(
                "spec", expected=f"the grid of the samples, {spec!r}", found=repr(self.spec)
            )
        if spec is not None:
            self._check(spec)
        rng = np.random.default_rng(
            _draw_seed()
            if self.seed is None
            else [self.seed, self._epoch.cell.value, zlib.crc32(sequence.encode()), frame]
        )
        mirrored = rng.random(len(_DIRECTIONS)) < self.probability
        old = np.eye(4)
        for column, direction in enumerate(_DIRECTIONS):
            old[column, column] = -1 if mirrored[column] and direction in self.directions else 1
        if self._chooses:
            angle = float(rng.choice(self.rotate_rad))
        else:
            angle = float(rng.uniform(-1, 1) * self.rotate_rad[0])
        new_T_old = rotation_z(angle) @ old
        new_T_old[:3] *= 1 + rng.uniform(-1, 1) * self.scale
        new_T_old[:3, 3] = rng.uniform(-1, 1, 3) * self.translate_m
        share = float(rng.uniform(0, self.drop))
        return Placement(new_T_old, share, int(rng.integers(2**63)))

    def __call__(self, sample: Sample) -> Sample:
        """Return the sample, changed. The input is not changed. Stacks are changed like the ground
        truth.

        Raises:
            ArgumentError: the sample has grids, and no grid is given, or they have another size; or
                points would be dropped from stacks.
        """
        given = cast(Values, sample)
        if self.drop and (stacks := STACKS & given.keys()):
            raise ArgumentError(
                "drop",
                expected="samples without stacks",
                found=", ".join(sorted(stacks)),
                advice="give the augmentation to the Dataset, as `transform`",
            )
        placement = self.place(given.get("sequence", ""), given.get("frame", 0), self.spec)
        return cast(Sample, moved(given, placement, self.spec))

    def _check(self, spec: GridSpec) -> None:
        for direction in self.directions:
            check_symmetric(spec, direction)


class Flip(Augment):
    """Mirrors samples at random along x and along y, independently: an `Augment` without other
    changes.

    In a Cartesian grid, a flip reverses an axis. In a cylindrical grid, a flip of y reverses the
    azimuth, and a flip of x reverses the azimuth and rolls it by half a turn; the radius is never
    flipped. Poses are conjugated with the reflection, so they still align the flipped scans.
    """

    def __init__(
        self,
        spec: GridSpec | str | float | None = None,
        directions: str | Iterable[str] = _DIRECTIONS,
        *,
        probability: float = 0.5,
        seed: int | None = None,
    ) -> None:
        """Check that the grid can be flipped. The arguments are those of `Augment`."""
        super().__init__(spec, directions, probability=probability, seed=seed)


def mirror(direction: str) -> Placement:
    """Return the placement of a sample that is mirrored in "x" or "y"."""
    new_T_old = np.eye(4)
    column = _DIRECTIONS.index(direction)
    new_T_old[column, column] = -1
    return Placement(new_T_old)


def flip(sample: Sample, direction: str, spec: GridSpec | None) -> Sample:
    """Return a sample mirrored in "x" or "y".

    Args:
        sample: a sample of a Dataset.
        direction: "x" or "y".
        spec: the grid of the sample; None if it has no grid.

    Raises:
        ArgumentError: the grid is not symmetric in this direction, or the sample has grids and none
            is given.
    """
    if spec is not None:
        check_symmetric(spec, direction)
    return cast(Sample, moved(cast(Values, sample), mirror(direction), spec))


def moved(
    sample: Values, placement: Placement, spec: GridSpec | None, *, stacks: bool = True
) -> Values:
    """Return a sample at another place.

    Args:
        sample: fields of a sample.
        placement: the place, and the points to keep.
        spec: the grid of the sample; None if it has no grid.
        stacks: whether stacks are changed, too.

    Raises:
        ArgumentError: the sample has grids, and none is given, or they have another size.
    """
    new_T_old = placement.new_T_old
    made = dict(sample)
    if placement.drop:
        made |= {
            name: value[placement.kept(len(value))]
            for name, value in sample.items()
            if name in RAGGED
        }
    moves = not np.array_equal(new_T_old, np.eye(4))
    for name in _FIRST_GRID_AXIS.keys() & sample.keys() - (frozenset() if stacks else STACKS):
        first = _FIRST_GRID_AXIS[name]
        size = sample[name].shape[first : first + 3]
        if spec is None or size != spec.size:
            expected = f"the grid of the samples, of size {size}, to move {name}"
            raise ArgumentError("spec", expected=expected, found=repr(spec))
        if moves:
            made[name] = _resampled(name, sample[name], spec, new_T_old)
    if not moves:
        return made
    with np.errstate(invalid="ignore"):  # of points that are not finite
        for name in {"points", "flow", "voxel_flow"} & made.keys():
            move = transform_points if name == "points" else rotate_vectors
            old = made[name]
            linear = new_T_old[:3, :3]
            if not new_T_old[:3, 3].any() and (linear == np.diag(linear.diagonal())).all():
                made[name] = old * linear.diagonal().astype(old.dtype)  # a flip
            else:
                made[name] = move(new_T_old, old).astype(old.dtype)
    if "poses" in sample:
        made["poses"] = new_T_old @ sample["poses"] @ np.linalg.inv(new_T_old)
    if "cameras" in sample:
        made["cameras"] = {
            name: camera.replaced(sensor_T_camera=_posed(new_T_old, camera.sensor_T_camera))
            for name, camera in sample["cameras"].items()
        }
    return made


def _posed(new_T_old: Transform, old_T_camera: Transform) -> Transform:
    """Return the pose of a camera that is moved. A camera has no scale: pixels stay."""
    posed = new_T_old @ old_T_camera
    posed[:3, :3] /= math.cbrt(abs(np.linalg.det(new_T_old[:3, :3])))
    return posed


def _resampled(name: str, grid: AnyArray, spec: GridSpec, new_T_old: Transform) -> AnyArray:
    """Return a field of grids, of the old voxels at the centres of the new ones."""
    first = _FIRST_GRID_AXIS[name]
    shape = grid.shape
    voxels = _old_voxels(spec, tuple(new_T_old.ravel().tolist()))
    flat = grid.reshape(*shape[:first], len(voxels), *shape[first + 3 :])
    made = flat.take(voxels, axis=first)
    made[(slice(None),) * first + (voxels < 0,)] = _OUTSIDE.get(name, 0)
    return made.reshape(shape)


@lru_cache(maxsize=8)  # flips and quarter turns return
def _old_voxels(spec: GridSpec, new_T_old: tuple[float, ...]) -> IntArray:
    """Return (V,) the old voxel that contains the centre of each new voxel, -1 outside."""
    old_T_new = np.linalg.inv(np.reshape(new_T_old, (4, 4)))
    centres = spec.from_axes(spec.centers().reshape(-1, 3))
    return spec.flat_index(transform_points(old_T_new, centres))


def check_symmetric(spec: GridSpec, direction: str) -> None:
    """Check that a grid can be mirrored in "x" or "y".

    Raises:
        ArgumentError: it cannot.
    """
    column = _DIRECTIONS.index(direction)
    bounds = 1 if spec.coordinates == "cylindrical" else column
    lower = spec.lower[bounds]
    upper = spec.upper[bounds]
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


def _numbers(name: str, value: float | Iterable[float]) -> tuple[float, ...]:
    """Return one number or several as a tuple of finite floats."""
    numbers = list(value) if isinstance(value, Iterable) else [value]
    if not numbers or not all(map(is_finite, numbers)):
        raise ArgumentError(name, expected="a number, or several", found=repr(value))
    return tuple(map(float, numbers))


def _draw_seed() -> int:
    """Draw a seed from the generator of torch, or from that of NumPy if torch is not imported."""
    torch = sys.modules.get("torch")
    return int(np.random.randint(2**63 - 1) if torch is None else torch.randint(2**63 - 1, ()))


class _SharedNumber:
    """A number in shared memory. Persistent workers have copies of all other attributes."""

    def __init__(self, value: int = 0, cell: Any = None) -> None:
        self.cell = multiprocessing.Value("q", value, lock=False) if cell is None else cell

    def __reduce__(self) -> tuple[Callable[..., _SharedNumber], tuple[Any, ...]]:
        """Share the memory when a process is spawned; in any other pickle, store the number."""
        if get_spawning_popen() is not None:
            return _SharedNumber, (0, self.cell)
        return _SharedNumber, (int(self.cell.value),)
