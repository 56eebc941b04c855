"""Which frames of an earlier run were made from other inputs than those of now, and must be made
again.

See `carlasc.storage.inputs` for the records.
"""

from __future__ import annotations

from collections.abc import Callable, Collection
from dataclasses import dataclass, field

from carlasc.core.choices import CompareInputs
from carlasc.errors import count
from carlasc.groundtruth.inputs import SequenceInput
from carlasc.running.spreading import Run, StepCounter
from carlasc.storage.inputs import (
    MadeFrom,
    combined,
    content_digests,
    describe_changes,
    made_again,
)
from carlasc.storage.protocol import SequenceWriter


@dataclass
class InputCheck:
    """The comparison of the inputs of one sequence with those that its grid was made from.

    Attributes:
        inputs: the sequence.
        writer: the output.
        grid: name of the grid.
        compare: how files are compared.
        stale: frames that exist and must be made again.
        gone: frames of the output that the input has no longer.
        changed: whether any input changed since the report was written.
        must_record: whether the record must be written even if no frame is made.
        notes: what was made again, and why, one line each.
    """

    inputs: SequenceInput
    writer: SequenceWriter
    grid: str
    compare: CompareInputs
    stale: set[int] = field(default_factory=set)
    gone: set[int] = field(default_factory=set)
    changed: bool = False
    must_record: bool = False
    notes: list[str] = field(default_factory=list)
    _record: MadeFrom = field(default_factory=MadeFrom)
    _own: dict[str, str] = field(default_factory=dict)
    _whole: str = ""
    _made: dict[int, str] = field(default_factory=dict)
    _is_prepared: bool = False
    _has_begun: bool = False

    @property
    def replaced(self) -> frozenset[int]:
        """Frames whose scans in the output are of an earlier state of the input."""
        return frozenset(self._record.replaced)

    @property
    def _name(self) -> str:
        return f"made-{self.grid}"

    def prepare(self, run: Run, steps: Callable[[int], None]) -> None:
        """Prepare the sequence, once."""
        if not self._is_prepared:
            self._is_prepared = True
            self.inputs.prepare(self.writer, run, steps)

    def look(
        self, existing: Collection[int], agrees: Callable[[int], bool | None], run: Run
    ) -> None:
        """Find the frames that must be made again.

        Args:
            existing: frames that exist in the output.
            agrees: makes a frame again, and returns whether the existing one is equal; None if it
                cannot be made.
            run: how the reading of files is spread.
        """
        inputs, files = self.inputs, self.inputs.files()
        record = self._record = MadeFrom.read(self.writer, self._name)
        if files is None or (self.compare == "never" and existing):
            return
        contents = content_digests(files, inputs.depended(), self.writer, self.compare, run)
        inputs.take_contents(contents)
        self._own = {
            str(frame): combined(content, inputs.about(frame))
            for frame, content in sorted(contents.items())
        }
        self._whole = combined(sorted(self._own.items()), inputs.shared())
        self.changed = self.must_record = bool(record.frames) and self._whole != record.whole
        recorded = {frame: record.frames.get(str(frame)) for frame in existing}
        if not self.changed and all(recorded.values()):
            return
        self.prepare(run, StepCounter(None))
        self.gone = {int(frame) for frame in record.frames} - set(inputs.available())
        self.stale = {
            frame for frame, made in recorded.items() if made not in (None, self._made_from(frame))
        }
        if self.stale:
            why = describe_changes(record.own, self._own)
            if not why:
                was_interrupted = "" in recorded.values()
                why = "a run was interrupted" if was_interrupted else "what all scans share changed"
            self.notes.append(f"{self.writer.location}: {made_again(self.stale, why)}")
        if unknown := [frame for frame in sorted(existing) if recorded[frame] is None]:
            self._accept(unknown, agrees)
            self.must_record = True

    def _made_from(self, frame: int) -> str:
        if frame not in self._made:
            self._made[frame] = self.inputs.made_from(frame, self._own, self._whole)
        return self._made[frame]

    def _accept(self, unknown: list[int], agrees: Callable[[int], bool | None]) -> None:
        """Compare some frames without a record with what is made now."""
        sample = {unknown[place] for place in (0, len(unknown) // 2, -1)}
        equal = [agree for frame in sorted(sample) if (agree := agrees(frame)) is not None]
        if not all(equal):
            self.stale |= set(unknown)
        what = "which are equal" if all(equal) else "which differ, so all are made again"
        self.notes.append(
            f"{self.writer.location}: {count(len(unknown), 'frame')} of {self.grid} without a "
            f"record of what they were made from: {len(equal)} made again, {what}"
        )

    def begin(self, numbers: Collection[int], missing: Collection[int]) -> None:
        """Write the record of the frames that are about to be made, once, and remove those of which
        the input has no scan any more. The sequence is prepared.

        Args:
            numbers: all frames of the run.
            missing: those that do not exist.
        """
        if not self._whole or self._has_begun:
            return
        record, inputs, self._has_begun = self._record, self.inputs, True
        if self.gone:
            self.writer.remove_frames(inputs.written(self.writer, self.grid), self.gone)
        changed = {
            frame.number
            for frame in inputs.frames
            if record.own.get(str(frame.source_frame), "") != self._own[str(frame.source_frame)]
        }
        record.replaced = tuple(sorted({*record.replaced, *(self.stale & changed)}))
        for frame in self.gone:
            del record.frames[str(frame)]
        record.frames |= {
            str(frame): "" if frame in self.stale else self._made_from(frame)
            for frame in sorted(numbers)
            if frame in missing or frame in self.stale or str(frame) not in record.frames
        }
        # only a run that ends says that all frames and the report are of these inputs
        record.own, record.whole = self._own, "" if self.changed or self.stale else self._whole
        record.write(self.writer, self._name)

    def finish(self, made: Collection[int]) -> None:
        """Complete the record, after the frames and the report were written.

        Args:
            made: frames that were made.
        """
        if not self._whole:
            return
        record = MadeFrom.read(self.writer, self._name)  # other parts may have written it
        again = self.stale & set(made)
        record.frames |= {str(frame): self._made_from(frame) for frame in sorted(again)}
        record.replaced = tuple(frame for frame in record.replaced if frame not in again)
        record.whole = self._whole
        record.write(self.writer, self._name)
