"""What a stage of a conversion did with one frame: its fields were written, or must still be, or it failed."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import groupby
from typing import Any, TypeVar

from numpy.typing import NDArray

from carlasc.errors import CarlascError, StorageError
from carlasc.storage.sinks import SequenceWriter

Item = TypeVar("Item")
Result = TypeVar("Result", bound="Outcome")
_BLOCK = 8  # frames of a task where each has files of its own, because a task costs more than a frame

Fields = Mapping[str, NDArray[Any]]
"""Arrays of a frame by the names of their fields, in the order in which they are written."""


@dataclass
class Outcome:
    """The outcome of one frame.

    Attributes:
        number: frame number.
        outputs: its fields, until they are written.
        failure: error message, if it failed.
    """

    number: int
    outputs: Fields = field(default_factory=dict)
    failure: str | None = None

    def take(self, make: Callable[[], Fields]) -> None:
        """Make the fields of the frame. A frame that cannot be read has failed.

        Raises:
            StorageError: nothing can be written, so every other frame would fail in the same way.
        """
        try:
            self.outputs = make()
        except StorageError:
            raise
        except (CarlascError, OSError) as error:
            self.failure = str(error)


def write_outcomes(writer: SequenceWriter, outcomes: Iterable[Outcome]) -> None:
    """Write the fields of some frames, those of a frame in their order, and forget them."""
    outcomes = list(outcomes)
    if frames := {outcome.number: outcome.outputs for outcome in outcomes if outcome.outputs}:
        writer.write_frames(frames)
    for outcome in outcomes:
        outcome.outputs = {}


def written_in_worker(writer: SequenceWriter, outcomes: list[Result]) -> list[Result]:
    """Return the outcomes of a block, written if the writer can be used in workers."""
    if writer.concurrent:
        write_outcomes(writer, outcomes)
    return outcomes


def in_blocks(
    items: Sequence[Item], number_of: Callable[[Item], int], writer: SequenceWriter
) -> Iterator[Sequence[Item]]:
    """Yield frames in the blocks that a worker does in one task: those that are stored together, or else a few in a row."""
    if writer.block == 1:
        yield from (items[i : i + _BLOCK] for i in range(0, len(items), _BLOCK))
    else:
        yield from (list(block) for _, block in groupby(items, key=lambda item: number_of(item) // writer.block))
