"""`carlasc convert`: another data set as sequences of the layout."""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import Annotated, Literal

import typer

from carlasc.cli.common import (
    Cluster,
    Json,
    PartOption,
    Workers,
    echo,
    engine,
    file_argument,
    parse_options,
    parse_part,
    place_argument,
    print_json,
    progress_bar,
    report_failures,
)
from carlasc.cli.grid_options import (
    BoundsOption,
    CoordinatesOption,
    DynamicOption,
    PresetOption,
    ResOption,
    RuleOption,
    SizeOption,
    StrideOption,
    WindowMOption,
    WindowOption,
    parse_grid_or_published,
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
    """What grids are made from."""

    scans = "scans"
    voxels = "voxels"
    none = "none"


class Axes(StrEnum):
    """Handedness of the axes that are written."""

    left = "left"
    right = "right"


class PoseSource(StrEnum):
    """Where poses come from."""

    auto = "auto"
    file = "file"
    kiss_icp = "kiss-icp"


class Flow(StrEnum):
    """Whether flow is written."""

    auto = "auto"
    none = "none"


def _print_list(wanted: bool) -> None:
    if wanted:
        from carlasc.converting import converter_names, load_converter

        for name in converter_names():
            echo(f"{name}: {load_converter(name).title}")
        raise typer.Exit


def convert(
    name: Annotated[str, typer.Argument(metavar="NAME", help="The data set: kitti, argoverse2, ... (see --list).")],
    source: Annotated[Path, file_argument("Folder of the data set, or of one of its sequences.", "SOURCE")],
    out: Annotated[str, place_argument("Folder to write to, or its URL.", "OUT")],
    sequences: Annotated[
        str | None,
        typer.Option(help="Names of sequences or the last parts of them, separated by commas: 00,08. Default: all."),
    ] = None,
    split: Annotated[Split, typer.Option(help="Only sequences of this split.")] = Split.all,
    classes: Annotated[
        str,
        typer.Option(
            help="carla: CarlaSC's classes. The name of the data set's own class table, such as semantickitti: keep its ids."
        ),
    ] = "carla",
    axes: Annotated[
        Axes,
        typer.Option(
            help="left: y is mirrored into CarlaSC's left-handed axes. right: right-handed, as in the data set."
        ),
    ] = Axes.left,
    grids: Annotated[
        Grids,
        typer.Option(
            help="scans: made from scans merged over time (the coarse grid if no other is given). voxels: the data set's own."
            " none: no grids."
        ),
    ] = Grids.scans,
    poses: Annotated[
        PoseSource,
        typer.Option(
            help="file: those of the data set. kiss-icp: estimated from the scans. auto: the file if it exists, else estimated."
        ),
    ] = PoseSource.auto,
    flow: Annotated[
        Flow,
        typer.Option(
            help="auto: the velocity of each actor, from its tracked boxes or else from its points. none: no flow."
        ),
    ] = Flow.auto,
    allow_unknown: Annotated[
        bool, typer.Option("--allow-unknown", help="Treat unknown class ids as unlabelled.")
    ] = False,
    force: Annotated[
        bool,
        typer.Option("--force", help="Accept poses under which scans do not overlap, or whose calibration is missing."),
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
    option: Annotated[
        list[str] | None,
        typer.Option(
            metavar="NAME=VALUE", help="An option of this data set, see its page. May be given several times."
        ),
    ] = None,
    workers: Workers = None,
    cluster: Cluster = None,
    part: PartOption = None,
    json: Json = False,
    _list: Annotated[
        bool,
        typer.Option("--list", help="List the converters that are installed.", callback=_print_list, is_eager=True),
    ] = False,
) -> None:
    """Write another data set as sequences of the CarlaSC layout: the same files, axes and classes.

    Run it again to continue where it stopped: frames that exist are skipped.
    """
    from carlasc.converting import LayoutOptions
    from carlasc.converting import convert as convert_recordings
    from carlasc.groundtruth import Voting
    from carlasc.groundtruth.options import GridOptions
    from carlasc.motion import PoseOptions
    from carlasc.running import Run

    observe = scans_of(window=window, window_m=window_m, stride=stride, dynamic=dynamic)
    asked = any(value is not None for value in (preset, res, size, coordinates, bounds, rule, observe))
    if asked and grids is not Grids.scans:
        raise ArgumentError("--grids", expected="scans, because options of the grid are given", found=grids.value)
    if part is not None and grids is Grids.scans and bounds is None:
        raise ArgumentError(
            "--part",
            expected="--bounds or --grids none with it, because the height of grids is found from the ground of all sequences",
            found="neither",
        )
    made: GridOptions | Literal["voxels"] | None = "voxels" if grids is Grids.voxels else None
    if grids is Grids.scans:
        spec = parse_grid_or_published(res, size, preset, coordinates, bounds)
        made = GridOptions(spec, observe, None if rule is None else Voting(rule.value), follow_ground=bounds is None)
    with progress_bar(f"convert {name}") as progress, engine(cluster, workers) as executor:
        result = convert_recordings(
            name,
            source,
            out,
            sequences=None if sequences is None else sequences.split(","),
            split=split.value,
            layout=LayoutOptions(classes, axes.value, flow.value, allow_unknown),
            poses=PoseOptions(poses.value, force),
            grids=made,
            options=parse_options(option),
            run=Run(workers, executor, parse_part(part), progress),
        )
    if json:
        print_json(result)
    else:
        for note in result.notes:
            echo(f"note: {note}")
        for place in (*result.sequences, *result.grids):
            echo(place)
        skipped = f" ({result.skipped} existed)" if result.skipped else ""
        echo(f"{result.made} frames converted{skipped} in {result.elapsed_s:.1f} s")
    report_failures(
        [(f.frame, f.message) for f in result.failures], result.made + result.skipped + len(result.failures)
    )
