"""`carlasc validate`."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Annotated

import typer

from carlasc.cli.common import (
    FAILED,
    Cluster,
    Json,
    console,
    engine,
    line,
    place_argument,
    print_json,
    progress_bar,
    report_failures,
)
from carlasc.cli.grid_options import (
    BoundsOption,
    DynamicOption,
    MotionOption,
    PresetOption,
    ResOption,
    SizeOption,
    WindowOption,
    parse_grid,
    scans_of,
)
from carlasc.errors import ArgumentError
from carlasc.running.options import Run

if TYPE_CHECKING:
    from carlasc.inspection.findings import ValidationResult
    from carlasc.inspection.heldout import HoldoutResult
    from carlasc.inspection.heldout_scores import HeldOutScores, RayShares

_SHOWN = 3
_HELD_OUT = "Held-out rays"
_COLORS = {"error": "red", "warning": "yellow", "note": "cyan"}


def validate(
    source: Annotated[str, place_argument("A data set, a split, a sequence, a zip, a packed store, or a URL.")] = ".",
    every: Annotated[
        int | None,
        typer.Option(
            metavar="N", help="Read the contents of every N-th frame; of about forty frames per sequence if not given."
        ),
    ] = None,
    full: Annotated[bool, typer.Option("--full", help="Read the contents of all frames.")] = False,
    everything: Annotated[
        bool, typer.Option("--all", help="Print all findings, not only the first three of each kind.")
    ] = False,
    holdout: Annotated[
        bool,
        typer.Option(
            "--holdout",
            help="Also leave scans out, and follow their rays through the grids that the other scans give.",
            rich_help_panel=_HELD_OUT,
        ),
    ] = False,
    holdout_every: Annotated[
        int | None,
        typer.Option(metavar="N", min=2, help="Leave every N-th scan out; default: 10.", rich_help_panel=_HELD_OUT),
    ] = None,
    res: ResOption = None,
    size: SizeOption = None,
    preset: PresetOption = None,
    bounds: BoundsOption = None,
    window: WindowOption = None,
    dynamic: DynamicOption = None,
    motion: MotionOption = None,
    workers: Annotated[
        int | None,
        typer.Option(
            help="Processes that work side by side; if not given, one, and one per core for held-out rays.", min=1
        ),
    ] = None,
    cluster: Cluster = None,
    as_json: Json = False,
) -> None:
    """Check a data set: files, poses, times, and whether scans agree with poses and grids. The exit code is 1 if there is an error.

    It finds files of the wrong size, labels without votes, unknown classes, poses that are not rigid or jump, and gaps. From the
    scans it recognizes a mirrored y axis, poses of a camera, transposed rotations, and a grid that is shifted by a cell.
    """
    from carlasc.core.grids import GridSpec
    from carlasc.groundtruth import FromScans
    from carlasc.inspection.validation import validate as examine
    from carlasc.motion import PoseOptions

    if full and every is not None:
        raise ArgumentError("every", expected="only one of --every and --full", found="both")
    grid, others = (res, size, preset, bounds), (holdout_every, window, dynamic, motion)
    if not holdout and any(value is not None for value in (*grid, *others)):
        raise ArgumentError("holdout", expected="given with the options of held-out rays", found="not given")
    spec = parse_grid(res, size, preset, None, bounds) if any(grid) else GridSpec.published()
    scans = replace(scans_of(window=window, dynamic=dynamic, motion=motion) or FromScans(), poses=PoseOptions("file"))
    rays = None
    with engine(cluster, workers) as executor:
        with progress_bar("Validating", unit="steps") as progress:
            result = examine(
                source, every=1 if full else every, run=Run(workers=workers or 1, executor=executor, progress=progress)
            )
        if holdout:
            from carlasc.inspection.heldout import EVERY
            from carlasc.inspection.heldout import holdout as hold_out

            with progress_bar("Leaving scans out") as progress:
                rays = hold_out(
                    source,
                    spec,
                    observe=scans,
                    every=holdout_every or EVERY,
                    run=Run(workers=workers, executor=executor, progress=progress),
                )
    if as_json:
        print_json(result.to_dict() | ({} if rays is None else {"holdout": rays.to_dict()}))
    else:
        print_result(result, everything=everything)
        if rays is not None:
            print_held_out(rays)
    if rays is not None:
        measured = sum(scores.frames for scores in rays.sequences.values()) + len(rays.failures)
        report_failures([(failure.frame, failure.message) for failure in rays.failures], measured, "scans")
    if not result.ok:
        raise typer.Exit(FAILED)


def print_result(result: ValidationResult, *, everything: bool = False) -> None:
    """Print the findings by kind, errors first; `carlasc demo` uses it too."""
    from carlasc.inspection.findings import SEVERITIES

    out = console()
    for (severity, check), findings in result.grouped().items():
        out.print(line(f"{severity}: {check} ({len(findings)})", _COLORS[severity]))
        shown = findings if everything else findings[:_SHOWN]
        for finding in shown:
            out.print(line(f"  {finding}"), soft_wrap=True)
        if len(findings) > len(shown):
            out.print(line(f"  ... and {len(findings) - len(shown)} more (--all prints them)"))
    for report in result.sequences:
        figures = [
            f"{share:.1%} of points in voxels of their class ({grid})" for grid, share in report.voxel_share.items()
        ]
        if report.pose_share is not None:
            figures.append(f"{report.pose_share:.1%} of a scan's structure on that of an earlier scan under the poses")
        name = report.path or result.location
        text = f"{name}: {report.frames} frames, {report.sampled} read{''.join('; ' + figure for figure in figures)}"
        out.print(line(text), soft_wrap=True)
    counts = ", ".join(f"{result.count(severity)} {severity}s" for severity in SEVERITIES)
    out.print(line(f"{result.location}: {'sound' if result.ok else 'not sound'} ({counts})", "bold"), soft_wrap=True)


def print_held_out(result: HoldoutResult) -> None:
    """Print what became of the held-out rays: of all sequences together, or of each if their classes differ."""
    total = result.total
    parts = result.sequences if total is None else {result.location: total}
    for name, scores in parts.items():
        _print_scores(
            f"{name or result.location}: held-out rays, {result.spec}, {scores.frames} scans left out", scores
        )


def _print_scores(title: str, scores: HeldOutScores) -> None:
    from carlasc.cli.tables import print_table

    out = console()
    header = ["Rays", "Returns", "Free %", "Unknown %", "Occupied %", "Passed %", "Passed objects %", "Missed %"]
    header += ["Error m", "90 % m"]
    parts = {"all": scores.all, **scores.by_distance(), **scores.by_class()}
    print_table(out, header, [_row(name, shares) for name, shares in parts.items()], title=title, turn=False)
    if scores.swept_share is not None:
        text = f"{scores.swept_share:.2%} of the {scores.swept_voxels} voxels that the vehicle itself drove through are occupied"
        out.print(line(text))


def _row(name: str, shares: RayShares) -> list[str]:
    percent = [shares.free, shares.unknown, shares.occupied, shares.passed, shares.passed_object, shares.missed]
    metres = [shares.error_median_m, shares.error_90_m]
    cells = ["" if value is None else f"{100 * value:.2f}" for value in percent]
    return [name, str(shares.returns), *cells, *("" if value is None else f"{value:.2f}" for value in metres)]
