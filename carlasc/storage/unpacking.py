"""Unpacking: every sequence of a store as published files again."""

from __future__ import annotations

import os
import time
from dataclasses import dataclass, field
from pathlib import Path

from carlasc.errors import ConflictError
from carlasc.running.spreading import Run
from carlasc.storage.copying import blocks_of, copy_blocks, copy_documents, counter, refuse_overlap
from carlasc.storage.durability import unfinished
from carlasc.storage.folder import FolderSink
from carlasc.storage.opening import as_source
from carlasc.storage.packed.output import put_in_place
from carlasc.storage.protocol import Source
from carlasc.storage.transport.trees import is_url

_BLOCK = 16  # frames that one task unpacks


@dataclass
class UnpackResult:
    """What `unpack` did.

    Attributes:
        out: the folder: a path, or a URL.
        sequences: paths of the sequences in it.
        files: number of files written.
        kept: number of files that an interrupted run had written.
        elapsed_s: seconds that it took.
    """

    out: Path | str
    sequences: list[str] = field(default_factory=list)
    files: int = 0
    kept: int = 0
    elapsed_s: float = 0.0


def unpack(
    source: str | os.PathLike[str] | Source,
    out: str | os.PathLike[str],
    *,
    overwrite: bool = False,
    run: Run = Run(),  # noqa: B008 (frozen)
) -> UnpackResult:
    """Write all sequences of `source` as published files: for a packed store, the same bytes that were packed.

    An interrupted run leaves `<out>.part`; the same call again continues with the files that are missing. In an object store, and where
    only a part of the files is written, they are in `out` from the beginning. Processes import the main module again: call this under
    `if __name__ == "__main__":` in scripts, or with `workers=1`.

    Args:
        source: a packed store, or anything else that `carlasc.open` takes, or a source.
        out: the folder to write: a path, or a URL of an object store.
        overwrite: write into a folder that exists and replace files of the same names; other files stay.
        run: how the work is spread: by one process per core, and fewer where there are few frames, unless `workers` is given. Steps of
            progress are files.

    Returns:
        What was written.

    Raises:
        ConflictError: something exists at `out`, or `out` lies inside `source`.
        FormatError, MissingDataError: a part of the source is damaged or missing.
        StorageError: the files cannot be written: a full disk, a folder without write permission.
    """
    began = time.perf_counter()
    source = as_source(source)
    refuse_overlap(out, source)
    result = UnpackResult(str(out) if is_url(out) else Path(out))
    in_place = overwrite or run.part.count > 1 or not isinstance(result.out, Path)
    if isinstance(result.out, Path) and result.out.exists() and not in_place:
        raise ConflictError(
            result.out,
            expected="nothing there",
            found="a folder" if result.out.is_dir() else "a file",
            advice="choose another name, or give `overwrite=True`",
        )
    folder = result.out if in_place or not isinstance(result.out, Path) else unfinished(result.out)
    sink, blocks = FolderSink(folder), []
    for path, sequence in source.sequences().items():
        result.sequences.append(path)
        writer = sink.sequence(path)
        if overwrite:
            for name in sequence.documents():
                writer.write_document(name, sequence.read_document(name))
        else:
            copy_documents(sequence, writer)
        blocks += blocks_of(sequence, writer, _BLOCK)
    ours = run.part.take(blocks)
    missing = ours if overwrite else [block.missing() for block in ours]
    total = sum(block.files for block in ours)
    result.kept = total - sum(block.files for block in missing)
    step = counter(run.progress, total)
    step(result.kept)
    result.files = copy_blocks(missing, run, step)
    if isinstance(folder, Path) and isinstance(result.out, Path) and folder != result.out:
        put_in_place(folder, result.out, overwrite=False)
    result.elapsed_s = time.perf_counter() - began
    return result
