"""Grids of a drive that still grows: from the poses and the scans known so far."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import cast

from carlasc.errors import CarlascError
from carlasc.groundtruth.from_scans.feed import WithoutScans
from carlasc.groundtruth.from_scans.sequences import ScanSequence
from carlasc.groundtruth.inputs import GridPlan
from carlasc.groundtruth.options import FromScans
from carlasc.groundtruth.run import FrameTask, settings_of
from carlasc.running.spreading import Run
from carlasc.storage import layout
from carlasc.storage.files import to_json
from carlasc.storage.inputs import PROVISIONAL, MadeFrom
from carlasc.storage.protocol import Sequence, SequenceWriter
from carlasc.storage.resuming import check_grid

_EVERY = 3  # of the scans of a window, every N-th one is merged: to find what moves takes time


@dataclass(frozen=True)
class ProvisionalFrame:
    """A frame of which the whole window exists. It is made in a worker.

    Every third scan of its window is merged, and shows what moves; poses are not refined. So each
    grid takes the same short time, however long the drive is.

    Attributes:
        sequence: its sequence.
        writer: writes beside it.
        plan: the plan of the final grids.
        number: number of the frame.
    """

    sequence: Sequence
    writer: SequenceWriter
    plan: GridPlan
    number: int

    def make(self) -> str | None:
        """Make and write the grid of the frame, marked as provisional; return why it failed.

        Raises:
            StorageError: the grid cannot be written.
        """
        observe = cast(FromScans, self.plan.observe)
        first, last = observe.window
        every = observe.stride if observe.stride > 1 else _EVERY
        others = set(self.sequence.frames("points").tolist())
        others -= {self.number + i for i in range(first, last + 1) if i % every == 0}
        near, plan, writer = WithoutScans(self.sequence, others), self.plan, self.writer
        try:
            params = settings_of(ScanSequence(near, plan, observe), plan)
            check_grid(writer, plan.grid, params, [self.number], overwrite=True)
            self._mark(to_json(params))
            unrefined = replace(observe.poses, refine="never")
            inputs = ScanSequence(near, plan, replace(observe, poses=unrefined))
            inputs.prepare(None, Run(workers=1), lambda steps: None)
            frame = inputs.frame(self.number)
            made = FrameTask(self.number, frame, plan, inputs.metadata.classes, False).run()
        except (CarlascError, OSError) as error:
            return str(error)
        grid = f"{plan.grid}/"
        fields = {name: data for name, data in made.outputs.items() if name.startswith(grid)}
        if fields:
            writer.write_frames({self.number: fields})
        return made.error

    def _mark(self, params: bytes) -> None:
        """Note that the grid is provisional; remove frames with other settings."""
        name, document = f"made-{self.plan.grid}", layout.params_file(self.plan.grid)
        MadeFrom(PROVISIONAL).write(self.writer, name)
        if (existing := self.writer.read_document(document)) != params:
            if existing is not None:
                self.writer.remove_grid(self.plan.grid)
            self.writer.write_document(document, params)
