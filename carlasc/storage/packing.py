"""Packing sequences into one store, which is several times smaller."""

from __future__ import annotations

import time
from collections import Counter, deque
from collections.abc import Iterator, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import nullcontext
from dataclasses import dataclass, field, replace
from pathlib import Path, PurePath
from typing import TYPE_CHECKING, cast

import numpy as np

from carlasc.core.arrays import AnyArray
from carlasc.errors import ArgumentError, ConflictError, check_types
from carlasc.running.spreading import Progress, Run, StepCounter
from carlasc.storage import layout
from carlasc.storage.copying import (
    FrameBlock,
    blocks_of,
    copy_blocks,
    copy_documents,
    record_of,
    refuse_overlap,
    typical_rows,
)
from carlasc.storage.files import AnyPath, storage_error
from carlasc.storage.inputs import combined, sequence_state
from carlasc.storage.opening import as_source, open, open_sink
from carlasc.storage.packed.stores import PackedSink, PackedSource, PackOptions, check_names
from carlasc.storage.protocol import Sequence, Source
from carlasc.storage.published import PublishedSequence
from carlasc.storage.shares import Share
from carlasc.storage.transport.trees import is_url

if TYPE_CHECKING:
    from carlasc.storage.zarr.zarr_sink import ZarrSink, ZarrWriter

_BLOCK = 8  # frames per read
_AHEAD = 2  # threads that read ahead, for stores with one writer


@dataclass
class PackResult:
    """Result of `pack`.

    Attributes:
        out: the store: a path, or a URL.
        is_finished: whether the store can be opened; if not, other parts of the run are missing,
            and sizes are not known yet.
        sequences: paths of the sequences in it.
        frames: number of frames of all sequences.
        published_bytes: bytes of the published files, per field ("documents": the text files).
        stored_bytes: bytes in the store, per field ("documents": the text files, "index":
            everything else).
        left_out: files that are not part of the layout and were not packed: "<sequence>: <file>".
        elapsed_s: duration, seconds.
    """

    out: Path | str
    is_finished: bool = False
    sequences: list[str] = field(default_factory=list)
    frames: int = 0
    published_bytes: dict[str, int] = field(default_factory=dict)
    stored_bytes: dict[str, int] = field(default_factory=dict)
    left_out: list[str] = field(default_factory=list)
    elapsed_s: float = 0.0

    @property
    def ratio(self) -> float:
        """Bytes in the store per published byte."""
        return sum(self.stored_bytes.values()) / max(1, sum(self.published_bytes.values()))


def pack(
    source: AnyPath | Source,
    out: AnyPath,
    *,
    small: bool = False,
    lossy_mm: float | None = None,
    overwrite: bool = False,
    run: Run = Run(),  # noqa: B008 (frozen)
) -> PackResult:
    """Pack all sequences of `source` into one store.

    Packing is lossless, unless `lossy_mm` is given.

    An interrupted run leaves a store that cannot be opened: a `.zarr` at `out`, others at
    `<out>.part`. The same call finishes it: zarr continues with the missing blocks of frames,
    Parquet after the last finished sequence, HDF5 starts again. Worker processes import the main
    module again: in scripts, call this function under `if __name__ == "__main__":`, or with
    `workers=1`.

    Args:
        source: what to pack: anything that `carlasc.open` takes, or a source.
        out: the store to write, a path or (.zarr) a URL of an object store. The suffix, `.zarr`,
            `.h5` or `.parquet`, determines its kind.
        small: compress points with PCodec (only .zarr): smaller, but fewer programs can read it.
        lossy_mm: round coordinates of points to this step, in millimetres, which the store records.
            None: exact.
        overwrite: replace an existing store.
        run: how the work is distributed. A `.zarr` is packed in blocks of frames: by worker
            processes (default: one per core, fewer for few blocks), by an executor, or in parts;
            the last part to finish completes the store. Other stores have one writer: `workers` is
            the number of threads that read ahead of it. Progress counts files.

    Returns:
        The packed sequences, with the bytes before and after.

    Raises:
        ArgumentError: `out` has another suffix, or an option is not supported by this kind of
            store.
        ConflictError: something exists at `out`, `out` lies inside `source`, or `source` changed
            since an interrupted run.
        DependencyError: the package for this kind of store is not installed.
        FormatError, MissingDataError: a file of the source is damaged or missing.
        StorageError: the store cannot be written: a full disk, a folder without write permission.
    """
    check_types(pack, locals())
    began = time.perf_counter()
    options = PackOptions(small, lossy_mm)
    run.part.refuse(overwrite)
    if PurePath(out).suffix != ".zarr" and (run.executor is not None or run.part.count > 1):
        raise ArgumentError(
            "part" if run.executor is None else "executor",
            expected="a .zarr store, which several processes can write",
            found=out,
        )
    source = as_source(source)
    refuse_overlap(out, source)
    result = PackResult(str(out) if is_url(out) else Path(out))
    share = Share(source, run)
    sequences = share.sequences()
    check_names([*sequences], source.location)
    for path, sequence in sequences.items():
        result.sequences.append(path)
        result.frames += len(sequence.scan_frames())
        if isinstance(sequence, PublishedSequence):
            result.left_out += [f"{path or '.'}: {name}" for name in sequence.unknown_files()]
    try:
        if PurePath(out).suffix == ".parquet":
            states = [
                sequence_state(one, one.fields(), one.documents()) for one in sequences.values()
            ]
            options = replace(options, made_from=combined(states))
        sink = open_sink(out, options, overwrite)
        if isinstance(sink, PackedSink):
            result.published_bytes = _append(sequences, sink, run.progress, run.workers or _AHEAD)
            sink.finish()
        elif not _pack_blocks(share, sequences, sink, run):
            return replace(result, elapsed_s=time.perf_counter() - began)
    except OSError as error:  # of the store; sources raise their own errors
        raise storage_error(result.out, error) from error
    packed = cast(PackedSource, open(out))
    result.published_bytes = result.published_bytes or packed.published_bytes()
    result.stored_bytes = packed.stored_bytes()
    result.is_finished = True
    result.elapsed_s = time.perf_counter() - began
    return result


def _pack_blocks(share: Share, sequences: Mapping[str, Sequence], sink: ZarrSink, run: Run) -> bool:
    """Pack the blocks of one part of the run, in any number of processes, and return whether the
    store is finished.
    """
    if sink.is_finished and run.part.count == 1:
        raise ConflictError(
            sink.location,
            expected="a new path",
            found="a finished store",
            advice="choose another name, or give `overwrite=True`",
        )
    blocks: list[FrameBlock] = []
    writers: list[ZarrWriter] = []
    for path, sequence in sequences.items():
        writers.append(writer := sink.sequence(path))
        writer.identity = (sequence.split, sequence.name, sequence.coordinates)
        copy_documents(sequence, writer, run.part)
        fields = {name: sequence.frames(name).tolist() for name in sequence.fields()}
        writer.expect(fields, typical_rows(sequence))
        blocks += blocks_of(sequence, writer, writer.block)
    copy_blocks(blocks, share.run)
    for writer in writers:
        writer.close()
    for writer in writers:
        writer.refresh()
    if run.part.count > 1:
        paths = (path for place in share.others for path in share.whole.sequences_in([place]))
        if any(block.missing().files for block in blocks) or not all(
            sink.sequence(path).is_complete() for path in paths
        ):
            return False  # another part finishes the store
    sink.finish()
    for writer in writers if run.part.count == 1 else ():
        writer.remove_document(record_of(run.part))
    return True


def _append(
    sequences: Mapping[str, Sequence], sink: PackedSink, progress: Progress | None, threads: int
) -> dict[str, int]:
    """Pack sequences one after the other, field by field, and return their published bytes by
    field. Of sequences that are already packed, only the bytes are added up.
    """
    frames_of = {
        path: {name: sequence.frames(name).tolist() for name in sorted(sequence.fields())}
        for path, sequence in sequences.items()
    }
    files = sum(len(frames) for fields in frames_of.values() for frames in fields.values())
    step = StepCounter(progress, files)
    published: Counter[str] = Counter()
    for path, sequence in sequences.items():
        documents = {name: sequence.read_document(name) for name in sequence.documents()}
        published["documents"] += sum(map(len, documents.values()))
        with nullcontext() if sink.finished(path) else sink.sequence(path) as writer:
            if writer is not None:
                writer.identity = (sequence.split, sequence.name, sequence.coordinates)
                for name, data in documents.items():
                    writer.write_document(name, data)
                writer.expect(frames_of[path], typical_rows(sequence))
            for name, frames in frames_of[path].items():
                dtype = layout.field_named(name).dtype
                for frame, array in _read_ahead(sequence, name, frames, threads):
                    if writer is not None:
                        writer.write(name, frame, array)
                    published[name] += array.size * np.dtype(dtype or array.dtype).itemsize
                    step(1)
    return dict(published)


def _read_ahead(
    sequence: Sequence, name: str, frames: list[int], threads: int
) -> Iterator[tuple[int, AnyArray]]:
    """Yield the frames of a field in order. Threads read the next blocks in advance."""
    blocks = [frames[first : first + _BLOCK] for first in range(0, len(frames), _BLOCK)]
    with ThreadPoolExecutor(threads) as pool:
        ahead: deque[Future[list[AnyArray]]] = deque()
        for number, block in enumerate(blocks):
            while len(ahead) < threads and number + len(ahead) < len(blocks):
                ahead.append(pool.submit(sequence.read_many, name, blocks[number + len(ahead)]))
            yield from zip(block, ahead.popleft().result(), strict=True)
