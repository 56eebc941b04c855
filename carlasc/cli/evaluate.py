"""`carlasc evaluate`."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from carlasc.cli.common import (
    Cluster,
    FramesOption,
    Json,
    console,
    echo,
    engine,
    file_option,
    line,
    place_argument,
    place_option,
    print_json,
    progress_bar,
    report_failures,
)
from carlasc.running.options import Run

if TYPE_CHECKING:
    from carlasc.metrics import Evaluation


class Part(StrEnum):
    """What a score can be broken down by."""

    distance = "distance"
    height = "height"
    visibility = "visibility"
    motion = "motion"


_OUTPUT, _PART = "Output", "Part of the grid"


def evaluate(
    source: Annotated[
        str,
        place_argument(
            "Predictions: a data set, a sequence, the folder of a grid, a folder of .label files, or files of SemanticKITTI,"
            " SSCBench, Occ3D or OpenOccupancy."
        ),
    ],
    truth: Annotated[str, place_argument("Ground truth: likewise.", "TRUTH")],
    convention: Annotated[
        str | None,
        typer.Option(
            help="Benchmark whose rules are followed: carlasc, semantickitti, sscbench, occ3d-lidar, occ3d-lidar-sparseocc,"
            " occ3d-camera, openoccupancy; own scores the data's own classes. If not given: the benchmark whose files TRUTH holds; otherwise carlasc, or own for"
            " classes that it has no map for."
        ),
    ] = None,
    all_conventions: Annotated[
        bool, typer.Option("--all-conventions", help="Print one row for each convention instead of the tables.")
    ] = False,
    grid: Annotated[
        str | None, typer.Option(help="Grid with the predictions; if not given, the name of the true grid.")
    ] = None,
    truth_grid: Annotated[
        str | None, typer.Option(help="Grid with the ground truth; if not given, evaluation, or the only grid.")
    ] = None,
    source_classes: Annotated[
        str | None,
        typer.Option(help="Class table of SOURCE's labels, if the data do not name one: carla, carlasc11, ..."),
    ] = None,
    compare: Annotated[
        str | None,
        place_option(
            "--compare", text="Other predictions of the same sequences: compare SOURCE with them by a paired test."
        ),
    ] = None,
    voxels: Annotated[
        Literal["known", "all"],
        typer.Option(help="Voxels that count: those that the truth evaluated, or all.", rich_help_panel=_PART),
    ] = "known",
    near_m: Annotated[
        float,
        typer.Option(
            "--near",
            help="Score only voxels at this distance from the sensor or farther, metres.",
            rich_help_panel=_PART,
        ),
    ] = 0.0,
    far_m: Annotated[
        float | None,
        typer.Option("--far", help="Score only voxels nearer to the sensor than this, metres.", rich_help_panel=_PART),
    ] = None,
    fov: Annotated[
        float,
        typer.Option(
            help="Score only voxels in this angle about the forward axis, degrees.",
            min=1,
            max=360,
            rich_help_panel=_PART,
        ),
    ] = 360.0,
    frames: FramesOption = None,
    workers: Annotated[
        int | None, typer.Option(help="Processes that work side by side; if not given, one.", min=1)
    ] = None,
    cluster: Cluster = None,
    by: Annotated[
        list[Part] | None,
        typer.Option(help="Also score parts of the grid; may be given several times.", rich_help_panel=_PART),
    ] = None,
    rays: Annotated[
        bool, typer.Option("--rays", help="Also score what rays meet first: RayIoU. Needs poses and a Cartesian grid.")
    ] = False,
    name: Annotated[
        str | None,
        typer.Option(
            help="What to call the predictions in the tables; SOURCE's name if not given.", rich_help_panel=_OUTPUT
        ),
    ] = None,
    per_frame: Annotated[
        Path | None,
        file_option("--per-frame", text="Write the scores of each frame to this CSV file.", rich_help_panel=_OUTPUT),
    ] = None,
    plot: Annotated[
        Path | None,
        file_option("--plot", text="Draw the scores of each frame to this PNG file.", rich_help_panel=_OUTPUT),
    ] = None,
    as_json: Json = False,
    latex: Annotated[bool, typer.Option("--latex", help="Print the tables as LaTeX.", rich_help_panel=_OUTPUT)] = False,
    csv: Annotated[bool, typer.Option("--csv", help="Print the tables as CSV.", rich_help_panel=_OUTPUT)] = False,
) -> None:
    """Score predicted grids by the rules of a benchmark: IoU of each class, their mean, and completeness.

    Benchmarks differ in the voxels that count, in the classes, and in the classes of the mean: scores by different conventions cannot be
    compared. Intersections and unions are summed over all frames before they are divided.
    """
    from carlasc.metrics import evaluate as score
    from carlasc.metrics import evaluate_by_all_conventions

    if plot is not None:
        from carlasc.inspection.charts import check_plot

        check_plot(plot)  # before anything is counted
    common: dict[str, Any] = {
        "grid": grid, "truth_grid": truth_grid, "source_classes": source_classes, "frames": frames,
    }  # fmt: skip
    name = name or Path(source).name
    if all_conventions:
        with progress_bar("Scoring") as progress, engine(cluster, workers) as executor:
            found = evaluate_by_all_conventions(
                source, truth, name=name, run=Run(workers or 1, executor, progress=progress), **common
            )
        _print_conventions(found, as_json)
        return

    common |= {"convention": convention, "voxels": voxels}
    common["region"] = None if (near_m, far_m, fov) == (0.0, None, 360.0) else _Region(near_m, far_m, fov)
    with progress_bar("Scoring") as progress, engine(cluster, workers) as executor:
        parts = [part.value for part in by or ()]
        result = score(
            source, truth, by=parts, rays=rays, name=name, run=Run(workers or 1, executor, progress=progress), **common
        )
    other = None
    if compare is not None:
        with progress_bar("Scoring the other") as progress, engine(cluster, workers) as executor:
            other = score(
                compare, truth, name=Path(compare).name, run=Run(workers or 1, executor, progress=progress), **common
            )
    if per_frame is not None:
        from carlasc.storage.files import write_output

        write_output(per_frame, result.to_csv().encode())
    if plot is not None:
        from carlasc.inspection.charts import draw_frame_scores

        draw_frame_scores(result, plot)
    _print(result, other, as_json=as_json, latex=latex, csv=csv)
    report_failures(result.failures, result.frames + len(result.failures))


@dataclass(frozen=True)
class _Region:
    """The voxels between two distances, metres, and within an angle about the forward axis, degrees. It pickles into workers."""

    near_m: float
    far_m: float | None
    fov: float

    def __call__(self, spec: Any) -> Any:
        import math

        from carlasc.metrics import distance_band, field_of_view

        band = distance_band(spec, self.near_m, math.inf if self.far_m is None else self.far_m)
        return band & field_of_view(spec, math.radians(self.fov))


def _print(result: Evaluation, other: Evaluation | None, *, as_json: bool, latex: bool, csv: bool) -> None:
    comparison = None if other is None else result.compare(other)
    if as_json:
        values = result.to_dict()
        if other is not None and comparison is not None:
            values["comparison"] = {"with": other.name, **comparison.to_dict()}
        print_json(values)
        return
    if latex or csv:
        echo("\n".join(table.to_latex() if latex else table.to_csv() for table in result.tables()), nl=False)
        return
    from carlasc.cli.tables import print_table

    out = console()
    for table in result.tables():
        title = f"{table.title} (percent, {result.frames} frames, voxels: {result.voxels})"
        print_table(out, table.header, table.texts(), title=title)
    if (interval := result.interval()) is not None:
        out.print(
            line(
                f"mIoU {100 * interval.value:.2f}, 95 % interval {100 * interval.low:.2f} to {100 * interval.high:.2f} ({len(result.sequences)} sequences)"
            )
        )
    if comparison is not None and other is not None:
        found = comparison.difference
        out.print(
            line(
                f"mIoU less that of {other.name}: {100 * found.value:+.2f}, 95 % interval {100 * found.low:+.2f} to {100 * found.high:+.2f},"
                f" p = {comparison.p_value:.3g} ({len(comparison.sequences)} sequences)"
            )
        )
    for note in result.notes:
        echo(f"note: {note}", err=True)


def _print_conventions(found: Any, as_json: bool) -> None:
    """Print a row per convention: its mean IoU and completeness, or why there is none."""
    import math

    from carlasc.cli.tables import print_table
    from carlasc.errors import CarlascError

    if as_json:
        print_json(
            {n: {"impossible": str(r)} if isinstance(r, CarlascError) else r.to_dict() for n, r in found.items()}
        )
    else:
        rows, reasons = [], []
        for name, result in found.items():
            if isinstance(result, CarlascError):
                rows.append([name, "-", "-", "-", "-", "-"])
                reasons.append(f"{name}: {result}")
                continue
            score = result.score
            figures = [score.miou, score.iou, score.precision, score.recall]
            shown = ["-" if math.isnan(value) else f"{100 * value:.2f}" for value in figures]
            rows.append([name, str(result.matrix.total), *shown])
        header = ["Convention", "Voxels", "mIoU", "IoU", "Precision", "Recall"]
        print_table(console(), header, rows, title="The same predictions by each convention (percent)", turn=False)
        for reason in reasons:
            echo(f"no score: {reason}")
    for result in found.values():
        if not isinstance(result, CarlascError):  # a frame that cannot be read fails by every convention
            report_failures(result.failures, result.frames + len(result.failures))
            break
