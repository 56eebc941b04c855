"""The run over a data set: it makes the grid of every frame, in parallel, and continues what an earlier run left unfinished."""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from concurrent.futures import Executor
from contextlib import ExitStack, closing
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from carlasc.captures.raw import RAW, find_captures
from carlasc.core.frames import FrameRange, Frames
from carlasc.core.grids import GridSpec
from carlasc.errors import ArgumentError, FormatError, MissingDataError
from carlasc.groundtruth.from_capture import capture_sequences
from carlasc.groundtruth.from_grid import resampled_sequences
from carlasc.groundtruth.from_scans.sequences import scan_sequences
from carlasc.groundtruth.inputs import Plan, SequenceInput, Steps
from carlasc.groundtruth.options import FromCapture, FromGrid, FromScans, Observe, Voting
from carlasc.groundtruth.reporting.facts import sample_frames
from carlasc.groundtruth.reporting.report import Report
from carlasc.groundtruth.tasks import Done, MakeFrame, MeasureFrame, Task, run_task, write_frame
from carlasc.running.processes import count_workers, one_pool, run_all
from carlasc.storage import as_source, layout
from carlasc.storage.files import parse_json, to_json
from carlasc.storage.folders.folder import FolderSink
from carlasc.storage.protocol import SequenceWriter, Sink, Source
from carlasc.storage.resuming import (
    RECORD,
    RECORD_FORMAT,
    agree_metadata,
    agree_poses,
    agree_times,
    check_grid,
    check_name,
)

RULES = {"capture": 1, "scans": 2, "grid": 1}
"""Version of the rule by which grids are made, by what observes the scene. It changes only when the same input gives other grids."""


@dataclass(frozen=True)
class FrameFailure:
    """A frame that could not be made.

    Attributes:
        sequence: location of its sequence in the source.
        frame: its number in the source.
        message: what went wrong, in one line.
    """

    sequence: str
    frame: int
    message: str


@dataclass(frozen=True)
class RegridResult:
    """What a run did.

    Attributes:
        grids: locations of the grids.
        spec: their geometry.
        made: number of frames that this run made.
        skipped: number of frames that existed already.
        failures: frames that could not be made.
        elapsed_s: duration of the run, in seconds.
        notes: remarks about how the grids were made, one line each.
    """

    grids: tuple[str, ...]
    spec: GridSpec
    made: int
    skipped: int
    failures: tuple[FrameFailure, ...]
    elapsed_s: float
    notes: tuple[str, ...] = ()


@dataclass(frozen=True)
class _Job:
    """What this run does with one sequence: where it goes, and the documents to write first."""

    inputs: SequenceInput
    writer: SequenceWriter
    documents: dict[str, bytes]
    params: dict[str, Any]
    replaces: bool


def regrid(
    source: str | os.PathLike[str] | Source,
    spec: GridSpec,
    out: str | os.PathLike[str] | Sink | None = None,
    *,
    observe: Observe | None = None,
    voting: Voting = Voting(),  # noqa: B008 (frozen)
    frames: Frames = None,
    name: str | None = None,
    overwrite: bool = False,
    workers: int | None = None,
    executor: Executor | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> RegridResult:
    """Make the ground-truth grid of every frame, and write it with its scans, flow, poses and times, and a report of each grid.

    Frames that exist already are skipped. If they were made with other settings, the run stops before it writes anything. A frame that
    cannot be read is reported in the result, and the other frames are made. The work is done in processes that import the main
    module again: call this under `if __name__ == "__main__":` in scripts, or with `workers=1`.

    Args:
        source: a sequence's folder, a folder of several sequences, or, unless it holds captures, anything that `carlasc.open` takes.
        spec: geometry of the grid.
        out: where to write: a folder, or any Sink. Each sequence is written to its path below `source`, then `<coordinates>/`. None
            writes into `source`.
        observe: what observes the scene: `FromCapture()`: every sensor of a raw capture; `FromScans(...)`: one sensor's scans,
            merged over time; `FromGrid(...)`: an existing finer grid. None: `FromCapture()` if there is a capture, otherwise
            `FromScans()`.
        voting: how votes are counted.
        frames: range of the source's frame numbers; None for all. A capture's frames are renumbered from 0.
        name: name of the grid's folder; None for a name by its size.
        overwrite: replace a grid that `regrid` made with other settings.
        workers: number of frames that are made in parallel; None for one per core. With an executor: the number of its workers.
        executor: runs the work instead of processes of our own; it is not shut down.
        progress: called with the number of finished frames and the number of all frames.

    Returns:
        What was made, what existed already, and what failed.

    Raises:
        ArgumentError: an argument is not valid.
        MissingDataError: there is no sequence, or no frame.
        ConflictError: the output is published data, or has other settings or other scans. Nothing in it is changed.
        StorageError: the disk is full or the output cannot be written to. Files that were written are complete.
    """
    start, workers = time.perf_counter(), count_workers(workers)
    grid = layout.grid_folder(spec) if name is None else check_name(name)
    sink = out if isinstance(out, Sink) else FolderSink(_folder_of(source) if out is None else out)
    plan = Plan(spec, grid, _choose(source) if observe is None else observe, voting, FrameRange.of(frames))
    jobs = [_prepare(inputs, sink, plan, overwrite=overwrite) for inputs in _sequences(source, plan)]

    with ExitStack() as open_things:
        pool = open_things.enter_context(one_pool(workers, executor))
        for job in jobs:
            _begin(job, grid)
            open_things.enter_context(job.writer)
        tasks = [_tasks(number, job, plan) for number, job in enumerate(jobs)]
        total = sum(len(job.inputs.frames) for job in jobs)
        unfinished = sum(len(missing) for missing, _ in tasks)
        skipped, failures = total - unfinished, list[FrameFailure]()
        passes = sum(job.inputs.steps_before for job, parts in zip(jobs, tasks, strict=True) if any(parts))
        steps = Steps(progress, skipped, total + passes)
        for job, (missing, existing) in zip(jobs, tasks, strict=True):
            if missing or existing:
                job.inputs.prepare(job.writer, workers=workers, executor=pool, progress=steps)
            parts: list[Done] = []
            with closing(run_all(run_task, [*missing, *existing], workers=workers, executor=pool)) as results:
                for done in results:
                    if isinstance(done.task, MakeFrame):
                        if done.error is not None:
                            frame = done.task.frame.source_frame
                            failures.append(FrameFailure(job.inputs.location, frame, done.error))
                        write_frame(job.writer, done.task.frame.number, done.outputs)
                        steps(1)
                    parts.append(replace(done, outputs={}))
            _write_report(job, plan, parts)

    grids = tuple(f"{job.writer.location}/{grid}" for job in jobs)
    made = unfinished - len(failures)
    notes = tuple(note for job in jobs for note in job.inputs.notes())
    return RegridResult(grids, spec, made, skipped, tuple(failures), time.perf_counter() - start, notes)


def _choose(source: str | os.PathLike[str] | Source) -> Observe:
    """Return what observes the scene if the caller does not say: a capture if there is one, otherwise scans.

    Raises:
        MissingDataError: there is neither.
    """
    if not isinstance(source, Source) and Path(source).is_dir():
        try:
            find_captures(source)
        except MissingDataError:
            pass
        else:
            return FromCapture()
    opened = as_source(source)
    try:
        opened.sequences()
    except MissingDataError as error:
        raise MissingDataError(
            source,
            expected="a capture (a folder raw/ with velodyne0/, labels0/, ...) or sequences with scans (velodyne/, poses.txt, ...)",
            found="neither",
            advice="give a sequence's folder, or a folder of sequences",
        ) from error
    return FromScans()


def _sequences(source: str | os.PathLike[str] | Source, plan: Plan) -> list[SequenceInput]:
    """Return the sequences of a source.

    Raises:
        ArgumentError: the source cannot hold what observes the scene, or the plan does not fit it.
        MissingDataError: there is no sequence.
    """
    match plan.observe:
        case FromCapture():
            return capture_sequences(source, plan)
        case FromScans():
            return scan_sequences(source, plan, plan.observe)
        case FromGrid():
            return resampled_sequences(source, plan, plan.observe)


def _folder_of(source: str | os.PathLike[str] | Source) -> Path:
    """Return the folder to write to if the caller does not say: the source, beside raw/ and `<coordinates>/`.

    Raises:
        ArgumentError: the source is not a folder, so nothing can be written into it.
    """
    if isinstance(source, Source):
        raise ArgumentError("out", expected="where to write, as the source is not a folder", found="None")
    folder = Path(source)
    if not folder.is_dir() and folder.exists():
        raise ArgumentError("out", expected=f"where to write, as {source} is a file", found="None")
    return folder.resolve().parent if folder.resolve().name in (RAW, *layout.COORDINATES) else folder


def _prepare(inputs: SequenceInput, sink: Sink, plan: Plan, *, overwrite: bool) -> _Job:
    """Compare what exists with what this run makes, and stop before anything is written if they do not agree."""
    writer = sink.sequence("/".join(part for part in (inputs.path, plan.spec.coordinates) if part))
    how = {"free_step_m": float(plan.voting.free_step_m), "voting": plan.rule}
    how |= {"min_confidence": float(plan.voting.min_confidence)} if plan.voting.min_confidence else {}
    made_from = inputs.record()
    record = {"format": RECORD_FORMAT, "rule": RULES[made_from["observe"]], **made_from, **how}
    settings = plan.spec.to_params(inputs.metadata.classes.num_channels) | {RECORD: record}
    params = parse_json(to_json(settings), plan.grid)  # as it is read again
    numbers = [frame.number for frame in inputs.frames]
    exists = check_grid(writer, plan.grid, params, numbers, overwrite=overwrite)
    documents = {
        layout.METADATA: agree_metadata(writer, inputs.metadata),
        layout.POSES: None if (poses := inputs.poses()) is None else agree_poses(writer, poses),
        layout.TIMES: None if (times := inputs.times()) is None else agree_times(writer, times),
        layout.params_file(plan.grid): to_json(params),
    }
    needed = {name: data for name, data in documents.items() if data is not None}
    return _Job(inputs, writer, needed, params, replaces=exists and overwrite)


def _begin(job: _Job, grid: str) -> None:
    """Write the documents of a sequence."""
    if job.replaces:
        job.writer.remove_grid(grid)
    for document, data in job.documents.items():
        job.writer.write_document(document, data)


def _tasks(number: int, job: _Job, plan: Plan) -> tuple[list[Task], list[Task]]:
    """Return the tasks of a sequence: to make each frame that lacks a file, and to measure for the report what exists.

    Nothing is measured if nothing is made and the report is complete.
    """
    inputs, writer, classes = job.inputs, job.writer, job.inputs.metadata.classes
    report = _report_of(job, plan.grid)
    reported = set() if report is None else set(report.frames)
    needed = {frame.number: (*frame.fields(), *plan.fields()) for frame in inputs.frames}
    missing = {n for n, fields in needed.items() if not all(writer.has(name, n) for name in fields)}
    existing = (needed.keys() | reported) - missing
    if not missing and existing == reported:
        return [], []
    sampled = sample_frames(sorted(existing | missing))
    made: list[Task] = [
        MakeFrame(number, frame, plan, writer, classes, frame.number in sampled)
        for frame in inputs.frames
        if frame.number in missing
    ]
    measured: list[Task] = [
        MeasureFrame(number, other, inputs.frame(other), plan, writer, classes, other in sampled)
        for other in sorted(existing)
    ]
    return made, measured


def _report_of(job: _Job, grid: str) -> Report | None:
    """Return the report that an earlier run with the same settings left; None if there is none."""
    data = job.writer.read_document(layout.report_file(grid))
    try:
        report = None if data is None else Report.from_json(data, layout.report_file(grid))
    except FormatError:
        return None
    return report if report is not None and report.settings == job.params else None


def _write_report(job: _Job, plan: Plan, results: list[Done]) -> None:
    """Write the report of a sequence's grid, if anything was made or measured."""
    facts = [done.facts for done in results if done.facts is not None]
    names = (layout.POSES, layout.TIMES, layout.METADATA, layout.params_file(plan.grid))
    found = {name: job.writer.read_document(name) for name in names}
    documents = {name: data for name, data in found.items() if data is not None}
    if facts:
        report = Report.make(
            plan.grid, facts, job.params, job.inputs.metadata.classes, documents, actors=job.inputs.summaries()
        )
        job.writer.write_document(layout.report_file(plan.grid), report.to_json())
