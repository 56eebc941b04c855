"""The options for making grids, which `regrid`, `convert`, `simulate` and `validate` share."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Annotated, Any, ClassVar

import typer

import carlasc
from carlasc.cli.common import echo, parse_numbers
from carlasc.cli.flags import Flags
from carlasc.core.choices import Complete, Coordinates, Dynamic, Preset, Rays, VoteRule
from carlasc.errors import ArgumentError, count

_FEW = 8  # fewer voxels along an axis are unusual
_MOVED_M = 1e-3  # bounds that differ by less are equal up to rounding
# fact: large-frame
_VOXEL_BYTES, _LARGE_BYTES = 8, 2e9  # size of a label and a count; a larger frame is unusual
MOTION_HELP = (
    "How moving points are found. boxes, instances, flow: by the field of that name. evidence: a "
    "point moves if rays of other scans passed through its position. none: only classes that "
    "always move. auto: the best field that exists, and evidence for what it misses"
)


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
        found = "; ".join(text for text, _ in unusual)
        if any(mistake for _, mistake in unusual) and not self.yes:
            expected = f"{_FEW} voxels or more along x and y, the bounds asked for, {_LARGE_BYTES / 1e9:g} GB per frame at most"
            raise ArgumentError(
                "grid", expected=expected, found=found, advice="give --yes to make it all the same"
            )
        if unusual:
            echo(f"note: the grid has {found}", err=True)
        return spec

    def _spec(self) -> tuple[carlasc.GridSpec, carlasc.GridSpec]:
        """Return the grid that the options describe, and the one whose bounds they ask for."""
        three = (("--res", self.res), ("--size", self.size), ("--preset", self.preset))
        given = [option for option, value in three if value is not None]
        if len(given) != 1:
            found = " and ".join(given) or "none of them"
            raise ArgumentError(
                "grid",
                expected="one of --res, --size and --preset",
                found=found,
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
class VoteFlags(Flags):
    """How votes are counted, and what is written about them."""

    heading: ClassVar[str] = "Votes"

    rule: Annotated[
        VoteRule | None,
        typer.Option(
            "--voting",
            help="How votes are counted. sensor: one vote per sensor, voxel and class, as in the "
            "published files (default for captures). sample: one vote per sample, as in the "
            "paper. ray: a voxel is occupied if enough of the rays that enter it end in it "
            "(default for scans).",
        ),
    ] = None
    free_step_m: Annotated[
        float, typer.Option(help="Distance between free-space samples on a ray, in metres.")
    ] = 1.5
    keep: Annotated[
        bool, typer.Option("--keep-votes", help="Also write the votes of each class per voxel.")
    ] = False
    keep_evidence: Annotated[
        bool,
        typer.Option(
            "--keep-evidence",
            help="Also write how certain each voxel is: probabilities, flags and number of scans "
            "(only for grids from scans).",
        ),
    ] = False
    keep_actors: Annotated[
        bool,
        typer.Option(
            "--keep-actors",
            help="Also write the actor that each voxel belongs to, and its velocity.",
        ),
    ] = False
    min_confidence: Annotated[
        float,
        typer.Option(
            help="Set a voxel to unknown if it is neither free nor occupied with at least this "
            "probability, 0 to below 1 (only for grids from scans)."
        ),
    ] = 0.0
    keep_seen: Annotated[
        bool,
        typer.Option(
            "--keep-seen",
            help="Also write which cameras see each voxel (only for data with cameras).",
        ),
    ] = False

    def voting(self) -> carlasc.Voting:
        """Return how votes are counted."""
        return carlasc.Voting(
            self.rule,
            self.free_step_m,
            self.keep,
            self.keep_evidence,
            self.min_confidence,
            self.keep_actors,
            self.keep_seen,
        )


@dataclass(frozen=True)
class PoseFlags(Flags):
    """Where poses come from."""

    heading: ClassVar[str] = "Poses"

    poses: Annotated[
        carlasc.motion.PoseSource,
        typer.Option(
            help="Where poses come from. file: the poses of the data. kiss-icp: estimated from the "
            "scans. auto: the file if it exists, otherwise estimated."
        ),
    ] = "auto"
    refine: Annotated[
        carlasc.motion.RefineMode,
        typer.Option(
            help="Refine poses, so that neighbouring scans agree. auto: only where scans then "
            "agree clearly better. always: all poses. never: none."
        ),
    ] = "auto"
    force: Annotated[
        bool,
        typer.Option(
            "--force",
            help="Accept poses even if they jump between frames, if scans do not overlap under "
            "them, or if their calibration is missing.",
        ),
    ] = False

    def options(self) -> carlasc.motion.PoseOptions:
        """Return where poses come from."""
        return carlasc.motion.PoseOptions(self.poses, self.refine, self.force)


@dataclass(frozen=True)
class WindowFlags(Flags):
    """Which scans are merged, and what happens to moving points."""

    heading: ClassVar[str] = "Scans merged over time"

    window: Annotated[
        str | None,
        typer.Option(
            metavar="A:B",
            help="First and last scan to merge, in frames relative to the current frame. Default: "
            "-30:30.",
        ),
    ] = None
    dynamic: Annotated[
        Dynamic | None,
        typer.Option(
            help="What happens to moving points. align: each actor is completed from all scans "
            "(default). current: only points of the frame itself are used. drop: they are left "
            "out. tube: they stay where they were seen, which leaves ghost trails, as in "
            "SemanticKITTI."
        ),
    ] = None
    motion: Annotated[
        carlasc.motion.MotionSource | None, typer.Option(help=f"{MOTION_HELP} (default).")
    ] = None

    def from_scans(self, poses: carlasc.motion.PoseOptions) -> carlasc.FromScans:
        """Return how scans are merged, with the defaults of `FromScans` for what is not given."""
        given = {name: value for name, value in self._given().items() if value is not None}
        return carlasc.FromScans(**given, poses=poses)

    def _given(self) -> dict[str, Any]:
        motion = None if self.motion is None else carlasc.motion.MotionOptions(self.motion)
        window = None if self.window is None else parse_window(self.window)
        return {"window": window, "dynamic": self.dynamic, "motion": motion}


@dataclass(frozen=True)
class ScanFlags(WindowFlags):
    """How scans are merged."""

    window_m: Annotated[
        float | None,
        typer.Option(
            help="Merge only scans within this driven distance, in metres. Default: no limit."
        ),
    ] = None
    stride: Annotated[
        int | None,
        typer.Option(help="Merge every N-th scan of the window. Default: 1.", metavar="N"),
    ] = None
    complete: Annotated[
        Complete | None,
        typer.Option(
            help="What happens to the parts of a moving vehicle that no scan saw. seen: they stay "
            "unknown. mirror: one side is copied from the other. body: like mirror, and the rest "
            "is copied from similar vehicles (default)."
        ),
    ] = None
    no_own_path: Annotated[
        bool,
        typer.Option(
            "--no-own-path",
            help="Do not count the space that the recording vehicle drove through as free. By "
            "default it counts as free, which removes ghost trails there.",
        ),
    ] = False
    rays: Annotated[
        Rays | None,
        typer.Option(
            help="Which rays of other scans are followed. all: every ray (default). enough: near "
            "the sensor, where rays are dense, only some of them."
        ),
    ] = None
    min_range_m: Annotated[
        float | None,
        typer.Option(
            help="Leave out nearer points, in metres. Default: the range in carlasc.json."
        ),
    ] = None
    max_range_m: Annotated[
        float | None,
        typer.Option(
            help="Leave out farther points, in metres. Default: the range in carlasc.json."
        ),
    ] = None

    def _given(self) -> dict[str, Any]:
        others = {
            name: getattr(self, name)
            for name in ("window_m", "stride", "complete", "rays", "min_range_m", "max_range_m")
        }
        return super()._given() | others | {"own_path": False if self.no_own_path else None}


def parse_window(text: str, option: str = "window") -> tuple[int, int]:
    """Return the first and the last scan of a window from "A:B"; `option` is named in errors."""
    first, _, last = text.partition(":")
    try:
        return int(first), int(last)
    except ValueError:
        raise ArgumentError(
            option,
            expected="A:B, in frames relative to the current frame, such as -30:30",
            found=repr(text),
        ) from None


@dataclass(frozen=True)
class GroundTruthFlags(Flags):
    """The options for making grids, the same in `regrid` and in `convert`."""

    grid: GridFlags
    votes: VoteFlags
    scans: ScanFlags
