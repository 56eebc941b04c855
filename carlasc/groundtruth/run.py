"""A run over a data set: from observations to grids, frame by frame, side by side, again and again until all is there."""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from concurrent.futures import Executor
from contextlib import ExitStack, closing
from dataclasses import dataclass, field
from typing import Any

from numpy.typing import NDArray

import carlasc
from carlasc.core.grids import GridSpec
from carlasc.errors import CarlascError, ConflictError, StorageError
from carlasc.groundtruth.from_scans.windows import Merging
from carlasc.groundtruth.inputs import FrameInputs, FrameRange, Recipe, SequenceInputs, check_frames, default_sink
from carlasc.groundtruth.providers import Observations, find_inputs
from carlasc.groundtruth.voting.ballot import Ballot, VoteRule
from carlasc.running.processes import count_workers, run_all
from carlasc.storage import layout
from carlasc.storage.files import to_json
from carlasc.storage.folders.folder import FolderSink
from carlasc.storage.protocol import SequenceWriter, Sink
from carlasc.storage.resuming import (
    RECORD,
    agree_metadata,
    agree_poses,
    agree_times,
    check_grid,
    check_name,
    check_scan,
)

Outputs = dict[str, NDArray[Any]]


@dataclass(frozen=True)
class FrameFailure:
    """A frame that could not be made.

    Attributes:
        sequence: where its source is.
        frame: its number in the source.
        message: what is wrong, in one line.
    """

    sequence: str
    frame: int
    message: str


@dataclass(frozen=True)
class RegridResult:
    """What a run did.

    Attributes:
        grids: where the grids are.
        spec: their geometry.
        made: frames that were made now.
        skipped: frames that were there already.
        failures: frames that could not be made.
        elapsed_s: how long it took, seconds.
        notes: what the reader should know of how they were made.
    """

    grids: tuple[str, ...]
    spec: GridSpec
    made: int
    skipped: int
    failures: tuple[FrameFailure, ...]
    elapsed_s: float
    notes: tuple[str, ...] = ()


@dataclass(frozen=True)
class _Plan:
    """One sequence: what goes in, where to, and what is there."""

    inputs: SequenceInputs
    writer: SequenceWriter
    recipe: Recipe
    documents: dict[str, bytes]
    replaces: bool


@dataclass(frozen=True)
class _Task:
    """One frame of one sequence; pickles."""

    plan: int
    frame: FrameInputs
    recipe: Recipe
    writer: SequenceWriter


@dataclass(frozen=True)
class _Done:
    """What became of a task: its outputs where the writer cannot write in workers, its error where it failed."""

    task: _Task
    outputs: Outputs = field(default_factory=dict)
    error: str | None = None


def regrid(
    source: str | os.PathLike[str],
    sink: str | os.PathLike[str] | Sink | None,
    spec: GridSpec,
    *,
    observations: Observations | None = None,
    vote: VoteRule | None = None,
    free_step_m: float = 1.5,
    frames: FrameRange | None = None,
    name: str | None = None,
    keep_votes: bool = False,
    overwrite: bool = False,
    merging: Merging | None = None,
    from_grid: str | None = None,
    estimate_poses: bool = False,
    force: bool = False,
    workers: int | None = None,
    executor: Executor | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> RegridResult:
    """Make the ground-truth grid of every frame, and write it with its scans, flow, poses and times.

    A second run skips the frames that are there; one with other settings stops. A frame that cannot be read is reported in the
    result and the others go on. Work is done in processes that import the main module again: scripts call this under
    `if __name__ == "__main__":`, or with `workers=1`.

    Args:
        source: a sequence's folder, or a folder of several.
        sink: where to write: a folder, or any Sink. Each sequence goes to its path below `source`, then `<coordinates>/`. None writes
            into `source`.
        spec: the grid.
        observations: what votes: "capture": every sensor of a raw capture; "scans": the ego sensor's scans of other times;
            "grid": an existing finer grid. None takes the capture where there is one, else the scans.
        vote: "sensor": at most one vote a sensor (scan), voxel and class, as in the published files; "sample": every sample
            counts; "point": every point counts, free space once a scan. None: "sensor" for captures, "point" for scans.
        free_step_m: distance between free samples on a ray, metres.
        frames: half-open range of the source's frame numbers, None at an open end; all frames if None. A capture's frames
            are renumbered from 0.
        name: the grid's folder; by its size if None.
        keep_votes: also write the votes by class.
        overwrite: replace an earlier grid of ours that was made with other settings.
        merging: which scans are merged, and what becomes of moving points; the defaults if None. Only with scans.
        from_grid: name of the finer grid; the finest if None. Only with "grid".
        estimate_poses: take poses from KISS-ICP, not from poses.txt; they are written only where there are none. Only with scans.
        force: go on where poses jump.
        workers: how many frames are made side by side; all cores if None. With an executor: how many its workers are.
        executor: takes the frames instead of processes of our own; it is left open.
        progress: called with the number of finished frames and of all.

    Returns:
        What was made, what was there, what failed.

    Raises:
        ArgumentError: an argument makes no sense.
        MissingDataError: there is no sequence or no frame.
        ConflictError: what is there is published data, or of other settings, or of other scans: nothing of it is touched.
        StorageError: the disk is full or the output cannot be written to. What was written is whole.
    """
    start, workers = time.perf_counter(), count_workers(workers)
    sink = sink if isinstance(sink, Sink) else FolderSink(default_sink(source) if sink is None else sink)
    tiny = GridSpec(spec.coordinates, (1, 1, 1), spec.lower, spec.upper)
    Ballot(tiny, vote=vote or "sensor", free_step_m=free_step_m)  # checks them
    check_frames(frames)
    grid = layout.grid_folder(spec) if name is None else check_name(name)

    plans = []
    for inputs in find_inputs(
        source,
        observations,
        frames,
        spec,
        merging=merging,
        from_grid=from_grid,
        estimate_poses=estimate_poses,
        force=force,
    ):
        recipe = Recipe(spec, grid, inputs.metadata.classes, vote or inputs.vote, float(free_step_m), keep_votes)
        writer = sink.sequence("/".join(part for part in (inputs.path, spec.coordinates) if part))
        plans.append(_plan(inputs, writer, recipe, overwrite=overwrite))

    with ExitStack() as writers:
        for plan in plans:
            _begin(plan)
            writers.enter_context(plan.writer)
        tasks = _unfinished(plans)
        total = sum(len(plan.inputs.frames) for plan in plans)
        skipped, failures = total - len(tasks), []
        if progress:
            progress(skipped, total)
        with closing(run_all(_run_task, tasks, workers=workers, executor=executor)) as results:
            for number, done in enumerate(results, skipped + 1):
                plan = plans[done.task.plan]
                if done.error is not None:
                    failures.append(FrameFailure(plan.inputs.location, done.task.frame.source_frame, done.error))
                _write(plan.writer, done.task.frame.number, done.outputs)
                if progress:
                    progress(number, total)

    grids = tuple(f"{plan.writer.location}/{grid}" for plan in plans)
    made = len(tasks) - len(failures)
    notes = tuple(note for plan in plans for note in plan.inputs.notes())
    return RegridResult(grids, spec, made, skipped, tuple(failures), time.perf_counter() - start, notes)


def make_frame(frame: FrameInputs, recipe: Recipe) -> Outputs:
    """Make all that a frame's files hold."""
    data = frame.make(recipe)
    outputs: Outputs = {**data.fields, f"{recipe.grid}/labels": data.grid.labels}
    if data.grid.counts is not None:
        outputs[f"{recipe.grid}/counts"] = data.grid.counts
    if recipe.keep_votes and data.votes is not None:
        outputs[f"{recipe.grid}/votes"] = data.votes.to_sparse()
    return outputs


def _plan(inputs: SequenceInputs, writer: SequenceWriter, recipe: Recipe, *, overwrite: bool) -> _Plan:
    """Look at what is there, and stop before anything is written if this run may not go on with it."""
    record = {"version": carlasc.__version__, **inputs.record(), "free_step_m": recipe.free_step_m, "vote": recipe.vote}
    params = recipe.spec.to_params(recipe.classes.num_channels) | {RECORD: record}
    numbers = [frame.number for frame in inputs.frames]
    ours = check_grid(writer, recipe.grid, params, numbers, overwrite=overwrite)
    documents = {
        layout.METADATA: agree_metadata(writer, inputs.metadata),
        layout.POSES: None if (poses := inputs.poses()) is None else agree_poses(writer, poses),
        layout.TIMES: None if (times := inputs.times()) is None else agree_times(writer, times),
        layout.params_file(recipe.grid): to_json(params),
    }
    needed = {name: data for name, data in documents.items() if data is not None}
    return _Plan(inputs, writer, recipe, needed, replaces=ours and overwrite)


def _begin(plan: _Plan) -> None:
    """Write what a sequence has once."""
    if plan.replaces:
        plan.writer.remove_grid(plan.recipe.grid)
    for document, data in plan.documents.items():
        plan.writer.write_document(document, data)


def _unfinished(plans: list[_Plan]) -> list[_Task]:
    """Return a task for each frame that lacks a file."""
    return [
        _Task(index, frame, plan.recipe, plan.writer)
        for index, plan in enumerate(plans)
        for frame in plan.inputs.frames
        if not all(plan.writer.has(name, frame.number) for name in (*frame.fields(), *plan.recipe.fields()))
    ]


def _run_task(task: _Task) -> _Done:
    """Make one frame, in a worker, and write it there if its writer can."""
    try:
        outputs = make_frame(task.frame, task.recipe)
        if not task.writer.concurrent:
            return _Done(task, outputs)
        _write(task.writer, task.frame.number, outputs)
    except (ConflictError, StorageError):
        raise  # every other frame would meet the same
    except MemoryError as error:
        raise CarlascError(
            f"{task.recipe.spec}: out of memory: take a coarser grid, or fewer workers (`--workers`)"
        ) from error
    except (CarlascError, OSError) as error:
        return _Done(task, error=str(error))
    return _Done(task)


def _write(writer: SequenceWriter, frame: int, outputs: Outputs) -> None:
    """Write a frame's files, the grid's last; scans that are there must be the same."""
    for name, array in outputs.items():
        if name in layout.SCAN_FIELDS and writer.has(name, frame):
            check_scan(writer, name, frame, array)
        else:
            writer.write(name, frame, array)
