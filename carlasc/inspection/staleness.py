"""Whether the grids of a sequence are of the scans, labels, poses and times that are beside them
now, by the records of what they were made from.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping

import numpy as np

from carlasc.captures.raw import RAW, Capture, CaptureFiles
from carlasc.core.frames import FrameRange
from carlasc.errors import ArgumentError, CarlascError, count
from carlasc.inspection.findings import Finding, Severity
from carlasc.running.spreading import Run
from carlasc.storage.folder import FolderSequence, FolderWriter
from carlasc.storage.inputs import (
    ACCEPTED,
    PROVISIONAL,
    FrameFiles,
    MadeFrom,
    SequenceFiles,
    combined,
    content_digests,
    describe_changes,
)
from carlasc.storage.protocol import Sequence, SequenceWriter
from carlasc.storage.resuming import RECORD

_SEED = 0
_ADVICE = "make the grid again with the command that made it: it makes what changed again"


class _Records(SequenceWriter):
    """Reads the records of a sequence, and writes nothing."""

    def __init__(self, sequence: Sequence) -> None:
        self.sequence = sequence
        self.location = sequence.location

    def has(self, field: str, frame: int) -> bool:
        return frame in self.sequence.frames(field)

    def write(self, field: str, frame: int, array: object) -> None:
        """Write nothing."""

    def write_document(self, name: str, data: bytes) -> None:
        """Write nothing."""

    def read_document(self, name: str) -> bytes | None:
        """Return a record; None if there is none, or the store does not list it."""
        try:
            return self.sequence.read_document(name)
        except CarlascError:
            return None


def check_inputs(sequence: Sequence) -> Iterator[Finding]:
    """Yield a finding for each grid whose inputs changed since it was made."""
    for grid in sequence.grids:
        if changes := changed_inputs(sequence, grid):
            where = f"{sequence.location}/{grid}"
            yield Finding("warning", "inputs", where, "what it was made from", changes, _ADVICE)


def check_sample(sequence: Sequence, count: int, run: Run) -> Iterator[Finding]:
    """Make some frames of each grid again from the scans beside it, and yield a finding for each
    grid with a frame that differs, and a note for each that was compared.
    """
    from carlasc.groundtruth.run import FrameTask  # compiled code, which `info` does not need
    from carlasc.inspection.reports import inputs_of

    for grid in sequence.grids:
        inputs = inputs_of(sequence, grid)
        where = f"{sequence.location}/{grid}"
        frames = sequence.frames(f"{grid}/labels")
        if inputs is None or not len(frames):
            continue
        chosen = np.random.default_rng(_SEED).permutation(frames)[:count].tolist()
        different = list[int]()
        try:
            inputs.prepare(None, run, lambda steps: None)
            for number in sorted(chosen):
                frame = inputs.frame(number)
                task = FrameTask(number, frame, inputs.plan, inputs.metadata.classes, False)
                made = task.run().outputs.get(f"{grid}/labels")
                there = sequence.read(f"{grid}/labels", number)
                if made is None or not np.array_equal(made.reshape(-1), there.reshape(-1)):
                    different.append(number)
        except CarlascError as error:
            yield Finding.from_error("inputs", where, error, _ADVICE)
            continue
        found = f"{len(different)} of {len(chosen)} frames that differ (seed {_SEED})"
        if different:
            found = f"{found}, the first is {different[0]}"
        kind: Severity = "warning" if different else "note"
        expected = "what is made of the scans now"
        advice = _ADVICE if different else ""
        yield Finding(kind, "inputs", where, expected, found, advice)


def record_inputs(sequence: Sequence) -> Iterator[Finding]:
    """Accept the frames of grids without a record of what they were made from, as made of the
    inputs as they are now; and yield a note for each grid.

    Raises:
        ArgumentError: such a grid is not in a folder.
    """
    for grid in sequence.grids:
        frames = sequence.frames(f"{grid}/labels").tolist()
        record = _record(sequence, grid)
        unknown = [frame for frame in frames if str(frame) not in record.frames]
        now = _own_now(sequence, grid, record)
        if not unknown or not now or changed_inputs(sequence, grid):
            continue
        if not isinstance(sequence, FolderSequence):
            found = sequence.location
            raise ArgumentError("record", expected="a folder, which keeps records", found=found)
        accepted = {str(frame): ACCEPTED for frame in unknown}
        accepted_record = MadeFrom(record.whole, record.own or now, record.frames | accepted)
        accepted_record.write(FolderWriter(sequence.folder), f"made-{grid}")
        found = f"none of {count(len(unknown), 'frame')}: they count as made of the inputs of now"
        where = f"{sequence.location}/{grid}"
        expected = "a record of what frames were made from"
        yield Finding("note", "inputs", where, expected, found)


def changed_inputs(sequence: Sequence, grid: str) -> str:
    """Return what changed of the inputs of a grid since it was made, such as "scan 12 changed";
    empty if nothing did, or if it is not known.
    """
    record = _record(sequence, grid)
    if record.whole == PROVISIONAL:
        return "provisional grids, made while the drive grew"
    if not record.own or not (now := _own_now(sequence, grid, record)):
        return ""
    # an output may have a part of the scans only, but none that its input has not
    is_capture = sequence.params(grid)[RECORD]["observe"] == "capture"
    required = record.own if is_capture else record.frames
    before = {frame: own for frame, own in record.own.items() if frame in now or frame in required}
    return describe_changes(before, now)


def _record(sequence: Sequence, grid: str) -> MadeFrom:
    return MadeFrom.read(_Records(sequence), f"made-{grid}")


def _own_now(sequence: Sequence, grid: str, record: MadeFrom) -> dict[str, str]:
    """Return the digests of the frames that a grid is made from, those of its record if it has one;
    none if they are not known.
    """
    made = sequence.params(grid).get(RECORD)
    if not isinstance(made, dict):
        return {}
    try:
        files, known = _files(sequence, made)
        if files is None:
            return {}
        window = [int(end) for end in str(made.get("window", "0:0")).split(":")]
        near = {int(n) + i for n in record.frames for i in range(window[0], window[1] + 1)}
        wanted = [
            frame for frame in known if not record.own or str(frame) in record.own or frame in near
        ]
        contents = content_digests(files, wanted, _Records(sequence))
        estimated = made.get("poses") == "kiss-icp"
        return {
            str(frame): combined(content, _about(sequence, made["observe"], frame, estimated))
            for frame, content in contents.items()
        }
    except (CarlascError, OSError, KeyError, ValueError):  # which other checks report
        return {}


def _files(sequence: Sequence, made: Mapping[str, object]) -> tuple[FrameFiles | None, list[int]]:
    """Return the files that a grid was made from, if they are beside it, and their frames."""
    if made["observe"] == "scans":
        return SequenceFiles(sequence), sequence.frames("points").tolist()
    if made["observe"] == "grid":
        finer = [f"{made['grid']}/{part}" for part in ("labels", "counts")]
        return SequenceFiles(sequence, *finer), sequence.frames(finer[0]).tolist()
    if isinstance(sequence, FolderSequence) and (sequence.folder.parent / RAW).is_dir():
        capture = Capture(sequence.folder.parent)
        frames = FrameRange.of(str(made["frames"])).select(capture.frames)
        return CaptureFiles(capture), frames.tolist()
    return None, []


def _about(sequence: Sequence, observe: str, frame: int, estimated: bool) -> object:
    """Return what a run records of a frame besides its files (see `SequenceInput.about`)."""
    if observe == "capture":
        return None
    if observe == "grid":
        return []
    pose = b"" if estimated else sequence.read_pose(frame).tobytes()
    return pose, float(sequence.times_of([frame])[0])
