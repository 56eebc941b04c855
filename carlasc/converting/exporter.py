"""The protocol of exporters: an exporter writes sequences in the format of another data set.

Another distribution adds one by a class that inherits `FrameExporter` or `SequenceExporter`, and an
entry point:

    [project.entry-points."carlasc.exporters"]
    name = "package.module:Class"

The options of an exporter are the arguments of its constructor. It holds only values, so that it
can be pickled into a worker. `carlasc.export` chooses the frames, calls workers, writes each file
completely or not at all, and continues earlier runs.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Collection, Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

from carlasc import storage
from carlasc.core.arrays import AnyArray

Files = Mapping[str, bytes | memoryview]
"""Bytes of files, by their path in a folder."""


@dataclass(frozen=True)
class Exported:
    """A sequence that was exported.

    Attributes:
        sequence: the sequence.
        folder: its folder, relative to the root of the other data set.
        frames: numbers of the frames that exist in the output, sorted.
    """

    sequence: storage.Sequence
    folder: str
    frames: tuple[int, ...]


class Exporter(ABC):
    """The common part of both kinds of exporters.

    Attributes:
        title: what it writes, in a few words.
    """

    title: ClassVar[str]

    @property
    def product(self) -> str:
        """What is written.

        Two products of an exporter have no files in common, so both may be written to one folder.
        """
        return "data"

    @property
    def settings(self) -> Mapping[str, Any]:
        """The values that the content of the files depends on, for JSON.

        A run does not continue one with other settings.
        """
        return vars(self)

    @property
    def of_one(self) -> str | None:
        """The name of an option that belongs to one sequence, so that only one can be exported."""
        return None

    def check_output(self, source: str, root: Path) -> tuple[int, list[str]] | None:
        """Check the files in `root` instead of an export, if an option requests that.

        Args:
            source: the given source, which need not have CarlaSC's layout.
            root: folder of the other data set.

        Returns:
            The number of files, and notes for the user, one line each; None to export.

        Raises:
            CarlascError: something is wrong in `root`.
        """
        return None

    @abstractmethod
    def folders(self, names: Sequence[str]) -> dict[str, str]:
        """Return the folder of each sequence of a source, by the sequence's name, relative to the
        root of the other data set.
        """

    def check(self, sequence: storage.Sequence) -> list[str]:
        """Check that a sequence has what the export needs, before anything is written.

        Returns:
            Notes for the user, one line each.

        Raises:
            CarlascError: it cannot be exported; the message names what is missing.
        """
        return []

    def frames(self, sequence: storage.Sequence) -> list[int]:
        """Return the sorted numbers of the frames to export."""
        return sequence.scan_frames().tolist()

    @abstractmethod
    def frame_files(self, sequence: storage.Sequence, frame: int) -> tuple[str, ...]:
        """Return the paths of the files with a frame, in the sequence's folder."""

    def documents(self, sequence: storage.Sequence) -> Files:
        """Return the files of a sequence that belong to no single frame, by their path in its
        folder.
        """
        return {}

    def index(self, root: Path, exported: Sequence[Exported]) -> Files:
        """Return the files that belong to no single sequence, by their path in `root`.

        They are written last.

        Args:
            root: folder of the other data set. It may hold sequences of earlier exports.
            exported: the sequences of this export.
        """
        return {}


class FrameExporter(Exporter):
    """Writes one or more files per frame. Frames are made and written in parallel."""

    @abstractmethod
    def make_frame(self, sequence: storage.Sequence, frame: int) -> Files:
        """Return the contents of `frame_files`, by their path.

        Raises:
            CarlascError: the frame cannot be read, or cannot be expressed in the other format.
        """


class SequenceFile(AbstractContextManager["SequenceFile"]):
    """A file that is being written and takes the frames of a sequence one by one."""

    @abstractmethod
    def add(self, frame: int, content: Mapping[str, AnyArray]) -> None:
        """Write a frame, whose arrays have the shapes that `make_frame` gives them, (N, ...) for N
        points. Frames come in increasing order.

        Raises:
            CarlascError: the frame cannot be expressed in the format. Nothing of it is written.
        """


class SequenceExporter(Exporter):
    """Writes one file per sequence, with all of its frames.

    Frames are made in parallel, and written by one process.
    """

    @abstractmethod
    def file(self, sequence: storage.Sequence) -> str:
        """Return the path of the sequence's file in its folder."""

    def frame_files(self, sequence: storage.Sequence, frame: int) -> tuple[str, ...]:
        """Return the file of the sequence."""
        return (self.file(sequence),)

    @abstractmethod
    def frames_in(self, path: Path, sequence: storage.Sequence) -> Collection[int]:
        """Return the frames that a finished file of a sequence holds.

        Raises:
            FormatError: it is no such file.
        """

    @abstractmethod
    def open(self, path: Path, sequence: storage.Sequence) -> SequenceFile:
        """Open a new file to write to.

        It is renamed to its final name after all frames were added.
        """

    @abstractmethod
    def make_frame(self, sequence: storage.Sequence, frame: int) -> Mapping[str, AnyArray]:
        """Return the arrays of a frame by name, of shape (N, ...) for N points.

        Raises:
            CarlascError: the frame cannot be read, or cannot be expressed in the other format.
        """


class _Whole(SequenceFile):
    """A file that has all frames already."""

    def __exit__(self, *error: object) -> None:
        """Do nothing."""

    def add(self, frame: int, content: Mapping[str, AnyArray]) -> None:
        """Do nothing."""


class WholeFileExporter(SequenceExporter):
    """Writes one small file per sequence, which is made at once from all frames.

    Frames that cannot be read end the export.
    """

    @abstractmethod
    def encode(self, sequence: storage.Sequence) -> tuple[bytes, list[str]]:
        """Return the content of the file of a sequence, and notes for the user, one line each.

        Raises:
            CarlascError: the sequence cannot be read, or cannot be expressed in the other format.
        """

    def check(self, sequence: storage.Sequence) -> list[str]:
        """Check that the file can be made."""
        return self.encode(sequence)[1]

    def folders(self, names: Sequence[str]) -> dict[str, str]:
        """Return the root for each name: the name is in that of the file."""
        return dict.fromkeys(names, ".")

    def frames_in(self, path: Path, sequence: storage.Sequence) -> Collection[int]:
        """Return all frames if the file has the content that would be written now: it may depend on
        other files than the sequence.
        """
        return self.frames(sequence) if path.read_bytes() == self.encode(sequence)[0] else ()

    def open(self, path: Path, sequence: storage.Sequence) -> SequenceFile:
        """Write the file."""
        path.write_bytes(self.encode(sequence)[0])
        return _Whole()

    def make_frame(self, sequence: storage.Sequence, frame: int) -> Mapping[str, AnyArray]:
        """Return nothing: frames are not made one by one."""
        return {}
