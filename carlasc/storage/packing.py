"""Packing sequences into one store, which is several times smaller, and unpacking them to the published files again."""

from __future__ import annotations

import os
import time
from collections import deque
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

from carlasc.errors import ArgumentError, ConflictError, StorageError
from carlasc.storage import layout
from carlasc.storage.folders.folder import FolderSink
from carlasc.storage.folders.published import PublishedSequence
from carlasc.storage.opening import as_source, open, open_sink
from carlasc.storage.packed.output import put_in_place, unfinished
from carlasc.storage.packed.protocol import Options, PackedSource
from carlasc.storage.protocol import Sequence, SequenceWriter, Source

Progress = Callable[[int, int], None]
_BLOCK = 8  # frames that are read together


@dataclass
class PackResult:
    """What `pack` did.

    Attributes:
        out: the store.
        sequences: paths of the sequences in it.
        frames: number of frames of all sequences.
        published_bytes: bytes of the published files, per field ("documents": the text files).
        stored_bytes: bytes in the store, per field ("documents": the text files, "index": everything else).
        left_out: files that the layout does not know, which are not packed: "<sequence>: <file>".
        elapsed_s: seconds that it took.
    """

    out: Path
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


@dataclass
class UnpackResult:
    """What `unpack` did.

    Attributes:
        out: the folder.
        sequences: paths of the sequences in it.
        files: number of files written.
        kept: number of files that an interrupted run had written.
        elapsed_s: seconds that it took.
    """

    out: Path
    sequences: list[str] = field(default_factory=list)
    files: int = 0
    kept: int = 0
    elapsed_s: float = 0.0


def pack(
    source: str | os.PathLike[str] | Source,
    out: str | os.PathLike[str],
    *,
    small: bool = False,
    lossy_mm: float | None = None,
    overwrite: bool = False,
    threads: int = 2,
    progress: Progress | None = None,
) -> PackResult:
    """Pack all sequences of `source` into one store. Nothing is lost, unless `lossy_mm` is given.

    An interrupted run leaves `<out>.part`, which cannot be opened. The same call again finishes it: zarr and Parquet continue after the
    last finished sequence, HDF5 starts again.

    Args:
        source: what to pack: anything that `carlasc.open` takes, or a source.
        out: the store to write; its ending, `.zarr`, `.h5` or `.parquet`, says of which kind.
        small: PCodec for points (zarr only): smaller, but fewer programs can read it.
        lossy_mm: quantise points to this many millimetres, which the store records. None keeps every bit.
        overwrite: replace a store that exists at `out`.
        threads: number of threads that read ahead.
        progress: called with (files done, all files).

    Returns:
        What was packed, with the bytes before and after.

    Raises:
        ArgumentError: `out` has another ending, or an option does not fit it.
        ConflictError: something exists at `out`, or `out` lies inside `source`.
        DependencyError: the package for this kind of store is not installed.
        FormatError, MissingDataError: a file of the source is damaged or missing.
        StorageError: the store cannot be written: a full disk, a folder without write permission.
    """
    began = time.perf_counter()
    options = Options(small, lossy_mm)
    _check_threads(threads)
    source = as_source(source)
    result = PackResult(Path(out))
    _refuse_overlap(result.out, source)
    sequences = source.sequences()
    step = _steps(sequences, progress)
    with _writing(result.out), open_sink(result.out, options, overwrite) as sink:
        for path, sequence in sequences.items():
            result.sequences.append(path)
            result.frames += len(sequence.scan_frames())
            if isinstance(sequence, PublishedSequence):
                result.left_out += [f"{path or '.'}: {name}" for name in sequence.unknown_files()]
            finished = sink.finished(path)
            with nullcontext() if finished else sink.sequence(path) as writer:
                if writer is not None:
                    writer.identity = (sequence.split, sequence.name, sequence.coordinates)
                _pack_sequence(sequence, writer, result.published_bytes, step, threads)
    result.stored_bytes = cast(PackedSource, open(result.out)).stored_bytes()
    result.elapsed_s = time.perf_counter() - began
    return result


def unpack(
    source: str | os.PathLike[str] | Source,
    out: str | os.PathLike[str],
    *,
    overwrite: bool = False,
    threads: int = 2,
    progress: Progress | None = None,
) -> UnpackResult:
    """Write all sequences of `source` as published files: for a packed store, the same bytes that were packed.

    An interrupted run leaves `<out>.part`; the same call again continues with the files that are missing.

    Args:
        source: a packed store, or anything else that `carlasc.open` takes, or a source.
        out: the folder to write.
        overwrite: write into a folder that exists and replace files of the same names; other files stay.
        threads: number of threads that read ahead.
        progress: called with (files done, all files).

    Returns:
        What was written.

    Raises:
        ConflictError: something exists at `out`, or `out` lies inside `source`.
        FormatError, MissingDataError: a part of the source is damaged or missing.
        StorageError: the files cannot be written: a full disk, a folder without write permission.
    """
    began = time.perf_counter()
    _check_threads(threads)
    source = as_source(source)
    result = UnpackResult(Path(out))
    _refuse_overlap(result.out, source)
    if result.out.exists() and not overwrite:
        raise ConflictError(
            result.out,
            expected="nothing there",
            found="a folder" if result.out.is_dir() else "a file",
            advice="choose another name, or give `overwrite=True`",
        )
    folder = result.out if result.out.exists() else unfinished(result.out)
    sequences = source.sequences()
    step = _steps(sequences, progress)
    for path, sequence in sequences.items():
        result.sequences.append(path)
        writer = FolderSink(folder).sequence(path)
        for name in sequence.documents():
            writer.write_document(name, sequence.read_document(name))
        for name in sorted(sequence.fields()):
            frames = [frame for frame in sequence.frames(name).tolist() if overwrite or not writer.has(name, frame)]
            kept = len(sequence.frames(name)) - len(frames)
            for frame, array in _read_ahead(sequence, name, frames, threads):
                writer.write(name, frame, array)
                step(1)
            step(kept)
            result.kept += kept
            result.files += len(frames)
    if folder != result.out:
        put_in_place(folder, result.out, overwrite=False)
    result.elapsed_s = time.perf_counter() - began
    return result


@contextmanager
def _writing(out: Path) -> Iterator[None]:
    """Report a store that cannot be written; sources raise their own errors."""
    try:
        yield
    except OSError as error:
        raise StorageError(
            out,
            problem=f"cannot be written: {error.strerror or error}",
            advice="fix that and run the same command again to finish it",
        ) from error


def _check_threads(threads: int) -> None:
    if threads < 1:
        raise ArgumentError("threads", expected="1 or more", found=str(threads))


def _pack_sequence(
    sequence: Sequence,
    writer: SequenceWriter | None,
    published_bytes: dict[str, int],
    step: Callable[[int], None],
    threads: int,
) -> None:
    """Copy a sequence field by field and add up its published bytes; None for the writer of a sequence that is already packed."""
    documents = {name: sequence.read_document(name) for name in sequence.documents()}
    published_bytes["documents"] = published_bytes.get("documents", 0) + sum(map(len, documents.values()))
    if writer is not None:
        for name, data in documents.items():
            writer.write_document(name, data)
    for name in sorted(sequence.fields()):
        entry, frames = layout.field_named(name), sequence.frames(name).tolist()
        for frame, array in _read_ahead(sequence, name, frames, threads):
            if writer is not None:
                writer.write(name, frame, array)
            itemsize = np.dtype(entry.dtype).itemsize if entry.dtype else array.itemsize
            published_bytes[name] = published_bytes.get(name, 0) + array.size * itemsize
            step(1)


def _read_ahead(sequence: Sequence, name: str, frames: list[int], threads: int) -> Iterator[tuple[int, NDArray[Any]]]:
    """Yield a field's frames in order, while threads read the next blocks."""
    blocks = [frames[first : first + _BLOCK] for first in range(0, len(frames), _BLOCK)]
    with ThreadPoolExecutor(threads) as pool:
        ahead: deque[Future[list[NDArray[Any]]]] = deque()
        for number, block in enumerate(blocks):
            while len(ahead) < threads and number + len(ahead) < len(blocks):
                ahead.append(pool.submit(sequence.read_many, name, blocks[number + len(ahead)]))
            yield from zip(block, ahead.popleft().result(), strict=True)


def _steps(sequences: Mapping[str, Sequence], progress: Progress | None) -> Callable[[int], None]:
    """Return a function that counts files and reports the count to `progress`."""
    total = sum(len(sequence.frames(name)) for sequence in sequences.values() for name in sequence.fields())
    done = 0

    def step(files: int) -> None:
        nonlocal done
        done += files
        if progress is not None and files:
            progress(done, total)

    return step


def _refuse_overlap(out: Path, source: Source) -> None:
    """Refuse to write into the source, or over it."""
    if "://" in source.location:
        return
    place, origin = out.resolve(), Path(source.location).resolve()
    if place == origin or place.is_relative_to(origin) or origin.is_relative_to(place):
        raise ConflictError(
            out,
            expected=f"a path outside of {source.location}",
            found="one inside it or around it",
            advice="choose another path",
        )
