"""`carlasc regrid`: ground truth at any resolution."""

from __future__ import annotations

from typing import Annotated, Literal

import typer

import carlasc
from carlasc.cli.common import (
    Json,
    place_argument,
    place_option,
    print_frames,
)
from carlasc.cli.flags import RunFlags
from carlasc.cli.grid_flags import GroundTruthFlags, PosesGiven
from carlasc.cli.library import Given, Library
from carlasc.errors import ArgumentError

Observed = Literal["capture", "scans", "grid"]
"""What grids are made from."""


def regrid(
    *,
    making: GroundTruthFlags,
    poses: PosesGiven,
    run: RunFlags,
    source: Annotated[
        str,
        place_argument(
            "A sequence with a raw capture or with scans, or a data set of such sequences: a "
            "folder or a URL.",
            default="current folder",
        ),
    ] = ".",
    out: Annotated[
        str | None,
        place_option(
            "-o",
            "--out",
            text="Folder or URL to write to. Sequences keep their paths below SOURCE. Default: "
            "SOURCE.",
        ),
    ] = None,
    observe: Annotated[
        Observed | None,
        typer.Option(
            help="What grids are made from: a raw capture, scans of one sensor merged over time, "
            "or a finer grid. Default: the capture if it exists, otherwise the scans.",
            show_default=False,
        ),
    ] = None,
    from_grid: Annotated[
        str | None,
        typer.Option(help="With --observe grid: name of the finer grid. Default: the finest grid."),
    ] = None,
    written: Annotated[Given, Library("carlasc.regrid")],
    json: Json = False,
) -> None:
    """Make ground truth at any resolution: from a raw capture, from the scans of one sensor merged
    over time, or from a finer grid.

    Existing frames are skipped, so the same command continues an interrupted run. In the folder of
    a sequence, `carlasc regrid --res 0.2` is enough.
    """
    voting = making.votes.make()
    chosen = _observe(observe, making, poses, from_grid)
    spec = making.grid.spec()
    with run.spread("regrid") as spread:
        result = written.make(source, spec, out, observe=chosen, voting=voting, run=spread)
    print_frames(result, result.grids, f"{spec}: made", json=json)


def _observe(
    kind: Observed | None, making: GroundTruthFlags, poses: Given, grid: str | None
) -> carlasc.groundtruth.Observe | None:
    """Return the `observe` argument.

    Without --observe, given options for scans or for a finer grid decide.
    """
    for_scans = making.scans.is_given or making.motion.is_given or poses.is_given
    if kind is None and (for_scans or grid is not None):
        kind = "scans" if for_scans else "grid"
    if for_scans and kind != "scans":
        raise ArgumentError(
            "observe", expected="scans, because options for scans are given", found=kind
        )
    if grid is not None and kind != "grid":
        raise ArgumentError("observe", expected="grid, because --from-grid is given", found=kind)
    match kind:
        case "capture":
            return carlasc.FromCapture()
        case "scans":
            return making.from_scans(poses)
        case "grid":
            return carlasc.FromGrid(grid)
    return None
