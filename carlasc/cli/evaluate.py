"""`carlasc evaluate`."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from carlasc.cli.common import FramesOption, Json, console, print_json, progress_bar, report_failures

if TYPE_CHECKING:
    from carlasc.metrics import Evaluation


def evaluate(
    source: Annotated[
        str,
        typer.Argument(help="Predictions: a data set, a sequence, the folder of a grid, or a folder of .label files."),
    ],
    truth: Annotated[str, typer.Argument(help="Ground truth: likewise.")],
    grid: Annotated[
        str | None, typer.Option(help="Grid with the predictions; if not given, the name of the true grid.")
    ] = None,
    truth_grid: Annotated[
        str | None, typer.Option(help="Grid with the ground truth; if not given, evaluation, or the only grid.")
    ] = None,
    remap: Annotated[
        str, typer.Option(help="Classes that are scored: auto, none, or a remap such as carlasc11 or semantickitti19.")
    ] = "auto",
    source_classes: Annotated[
        str | None,
        typer.Option(help="Class table of SOURCE's labels, if the data do not name one: carla, carlasc11, ..."),
    ] = None,
    mask: Annotated[
        Literal["known", "semantickitti", "all"],
        typer.Option(help="Voxels that count: known ones, those of SemanticKITTI's rule, or all."),
    ] = "known",
    near_m: Annotated[
        float, typer.Option("--near", help="Score only voxels at this distance from the sensor or farther, metres.")
    ] = 0.0,
    far_m: Annotated[
        float | None, typer.Option("--far", help="Score only voxels nearer to the sensor than this, metres.")
    ] = None,
    fov: Annotated[
        float,
        typer.Option(help="Score only voxels in this angle about the forward axis, degrees.", min=1, max=360),
    ] = 360.0,
    frames: FramesOption = None,
    skip_absent: Annotated[
        bool,
        typer.Option(
            "--skip-absent",
            help="Leave classes that are in neither side out of the mean, instead of counting them as zero.",
        ),
    ] = False,
    name: Annotated[
        str | None, typer.Option(help="What to call the predictions in the tables; SOURCE's name if not given.")
    ] = None,
    as_json: Json = False,
    latex: Annotated[bool, typer.Option("--latex", help="Print the tables as LaTeX.")] = False,
    csv: Annotated[bool, typer.Option("--csv", help="Print the tables as CSV.")] = False,
) -> None:
    """Score predicted grids: the paper's tables of the IoU of each class and of completeness.

    mIoU is the mean over all classes, including free, as in the paper; the mean without free is printed beside it. A class that is
    in neither the predictions nor the ground truth counts as zero, unless --skip-absent is given. Intersections and unions are
    summed over all frames before they are divided.
    """
    import math

    from carlasc.metrics import distance_band, field_of_view
    from carlasc.metrics import evaluate as score

    def region(spec: Any) -> Any:
        band = distance_band(spec, near_m, math.inf if far_m is None else far_m)
        return band & field_of_view(spec, math.radians(fov))

    with progress_bar("Scoring") as progress:
        result = score(
            source,
            truth,
            grid=grid,
            truth_grid=truth_grid,
            remap=None if remap == "none" else remap,
            source_classes=source_classes,
            mask=mask,
            region=None if (near_m, far_m, fov) == (0.0, None, 360.0) else region,
            frames=frames,
            absent="skip" if skip_absent else "zero",
            name=name or Path(source).name,
            progress=progress,
        )
    if as_json:
        print_json(result.to_dict())
    elif latex or csv:
        typer.echo("\n".join(table.to_latex() if latex else table.to_csv() for table in result.tables()), nl=False)
    else:
        _print(result)
    report_failures(result.failures, result.frames + len(result.failures))


def _print(result: Evaluation) -> None:
    from carlasc.cli.tables import print_table

    for table in result.tables():
        title = f"{table.title} (percent, {result.frames} frames, voxels: {result.mask})"
        print_table(console(), table.header, table.texts(), title=title)
