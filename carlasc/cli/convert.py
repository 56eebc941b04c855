"""`carlasc convert`: another data set as sequences of the layout."""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

from carlasc.cli.common import Json, Workers, print_json, progress_bar, report_failures
from carlasc.cli.regrid import Coordinates, Dynamics, Preset, Vote, merging_of, parse_grid
from carlasc.errors import ArgumentError


class Split(StrEnum):
    """Parts of a data set."""

    train = "train"
    val = "val"
    test = "test"
    all = "all"


class Grids(StrEnum):
    """Where grids come from."""

    scans = "scans"
    voxels = "voxels"
    none = "none"


class Frame(StrEnum):
    """Handedness of what is written."""

    carlasc = "carlasc"
    kitti = "kitti"


class PoseSource(StrEnum):
    """Where poses come from."""

    auto = "auto"
    file = "file"
    kiss_icp = "kiss-icp"


class Flow(StrEnum):
    """Where flow comes from."""

    instances = "instances"
    none = "none"


_GRIDS = "Grids from scans"


def _print_list(wanted: bool) -> None:
    if wanted:
        from carlasc.converting import converter_names, load_converter

        for name in converter_names():
            typer.echo(f"{name}: {load_converter(name).title}")
        raise typer.Exit


def convert(
    name: Annotated[str, typer.Argument(metavar="NAME", help="The data set: kitti, poss, ... (see --list).")],
    src: Annotated[Path, typer.Argument(metavar="SRC", help="Its root, or one of its sequences.")],
    out: Annotated[Path, typer.Argument(metavar="OUT", help="Folder to write to.")],
    sequences: Annotated[
        str | None, typer.Option(help="Numbers of sequences, with commas between: 00,08; all if not given.")
    ] = None,
    split: Annotated[Split, typer.Option(help="Only sequences of this part.")] = Split.all,
    labels: Annotated[
        str, typer.Option(help="carla: CarlaSC's classes; the converter's name: the data set's own.")
    ] = "carla",
    frame: Annotated[
        Frame, typer.Option(help="carlasc: y mirrored into CarlaSC's left-handed frame; kitti: right-handed, as it is.")
    ] = Frame.carlasc,
    grids: Annotated[
        Grids, typer.Option(help="scans: made of scans merged over time; voxels: the data set's own; none.")
    ] = Grids.scans,
    poses: Annotated[
        PoseSource,
        typer.Option(help="file; kiss-icp: estimated from the scans; auto: the file where there is one."),
    ] = PoseSource.auto,
    flow: Annotated[
        Flow, typer.Option(help="instances: velocity of moving actors, estimated from their points; none.")
    ] = Flow.instances,
    allow_unknown: Annotated[
        bool, typer.Option("--allow-unknown", help="Take unknown class ids for unlabelled.")
    ] = False,
    force: Annotated[
        bool, typer.Option("--force", help="Go on with poses that do not put scans on each other, or lack Tr.")
    ] = False,
    preset: Annotated[
        Preset | None, typer.Option(help="A published grid; coarse if no grid is given.", rich_help_panel=_GRIDS)
    ] = None,
    res: Annotated[
        str | None, typer.Option(help="Size of a voxel, metres, or one value an axis.", rich_help_panel=_GRIDS)
    ] = None,
    size: Annotated[str | None, typer.Option(help="Number of voxels an axis, X,Y,Z.", rich_help_panel=_GRIDS)] = None,
    coordinates: Annotated[
        Coordinates | None, typer.Option(help="Axes of the grid; cartesian if not given.", rich_help_panel=_GRIDS)
    ] = None,
    bounds: Annotated[str | None, typer.Option(help="x0,x1,y0,y1,z0,z1 as in regrid.", rich_help_panel=_GRIDS)] = None,
    vote: Annotated[Vote | None, typer.Option(help="How votes are counted.", rich_help_panel=_GRIDS)] = None,
    window: Annotated[
        str | None, typer.Option(help="Scans A:B around each frame; -30:30 if not given.", rich_help_panel=_GRIDS)
    ] = None,
    window_m: Annotated[
        float | None, typer.Option(help="Of those, only scans within so many metres driven.", rich_help_panel=_GRIDS)
    ] = None,
    stride: Annotated[int | None, typer.Option(help="Every so manyth scan.", rich_help_panel=_GRIDS)] = None,
    dynamic: Annotated[
        Dynamics | None,
        typer.Option(help="What moves: align (the default), current, drop or tube.", rich_help_panel=_GRIDS),
    ] = None,
    workers: Workers = None,
    json: Json = False,
    _list: Annotated[
        bool,
        typer.Option("--list", help="List the converters that are installed.", callback=_print_list, is_eager=True),
    ] = False,
) -> None:
    """Write another data set as sequences of the layout: the same files, frame and classes.

    Run it again to go on where it stopped: frames that are there are skipped.
    """
    from carlasc.converting import convert as convert_recordings

    merging = merging_of(window, window_m, stride, dynamic, None, None)
    asked = any(value is not None for value in (preset, res, size, coordinates, bounds, vote, merging))
    if asked and grids is not Grids.scans:
        raise ArgumentError(f"grid options are for --grids scans: expected none of them, found some with {grids.value}")
    if preset is None and res is None and size is None:
        preset = Preset.cylindrical if coordinates is Coordinates.cylindrical else Preset.coarse
    spec = parse_grid(res, size, preset, coordinates, bounds) if grids is Grids.scans else None
    with progress_bar(f"convert {name}") as progress:
        result = convert_recordings(
            name,
            src,
            out,
            sequences=None if sequences is None else sequences.split(","),
            split=split.value,
            labels=labels,
            frame=frame.value,
            grids=grids.value,
            spec=spec,
            merging=merging,
            vote=None if vote is None else vote.value,
            poses=poses.value,
            flow=flow.value,
            allow_unknown=allow_unknown,
            force=force,
            workers=workers,
            progress=progress,
        )
    if json:
        print_json(result)
    else:
        for note in result.notes:
            typer.echo(f"note: {note}")
        for place in (*result.sequences, *result.grids):
            typer.echo(place)
        there = f" ({result.skipped} were there)" if result.skipped else ""
        typer.echo(f"{result.made} frames converted{there} in {result.elapsed_s:.1f} s")
    report_failures(
        [(f.frame, f.message) for f in result.failures], result.made + result.skipped + len(result.failures)
    )
