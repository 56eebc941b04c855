"""The options for grids that `regrid` and `convert` share, and their translation into arguments of the library."""

from __future__ import annotations

import math
from enum import StrEnum
from typing import TYPE_CHECKING, Annotated, Any

import typer

from carlasc.cli.common import parse_numbers
from carlasc.errors import ArgumentError

if TYPE_CHECKING:
    from carlasc.core.grids import GridSpec
    from carlasc.groundtruth import FromScans


class Coordinates(StrEnum):
    """Axes of a grid."""

    cartesian = "cartesian"
    cylindrical = "cylindrical"


class Preset(StrEnum):
    """Grids of the published data set."""

    coarse = "coarse"
    fine = "fine"
    cylindrical = "cylindrical"


class Rule(StrEnum):
    """How votes are counted."""

    sensor = "sensor"
    sample = "sample"
    ray = "ray"


class Dynamic(StrEnum):
    """What happens to moving points."""

    align = "align"
    current = "current"
    drop = "drop"
    tube = "tube"


class Motion(StrEnum):
    """What tells which points move."""

    auto = "auto"
    boxes = "boxes"
    instances = "instances"
    flow = "flow"
    evidence = "evidence"
    none = "none"


class Complete(StrEnum):
    """What happens to the parts of an actor that no scan saw."""

    seen = "seen"
    mirror = "mirror"
    body = "body"


_GRID = "Grid: one of --res, --size and --preset"
SCANS = "Scans merged over time"

ResOption = Annotated[
    str | None,
    typer.Option(
        "--res",
        help="Size of a voxel: one value in metres, or one value per axis: x,y,z or radius,degrees,z.",
        rich_help_panel=_GRID,
    ),
]
SizeOption = Annotated[
    str | None,
    typer.Option("--size", help="Number of voxels per axis, X,Y,Z, within exactly the bounds.", rich_help_panel=_GRID),
]
PresetOption = Annotated[
    Preset | None, typer.Option("--preset", help="A grid of the published data set.", rich_help_panel=_GRID)
]
CoordinatesOption = Annotated[
    Coordinates | None,
    typer.Option("--coordinates", help="Coordinates of the grid; default: cartesian.", rich_help_panel=_GRID),
]
BoundsOption = Annotated[
    str | None,
    typer.Option(
        "--bounds",
        help="x0,x1,y0,y1,z0,z1 in metres (cylindrical: radius in metres, azimuth in degrees, z in metres); default: the published bounds.",
        rich_help_panel=_GRID,
    ),
]
RuleOption = Annotated[
    Rule | None,
    typer.Option(
        "--voting",
        help="How votes are counted. sensor: one vote per sensor, voxel and class, as in the published files (default for captures);"
        " sample: every sample counts, as in the paper; ray: a voxel is occupied where enough of the rays that enter it end in it (default for scans).",
        rich_help_panel=_GRID,
    ),
]
WindowOption = Annotated[
    str | None,
    typer.Option(
        "--window",
        help="First and last scan to merge, relative to each frame, in frames; default: -30:30.",
        rich_help_panel=SCANS,
    ),
]
WindowMOption = Annotated[
    float | None,
    typer.Option("--window-m", help="Merge only scans within this driven distance, in metres.", rich_help_panel=SCANS),
]
StrideOption = Annotated[
    int | None,
    typer.Option(
        "--stride", help="Merge every N-th scan of the window; default: 1.", metavar="N", rich_help_panel=SCANS
    ),
]
DynamicOption = Annotated[
    Dynamic | None,
    typer.Option(
        "--dynamic",
        help="What happens to moving points. align: complete each actor from all scans (default); current: use those of the frame"
        " itself; drop: use none; tube: leave them where they were seen, as in SemanticKITTI.",
        rich_help_panel=SCANS,
    ),
]
MotionOption = Annotated[
    Motion | None,
    typer.Option(
        "--motion",
        help="What tells which points move. boxes, instances, flow: the field of that name; evidence: free space that other scans saw"
        " there; none: nothing but moving classes; auto: the best field that exists, and evidence for what it misses (default).",
        rich_help_panel=SCANS,
    ),
]
CompleteOption = Annotated[
    Complete | None,
    typer.Option(
        "--complete",
        help="What happens to the parts of a moving vehicle that no scan saw. seen: they stay unknown; mirror: a side is taken from the"
        " other side (default); body: and what is still missing from the usual shape of vehicles.",
        rich_help_panel=SCANS,
    ),
]
NoOwnPathOption = Annotated[
    bool,
    typer.Option(
        "--no-own-path",
        help="What the recording vehicle itself drove through is not taken for free space.",
        rich_help_panel=SCANS,
    ),
]


def scans_of(*, window: str | None, **others: Any) -> FromScans | None:
    """Return how scans are merged, with the defaults of `FromScans` for what is None; None if everything is."""
    from carlasc.groundtruth import FromScans
    from carlasc.motion import MotionOptions, PoseOptions

    given: dict[str, Any] = {
        name: value.value if isinstance(value, StrEnum) else value for name, value in others.items()
    }
    given["window"] = None if window is None else _parse_window(window)
    given = {name: value for name, value in given.items() if value is not None}
    if "motion" in given:
        given["motion"] = MotionOptions(given["motion"])
    if "poses" in given or "force" in given:
        given["poses"] = PoseOptions(given.pop("poses", "auto"), given.pop("force", False))
    return FromScans(**given) if given else None


def _parse_window(text: str) -> tuple[int, int]:
    first, _, last = text.partition(":")
    try:
        return int(first), int(last)
    except ValueError:
        raise ArgumentError(
            "window", expected="A:B, in frames relative to the current one, such as -30:30", found=repr(text)
        ) from None


def parse_grid_or_published(
    res: str | None, size: str | None, preset: Preset | None, coordinates: Coordinates | None, bounds: str | None
) -> GridSpec:
    """Return the grid that the options describe, or the published one of the coordinates if they name none."""
    if res is None and size is None and preset is None:
        preset = Preset.cylindrical if coordinates is Coordinates.cylindrical else Preset.coarse
    return parse_grid(res, size, preset, coordinates, bounds)


def parse_grid(
    res: str | None, size: str | None, preset: Preset | None, coordinates: Coordinates | None, bounds: str | None
) -> GridSpec:
    """Return the grid that the options describe. Azimuths are degrees here and radians everywhere else.

    Raises:
        ArgumentError: not exactly one of --res, --size and --preset, or values that are not valid for a grid.
    """
    from carlasc.core.grids import GridSpec

    given = [option for option, value in (("--res", res), ("--size", size), ("--preset", preset)) if value is not None]
    if len(given) != 1:
        found = " and ".join(given) or "none of them"
        raise ArgumentError("grid", expected="one of --res, --size and --preset", found=found, advice="try --res 0.2")
    if preset is Preset.cylindrical and coordinates is Coordinates.cartesian:
        raise ArgumentError("coordinates", expected="cylindrical with --preset cylindrical", found="cartesian")
    if preset is not None and bounds is not None:
        raise ArgumentError("bounds", expected="none with --preset, which has its own bounds", found=repr(bounds))
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
