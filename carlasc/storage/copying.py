"""`unpack`, and copying frames block by block in any number of processes, which packing uses too.

Unpacking writes every sequence of a store as published files.
"""

from __future__ import annotations

import os
import time
from collections.abc import Mapping
from collections.abc import Sequence as Series
from contextlib import closing
from dataclasses import dataclass, field, replace
from pathlib import Path, PurePosixPath

import numpy as np

from carlasc.core.arrays import AnyArray
from carlasc.errors import ConflictError, check_types
from carlasc.running.processes import run_all
from carlasc.running.spreading import Part, Run, StepCounter, check_shared
from carlasc.storage import layout
from carlasc.storage.files import AnyPath, unfinished
from carlasc.storage.folder import FolderSink
from carlasc.storage.inputs import combined, sequence_state
from carlasc.storage.opening import as_source
from carlasc.storage.packed.output import put_in_place
from carlasc.storage.protocol import Sequence, SequenceWriter, Sink, Source
from carlasc.storage.shares import Share
from carlasc.storage.transport.trees import is_url

_FEW = 4  # minimum number of tasks per process, because starting a process takes time
_SAMPLED = 5  # number of frames that are read to estimate the size of frames


@dataclass(frozen=True)
class FrameBlock:
    """The frames that one task copies.

    Attributes:
        sequence: the sequence that they are read from.
        writer: writes them.
        frames: frame numbers by field.
    """

    sequence: Sequence
    writer: SequenceWriter
    frames: dict[str, list[int]]

    @property
    def files(self) -> int:
        """Number of published files of these frames."""
        return sum(map(len, self.frames.values()))

    def missing(self) -> FrameBlock:
        """Return the frames that the writer lacks."""
        has = self.writer.has
        lacking = {
            name: [frame for frame in frames if not has(name, frame)]
            for name, frames in self.frames.items()
        }
        return FrameBlock(
            self.sequence, self.writer, {name: frames for name, frames in lacking.items() if frames}
        )


def blocks_of(sequence: Sequence, writer: SequenceWriter, size: int) -> list[FrameBlock]:
    """Return all frames of a sequence in blocks of `size` frame numbers."""
    blocks: dict[int, dict[str, list[int]]] = {}
    for name in sorted(sequence.fields()):
        for frame in sequence.frames(name).tolist():
            blocks.setdefault(frame // size, {}).setdefault(name, []).append(frame)
    return [FrameBlock(sequence, writer, blocks[number]) for number in sorted(blocks)]


def copy_blocks(blocks: Series[FrameBlock], run: Run, *, again: bool = False) -> tuple[int, int]:
    """Copy the blocks of a part of a run in parallel.

    Existing frames are not written again, unless `again` is given.

    Returns:
        The number of files that were written, and the number of existing files that were kept.
    """
    ours = run.part.take(blocks)
    todo = [
        block for block in (ours if again else [block.missing() for block in ours]) if block.files
    ]
    total = sum(block.files for block in ours)
    files = 0
    step = StepCounter(run.progress, total)
    left = total - sum(block.files for block in todo)
    step(left)
    if run.workers is None and run.executor is None:
        run = replace(run, workers=max(1, min(run.processes, len(todo) // _FEW)))
    for place in {
        place for block in todo for place in (block.sequence.location, block.writer.location)
    }:
        check_shared(place, run)
    with closing(run_all(_copy, todo, run)) as copied:
        for count in copied:
            step(count)
            files += count
    return files, left


def _copy(block: FrameBlock) -> int:
    found: dict[int, dict[str, AnyArray]] = {}
    for name, frames in block.frames.items():
        for frame, array in zip(frames, block.sequence.read_many(name, frames), strict=True):
            found.setdefault(frame, {})[name] = array
    block.writer.write_frames(found)
    return block.files


def record_of(part: Part) -> str:
    """Return the text file by which a part knows the input that it copies: each part may read a
    copy of the input on a machine of its own.
    """
    return f"{layout.COPIED}{part.number}-of-{part.count}.json"


def copy_documents(
    sequence: Sequence, writer: SequenceWriter, part: Part, made_from: str = ""
) -> None:
    """Copy the text files of a sequence.

    Equal files, from an interrupted run or another part of this run, are kept.

    Args:
        sequence: the sequence.
        writer: writes the copy.
        part: the part of the run.
        made_from: digest of what else the copy is made from.

    Raises:
        ConflictError: an existing text file is different, or the sequence changed since an earlier
            run of this part.
    """
    for name in sequence.documents():
        data = sequence.read_document(name)
        if not writer.create_document(name, data) and writer.read_document(name) != data:
            raise ConflictError(
                f"{writer.location}/{name}",
                expected="the text file of this source",
                found="a different file",
                advice="choose another name, or remove the existing output",
            )
    state = combined(made_from, sequence_state(sequence, sequence.fields(), ())).encode()
    record = record_of(part)
    if not writer.create_document(record, state) and writer.read_document(record) != state:
        raise ConflictError(
            writer.location,
            expected=f"{sequence.location} as it was in the earlier run",
            found="files that changed",
            advice="remove the output, or choose another name",
        )


def typical_rows(sequence: Sequence) -> dict[str, int]:
    """Return the largest number of elements of a few frames by field, for `SequenceWriter.expect`.

    The choice of frames is deterministic.

    Fields with one row per point have the size of `points`. Grids and boxes are left out, because
    their sizes are known.
    """
    found: dict[str, int] = {}
    for name in sorted(sequence.fields()):
        entry = layout.field_named(name)
        frames = sequence.frames(name)
        if entry.per in ("voxel", "box") or (
            entry.per == "point" and name != "points" and "points" in sequence.fields()
        ):
            continue
        places = np.unique(np.linspace(0, len(frames) - 1, _SAMPLED).astype(np.int64))
        found[name] = max(len(sequence.read(name, frame)) for frame in frames[places].tolist())
    return found


def refuse_overlap(out: AnyPath, source: Source) -> None:
    """Check that the output and the source do not contain each other.

    Raises:
        ConflictError: one is inside the other.
    """
    place, origin = (
        PurePosixPath(os.fspath(one)) if is_url(one) else Path(one).resolve()
        for one in (out, source.location)
    )
    if place == origin or place.is_relative_to(origin) or origin.is_relative_to(place):
        raise ConflictError(
            out,
            expected=f"a path outside of {source.location}",
            found="a path inside or above it",
            advice="choose another path",
        )


_BLOCK = 16  # frames that one task unpacks


@dataclass
class UnpackResult:
    """What `unpack` did.

    Attributes:
        out: the folder: a path, or a URL.
        sequences: paths of the sequences in it.
        files: number of files written.
        kept: number of existing files of an interrupted run.
        elapsed_s: duration, seconds.
    """

    out: Path | str
    sequences: list[str] = field(default_factory=list)
    files: int = 0
    kept: int = 0
    elapsed_s: float = 0.0


def unpack(
    source: AnyPath | Source,
    out: AnyPath,
    *,
    overwrite: bool = False,
    run: Run = Run(),  # noqa: B008 (frozen)
) -> UnpackResult:
    """Write all sequences of `source` as published files.

    A packed store gives the same bytes that were packed.

    An interrupted run leaves `<out>.part`; the same call continues with the missing files. In an
    object store, and in a run of several parts, files are written to `out` directly. Worker
    processes import the main module again: in scripts, call this function under `if __name__ ==
    "__main__":`, or with `workers=1`.

    Args:
        source: a packed store, or anything else that `carlasc.open` takes, or a source.
        out: the folder to write: a path, or a URL of an object store.
        overwrite: write into an existing folder, and replace files of the same names.
        run: how the work is distributed. The default is one process per core, fewer for few frames.
            Progress counts files.

    Returns:
        What was written.

    Raises:
        ConflictError: something exists at `out`, `out` lies inside `source`, or `source` changed
            since an earlier run.
        FormatError, MissingDataError: a part of the source is damaged or missing.
        StorageError: the files cannot be written: a full disk, a folder without write permission.
    """
    check_types(unpack, locals())
    began = time.perf_counter()
    source = as_source(source)
    refuse_overlap(out, source)
    result = UnpackResult(str(out) if is_url(out) else Path(out))
    # renamed when it is complete; object stores and several parts write to their place
    final = None if is_url(out) or overwrite or run.part.count > 1 else Path(out)
    if final is not None and final.exists():
        raise ConflictError(
            final,
            expected="a new path",
            found="a folder" if final.is_dir() else "a file",
            advice="choose another name, or give `overwrite=True`",
        )
    share = Share(source, run)
    sink = FolderSink(result.out if final is None else unfinished(final))
    write_files(share.sequences(), sink, result, share.run, run.part, again=overwrite)
    if final is not None:
        put_in_place(unfinished(final), final, overwrite=False)
        for path in result.sequences:
            FolderSink(final).sequence(path).remove_document(record_of(run.part))
    result.elapsed_s = time.perf_counter() - began
    return result


def write_files(
    sequences: Mapping[str, Sequence],
    sink: Sink,
    result: UnpackResult,
    run: Run,
    part: Part,
    made_from: str = "",
    *,
    again: bool,
) -> None:
    """Write the sequences of a part of a run, and add to the result what was written.

    `made_from` is a digest of what they are made from, besides their files.
    """
    blocks = list[FrameBlock]()
    for path, sequence in sequences.items():
        result.sequences.append(path)
        writer = sink.sequence(path)
        if again:
            writer.remove_document(record_of(part))
            for name in sequence.documents():
                writer.write_document(name, sequence.read_document(name))
        else:
            copy_documents(sequence, writer, part, made_from)
        blocks += blocks_of(sequence, writer, _BLOCK)
    result.files, result.kept = copy_blocks(blocks, run, again=again)
