"""`carlasc evaluate`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any, Literal

import typer

from carlasc.cli.common import Json, console, parse_frames, print_json, progress_bar, report_failures


def evaluate(
    pred: Annotated[str, typer.Argument(help="Predictions: a data set, a sequence, or a folder of .label files.")],
    truth: Annotated[str, typer.Argument(help="Ground truth: a data set, a sequence, or a folder of .label files.")],
    pred_grid: Annotated[
        str | None, typer.Option(help="Grid with the predictions; the truth's name if not given.")
    ] = None,
    grid: Annotated[str | None, typer.Option(help="Grid with the truth; `evaluation` if not given.")] = None,
    remap: Annotated[
        str, typer.Option(help="Classes scored: auto, none, or a remap: carlasc11, semantickitti19.")
    ] = "auto",
    pred_classes: Annotated[
        str | None,
        typer.Option(help="Class table of the predictions' ids, where nothing beside them says: carla, carlasc11, ..."),
    ] = None,
    mask: Annotated[
        Literal["known", "semantickitti", "all"],
        typer.Option(help="Voxels that count: known ones, by SemanticKITTI's rule, or all."),
    ] = "known",
    near: Annotated[float, typer.Option(help="Only voxels at least so far from the sensor, metres.", min=0)] = 0.0,
    far: Annotated[float | None, typer.Option(help="Only voxels nearer than this, metres.")] = None,
    fov: Annotated[float, typer.Option(help="Only voxels in this angle about the forward axis, degrees.")] = 360.0,
    frames: Annotated[str | None, typer.Option(help="Frames A:B (B not included).")] = None,
    skip_absent: Annotated[
        bool,
        typer.Option(
            "--skip-absent", help="Leave classes in neither side out of the mean, instead of counting them zero."
        ),
    ] = False,
    name: Annotated[str | None, typer.Option(help="What to call the predictions in the tables.")] = None,
    as_json: Json = False,
    latex: Annotated[bool, typer.Option("--latex", help="Print the tables as LaTeX.")] = False,
    csv: Annotated[bool, typer.Option("--csv", help="Print the tables as CSV.")] = False,
) -> None:
    """Score predicted grids: the paper's tables of per-class IoU and of completeness.

    mIoU counts every class, free among them, as the paper does; beside it stands the mean without free. A class in neither the
    prediction nor the truth counts zero unless --skip-absent is given. Intersections and unions are summed over all frames.
    """
    import math

    from carlasc.metrics import distance_band, field_of_view
    from carlasc.metrics import evaluate as score

    def region(spec: Any) -> Any:
        return distance_band(spec, near, math.inf if far is None else far) & field_of_view(spec, math.radians(fov))

    with progress_bar("Scoring") as progress:
        result = score(
            pred,
            truth,
            pred_grid=pred_grid,
            truth_grid=grid,
            remap=None if remap == "none" else remap,
            pred_classes=pred_classes,
            mask=mask,
            region=None if (near, far, fov) == (0.0, None, 360.0) else region,
            frames=parse_frames(frames),
            absent="skip" if skip_absent else "zero",
            name=name or Path(pred).name,
            progress=progress,
        )
    if as_json:
        print_json(result.figures())
    elif latex or csv:
        typer.echo("\n".join(table.to_latex() if latex else table.to_csv() for table in result.tables()), nl=False)
    else:
        _print_tables(result)
    report_failures(result.failures, result.frames + len(result.failures))


def _print_tables(result: Any) -> None:
    from rich.table import Table

    out = console()
    for table in result.tables():
        drawn = Table(
            title=f"{table.title} (percent, {result.frames} frames, voxels: {result.mask})", title_justify="left"
        )
        for index, column in enumerate(table.header):
            drawn.add_column(column, justify="left" if index == 0 else "right")
        for row in table.texts():
            drawn.add_row(*row)
        out.print(drawn)
