"""`carlasc info`."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated

import typer

from carlasc.cli.common import MANY, Json, console, few, line, place_argument, print_json, show
from carlasc.cli.library import Given, Library
from carlasc.errors import count

if TYPE_CHECKING:
    from carlasc.inspection.overview import GridOverview, Overview, SequenceOverview


def info(
    *,
    source: Annotated[
        str,
        place_argument(
            "A data set, a split, a sequence, a zip, a packed store, a capture, or a URL."
        ),
    ] = ".",
    options: Annotated[Given, Library("carlasc.info")],
    everything: Annotated[
        bool, typer.Option("--all", help="Look at all sequences, and print a row for each.")
    ] = False,
    as_json: Json = False,
) -> None:
    """List the contents of a data set: splits, sequences, frames, fields, grids and how they were
    made. No frame is read. Of more than 100 sequences, some are looked at.
    """
    given = {} if everything else {"sample": MANY, **options.values}
    overview = options.make(source, **given)
    if as_json:
        print_json(overview.to_dict())
    else:
        _print(overview, everything=everything)


def _print(overview: Overview, *, everything: bool) -> None:
    from carlasc.cli.tables import print_table

    names = {name: number for name, number in overview.splits.items() if name != "none"}
    splits = (
        f" ({', '.join(f'{name} {number}' for name, number in names.items())})" if names else ""
    )
    console().print(
        line(overview.location, "bold") + line(f": {overview.level} ({overview.store})")
    )
    if overview.places:
        frames = overview.total("frames")
        taken = overview.total("bytes")
        show(f"{count(sum(overview.places.values()), 'sequence')}{splits}")
        size = f"{_size(taken.value)} ({_size(taken.low)} to {_size(taken.high)})"
        looked_at = f"{len(overview.sequences)} looked at (--all: all)"
        show(f"{looked_at}: in all {frames:,.0f} frames, {size}")
        header = "Split|Fields|Axes|Classes|Sensor|Sequences|Frames"
        print_table(header.split("|"), _rows_of_kinds(overview))
    elif overview.sequences:
        size = f", {_size(overview.bytes)}" if overview.bytes is not None else ""
        show(f"{count(len(overview.sequences), 'sequence')}{splits}{size}")
        header = "Sequence|Frames|Numbers|Gaps|Fields|Grids|Axes|Classes|Size"
        print_table(
            header.split("|"), [_row(sequence) for sequence in overview.sequences], turn=False
        )
    bad = [sequence for sequence in overview.sequences if sequence.problem]
    for sequence in few(bad, everything=everything):
        show(f"{sequence.path or sequence.name}: {sequence.problem}")
    if kinds := _kinds_of_grids(overview):
        header = "Grid|Coordinates|Voxels|Voxel size|Bounds|Fields|Sequences|Frames|Made"
        print_table(header.split("|"), [_grid_row(grids) for grids in kinds])
    stale = [
        f"{sequence.path or sequence.name}/{grid.name}: stale: {grid.stale}"
        for sequence in overview.sequences
        for grid in sequence.grids
        if grid.stale
    ]
    for text in few(stale, everything=everything):
        show(text, "yellow")
    for capture in overview.captures:
        span = f"{capture.first}..{capture.last}" + (
            f" with {count(capture.gaps, 'gap')}" if capture.gaps else ""
        )
        size = f"{count(capture.sensors, 'sensor')}, {count(capture.frames, 'frame')}"
        show(f"raw capture {capture.path or '.'}: {size} ({span})")


def _rows_of_kinds(overview: Overview) -> list[list[object]]:
    """Return a row for each kind of sequence: what it has in common, and the sums."""
    kinds: dict[tuple[object, ...], list[int]] = {}
    for one in overview.sequences:
        kind = (one.split or "none", ", ".join(one.fields), one.axes, one.classes, one.sensor)
        kinds.setdefault(kind, []).append(one.frames)
    return [[*kind, len(frames), sum(frames)] for kind, frames in kinds.items()]


def _row(sequence: SequenceOverview) -> list[object]:
    fields = [
        name if n == sequence.frames else f"{name} ({n})" for name, n in sequence.fields.items()
    ]
    fields += [name.removesuffix(".txt") for name in sequence.documents if name.endswith(".txt")]
    return [
        sequence.path or sequence.name,
        sequence.frames,
        None if sequence.first is None else f"{sequence.first}..{sequence.last}",
        sequence.gaps or None,
        ", ".join(fields) or "none",
        ", ".join(grid.name for grid in sequence.grids) or "none",
        sequence.axes,
        sequence.classes,
        None if sequence.bytes is None else f"about {_size(sequence.bytes)}",
    ]


def _kinds_of_grids(overview: Overview) -> list[list[GridOverview]]:
    """Return the grids of all sequences, grouped by name, geometry and how they were made."""
    kinds: dict[tuple[object, ...], list[GridOverview]] = {}
    for sequence in overview.sequences:
        for grid in sequence.grids:
            kind = (grid.name, grid.coordinates, grid.size, grid.lower, grid.upper, _made(grid))
            kinds.setdefault(kind, []).append(grid)
    return list(kinds.values())


def _grid_row(grids: list[GridOverview]) -> list[object]:
    grid = grids[0]
    return [
        grid.name,
        grid.coordinates,
        " x ".join(map(str, grid.size)),
        " x ".join(f"{edge:.4g}" for edge in grid.voxel_size),
        ", ".join(f"{low:g}..{up:g}" for low, up in zip(grid.lower, grid.upper, strict=True)),
        ", ".join(grid.parts),
        len(grids),
        sum(g.frames for g in grids),
        _made(grid),
    ]


def _made(grid: GridOverview) -> str:
    if grid.made is None:
        return "published"
    return ", ".join(
        f"{key} {value}" for key, value in grid.made.items() if isinstance(value, str | int | float)
    )


def _size(count: float) -> str:
    return f"{count / 1e9:.2f} GB" if count >= 1e8 else f"{count / 1e6:.2f} MB"
