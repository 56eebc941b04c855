"""The protocol between stores and everything else: a Source yields sequences, a Sink takes them.

A sequence is one `<split>/<sequence>/<coordinates>` of the layout. It has fields and frames; one call reads one field of one
frame as an array. Fields it lacks are absent from `fields()`. Sources hold paths, never open handles, so they pickle; a store
that needs a handle opens it per process on first read.
"""

from __future__ import annotations

import copy
from abc import ABC, abstractmethod
from collections.abc import Iterable, Mapping
from functools import cached_property
from pathlib import PurePosixPath
from types import TracebackType
from typing import Any, Self, cast

import numpy as np
from numpy.typing import NDArray

from carlasc.core.classes import ClassTable
from carlasc.core.geometry import Transform
from carlasc.core.grids import Coordinates, Grid, GridSpec
from carlasc.core.scans import Scan
from carlasc.core.tables import table_from_json
from carlasc.errors import ConflictError, FormatError, MissingDataError
from carlasc.storage import layout
from carlasc.storage.files import parse_json
from carlasc.storage.metadata import Metadata, check_format


class Sequence(ABC):
    """One `<split>/<sequence>/<coordinates>`: fields and frames, read one at a time.

    Attributes:
        path: where it stands in its Source, "Train/Town01_Light/cartesian"; unique there; "" where the Source is just it.
        location: what to call it in errors: a folder, a URL.
        split: "Train", "Val", "Test", or None.
        name: "Town01_Light".
        coordinates: "cartesian" or "cylindrical".
    """

    path: str
    location: str
    split: str | None
    name: str
    coordinates: Coordinates
    _given_poses: NDArray[np.float64] | None = None

    @abstractmethod
    def fields(self) -> frozenset[str]:
        """Return the names of the fields that stand in files of their own (see `carlasc.storage.layout`): no poses, no times."""

    @abstractmethod
    def frames(self, field: str) -> NDArray[np.int64]:
        """Return the sorted frame numbers that have a field; empty where it is absent."""

    @abstractmethod
    def read(self, field: str, frame: int) -> NDArray[Any]:
        """Read one field of one frame, with the values and the shape of the published file.

        Labels and counts may come in a narrower type than the file's; `points` is (N, 4) float32, a grid's arrays (X, Y, Z), bev
        the (B,) uint8 bytes of the picture. The array may be read-only.

        Raises:
            MissingDataError: the field or the frame is not there.
            FormatError: what is there is not what the format says.
        """

    @abstractmethod
    def documents(self) -> tuple[str, ...]:
        """Return the names of the text files that are there: poses.txt, times.txt, carlasc.json, `<grid>/params.json`."""

    @abstractmethod
    def read_document(self, name: str) -> bytes:
        """Return a text file's bytes as they stand.

        Raises:
            MissingDataError: it is not there.
        """

    def read_many(self, field: str, frames: Iterable[int]) -> list[NDArray[Any]]:
        """Read one field of several frames; stores that can do so read them in one go."""
        return [self.read(field, frame) for frame in frames]

    def read_xyz(
        self, frames: Iterable[int], spare: list[NDArray[np.float32]] | None = None
    ) -> list[NDArray[np.float32]]:
        """Read where the points of several frames are, laid out in memory as the store has them: to be read, not to be kept.

        Args:
            frames: their numbers.
            spare: what earlier calls returned and nobody looks at any more: the store may write over it.

        Returns:
            (N, 3) or (N, 4) float32 metres of each frame: rows, or the transpose of contiguous x, y and z.
        """
        return self.read_many("points", frames)

    @cached_property
    def metadata(self) -> Metadata:
        """What carlasc.json says, or the defaults."""
        if layout.METADATA not in self.documents():
            return Metadata()
        return Metadata.from_json(self.read_document(layout.METADATA), f"{self.location}/{layout.METADATA}")

    @cached_property
    def grids(self) -> Mapping[str, GridSpec]:
        """The sequence's grids by name (their folder), each with its geometry."""
        names = sorted(
            name.removesuffix(f"/{layout.PARAMS}") for name in self.documents() if name.endswith(f"/{layout.PARAMS}")
        )
        return {
            name: GridSpec.from_params(self.params(name), f"{self.location}/{layout.params_file(name)}")
            for name in names
        }

    def params(self, grid: str) -> dict[str, Any]:
        """Return a grid's params.json; it is read once."""
        if grid not in self._params:
            name = layout.params_file(grid)
            self._params[grid] = parse_json(self.read_document(name), f"{self.location}/{name}")
        return self._params[grid]

    @cached_property
    def _params(self) -> dict[str, dict[str, Any]]:
        return {}

    def classes_of(self, grid: str) -> ClassTable:
        """Return the class table of a grid's labels.

        It is the sequence's, unless the grid's params.json names another one, or holds it whole, under `carlasc`: predictions.

        Raises:
            FormatError: carlasc.json or params.json names an unknown table, or holds a damaged one.
        """
        table = self._record(grid).get("classes")
        if table is None:
            return self.metadata.classes
        return table_from_json(table, f"{self.location}/{layout.params_file(grid)}")

    def predicted_by(self, grid: str) -> str | None:
        """Return the network that predicted a grid, as its params.json says under `carlasc`; None: it is no prediction."""
        name = self._record(grid).get("network")
        return None if name is None else str(name)

    def _record(self, grid: str) -> Mapping[str, Any]:
        """How a grid was made: params.json's `carlasc`, empty if there is none."""
        record = self.params(grid).get("carlasc")
        if not isinstance(record, dict):
            return {}
        check_format(record.get("format", 1), f"{self.location}/{layout.params_file(grid)}: carlasc")
        return record

    def with_poses(self, poses: NDArray[np.float64]) -> Self:
        """Return a copy of the sequence that has other poses than its poses.txt.

        Copies and pickles of it keep these poses. Its documents are those of the sequence.

        Args:
            poses: (L, 4, 4) first_T_sensor, one per line, as `poses` returns them.
        """
        other = copy.copy(self)
        vars(other).pop("poses", None)
        other._given_poses = poses
        return other

    @cached_property
    def poses(self) -> NDArray[np.float64]:
        """(F, 4, 4) first_T_sensor, a line of poses.txt each; `read_pose` finds a frame's.

        Raises:
            MissingDataError: there is no poses.txt.
        """
        if self._given_poses is not None:
            return self._given_poses
        return layout.decode_poses(self.read_document(layout.POSES), f"{self.location}/{layout.POSES}")

    @cached_property
    def times(self) -> NDArray[np.float64]:
        """(F,) seconds since the first frame, a line of times.txt each; `read_time` finds a frame's."""
        return layout.decode_times(self.read_document(layout.TIMES), f"{self.location}/{layout.TIMES}")

    def read_pose(self, frame: int) -> Transform:
        """Return (4, 4) first_T_sensor of a frame."""
        return self.poses[self.line_of(frame, len(self.poses), layout.POSES)]

    def read_time(self, frame: int) -> float:
        """Return a frame's seconds since the first one."""
        return float(self.times[self.line_of(frame, len(self.times), layout.TIMES)])

    def line_of(self, frame: int, lines: int, document: str) -> int:
        """Return which line of a text file belongs to a frame.

        Line i is frame i wherever the file is long enough for the last frame (frames may be missing in between). A file
        with just a line for each frame that is there goes by their order.

        Raises:
            FormatError: the file has too few lines.
        """
        last, positions = self._frame_lines
        if last < lines:
            if 0 <= frame < lines:
                return frame
        elif len(positions) == lines and frame in positions:
            return positions[frame]
        raise FormatError(
            f"{self.location}/{document}",
            expected=f"a line for each of {len(positions)} frames (the last is {last})",
            found=f"{lines}",
            advice=f"frame {frame} has none",
        )

    @cached_property
    def _frame_lines(self) -> tuple[int, dict[int, int]]:
        frames = self.scan_frames()
        return int(frames[-1]) if len(frames) else -1, {int(frame): line for line, frame in enumerate(frames)}

    def scan_frames(self) -> NDArray[np.int64]:
        """Return the frames of the sequence: those with points, or, where it has only grids, those of all fields."""
        if len(points := self.frames("points")):
            return points
        return np.unique(
            np.concatenate([np.empty(0, np.int64), *(self.frames(field) for field in sorted(self.fields()))])
        )

    def scan(self, frame: int, fields: Iterable[str] | None = None) -> Scan:
        """Read a frame's points with those of `fields` that the sequence has; None reads every field with a row per point."""
        wanted = layout.point_fields() if fields is None else fields
        points = self.read("points", frame)
        read = {name: self.read(name, frame) for name in wanted if name in self.fields() and name != "remission"}
        own = {name: read.pop(name) for name in ("labels", "flow", "instances") if name in read}
        try:
            return Scan(points[:, :3], remission=points[:, 3], **own, others=read)
        except FormatError as error:
            raise error.within(f"{self.location}: frame {frame}") from error

    def grid(self, name: str, frame: int) -> Grid:
        """Read a grid of a frame: labels, and counts where there are any."""
        if name not in self.grids:
            raise MissingDataError(
                self.location, expected=f"the grid {name}", found=f"{', '.join(self.grids) or 'none'}"
            )
        counts = self.read(f"{name}/counts", frame) if f"{name}/counts" in self.fields() else None
        return Grid(self.grids[name], cast(NDArray[np.unsignedinteger], self.read(f"{name}/labels", frame)), counts)

    def __repr__(self) -> str:
        return f"<{type(self).__name__} {self.location}>"


class Source(ABC):
    """Where sequences are read from.

    Attributes:
        location: what to call it in errors: a folder, a file, a URL.
    """

    location: str

    @abstractmethod
    def sequences(self) -> Mapping[str, Sequence]:
        """Return the sequences by their path, in sorted order."""

    def __repr__(self) -> str:
        return f"<{type(self).__name__} {self.location}>"


class SequenceWriter(ABC):
    """Takes one sequence. In a folder, what `write` has returned from is there whole, whatever happens next.

    A packed store is there whole once its sink is closed, and not before.

    Attributes:
        location: what to call it in errors.
        concurrent: whether several processes may write at once, each with its own pickled copy.
    """

    location: str
    concurrent: bool = False

    @abstractmethod
    def has(self, field: str, frame: int) -> bool:
        """Whether a field of a frame is already there, whole."""

    @abstractmethod
    def write(self, field: str, frame: int, array: NDArray[Any]) -> None:
        """Write one field of one frame, over what is there.

        A grid's params.json comes before its first frame. Stores that append want each field's frames in rising order.

        Raises:
            FormatError: the array does not fit the field.
        """

    @abstractmethod
    def write_document(self, name: str, data: bytes) -> None:
        """Write a text file's bytes, over what is there."""

    @abstractmethod
    def read_document(self, name: str) -> bytes | None:
        """Return a text file's bytes, None if it is not there: how a second run finds what a first one left."""

    def read(self, field: str, frame: int) -> NDArray[Any] | None:
        """Return a field of a frame that is there, as the file's flat or (N, columns) rows; None where the store cannot tell."""
        return None

    def remove_grid(self, grid: str) -> None:
        """Remove a grid, its params.json last, so that a removal that is cut short can be gone on with.

        Raises:
            ConflictError: the store cannot.
        """
        raise ConflictError(f"{self.location}: this store cannot replace its grid {grid}: write to a new one")

    def close(self) -> None:  # noqa: B027 (most stores have nothing to finish)
        """Finish: a store that needs a last word (an index) says it here. Not called when the work failed."""

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if kind is None:
            self.close()


class Sink(ABC):
    """Where sequences are written to."""

    location: str

    @abstractmethod
    def sequence(self, path: str) -> SequenceWriter:
        """Start, or go on with, the sequence at a path such as "Train/Town01_Light/cartesian"."""

    def close(self) -> None:  # noqa: B027 (a folder has nothing to finish)
        """Finish: a packed store stands in its place from here on. Not called when the work failed."""

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if kind is None:
            self.close()


def identity_of(path: str) -> tuple[str | None, str, Coordinates]:
    """Return split, name and coordinates that a sequence's path tells.

    The path is that of the `<coordinates>` folder, as much of it as is known, absolute or not. A last part that names no
    coordinates is the sequence itself, Cartesian.
    """
    parts = [part for part in PurePosixPath(path.replace("\\", "/")).parts if part not in ("/", ".")]
    coordinates = parts.pop() if parts and parts[-1] in layout.COORDINATES else "cartesian"
    name = parts.pop() if parts else ""
    split = next((split for split in layout.SPLITS if parts and parts[-1].lower() == split.lower()), None)
    return split, name, cast(Coordinates, coordinates)
