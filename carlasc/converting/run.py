"""`convert`: every recording of another data set becomes a sequence of the layout. Frames are converted in parallel."""

from __future__ import annotations

import os
import time
from collections.abc import Collection, Mapping
from concurrent.futures import Executor
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Literal, get_args

from carlasc.converting.places import check_outside
from carlasc.converting.plans import (
    RecordingPlan,
    SplitName,
    check_voxel_grid,
    choose_recordings,
    plan_recording,
)
from carlasc.converting.protocol import Converter
from carlasc.converting.registry import load_converter
from carlasc.converting.regridding import Regridding
from carlasc.converting.results import ConvertResult, Failure, Progress, Steps
from carlasc.converting.stages import Conversion
from carlasc.converting.target import Target
from carlasc.converting.trajectory import PoseSource
from carlasc.core.grids import GridSpec
from carlasc.errors import ArgumentError, MissingDataError
from carlasc.running.processes import count_workers, one_pool
from carlasc.storage.folders.folder import FolderSink
from carlasc.storage.metadata import Axes, Metadata
from carlasc.storage.protocol import Sink

if TYPE_CHECKING:
    from carlasc.groundtruth import RegridResult
    from carlasc.groundtruth.options import FromScans, Voting

Grids = Literal["scans", "voxels", "none"]
Flow = Literal["auto", "none"]


def convert(
    name: str | type[Converter],
    source: str | os.PathLike[str],
    out: str | os.PathLike[str] | Sink,
    *,
    sequences: Collection[str] | None = None,
    split: SplitName = "all",
    classes: str = "carla",
    axes: Axes = "left",
    grids: Grids = "scans",
    spec: GridSpec | None = None,
    observe: FromScans | None = None,
    voting: Voting | None = None,
    follow_ground: bool = True,
    poses: PoseSource = "auto",
    flow: Flow = "auto",
    options: Mapping[str, str] | None = None,
    allow_unknown: bool = False,
    force: bool = False,
    workers: int | None = None,
    executor: Executor | None = None,
    progress: Progress | None = None,
) -> ConvertResult:
    """Write another data set as sequences of the CarlaSC layout: the same files, axes and classes.

    A second run skips the frames that exist. A frame that cannot be read is reported in the result, and the others are converted.
    Worker processes import the main module again: scripts call this under `if __name__ == "__main__":`, or with `workers=1`.

    Args:
        name: the converter: "kitti", "argoverse2", ..., or one of another distribution (see `converter_names`); or a class that
            inherits `Converter`.
        source: folder of the data set, or of one of its sequences.
        out: folder to write to, or any Sink (then without grids).
        sequences: which ones, by their names or the last part of them ("00"); None converts all.
        split: "train", "val" or "test": only sequences of this split; "all" converts every split.
        classes: "carla" maps class ids to CarlaSC's; the name of the data set's own class table ("semantickitti") keeps its ids.
        axes: "left" mirrors y into CarlaSC's left-handed axes; "right" keeps the right-handed ones.
        grids: "scans" makes grids from scans merged over time; "voxels" takes the data set's own voxels, with count 0 where
            they are unknown; "none" writes no grids.
        spec: with "scans": the grid; None takes the published coarse one.
        observe: with "scans": which scans are merged, and how moving points are treated.
        voting: with "scans": how votes are counted.
        follow_ground: with "scans": move the grid up or down by whole voxels where the ground is below it, or far above its lower
            bound; False keeps the bounds of `spec`.
        poses: "file", "kiss-icp" (estimated from the scans), or "auto": the file where it exists, else estimated.
        flow: "auto" gives points the velocity of their actor: from tracked boxes where the data set has them, else estimated from
            the actor's points, if they are numbered; "none" writes no flow.
        options: what the converter takes beside the source, as text: see its page in the documentation.
        allow_unknown: treat class ids that the table does not have as unlabelled.
        force: accept poses under which the scans do not overlap, or whose calibration is missing.
        workers: number of frames that are converted at the same time; None uses all cores.
        executor: runs the work instead of processes of our own; it is not shut down.
        progress: called with the number of finished steps and the number of all steps.

    Returns:
        What was written, what was skipped, and what failed.

    Raises:
        ArgumentError: an argument has a wrong value, or no converter has that name.
        MissingDataError: `source`, a sequence or the poses do not exist.
        FormatError: poses or times do not fit the frames, or the scans.
        ConflictError: `out` lies inside `source`, or holds other data.
        StorageError: the output cannot be written. The files written so far are complete.
    """
    start, workers = time.perf_counter(), count_workers(workers)
    converter = load_converter(name) if isinstance(name, str) else name
    _check(converter, classes=classes, axes=axes, grids=grids, split=split, poses=poses, flow=flow)
    root = Path(source)
    sink = out if isinstance(out, Sink) else FolderSink(out)
    _check_sink(root, sink, grids)
    if not root.exists():
        raise MissingDataError(root, expected="a folder", found="nothing", advice="check the path")
    recordings = choose_recordings(converter(root, **(options or {})).sequences(), root, sequences, split)
    remap = converter.to_carla if classes == "carla" else None
    target = Target(converter.classes, remap, axes == "left", allow_unknown, voxels=grids == "voxels")
    metadata = Metadata(
        axes,
        target.classes,
        converter.sensor,
        converter.min_range_m,
        converter.max_range_m,
        f"{name if isinstance(name, str) else name.__name__} {root.name}",
        {} if converter.license is None else {"license": converter.license},
    )
    plans = [
        plan_recording(recording, converter, sink, poses, flow=flow == "auto", force=force) for recording in recordings
    ]
    for plan in plans:
        _check_grids(plan, grids)
        check_voxel_grid(plan, target)
    steps = Steps(progress, sum(len(plan.recording.frames) for plan in plans))
    done: list[Conversion] = []
    made: list[RegridResult] = []
    with one_pool(workers, executor) as pool:
        with ExitStack() as writers:
            for plan in plans:
                writers.enter_context(plan.writer)
                done.append(Conversion(plan, converter, target, workers, pool, steps))
                done[-1].run(metadata)
        failures = [failure for conversion in done for failure in conversion.failures]
        notes = [note for conversion in done for note in conversion.notes]
        if grids == "scans":
            regridding = Regridding(spec, observe, voting, follow_ground, force, workers, pool, steps)
            fitted, remarks = regridding.fit(done, sink.location)
            notes += remarks
            made = [regridding.run(conversion, fitted) for conversion in done]
    for result in made:
        notes += result.notes
        failures += [Failure(f.sequence, f.frame, f.message) for f in result.failures]
    return ConvertResult(
        tuple(plan.writer.location for plan in plans),
        sum(conversion.made for conversion in done),
        sum(len(plan.recording.frames) - len(plan.unfinished) for plan in plans),
        tuple(failures),
        tuple(path for result in made for path in result.grids),
        tuple(notes),
        time.perf_counter() - start,
    )


def _check(converter: type[Converter], **given: str) -> None:
    allowed: dict[str, tuple[str, ...]] = {
        "classes": ("carla", converter.classes.name),
        "axes": get_args(Axes),
        "grids": get_args(Grids),
        "split": get_args(SplitName),
        "poses": get_args(PoseSource),
        "flow": get_args(Flow),
    }
    for option, value in given.items():
        if value not in allowed[option]:
            raise ArgumentError(option, expected=f"one of {', '.join(allowed[option])}", found=repr(value))


def _check_grids(plan: RecordingPlan, grids: Grids) -> None:
    if grids == "scans" and not plan.recording.rays:
        raise ArgumentError(
            "grids",
            expected="voxels or none",
            found=f"scans for {plan.recording.location}",
            advice="nobody knows where its points were seen from, so free space cannot be told from unknown space",
        )


def _check_sink(source: Path, sink: Sink, grids: Grids) -> None:
    if isinstance(sink, FolderSink):
        check_outside(sink.folder, str(source))
    elif grids != "none":
        raise ArgumentError(
            "grids", expected=f"none with {sink.location}", found=grids, advice="convert to a folder, then pack it"
        )
