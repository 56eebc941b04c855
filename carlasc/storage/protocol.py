"""The protocol of stores: a Source yields sequences, and a Sink takes them.

A sequence is one `<split>/<sequence>/<coordinates>` of the layout. It has fields and frames; one
call reads one field of one frame as an array. A field that the sequence does not have is not listed
by `fields()`. Sources hold paths, never open handles, so that they can be pickled. A store that
needs a handle opens it in each process on the first read.
"""

from __future__ import annotations

import copy
import dataclasses
import math
from abc import ABC, abstractmethod
from collections.abc import Collection, ItemsView, Iterable, Iterator, Mapping, ValuesView
from contextlib import suppress
from functools import cached_property
from typing import Any, Protocol, Self, cast

import numpy as np

from carlasc.core.arrays import AnyArray, Float32Array, FloatArray, IntArray, LabelArray
from carlasc.core.boxes import Boxes
from carlasc.core.classes import ClassTable, TableUse
from carlasc.core.frames import check_seconds
from carlasc.core.geometry import Transform
from carlasc.core.grids import Coordinates, Grid, GridSpec
from carlasc.core.notebook import describe
from carlasc.core.scans import Scan
from carlasc.core.tables import table_from_json
from carlasc.errors import (
    ConflictError,
    FormatError,
    MissingDataError,
    MissingKeyError,
    first_names,
    within,
)
from carlasc.storage import layout
from carlasc.storage.files import parse_json
from carlasc.storage.layout import Metadata


class FileTree(Protocol):
    """The part of a tree of files, local or remote, that this protocol uses.

    Attributes:
        location: its name in errors: a folder, a zip, a URL.
    """

    location: str

    def read(self, path: str, size: int | None = None) -> bytes | memoryview:
        """Return a file's bytes.

        Args:
            path: the file, its parts joined by "/".
            size: expected size in bytes; None if it is not known.
        """
        ...


class Sequence(ABC):
    """One `<split>/<sequence>/<coordinates>`: fields and frames, read one at a time.

    It is a collection of frame numbers: `for frame in sequence`, `frame in sequence` and
    `len(sequence)` use `scan_frames()`.

    Attributes:
        path: path of the sequence in its Source, such as "Train/Town01_Light/cartesian", which is
            unique there; "" if the Source is this one sequence.
        location: name of the sequence in errors: a folder or a URL.
        split: "Train", "Val", "Test", or None.
        name: "Town01_Light".
        coordinates: "cartesian" or "cylindrical".
        tree: the tree of files that it is read from; None if it is not read from files.
        awaited: frames whose scans could not be written yet. Grids to which they belong wait for
            them.
    """

    path: str
    location: str
    split: str | None
    name: str
    coordinates: Coordinates
    tree: FileTree | None = None
    awaited: frozenset[int] = frozenset()
    _given_poses: FloatArray | None = None
    _given_classes: ClassTable | None = None

    @abstractmethod
    def fields(self) -> frozenset[str]:
        """Return the names of the fields with one file per frame (see `carlasc.storage.layout`),
        without poses and times.
        """

    @abstractmethod
    def frames(self, field: str) -> IntArray:
        """Return the sorted numbers of the (N,) frames that have a field; empty if the sequence
        does not have the field.
        """

    @abstractmethod
    def read(self, field: str, frame: int) -> AnyArray:
        """Read one field of one frame, with the values and the shape of the published file.

        Labels and counts may have a narrower type than in the file. `points` is (N, 4) float32, the
        arrays of a grid are (X, Y, Z), `boxes` is a table (`carlasc.core.BOXES_DTYPE`), and `bev`
        is the (B,) uint8 bytes of the picture. The array may be read-only.

        Raises:
            MissingDataError: the field or the frame does not exist.
            FormatError: the data do not have the format of the field.
        """

    @abstractmethod
    def documents(self) -> tuple[str, ...]:
        """Return the names of the existing text files: poses.txt, times.txt, carlasc.json, and
        params.json and the report of each grid.
        """

    @abstractmethod
    def read_document(self, name: str) -> bytes:
        """Return the unchanged bytes of a text file.

        Raises:
            MissingDataError: the file does not exist.
        """

    def read_many(self, field: str, frames: Iterable[int]) -> list[AnyArray]:
        """Read one field of several frames, each with the shape that `read` returns.

        Some stores read them together, which is faster.
        """
        return [self.read(field, frame) for frame in frames]

    def read_xyz(
        self, frames: Iterable[int], spare: list[Float32Array] | None = None
    ) -> list[Float32Array]:
        """Read the coordinates of the points of several frames, in the memory layout of the store.

        The caller must not keep the arrays.

        Args:
            frames: numbers of the frames.
            spare: arrays that earlier calls returned and that are no longer in use. The store may
                overwrite them.

        Returns:
            (N, 3) or (N, 4) float32 metres of each frame: rows, or the transpose of contiguous x, y
            and z.
        """
        return self.read_many("points", frames)

    def files_of(self, field: str, frames: Iterable[int]) -> list[str]:
        """Return the files that hold a field of some frames, each once, as paths in the tree of the
        store.

        A cache fetches these files before the frames are read. The list is empty if the store does
        not support this.
        """
        return []

    @cached_property
    def metadata(self) -> Metadata:
        """The metadata in carlasc.json, or the defaults if the file does not exist."""
        if layout.METADATA not in self.documents():
            return Metadata()
        return Metadata.from_json(
            self.read_document(layout.METADATA), f"{self.location}/{layout.METADATA}"
        )

    @cached_property
    def grids(self) -> Mapping[str, GridSpec]:
        """The geometry of each grid of the sequence, by the name of the grid's folder."""
        names = sorted(
            name.removesuffix(f"/{layout.PARAMS}")
            for name in self.documents()
            if name.endswith(f"/{layout.PARAMS}")
        )
        return {
            name: GridSpec.from_params(
                self.params(name), f"{self.location}/{layout.params_file(name)}"
            )
            for name in names
        }

    def params(self, grid: str) -> dict[str, Any]:
        """Return the params.json of a grid. The file is read once."""
        if grid not in self._params:
            name = layout.params_file(grid)
            self._params[grid] = parse_json(self.read_document(name), f"{self.location}/{name}")
        return self._params[grid]

    @cached_property
    def _params(self) -> dict[str, dict[str, Any]]:
        return {}

    def classes_of(self, grid: str) -> ClassTable:
        """Return the class table of a grid's labels.

        This is the class table of the sequence, unless the grid's params.json names or contains
        another one under `carlasc`, as predictions do.

        Raises:
            FormatError: carlasc.json or params.json names an unknown table, or contains an invalid
                one.
        """
        if self._given_classes is not None:
            return self._given_classes
        table = self._record(grid).get("classes")
        if table is None:
            return self.metadata.classes
        return table_from_json(table, f"{self.location}/{layout.params_file(grid)}")

    def table_use(self, grid: str = "") -> TableUse:
        """Return the class table of the points or of a grid, and whether carlasc.json or the
        params.json of the grid names it; otherwise that of CARLA is assumed, as published files
        have it.
        """
        if self._given_classes is not None:
            return TableUse(self._given_classes.name, "option")
        name = layout.METADATA
        table = self.classes_of(grid) if grid else self.metadata.classes
        named = bool(grid) and self._record(grid).get("classes") is not None
        if not named and name in self.documents():
            values = parse_json(self.read_document(name), f"{self.location}/{name}")
            named = "classes" in values
        return TableUse(table.name, "file" if named else "assumed")

    def predicted_by(self, grid: str) -> str | None:
        """Return the name of the network that predicted a grid, from its params.json; None if the
        grid is not a prediction.
        """
        name = self._record(grid).get("network")
        return None if name is None else str(name)

    def _record(self, grid: str) -> Mapping[str, Any]:
        """Return the record of how a grid was made: the value of `carlasc` in params.json, or an
        empty mapping.
        """
        record = self.params(grid).get("carlasc")
        if not isinstance(record, dict):
            return {}
        layout.check_format(
            record.get("format", 1), f"{self.location}/{layout.params_file(grid)}: carlasc"
        )
        return record

    def with_classes(self, classes: ClassTable) -> Sequence:
        """Return a copy of the sequence whose labels, of points and of grids, are read with another
        class table than the metadata name.
        """
        other = copy.copy(self)
        vars(other)["metadata"] = dataclasses.replace(self.metadata, classes=classes)
        other._given_classes = classes
        return other

    def with_poses(self, poses: FloatArray) -> Self:
        """Return a copy of the sequence with other poses than those in its poses.txt.

        Copies and pickles of the result keep these poses. Its documents are those of the sequence.

        Args:
            poses: (L, 4, 4) first_T_sensor, one per line, as `poses` returns them.
        """
        other = copy.copy(self)
        vars(other).pop("poses", None)
        other._given_poses = poses
        return other

    @cached_property
    def poses(self) -> FloatArray:
        """(F, 4, 4) first_T_sensor, one per line of poses.txt; `read_pose` returns that of a frame.

        Raises:
            MissingDataError: poses.txt does not exist.
        """
        if self._given_poses is not None:
            return self._given_poses
        return layout.decode_poses(
            self.read_document(layout.POSES), f"{self.location}/{layout.POSES}"
        )

    @cached_property
    def times(self) -> FloatArray:
        """(F,) seconds since the first frame, one per line of times.txt; `read_time` returns that
        of a frame.
        """
        return layout.decode_times(
            self.read_document(layout.TIMES), f"{self.location}/{layout.TIMES}"
        )

    def read_pose(self, frame: int) -> Transform:
        """Return (4, 4) first_T_sensor of a frame.

        Raises:
            FormatError: poses.txt has no line for the frame, or a number in it is not finite.
        """
        line = self.line_of(frame, len(self.poses), layout.POSES)
        pose = self.poses[line]
        if not np.isfinite(pose).all():
            where = f"{self.location}/{layout.POSES}: line {line + 1}"
            raise FormatError(
                where,
                expected="finite numbers",
                found="NaN or infinity",
                advice="copy the file again",
            )
        return pose

    def read_time(self, frame: int) -> float:
        """Return the time of a frame in seconds since the first frame.

        Raises:
            FormatError: times.txt has no line for the frame, or the line is not a valid time.
        """
        line = self.line_of(frame, len(self.times), layout.TIMES)
        return float(
            check_seconds(
                self.times[line : line + 1], f"{self.location}/{layout.TIMES}: line {line + 1}"
            )[0]
        )

    def times_of(self, frames: Iterable[int]) -> FloatArray:
        """Return (F,) seconds of frames since the first frame: those of `read_time`, or at 10 Hz
        without times.txt.
        """
        if layout.TIMES in self.documents():
            return np.array([self.read_time(int(frame)) for frame in frames], np.float64)
        return np.array([frame * layout.FRAME_PERIOD_S for frame in frames], np.float64)

    def line_of(self, frame: int, lines: int, document: str) -> int:
        """Return the number of the line of a text file that belongs to a frame.

        Line i belongs to frame i if the file is long enough for the last frame; frames in between
        may be missing. If the file has exactly one line per existing frame, the lines belong to the
        frames in their order.

        Args:
            frame: number of the frame.
            lines: number of lines of the file.
            document: name of the file, for the error.

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
            found=f"{lines} lines",
            advice=f"frame {frame} has none",
        )

    @cached_property
    def _frame_lines(self) -> tuple[int, dict[int, int]]:
        frames = self.scan_frames()
        return int(frames[-1]) if len(frames) else -1, {
            int(frame): line for line, frame in enumerate(frames)
        }

    def scan_frames(self) -> IntArray:
        """Return the (N,) frames of the sequence: frames with points, or frames of any field if the
        sequence has no scans.
        """
        if len(points := self.frames("points")):
            return points
        return np.unique(
            np.concatenate(
                [np.empty(0, np.int64), *(self.frames(field) for field in sorted(self.fields()))]
            )
        )

    def scan(self, frame: int, fields: Iterable[str] | None = None) -> Scan:
        """Read the points of a frame and the given `fields`, if they exist.

        None reads boxes and all fields with one row per point.
        """
        wanted = {*layout.point_fields(), "boxes"} if fields is None else set(fields)
        boxes = self.boxes(frame) if "boxes" in wanted else None
        wanted = wanted & self.fields() - {"boxes", "remission"}
        (points,) = self.read_many("points", [frame])
        read = {}
        for name in layout.point_fields():  # in Python 3.11, a comprehension is a level of calls
            if name in wanted:
                (read[name],) = self.read_many(name, [frame])
        own = {name: read.pop(name) for name in ("labels", "flow", "instances") if name in read}
        with within(f"{self.location}: frame {frame}"):
            return Scan(points[:, :3], remission=points[:, 3], **own, others=read, boxes=boxes)

    def boxes(self, frame: int) -> Boxes | None:
        """Read the tracked boxes of a frame; None if the frame is not annotated.

        Raises:
            FormatError: the boxes are damaged, or are not valid (see `carlasc.Boxes`).
        """
        if frame not in self.frames("boxes"):
            return None
        return Boxes.from_table(self.read("boxes", frame), f"{self.location}: frame {frame}")

    def grid(self, name: str, frame: int) -> Grid:
        """Read a grid of a frame: its labels, and its counts if they exist."""
        if name not in self.grids:
            raise MissingDataError(
                self.location,
                expected=f"the grid {name}",
                found=f"{', '.join(self.grids) or 'none'}",
            )
        counts = self.read(f"{name}/counts", frame) if f"{name}/counts" in self.fields() else None
        labels = cast(LabelArray, self.read(f"{name}/labels", frame))
        with within(f"{self.location}: frame {frame}"):
            return Grid(self.grids[name], labels, counts)

    def __iter__(self) -> Iterator[int]:
        return iter(self.scan_frames().tolist())

    def __len__(self) -> int:
        return len(self.scan_frames())

    def __contains__(self, frame: object) -> bool:
        return frame in self.scan_frames().tolist()

    def __bool__(self) -> bool:
        return True  # a sequence without frames is a sequence

    def __repr__(self) -> str:
        return f"<{type(self).__name__} {self.location}>"

    def _repr_html_(self) -> str:
        """Return the HTML for notebooks: the content of the sequence, and its first grid from
        above.
        """
        fields = ", ".join(sorted(field for field in self.fields() if "/" not in field))
        rows = {"frames": len(self), "fields": fields} | {
            f"grid {name}": spec for name, spec in self.grids.items()
        }
        picture = None
        name = next(iter(self.grids), "")
        if f"{name}/labels" in self.fields():
            first = self.frames(f"{name}/labels").tolist()[0]
            palette = self.classes_of(name).palette
            labels = self.read(f"{name}/labels", first)
            left_handed = self.metadata.axes == "left"
            picture = self.grids[name].seen_from_above(labels, palette, left_handed=left_handed)
        return describe(self.location, rows, picture)

    def __getstate__(self) -> dict[str, Any]:
        """Leave out cached data that another process can read again faster than it can be sent."""
        return {
            name: value
            for name, value in self.__dict__.items()
            if name not in ("poses", "times", "_frame_lines")
        }


class Source(Mapping[str, Sequence]):
    """A store that sequences are read from: a mapping from their sorted paths to sequences.

    `source["Train/Town01_Light"]` finds a sequence by its path. The coordinates may be left out of
    the path, if they are Cartesian or the sequence has only one kind.

    Attributes:
        location: name of the source in errors: a folder, a file or a URL.
    """

    location: str

    @abstractmethod
    def sequences(self) -> Mapping[str, Sequence]:
        """Return the sequences by path, in sorted order."""

    def places(self) -> list[str]:
        """Return the sorted folders of sequences and captures, without opening them: a path of a
        sequence without `<coordinates>`. A folder may hold none.
        """
        return sorted({layout.place_of(path) for path in self.sequences()})

    def sequences_in(self, places: Collection[str]) -> Mapping[str, Sequence]:
        """Return the sequences in some of `places()`, by path, in sorted order."""
        chosen = {*places}
        found = self.sequences().items()
        return {path: one for path, one in found if layout.place_of(path) in chosen}

    def __getitem__(self, path: str) -> Sequence:
        """Return a sequence by its path.

        Raises:
            MissingKeyError: the sequence does not exist; this is also a KeyError.
        """
        sequences = self.sequences()
        for name in (path, *(f"{path}/{coordinates}" for coordinates in layout.COORDINATES)):
            if name in sequences:
                return sequences[name]
        raise MissingKeyError(
            self.location, expected=f"the sequence {path}", found=first_names(sequences)
        )

    def __iter__(self) -> Iterator[str]:
        return iter(self.sequences())

    def __len__(self) -> int:
        return len(self.sequences())

    def values(self) -> ValuesView[Sequence]:
        """Return the sequences. The store is listed once."""
        return self.sequences().values()

    def items(self) -> ItemsView[str, Sequence]:
        """Return the paths and the sequences. The store is listed once."""
        return self.sequences().items()

    def __bool__(self) -> bool:
        return True  # a store without sequences is a store

    # equality by identity: no data are read
    __eq__ = object.__eq__
    __hash__ = object.__hash__

    def __repr__(self) -> str:
        return f"<{type(self).__name__} {self.location}>"


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

    def remove_document(self, name: str) -> None:  # noqa: B027 (finished stores cannot change)
        """Remove a text file, if it exists and the store can remove it."""

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
        data = self.read_document(name)
        where = f"{self.location}/{name}"
        with suppress(FormatError):
            if data is not None:
                return math.prod(GridSpec.from_params(parse_json(data, where), where).size)
        return None

    def is_complete(self) -> bool:
        """Whether the sequence has all announced frames; False if the store does not know."""
        return False

    def remove_grid(self, grid: str) -> None:
        """Remove a grid.

        Its params.json is removed last, so that an interrupted removal can be continued.

        Raises:
            ConflictError: the store cannot remove grids.
        """
        raise ConflictError(
            f"{self.location}: this store cannot replace its grid {grid}: write to a new store"
        )

    def remove_frames(self, fields: Iterable[str], frames: Collection[int]) -> None:
        """Remove fields of some frames, if they exist.

        Raises:
            ConflictError: the store cannot remove frames.
        """
        raise ConflictError(
            self.location,
            expected="the frames of its input only",
            found=f"the frames {first_names(map(str, sorted(frames)))}, which the input lacks now",
            advice="this store cannot remove frames: write to a new store",
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
