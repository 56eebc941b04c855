"""The run over a data set: it makes the grid of every frame, in parallel, and continues an
unfinished earlier run.
"""

from __future__ import annotations

import os
import time
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path

from carlasc.captures.raw import RAW, Capture, find_captures
from carlasc.core.frames import FrameRange, Frames
from carlasc.core.grids import GridSpec
from carlasc.errors import ArgumentError, MissingDataError
from carlasc.groundtruth.from_capture import capture_sequences
from carlasc.groundtruth.from_grid import resampled_sequences
from carlasc.groundtruth.from_scans.sequences import scan_sequences
from carlasc.groundtruth.inputs import GridPlan, SequenceInput
from carlasc.groundtruth.options import FromCapture, FromScans, Observe, Voting
from carlasc.groundtruth.seen import check_views
from carlasc.groundtruth.work import FrameFailure, SequenceJob, Work
from carlasc.running.processes import one_pool
from carlasc.running.spreading import Run
from carlasc.storage import as_source, layout
from carlasc.storage.files import parse_json, to_json
from carlasc.storage.opening import as_sink
from carlasc.storage.protocol import Source
from carlasc.storage.resuming import (
    RECORD,
    RECORD_FORMAT,
    agree_lines,
    agree_metadata,
    check_grid,
    check_name,
)
from carlasc.storage.sinks import Sink
from carlasc.storage.transport.targets import check_shared
from carlasc.storage.transport.trees import is_url

RULES = {"capture": 1, "scans": 3, "grid": 1}
"""Version of the rule that makes grids, by what observes the scene.

It changes only when the same input gives other grids.
"""


@dataclass(frozen=True)
class RegridResult:
    """The result of a run.

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


def regrid(
    source: str | os.PathLike[str] | Source | Capture,
    spec: GridSpec,
    out: str | os.PathLike[str] | Sink | None = None,
    *,
    observe: Observe | None = None,
    voting: Voting = Voting(),  # noqa: B008 (frozen)
    frames: Frames = None,
    name: str | None = None,
    overwrite: bool = False,
    run: Run = Run(),  # noqa: B008 (frozen)
) -> RegridResult:
    """Make the ground-truth grid of every frame, and write it with its scans, flow, poses and
    times, and a report of each grid.

    Frames that exist already are skipped. If they were made with other settings, the run stops
    before it writes anything. A frame that cannot be read is reported in the result, and the other
    frames are made. The work is done in processes that import the main module again: call this
    under `if __name__ == "__main__":` in scripts, or with `run=Run(workers=1)`.

    Args:
        source: a sequence's folder, a folder of several sequences, or, unless it holds captures,
            anything that `carlasc.open` takes; or a `carlasc.captures.Capture`, such as a
            `SimulatedCapture`, which is on no disk.
        spec: geometry of the grid.
        out: where to write: a folder or a `.zarr` store, on this machine or in an object store; or
            any Sink. Each sequence is written to its path below `source`, then `<coordinates>/`.
            None writes into `source`.
        observe: what observes the scene: `FromCapture()`: every sensor of a raw capture;
            `FromScans(...)`: one sensor's scans, merged over time; `FromGrid(...)`: an existing
            finer grid. None: `FromCapture()` if there is a capture, otherwise `FromScans()`.
        voting: how votes are counted.
        frames: range of the source's frame numbers; None for all. A capture's frames are renumbered
            from 0.
        name: name of the grid's folder. None: a name with its size.
        overwrite: replace what an earlier run with other settings wrote.
        run: how the work is spread, whether this is only a part of it, and what shows its progress.
            The last part to finish writes the report, and finishes a packed store.

    Returns:
        The frames that were made, that existed already, and that failed.

    Raises:
        ArgumentError: an argument is not valid.
        MissingDataError: there is no sequence, or no frame.
        ConflictError: the output is published data, or has other settings or other scans. Nothing
            in it is changed.
        StorageError: the disk is full or the output cannot be written to. Files that were written
            are complete.
    """
    start = time.perf_counter()
    run.part.refuse(overwrite)
    grid = layout.grid_folder(spec) if name is None else check_name(name)
    sink = as_sink(_folder_of(source) if out is None else out, part=run.part)
    for place in (sink.location, str(source)):
        check_shared(place, run)
    plan = GridPlan(
        spec, grid, _choose(source) if observe is None else observe, voting, FrameRange.of(frames)
    )
    jobs = [
        _prepare(inputs, sink, plan, overwrite=overwrite) for inputs in _sequences(source, plan)
    ]

    with ExitStack() as open_things:
        pool = open_things.enter_context(one_pool(run))
        for job in jobs:
            _begin(job)
            job.announce()
            open_things.enter_context(job.writer)
        work = Work(jobs, plan, pool)
        failures = work.run()
    # the caller may write more into its own sink
    if sink is not out and (work.has_written or not sink.is_finished):
        if run.part.count == 1:
            sink.finish(incomplete=True)  # missing frames could not be made, and are reported
        elif not any(job.missing() for job in jobs):
            sink.finish()

    grids = tuple(sink.place(f"{job.path}/{grid}") for job in jobs)
    notes = tuple(note for job in jobs for note in job.inputs.notes())
    made = work.wanted - len(failures)
    return RegridResult(
        grids, spec, made, work.skipped, tuple(failures), time.perf_counter() - start, notes
    )


def _choose(source: str | os.PathLike[str] | Source | Capture) -> Observe:
    """Return the default of `observe`: a capture if there is one, otherwise scans.

    Raises:
        MissingDataError: there is neither.
    """
    if isinstance(source, Capture):
        return FromCapture()
    if not isinstance(source, Source):
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
            expected="a capture (a folder raw/ with velodyne0/, labels0/, ...) or sequences with "
            "scans (velodyne/, poses.txt, ...)",
            found="neither",
            advice="give a sequence's folder, or a folder of sequences",
        ) from error
    return FromScans()


def _sequences(
    source: str | os.PathLike[str] | Source | Capture, plan: GridPlan
) -> list[SequenceInput]:
    """Return the sequences of a source.

    Raises:
        ArgumentError: the source does not fit `observe` or the plan.
        MissingDataError: there is no sequence.
    """
    if isinstance(plan.observe, FromCapture):
        return capture_sequences(source, plan)
    if isinstance(source, Capture):
        raise ArgumentError(
            "observe", expected="FromCapture() with a capture", found=repr(plan.observe)
        )
    if isinstance(plan.observe, FromScans):
        return scan_sequences(source, plan, plan.observe)
    return resampled_sequences(source, plan, plan.observe)


def _folder_of(source: str | os.PathLike[str] | Source | Capture) -> str | Path:
    """Return the default of `out`: the source, beside raw/ and `<coordinates>/`.

    Raises:
        ArgumentError: the source is not a folder.
    """
    if isinstance(source, Source | Capture):
        raise ArgumentError(
            "out", expected="where to write, as the source is not a folder", found="None"
        )
    if is_url(source):
        above, _, name = str(source).rstrip("/").rpartition("/")
        return above if name in (RAW, *layout.COORDINATES) else str(source)
    folder = Path(source)
    if not folder.is_dir() and folder.exists():
        raise ArgumentError("out", expected=f"where to write, as {source} is a file", found="None")
    return (
        folder.resolve().parent if folder.resolve().name in (RAW, *layout.COORDINATES) else folder
    )


def _prepare(inputs: SequenceInput, sink: Sink, plan: GridPlan, *, overwrite: bool) -> SequenceJob:
    """Compare the existing output with the plan of this run; if they differ, stop before anything
    is written.
    """
    path = "/".join(part for part in (inputs.path, plan.spec.coordinates) if part)
    writer = sink.sequence(path)
    how = {"free_step_m": float(plan.voting.free_step_m), "voting": plan.rule}
    how |= (
        {"min_confidence": float(plan.voting.min_confidence)} if plan.voting.min_confidence else {}
    )
    made_from = inputs.record()
    record = {"format": RECORD_FORMAT, "rule": RULES[made_from["observe"]], **made_from, **how}
    cameras = inputs.cameras()
    if plan.voting.keep_seen:
        check_views(plan.spec, inputs.frames[0].views(), inputs.location)
    record |= {"labels": inputs.metadata.predicted} if inputs.metadata.predicted else {}
    settings = plan.spec.to_params(inputs.metadata.classes.num_channels) | {RECORD: record}
    params = parse_json(to_json(settings), plan.grid)  # as a later run reads it
    numbers = [frame.number for frame in inputs.frames]
    exists = check_grid(writer, plan.grid, params, numbers, overwrite=overwrite)
    documents = {
        layout.METADATA: agree_metadata(writer, inputs.metadata),
        layout.POSES: agree_lines(writer, layout.POSES, inputs.poses()),
        layout.TIMES: agree_lines(writer, layout.TIMES, inputs.times()),
        layout.CAMERAS: None if cameras == writer.read_document(layout.CAMERAS) else cameras,
        layout.params_file(plan.grid): to_json(params),
    }
    needed = {name: data for name, data in documents.items() if data is not None}
    return SequenceJob(path, inputs, plan, writer, needed, params, replaces=exists and overwrite)


def _begin(job: SequenceJob) -> None:
    """Write the documents of a sequence, the settings of its grid first: a run with other settings
    that began at the same time finds them.

    Raises:
        ConflictError: such a run wrote its settings first.
    """
    writer, params = job.writer, layout.params_file(job.plan.grid)
    if job.replaces:
        writer.remove_grid(job.plan.grid)
    if not writer.create_document(params, job.documents[params]):
        check_grid(writer, job.plan.grid, job.params, (), overwrite=False)
    for document, data in job.documents.items():
        if document != params:
            writer.write_document(document, data)
