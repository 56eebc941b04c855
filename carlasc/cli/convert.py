"""`carlasc convert`: another data set as sequences of the layout."""

from __future__ import annotations

from typing import Annotated, Final, Literal

import typer

import carlasc
from carlasc.cli.common import (
    BatchError,
    Json,
    as_typed,
    echo,
    place_argument,
    print_frames,
    print_json,
    print_warnings,
    starting_with,
)
from carlasc.cli.flags import DeclaredOptions, RunFlags
from carlasc.cli.grid_flags import GroundTruthFlags, PosesGiven
from carlasc.cli.library import Given, Library
from carlasc.errors import ArgumentError, count

DECLARED_BY: Final = "converter"
"""What declares options of this command, if its arguments name one."""


def _print_list(wanted: bool) -> None:
    if wanted:
        for name in carlasc.converting.converter_names():
            echo(f"{name}: {carlasc.converting.load_converter(name).title}")
        raise typer.Exit


def _print_preview(
    previews: tuple[carlasc.converting.RecordingPreview, ...], out: str, grids: str
) -> None:
    """Print what a conversion would read and write."""
    for one in previews:
        rate = "no times" if one.rate_hz is None else f"{one.rate_hz:g} Hz"
        echo(f"{one.location}: {count(one.frames, 'scan')}, {rate}, of {', '.join(one.sensors)}")
        bounds = " ".join(
            f"{axis} {low:g}..{high:g}"
            for axis, low, high in zip("xyz", one.lower, one.upper, strict=True)
        )
        echo(f"  first scan: {one.points} points, {bounds} m; fields {', '.join(one.fields)}")
        ground = (
            "no ground found"
            if one.up is None
            else f"height of the sensor above the ground: {one.height_m:g} m"
        )
        echo(f"  {ground}")
        known = one.poses == "file"
        echo(f"  poses: {'those of the recording' if known else 'estimated from the scans'}")
        for note in one.notes:
            echo(f"  {as_typed(note)}")
        print_warnings(one.findings)
        echo(
            f"  output: {out}/{one.split}/{one.name}, with "
            f"{'no grids' if grids == 'none' else f'grids from {grids}'}"
        )
    echo("nothing was written")


def convert(
    *,
    options: DeclaredOptions,
    layout: Annotated[Given, Library("carlasc.LayoutOptions")],
    poses: PosesGiven,
    making: GroundTruthFlags,
    run: RunFlags,
    name: Annotated[
        str,
        typer.Argument(
            metavar="NAME",
            help="Name of the data set: kitti, argoverse2, ... (see --list). NAME --help also "
            "shows the options of this data set.",
            autocompletion=lambda incomplete: starting_with(
                incomplete, carlasc.converting.converter_names()
            ),
        ),
    ],
    source: Annotated[
        str,
        place_argument(
            "Folder of the data set, or of one of its sequences. With --sequences-from: folder or "
            "URL of clips.",
            "SOURCE",
        ),
    ],
    out: Annotated[str, place_argument("Folder to write to, or its URL.", "OUT")],
    sequences: Annotated[
        str | None,
        typer.Option(
            help="Names of sequences, or their last parts, separated by commas, such as 00,08. "
            "Default: all."
        ),
    ] = None,
    written: Annotated[Given, Library("carlasc.convert")],
    grids: Annotated[
        Literal["scans", "voxels", "none"],
        typer.Option(
            help="Grids to write. scans: made from scans merged over time (by default coarse "
            "ones). voxels: the grids of the data set. none: no grids."
        ),
    ] = "scans",
    follow: Annotated[
        bool,
        typer.Option(
            "--follow",
            help="SOURCE is a folder of scans that grows: take scans as they appear, and make "
            "provisional grids, until Ctrl-C or --idle. Then all is made as without this option.",
        ),
    ] = False,
    idle: Annotated[
        float | None,
        typer.Option(
            help="With --follow: seconds without a new scan after which the drive has ended. "
            "Default: it ends with Ctrl-C.",
            min=1.0,
        ),
    ] = None,
    dry_run: Annotated[
        bool,
        typer.Option("--dry-run", help="Print what would be read and written, and write nothing."),
    ] = False,
    json: Json = False,
    _list: Annotated[
        bool,
        typer.Option(
            "--list",
            help="List the converters that are installed.",
            callback=_print_list,
            is_eager=True,
        ),
    ] = False,
) -> None:
    """Write another data set as sequences of the CarlaSC layout: the same files, axes and classes.

    Run it again to continue where it stopped: frames that exist are skipped.
    """
    chosen = None if sequences is None else sequences.split(",")
    common = {"layout": layout.make(), "poses": poses.make(), "options": options.values}
    if dry_run:
        previews = carlasc.converting.preview(
            name, source, sequences=chosen, **written.values, **common
        )
        if json:
            print_json(previews)
        else:
            _print_preview(previews, out, grids)
        found = [finding for one in previews for finding in one.findings]
        if errors := [str(finding) for finding in found if finding.severity == "error"]:
            raise BatchError("nothing would be converted", errors)
        return
    if making.is_given and grids != "scans":
        raise ArgumentError(
            "--grids", expected="scans, because options of the grid are given", found=grids
        )
    bounded = making.grid.bounds is not None
    if (run.part or run.sequences_from) and grids == "scans" and not bounded:
        raise ArgumentError(
            "--part",
            expected="--bounds or --grids none, because the height of the grid is otherwise "
            "measured in all sequences",
            found="neither",
        )
    made = carlasc.groundtruth.GridOptions(
        making.grid.spec_or_published(),
        making.from_scans(poses),
        making.votes.make(),
        follow_ground=not bounded,
    )
    if follow:
        parts = {
            "--part": run.part,
            "--sequences-from": run.sequences_from,
            "--cluster": run.cluster,
            "--sequences": chosen,
            "--frames": "frames" in written.values,
        }
        if asked := [name for name, given in parts.items() if given]:
            raise ArgumentError(
                "--follow",
                expected="one recording, whole, on this machine",
                found=", ".join(asked),
            )
        carlasc.converting.follow(
            name,
            source,
            out,
            idle_s=idle,
            grids=made if grids == "scans" else None,
            **common,
            say=lambda line: echo(line, err=True),
        )
    with run.spread(f"convert {name}", "steps") as spread:
        result = written.make(
            name,
            source,
            out,
            sequences=chosen,
            grids=made if grids == "scans" else "voxels" if grids == "voxels" else None,
            **common,
            run=spread,
        )
    if not json:
        print_warnings(result.findings)
    print_frames(result, (*result.sequences, *result.grids), "converted", json=json)
