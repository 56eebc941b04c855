"""`export`: writes sequences of the layout in the format of another data set."""

from __future__ import annotations

import itertools
import json
import os
import time
from collections.abc import Collection, Generator, Iterable, Mapping, Sequence
from contextlib import closing, suppress
from dataclasses import dataclass, field, replace
from pathlib import Path, PurePosixPath
from typing import Any

from carlasc import storage
from carlasc.converting.exporter import (
    Exported,
    Exporter,
    FrameExporter,
    SequenceExporter,
    SequenceFile,
)
from carlasc.converting.protocol import Failure, check_outside
from carlasc.converting.registry import load_exporter, read_options
from carlasc.core.arrays import AnyArray
from carlasc.core.choices import CompareInputs
from carlasc.core.classes import TableUse
from carlasc.errors import (
    CarlascError,
    ConflictError,
    FormatError,
    MissingDataError,
    StorageError,
    check_choice,
    check_types,
    only,
)
from carlasc.motion.box_table import ONE_FRAME
from carlasc.running.processes import one_pool, run_all
from carlasc.running.spreading import Part, Run, StepCounter
from carlasc.storage import layout
from carlasc.storage.files import (
    AnyPath,
    has_content,
    make_folder,
    parse_json,
    remove_stale,
    rename,
    sync_tree,
    to_json,
    write_atomic,
    write_many,
)
from carlasc.storage.folder import FolderWriter
from carlasc.storage.inputs import (
    MadeFrom,
    SequenceFiles,
    combined,
    content_digests,
    describe_changes,
    made_again,
)
from carlasc.storage.layout import identity_of
from carlasc.storage.shares import Share, source_in

RECORD = "carlasc-export.json"
"""The file in a folder that records its exports."""


@dataclass(frozen=True)
class ExportResult:
    """The result of `export`.

    Attributes:
        out: root of the data set that was written.
        sequences: the folder of each sequence in it, or its file where a format has one, by the
            sequence's path in the source.
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
    source_classes: tuple[TableUse, ...] = ()


def export(
    name: str,
    source: AnyPath | storage.Source,
    out: AnyPath,
    *,
    sequences: Collection[str] | None = None,
    overwrite: bool = False,
    options: Mapping[str, Any] | None = None,
    compare_inputs: CompareInputs = "fast",
    run: Run = Run(),  # noqa: B008 (frozen)
) -> ExportResult:
    """Write sequences of the layout in the format of another data set, so that its tools can read
    them.

    A second run skips existing frames; if a format has one file per sequence, it skips complete
    sequences. A sequence that changed since then is exported again. A frame that cannot be written
    is reported in the result, and the others are written.

    Args:
        name: the other data set: one of `exporter_names()`.
        source: anything that `carlasc.open` takes, or a Source.
        out: folder to write to.
        sequences: names of the sequences to export; None exports all.
        overwrite: write existing frames again.
        options: options of the exporter, by name, such as `{"grid": "evaluation"}`; text is parsed
            as the type of the option (see `option_declarations`).
        compare_inputs: how it is found out whether a sequence changed: "fast": by the size and the
            time of each file, and by content where these differ; "content": by content; "never":
            existing frames are kept.
        run: how the work is spread. A part exports a share of the frames, or of the sequences if
            each is one file. The last part to finish writes the files that belong to no single
            sequence.

    Returns:
        What was written, what was skipped, and what failed.

    Raises:
        ArgumentError: the exporter or its option does not exist.
        MissingDataError: a sequence does not exist, or lacks data that the export needs.
        ConflictError: `out` lies inside `source`, or holds an export of other sequences or with
            other options.
        StorageError: the output cannot be written. The files written so far are complete.
    """
    check_types(export, locals())
    start = time.perf_counter()
    check_choice("compare_inputs", compare_inputs, CompareInputs)
    kind = load_exporter(name)
    exporter = kind(**read_options(kind, options))
    root = Path(out)
    place = source.location if isinstance(source, storage.Source) else os.fspath(source)
    if (checked := exporter.check_output(place, root)) is not None:
        return ExportResult(
            root, {}, 0, checked[0], (), tuple(checked[1]), time.perf_counter() - start
        )
    opened = storage.as_source(source)
    check_outside(root, opened.location)
    share = Share(opened, run)
    every = _by_name(share)
    # of all sequences: names of folders do not depend on the choice
    places = sorted(f"{place}/cartesian" for place in (*share.own, *share.others))
    names = [identity_of(place)[1] for place in places] if share.others else [*every]
    folders = exporter.folders(names)
    wanted = _choose(every, names, sequences, opened.location)
    if exporter.of_one is not None:
        only(exporter.of_one, {sequence.name: sequence for sequence in wanted}, ONE_FRAME)
    chosen = []
    notes = []
    for sequence in wanted:
        notes += exporter.check(sequence)
        chosen.append(_exported(exporter, sequence, folders))
        if not chosen[-1].frames:
            notes.append(f"{sequence.location} has no frame to export")
    record = ExportRecord(root, name, exporter.product)
    own = {_place(exporter, exported): exported.sequence for exported in chosen}
    if not overwrite:
        record.check(own, exporter.settings)
    record.write(own, exporter.settings)
    remove_stale(root)
    ours = _deal(exporter, chosen, share.run.part)
    steps = StepCounter(run.progress, sum(len(exported.frames) for exported in ours))
    with one_pool(share.run) as pooled:
        writing = _SequenceExport(exporter, root, overwrite, pooled, steps)
        for exported in ours:
            label = f"export-{name}-{exporter.product}/{_place(exporter, exported)}"
            inputs = _ExportedFrom(exporter, root, label, exported, compare_inputs, pooled)
            exists = any(
                _exists(exporter, exported.sequence, frame, root / exported.folder)
                for frame in exported.frames
            )
            if inputs.changed and exists:
                notes.append(f"{root / exported.folder}: {inputs.why(exported)}")
                inputs.remove_gone()
            elif inputs.is_known or not exists:
                inputs.write()
            elif not overwrite and compare_inputs != "never":
                notes.append(f"{root / exported.folder}: {_UNKNOWN}")
            failed = len(writing.failures)
            writing.add(exported, again=inputs.changed)
            # otherwise, frames of before may still be there
            if len(writing.failures) == failed and (inputs.is_known or overwrite):
                inputs.write()
    indexed: Sequence[Exported] | None = writing.exported
    if run.part.count > 1:
        others = (
            _exported(exporter, sequence, folders)
            for place in share.others
            for sequence in _by_name(source_in(opened, [place])).values()
            if sequences is None or sequence.name in sequences
        )
        indexed = _all_whole(exporter, root, itertools.chain(chosen, others))
    if indexed is not None:
        indexed = sorted(indexed, key=lambda exported: names.index(exported.sequence.name))
        own = {_place(exporter, exported): exported.sequence for exported in indexed}
        record.write(own, exporter.settings)  # other parts may have replaced it
        index = exporter.index(root, indexed)
        write_many({root / file: data for file, data in index.items()})
    written = sum(len(exported.frames) for exported in writing.exported)
    return ExportResult(
        root,
        {exported.sequence.path: _place(exporter, exported) for exported in chosen},
        written - writing.skipped,
        writing.skipped,
        tuple(writing.failures),
        tuple(dict.fromkeys(notes)),
        time.perf_counter() - start,
        tuple(sorted({exported.sequence.table_use() for exported in chosen})),
    )


def _by_name(source: storage.Source) -> dict[str, storage.Sequence]:
    """Return the sequences of a source by name.

    If a sequence has both coordinates, the Cartesian one is taken.

    Raises:
        FormatError: two sequences have the same name, so that they would be written to the same
            place.
    """
    by_name: dict[str, storage.Sequence] = {}
    for sequence in source.sequences().values():
        other = by_name.get(sequence.name)
        if other is not None and (
            other.split != sequence.split or other.coordinates == sequence.coordinates
        ):
            raise FormatError(
                source.location,
                expected="sequences of different names",
                found=f"{other.path} and {sequence.path}",
                advice="export them one after the other, each to a folder of its own",
            )
        if other is None or sequence.coordinates == "cartesian":
            by_name[sequence.name] = sequence
    return by_name


def _choose(
    by_name: Mapping[str, storage.Sequence],
    names: Collection[str],
    wanted: Collection[str] | None,
    location: str,
) -> list[storage.Sequence]:
    if wanted is not None and (unknown := [name for name in wanted if name not in names]):
        raise MissingDataError(
            location,
            expected=f"the sequences {', '.join(unknown)}",
            found=f"only {', '.join(names)}",
        )
    return [sequence for name, sequence in by_name.items() if wanted is None or name in wanted]


def _exported(
    exporter: Exporter, sequence: storage.Sequence, folders: Mapping[str, str]
) -> Exported:
    return Exported(sequence, folders[sequence.name], tuple(exporter.frames(sequence)))


def _place(exporter: Exporter, exported: Exported) -> str:
    """Return the place of one sequence only: its folder, or its file if several sequences share a
    folder.
    """
    if isinstance(exporter, SequenceExporter):
        return PurePosixPath(exported.folder, exporter.file(exported.sequence)).as_posix()
    return exported.folder


def _deal(exporter: Exporter, chosen: Sequence[Exported], part: Part) -> list[Exported]:
    """Return the sequences of a part, each with its frames of that part.

    A sequence that is one file is in one part.
    """
    if isinstance(exporter, SequenceExporter):
        return list(part.take(chosen))
    dealt = set(
        part.take([(n, frame) for n, exported in enumerate(chosen) for frame in exported.frames])
    )
    ours = [
        replace(exported, frames=tuple(frame for frame in exported.frames if (n, frame) in dealt))
        for n, exported in enumerate(chosen)
    ]
    return [exported for exported in ours if exported.frames or part.count == 1]


def _all_whole(exporter: Exporter, root: Path, every: Iterable[Exported]) -> list[Exported] | None:
    """Return sequences if all of them are exported; the first that is not ends the search."""
    found = list[Exported]()
    for exported in every:
        if not _is_whole(exporter, exported, root / exported.folder):
            return None
        found.append(exported)
    return found


def _is_whole(exporter: Exporter, exported: Exported, folder: Path) -> bool:
    """Whether all frames of a sequence are exported."""
    sequence = exported.sequence
    if isinstance(exporter, SequenceExporter):
        path = folder / exporter.file(sequence)
        return has_content(path) and set(exported.frames) <= set(exporter.frames_in(path, sequence))
    return all(_exists(exporter, sequence, frame, folder) for frame in exported.frames)


def _exists(exporter: Exporter, sequence: storage.Sequence, frame: int, folder: Path) -> bool:
    """Whether all files of a frame exist, or the file of its sequence."""
    return all(has_content(folder / file) for file in exporter.frame_files(sequence, frame))


_UNKNOWN = (
    "there is no record of what existing frames were made from: they are kept; "
    '`compare_inputs="content"` compares them'
)
_TEXTS = "-1"  # in the place of a frame: files that belong to no single frame


class _RootFiles(FolderWriter):
    """Keeps records as files in the folder of another data set: a reader of that data set could
    take a folder for one of its own.
    """

    def read_document(self, name: str) -> bytes | None:
        """Return the bytes of a record."""
        return super().read_document(_flat(name))

    def write_document(self, name: str, data: bytes) -> None:
        """Write a record."""
        super().write_document(_flat(name), data)


def _flat(name: str) -> str:
    return "carlasc-" + name.removeprefix(f"{layout.DERIVED}/").replace("/", "-")


class _ExportedFrom:
    """The record of what a sequence was exported from. A frame may depend on all of the sequence.

    Attributes:
        is_known: whether there is a record.
        changed: whether the sequence is not what the record says.
    """

    def __init__(
        self,
        exporter: Exporter,
        root: Path,
        label: str,
        exported: Exported,
        compare: CompareInputs,
        run: Run,
    ) -> None:
        self._exporter = exporter
        self._sequence = exported.sequence
        self._folder = root / exported.folder
        self._writer = _RootFiles(root)
        self._label = f"{label}-{run.part.number}-of-{run.part.count}"
        self._before = self._now = MadeFrom.read(self._writer, self._label)
        self.is_known = bool(self._before.whole)
        self.changed = False
        if compare != "never":
            sequence = self._sequence
            files = SequenceFiles(sequence, *sequence.fields())
            files.kind = self._label
            contents = content_digests(files, exported.frames, self._writer, compare, run)
            own = {str(frame): content for frame, content in contents.items()}
            texts = [
                (text, sequence.read_document(text))
                for text in sequence.documents()
                if not text.endswith(layout.REPORT)
            ]
            whole = combined(sorted(own.items()), texts)
            written = {str(frame): self._files(frame) for frame in exported.frames}
            written[_TEXTS] = "\n".join(exporter.documents(sequence))
            self._now = MadeFrom(whole, own, written)
            self.changed = self.is_known and self._before.whole != whole

    def why(self, exported: Exported) -> str:
        """Return why the sequence is exported again."""
        why = describe_changes(self._before.own, self._now.own) or "its text files changed"
        return made_again(exported.frames, why)

    def _files(self, frame: int) -> str:
        """Return the files of a frame, separated by line breaks."""
        if isinstance(self._exporter, FrameExporter):
            return "\n".join(self._exporter.frame_files(self._sequence, frame))
        return ""

    def remove_gone(self) -> None:
        """Remove the files that the export has no longer, in its own folder: a record of a stranger
        may name any file.
        """
        inside = self._folder.resolve()
        kept = set(self._now.frames[_TEXTS].splitlines())
        for frame in self._exporter.frames(self._sequence):
            kept.update(self._files(frame).splitlines())
        for files in self._before.frames.values():
            for file in set(files.splitlines()) - kept:
                path = inside / file
                if path.parent.resolve().is_relative_to(inside):
                    if path.is_file():  # a run that was killed may have made its folder only
                        path.unlink()
                    with suppress(OSError):  # it is not empty, or not there
                        path.parent.rmdir()

    def write(self) -> None:
        """Write the record."""
        self._now.write(self._writer, self._label)


@dataclass(frozen=True)
class ExportJob:
    """A frame to make."""

    exporter: FrameExporter | SequenceExporter
    sequence: storage.Sequence
    frame: int
    folder: Path


@dataclass
class _SequenceExport:
    """The export of sequences, one after the other.

    Attributes:
        exporter: the exporter.
        root: folder of the other data set.
        overwrite: whether existing frames are written again.
        run: how the work is spread.
        steps: called after each frame.
        exported: the sequences in the output.
        skipped: number of frames that existed before.
        failures: frames that could not be written.
    """

    exporter: Exporter
    root: Path
    overwrite: bool
    run: Run
    steps: StepCounter
    exported: list[Exported] = field(default_factory=list)
    skipped: int = 0
    failures: list[Failure] = field(default_factory=list)
    _again: bool = False

    def add(self, exported: Exported, *, again: bool = False) -> None:
        """Export the frames of a sequence; with `again`, also those that exist."""
        self._again = again or self.overwrite
        sequence = exported.sequence
        folder = self.root / exported.folder
        remove_stale(folder)
        documents = self.exporter.documents(sequence)
        write_many({folder / document: data for document, data in documents.items()})
        write = self._write_frames if isinstance(self.exporter, FrameExporter) else self._write_file
        failures = write(exported, folder)
        self.failures += [
            Failure(sequence.location, frame, message) for frame, message in failures.items()
        ]
        self.exported.append(
            replace(exported, frames=tuple(f for f in exported.frames if f not in failures))
        )

    def _write_frames(self, exported: Exported, folder: Path) -> dict[int, str]:
        """Write the missing frames of a sequence, each in its own files; return the messages of
        those that failed.
        """
        exporter = self.exporter
        sequence = exported.sequence
        assert isinstance(exporter, FrameExporter)
        jobs = [
            ExportJob(exporter, sequence, frame, folder)
            for frame in exported.frames
            if self._again or not _exists(exporter, sequence, frame, folder)
        ]
        self._skip(len(exported.frames) - len(jobs))
        failures = {}
        with closing(self._made(jobs)) as results:
            for job, problem in zip(jobs, results, strict=True):
                if problem is not None:
                    failures[job.frame] = problem
                self.steps()
        return failures

    def _write_file(self, exported: Exported, folder: Path) -> dict[int, str]:
        """Write the file of a sequence, unless it exists with all frames; return the messages of
        those that failed.

        A file that lacks frames is written again.
        """
        exporter = self.exporter
        sequence = exported.sequence
        assert isinstance(exporter, SequenceExporter)
        if not self._again and _is_whole(exporter, exported, folder):
            self._skip(len(exported.frames))
            return {}
        path = folder / exporter.file(sequence)
        part = path.with_name(f"{path.name}.part")
        jobs = [ExportJob(exporter, sequence, frame, folder) for frame in exported.frames]
        failures = {}
        try:
            make_folder(path.parent)
            part.unlink(missing_ok=True)  # of a run that was killed
            with (
                closing(self._made(jobs)) as results,
                exporter.open(part, sequence) as file,
            ):
                for frame, made in zip(exported.frames, results, strict=True):
                    problem = made if isinstance(made, str) else _add(file, frame, made)
                    if problem is not None:
                        failures[frame] = problem
                    self.steps()
            if len(failures) < len(exported.frames):
                sync_tree(part)
                rename(part, path)
        except OSError as error:
            raise StorageError(
                path, problem=f"cannot be written: {error.strerror or error}"
            ) from error
        finally:
            part.unlink(missing_ok=True)
        return failures

    def _skip(self, frames: int) -> None:
        self.skipped += frames
        self.steps(frames)

    def _made(self, jobs: list[ExportJob]) -> Generator[Any, None, None]:
        """Return the results of jobs: the arrays of a frame, or a message if the frame or its
        worker failed.
        """
        return run_all(_make_frame, jobs, self.run, lost=lambda job, message: message)


def _make_frame(job: ExportJob) -> Mapping[str, AnyArray] | str | None:
    """Make a frame, and write its files if it has files of its own; otherwise return its arrays.

    If it cannot be done, return the error message.
    """
    try:
        if isinstance(job.exporter, SequenceExporter):
            return job.exporter.make_frame(job.sequence, job.frame)
        files = job.exporter.make_frame(job.sequence, job.frame)
        write_many({job.folder / file: data for file, data in files.items()})
    except StorageError:
        raise
    except (CarlascError, OSError) as error:
        return str(error)
    return None


def _add(file: SequenceFile, frame: int, content: Mapping[str, AnyArray]) -> str | None:
    try:
        file.add(frame, content)
    except CarlascError as error:
        return str(error)
    return None


class ExportRecord:
    """The record of one exporter's product in a folder.

    Args:
        root: folder of the other data set.
        name: name of the exporter.
        product: the product.
    """

    def __init__(self, root: Path, name: str, product: str) -> None:
        self._path = root / RECORD
        self._name = name
        self._product = product

    def _read(self) -> dict[str, Any]:
        path = self._path
        return parse_json(path.read_bytes(), str(path)) if has_content(path) else {}

    def check(self, sequences: Mapping[str, storage.Sequence], settings: Mapping[str, Any]) -> None:
        """Check that the places of sequences in the folder are new, or hold the same sequences,
        exported with the same settings.

        Raises:
            ConflictError: a place holds something else.
        """
        known = self._read().get(self._name, {}).get(self._product, {})
        wanted = _plain(settings)
        for place, sequence in sequences.items():
            record = known.get(place)
            if record is None:
                continue
            where = self._path.parent / place
            if record["sequence"] != sequence.path:
                raise ConflictError(
                    where,
                    expected=f"the sequence {sequence.path or '.'}",
                    found=f"{record['sequence'] or '.'}, which was exported earlier",
                    advice="write to another folder, or replace it with `overwrite=True`",
                )
            if record["settings"] != wanted:
                raise ConflictError(
                    where,
                    expected=f"frames that were exported with {_listed(wanted)}",
                    found=_listed(record["settings"]),
                    advice="write to another folder, or replace them with `overwrite=True`",
                )

    def write(self, sequences: Mapping[str, storage.Sequence], settings: Mapping[str, Any]) -> None:
        """Add sequences to the record, by their places."""
        every = self._read()
        part = every.setdefault(self._name, {}).setdefault(self._product, {})
        part |= {
            place: {"sequence": s.path, "settings": _plain(settings)}
            for place, s in sequences.items()
        }
        every[self._name][self._product] = dict(sorted(part.items()))
        write_atomic(self._path, to_json(every))


def _plain(settings: Mapping[str, Any]) -> Any:
    return json.loads(json.dumps(dict(settings), default=str))


def _listed(settings: Mapping[str, Any]) -> str:
    return ", ".join(f"{name}={value}" for name, value in settings.items()) or "no options"
