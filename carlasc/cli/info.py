"""`carlasc info`."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated

import typer

from carlasc.cli.common import Json, console, print_json

if TYPE_CHECKING:
    from carlasc.inspection.overview import GridOverview, Overview, SequenceOverview


def info(
    path: Annotated[
        str, typer.Argument(help="A data set, a split, a sequence, a zip, a packed store, a capture, or a URL.")
    ] = ".",
    as_json: Json = False,
) -> None:
    """Say what is there: splits, sequences, frames, fields, grids and how they were made. No frame is read."""
    from carlasc.inspection.overview import info as look

    overview = look(path)
    if as_json:
        print_json(overview.to_dict())
    else:
        _print(overview)


def _print(overview: Overview) -> None:
    from rich.table import Table

    out = console()
    splits = ", ".join(f"{name} {count}" for name, count in overview.splits.items())
    out.print(f"[bold]{overview.location}[/bold]: {overview.level} ({overview.store})", highlight=False)
    if overview.sequences:
        out.print(f"{len(overview.sequences)} sequences: {splits}{_size(overview.bytes)}", highlight=False)
        table = Table("Sequence", "Frames", "Numbers", "Gaps", "Fields", "Grids", "Frame", "Classes", "About")
        for sequence in overview.sequences:
            table.add_row(*_row(sequence))
        out.print(table)
    for sequence in overview.sequences:
        if sequence.problem:
            out.print(f"{sequence.path or sequence.name}: {sequence.problem}", highlight=False, markup=False)
    _print_grids(overview)
    for capture in overview.captures:
        span = f"{capture.first}..{capture.last}" + (f" with {capture.gaps} gaps" if capture.gaps else "")
        text = f"raw capture {capture.path or '.'}: {capture.sensors} sensors, {capture.frames} frames ({span})"
        out.print(text, highlight=False, markup=False)


def _row(sequence: SequenceOverview) -> list[str]:
    fields = [name if n == sequence.frames else f"{name} ({n})" for name, n in sequence.fields.items()]
    fields += [name.removesuffix(".txt") for name in sequence.documents if name.endswith(".txt")]
    return [
        sequence.path or sequence.name,
        str(sequence.frames),
        "" if sequence.first is None else f"{sequence.first}..{sequence.last}",
        str(sequence.gaps or ""),
        ", ".join(fields) or "none",
        ", ".join(grid.name for grid in sequence.grids) or "none",
        sequence.axes,
        sequence.classes,
        _size(sequence.bytes).removeprefix(", "),
    ]


def _print_grids(overview: Overview) -> None:
    """Print each kind of grid once, with the number of sequences that have it."""
    from rich.table import Table

    kinds: dict[tuple[object, ...], list[GridOverview]] = {}
    for sequence in overview.sequences:
        for grid in sequence.grids:
            kinds.setdefault((grid.name, grid.coordinates, grid.size, grid.lower, grid.upper, _made(grid)), []).append(
                grid
            )
    if not kinds:
        return
    table = Table("Grid", "Axes", "Size", "Cell", "Bounds", "Parts", "Sequences", "Frames", "Made")
    for grids in kinds.values():
        grid = grids[0]
        bounds = ", ".join(f"{low:g}..{up:g}" for low, up in zip(grid.lower, grid.upper, strict=True))
        table.add_row(
            grid.name,
            grid.coordinates,
            " x ".join(map(str, grid.size)),
            " x ".join(f"{edge:.4g}" for edge in grid.voxel_size),
            bounds,
            ", ".join(grid.parts),
            str(len(grids)),
            str(sum(g.frames for g in grids)),
            _made(grid),
        )
    console().print(table)


def _made(grid: GridOverview) -> str:
    if grid.made is None:
        return "published"
    return ", ".join(f"{key} {value}" for key, value in grid.made.items() if isinstance(value, str | int | float))


def _size(count: int | None) -> str:
    if count is None:
        return ""
    return f", {count / 1e9:.2f} GB" if count >= 1e8 else f", {count / 1e6:.2f} MB"
