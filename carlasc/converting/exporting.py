"""`export`: sequences of the layout as another data set's files."""

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
from carlasc.converting.places import check_outside
from carlasc.converting.protocol import Exporter
from carlasc.converting.registry import load_converter
from carlasc.converting.results import Failure, Progress, Steps
from carlasc.errors import ArgumentError, CarlascError, MissingDataError, StorageError
from carlasc.running.processes import count_workers, run_all
from carlasc.storage.files import remove_stale, write_atomic


@dataclass(frozen=True)
class ExportResult:
    """The result of `export`.

    Attributes:
        out: root of the data set that was written.
        sequences: the folder of each sequence in it, by the sequence's path in the source.
        made: number of frames that were written.
        skipped: number of frames that existed already.
        failures: frames that could not be written.
        elapsed_s: duration in seconds.
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
    source: str | os.PathLike[str] | storage.Source,
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

    A second run skips the frames that exist. A frame that cannot be written is reported in the result, and the others are written.

    Args:
        name: the other data set: "kitti".
        source: anything that `carlasc.open` takes, or a Source.
        out: folder to write to.
        sequences: names of the sequences to export; None exports all.
        overwrite: write frames again that exist.
        workers: number of frames that are written at the same time; None uses all cores.
        executor: runs the work instead of processes of our own; it is not shut down.
        progress: called with the number of finished frames and the number of all frames.
        **options: of the exporter. "kitti" takes `grid` (the grid that goes to voxels/; None takes the finest) and `predictions`
            (whether grids are the output of a network, which goes to predictions/).

    Returns:
        What was written, what was skipped, and what failed.

    Raises:
        ArgumentError: no data set has that name, it can only be read, or it has no such option.
        MissingDataError: a sequence does not exist.
        ConflictError: `out` lies inside `source`.
        StorageError: the output cannot be written. The files written so far are complete.
    """
    start, workers = time.perf_counter(), count_workers(workers)
    exporter = load_converter(name).exporter(**options)
    if exporter is None:
        raise ArgumentError("name", expected="a data set that can be written", found=f"{name!r}, which is only read")
    opened, root = storage.as_source(source), Path(out)
    check_outside(root, opened.location)
    chosen = _choose(opened, sequences)
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
    """Return the wanted sequences by path, one per name: the Cartesian one where a sequence has both coordinates."""
    found: dict[str, tuple[str, storage.Sequence]] = {}
    for path, sequence in source.sequences().items():
        if sequence.name not in found or sequence.coordinates == "cartesian":
            found[sequence.name] = (path, sequence)
    if wanted is not None and (unknown := [name for name in wanted if name not in found]):
        raise MissingDataError(
            source.location, expected=f"the sequences {', '.join(unknown)}", found=f"only {', '.join(found)}"
        )
    return {path: sequence for name, (path, sequence) in found.items() if wanted is None or name in wanted}


def _export_frame(job: _Job) -> str | None:
    """Write one frame's files; return the error message if it cannot be done."""
    try:
        for file, data in job.exporter.make_frame(job.sequence, job.frame).items():
            write_atomic(job.folder / file, data)
    except StorageError:
        raise
    except (CarlascError, OSError) as error:
        return str(error)
    return None
