"""Packing sequences into one store, several times smaller and faster to read, and unpacking them to the published files again."""

from __future__ import annotations

import os
from collections import deque
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

from carlasc.errors import CarlascError, ConflictError
from carlasc.storage import layout
from carlasc.storage.folders.folder import FolderSink
from carlasc.storage.folders.published import PublishedSequence
from carlasc.storage.opening import open, open_sink
from carlasc.storage.packed.arraywriter import put_in_place
from carlasc.storage.packed.store import Options, PackedSource
from carlasc.storage.protocol import Sequence, SequenceWriter, Source

Progress = Callable[[int, int], None]
_BLOCK = 8  # frames read together


@dataclass
class PackResult:
    """What `pack` did.

    Attributes:
        out: the store.
        sequences: paths of the sequences in it.
        frames: frames of all of them.
        published: bytes a field as published files, by field ("documents" are the text files).
        left_out: files that the layout does not know, which stay behind: "<sequence>: <file>".
        stored: bytes a field in the store, what its library adds included ("documents": the text files, "index": the rest).
    """

    out: Path
    sequences: list[str] = field(default_factory=list)
    frames: int = 0
    published: dict[str, int] = field(default_factory=dict)
    left_out: list[str] = field(default_factory=list)
    stored: dict[str, int] = field(default_factory=dict)

    @property
    def ratio(self) -> float:
        """Bytes of the store for each published byte."""
        return sum(self.stored.values()) / max(1, sum(self.published.values()))


@dataclass
class UnpackResult:
    """What `unpack` did.

    Attributes:
        out: the folder.
        sequences: paths of the sequences in it.
        files: files written.
        kept: files that were there already, from a run that was cut off.
    """

    out: Path
    sequences: list[str] = field(default_factory=list)
    files: int = 0
    kept: int = 0


def pack(
    src: str | os.PathLike[str] | Source,
    out: str | os.PathLike[str],
    *,
    small: bool = False,
    lossy_mm: float | None = None,
    overwrite: bool = False,
    workers: int | None = None,
    progress: Progress | None = None,
) -> PackResult:
    """Pack every sequence of `src` into one store. Nothing is lost, unless `lossy_mm` is given.

    A run that was cut off leaves `<out>.part`, which opens as nothing; the same call again goes on from it (zarr: after the last finished
    sequence) and finishes it.

    Args:
        src: what to pack: anything that `carlasc.open` takes, or a source.
        out: the store to write: `.zarr`, `.h5` or `.parquet`.
        small: PCodec for points (zarr only): smaller, but read by fewer programs.
        lossy_mm: quantise points to this many millimetres; it is recorded in the store. None keeps every bit.
        overwrite: replace a store that is there.
        workers: threads that read ahead; 2 if not given.
        progress: called with (files done, files in all).

    Returns:
        What was packed, with the bytes before and after.

    Raises:
        ArgumentError: `out` has another ending, or an option does not fit it.
        ConflictError: something is at `out`, or `out` lies inside `src`.
        FormatError, MissingDataError: what the source says of a file that is damaged or missing.
    """
    options = Options(small, lossy_mm)
    source = src if isinstance(src, Source) else open(src)
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
                _pack_sequence(sequence, writer, result.published, step, workers or 2)
    store = open(result.out)
    result.stored = cast(PackedSource, store).stored_bytes()
    return result


def unpack(
    src: str | os.PathLike[str] | Source,
    out: str | os.PathLike[str],
    *,
    overwrite: bool = False,
    workers: int | None = None,
    progress: Progress | None = None,
) -> UnpackResult:
    """Write every sequence of `src` as published files: from a packed store the very bytes that went in.

    A run that was cut off leaves `<out>.part`; the same call again goes on from it, file by file.

    Args:
        src: a packed store, or anything else that `carlasc.open` takes, or a source.
        out: the folder to write.
        overwrite: write into a folder that is there, over files of the same names; others stay.
        workers: threads that read ahead; 2 if not given.
        progress: called with (files done, files in all).

    Returns:
        What was written.

    Raises:
        ConflictError: something is at `out`, or `out` lies inside `src`.
        FormatError, MissingDataError: what the source says of a part that is damaged or missing.
    """
    source = src if isinstance(src, Source) else open(src)
    result = UnpackResult(Path(out))
    _refuse_overlap(result.out, source)
    if result.out.exists() and not overwrite:
        raise ConflictError(
            result.out, expected="nothing there", found="something", advice="choose another place, or --overwrite"
        )
    folder = result.out if result.out.exists() else result.out.with_name(f"{result.out.name}.part")
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
            for frame, array in _read_ahead(sequence, name, frames, workers or 2):
                writer.write(name, frame, array)
                step(1)
            step(kept)
            result.kept += kept
            result.files += len(frames)
    if folder != result.out:
        put_in_place(folder, result.out, overwrite=False)
    return result


@contextmanager
def _writing(out: Path) -> Iterator[None]:
    """Say what could not be written; sources have errors of their own."""
    try:
        yield
    except OSError as error:
        raise CarlascError(
            f"{out}: cannot be written: {error.strerror or error}: mend that and run the same command again to go on"
        ) from error


def _pack_sequence(
    sequence: Sequence,
    writer: SequenceWriter | None,
    published: dict[str, int],
    step: Callable[[int], None],
    workers: int,
) -> None:
    """Copy a sequence field by field, and add up its published bytes; without a writer it is there already."""
    documents = {name: sequence.read_document(name) for name in sequence.documents()}
    published["documents"] = published.get("documents", 0) + sum(map(len, documents.values()))
    if writer is not None:
        for name, data in documents.items():
            writer.write_document(name, data)
    for name in sorted(sequence.fields()):
        entry, frames = layout.field_named(name), sequence.frames(name).tolist()
        for frame, array in _read_ahead(sequence, name, frames, workers):
            if writer is not None:
                writer.write(name, frame, array)
            itemsize = np.dtype(entry.dtype).itemsize if entry.dtype else array.itemsize
            published[name] = published.get(name, 0) + array.size * itemsize
            step(1)


def _read_ahead(sequence: Sequence, name: str, frames: list[int], workers: int) -> Iterator[tuple[int, NDArray[Any]]]:
    """Read a field's frames in order, some blocks ahead of the one that is asked for."""
    blocks = [frames[first : first + _BLOCK] for first in range(0, len(frames), _BLOCK)]
    with ThreadPoolExecutor(workers) as pool:
        ahead: deque[Future[list[NDArray[Any]]]] = deque()
        for number, block in enumerate(blocks):
            while len(ahead) < workers and number + len(ahead) < len(blocks):
                ahead.append(pool.submit(sequence.read_many, name, blocks[number + len(ahead)]))
            yield from zip(block, ahead.popleft().result(), strict=True)


def _steps(sequences: Mapping[str, Sequence], progress: Progress | None) -> Callable[[int], None]:
    """Return a function that counts files and passes the count on."""
    total = sum(len(sequence.frames(name)) for sequence in sequences.values() for name in sequence.fields())
    done = 0

    def step(files: int) -> None:
        nonlocal done
        done += files
        if progress is not None and files:
            progress(done, total)

    return step


def _refuse_overlap(out: Path, source: Source) -> None:
    """Refuse to write into what is read, or over it."""
    if "://" in source.location:
        return
    place, origin = out.resolve(), Path(source.location).resolve()
    if place == origin or place.is_relative_to(origin) or origin.is_relative_to(place):
        raise ConflictError(
            out,
            expected=f"a place apart from {source.location}",
            found="one inside it or around it",
            advice="choose another",
        )
