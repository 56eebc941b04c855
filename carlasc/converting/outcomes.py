"""What a stage of a conversion did with one frame: its fields were written, or must still be, or it failed."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

from numpy.typing import NDArray

from carlasc.errors import CarlascError, StorageError
from carlasc.storage.protocol import SequenceWriter

Fields = Mapping[str, NDArray[Any]]
"""Arrays of a frame by the names of their fields, in the order in which they are written."""


@dataclass
class Outcome:
    """The outcome of one frame.

    Attributes:
        number: frame number.
        outputs: its fields, where the writer cannot be used in workers.
        failure: error message, if it failed.
    """

    number: int
    outputs: Fields = field(default_factory=dict)
    failure: str | None = None

    def take(self, make: Callable[[], Fields], writer: SequenceWriter) -> None:
        """Make the fields of the frame, and write them if the writer can be used in workers. A frame that cannot be read has failed.

        Raises:
            StorageError: nothing can be written, so every other frame would fail in the same way.
        """
        try:
            fields = make()
        except StorageError:
            raise
        except (CarlascError, OSError) as error:
            self.failure = str(error)
            return
        if writer.concurrent:
            write_fields(writer, self.number, fields)
        else:
            self.outputs = fields


def write_fields(writer: SequenceWriter, frame: int, fields: Fields) -> None:
    """Write a frame's fields in their order."""
    for name, array in fields.items():
        writer.write(name, frame, array)
