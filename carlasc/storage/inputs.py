"""What an output was made from: digests of its inputs, by which a later run notices changed inputs.

Two kinds of small text files in `.carlasc/` beside the outputs hold them. Both may be deleted.

- `inputs-<kind>.json` has the state of the files of each frame of an input (size and time of
  modification; version of an object), and a digest of their content. Only files in another state
  are read again, so copies of a data set, which have other times, count as unchanged.
- `made-<output>.json` has a digest of everything that each frame of an output was made from.
"""

from __future__ import annotations

import os
from abc import ABC, abstractmethod
from collections.abc import Collection, Iterable, Iterator, Mapping
from contextlib import closing, suppress
from dataclasses import asdict, dataclass, field
from functools import partial
from hashlib import blake2b
from pathlib import Path
from typing import Any

import numpy as np

from carlasc.core.arrays import AnyArray
from carlasc.core.choices import CompareInputs
from carlasc.errors import CarlascError, count, first_names, first_runs, tried_twice
from carlasc.running.processes import run_all
from carlasc.running.spreading import Run
from carlasc.storage import layout
from carlasc.storage.files import parse_json, to_json
from carlasc.storage.protocol import Sequence, SequenceWriter, Source
from carlasc.storage.transport.trees import Tree

ACCEPTED = "accepted"
"""In the place of the digest of a frame: it counts as made of the inputs in the record."""
PROVISIONAL = "provisional"
"""In the place of the digest of all inputs: the output was made while its input grew."""
_FORMAT = 1
_BYTES = 16  # of the digest of a file
_SHORT = 8  # bytes of the digests in records
_BLOCK = 32  # frames that one task reads
_UNREADABLE = ""  # never equal to another state or digest, so that it is read again
_NAMED = 3  # ranges of frames that a note names


def digest_of(field: str, array: AnyArray) -> bytes:
    """Return the digest (BLAKE2b, 16 bytes) of a field of a frame: the digest of its published
    file, for all stores.

    Votes are compressed in their file, so their digest is that of their rows.

    Raises:
        FormatError: the array does not fit the field.
    """
    entry = layout.field_named(field)
    data = (
        np.ascontiguousarray(array).tobytes()
        if entry.kind in ("votes", "velocities")
        else entry.encode(array, field)
    )
    return digest_of_bytes(data)


def digest_of_bytes(data: bytes | memoryview) -> bytes:
    """Return the digest (BLAKE2b, 16 bytes) of the bytes of a file."""
    return blake2b(data, digest_size=_BYTES).digest()


def combined(*parts: object) -> str:
    """Return a digest of values: bytes, texts, numbers, and tuples, lists and mappings of them."""
    digest = blake2b(digest_size=_SHORT)
    for part in parts:
        data = part if isinstance(part, bytes) else repr(part).encode()
        digest.update(len(data).to_bytes(8, "little") + data)
    return digest.hexdigest()


class FrameFiles(ABC):
    """The files of each frame of an input. It is sent to workers.

    Attributes:
        kind: name of their table of digests.
        tree: the tree of files; None if they are not files.
    """

    kind: str
    tree: Tree | None

    @abstractmethod
    def paths(self, frame: int) -> list[str]:
        """Return the files of a frame in the tree; empty if they are not known."""

    @abstractmethod
    def contents(self, frame: int) -> Iterator[tuple[str, bytes]]:
        """Yield the name and the digest of each part of a frame.

        Raises:
            CarlascError: the frame cannot be read.
        """


class SequenceFiles(FrameFiles):
    """The files of a sequence in any store: the fields of scans, and some fields of grids.

    A digest is that of the published files, so it is the same in all stores.
    """

    def __init__(self, sequence: Sequence, *more: str) -> None:
        self.sequence = sequence
        tree = sequence.tree
        self.tree = tree if isinstance(tree, Tree) else None
        self.kind = more[0].partition("/")[0] if more else "scans"
        self.fields = sorted(sequence.fields() & {*layout.SCAN_FIELDS, *more})

    def _fields(self, frame: int) -> Iterator[str]:
        yield from (name for name in self.fields if frame in self.sequence.frames(name))

    def paths(self, frame: int) -> list[str]:
        """Return the files that hold the fields of a frame."""
        return [
            path for name in self._fields(frame) for path in self.sequence.files_of(name, [frame])
        ]

    def contents(self, frame: int) -> Iterator[tuple[str, bytes]]:
        """Yield the name and the digest of each field."""
        for name in self._fields(frame):
            yield name, digest_of(name, self.sequence.read(name, frame))


def content_digests(
    files: FrameFiles,
    frames: Iterable[int],
    writer: SequenceWriter | None = None,
    compare: CompareInputs = "fast",
    run: Run = Run(workers=1),  # noqa: B008 (frozen)
) -> dict[int, str]:
    """Return a digest of the content of each frame; empty if it cannot be read.

    Args:
        files: the files.
        frames: numbers of the frames.
        writer: keeps the table; None: all files are read.
        compare: "fast" reads only files whose state differs from that in the table.
        run: how the reading is spread.
    """
    wanted = list(frames)
    document = layout.record_file(f"inputs-{files.kind}")
    known = {} if writer is None else _read_rows(writer, document)
    states = _states(files, wanted)
    fresh = {
        frame: known[frame][1]
        for frame in wanted
        if compare != "content"
        and frame in known
        and states[frame] != _UNREADABLE
        and states[frame] == known[frame][0]
    }
    others = [frame for frame in wanted if frame not in fresh]
    if others:
        blocks = [others[i : i + _BLOCK] for i in range(0, len(others), _BLOCK)]
        quiet = Run(run.workers, run.executor) if len(blocks) > 1 else Run(workers=1)
        with closing(run_all(partial(_digests, files), blocks, quiet)) as read:
            for block, digests in zip(blocks, read, strict=True):
                fresh |= zip(block, digests, strict=True)
    rows = {frame: (states[frame], fresh[frame]) for frame in wanted if fresh[frame]}
    if writer is not None and rows != {frame: row for frame, row in known.items() if frame in rows}:
        every = dict(sorted((known | rows).items()))
        writer.write_document(document, to_json({"format": _FORMAT, "frames": every}))
    return fresh


def _digests(files: FrameFiles, frames: list[int]) -> list[str]:
    """Return the digests of some frames, in a worker."""
    # an error is reported when the frame is used
    found = list(map(tried_twice, [partial(_digest, files, frame) for frame in frames]))
    return [digest or _UNREADABLE for digest in found]


def _digest(files: FrameFiles, frame: int) -> str:
    return combined(*files.contents(frame))


def _states(files: FrameFiles, frames: list[int]) -> dict[int, str]:
    """Return the state of the files of each frame, empty if it is not known."""
    paths = {frame: files.paths(frame) for frame in frames}
    every = dict.fromkeys(path for own in paths.values() for path in own)
    states = {} if files.tree is None else files.tree.states(list(every))
    return {
        frame: combined(*(states[path] for path in own))
        if own and all(states.get(path) for path in own)
        else _UNREADABLE
        for frame, own in paths.items()
    }


def sequence_states(source: Source, *more: str) -> dict[str, str]:
    """Return the state of the text files, the scans and the pictures of each sequence of a source,
    by path, and of more fields.
    """
    states = {}
    for path, sequence in source.sequences().items():
        own = [name for name in sequence.fields() if "/" not in name]
        texts = [name for name in sequence.documents() if "/" not in name]
        states[path] = sequence_state(sequence, [*own, *more], texts)
    return states


def sequence_state(sequence: Sequence, fields: Iterable[str], texts: Iterable[str]) -> str:
    """Return the state of some fields and text files of a sequence."""
    files = SequenceFiles(sequence, *fields)
    frames = {frame for name in files.fields for frame in sequence.frames(name).tolist()}
    return combined(
        _states(files, sorted(frames)), [(name, sequence.read_document(name)) for name in texts]
    )


def _read_rows(writer: SequenceWriter, document: str) -> dict[int, tuple[str, str]]:
    """Return the rows of a table of digests; empty without one, or with one of another version."""
    with suppress(KeyError, ValueError, TypeError, AttributeError):
        rows = _read_record(writer, document)["frames"]
        return {int(frame): (state, digest) for frame, (state, digest) in rows.items()}
    return {}


def _read_record(writer: SequenceWriter, document: str) -> dict[str, Any]:
    """Return the content of a record; empty without one, or with one of another version."""
    data = writer.read_document(document)
    with suppress(CarlascError):
        values = {} if data is None else parse_json(data, document)
        return values if values.pop("format", None) == _FORMAT else {}
    return {}


@dataclass
class MadeFrom:
    """The record of what the frames of an output were made from.

    Attributes:
        whole: digest of all inputs of the sequence; or `PROVISIONAL`.
        own: digest of the own files, the pose and the time of each frame of the input.
        frames: digest of everything that a frame of the output was made from; empty while a frame
            that exists is made again.
    """

    whole: str = ""
    own: dict[str, str] = field(default_factory=dict)
    frames: dict[str, str] = field(default_factory=dict)

    @classmethod
    def read(cls, writer: SequenceWriter, output: str) -> MadeFrom:
        """Return the record of an output; an empty one without any, or with one that cannot be
        read.
        """
        with suppress(KeyError, ValueError, TypeError, AttributeError):
            values = _read_record(writer, layout.record_file(output))
            frames = {str(int(frame)): str(made) for frame, made in values["frames"].items()}
            return cls(str(values["whole"]), dict(values["own"]), frames)
        return cls()

    def write(self, writer: SequenceWriter, output: str) -> None:
        """Write the record, unless it is equal to the existing one."""
        if self != self.read(writer, output):
            writer.write_document(layout.record_file(output), self._to_json())

    def create(self, writer: SequenceWriter, output: str) -> None:
        """Write the record, unless there is one."""
        writer.create_document(layout.record_file(output), self._to_json())

    def _to_json(self) -> bytes:
        return to_json({"format": _FORMAT, **asdict(self)})


def folder_states(places: Mapping[str, Path]) -> dict[str, str]:
    """Return the state of the files in each folder below some places: their names, sizes and times.

    Args:
        places: folders or files, by the name that their states get.
    """
    states = dict[str, str]()
    seen = set[str]()
    todo = [(name, str(place)) for name, place in places.items()]
    while todo:
        name, place = todo.pop()
        if (real := os.path.realpath(place)) in seen:  # a link to a folder above
            continue
        seen.add(real)
        files = list[tuple[str, int, int]]()
        try:
            entries = list(os.scandir(place))
        except NotADirectoryError:
            about = os.stat(place)
            files.append(("", about.st_size, about.st_mtime_ns))
            entries = []
        except OSError:  # such as a folder that may not be read: the converter reports it
            continue
        for entry in entries:
            with suppress(OSError):  # a broken link
                if entry.is_dir():
                    todo.append((f"{name}/{entry.name}".lstrip("/"), entry.path))
                else:
                    about = entry.stat()
                    files.append((entry.name, about.st_size, about.st_mtime_ns))
        states[name] = combined(sorted(files))
    return states


def changed_names(old: Mapping[str, str], new: Mapping[str, str]) -> str:
    """Return the names whose states differ: "velodyne, labels changed"."""
    names = sorted(name for name in old.keys() | new.keys() if old.get(name) != new.get(name))
    return f"{first_names((name or '.' for name in names), _NAMED)} changed"


def describe_changes(old: Mapping[str, str], new: Mapping[str, str]) -> str:
    """Return what differs between the own digests of the frames of an input: "scan 12 changed";
    empty if nothing does.
    """
    kinds = {
        "changed": [int(frame) for frame in new.keys() & old.keys() if new[frame] != old[frame]],
        "added": list(map(int, new.keys() - old.keys())),
        "removed": [int(frame) for frame in old.keys() - new.keys() if frame.isdecimal()],
    }
    return ", ".join(
        f"scan{'s' * (len(frames) > 1)} {first_runs(sorted(frames), _NAMED)} {kind}"
        for kind, frames in kinds.items()
        if frames
    )


def made_again(frames: Collection[int], why: str) -> str:
    """Return the note on frames that are made again."""
    return f"{count(len(frames), 'frame')} made again: {why}"
