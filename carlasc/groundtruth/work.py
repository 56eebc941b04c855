"""The work of a run: the frames of all sequences are made in parallel, and each complete sequence
gets a report.

A `FrameTask` pickles into a worker, where a frame is made, or an existing frame is measured.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Iterator, Set
from collections.abc import Sequence as Series
from contextlib import closing
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import groupby
from typing import Any

from carlasc.core.arrays import AnyArray
from carlasc.core.classes import ClassTable
from carlasc.core.grids import Grid, is_confident
from carlasc.errors import CarlascError, ConflictError, FormatError, MissingDataError, StorageError
from carlasc.groundtruth.inputs import FrameData, FrameInput, GridPlan, SequenceInput
from carlasc.groundtruth.reporting import Changes, FrameFacts, Report, sample_frames
from carlasc.groundtruth.seen import see_voxels
from carlasc.running.processes import run_all
from carlasc.running.spreading import Run, StepCounter
from carlasc.storage import layout
from carlasc.storage.resuming import check_scan
from carlasc.storage.sinks import SequenceWriter

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
class FrameTask(ABC):
    """One piece of the work of a run. It holds paths and settings.

    Attributes:
        number: frame number in the output.
        frame: the frame, if the run knows it.
        plan: the plan of the run.
        classes: class table of the grid.
        sampled: whether the frame is also made without a tenth of the scans.
    """

    number: int
    frame: FrameInput | None
    plan: GridPlan
    classes: ClassTable
    sampled: bool

    @abstractmethod
    def run(self) -> FrameResult:
        """Do the work, in a worker."""

    def facts_of(self, arrays: Outputs, grid: Grid, thinned: Grid | None) -> FrameFacts:
        """Return the facts of the frame from its arrays, its grid, and the grid without a tenth of
        the scans, if it was made.
        """
        plan, frame = self.plan, self.frame
        changes = None if thinned is None else Changes.between(grid, thinned)
        residuals = None if frame is None else frame.residuals()
        return FrameFacts.of(
            self.number, arrays, plan.grid, plan.spec, self.classes, changes, residuals
        )


@dataclass(frozen=True)
class MakeFrame(FrameTask):
    """Makes one frame."""

    frame: FrameInput

    def run(self) -> FrameResult:
        """Make the frame. The arrays are returned, and not written yet."""
        plan, number = self.plan, self.number
        try:
            # first, while no outputs take memory
            thinned = self.frame.thinned(plan) if self.sampled else None
            data = self.frame.make(plan)
            outputs, grid = _outputs_of(data, plan, number)
            if plan.voting.keep_seen:
                outputs[f"{plan.grid}/seen"] = see_voxels(
                    grid.labels > 0, plan.spec, self.frame.views(), data.boxes
                )
            facts = self.facts_of(outputs, grid, thinned)
        except MemoryError as error:
            raise CarlascError(
                str(plan.spec),
                problem="out of memory",
                advice="use a coarser grid, or fewer processes (`workers`)",
            ) from error
        except (CarlascError, OSError) as error:
            return FrameResult(self, error=str(error))
        return FrameResult(self, outputs, facts=facts)


@dataclass(frozen=True)
class MeasureFrame(FrameTask):
    """Measures one frame that exists already, for the report.

    Attributes:
        writer: where the frame is.
    """

    writer: SequenceWriter

    def run(self) -> FrameResult:
        """Read the frame. A frame that cannot be read is left out of the report."""
        plan = self.plan
        names = (*layout.SCAN_FIELDS, *(f"{plan.grid}/{part}" for part in layout.GRID_FIELDS))
        try:
            arrays = {
                name: array
                for name in names
                if self.writer.has(name, self.number)
                and (array := self.writer.read(name, self.number)) is not None
            }
            if not {f"{plan.grid}/labels", f"{plan.grid}/counts"} <= arrays.keys():
                return FrameResult(self)
            labels, counts = (
                arrays[f"{plan.grid}/{part}"].reshape(plan.spec.size)
                for part in ("labels", "counts")
            )
            thinned = self.frame.thinned(plan) if self.sampled and self.frame is not None else None
            facts = self.facts_of(arrays, Grid(plan.spec, labels, counts), thinned)
        except (CarlascError, OSError, ValueError):
            return FrameResult(self)
        return FrameResult(self, facts=facts)


@dataclass(frozen=True)
class Batch:
    """Tasks that a worker runs one after another: the frames that are stored together, or the
    measurement of one frame.

    Attributes:
        writer: where the frames are written.
        tasks: the tasks.
    """

    writer: SequenceWriter
    tasks: tuple[FrameTask, ...]


def run_batch(batch: Batch) -> list[FrameResult]:
    """Run the tasks of a batch, and write the frames if the writer works in workers.

    Raises:
        ConflictError: a scan exists already, and differs from that of this run.
        StorageError: nothing can be written, so all other batches would fail too.
    """
    done: list[FrameResult] = []
    for task in batch.tasks:  # in Python 3.11, a comprehension is a level of calls
        done.append(task.run())  # noqa: PERF401
    if not batch.writer.concurrent:
        return done
    try:
        write_frames(batch.writer, done)
    except (ConflictError, StorageError):
        raise  # every other batch would raise the same
    except (CarlascError, OSError) as error:
        done = [replace(result, error=result.error or str(error), facts=None) for result in done]
    return [replace(result, outputs={}) for result in done]


def fail_batch(batch: Batch, message: str) -> list[FrameResult]:
    """Return the result of a batch that no worker could finish."""
    return [FrameResult(task, error=message) for task in batch.tasks]


def write_frames(writer: SequenceWriter, results: Series[FrameResult]) -> None:
    """Write the frames that were made. Scan fields that exist already must be equal to this run's.

    Raises:
        ConflictError: they differ.
    """
    frames: dict[int, Outputs] = {}
    for done in results:
        if isinstance(done.task, MakeFrame) and done.outputs:
            number = done.task.number
            frames[number] = {
                name: array
                for name, array in done.outputs.items()
                if name not in layout.SCAN_FIELDS
                or not (writer.has(name, number) and check_scan(writer, name, number, array))
            }
    if frames:
        writer.write_frames(frames)


def _outputs_of(data: FrameData, plan: GridPlan, frame: int) -> tuple[Outputs, Grid]:
    """Return all arrays to write for a frame, the grid last, and the grid.

    Raises:
        MissingDataError: the plan needs the certainty of each voxel, and the frame does not have
            it.
    """
    labels, counts, evidence = data.grid.labels, data.grid.counts, data.evidence
    if plan.needs_evidence and evidence is None:
        raise MissingDataError(
            f"frame {frame}", expected="how certain each voxel is", found="nothing"
        )
    if plan.voting.min_confidence and counts is not None and evidence is not None:
        confident = is_confident(evidence.occupied, plan.voting.min_confidence)
        labels, counts = labels * confident, counts * confident
    outputs: Outputs = {**data.fields, f"{plan.grid}/labels": labels}
    outputs |= {} if counts is None else {f"{plan.grid}/counts": counts}
    if plan.voting.keep and data.votes is not None:
        outputs[f"{plan.grid}/votes"] = data.votes.to_sparse()
    if plan.voting.keep_evidence and evidence is not None:
        outputs |= {
            f"{plan.grid}/{part}": getattr(evidence, part) for part in layout.EVIDENCE_FIELDS
        }
    if plan.voting.keep_actors and data.actors is not None:
        actors = data.actors.within(labels > 0)  # confidence may have made voxels unknown
        outputs |= {f"{plan.grid}/{part}": getattr(actors, part) for part in layout.ACTOR_FIELDS}
    return outputs, Grid(plan.spec, labels, counts)


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
        has, grid = self.writer.has, self.plan.fields()
        frames = self.inputs.frames
        return {
            frame.number
            for frame in frames
            if not all(has(name, frame.number) for name in (*frame.fields(), *grid))
        }

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
    def is_reported(self) -> bool:
        """Whether the report exists and has every frame."""
        report = self.report()
        return report is not None and set(report.frames) >= self.numbers

    @property
    def reported(self) -> frozenset[int]:
        """The frames of the report: those of this run, and those of the existing report."""
        report = self.report()
        return self.numbers if report is None else self.numbers | set(report.frames)

    def make(self, missing: Set[int]) -> list[FrameTask]:
        """Return a task for each of some missing frames."""
        sampled, classes = set(sample_frames(sorted(self.reported))), self.inputs.metadata.classes
        frames = [frame for frame in self.inputs.frames if frame.number in missing]
        return [
            MakeFrame(frame.number, frame, self.plan, classes, frame.number in sampled)
            for frame in frames
        ]

    def measure(self, made: Set[int]) -> list[FrameTask]:
        """Return a task for each frame that the report needs and this run did not make."""
        sampled, inputs, classes = (
            set(sample_frames(sorted(self.reported))),
            self.inputs,
            self.inputs.metadata.classes,
        )
        return [
            MeasureFrame(
                number, inputs.frame(number), self.plan, classes, number in sampled, self.writer
            )
            for number in sorted(self.reported - made)
        ]

    def write_report(self, results: Series[FrameResult]) -> None:
        """Write the report, if anything was made or measured."""
        facts = [done.facts for done in results if done.facts is not None]
        grid, writer = self.plan.grid, self.writer
        names = (layout.POSES, layout.TIMES, layout.METADATA, layout.params_file(grid))
        documents = {
            name: data for name in names if (data := writer.read_document(name)) is not None
        }
        if facts:
            inputs = self.inputs
            classes, actors, poses = (
                inputs.metadata.classes,
                inputs.summaries(),
                inputs.pose_facts(),
            )
            report = Report.make(
                grid, facts, self.params, classes, documents, actors=actors, poses=poses
            )
            writer.write_document(layout.report_file(grid), report.to_json())


@dataclass
class Work:
    """The work of a run, or of a part of it.

    Attributes:
        jobs: the sequences.
        plan: the plan of the run.
        spread: how the work is spread. Frames that are stored together are in one part.
        failures: frames that could not be made.
        wanted: number of frames to make.
        skipped: number of frames of this part that exist already.
        has_written: whether a frame or a report was written.
    """

    jobs: Series[SequenceJob]
    plan: GridPlan
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
        ours = [job.missing() & numbers for job, numbers in zip(self.jobs, dealt, strict=True)]
        self.wanted = sum(map(len, ours))
        self.skipped = sum(map(len, dealt)) - self.wanted
        passes = sum(
            job.inputs.steps_before for job, missing in zip(self.jobs, ours, strict=True) if missing
        )
        steps = StepCounter(self.spread.progress, self.skipped + self.wanted + passes, self.skipped)
        steps(0)
        under_way: deque[SequenceJob] = deque()  # the job of each batch, in order

        def batches() -> Iterator[Batch]:
            for job, missing in zip(self.jobs, ours, strict=True):
                if missing:
                    job.inputs.prepare(job.writer, self.spread, steps)
                for batch in _batches(job, job.make(missing)):
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
            if isinstance(done.task, MakeFrame) and done.error is not None:
                self.failures.append(
                    FrameFailure(job.inputs.location, done.task.frame.source_frame, done.error)
                )
        if (not made and job.is_reported) or (self.spread.part.count > 1 and job.missing()):
            return
        if not made:
            job.inputs.prepare(job.writer, self.spread, StepCounter(None))
        self.has_written = True
        tried = {done.task.number for done in made}
        with closing(
            run_all(run_batch, _batches(job, job.measure(tried)), self.spread, lost=fail_batch)
        ) as results:
            job.write_report([*made, *(done for batch in results for done in batch)])


def _batches(job: SequenceJob, tasks: Series[FrameTask]) -> Iterator[Batch]:
    """Yield tasks in batches; the frames that are stored together are in one batch."""
    for _, group in groupby(tasks, key=lambda task: job.block_of(task.number)):
        yield Batch(job.writer, tuple(group))
