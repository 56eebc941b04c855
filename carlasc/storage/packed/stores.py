"""Base classes of all packed stores: options, the check of the root, and reading and writing one
sequence.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Collection, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Generic, Protocol, TypeVar, cast

import numpy as np

from carlasc.core.arrays import AnyArray, IntArray
from carlasc.core.grids import Coordinates
from carlasc.errors import ArgumentError, FormatError, MissingDataError, check_types, within
from carlasc.storage import layout
from carlasc.storage.files import AnyPath, damaged, leads_outside, unfinished
from carlasc.storage.layout import identity_of
from carlasc.storage.packed.output import refuse_existing, unfinished_error
from carlasc.storage.protocol import Sequence, SequenceWriter, Sink, Source

VERSION = 3  # of the format in docs/storage.md, the same for all packed stores
STORE = "carlasc.store"


@dataclass(frozen=True)
class PackOptions:
    """How a store is packed.

    Attributes:
        small: compress points with PCodec: smaller, but readers need the `pcodec` extension of
            numcodecs.
        lossy_mm: quantise points to this many millimetres; None is lossless.
        block: number of frames per file of a zarr store. One task writes a block.
        made_from: digest of the input of a Parquet store. A run that was interrupted with another
            input starts again.

    Raises:
        ArgumentError: `lossy_mm` is not above 0 and at most 1000, or `block` is not from 1 to 1024.
    """

    small: bool = False
    lossy_mm: float | None = None
    block: int = 16
    made_from: str = ""

    def __post_init__(self) -> None:
        check_types(PackOptions, vars(self))
        if self.lossy_mm is not None and not 0 < self.lossy_mm <= 1000:
            raise ArgumentError(
                "lossy_mm", expected="millimetres above 0, up to 1000", found=self.lossy_mm
            )
        if not 1 <= self.block <= 1024:
            raise ArgumentError("block", expected="1 to 1024 frames", found=self.block)

    @property
    def scale_m(self) -> float | None:
        """Size of one step of a quantised coordinate, metres; None if points are not quantised."""
        return None if self.lossy_mm is None else self.lossy_mm / 1000


class PackedSource(Source):
    """A packed store.

    Attributes:
        nodes: the group (or folder) of each sequence in the store, by the sequence's path.
        lossy_mm: rounding step of the coordinates of points, millimetres; None if they are
            lossless.
    """

    nodes: Mapping[str, str]

    def __init__(self, location: str, root: Mapping[str, Any] | None) -> None:
        """Check the attributes of the store's root.

        Raises:
            FormatError: it is not a packed store, is unfinished, has another version, or has a name
                that leads out of the store.
        """
        self.location = location
        self.nodes = _check_root(root, location)
        lossy = (root or {}).get("lossy_mm")
        self.lossy_mm = float(lossy) if isinstance(lossy, int | float) and lossy else None

    def published_bytes(self) -> dict[str, int]:
        """Return the size of the published files by field; empty if it is not recorded."""
        return {}

    def stored_bytes(self) -> dict[str, int]:
        """Return the stored bytes by field, with "documents" for the text files and "index" for
        everything else.
        """
        sizes: Counter[str] = Counter()
        for path, sequence in self.sequences().items():
            for name in ("documents", *sequence.fields()):
                sizes[name] += self._stored_bytes(self.nodes[path], name)
        return dict(sizes) | {"index": self._stored_bytes("", "") - sizes.total()}

    @abstractmethod
    def _stored_bytes(self, group: str, name: str) -> int:
        """Return the stored bytes of a field, or of the "documents", of a sequence, or of the whole
        store if both are empty.
        """


def _check_root(root: Mapping[str, Any] | None, where: str) -> Mapping[str, str]:
    if root is None or root.get("type") != STORE:
        raise FormatError(
            where, expected="a store packed by carlasc", found=f"a store without the type {STORE}"
        )
    version = root.get("version", 1)
    if isinstance(version, bool) or not isinstance(version, int | np.integer) or version < 1:
        raise damaged(where, "a version above 0", repr(version))
    if version != VERSION:
        raise FormatError(
            where,
            expected=f"a store of version {VERSION}",
            found=f"version {version}",
            advice="upgrade carlasc to read it"
            if version > VERSION
            else "it was packed by an earlier, unreleased version of carlasc: pack it again",
        )
    if not root.get("complete"):
        raise unfinished_error(where)
    sequences = root.get("sequences")
    if not isinstance(sequences, dict) or not all(
        isinstance(node, str) for node in sequences.values()
    ):
        raise damaged(where, "the groups of sequences", "none")
    nodes: dict[str, str] = dict(sorted(sequences.items()))
    check_names([*nodes, *nodes.values()], where)
    return nodes


class FieldReader(Protocol):
    """One field of a sequence in a packed store."""

    frames: IntArray


_FieldReader = TypeVar("_FieldReader", bound=FieldReader)


class PackedSequence(Sequence, Generic[_FieldReader]):
    """One sequence of a packed store. Each field is opened on its first read."""

    def __init__(self, path: str, location: str, about: Mapping[str, Any]) -> None:
        """Take the sequence's split, name, coordinates, fields and text files from its attributes.

        Raises:
            FormatError: one of them is missing, or a name in them leads out of the store.
        """
        self.path = path
        self.location = location
        try:
            self.split: str | None = about["split"]
            self.name: str = about["name"]
            self.coordinates = cast(Coordinates, about["coordinates"])
            self._fields = frozenset(about["fields"])
            self._documents = tuple(about["documents"])
        except KeyError as error:
            raise damaged(location, f"the attribute {error.args[0]}", "none") from error
        except TypeError as error:
            raise damaged(location, "lists of fields and text files", str(error)) from error
        names = (self.name, self.coordinates, self.split or "", *self._fields, *self._documents)
        if (
            not all(isinstance(name, str) for name in names)
            or self.coordinates not in layout.COORDINATES
        ):
            raise damaged(
                location, "names of the sequence, its fields and its text files", "other values"
            )
        check_names([*self._fields, *self._documents], location)
        self._readers: dict[str, _FieldReader] = {}

    @abstractmethod
    def _open_field(self, field: str) -> _FieldReader: ...

    def fields(self) -> frozenset[str]:
        """Return the fields with at least one frame."""
        return self._fields

    def frames(self, field: str) -> IntArray:
        """Return the frames of a field."""
        return self._field(field).frames if field in self._fields else np.empty(0, np.int64)

    def documents(self) -> tuple[str, ...]:
        """Return the names of the text files."""
        return tuple(name for name in self._documents if not name.startswith(f"{layout.DERIVED}/"))

    def _check_listed(self, what: str, names: Collection[str], name: str) -> None:
        if name not in names:
            raise MissingDataError(
                self.location,
                expected=f"the {what} {name}",
                found=", ".join(sorted(names)) or "none",
            )

    def _field(self, field: str) -> _FieldReader:
        self._check_listed("field", self._fields, field)
        if field not in self._readers:
            self._readers[field] = self._open_field(field)
        return self._readers[field]

    def __getstate__(self) -> dict[str, Any]:
        return super().__getstate__() | {"_readers": {}}  # a worker process opens fields again


class PackedSink(Sink):
    """Writes a packed store by appending. One writer writes one sequence after the other.

    The store gets its final name only when the sink is finished.

    Attributes:
        path: final path of the store.
        part: path of the unfinished store.
        options: options of the store.
        overwrite: whether an existing store is replaced.
        nodes: the group (or folder) of each completed sequence.
    """

    def __init__(self, path: AnyPath, options: PackOptions | None, overwrite: bool) -> None:
        """Check the options and the path. Nothing is written yet.

        Raises:
            ArgumentError: `small` is given, but only zarr has PCodec.
            ConflictError: something exists at `path`, and `overwrite` is not given.
        """
        self.path = Path(path)
        self.location = str(path)
        self.part = unfinished(self.path)
        self.options = options or PackOptions()
        self.overwrite = overwrite
        self.nodes: dict[str, str] = {}
        if self.options.small:
            raise ArgumentError(
                "small",
                expected="a .zarr store",
                found=f"{path}: only zarr has PCodec",
                advice="leave `small` out",
            )
        refuse_existing(self.path, overwrite)

    def finished(self, path: str) -> bool:
        """Whether this sequence is complete."""
        return path in self.nodes

    @abstractmethod
    def sequence(self, path: str) -> PackedWriter[Any]:
        """Start a sequence. An incomplete sequence of an interrupted run is removed."""

    def root(self) -> dict[str, Any]:
        """Return the attributes of the root of the finished store."""
        return {"type": STORE, "version": VERSION, "complete": True, "sequences": self.nodes}


class FieldWriter(ABC):
    """Writes one field of a sequence, with frames in ascending order.

    Attributes:
        entry: the field in the layout.
        frames: the frames written so far, in order, each with the result of `write`.
    """

    def __init__(self, field: str) -> None:
        self.entry = layout.field_named(field)
        self.frames: dict[int, Any] = {}

    def append(self, frame: int, array: AnyArray) -> None:
        """Write one frame.

        Raises:
            FormatError: it does not fit the field, or an earlier frame.
        """
        last = next(reversed(self.frames), -1)
        if frame <= last:
            raise FormatError(
                "its number", expected=f"frames in rising order, above {last}", found=frame
            )
        self.entry.check(array, "its array")
        self.frames[frame] = self.write(frame, array)

    @abstractmethod
    def write(self, frame: int, array: AnyArray) -> Any:
        """Write one frame that fits the field, and return its number of elements."""

    @abstractmethod
    def close(self) -> None:
        """Write buffered data."""


_FieldWriter = TypeVar("_FieldWriter", bound=FieldWriter)


class PackedWriter(SequenceWriter, Generic[_FieldWriter]):
    """Writes one sequence of a packed store, with the frames of each field in ascending order.

    Attributes:
        identity: split, name and coordinates; by default those of the path.
        node: group (or folder) of the sequence in the store.
        options: options of the store.
        writers: the fields written so far.
        contents: the text files written so far.
    """

    def __init__(self, sink: PackedSink, path: str, node: str) -> None:
        self.location = f"{sink.part}/{node}"
        self.path = path
        self.node = node
        self.options = sink.options
        self.identity: tuple[str | None, str, Coordinates] = identity_of(path)
        self.writers: dict[str, _FieldWriter] = {}
        self.contents: dict[str, bytes] = {}
        self._finished = sink.nodes

    @abstractmethod
    def _start_field(self, field: str) -> _FieldWriter: ...

    @abstractmethod
    def _finish(self) -> None:
        """Write everything but the fields, and mark the sequence as complete."""

    def close(self) -> None:
        """Write buffered frames and mark the sequence as complete."""
        for writer in self.writers.values():
            writer.close()
        self._finish()
        self._finished[self.path] = self.node

    def __getstate__(self) -> dict[str, Any]:
        """Keep only the name, because only one process writes the store."""
        kept = ("location", "path", "identity")
        return {name: vars(self)[name] for name in kept} | {"writers": {}, "contents": {}}

    def has(self, field: str, frame: int) -> bool:
        """Whether this run has written the frame."""
        return field in self.writers and frame in self.writers[field].frames

    def write(self, field: str, frame: int, array: AnyArray) -> None:
        """Append one frame to a field.

        Raises:
            FormatError: the array does not fit the field, `frame` is not above the previous one, or
                the name of the field leads out of the store.
        """
        if field not in self.writers:
            check_names([field], self.location)
            self.writers[field] = self._start_field(field)
        with within(f"{self.location}: field {field}, frame {frame}"):
            self.writers[field].append(frame, array)

    def write_document(self, name: str, data: bytes) -> None:
        """Keep a text file's bytes until the sequence is closed."""
        check_names([name], self.location)
        self.contents[name] = data

    def read_document(self, name: str) -> bytes | None:
        """Return the bytes of a text file; None if it was not written."""
        return self.contents.get(name)

    def about(self) -> dict[str, Any]:
        """Return the attributes of the sequence in the store."""
        split, name, coordinates = self.identity
        about = {"path": self.path, "split": split, "name": name, "coordinates": coordinates}
        return about | {"fields": sorted(self.writers), "documents": sorted(self.contents)}


def check_scale(attributes: Mapping[str, Any], where: str) -> None:
    """Check the size of a step of quantised coordinates in the attributes of a field.

    Raises:
        FormatError: it is not a length of at most 1 m.
    """
    scale = attributes.get("scale_m", 1)
    if type(scale) not in (int, float) or not 0 < scale <= 1:
        raise damaged(where, "a step of coordinates above 0, up to 1 m", repr(scale))


def node_of(path: str, where: str) -> str:
    """Return the group (or folder) of a sequence in a store: its path, or "sequence" if the path is
    empty.

    Raises:
        FormatError: the path leads out of the store.
    """
    check_names([path], where)
    return path.strip("/") or "sequence"


def check_names(names: list[str], where: str) -> None:
    """Check that names from an untrusted store do not lead out of it.

    Raises:
        FormatError: a name does; the message has the first one.
    """
    for name in names:
        if leads_outside(name):
            raise FormatError(
                where,
                expected="names inside the store",
                found=repr(name),
                advice="the name leads out of the store: do not use this store",
            )
