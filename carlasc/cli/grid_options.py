"""What `regrid` and `convert` are told of the grids they make: options that both take, and what they mean."""

from __future__ import annotations

import math
from enum import StrEnum
from typing import TYPE_CHECKING, Annotated, Any

import typer

from carlasc.cli.common import parse_numbers
from carlasc.errors import ArgumentError

if TYPE_CHECKING:
    from carlasc.core.grids import GridSpec
    from carlasc.groundtruth.from_scans.windows import Merging


class Coordinates(StrEnum):
    """Axes of a grid."""

    cartesian = "cartesian"
    cylindrical = "cylindrical"


class Preset(StrEnum):
    """Grids of the published data set."""

    coarse = "coarse"
    fine = "fine"
    cylindrical = "cylindrical"


class Vote(StrEnum):
    """How votes are counted."""

    sensor = "sensor"
    sample = "sample"
    point = "point"


class Dynamics(StrEnum):
    """What becomes of moving points."""

    align = "align"
    current = "current"
    drop = "drop"
    tube = "tube"


_GRID = "Grid: one of --res, --size and --preset"
SCANS = "Scans merged over time"

ResOption = Annotated[
    str | None,
    typer.Option(
        "--res", help="Size of a voxel: metres, or one value an axis: x,y,z or radius,degrees,z.", rich_help_panel=_GRID
    ),
]
SizeOption = Annotated[
    str | None,
    typer.Option("--size", help="Number of voxels an axis, X,Y,Z, over exactly the bounds.", rich_help_panel=_GRID),
]
PresetOption = Annotated[Preset | None, typer.Option("--preset", help="A published grid.", rich_help_panel=_GRID)]
CoordinatesOption = Annotated[
    Coordinates | None,
    typer.Option("--coordinates", help="Axes of the grid; cartesian if not given.", rich_help_panel=_GRID),
]
BoundsOption = Annotated[
    str | None,
    typer.Option(
        "--bounds",
        help="x0,x1,y0,y1,z0,z1 in metres (cylindrical: radius in metres, azimuth in degrees, z); the published ones if not given.",
        rich_help_panel=_GRID,
    ),
]
VoteOption = Annotated[
    Vote | None,
    typer.Option(
        "--vote",
        help="sensor: one vote a sensor, voxel and class (as published; the default for captures); sample: every sample (as in the"
        " paper); point: every point, free space once a scan (the default for scans).",
        rich_help_panel=_GRID,
    ),
]
WindowOption = Annotated[
    str | None,
    typer.Option(
        "--window", help="Scans A:B around each frame, in frames; -30:30 if not given.", rich_help_panel=SCANS
    ),
]
WindowMOption = Annotated[
    float | None,
    typer.Option("--window-m", help="Of those, only scans within so many metres driven.", rich_help_panel=SCANS),
]
StrideOption = Annotated[int | None, typer.Option("--stride", help="Every so manyth scan.", rich_help_panel=SCANS)]
DynamicOption = Annotated[
    Dynamics | None,
    typer.Option(
        "--dynamic",
        help="What moves: align (complete each actor; the default), current (that frame's points only), drop, tube (SemanticKITTI's rule).",
        rich_help_panel=SCANS,
    ),
]


def merging_of(
    window: str | None,
    window_m: float | None,
    stride: int | None,
    dynamic: Dynamics | None,
    min_range: float | None,
    max_range: float | None,
) -> Merging | None:
    """Return how scans are merged, None if nothing was said of it."""
    from carlasc.groundtruth.from_scans.windows import Merging

    given: dict[str, Any] = {"window_m": window_m, "stride": stride, "min_range_m": min_range, "max_range_m": max_range}
    given["dynamic"] = None if dynamic is None else dynamic.value
    given["window"] = None if window is None else _parse_window(window)
    given = {name: value for name, value in given.items() if value is not None}
    return Merging(**given) if given else None


def _parse_window(text: str) -> tuple[int, int]:
    first, _, last = text.partition(":")
    try:
        return int(first), int(last)
    except ValueError:
        raise ArgumentError(
            "--window", expected="A:B in frames around the current one such as -30:30", found=f"{text!r}"
        ) from None


def parse_grid(
    res: str | None, size: str | None, preset: Preset | None, coordinates: Coordinates | None, bounds: str | None
) -> GridSpec:
    """Return the grid that the options describe; degrees end here.

    Raises:
        ArgumentError: not exactly one of the three, or values that make no grid.
    """
    from carlasc.core.grids import GridSpec

    given = [option for option, value in (("--res", res), ("--size", size), ("--preset", preset)) if value is not None]
    if len(given) != 1:
        found = " and ".join(given) or "none of them"
        raise ArgumentError(f"expected one of --res, --size and --preset, found {found}: try --res 0.2")
    if preset is Preset.cylindrical and coordinates is Coordinates.cartesian:
        raise ArgumentError("--preset cylindrical", expected="no --coordinates, or cylindrical", found="cartesian")
    if preset is not None and bounds is not None:
        raise ArgumentError(
            "--bounds", expected="--res or --size with it", found="--preset, which has bounds of its own"
        )
    cylindrical = preset is Preset.cylindrical or coordinates is Coordinates.cylindrical
    spec = GridSpec.published("cylindrical" if cylindrical else "cartesian")
    if bounds is not None:
        values = list(parse_numbers(bounds, float, (6,), "--bounds"))
        if cylindrical:
            values[2:4] = [math.radians(value) for value in values[2:4]]
        spec = spec.with_bounds(values[0::2], values[1::2])
    if size is not None:
        return spec.with_size(parse_numbers(size, int, (3,), "--size"))
    if res is not None:
        steps = list(parse_numbers(res, float, (1, 3), "--res"))
        if cylindrical and len(steps) == 3:
            steps[1] = math.radians(steps[1])
        return spec.with_resolution(steps)
    if preset is Preset.fine:
        return spec.with_size(GridSpec.published("cartesian_fine").size)
    return spec
