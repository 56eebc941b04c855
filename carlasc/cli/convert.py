"""`carlasc convert`: another data set as sequences of the layout."""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

from carlasc.cli.common import Json, Workers, print_json, progress_bar, report_failures
from carlasc.cli.grid_options import (
    BoundsOption,
    Coordinates,
    CoordinatesOption,
    DynamicOption,
    Preset,
    PresetOption,
    ResOption,
    RuleOption,
    SizeOption,
    StrideOption,
    WindowMOption,
    WindowOption,
    parse_grid,
    scans_of,
)
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
        Grids,
        typer.Option(
            help="scans: made of scans merged over time, coarse ones if no grid is given; voxels: the data set's own; none."
        ),
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
    preset: PresetOption = None,
    res: ResOption = None,
    size: SizeOption = None,
    coordinates: CoordinatesOption = None,
    bounds: BoundsOption = None,
    rule: RuleOption = None,
    window: WindowOption = None,
    window_m: WindowMOption = None,
    stride: StrideOption = None,
    dynamic: DynamicOption = None,
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

    merging = scans_of(window=window, window_m=window_m, stride=stride, dynamic=dynamic)
    asked = any(value is not None for value in (preset, res, size, coordinates, bounds, rule, merging))
    if asked and grids is not Grids.scans:
        raise ArgumentError(
            "grid options are for --grids scans", expected="none of them", found=f"some with {grids.value}"
        )
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
            vote=None if rule is None else rule.value,
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
