"""`export`: sequences of the layout as another data set's files."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Collection, Generator, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path, PurePosixPath
from typing import Any

from numpy.typing import NDArray

from carlasc import storage
from carlasc.converting.exporter import Exported, Exporter, FrameExporter, SequenceExporter
from carlasc.converting.options import make_exporter
from carlasc.converting.places import check_outside
from carlasc.converting.records import ExportRecord
from carlasc.converting.registry import load_exporter
from carlasc.converting.results import Failure, Progress, Steps
from carlasc.errors import CarlascError, FormatError, MissingDataError, StorageError
from carlasc.running.engines import Engine
from carlasc.running.options import Run
from carlasc.running.parts import Part
from carlasc.running.processes import one_pool, run_all
from carlasc.storage.durability import make_folder, rename, sync_tree
from carlasc.storage.files import has_content, remove_stale, write_many


@dataclass(frozen=True)
class ExportResult:
    """The result of `export`.

    Attributes:
        out: root of the data set that was written.
        sequences: the folder of each sequence in it, or its file where a format has one, by the sequence's path in the source.
        made: number of frames that were written.
        skipped: number of frames that existed already.
        failures: frames that could not be written.
        notes: remarks about the result, one line each.
        elapsed_s: duration in seconds.
    """

    out: Path
    sequences: dict[str, str]
    made: int
    skipped: int
    failures: tuple[Failure, ...]
    notes: tuple[str, ...]
    elapsed_s: float


def export(
    name: str,
    source: str | os.PathLike[str] | storage.Source,
    out: str | os.PathLike[str],
    *,
    sequences: Collection[str] | None = None,
    overwrite: bool = False,
    workers: int | None = None,
    executor: Engine | None = None,
    part: Part = Part(),  # noqa: B008 (frozen)
    progress: Progress | None = None,
    **options: Any,
) -> ExportResult:
    """Write sequences of the layout as another data set's files, so that its tools can read them.

    A second run skips the frames that exist; where a format has one file per sequence, it skips the sequences that are complete. A frame
    that cannot be written is reported in the result, and the others are written.

    Args:
        name: the other data set: one of `exporter_names()`.
        source: anything that `carlasc.open` takes, or a Source.
        out: folder to write to.
        sequences: names of the sequences to export; None exports all.
        overwrite: write frames again that exist.
        workers: number of frames that are made at the same time; None uses all cores.
        executor: runs the work instead of processes of our own; it is not shut down.
        part: exports only this part of the frames, or of the sequences where each is one file; other commands export the others. The part
            that finds that nothing is missing any more writes what the data set has once.
        progress: called with the number of finished frames and the number of all frames.
        **options: of the exporter: the arguments of its constructor, such as `grid`. Text is read as the type of the option.

    Returns:
        What was written, what was skipped, and what failed.

    Raises:
        ArgumentError: no exporter has that name, or it has no such option.
        MissingDataError: a sequence does not exist, or lacks what the export needs.
        ConflictError: `out` lies inside `source`, or holds an export of other sequences or with other options.
        StorageError: the output cannot be written. The files written so far are complete.
    """
    start = time.perf_counter()
    exporter = make_exporter(load_exporter(name), options)
    opened, root = storage.as_source(source), Path(out)
    check_outside(root, opened.location)
    every = _by_name(opened)
    folders = exporter.folders(list(every))  # of all sequences: a folder's name does not depend on which are exported
    chosen, notes = [], []
    for sequence in _choose(every, sequences, opened.location):
        notes += exporter.check(sequence)
        chosen.append(Exported(sequence, folders[sequence.name], tuple(exporter.frames(sequence))))
        if not chosen[-1].frames:
            notes.append(f"{sequence.location} has no frame to export")
    record = ExportRecord(root, name, exporter.product)
    places = {_place(exporter, exported): exported.sequence for exported in chosen}
    if not overwrite:
        record.check(places, exporter.settings)
    record.write(places, exporter.settings)
    remove_stale(root)
    ours = _deal(exporter, chosen, part)
    steps = Steps(progress, sum(len(exported.frames) for exported in ours))
    with one_pool(Run(workers, executor)) as pooled:
        run = partial(run_all, run=pooled, lost=_fail)
        done = _Done([], 0, [])
        for exported in ours:
            folder = root / exported.folder
            remove_stale(folder)
            documents = exporter.documents(exported.sequence)
            write_many({folder / document: data for document, data in documents.items()})
            done += _export_sequence(exporter, exported, folder, overwrite, run, steps)
    if part.count == 1 or all(_is_whole(exporter, exported, root / exported.folder) for exported in chosen):
        index = exporter.index(root, done.exported if part.count == 1 else chosen)
        write_many({root / file: data for file, data in index.items()})
    written = sum(len(exported.frames) for exported in done.exported)
    return ExportResult(
        root,
        {exported.sequence.path: _place(exporter, exported) for exported in chosen},
        written - done.skipped,
        done.skipped,
        tuple(done.failures),
        tuple(dict.fromkeys(notes)),
        time.perf_counter() - start,
    )


@dataclass(frozen=True)
class _Done:
    """What exists after some sequences were exported."""

    exported: list[Exported]
    skipped: int
    failures: list[Failure]

    def __add__(self, other: _Done) -> _Done:
        return _Done(self.exported + other.exported, self.skipped + other.skipped, self.failures + other.failures)


@dataclass(frozen=True)
class _Job:
    """A frame to make."""

    exporter: FrameExporter | SequenceExporter
    sequence: storage.Sequence
    frame: int
    folder: Path


_Run = Callable[[Callable[[_Job], Any], Sequence[_Job]], Generator[Any, None, None]]


def _by_name(source: storage.Source) -> dict[str, storage.Sequence]:
    """Return the sequences of a source by name: the Cartesian one where a sequence has both coordinates.

    Raises:
        FormatError: two sequences have the same name, and would be written to the same place.
    """
    found: dict[str, storage.Sequence] = {}
    for sequence in source.sequences().values():
        other = found.get(sequence.name)
        if other is not None and (other.split, sequence.coordinates) != (sequence.split, _other_coordinates(other)):
            raise FormatError(
                source.location,
                expected="sequences of different names",
                found=f"{other.path} and {sequence.path}",
                advice="export them one after the other, each to a folder of its own",
            )
        if other is None or sequence.coordinates == "cartesian":
            found[sequence.name] = sequence
    return found


def _other_coordinates(sequence: storage.Sequence) -> str:
    return "cylindrical" if sequence.coordinates == "cartesian" else "cartesian"


def _choose(
    found: Mapping[str, storage.Sequence], wanted: Collection[str] | None, location: str
) -> list[storage.Sequence]:
    if wanted is not None and (unknown := [name for name in wanted if name not in found]):
        raise MissingDataError(
            location, expected=f"the sequences {', '.join(unknown)}", found=f"only {', '.join(found)}"
        )
    return [sequence for name, sequence in found.items() if wanted is None or name in wanted]


def _place(exporter: Exporter, exported: Exported) -> str:
    """Return what belongs to one sequence only: its folder, or its file where several sequences share a folder."""
    if isinstance(exporter, SequenceExporter):
        return PurePosixPath(exported.folder, exporter.file(exported.sequence)).as_posix()
    return exported.folder


def _deal(exporter: Exporter, chosen: Sequence[Exported], part: Part) -> list[Exported]:
    """Return the sequences of a part, each with its frames of that part: a sequence that is one file is in one part."""
    if isinstance(exporter, SequenceExporter):
        return list(part.take(chosen))
    dealt = set(part.take([(n, frame) for n, exported in enumerate(chosen) for frame in exported.frames]))
    ours = [
        replace(exported, frames=tuple(frame for frame in exported.frames if (n, frame) in dealt))
        for n, exported in enumerate(chosen)
    ]
    return [exported for exported in ours if exported.frames or part.count == 1]


def _is_whole(exporter: Exporter, exported: Exported, folder: Path) -> bool:
    """Whether all frames of a sequence are exported."""
    sequence = exported.sequence
    if isinstance(exporter, SequenceExporter):
        path = folder / exporter.file(sequence)
        return has_content(path) and set(exported.frames) <= set(exporter.frames_in(path, sequence))
    assert isinstance(exporter, FrameExporter)
    files = (file for frame in exported.frames for file in exporter.frame_files(sequence, frame))
    return all(has_content(folder / file) for file in files)


def _export_sequence(
    exporter: Exporter, exported: Exported, folder: Path, overwrite: bool, run: _Run, steps: Steps
) -> _Done:
    if isinstance(exporter, FrameExporter):
        return _export_frames(exporter, exported, folder, overwrite, run, steps)
    assert isinstance(exporter, SequenceExporter)
    return _export_file(exporter, exported, folder, overwrite, run, steps)


def _export_frames(
    exporter: FrameExporter, exported: Exported, folder: Path, overwrite: bool, run: _Run, steps: Steps
) -> _Done:
    """Write the frames of a sequence that do not exist yet, each in files of its own."""
    sequence = exported.sequence
    jobs = [
        _Job(exporter, sequence, frame, folder)
        for frame in exported.frames
        if overwrite or not all(has_content(folder / file) for file in exporter.frame_files(sequence, frame))
    ]
    steps(len(exported.frames) - len(jobs))
    failures = []
    with closing(run(_write_frame, jobs)) as results:
        for job, problem in zip(jobs, results, strict=True):
            if problem is not None:
                failures.append(Failure(sequence.location, job.frame, problem))
            steps()
    return _done(exported, len(exported.frames) - len(jobs), failures)


def _fail(job: _Job, message: str) -> str:
    """Return the result of a frame that no worker could finish."""
    return message


def _write_frame(job: _Job) -> str | None:
    """Write one frame's files; return the error message if it cannot be done."""
    assert isinstance(job.exporter, FrameExporter)
    try:
        files = job.exporter.make_frame(job.sequence, job.frame)
        write_many({job.folder / file: data for file, data in files.items()})
    except StorageError:
        raise
    except (CarlascError, OSError) as error:
        return str(error)
    return None


def _export_file(
    exporter: SequenceExporter, exported: Exported, folder: Path, overwrite: bool, run: _Run, steps: Steps
) -> _Done:
    """Write the file of a sequence, unless it exists with all frames. A file that lacks frames is made anew."""
    sequence, path = exported.sequence, folder / exporter.file(exported.sequence)
    if not overwrite and _is_whole(exporter, exported, folder):
        steps(len(exported.frames))
        return _done(exported, len(exported.frames), [])
    part = path.with_name(f"{path.name}.part")
    jobs = [_Job(exporter, sequence, frame, folder) for frame in exported.frames]
    failures = []
    try:
        make_folder(path.parent)
        part.unlink(missing_ok=True)  # of a run that was killed
        with closing(run(_make_frame, jobs)) as results, exporter.open(part, sequence) as file:
            for frame, made in zip(exported.frames, results, strict=True):
                problem = made if isinstance(made, str) else _add(file.add, frame, made)
                if problem is not None:
                    failures.append(Failure(sequence.location, frame, problem))
                steps()
        if len(failures) < len(exported.frames):
            sync_tree(part)
            rename(part, path)
    except OSError as error:
        raise StorageError(path, problem=f"cannot be written: {error.strerror or error}") from error
    finally:
        part.unlink(missing_ok=True)
    return _done(exported, 0, failures)


def _make_frame(job: _Job) -> Mapping[str, NDArray[Any]] | str:
    """Return the arrays of a frame, or the error message if it cannot be done."""
    assert isinstance(job.exporter, SequenceExporter)
    try:
        return job.exporter.make_frame(job.sequence, job.frame)
    except (CarlascError, OSError) as error:
        return str(error)


def _add(add: Callable[[int, Any], None], frame: int, content: Mapping[str, NDArray[Any]]) -> str | None:
    try:
        add(frame, content)
    except CarlascError as error:
        return str(error)
    return None


def _done(exported: Exported, skipped: int, failures: list[Failure]) -> _Done:
    failed = {failure.frame for failure in failures}
    frames = tuple(frame for frame in exported.frames if frame not in failed)
    return _Done([replace(exported, frames=frames)], skipped, failures)
