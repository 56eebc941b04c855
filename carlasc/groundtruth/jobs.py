"""The work of a run: the frames of all its sequences are made in parallel, and each sequence whose frames all exist gets a report."""

from __future__ import annotations

from collections import deque
from collections.abc import Generator, Iterator, Set
from collections.abc import Sequence as Series
from contextlib import closing
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import groupby
from typing import Any

from carlasc.errors import FormatError
from carlasc.groundtruth.inputs import Plan, SequenceInput, Steps
from carlasc.groundtruth.reporting.facts import sample_frames
from carlasc.groundtruth.reporting.report import Report
from carlasc.groundtruth.tasks import Batch, Done, MakeFrame, MeasureFrame, Task, fail_batch, run_batch, write_frames
from carlasc.running.options import Run
from carlasc.running.processes import run_all
from carlasc.storage import layout
from carlasc.storage.sinks import SequenceWriter


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
class Job:
    """What a run does with one sequence: what is made, where it goes, and the documents to write first."""

    path: str
    inputs: SequenceInput
    plan: Plan
    writer: SequenceWriter
    documents: dict[str, bytes]
    params: dict[str, Any]
    replaces: bool

    @cached_property
    def numbers(self) -> frozenset[int]:
        """The numbers of the frames in the output."""
        return frozenset(frame.number for frame in self.inputs.frames)

    def block_of(self, number: int) -> int:
        """Return the block of a frame: the frames of a block are stored together."""
        return number // self.writer.block

    def announce(self) -> None:
        """Say what is going to be written, to a store that needs to know."""
        frames: dict[str, list[int]] = {name: sorted(self.numbers) for name in self.plan.fields()}
        for frame in self.inputs.frames:
            for name in frame.fields():
                frames.setdefault(name, []).append(frame.number)
        points = self.inputs.most_points() if self.writer.block > 1 else None
        self.writer.expect(frames, {"points": points} if points else None)

    def missing(self) -> set[int]:
        """Return the frames that lack a file now; other commands may write at the same time."""
        self.writer.refresh()
        has, grid = self.writer.has, self.plan.fields()
        frames = self.inputs.frames
        return {
            frame.number for frame in frames if not all(has(name, frame.number) for name in (*frame.fields(), *grid))
        }

    def report(self) -> Report | None:
        """Return the report that an earlier run with the same settings left; None if there is none."""
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
        """The frames that the report is about: those of this run, and those of the report that exists."""
        report = self.report()
        return self.numbers if report is None else self.numbers | set(report.frames)

    def make(self, missing: Set[int]) -> list[Task]:
        """Return a task for each of some missing frames."""
        sampled, classes = set(sample_frames(sorted(self.reported))), self.inputs.metadata.classes
        frames = [frame for frame in self.inputs.frames if frame.number in missing]
        return [MakeFrame(frame.number, frame, self.plan, classes, frame.number in sampled) for frame in frames]

    def measure(self, made: Set[int]) -> list[Task]:
        """Return a task for each frame that the report needs and this run did not make."""
        sampled, inputs, classes = set(sample_frames(sorted(self.reported))), self.inputs, self.inputs.metadata.classes
        return [
            MeasureFrame(number, inputs.frame(number), self.plan, self.writer, classes, number in sampled)
            for number in sorted(self.reported - made)
        ]

    def write_report(self, results: Series[Done]) -> None:
        """Write the report, if anything was made or measured."""
        facts = [done.facts for done in results if done.facts is not None]
        grid, writer = self.plan.grid, self.writer
        names = (layout.POSES, layout.TIMES, layout.METADATA, layout.params_file(grid))
        found = {name: writer.read_document(name) for name in names}
        documents = {name: data for name, data in found.items() if data is not None}
        if facts:
            classes, actors = self.inputs.metadata.classes, self.inputs.summaries()
            report = Report.make(grid, facts, self.params, classes, documents, actors=actors)
            writer.write_document(layout.report_file(grid), report.to_json())


@dataclass
class Work:
    """The work of a run, or of a part of it.

    Attributes:
        jobs: the sequences.
        plan: what is made.
        spread: how the work is spread. Of a part of it, frames that are stored together are dealt out together.
        failures: frames that could not be made.
        wanted: number of frames to make.
        skipped: number of frames of this part that exist already.
        has_written: whether a frame or a report was written.
    """

    jobs: Series[Job]
    plan: Plan
    spread: Run
    failures: list[FrameFailure] = field(default_factory=list)
    wanted: int = 0
    skipped: int = 0
    has_written: bool = False

    def run(self) -> list[FrameFailure]:
        """Make what is missing, and return the frames that could not be made.

        Sequences follow each other without a pause: while the last frames of one are made, the next one is prepared and begun.
        """
        dealt = self._deal()
        ours = [job.missing() & numbers for job, numbers in zip(self.jobs, dealt, strict=True)]
        self.wanted = sum(map(len, ours))
        self.skipped = sum(map(len, dealt)) - self.wanted
        passes = sum(job.inputs.steps_before for job, missing in zip(self.jobs, ours, strict=True) if missing)
        steps = Steps(self.spread.progress, self.skipped, self.skipped + self.wanted + passes)
        under_way: deque[Job] = deque()  # the job of each batch, in order

        def batches() -> Iterator[Batch]:
            for job, missing in zip(self.jobs, ours, strict=True):
                if missing:
                    self._prepare(job, steps)
                for batch in _batches(job, job.make(missing)):
                    under_way.append(job)
                    yield batch

        made: dict[int, list[Done]] = {id(job): [] for job in self.jobs}
        with closing(self._results(batches())) as results:
            for job, missing in zip(self.jobs, ours, strict=True):
                while len(made[id(job)]) < len(missing):
                    done = next(results)
                    write_frames(under_way.popleft().writer, done)  # what the writer cannot write in workers
                    made[id(job)] += [replace(result, outputs={}) for result in done]
                    steps(len(done))
                self._finish(job, made.pop(id(job)), steps)
        return self.failures

    def _deal(self) -> list[set[int]]:
        """Return the frames of each sequence that belong to the part."""
        blocks = sorted({(n, job.block_of(number)) for n, job in enumerate(self.jobs) for number in job.numbers})
        dealt = set(self.spread.part.take(blocks))
        return [{i for i in job.numbers if (n, job.block_of(i)) in dealt} for n, job in enumerate(self.jobs)]

    def _prepare(self, job: Job, steps: Steps) -> None:
        job.inputs.prepare(job.writer, self.spread, steps)

    def _results(self, batches: Iterator[Batch]) -> Generator[list[Done], None, None]:
        return run_all(run_batch, batches, self.spread, lost=fail_batch)

    def _finish(self, job: Job, made: list[Done], steps: Steps) -> None:
        """Note what failed, and write the report; where other parts make frames of the sequence, the last of them writes it."""
        self.has_written |= bool(made)
        for done in made:
            if isinstance(done.task, MakeFrame) and done.error is not None:
                self.failures.append(FrameFailure(job.inputs.location, done.task.frame.source_frame, done.error))
        if (not made and job.is_reported) or (self.spread.part.count > 1 and job.missing()):
            return
        if not made:
            self._prepare(job, Steps(None, 0, 0))
        self.has_written = True
        tried = {done.task.number for done in made}
        with closing(self._results(_batches(job, job.measure(tried)))) as results:
            job.write_report([*made, *(done for batch in results for done in batch)])


def _batches(job: Job, tasks: Series[Task]) -> Iterator[Batch]:
    """Yield tasks in batches: those of frames that are stored together in one."""
    for _, group in groupby(tasks, key=lambda task: job.block_of(task.number)):
        yield Batch(job.writer, tuple(group))
