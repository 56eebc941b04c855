"""The tasks of a run, which pickle into workers: making a frame, measuring one that exists."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass, field
from typing import Any

from numpy.typing import NDArray

from carlasc.core.classes import ClassTable
from carlasc.core.evidence import is_confident
from carlasc.core.grids import Grid
from carlasc.errors import CarlascError, ConflictError, MissingDataError, StorageError
from carlasc.groundtruth.inputs import FrameInput, Plan
from carlasc.groundtruth.reporting.facts import Changes, FrameFacts
from carlasc.storage import layout
from carlasc.storage.protocol import SequenceWriter
from carlasc.storage.resuming import check_scan

Outputs = dict[str, NDArray[Any]]


@dataclass(frozen=True)
class Done:
    """The result of a task.

    Attributes:
        task: the task.
        outputs: what it made, by field, if the writer cannot write in workers.
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
        job: number of its sequence in the run.
    """

    job: int

    @abstractmethod
    def run(self) -> Done:
        """Do the work, in a worker."""


@dataclass(frozen=True)
class MakeFrame(Task):
    """Makes one frame, and writes it in the worker if its writer can.

    Attributes:
        frame: the frame.
        plan: what the run makes.
        writer: where it is written.
        classes: class table of the grid.
        sampled: whether the frame is also made without a tenth of the scans.
    """

    frame: FrameInput
    plan: Plan
    writer: SequenceWriter
    classes: ClassTable
    sampled: bool

    def run(self) -> Done:
        """Make the frame."""
        plan, number = self.plan, self.frame.number
        try:
            outputs, grid = _make(self.frame, plan)
            changes = _changes(self.frame, plan, grid) if self.sampled else None
            facts = FrameFacts.of(number, outputs, plan.grid, plan.spec, self.classes, changes, self.frame.residuals())
            if not self.writer.concurrent:
                return Done(self, outputs, facts=facts)
            write_frame(self.writer, number, outputs)
        except (ConflictError, StorageError):
            raise  # every other frame would raise the same
        except MemoryError as error:
            raise CarlascError(
                str(plan.spec), problem="out of memory", advice="use a coarser grid, or fewer processes (`workers`)"
            ) from error
        except (CarlascError, OSError) as error:
            return Done(self, error=str(error))
        return Done(self, facts=facts)


@dataclass(frozen=True)
class MeasureFrame(Task):
    """Measures one frame that exists already, for the report.

    Attributes:
        number: frame number in the output.
        frame: the frame, if the run knows it.
        sampled: whether the frame is also made without a tenth of the scans.
        plan: what the run makes.
        writer: where the frame is.
        classes: class table of the grid.
    """

    number: int
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
            again = self.frame if self.sampled else None
            changes = None if again is None else _changes(again, plan, Grid(plan.spec, labels, counts))
            residuals = None if self.frame is None else self.frame.residuals()
            facts = FrameFacts.of(self.number, arrays, plan.grid, plan.spec, self.classes, changes, residuals)
        except (CarlascError, OSError, ValueError):
            return Done(self)
        return Done(self, facts=facts)


def run_task(task: Task) -> Done:
    """Do the work of a task."""
    return task.run()


def write_frame(writer: SequenceWriter, frame: int, outputs: Outputs) -> None:
    """Write a frame's files. Scan fields that exist already must be equal to this run's.

    Raises:
        ConflictError: they differ.
    """
    for name, array in outputs.items():
        if name in layout.SCAN_FIELDS and writer.has(name, frame):
            check_scan(writer, name, frame, array)
        else:
            writer.write(name, frame, array)


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


def _changes(frame: FrameInput, plan: Plan, grid: Grid) -> Changes | None:
    thinned = frame.thinned(plan)
    return None if thinned is None else Changes.between(grid, thinned)
