"""The protocol for writing stores: a Sink takes sequences, a SequenceWriter their fields and
frames.

`carlasc.storage.protocol` is the protocol for reading, with the same fields and frames.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Iterable, Mapping
from contextlib import suppress
from typing import Self

from carlasc.core.arrays import AnyArray
from carlasc.core.grids import GridSpec
from carlasc.errors import ConflictError, FormatError
from carlasc.storage import layout
from carlasc.storage.files import parse_json
from carlasc.storage.protocol import Source

FrameArrays = Mapping[int, Mapping[str, AnyArray]]
"""The fields of frames: arrays by field, by frame number."""


class SequenceWriter(ABC):
    """Writes one sequence.

    In a folder, a file is complete when `write` returns, even if the run fails later. A packed
    store is complete only after its sink has been closed.

    Attributes:
        location: name of the output in errors.
        concurrent: whether several processes may write at the same time, each with its own pickled
            copy of the writer.
        block: number of frames that are stored together: frames with equal `frame // block`. If
            `concurrent`, two processes should not write different frames of one block at the same
            time. They may write the same frames.
    """

    location: str
    concurrent: bool = False
    block: int = 1

    def expect(  # noqa: B027 (most stores have nothing to record)
        self, frames: Mapping[str, Iterable[int]], rows: Mapping[str, int] | None = None
    ) -> None:
        """Announce the frames of a run, before it writes any frame.

        Stores with several writers cannot be finished while announced frames are missing. They also
        reserve a fixed size for every frame, which must not depend on the frame that is written
        first.

        Args:
            frames: numbers of the frames of each field.
            rows: number of elements of a typical large frame by field, such as the maximum number
                of points of a few scans.
        """

    @abstractmethod
    def has(self, field: str, frame: int) -> bool:
        """Return whether a field of a frame already exists and is complete."""

    def refresh(self) -> None:  # noqa: B027 (most stores remember nothing)
        """Discard cached listings: the next `has` sees the frames that other processes have
        written.
        """

    @abstractmethod
    def write(self, field: str, frame: int, array: AnyArray) -> None:
        """Write one field of one frame. An existing one is replaced.

        The params.json of a grid must be written before its first frame. Stores that append need
        the frames of each field in ascending order.

        Args:
            field: name of the field (see `carlasc.storage.layout`).
            frame: number of the frame.
            array: the values, with the shape of the published file: (N, ...) for N points, (X, Y,
                Z) for a grid.

        Raises:
            FormatError: the array does not fit the field.
        """

    def write_frames(self, frames: FrameArrays) -> None:
        """Write the fields of several frames, in the given order.

        `frames` maps frame numbers to fields by name, with the shapes of `write`.

        Stores with several frames per file write the frames of a block together. They are fastest
        if they get a whole block at once.
        """
        for frame, fields in frames.items():
            for field, array in fields.items():
                self.write(field, frame, array)

    @abstractmethod
    def write_document(self, name: str, data: bytes) -> None:
        """Write the bytes of a text file; an existing file is replaced."""

    def create_document(self, name: str, data: bytes) -> bool:
        """Write a text file unless it exists, and return whether it was written.

        If `concurrent` and several processes do this at once, exactly one succeeds.
        """
        if self.read_document(name) is not None:
            return False
        self.write_document(name, data)
        return True

    @abstractmethod
    def read_document(self, name: str) -> bytes | None:
        """Return the bytes of a text file; None if it does not exist.

        Runs use this to continue the output of an earlier run.
        """

    def read(self, field: str, frame: int) -> AnyArray | None:
        """Return an existing field of a frame as a flat array or (N, columns) rows; None if the
        store cannot read it.
        """
        return None

    def cells_of(self, grid: str) -> int | None:
        """Return the number of voxels of a grid from its params.json; None if it is not known."""
        name = layout.params_file(grid)
        data, where = self.read_document(name), f"{self.location}/{name}"
        with suppress(FormatError):
            if data is not None:
                return math.prod(GridSpec.from_params(parse_json(data, where), where).size)
        return None

    def remove_grid(self, grid: str) -> None:
        """Remove a grid.

        Its params.json is removed last, so that an interrupted removal can be continued.

        Raises:
            ConflictError: the store cannot remove grids.
        """
        raise ConflictError(
            f"{self.location}: this store cannot replace its grid {grid}: write to a new store"
        )

    def close(self) -> None:  # noqa: B027 (most stores have nothing to finish)
        """Finish the sequence, for example by writing an index.

        This is not called after an error.
        """

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: object, *_: object) -> None:
        if kind is None:
            self.close()


class Sink(ABC):
    """A store that sequences are written to.

    Attributes:
        location: name of the store in errors.
        is_finished: whether the store can be opened.
        is_readable: whether `source` can be called.
    """

    location: str
    is_finished: bool = False
    is_readable: bool = False

    @abstractmethod
    def sequence(self, path: str) -> SequenceWriter:
        """Start or continue the sequence at a path such as "Train/Town01_Light/cartesian"."""

    def place(self, path: str) -> str:
        """Return the name of a sequence, or of a grid in a sequence, in the finished store: the
        location of the store and the path in it.
        """
        return path if self.location == "." else f"{self.location}/{path}"

    # a folder has nothing to finish
    def finish(self, *, incomplete: bool = False) -> None:  # noqa: B027
        """Finish the store.

        A packed store can be opened after that. This is not called after an error.

        Args:
            incomplete: finish the store even if announced frames are missing, because they could
                not be made.

        Raises:
            ConflictError: announced frames are missing.
        """

    def source(self) -> Source:
        """Return a source of the written data.

        It can be used while more data are written; a packed store must be finished first.

        Raises:
            ConflictError: the store cannot be read while it is written.
        """
        raise ConflictError(
            self.location,
            expected="a folder or a .zarr store, which can be read while more is added",
            found="another kind of store",
            advice="write to a folder or a .zarr store, then pack it",
        )

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: object, *_: object) -> None:
        if kind is None:
            self.finish()
