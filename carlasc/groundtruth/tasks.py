"""The tasks of a run, which pickle into workers: making a frame, measuring one that exists."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

from numpy.typing import NDArray

from carlasc.core.classes import ClassTable
from carlasc.core.evidence import is_confident
from carlasc.core.grids import Grid
from carlasc.errors import CarlascError, ConflictError, MissingDataError, StorageError
from carlasc.groundtruth.inputs import FrameInput, Plan
from carlasc.groundtruth.reporting.facts import Changes, FrameFacts
from carlasc.storage import layout
from carlasc.storage.resuming import check_scan
from carlasc.storage.sinks import SequenceWriter

Outputs = dict[str, NDArray[Any]]


@dataclass(frozen=True)
class Done:
    """The result of a task.

    Attributes:
        task: the task.
        outputs: what it made, by field, until it is written.
        error: why it failed; None if it did not.
        facts: what the report needs to know of the frame.
    """

    task: Task
    outputs: Outputs = field(default_factory=dict)
    error: str | None = None
    facts: FrameFacts | None = None


@dataclass(frozen=True)
class Task(ABC):
    """One piece of the work of a run. It holds paths and settings.

    Attributes:
        number: frame number in the output.
    """

    number: int

    @abstractmethod
    def run(self) -> Done:
        """Do the work, in a worker."""


@dataclass(frozen=True)
class MakeFrame(Task):
    """Makes one frame.

    Attributes:
        frame: the frame.
        plan: what the run makes.
        classes: class table of the grid.
        sampled: whether the frame is also made without a tenth of the scans.
    """

    frame: FrameInput
    plan: Plan
    classes: ClassTable
    sampled: bool

    def run(self) -> Done:
        """Make the frame. What it made is returned, and not written yet."""
        plan, number = self.plan, self.number
        try:
            thinned = self.frame.thinned(plan) if self.sampled else None  # first, while there are no outputs to keep
            outputs, grid = _make(self.frame, plan)
            changes = None if thinned is None else Changes.between(grid, thinned)
            facts = FrameFacts.of(number, outputs, plan.grid, plan.spec, self.classes, changes, self.frame.residuals())
        except MemoryError as error:
            raise CarlascError(
                str(plan.spec), problem="out of memory", advice="use a coarser grid, or fewer processes (`workers`)"
            ) from error
        except (CarlascError, OSError) as error:
            return Done(self, error=str(error))
        return Done(self, outputs, facts=facts)


@dataclass(frozen=True)
class MeasureFrame(Task):
    """Measures one frame that exists already, for the report.

    Attributes:
        frame: the frame, if the run knows it.
        sampled: whether the frame is also made without a tenth of the scans.
        plan: what the run makes.
        writer: where the frame is.
        classes: class table of the grid.
    """

    frame: FrameInput | None
    plan: Plan
    writer: SequenceWriter
    classes: ClassTable
    sampled: bool

    def run(self) -> Done:
        """Read the frame. One that cannot be read is left out of the report."""
        plan = self.plan
        names = (*layout.SCAN_FIELDS, *(f"{plan.grid}/{part}" for part in layout.GRID_FIELDS))
        try:
            found = {name: self.writer.read(name, self.number) for name in names if self.writer.has(name, self.number)}
            arrays = {name: array for name, array in found.items() if array is not None}
            if not {f"{plan.grid}/labels", f"{plan.grid}/counts"} <= arrays.keys():
                return Done(self)
            labels, counts = (arrays[f"{plan.grid}/{part}"].reshape(plan.spec.size) for part in ("labels", "counts"))
            thinned = self.frame.thinned(plan) if self.sampled and self.frame is not None else None
            changes = None if thinned is None else Changes.between(Grid(plan.spec, labels, counts), thinned)
            residuals = None if self.frame is None else self.frame.residuals()
            facts = FrameFacts.of(self.number, arrays, plan.grid, plan.spec, self.classes, changes, residuals)
        except (CarlascError, OSError, ValueError):
            return Done(self)
        return Done(self, facts=facts)


@dataclass(frozen=True)
class Batch:
    """Tasks that a worker does one after another: to make the frames that are stored together, or to measure a frame.

    Attributes:
        writer: where the frames are written.
        tasks: the tasks.
    """

    writer: SequenceWriter
    tasks: tuple[Task, ...]


def run_batch(batch: Batch) -> list[Done]:
    """Do the work of a batch, and write what it made if the writer can be used in workers.

    Raises:
        ConflictError: a scan exists already, and differs from that of this run.
        StorageError: nothing can be written, so every other batch would fail in the same way.
    """
    done = [task.run() for task in batch.tasks]
    if not batch.writer.concurrent:
        return done
    try:
        write_frames(batch.writer, done)
    except (ConflictError, StorageError):
        raise  # every other batch would raise the same
    except (CarlascError, OSError) as error:
        done = [replace(result, error=result.error or str(error), facts=None) for result in done]
    return [replace(result, outputs={}) for result in done]


def fail_batch(batch: Batch, message: str) -> list[Done]:
    """Return the result of a batch that no worker could finish."""
    return [Done(task, error=message) for task in batch.tasks]


def write_frames(writer: SequenceWriter, results: Sequence[Done]) -> None:
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
                if name not in layout.SCAN_FIELDS or not exists(writer, name, number, array)
            }
    if frames:
        writer.write_frames(frames)


def exists(writer: SequenceWriter, field: str, frame: int, array: NDArray[Any]) -> bool:
    """Whether a scan field of a frame exists already.

    Raises:
        ConflictError: it exists, and differs from `array`.
    """
    return writer.has(field, frame) and check_scan(writer, field, frame, array)


def _make(frame: FrameInput, plan: Plan) -> tuple[Outputs, Grid]:
    """Make everything that is written for a frame, the grid last."""
    data = frame.make(plan)
    labels, counts, evidence = data.grid.labels, data.grid.counts, data.evidence
    if plan.needs_evidence and evidence is None:
        raise MissingDataError(f"frame {frame.number}", expected="how certain each voxel is", found="nothing")
    if plan.voting.min_confidence and counts is not None and evidence is not None:
        confident = is_confident(evidence.occupied, plan.voting.min_confidence)
        labels, counts = labels * confident, counts * confident
    outputs: Outputs = {**data.fields, f"{plan.grid}/labels": labels}
    if counts is not None:
        outputs[f"{plan.grid}/counts"] = counts
    if plan.voting.keep and data.votes is not None:
        outputs[f"{plan.grid}/votes"] = data.votes.to_sparse()
    if plan.voting.keep_evidence and evidence is not None:
        outputs |= {f"{plan.grid}/{part}": getattr(evidence, part) for part in layout.EVIDENCE_FIELDS}
    return outputs, Grid(plan.spec, labels, counts)
