"""`carlasc evaluate`."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, ClassVar

import typer

import carlasc
from carlasc.cli.common import (
    Json,
    echo,
    file_option,
    place_argument,
    place_option,
    print_json,
    report_failures,
    show,
    starting_with,
)
from carlasc.cli.flags import Flags, OneWorkerFlags
from carlasc.cli.library import Given, Library
from carlasc.core.choices import Around
from carlasc.errors import ArgumentError, count

if TYPE_CHECKING:
    from carlasc.metrics import Evaluation, FigureTable


@dataclass(frozen=True)
class RegionFlags(Flags):
    """The voxels between two distances, and within an angle about the forward axis."""

    heading: ClassVar[str] = "What is scored"

    near_m: Annotated[
        float,
        typer.Option(
            "--near", help="Score only voxels at least this far from the sensor, in metres."
        ),
    ] = 0.0
    far_m: Annotated[
        float | None,
        typer.Option(
            "--far",
            help="Score only voxels nearer to the sensor than this, in metres. Default: no limit.",
        ),
    ] = None
    fov: Annotated[
        float,
        typer.Option(
            help="Score only voxels in a field of view of this angle, centred forward, in degrees.",
            min=1,
            max=360,
        ),
    ] = 360.0

    def __call__(self, spec: Any) -> Any:
        """Return which voxels of a grid are scored. Workers get the object, which pickles."""
        from carlasc.metrics import distance_band, field_of_view

        band = distance_band(spec, self.near_m, math.inf if self.far_m is None else self.far_m)
        return band & field_of_view(spec, math.radians(self.fov))


@dataclass(frozen=True)
class OutputFlags(Flags):
    """What is printed and written."""

    heading: ClassVar[str] = "Output"

    per_frame: Annotated[
        Path | None,
        file_option("--per-frame", text="Also write the scores of each frame to this CSV file."),
    ] = None
    plot: Annotated[
        Path | None,
        file_option(
            "--plot", text="Also draw the scores of each frame to this .png, .svg or .pdf file."
        ),
    ] = None
    as_json: Json = False
    latex: Annotated[bool, typer.Option("--latex", help="Print the tables as LaTeX.")] = False
    csv: Annotated[bool, typer.Option("--csv", help="Print the tables as CSV.")] = False
    markdown: Annotated[bool, typer.Option("--markdown", help="Print the tables as Markdown.")] = (
        False
    )

    def texts(self, tables: Sequence[FigureTable]) -> str | None:
        """Return tables in the chosen form; None for the terminal's."""
        for form in ("latex", "csv", "markdown"):
            if getattr(self, form):
                return "\n".join(getattr(table, f"to_{form}")() for table in tables)
        return None


def evaluate(
    *,
    choice: Annotated[Given, Library("carlasc.evaluate")],
    scored: Annotated[Given, Library("carlasc.Scoring")],
    region: RegionFlags,
    output: OutputFlags,
    work: OneWorkerFlags,
    source: Annotated[
        str,
        place_argument(
            "Predictions: a data set, a sequence, the folder of a grid, a folder of .label files, "
            "or files of SemanticKITTI, SSCBench, Occ3D, OpenOccupancy, SurroundOcc, OccNet or "
            "CarlaOcc."
        ),
    ],
    truth: Annotated[str, place_argument("Ground truth, in one of the same forms.", "TRUTH")],
    convention: Annotated[
        str | None,
        typer.Option(
            help="Benchmark whose rules are followed: carlasc, semantickitti, sscbench, "
            "occ3d-lidar, occ3d-lidar-sparseocc, occ3d-camera, openoccupancy, surroundocc, occnet; "
            "or own, which "
            "scores the classes of the data. Default: the benchmark whose files TRUTH holds, "
            "otherwise carlasc, or own for classes that carlasc has no map for.",
            autocompletion=lambda incomplete: starting_with(
                incomplete, (*carlasc.metrics.CONVENTIONS, "own")
            ),
        ),
    ] = None,
    all_conventions: Annotated[
        bool,
        typer.Option(
            "--all-conventions", help="Print one row per convention instead of the tables."
        ),
    ] = False,
    forecast: Annotated[
        Around | None,
        typer.Option(
            help="Score forecasts: grids with names such as forecast_1s. present: they are around "
            "the sensor of the frame in which they are made. future: around the sensor of the "
            "frame that they predict."
        ),
    ] = None,
    compare: Annotated[
        str | None,
        place_option(
            "--compare",
            text="Other predictions of the same sequences, to compare SOURCE with by a paired "
            "test.",
        ),
    ] = None,
    boxes: Annotated[
        bool,
        typer.Option(
            "--boxes",
            help="SOURCE is a table of boxes, which are scored by those of TRUTH: .csv, .json or "
            ".parquet, as --boxes-out of label and regrid writes it.",
        ),
    ] = False,
    name: Annotated[
        str | None,
        typer.Option(help="Name of the predictions in the tables. Default: the name of SOURCE."),
    ] = None,
) -> None:
    """Score predicted grids by the rules of a benchmark: IoU per class, mIoU, and completeness.

    Benchmarks differ in the voxels that are scored, in the classes, and in the classes of the mean.
    Scores by different conventions can therefore not be compared. Intersections and unions are
    summed over all frames before they are divided.
    """
    if output.plot is not None:
        from carlasc.inspection.charts import check_plot

        check_plot(output.plot)  # before anything is counted
    name = name or Path(source).name
    common = dict(choice.values)
    if boxes or forecast is not None:
        others = {
            "all_conventions": all_conventions,
            "compare": compare,
            "per_frame": output.per_frame,
            "plot": output.plot,
        }
        if boxes:
            others |= {**common, **scored.values, "convention": convention, "forecast": forecast}
        if refused := [option for option, value in others.items() if value]:
            expected = f"none with {'--boxes' if boxes else '--forecast'}"
            raise ArgumentError(refused[0], expected=expected, found="both", advice="leave one out")
    if boxes:
        _print_boxes(source, truth, name, region, output)
        return
    scoring: carlasc.Scoring = scored.make(region=region if region.is_given else None)
    if forecast is not None:
        common |= {"convention": convention, "around": forecast}
        with work.spread("Scoring", usual=1) as run:
            by_time = carlasc.metrics.evaluate_forecasts(
                source, truth, scoring=scoring, run=run, **common
            )
        _print_forecasts(by_time, name, output)
        return
    if all_conventions:
        with work.spread("Scoring", usual=1) as run:
            results = carlasc.metrics.evaluate_by_all_conventions(
                source, truth, name=name, run=run, **common
            )
        _print_conventions(results, output.as_json)
        return
    common = {**common, "convention": convention}
    with work.spread("Scoring", usual=1) as run:
        result = carlasc.evaluate(source, truth, scoring=scoring, name=name, run=run, **common)
    other = None
    if compare is not None:
        whole = replace(scoring, by=(), rays=False, actors=False)
        with work.spread("Scoring --compare", usual=1) as run:
            other = carlasc.evaluate(
                compare, truth, scoring=whole, name=Path(compare).name, run=run, **common
            )
    if output.per_frame is not None:
        from carlasc.storage.files import write_output

        write_output(output.per_frame, result.to_csv().encode())
    if output.plot is not None:
        from carlasc.inspection.charts import draw_frame_scores

        draw_frame_scores(result, output.plot)
    _print(result, other, output)
    report_failures(result.failures, result.frames + len(result.failures))


def _print_tables(tables: Sequence[FigureTable], remark: str, output: OutputFlags) -> None:
    from carlasc.cli.tables import print_table

    if (text := output.texts(tables)) is not None:
        echo(text, nl=False)
        return
    for table in tables:
        print_table(table.header, table.texts(), title=f"{table.title} ({remark})")


def _print(result: Evaluation, other: Evaluation | None, output: OutputFlags) -> None:
    comparison = None if other is None else result.compare(other)
    if output.as_json:
        values = result.to_dict()
        if other is not None and comparison is not None:
            values["comparison"] = {"with": other.name, **comparison.to_dict()}
        print_json(values)
        return
    for kind, part in {"": result, **result.apart}.items():
        of = f"{kind} grids, " if kind else ""
        remark = f"{of}percent, {count(part.frames, 'frame')}, voxels: {part.voxels}"
        _print_tables(part.tables(), remark, output)
    predicted, true = (
        ", ".join(map(str, uses)) for uses in (result.source_classes, result.truth_classes)
    )
    remarks = [f"classes: predictions {predicted}; ground truth {true}"]
    remarks += [text for part in (result, *result.apart.values()) if (text := part.about_absent())]
    for remark in remarks:
        if output.texts([]) is None:
            show(remark)
        else:
            echo(remark, err=True)
    if output.texts([]) is not None:
        return
    if (interval := result.interval()) is not None:
        show(
            f"mIoU {100 * interval.value:.2f}, 95% interval {100 * interval.low:.2f} to "
            f"{100 * interval.high:.2f} ({count(len(result.sequences), 'sequence')})"
        )
    if comparison is not None and other is not None:
        gain = comparison.difference
        show(
            f"mIoU minus that of {other.name}: {100 * gain.value:+.2f}, 95% interval "
            f"{100 * gain.low:+.2f} to {100 * gain.high:+.2f}, p = {comparison.p_value:.3g} "
            f"({count(len(comparison.sequences), 'sequence')})"
        )
    if result.actors is not None and not math.isnan(result.actors.velocity_m_s):
        speeds = result.actors.velocity_by_speed.items()
        bands = ", ".join(
            f"from {low:g} m/s {value:.2f}" for low, value in speeds if not math.isnan(value)
        )
        show(
            f"mean velocity error of moving voxels: {result.actors.velocity_m_s:.2f} m/s ({bands})"
        )
    for note in result.notes:
        echo(f"note: {note}", err=True)


def _print_forecasts(by_time: Mapping[float, Evaluation], name: str, output: OutputFlags) -> None:
    """Print the tables with a row for each time ahead."""
    results = list(by_time.values())
    if output.as_json:
        print_json(
            {
                "name": name,
                "forecasts": [
                    {"horizon_s": t, **result.to_dict()} for t, result in by_time.items()
                ],
            }
        )
    else:
        tables = [carlasc.metrics.semantic_table(results), carlasc.metrics.geometric_table(results)]
        tables += [
            replace(table, title=f"{table.title}, {one.name}")
            for one in results
            for table in one.tables()[2:]
        ]
        frames = ", ".join(str(result.frames) for result in results)
        _print_tables(
            tables, f"percent, {name}, frames: {frames}, voxels: {results[0].voxels}", output
        )
    failures = [failure for result in results for failure in result.failures]
    report_failures(failures, sum(result.frames for result in results) + len(failures))


def _print_boxes(
    source: str, truth: str, name: str, region: RegionFlags, output: OutputFlags
) -> None:
    """Score boxes, and print them."""
    far = math.inf if region.far_m is None else region.far_m
    result = carlasc.metrics.evaluate_boxes(
        source, truth, name=name, near_m=region.near_m, far_m=far, fov_rad=math.radians(region.fov)
    )
    if output.as_json:
        print_json(result.to_dict())
        return
    _print_tables([result.table()], f"percent, {count(result.frames, 'annotated frame')}", output)
    if result.left_out:
        echo(f"note: {result.left_out} boxes at times without an annotated frame", err=True)


def _print_conventions(results: Mapping[str, Any], as_json: bool) -> None:
    """Print a row per convention: its mean IoU and completeness, or why there is none."""
    from carlasc.cli.tables import print_table
    from carlasc.errors import CarlascError

    if as_json:
        print_json(
            {
                n: {"impossible": str(r)} if isinstance(r, CarlascError) else r.to_dict()
                for n, r in results.items()
            }
        )
    else:
        rows = list[list[object]]()
        reasons = []
        for name, result in results.items():
            if isinstance(result, CarlascError):
                rows.append([name, *"-----"])
                reasons.append(f"{name}: {result}")
                continue
            score = result.score
            figures = [score.miou, score.iou, score.precision, score.recall]
            shown = ["-" if math.isnan(value) else 100 * value for value in figures]
            rows.append([name, result.matrix.total, *shown])
        header = ["Convention", "Voxels", "mIoU", "IoU", "Precision", "Recall"]
        print_table(
            header,
            rows,
            title="The same predictions by each convention (percent)",
            turn=False,
        )
        for reason in reasons:
            echo(f"no score: {reason}")
    for result in results.values():
        # a frame that cannot be read fails by every convention
        if not isinstance(result, CarlascError):
            report_failures(result.failures, result.frames + len(result.failures))
            break
