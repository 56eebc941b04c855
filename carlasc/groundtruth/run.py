"""The run over a data set: it makes the grid of every frame, in parallel, and continues an
unfinished earlier run. Each complete sequence gets a report.

A `FrameTask` pickles into a worker, where a frame is made, or an existing frame is measured.
"""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Iterator, Set
from collections.abc import Sequence as Series
from contextlib import ExitStack, closing
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import groupby
from pathlib import Path
from typing import Any

import numpy as np

from carlasc.captures.raw import RAW, Capture, find_captures
from carlasc.core.arrays import AnyArray
from carlasc.core.choices import CompareInputs
from carlasc.core.classes import ClassTable, TableUse
from carlasc.core.frames import FrameRange, Frames
from carlasc.core.grids import Grid, GridSpec, is_confident
from carlasc.errors import (
    ArgumentError,
    CarlascError,
    ConflictError,
    FormatError,
    MissingDataError,
    StorageError,
    check_choice,
    check_types,
    only,
    reading,
)
from carlasc.groundtruth.from_capture import capture_sequences
from carlasc.groundtruth.from_grid import resampled_sequences
from carlasc.groundtruth.from_scans.actor_voxels import with_numbers
from carlasc.groundtruth.from_scans.sequences import ScanSequence, scan_sequences
from carlasc.groundtruth.inputs import (
    FrameData,
    FrameInput,
    GridPlan,
    InputCheck,
    SequenceInput,
    StoredSequence,
)
from carlasc.groundtruth.options import FromCapture, FromScans, Observe, Voting
from carlasc.groundtruth.reporting import Changes, FrameFacts, Report, sample_frames
from carlasc.groundtruth.seen import check_views, see_voxels
from carlasc.motion.box_table import ONE_FRAME, check_box_file
from carlasc.running.processes import one_pool, run_all
from carlasc.running.spreading import Run, StepCounter, check_shared
from carlasc.storage import as_source, layout
from carlasc.storage.files import AnyPath, parse_json, to_json
from carlasc.storage.opening import as_sink
from carlasc.storage.protocol import SequenceWriter, Sink, Source
from carlasc.storage.resuming import (
    RECORD,
    RECORD_FORMAT,
    agree_lines,
    agree_metadata,
    check_grid,
    check_name,
    check_scan,
)
from carlasc.storage.shares import Share, source_in
from carlasc.storage.transport.trees import is_url

RULES = {"capture": 1, "scans": 5, "grid": 1}
"""Version of the rule that makes grids, by what observes the scene.

It changes only when the same input gives other grids.
"""
_TOGETHER = 64  # number of frames that a worker makes one after another, about


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
        source_classes: class tables by which sequences were read, and what named them.
    """

    grids: tuple[str, ...]
    spec: GridSpec
    made: int
    skipped: int
    failures: tuple[FrameFailure, ...]
    elapsed_s: float
    notes: tuple[str, ...] = ()
    source_classes: tuple[TableUse, ...] = ()


def regrid(
    source: AnyPath | Source | Capture,
    spec: GridSpec | str | float,
    out: AnyPath | Sink | None = None,
    *,
    observe: Observe | None = None,
    voting: Voting = Voting(),  # noqa: B008 (frozen)
    frames: Frames = None,
    name: str | None = None,
    overwrite: bool = False,
    compare_inputs: CompareInputs = "fast",
    boxes_out: AnyPath | None = None,
    run: Run = Run(),  # noqa: B008 (frozen)
) -> RegridResult:
    """Make the ground-truth grid of every frame, and write it with its scans, flow, poses and
    times, and a report of each grid.

    Frames that exist already are skipped, unless their scans, labels, poses or times changed since
    then: these are made again, and a note says why. If they were made with other settings, the run
    stops before it writes anything. A frame that cannot be read is reported in the result, and the
    other frames are made. The work is done in processes that import the main module again: call
    this under `if __name__ == "__main__":` in scripts, or with `run=Run(workers=1)`.

    Args:
        source: a sequence's folder, a folder of several sequences, or, unless it holds captures,
            anything that `carlasc.open` takes; or a `carlasc.captures.Capture`, such as a
            `SimulatedCapture`, which is on no disk.
        spec: geometry of the grid, or what `GridSpec.of` takes: "coarse", or 0.2 (metres).
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
        compare_inputs: how it is found out whether the inputs of existing frames changed: "fast":
            by the size and the time of each file, and by content where these differ; "content":
            by content; "never": existing frames are kept.
        boxes_out: .csv, .json or .parquet file of the boxes of the moving actors of one sequence,
            which is replaced: one row per actor and scan, in the frame of the poses, right-handed.
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
    check_types(regrid, locals())
    spec = GridSpec.of(spec)
    start = time.perf_counter()
    run.part.refuse(overwrite)
    check_choice("compare_inputs", compare_inputs, CompareInputs)
    grid = layout.grid_folder(spec) if name is None else check_name(name)
    sink = as_sink(_folder_of(source) if out is None else out, part=run.part)
    for place in (sink.location, str(source)):
        check_shared(place, run)
    share = None
    if run.is_share and not isinstance(source, Capture):
        share = Share(as_source(source), run)
    places, others = ([""], []) if share is None else (share.own, share.others)
    if observe is None:
        observe = _choose(source, share)
    plan = GridPlan(spec, grid, observe, voting, FrameRange.of(frames))
    found = list[SequenceInput]()
    try:
        found += _sequences(source, plan, places)
    except MissingDataError:
        if not others:
            raise
    merged = {one.path: one for one in found if isinstance(one, ScanSequence)}
    if boxes_out is not None:
        merged = {path: one for path, one in merged.items() if one.feed.needs_actors}
        only("boxes_out", merged, f"{ONE_FRAME}, whose scans show actors that move")
        check_box_file("boxes_out", Path(boxes_out))
    jobs = [_prepare(one, sink, plan, compare_inputs, overwrite=overwrite) for one in found]

    with ExitStack() as open_things:
        pool = open_things.enter_context(one_pool(run if share is None else share.run))
        for job in jobs:
            _begin(job)
            job.announce()
            open_things.enter_context(job.writer)
        work = Work(jobs, pool)
        failures = work.run()
        if boxes_out is not None:
            (one,) = merged.values()
            one.prepare(jobs[0].writer, pool, lambda steps: None)  # unless a grid needed it
            one.actors = with_numbers(one.actors, one.feed)
            one.box_table(one.feed.frames.tolist()).write(boxes_out)
    # the caller may write more into its own sink
    if sink is not out and (work.has_written or not sink.is_finished):
        if run.part.count == 1:
            sink.finish(incomplete=True)  # missing frames could not be made, and are reported
        elif not any(job.missing() for job in jobs) and all(
            _is_complete(source, plan, sink, place) for place in others
        ):
            sink.finish()

    grids = tuple(sink.place(f"{job.path}/{grid}") for job in jobs)
    notes = tuple(note for job in jobs for note in (*job.check.notes, *job.inputs.notes()))
    made = work.wanted - len(failures)
    took = time.perf_counter() - start
    stored = [job.inputs.sequence for job in jobs if isinstance(job.inputs, StoredSequence)]
    uses = tuple(sorted({sequence.table_use() for sequence in stored}))
    return RegridResult(grids, spec, made, work.skipped, tuple(failures), took, notes, uses)


def _is_complete(
    source: AnyPath | Source | Capture, plan: GridPlan, sink: Sink, place: str
) -> bool:
    """Whether another part has made the sequences of a folder."""
    try:
        found = _sequences(source, plan, [place])
    except MissingDataError:
        return True
    paths = [f"{one.path}/{plan.spec.coordinates}".lstrip("/") for one in found]
    return all(sink.sequence(path).is_complete() for path in paths)


def _choose(source: AnyPath | Source | Capture, share: Share | None) -> Observe:
    """Return the default of `observe`: a capture if there is one, otherwise scans. Parts look at
    their own sequences, and at the first one.

    Raises:
        MissingDataError: there is neither.
    """
    if isinstance(source, Capture):
        return FromCapture()
    if not isinstance(source, Source):
        try:
            find_captures(source, ("",) if share is None else [*share.own, share.first])
        except MissingDataError:
            pass
        else:
            return FromCapture()
    opened = as_source(source) if share is None else share
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
    source: AnyPath | Source | Capture, plan: GridPlan, places: Series[str]
) -> list[SequenceInput]:
    """Return the sequences of some places of a source: see `Source.places`.

    Raises:
        ArgumentError: the source does not fit `observe` or the plan.
        MissingDataError: there is no sequence.
    """
    if isinstance(plan.observe, FromCapture):
        return capture_sequences(source, plan, places)
    if isinstance(source, Capture):
        raise ArgumentError(
            "observe", expected="FromCapture() with a capture", found=repr(plan.observe)
        )
    opened = as_source(source)
    if [*places] != [""]:
        opened = source_in(opened, places)
    if isinstance(plan.observe, FromScans):
        return scan_sequences(opened, plan, plan.observe)
    return resampled_sequences(opened, plan, plan.observe)


def _folder_of(source: AnyPath | Source | Capture) -> str | Path:
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


def _prepare(
    inputs: SequenceInput, sink: Sink, plan: GridPlan, compare: CompareInputs, *, overwrite: bool
) -> SequenceJob:
    """Compare the existing output with the plan of this run; if they differ, stop before anything
    is written.
    """
    path = "/".join(part for part in (inputs.path, plan.spec.coordinates) if part)
    writer = sink.sequence(path)
    params = settings_of(inputs, plan)
    cameras = inputs.cameras()
    if plan.voting.keep_seen:
        check_views(plan.spec, inputs.frames[0].views(), inputs.location)
    numbers = [frame.number for frame in inputs.frames]
    check = InputCheck(inputs, writer, plan.grid, compare)
    may_replace = overwrite or check.is_provisional
    exists = check_grid(writer, plan.grid, params, numbers, overwrite=may_replace)
    documents = {
        layout.METADATA: agree_metadata(writer, inputs.metadata),
        layout.POSES: agree_lines(
            writer, layout.POSES, inputs.poses(), may_change=check.is_of_input
        ),
        layout.TIMES: agree_lines(
            writer, layout.TIMES, inputs.times(), may_change=check.is_of_input
        ),
        layout.CAMERAS: None if cameras == writer.read_document(layout.CAMERAS) else cameras,
        layout.params_file(plan.grid): to_json(params),
    }
    needed = {name: data for name, data in documents.items() if data is not None}
    is_other = writer.read_document(layout.params_file(plan.grid)) != to_json(params)
    replaces = exists and (overwrite or (check.is_provisional and is_other))
    return SequenceJob(path, inputs, plan, writer, needed, params, replaces, check)


def settings_of(inputs: SequenceInput, plan: GridPlan) -> dict[str, Any]:
    """Return the params.json of the grid of a sequence, as a later run reads it."""
    how = {"free_step_m": float(plan.voting.free_step_m), "voting": plan.rule}
    if plan.voting.min_confidence:
        how["min_confidence"] = float(plan.voting.min_confidence)
    made_from = inputs.record()
    record = {"format": RECORD_FORMAT, "rule": RULES[made_from["observe"]], **made_from, **how}
    if inputs.metadata.predicted:
        record["labels"] = inputs.metadata.predicted
    settings = plan.spec.to_params(inputs.metadata.classes.num_channels) | {RECORD: record}
    return parse_json(to_json(settings), plan.grid)


def _begin(job: SequenceJob) -> None:
    """Write the documents of a sequence, the settings of its grid first: a run with other settings
    that began at the same time finds them.

    Raises:
        ConflictError: such a run wrote its settings first.
    """
    writer = job.writer
    params = layout.params_file(job.plan.grid)
    if job.replaces:
        writer.remove_grid(job.plan.grid)
    if writer.create_document(params, job.documents[params]):
        job.check.announce(job.numbers)
    else:
        check_grid(writer, job.plan.grid, job.params, (), overwrite=False)
    for document, data in job.documents.items():
        if document != params:
            writer.write_document(document, data)


Outputs = dict[str, AnyArray]


@dataclass(frozen=True)
class FrameResult:
    """The result of a task.

    Attributes:
        task: the task.
        outputs: the arrays that it made, by field, until they are written.
        error: why it failed; None if it did not.
        facts: the facts of the frame for the report.
    """

    task: FrameTask
    outputs: Outputs = field(default_factory=dict)
    error: str | None = None
    facts: FrameFacts | None = None


@dataclass(frozen=True)
class FrameTask:
    """One piece of the work of a run: to make a frame, or to measure one that exists, for the
    report. It holds paths and settings.

    Attributes:
        number: frame number in the output.
        frame: the frame; None if it exists, and only an earlier run knew it.
        plan: the plan of the run.
        classes: class table of the grid.
        sampled: whether the frame is also made without a tenth of the scans.
        replaces: whether scans in the output are replaced, because those of the input changed.
        existing: where the frame is; None: it is made.
    """

    number: int
    frame: FrameInput | None
    plan: GridPlan
    classes: ClassTable
    sampled: bool
    replaces: bool = False
    existing: SequenceWriter | None = None

    def run(self) -> FrameResult:
        """Do the work, in a worker. The arrays of a new frame are returned, and not written yet."""
        plan = self.plan
        number = self.number
        frame = self.frame
        try:
            # first, while no outputs take memory
            thinned = frame.thinned(plan) if self.sampled and frame is not None else None
            if self.existing is not None:
                arrays, grid = self._read(self.existing)
                outputs = Outputs()
            elif frame is not None:
                arrays, grid = self.outputs_of(frame.make(plan), frame)
                outputs = arrays
            else:
                raise MissingDataError(f"frame {number}", expected="in the source", found="none")
            changes = None if thinned is None else Changes.between(grid, thinned)
            residuals = None if frame is None else frame.residuals()
            facts = FrameFacts.of(number, arrays, plan.grid, self.classes, changes, residuals)
        except MemoryError as error:
            raise CarlascError(
                str(plan.spec),
                problem="out of memory",
                advice="use a coarser grid, or fewer processes (`workers`)",
            ) from error
        except (CarlascError, OSError) as error:
            return FrameResult(self, error=str(error))
        return FrameResult(self, outputs, facts=facts)

    def outputs_of(self, data: FrameData, frame: FrameInput) -> tuple[Outputs, Grid]:
        """Return all arrays to write for a frame, the grid last, and the grid.

        Raises:
            MissingDataError: the plan needs the certainty of each voxel, and the frame does not
                have it.
        """
        plan = self.plan
        voting = self.plan.voting
        where = f"frame {self.number}"
        labels = data.grid.labels
        counts = data.grid.counts
        evidence = data.evidence
        if plan.needs_evidence and evidence is None:
            raise MissingDataError(where, expected="how certain each voxel is", found="nothing")
        if voting.min_confidence and counts is not None and evidence is not None:
            confident = is_confident(evidence.occupied, voting.min_confidence)
            labels = labels * confident
            counts = counts * confident
        parts: Outputs = {"labels": labels}
        parts |= {} if counts is None else {"counts": counts}
        if voting.keep and data.votes is not None:
            parts["votes"] = data.votes.to_sparse()
        if voting.keep_evidence and evidence is not None:
            parts |= vars(evidence)
        if (voting.keep_evidence or plan.infers) and data.flags is not None:
            parts["flags"] = data.flags
        if voting.keep_actors and data.actors is not None:
            actors = data.actors.within(labels > 0)  # confidence may have made voxels unknown
            parts |= {part: getattr(actors, part) for part in layout.ACTOR_FIELDS}
        if voting.keep_seen:
            parts["seen"] = see_voxels(labels > 0, plan.spec, frame.views(), data.boxes)
        of_grid = {f"{plan.grid}/{part}": array for part, array in parts.items()}
        return {**data.fields, **of_grid}, Grid(plan.spec, labels, counts)

    def _read(self, writer: SequenceWriter) -> tuple[Outputs, Grid]:
        """Return the arrays of a frame that exists, and its grid."""
        plan = self.plan
        arrays = Outputs()
        names = (*layout.SCAN_FIELDS, *(f"{plan.grid}/{part}" for part in layout.GRID_FIELDS))
        with reading(f"frame {self.number}", "a grid with labels and counts"):
            for name in names:
                has = writer.has(name, self.number)
                if has and (array := writer.read(name, self.number)) is not None:
                    arrays[name] = array
            labels, counts = (
                arrays[f"{plan.grid}/{part}"].reshape(plan.spec.size)
                for part in ("labels", "counts")
            )
        return arrays, Grid(plan.spec, labels, counts)


@dataclass(frozen=True)
class Batch:
    """Tasks that a worker runs one after another: frames that follow each other, or the measurement
    of one frame.

    Attributes:
        writer: where the frames are written.
        blocks: the tasks; those of frames that are stored together are in one tuple.
    """

    writer: SequenceWriter
    blocks: tuple[tuple[FrameTask, ...], ...]


def run_batch(batch: Batch) -> list[FrameResult]:
    """Run the tasks of a batch, and write the frames if the writer works in workers.

    Raises:
        ConflictError: a scan exists already, and differs from that of this run.
        StorageError: nothing can be written, so all other batches would fail too.
    """
    every: list[FrameResult] = []
    for tasks in batch.blocks:
        done: list[FrameResult] = []
        for task in tasks:  # in Python 3.11, a comprehension is a level of calls
            done.append(task.run())  # noqa: PERF401
        if batch.writer.concurrent:
            try:
                write_frames(batch.writer, done)
            except (ConflictError, StorageError):
                raise  # every other batch would raise the same
            except (CarlascError, OSError) as error:
                done = [replace(one, error=one.error or str(error), facts=None) for one in done]
            done = [replace(one, outputs={}) for one in done]
        every += done
    return every


def fail_batch(batch: Batch, message: str) -> list[FrameResult]:
    """Return the result of a batch that no worker could finish."""
    return [FrameResult(task, error=message) for tasks in batch.blocks for task in tasks]


def write_frames(writer: SequenceWriter, results: Series[FrameResult]) -> None:
    """Write the frames that were made. Scan fields that exist already must be equal to this run's.

    Raises:
        ConflictError: they differ.
    """
    frames: dict[int, Outputs] = {}
    for done in results:
        if done.outputs:
            number = done.task.number
            frames[number] = {
                name: array
                for name, array in done.outputs.items()
                if name not in layout.SCAN_FIELDS
                or done.task.replaces
                or not (writer.has(name, number) and check_scan(writer, name, number, array))
            }
    if frames:
        writer.write_frames(frames)


@dataclass(frozen=True)
class FrameFailure:
    """A frame that could not be made.

    Attributes:
        sequence: location of its sequence in the source.
        frame: its number in the source.
        message: the error, in one line.
    """

    sequence: str
    frame: int
    message: str


@dataclass(frozen=True)
class SequenceJob:
    """The job of a run for one sequence: inputs, writer, and documents to write first."""

    path: str
    inputs: SequenceInput
    plan: GridPlan
    writer: SequenceWriter
    documents: dict[str, bytes]
    params: dict[str, Any]
    replaces: bool
    check: InputCheck

    @cached_property
    def numbers(self) -> frozenset[int]:
        """The numbers of the frames in the output."""
        return frozenset(frame.number for frame in self.inputs.frames)

    def block_of(self, number: int) -> int:
        """Return the block of a frame. The frames of a block are stored together."""
        return number // self.writer.block

    def announce(self) -> None:
        """Announce the fields and frames to a store that reserves space."""
        frames: dict[str, list[int]] = {name: sorted(self.numbers) for name in self.plan.fields()}
        for frame in self.inputs.frames:
            for name in frame.fields():
                frames.setdefault(name, []).append(frame.number)
        points = self.inputs.most_points() if self.writer.block > 1 else None
        self.writer.expect(frames, {"points": points} if points else None)

    def missing(self) -> set[int]:
        """Return the frames that lack a file at this moment: other commands may write at the same
        time.
        """
        self.writer.refresh()
        has = self.writer.has
        grid = self.plan.fields()
        frames = self.inputs.frames
        return {
            frame.number
            for frame in frames
            if not all(has(name, frame.number) for name in (*frame.fields(), *grid))
        }

    def look(self, run: Run) -> set[int]:
        """Compare the inputs of the existing frames with those of now, and return the frames that
        must be made, because they lack a file or their inputs changed.
        """
        missing = self.missing()
        begun = {n for n in missing if any(self.writer.has(name, n) for name in self.check.copied)}
        self.check.look(self.numbers - missing, begun, self._agrees, run)
        return missing | self.check.stale

    def _agrees(self, number: int) -> bool | None:
        """Return whether a frame is equal to what is made now; None if it cannot be made."""
        (task,) = self.tasks({number})
        made = task.run().outputs
        own = f"{self.plan.grid}/"
        fields = {name: array for name, array in made.items() if name.startswith(own)}
        return (
            None
            if not fields
            else all(
                (there := self.writer.read(name, number)) is not None
                and np.array_equal(
                    there.reshape(-1), array.reshape(-1), equal_nan=array.dtype.kind == "f"
                )
                for name, array in fields.items()
            )
        )

    def _documents(self) -> dict[str, bytes]:
        """Return the text files that a report is made from."""
        names = (layout.POSES, layout.TIMES, layout.METADATA, layout.params_file(self.plan.grid))
        found = {name: self.writer.read_document(name) for name in names}
        return {name: data for name, data in found.items() if data is not None}

    def is_reported(self) -> bool:
        """Whether the report covers all frames, and its text files are those of now."""
        report = self.report()
        now = self._documents()
        return (
            report is not None
            and not self.check.changed
            and set(report.frames) >= self.numbers
            and report.documents.keys() == now.keys()
            and all(report.documents[name].matches(data) for name, data in now.items())
        )

    def report(self) -> Report | None:
        """Return the report of an earlier run with the same settings; None without one."""
        name = layout.report_file(self.plan.grid)
        data = self.writer.read_document(name)
        try:
            report = None if data is None else Report.from_json(data, name)
        except FormatError:
            return None
        return report if report is not None and report.settings == self.params else None

    @property
    def reported(self) -> frozenset[int]:
        """The frames of the report: those of this run, and those of the existing report."""
        report = self.report()
        earlier = set() if report is None else set(report.frames) - self.check.gone
        return self.numbers | earlier

    def tasks(self, numbers: Set[int], existing: SequenceWriter | None = None) -> list[FrameTask]:
        """Return a task for each of some frames; `existing`: where they are already."""
        sampled = set(sample_frames(sorted(self.reported)))
        inputs = self.inputs
        known = {frame.number: frame for frame in inputs.frames}
        return [
            FrameTask(
                number,
                known.get(number) or inputs.frame(number),
                self.plan,
                inputs.metadata.classes,
                number in sampled,
                number in self.check.stale,
                existing,
            )
            for number in sorted(numbers)
        ]

    def write_report(self, results: Series[FrameResult]) -> None:
        """Write the report, if anything was made or measured."""
        facts = [done.facts for done in results if done.facts is not None]
        grid = self.plan.grid
        writer = self.writer
        documents = self._documents()
        if facts:
            inputs = self.inputs
            report = Report.make(
                grid,
                facts,
                self.params,
                inputs.metadata.classes,
                documents,
                actors=inputs.summaries(),
                poses=inputs.pose_facts(),
            )
            writer.write_document(layout.report_file(grid), report.to_json())


@dataclass
class Work:
    """The work of a run, or of a part of it.

    Attributes:
        jobs: the sequences.
        spread: how the work is spread. Frames that are stored together are in one part.
        failures: frames that could not be made.
        wanted: number of frames to make.
        skipped: number of frames of this part that exist already.
        has_written: whether a frame or a report was written.
    """

    jobs: Series[SequenceJob]
    spread: Run
    failures: list[FrameFailure] = field(default_factory=list)
    wanted: int = 0
    skipped: int = 0
    has_written: bool = False

    def run(self) -> list[FrameFailure]:
        """Make the missing frames, and return the frames that could not be made.

        Sequences follow each other without a pause: the next sequence is prepared while the last
        frames of one are made.
        """
        dealt = self._deal()
        every = [job.look(self.spread) for job in self.jobs]
        ours = [todo & numbers for todo, numbers in zip(every, dealt, strict=True)]
        self.wanted = sum(map(len, ours))
        self.skipped = sum(map(len, dealt)) - self.wanted
        passes = sum(
            job.inputs.steps_before for job, missing in zip(self.jobs, ours, strict=True) if missing
        )
        steps = StepCounter(self.spread.progress, self.skipped + self.wanted + passes, self.skipped)
        steps(0)
        under_way: deque[SequenceJob] = deque()  # the job of each batch, in order

        def batches() -> Iterator[Batch]:
            for job, todo, missing in zip(self.jobs, every, ours, strict=True):
                if missing:
                    job.inputs.prepare(job.writer, self.spread, steps)
                    job.check.begin(job.numbers, todo)
                for batch in _batches(job, job.tasks(missing), self.spread):
                    under_way.append(job)
                    yield batch

        made: dict[int, list[FrameResult]] = {id(job): [] for job in self.jobs}
        with closing(run_all(run_batch, batches(), self.spread, lost=fail_batch)) as results:
            for job, missing in zip(self.jobs, ours, strict=True):
                while len(made[id(job)]) < len(missing):
                    done = next(results)
                    # frames of a writer that does not work in workers
                    write_frames(under_way.popleft().writer, done)
                    made[id(job)] += [replace(result, outputs={}) for result in done]
                    steps(len(done))
                self._finish(job, made.pop(id(job)), steps)
        return self.failures

    def _deal(self) -> list[set[int]]:
        """Return the frames of each sequence that belong to the part."""
        blocks = sorted(
            {(n, job.block_of(number)) for n, job in enumerate(self.jobs) for number in job.numbers}
        )
        dealt = set(self.spread.part.take(blocks))
        return [
            {i for i in job.numbers if (n, job.block_of(i)) in dealt}
            for n, job in enumerate(self.jobs)
        ]

    def _finish(self, job: SequenceJob, made: list[FrameResult], steps: StepCounter) -> None:
        """Note the failures, and write the report; if other parts make frames of the sequence, the
        last part writes it.
        """
        self.has_written |= bool(made)
        for done in made:
            if done.task.frame is not None and done.error is not None:
                frame = done.task.frame.source_frame
                self.failures.append(FrameFailure(job.inputs.location, frame, done.error))
        if job.check.must_record and not made:
            job.check.begin(job.numbers, ())
        is_reported = not made and job.is_reported()
        if not (is_reported or (self.spread.part.count > 1 and job.missing())):
            self._report(job, made)
        if made or job.check.must_record:
            job.check.finish({done.task.number for done in made if done.error is None})

    def _report(self, job: SequenceJob, made: list[FrameResult]) -> None:
        """Write the report of a sequence."""
        job.inputs.prepare(job.writer, self.spread, StepCounter(None))
        self.has_written = True
        others = job.reported - {done.task.number for done in made}
        measured = _batches(job, job.tasks(others, job.writer), Run(1))
        with closing(run_all(run_batch, measured, self.spread, lost=fail_batch)) as results:
            job.write_report([*made, *(done for batch in results for done in batch)])


def _batches(job: SequenceJob, tasks: Series[FrameTask], spread: Run) -> Iterator[Batch]:
    """Yield tasks in batches.

    Frames from scans share the scans of their windows: each worker makes frames that follow each
    other, as long as it writes them itself.
    """
    groups = groupby(tasks, key=lambda task: job.block_of(task.number))
    blocks = [tuple(group) for _, group in groups]
    together = 1
    shares = isinstance(job.plan.observe, FromScans) and job.writer.concurrent
    if shares and not spread.is_alone:
        rounds = max(round(len(tasks) / (_TOGETHER * spread.processes)), 1)
        together = max(-(-len(blocks) // (rounds * spread.processes)), 1)
    for begin in range(0, len(blocks), together):
        yield Batch(job.writer, tuple(blocks[begin : begin + together]))
