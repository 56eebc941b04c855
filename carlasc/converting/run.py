"""`convert`: every recording of another data set becomes a sequence of the layout. Frames are converted in parallel."""

from __future__ import annotations

import os
import time
from collections.abc import Collection, Sequence
from concurrent.futures import Executor
from contextlib import ExitStack, closing
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Literal, get_args

from carlasc.converting.frames import Block, FrameJob, Target, Velocity, convert_block, write_fields
from carlasc.converting.places import check_outside
from carlasc.converting.plans import (
    RecordingPlan,
    SplitName,
    check_voxel_grid,
    choose_recordings,
    plan_recording,
    write_documents,
)
from carlasc.converting.protocol import Converter
from carlasc.converting.registry import load_converter
from carlasc.converting.results import ConvertResult, Failure, Progress, Steps
from carlasc.converting.trajectory import PoseSource
from carlasc.core.grids import GridSpec
from carlasc.errors import ArgumentError
from carlasc.running.processes import count_workers, run_all
from carlasc.storage.folders.folder import FolderSink
from carlasc.storage.metadata import Axes, Metadata
from carlasc.storage.protocol import Sink

if TYPE_CHECKING:
    from carlasc.groundtruth.options import FromScans, Voting

Grids = Literal["scans", "voxels", "none"]
Flow = Literal["instances", "none"]

_BLOCK = 8  # frames that a worker converts in one task


def convert(
    name: str,
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
    poses: PoseSource = "auto",
    flow: Flow = "instances",
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
        name: the converter: "kitti", "poss", or one of another distribution (see `converter_names`).
        source: folder of the data set, or of one of its sequences.
        out: folder to write to, or any Sink (then without grids).
        sequences: which ones, by the last part of their names ("00"); None converts all.
        split: "train", "val" or "test": only sequences of this split; "all" converts every split.
        classes: "carla" maps class ids to CarlaSC's; the name of the data set's own class table ("semantickitti") keeps its ids.
        axes: "left" mirrors y into CarlaSC's left-handed axes; "right" keeps the right-handed ones.
        grids: "scans" makes grids from scans merged over time; "voxels" takes the data set's own voxels, with count 0 where
            they are unknown; "none" writes no grids.
        spec: with "scans": the grid; None takes the published coarse one.
        observe: with "scans": which scans are merged, and how moving points are treated.
        voting: with "scans": how votes are counted.
        poses: "file", "kiss-icp" (estimated from the scans), or "auto": the file where it exists, else estimated.
        flow: "instances" estimates the velocity of every moving actor from its points; "none" writes no flow. Without labels no
            flow is written.
        allow_unknown: treat class ids that the table does not have as unlabelled.
        force: accept poses under which the scans do not overlap, or whose calibration is missing.
        workers: number of frames that are converted at the same time; None uses all cores.
        executor: runs the work instead of processes of our own; it is not shut down.
        progress: called with the number of finished steps and the number of all steps.

    Returns:
        What was written, what was skipped, and what failed.

    Raises:
        ArgumentError: an argument has a wrong value, or no converter has that name.
        MissingDataError: a sequence or the poses do not exist.
        FormatError: poses or times do not fit the frames, or the scans.
        ConflictError: `out` lies inside `source`, or holds other data.
        StorageError: the output cannot be written. The files written so far are complete.
    """
    start, workers = time.perf_counter(), count_workers(workers)
    converter = load_converter(name)
    _check(name, converter, classes=classes, axes=axes, grids=grids, split=split, poses=poses, flow=flow)
    root = Path(source)
    sink = out if isinstance(out, Sink) else FolderSink(out)
    _check_sink(root, sink, grids)
    recordings = choose_recordings(converter(root).sequences(), root, sequences, split)
    target = Target(
        converter.classes,
        converter.to_carla if classes == "carla" else None,
        mirrored=axes == "left",
        allow_unknown=allow_unknown,
        voxels=converter.voxels if grids == "voxels" else None,
    )
    metadata = Metadata(
        axes,
        target.classes,
        converter.sensor,
        converter.min_range_m,
        converter.max_range_m,
        f"{name} {root.name}",
    )

    plans = [
        plan_recording(recording, converter, sink, poses, flow=flow == "instances", force=force)
        for recording in recordings
    ]
    for plan in plans:
        check_voxel_grid(plan, target)
    steps = Steps(progress, sum(len(plan.recording.frames) for plan in plans))
    failures, notes, made = [], [], 0
    with ExitStack() as writers:
        for plan in plans:
            writers.enter_context(plan.writer)
            write_documents(plan, target, converter, metadata, steps)
            velocities = _actor_velocities(plan, target, workers, executor, steps)
            without_flow = 0
            blocks = _blocks(plan, target, velocities)
            steps(len(plan.recording.frames) - sum(len(block.jobs) for block in blocks))
            with closing(run_all(convert_block, blocks, workers=workers, executor=executor)) as results:
                for result in results:
                    for number, outputs in result.outputs.items():
                        write_fields(plan.writer, number, outputs)
                    failures += [Failure(plan.recording.location, *failure) for failure in result.failures]
                    without_flow += result.without_flow
                    steps(len(result.block.jobs))
            failed = {f.frame for f in failures if f.sequence == plan.recording.location}
            made += sum(plan.recording.frames[i].number not in failed for i in plan.missing)
            failures += [Failure(plan.recording.location, *problem) for problem in plan.recording.problems()]
            notes += _notes(plan, without_flow)
    grid_paths, more = (
        _regrid(plans, spec, observe, voting, force, workers, executor, steps, failures)
        if grids == "scans"
        else ((), [])
    )
    return ConvertResult(
        tuple(plan.writer.location for plan in plans),
        made,
        sum(len(plan.recording.frames) - len(plan.missing) for plan in plans),
        tuple(failures),
        grid_paths,
        tuple(notes + more),
        time.perf_counter() - start,
    )


def _check(name: str, converter: type[Converter], **given: str) -> None:
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
    if given["grids"] == "voxels" and converter.voxels is None:
        raise ArgumentError(
            "grids",
            expected="scans or none",
            found="voxels",
            advice=f"the data set {name} has no voxel grids of its own",
        )


def _check_sink(source: Path, sink: Sink, grids: Grids) -> None:
    if isinstance(sink, FolderSink):
        check_outside(sink.folder, str(source))
    elif grids != "none":
        raise ArgumentError(
            "grids", expected=f"none with {sink.location}", found=grids, advice="convert to a folder, then pack it"
        )


def _actor_velocities(
    plan: RecordingPlan, target: Target, workers: int, executor: Executor | None, steps: Steps
) -> dict[int, dict[int, Velocity]] | None:
    """Return the velocity of each moving actor by frame and actor; None where no flow is written."""
    if "flow" not in plan.fields:
        return None
    if not plan.missing:
        return {}
    from carlasc.converting.actors import estimate_actor_velocities

    assert plan.poses is not None
    return estimate_actor_velocities(
        plan.recording, plan.poses, plan.times, target.source, workers=workers, executor=executor, steps=steps
    )


def _blocks(plan: RecordingPlan, target: Target, velocities: dict[int, dict[int, Velocity]] | None) -> list[Block]:
    """Return the frames to convert: those that lack a field, or all frames where each may have voxels."""
    missing = set(plan.missing)
    jobs = [
        FrameJob(handle, index in missing, None if velocities is None else velocities.get(handle.number, {}))
        for index, handle in enumerate(plan.recording.frames)
        if index in missing or target.voxels is not None
    ]
    return [Block(tuple(jobs[i : i + _BLOCK]), target, plan.writer) for i in range(0, len(jobs), _BLOCK)]


def _notes(plan: RecordingPlan, without_flow: int) -> list[str]:
    notes, where = [], plan.writer.location
    if not plan.recording.has_labels:
        notes.append(f"{where}: scans have no labels, so neither labels nor instances nor flow were written")
    if without_flow:
        notes.append(
            f"{where}: {without_flow} moving points belong to no numbered actor; their flow is unknown and set to 0"
        )
    gaps = plan.recording.frames[-1].number + 1 - len(plan.recording.frames)
    if gaps:
        notes.append(f"{where}: {gaps} of {gaps + len(plan.recording.frames)} frames have no scan")
    return notes


def _regrid(
    plans: Sequence[RecordingPlan],
    spec: GridSpec | None,
    observe: FromScans | None,
    voting: Voting | None,
    force: bool,
    workers: int,
    executor: Executor | None,
    steps: Steps,
    failures: list[Failure],
) -> tuple[tuple[str, ...], list[str]]:
    """Make grids from the converted scans: each frame's grid from the scans around it in time."""
    from carlasc.groundtruth import FromScans, Voting, regrid

    paths: list[str] = []
    notes: list[str] = []
    for plan in plans:
        folder = Path(plan.writer.location)
        last = 0
        steps.expect(len(plan.recording.frames))

        def advance(done: int, total: int) -> None:
            nonlocal last
            steps(done - last)
            last = done

        result = regrid(
            folder,
            spec or GridSpec.published(),
            folder.parent,
            observe=replace(observe or FromScans(), force=force),
            voting=voting or Voting(),
            workers=workers,
            executor=executor,
            progress=advance,
        )
        paths += result.grids
        notes += result.notes
        failures += [Failure(f.sequence, f.frame, f.message) for f in result.failures]
    return tuple(paths), notes
