"""The options for making grids, which `regrid`, `convert`, `simulate` and `validate` share."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Annotated

import typer

import carlasc
from carlasc.cli.common import echo, parse_numbers
from carlasc.cli.flags import Flags
from carlasc.cli.library import Given, Library
from carlasc.core.choices import Coordinates, Preset
from carlasc.errors import ArgumentError, count

_FEW = 8  # fewer voxels along an axis are unusual
_MOVED_M = 1e-3  # bounds that differ by less are equal up to rounding
_VOXEL_BYTES = 8  # size of a label and a count
_LARGE_BYTES = 2e9  # a larger frame is unusual; fact: large-frame

MotionGiven = Annotated[Given, Library("carlasc.motion.MotionOptions")]
PosesGiven = Annotated[Given, Library("carlasc.motion.PoseOptions")]


@dataclass(frozen=True)
class GridFlags(Flags):
    """The geometry of a grid.

    Most people need these options: they are the first ones, without a heading.
    """

    res: Annotated[
        str | None,
        typer.Option(
            help="Voxel size in metres: one value, or one per axis, x,y,z (cylindrical: "
            "radius,azimuth,z with the azimuth in degrees). Use only one of --res, --size and "
            "--preset."
        ),
    ] = None
    size: Annotated[
        str | None, typer.Option(help="Number of voxels per axis: X,Y,Z. The bounds stay exact.")
    ] = None
    preset: Annotated[Preset | None, typer.Option(help="A grid of the published data set.")] = None
    coordinates: Annotated[
        Coordinates | None, typer.Option(help="Coordinates of the grid. Default: cartesian.")
    ] = None
    bounds: Annotated[
        str | None,
        typer.Option(
            help="Lower and upper bound of each axis, x0,x1,y0,y1,z0,z1, in metres (cylindrical: "
            "radius, azimuth in degrees, z). Default: those of the published data set."
        ),
    ] = None
    yes: Annotated[
        bool,
        typer.Option(
            "--yes", help="Make the grid even if its size or its bounds are probably a mistake."
        ),
    ] = False

    def spec_or_published(self) -> carlasc.GridSpec:
        """Return the grid that the options describe, or the published one of the coordinates if
        they name none.
        """
        if self.res is None and self.size is None and self.preset is None and self.bounds is None:
            return carlasc.GridSpec.published(self.coordinates or "cartesian")
        return self.spec()

    def spec(self) -> carlasc.GridSpec:
        """Return the grid that the options describe, and print on stderr what is unusual about it.

        Azimuths are in degrees in options, and in radians in the library.

        Raises:
            ArgumentError: not exactly one of --res, --size and --preset, values that are not valid
                for a grid, or values that are probably a mistake, without --yes.
        """
        spec, asked = self._spec()
        unusual = [*unusual_of(spec, asked)]
        remark = "; ".join(text for text, _ in unusual)
        if any(mistake for _, mistake in unusual) and not self.yes:
            expected = (
                f"{_FEW} voxels or more along x and y, the bounds asked for, "
                f"{_LARGE_BYTES / 1e9:g} GB per frame at most"
            )
            raise ArgumentError(
                "grid", expected=expected, found=remark, advice="give --yes to make it all the same"
            )
        if unusual:
            echo(f"note: the grid has {remark}", err=True)
        return spec

    def _spec(self) -> tuple[carlasc.GridSpec, carlasc.GridSpec]:
        """Return the grid that the options describe, and the one whose bounds they ask for."""
        three = (("--res", self.res), ("--size", self.size), ("--preset", self.preset))
        given = [option for option, value in three if value is not None]
        if len(given) != 1:
            raise ArgumentError(
                "grid",
                expected="one of --res, --size and --preset",
                found=" and ".join(given) or "none of them",
                advice="try --res 0.2",
            )
        if self.preset == "cylindrical" and self.coordinates == "cartesian":
            raise ArgumentError(
                "coordinates", expected="cylindrical with --preset cylindrical", found="cartesian"
            )
        if self.preset is not None and self.bounds is not None:
            raise ArgumentError(
                "bounds",
                expected="none, because --preset has bounds",
                found=repr(self.bounds),
                advice="use --size",
            )
        cylindrical = "cylindrical" in (self.preset, self.coordinates)
        spec = carlasc.GridSpec.published("cylindrical" if cylindrical else "cartesian")
        if self.bounds is not None:
            values = list(parse_numbers(self.bounds, float, (6,), "--bounds"))
            if cylindrical:
                values[2:4] = [math.radians(value) for value in values[2:4]]
            spec = spec.with_bounds(values[0::2], values[1::2])
        if self.size is not None:
            spec = spec.with_size(parse_numbers(self.size, int, (3,), "--size"))
            return spec, spec
        if self.res is not None:
            steps = list(parse_numbers(self.res, float, (1, 3), "--res"))
            if cylindrical and len(steps) == 3:
                steps[1] = math.radians(steps[1])
            return spec.with_resolution(steps), spec
        if self.preset == "fine":
            spec = spec.with_size(carlasc.GridSpec.published("fine").size)
        return spec, spec


def unusual_of(spec: carlasc.GridSpec, asked: carlasc.GridSpec) -> Iterator[tuple[str, bool]]:
    """Yield what is unusual about a grid, and whether it is probably a mistake.

    Args:
        spec: the grid.
        asked: the grid with the bounds, and the numbers of voxels, that were asked for.
    """
    axes = (
        ("x", "y", "z") if spec.coordinates == "cartesian" else ("the radius", "the azimuth", "z")
    )
    for number, axis in enumerate(axes):
        if spec.size[number] < _FEW and (axis != "z" or spec.size != asked.size):
            yield f"{count(spec.size[number], 'voxel')} along {axis}", axis != "z"
        (low, up), (old, end) = ((grid.lower[number], grid.upper[number]) for grid in (spec, asked))
        if abs(low - old) + abs(up - end) > _MOVED_M:
            bounds = f"{axis} from {low:.2f} to {up:.2f} m instead of {old:.2f} to {end:.2f} m"
            yield bounds, up - low > 2 * (end - old)
    if (size := spec.num_voxels * _VOXEL_BYTES) > _LARGE_BYTES:
        yield f"{spec.num_voxels:,} voxels, {size / 1e9:.1f} GB per frame", True


@dataclass(frozen=True)
class GroundTruthFlags(Flags):
    """The options for making grids, the same in `regrid` and in `convert`."""

    grid: GridFlags
    votes: Annotated[Given, Library("carlasc.Voting")]
    scans: Annotated[Given, Library("carlasc.FromScans")]
    motion: MotionGiven

    def from_scans(self, poses: Given) -> carlasc.FromScans:
        """Return how scans are merged."""
        made: carlasc.FromScans = self.scans.make(motion=self.motion.make(), poses=poses.make())
        return made
