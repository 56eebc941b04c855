"""Views of sequences, and sources with selected sequences."""

from __future__ import annotations

from collections.abc import Mapping

from carlasc.core.arrays import AnyArray, IntArray
from carlasc.storage.protocol import Sequence, Source


class SequenceView(Sequence):
    """A view of another sequence. Subclasses change parts of it.

    Attributes:
        whole: the sequence that is viewed.
    """

    def __init__(self, whole: Sequence) -> None:
        self.whole = whole
        self.path = whole.path
        self.location = whole.location
        self.split = whole.split
        self.name = whole.name
        self.coordinates = whole.coordinates
        self._given_poses = whole._given_poses

    def fields(self) -> frozenset[str]:
        """Return the fields of the whole sequence."""
        return self.whole.fields()

    def frames(self, field: str) -> IntArray:
        """Return the frames of a field of the whole sequence."""
        return self.whole.frames(field)

    def read(self, field: str, frame: int) -> AnyArray:
        """Read one field of one frame of the whole sequence."""
        return self.whole.read(field, frame)

    def documents(self) -> tuple[str, ...]:
        """Return the text files of the whole sequence."""
        return self.whole.documents()

    def read_document(self, name: str) -> bytes:
        """Return the bytes of a text file of the whole sequence."""
        return self.whole.read_document(name)

    def line_of(self, frame: int, lines: int, document: str) -> int:
        """Return the line of a text file of the whole sequence that belongs to a frame."""
        return self.whole.line_of(frame, lines, document)


class ChosenSequences(Source):
    """A source with a selection of sequences, possibly views of the original ones."""

    def __init__(self, location: str, sequences: Mapping[str, Sequence]) -> None:
        self.location = location
        self.chosen = sequences

    def sequences(self) -> Mapping[str, Sequence]:
        """Return the sequences."""
        return self.chosen
