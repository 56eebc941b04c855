"""`carlasc validate`."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, ClassVar

import typer

import carlasc
from carlasc.cli.common import (
    FAILED,
    MANY,
    Json,
    SourceArgument,
    few,
    print_json,
    report_failures,
    show,
)
from carlasc.cli.flags import Flags, OneWorkerFlags
from carlasc.cli.grid_flags import GridFlags, MotionGiven
from carlasc.cli.library import Given, Library
from carlasc.errors import ArgumentError, count

if TYPE_CHECKING:
    from carlasc.inspection.findings import ValidationResult
    from carlasc.inspection.heldout import HoldoutResult
    from carlasc.inspection.heldout_scores import HeldOutScores, RayShares

_SHOWN = 3
_SAMPLE = 20  # frames of each grid that are made again with --full
_COLORS = {"error": "red", "warning": "yellow", "note": "cyan"}


@dataclass(frozen=True)
class HoldoutFlags(Flags):
    """Which scans are left out."""

    heading: ClassVar[str] = "Held-out rays"

    holdout: Annotated[
        bool,
        typer.Option(
            "--holdout",
            help="Also leave scans out, make grids from the other scans, and compare the rays of "
            "the left-out scans with these grids (by default in one process per core).",
        ),
    ] = False
    holdout_every: Annotated[
        int | None, typer.Option(metavar="N", min=2, help="Leave out every N-th scan. Default: 10.")
    ] = None


@dataclass(frozen=True)
class HoldoutGridFlags(GridFlags):
    """The grid whose voxels are tested: the one that exists if none is given."""

    heading: ClassVar[str] = HoldoutFlags.heading


def validate(
    *,
    source: SourceArgument = ".",
    options: Annotated[Given, Library("carlasc.validate")],
    full: Annotated[
        bool,
        typer.Option(
            "--full",
            help="Read the contents of all frames, and make 20 frames of each grid again, or "
            "--sample of them.",
        ),
    ] = False,
    everything: Annotated[
        bool,
        typer.Option("--all", help="Print all findings and sequences, not only the first."),
    ] = False,
    as_json: Json = False,
    holdout: HoldoutFlags,
    grid: HoldoutGridFlags,
    scans: Annotated[Given, Library("carlasc.FromScans", "window dynamic")],
    motion: MotionGiven,
    work: OneWorkerFlags,
) -> None:
    """Check a data set: files, poses, times, and whether scans agree with poses and grids.

    The exit code is 0 if the data are sound, and 1 otherwise.

    It finds files of the wrong size, labels without votes, unknown classes, poses that are not
    rigid or jump, and gaps. By comparing scans with poses and grids, it recognizes a mirrored y
    axis, poses of a camera, transposed rotations, and a grid shifted by one voxel.
    """
    if full and "every" in options.values:
        raise ArgumentError(
            "every", expected="only one of --every and --full", found="both", advice="leave one out"
        )
    if not holdout.holdout and (
        holdout.is_given or grid.is_given or scans.is_given or motion.is_given
    ):
        raise ArgumentError(
            "holdout",
            expected="--holdout, because its options are given",
            found="none",
            advice="give `holdout`",
        )
    spec = grid.spec_or_published() if grid.is_given else None
    observe = None
    if scans.is_given or motion.is_given:
        observe = scans.make(motion=motion.make(), poses=carlasc.motion.PoseOptions("file"))
    rays = None
    with work.spread("Validating", "steps", usual=1) as run:
        more = {"every": 1, "sample": options.values.get("sample", _SAMPLE)} if full else {}
        result = options.make(source, **more, run=run)
    if holdout.holdout:
        left_out = holdout.holdout_every or carlasc.inspection.EVERY
        with work.spread("Leaving scans out") as run:
            rays = carlasc.inspection.holdout(
                source, spec, observe=observe, every=left_out, run=run
            )
    if as_json:
        print_json(result.to_dict() | ({} if rays is None else {"holdout": rays.to_dict()}))
    else:
        print_result(result, everything=everything)
        if rays is not None:
            print_held_out(rays)
    if rays is not None:
        measured = sum(scores.frames for scores in rays.sequences.values()) + len(rays.failures)
        report_failures(
            [(failure.frame, failure.message) for failure in rays.failures], measured, "scans"
        )
    if not result.ok or (rays is not None and rays.state != "right"):
        raise typer.Exit(FAILED)


def print_result(result: ValidationResult, *, everything: bool = False) -> None:
    """Print the findings by kind, errors first; `carlasc demo` uses it too."""
    from carlasc.cli.tables import print_table
    from carlasc.inspection.findings import SEVERITIES, STATES

    for (severity, check), findings in result.grouped().items():
        about = f", in {result.sequences_with(findings):,.0f} sequences"
        text = f"{severity}: {check} ({len(findings)}{about if result.places else ''})"
        show(text, _COLORS[severity])
        shown = findings if everything else findings[:_SHOWN]
        for finding in shown:
            show(f"  {finding}")
        if len(findings) > len(shown):
            show(f"  ... and {len(findings) - len(shown)} more (--all prints them)")
    found = Counter(finding.sequence for finding in result.findings)
    if result.places or (len(result.sequences) > MANY and not everything):
        if result.places:
            show(f"a sample of {sum(result.places.values()):,} sequences")
        splits = result.by_split()
        rows = [[split, *sums.values()] for split, sums in splits.items()]
        print_table(["sequences with", *next(iter(splits.values()))], rows, turn=False)
    for report in few(result.sequences, lambda report: found[report.path], everything=everything):
        figures = [
            f"{share:.1%} of points in voxels of their class ({grid})"
            for grid, share in report.voxel_share.items()
        ]
        if report.pose_share is not None:
            figures.append(
                f"{report.pose_share:.1%} of a scan's structure overlaps that of an earlier scan"
            )
        if report.disagreement_m is not None and report.refined_m is not None:
            figures.append(
                f"scans agree within {100 * report.disagreement_m:.1f} cm "
                f"({100 * report.refined_m:.1f} cm with refined poses)"
            )
        name = report.path or result.location
        show(f"{name}: {count(report.frames, 'frame')}, {report.sampled} read")
        for figure in figures:
            show(f"  {figure}")
        if report.mounting:
            mounting = ", ".join(f"{axis} {value}" for axis, value in report.mounting.items())
            show(f"  sensor in the frame of the poses: {mounting}")
        for camera, agreement in report.images.items():
            show(f"  images of {camera} on the scans: {agreement}")
        for state, words in STATES.items():
            if own := [check for check, of_check in report.checks.items() if of_check == state]:
                show(f"  {words}: {', '.join(own)}")
    counts = ", ".join(count(result.count(severity), severity) for severity in SEVERITIES)
    show(f"{result.location}: {result.verdict} ({counts})", "bold")


def print_held_out(result: HoldoutResult) -> None:
    """Print the scores of the held-out rays: of all sequences together, or of each if their classes
    differ.
    """
    from carlasc.inspection.findings import STATES

    total = result.total
    parts = result.sequences if total is None else {result.location: total}
    for name, scores in parts.items():
        _print_scores(
            f"{name or result.location}: held-out rays, {result.spec}, "
            f"{count(scores.frames, 'scan')} left out",
            scores,
        )
    for name, scores in result.given_poses.items():
        shares = scores.all
        figures = {"free": shares.free, "unknown": shares.unknown, "occupied": shares.occupied}
        text = ", ".join(f"{100 * (share or 0):.2f}% {where}" for where, share in figures.items())
        show(
            f"{name or result.location}: under the given poses: returns in {text} voxels; "
            f"{100 * (shares.passed_object or 0):.2f}% of the rays pass through objects"
        )
    for name, fault in result.faults.items():
        if fault:
            show(f"{name or result.location}: {fault}", "yellow")
    show(f"{result.location}: held-out rays: {STATES[result.state]}", "bold")


def _print_scores(title: str, scores: HeldOutScores) -> None:
    from carlasc.cli.tables import print_table

    header = [
        "Rays",
        "Returns",
        "Free %",
        "Unknown %",
        "Occupied %",
        "Passed %",
        "Passed objects %",
        "Missed %",
        "Error m",
        "90% m",
    ]
    parts = {"all": scores.all, **scores.by_distance(), **scores.by_class()}
    print_table(header, [_row(name, one) for name, one in parts.items()], title=title, turn=False)
    if scores.swept_share is not None:
        show(
            f"{scores.swept_share:.2%} of the {scores.swept_voxels} voxels that the vehicle itself "
            "drove through are occupied"
        )


def _row(name: str, shares: RayShares) -> list[object]:
    where = shares.free, shares.unknown, shares.occupied
    percent = *where, shares.passed, shares.passed_object, shares.missed
    cells = [None if value is None else 100 * value for value in percent]
    return [name, shares.returns, *cells, shares.error_median_m, shares.error_90_m]
