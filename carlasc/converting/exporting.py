"""The way back: sequences of the layout as another data set's files."""

from __future__ import annotations

import os
import time
from collections.abc import Collection
from concurrent.futures import Executor
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from carlasc import storage
from carlasc.converting.protocol import Exporter
from carlasc.converting.registry import load_converter
from carlasc.converting.results import Failure, Progress, Steps
from carlasc.errors import ArgumentError, CarlascError, ConflictError, MissingDataError, StorageError
from carlasc.running.processes import count_workers, run_all
from carlasc.storage.files import remove_stale, write_atomic


@dataclass(frozen=True)
class ExportResult:
    """What `export` did.

    Attributes:
        out: the data set.
        sequences: the folder of each sequence in it, by the sequence's path in the source.
        made: frames that were written now.
        skipped: frames that were there already.
        failures: frames that could not be written.
        elapsed_s: how long it took, seconds.
    """

    out: Path
    sequences: dict[str, str]
    made: int
    skipped: int
    failures: tuple[Failure, ...]
    elapsed_s: float


@dataclass(frozen=True)
class _Job:
    sequence: storage.Sequence
    frame: int
    exporter: Exporter
    folder: Path


def export(
    name: str,
    src: str | os.PathLike[str],
    out: str | os.PathLike[str],
    *,
    sequences: Collection[str] | None = None,
    overwrite: bool = False,
    workers: int | None = None,
    executor: Executor | None = None,
    progress: Progress | None = None,
    **options: Any,
) -> ExportResult:
    """Write sequences of the layout as another data set's files, so that its tools can read them.

    A second run skips the frames that are there. A frame that cannot be written is reported in the result and the others go on.

    Args:
        name: the other data set: "kitti".
        src: anything that `carlasc.open` takes.
        out: folder to write to.
        sequences: names of the sequences to export; all if None.
        overwrite: write frames again that are there.
        workers: how many frames are written side by side; all cores if None.
        executor: does the work instead of processes of our own; it is left open.
        progress: called with the number of finished frames and of all.
        **options: of the exporter; "kitti" takes `grid` (which grid goes to voxels/, the finest if None) and `predictions` (whether grids are
            a network's output, and go to predictions/).

    Returns:
        What was written, what was there, what failed.

    Raises:
        ArgumentError: nothing is called so, or it has no way back, or not these options.
        MissingDataError: there is no such sequence.
        ConflictError: `out` lies inside `src`.
        StorageError: the output cannot be written to. What was written is whole.
    """
    start, workers = time.perf_counter(), count_workers(workers)
    exporter = load_converter(name).exporter(**options)
    if exporter is None:
        raise ArgumentError(
            f"export {name!r}", expected="a data set that can be written", found="one that is only read"
        )
    source, root = storage.open(src), Path(out)
    _refuse_overlap(root, source)
    chosen = _choose(source, sequences)
    folders = exporter.folders([sequence.name for sequence in chosen.values()])
    jobs, total = [], 0
    for sequence in chosen.values():
        folder = root / folders[sequence.name]
        remove_stale(folder)
        for document, data in exporter.documents(sequence).items():
            write_atomic(folder / document, data)
        frames = sequence.scan_frames().tolist()
        total += len(frames)
        for frame in frames:
            files = exporter.frame_files(sequence, frame)
            if overwrite or not all((folder / file).is_file() for file in files):
                jobs.append(_Job(sequence, frame, exporter, folder))
    steps, failures = Steps(progress, total), []
    steps(total - len(jobs))
    with closing(run_all(_export_frame, jobs, workers=workers, executor=executor)) as results:
        for job, problem in zip(jobs, results, strict=True):
            if problem is not None:
                failures.append(Failure(job.sequence.location, job.frame, problem))
            steps()
    return ExportResult(
        root,
        {path: folders[sequence.name] for path, sequence in chosen.items()},
        len(jobs) - len(failures),
        total - len(jobs),
        tuple(failures),
        time.perf_counter() - start,
    )


def _choose(source: storage.Source, wanted: Collection[str] | None) -> dict[str, storage.Sequence]:
    """Return the sequences with scans or grids, one of each name: Cartesian ones where both coordinates are there."""
    found: dict[str, tuple[str, storage.Sequence]] = {}
    for path, sequence in source.sequences().items():
        if sequence.name not in found or sequence.coordinates == "cartesian":
            found[sequence.name] = (path, sequence)
    if wanted is not None and (unknown := [name for name in wanted if name not in found]):
        raise MissingDataError(
            source.location, expected=f"the sequences {', '.join(unknown)}", found=f"only {', '.join(found)}"
        )
    return {path: sequence for name, (path, sequence) in found.items() if wanted is None or name in wanted}


def _refuse_overlap(root: Path, source: storage.Source) -> None:
    if "://" in source.location:
        return
    place, origin = root.resolve(), Path(source.location).resolve()
    if place == origin or place.is_relative_to(origin):
        raise ConflictError(
            root,
            expected=f"a place outside {source.location}",
            found="one inside it",
            advice="choose another, the source is never written to",
        )


def _export_frame(job: _Job) -> str | None:
    """Write one frame's files, the last one last; return what is wrong where it cannot be done."""
    try:
        for file, data in job.exporter.make_frame(job.sequence, job.frame).items():
            write_atomic(job.folder / file, data)
    except StorageError:
        raise
    except (CarlascError, OSError) as error:
        return str(error)
    return None
