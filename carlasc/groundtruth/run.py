"""The run over a data set: it makes the grid of every frame, in parallel, and continues what an earlier run left unfinished."""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from concurrent.futures import Executor
from contextlib import ExitStack, closing
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from numpy.typing import NDArray

from carlasc.captures.raw import RAW, find_captures
from carlasc.core.frames import FrameRange, Frames
from carlasc.core.grids import GridSpec
from carlasc.errors import ArgumentError, CarlascError, ConflictError, MissingDataError, StorageError
from carlasc.groundtruth.from_capture import capture_sequences
from carlasc.groundtruth.from_grid import resampled_sequences
from carlasc.groundtruth.from_scans.sequences import scan_sequences
from carlasc.groundtruth.inputs import FrameInput, Plan, SequenceInput
from carlasc.groundtruth.options import FromCapture, FromGrid, FromScans, Observe, Voting
from carlasc.running.processes import count_workers, run_all
from carlasc.storage import as_source, layout
from carlasc.storage.files import to_json
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
    check_scan,
)

RULE = 1
"""Version of the rule by which grids are made. It changes only when the same input gives other grids."""

Outputs = dict[str, NDArray[Any]]


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
    replaces: bool


@dataclass(frozen=True)
class _Task:
    """One frame of one job. It holds paths and settings, and pickles into a worker."""

    job: int
    frame: FrameInput
    plan: Plan
    writer: SequenceWriter


@dataclass(frozen=True)
class _Done:
    """The result of a task: its outputs if the writer cannot write in workers, its error if it failed."""

    task: _Task
    outputs: Outputs = field(default_factory=dict)
    error: str | None = None


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
    """Make the ground-truth grid of every frame, and write it with its scans, flow, poses and times.

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

    with ExitStack() as writers:
        for job in jobs:
            _begin(job, grid)
            writers.enter_context(job.writer)
        tasks = _unfinished(jobs, plan)
        total = sum(len(job.inputs.frames) for job in jobs)
        skipped, failures = total - len(tasks), []
        if progress:
            progress(skipped, total)
        with closing(run_all(_run_task, tasks, workers=workers, executor=executor)) as results:
            for number, done in enumerate(results, skipped + 1):
                job = jobs[done.task.job]
                if done.error is not None:
                    failures.append(FrameFailure(job.inputs.location, done.task.frame.source_frame, done.error))
                _write(job.writer, done.task.frame.number, done.outputs)
                if progress:
                    progress(number, total)

    grids = tuple(f"{job.writer.location}/{grid}" for job in jobs)
    made = len(tasks) - len(failures)
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
    record = {"format": RECORD_FORMAT, "rule": RULE, **inputs.record(), **how}
    params = plan.spec.to_params(inputs.metadata.classes.num_channels) | {RECORD: record}
    numbers = [frame.number for frame in inputs.frames]
    exists = check_grid(writer, plan.grid, params, numbers, overwrite=overwrite)
    documents = {
        layout.METADATA: agree_metadata(writer, inputs.metadata),
        layout.POSES: None if (poses := inputs.poses()) is None else agree_poses(writer, poses),
        layout.TIMES: None if (times := inputs.times()) is None else agree_times(writer, times),
        layout.params_file(plan.grid): to_json(params),
    }
    needed = {name: data for name, data in documents.items() if data is not None}
    return _Job(inputs, writer, needed, replaces=exists and overwrite)


def _begin(job: _Job, grid: str) -> None:
    """Write the documents of a sequence."""
    if job.replaces:
        job.writer.remove_grid(grid)
    for document, data in job.documents.items():
        job.writer.write_document(document, data)


def _unfinished(jobs: list[_Job], plan: Plan) -> list[_Task]:
    """Return a task for each frame that lacks a file."""
    return [
        _Task(index, frame, plan, job.writer)
        for index, job in enumerate(jobs)
        for frame in job.inputs.frames
        if not all(job.writer.has(name, frame.number) for name in (*frame.fields(), *plan.fields()))
    ]


def _run_task(task: _Task) -> _Done:
    """Make one frame, in a worker, and write it there if its writer can."""
    try:
        outputs = _make(task.frame, task.plan)
        if not task.writer.concurrent:
            return _Done(task, outputs)
        _write(task.writer, task.frame.number, outputs)
    except (ConflictError, StorageError):
        raise  # every other frame would raise the same
    except MemoryError as error:
        raise CarlascError(
            str(task.plan.spec), problem="out of memory", advice="use a coarser grid, or fewer processes (`workers`)"
        ) from error
    except (CarlascError, OSError) as error:
        return _Done(task, error=str(error))
    return _Done(task)


def _make(frame: FrameInput, plan: Plan) -> Outputs:
    """Make everything that is written for a frame, the grid last."""
    data = frame.make(plan)
    outputs: Outputs = {**data.fields, f"{plan.grid}/labels": data.grid.labels}
    if data.grid.counts is not None:
        outputs[f"{plan.grid}/counts"] = data.grid.counts
    if plan.voting.keep and data.votes is not None:
        outputs[f"{plan.grid}/votes"] = data.votes.to_sparse()
    return outputs


def _write(writer: SequenceWriter, frame: int, outputs: Outputs) -> None:
    """Write a frame's files. Scan fields that exist already must be equal to this run's."""
    for name, array in outputs.items():
        if name in layout.SCAN_FIELDS and writer.has(name, frame):
            check_scan(writer, name, frame, array)
        else:
            writer.write(name, frame, array)
