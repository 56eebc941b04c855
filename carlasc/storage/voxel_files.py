"""Voxel grids in the files of other programs: the frames of one grid, what describes a format, and
a Source that presents the files in the layout.

A format is an entry point of the group `carlasc.voxels`, whose value is a `VoxelFormat`.
"""

from __future__ import annotations

import copy
import fnmatch
import os
import re
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from functools import cache, cached_property
from pathlib import Path
from typing import Literal

import numpy as np

from carlasc.core.arrays import AnyArray, BoolArray, FloatArray, IntArray, LabelArray
from carlasc.core.classes import ClassTable, TableUse, times
from carlasc.core.grids import GridSpec
from carlasc.core.tables import CARLASC11, table_to_json
from carlasc.errors import FormatError, MissingDataError, load_plugin, plugin_names
from carlasc.storage import layout
from carlasc.storage.files import to_json
from carlasc.storage.layout import Metadata
from carlasc.storage.protocol import Sequence, Source

SeenBy = Literal["lidar", "camera"]
"""Whose mask of observed voxels is taken, for data that have both."""

_Read = Callable[[Path], LabelArray]
GROUP = "carlasc.voxels"
IGNORED_ID = 255  # in files of other programs: a voxel that does not count
_BITS = 8  # voxels per byte of an .invalid file


class GridFrames(ABC):
    """The frames of one grid.

    Attributes:
        path: path of the sequence; "" for a plain folder.
        location: name of the grid in errors.
        spec: geometry; None if it is not known.
        classes: class table of the ids; None if it is not known.
        named: what names the class table: "file" (its metadata), "format" (all files of the format
            have these ids), or "assumed".
        benchmark: name of the convention of the benchmark with this file format; None for other
            data.
        origin: position of the sensor in the frame of the grid, metres; None if it is not known.
    """

    path: str
    location: str
    spec: GridSpec | None
    classes: ClassTable | None
    named: str = "assumed"
    benchmark: str | None = None
    origin: tuple[float, float, float] | None = None

    @abstractmethod
    def frames(self) -> IntArray:
        """Return the sorted frames that have labels."""

    @abstractmethod
    def labels(self, frame: int) -> LabelArray:
        """Return the labels of a frame: (X, Y, Z), or (X * Y * Z,) if the geometry is not known."""

    @abstractmethod
    def known(self, frame: int, seen_by: SeenBy = "lidar") -> BoolArray | None:
        """Return the known voxels of a frame (counts > 0, or not invalid), bool; None if the data
        do not have this information.

        `seen_by` selects the mask of the LiDAR or of cameras, for data that have both.
        """

    def name_of(self, frame: int) -> str:
        """Return the name of a frame in messages: its number or its token."""
        return str(frame)

    def poses(self) -> FloatArray | None:
        """Return (F, 4, 4) poses of the grid in all `frames`, in one fixed frame; None without."""
        return None

    def follow(self, truth: GridFrames) -> None:  # noqa: B027 (only some data need it)
        """Take the number of voxels and the frame numbers from the ground truth, if the files of
        predictions lack them.
        """


@dataclass(frozen=True)
class VoxelFormat:
    """A file format of voxel grids: where its files are, and how one of them is read.

    Attributes:
        name: name of the format.
        files: templates of the paths of a grid's files, by name of the grid; that of ground truth
            first. A template such as "sequences/{sequence}/voxels/{frame}.label" has a name for
            each changing part, perhaps with a pattern: "{sequence=scene_*}". Without {sequence},
            the folder is one sequence.
        classes: class table of the ids in files.
        spec: geometry.
        read: function that returns the (X, Y, Z) ids of a file; 255 is an ignored voxel. None for
            `.label` files, which `LabelFolder` reads.
        mask: function that returns the (X, Y, Z) bool mask of the voxels that the LiDAR or a camera
            observed, or None if the file has no such mask. None if no file has one.
        holds: function that returns whether a file has the format, for templates whose names also
            fit other files; None if the name is sufficient.
        label_bytes: bytes per label of `.label` files without a mask.
        named: as in `GridFrames`.
        benchmark: name of the convention that scores the files; a second name is for files without
            camera masks.
        place: frame of the grid in words.
        origin: position of the LiDAR in the grid, metres.
        poses: function that returns (F, 4, 4) poses of the grid in one fixed frame, given the
            folder of a sequence and the names of its frames; None if they are not known.
    """

    name: str
    files: Mapping[str, str]
    classes: ClassTable
    spec: GridSpec
    read: _Read | None = None
    mask: Callable[[Path, SeenBy], BoolArray | None] | None = None
    holds: Callable[[Path], bool] | None = None
    label_bytes: int = 2
    named: str = "format"
    benchmark: tuple[str, ...] = ()
    place: str = "the sensor, x forward"
    origin: tuple[float, float, float] | None = (0.0, 0.0, 0.0)
    poses: Callable[[Path, list[str]], FloatArray | None] | None = None

    def find(self, place: Path) -> Iterator[tuple[str, GridFrames]]:
        """Yield the grids at a place, each with its name: a folder above the files, a folder of
        some of them, or one file.
        """
        for grid, template in self.files.items():
            found: dict[tuple[str, Path], dict[str, Path]] = {}
            for path, names in matches(place, template):
                folder = place if place.is_dir() and "sequence" not in names else path.parent
                if "sequence" in names:
                    depth = template.count("/") - template[: template.index("{sequence")].count("/")
                    folder = path.parents[depth - 1]
                found.setdefault((names.get("sequence", ""), folder), {})[names["frame"]] = path
            for (sequence, folder), files in sorted(found.items()):
                if self.holds is not None and not self.holds(next(iter(files.values()))):
                    continue
                if self.read is None:
                    labels = next(iter(files.values())).parent
                    frames: GridFrames = LabelFolder(labels, sequence, self, frozenset(files))
                else:
                    frames = VoxelFrames(self, self.read, folder, sequence, files)
                if len(frames.frames()):
                    yield grid, frames


class VoxelFrames(GridFrames):
    """The frames of a sequence in files of arrays, one per frame.

    Frames are numbered by the names of their files if these are numbers; otherwise in the order of
    the names (tokens) of the ground truth.

    Attributes:
        format: format of the files.
        read: function that returns the (X, Y, Z) ids of a file.
        files: file of each frame, by name.
        names: names of the frames in order.
    """

    def __init__(
        self, format: VoxelFormat, read: _Read, folder: Path, path: str, files: dict[str, Path]
    ) -> None:
        self.format, self.read = format, read
        self.path, self.location, self.files = path, str(folder), files
        self.classes, self.named, self.origin = format.classes, format.named, format.origin
        self.spec: GridSpec = format.spec
        self.names = sorted(files)

    @cached_property
    def numbered(self) -> bool:
        """Whether the names of the files are numbers."""
        return all(name.isdecimal() for name in self.names)

    @cached_property
    def benchmark(self) -> str | None:  # type: ignore[override]
        """The convention of the benchmark: the second one for files without camera masks."""
        first, *others = (*self.format.benchmark, None)
        masked = len(others) < 2 or self.known(int(self.frames()[0]), "camera") is not None
        return first if masked else others[0]

    def follow(self, truth: GridFrames) -> None:
        """Take the numbering of frames from the ground truth."""
        if isinstance(truth, VoxelFrames):
            self.names, self.numbered = truth.names, truth.numbered

    def only(self, names: list[str]) -> VoxelFrames:
        """Return the frames with these names."""
        files = {name: self.files[name] for name in names}
        return VoxelFrames(self.format, self.read, Path(self.location), self.path, files)

    def frames(self) -> IntArray:
        """Return the numbers of the frames that have a file."""
        names = enumerate(self.names)
        return np.array(
            [int(n) if self.numbered else i for i, n in names if n in self.files], np.int64
        )

    @cached_property
    def _name(self) -> dict[int, str]:
        return {int(n) if self.numbered else i: n for i, n in enumerate(self.names)}

    def name_of(self, frame: int) -> str:
        """Return the name of a frame's file."""
        return str(frame) if self.numbered else self._name[frame]

    def labels(self, frame: int) -> LabelArray:
        """Return (X, Y, Z) ids as they are in the file."""
        return self.read(self.files[self._name[frame]])

    def known(self, frame: int, seen_by: SeenBy = "lidar") -> BoolArray | None:
        """Return (X, Y, Z) bool, the voxels that the LiDAR or a camera observed; None if the file
        does not contain the mask.
        """
        mask = self.format.mask
        return None if mask is None else mask(self.files[self._name[frame]], seen_by)

    def poses(self) -> FloatArray | None:
        """Return (F, 4, 4) poses of the grid; None if the folders hold none."""
        poses = self.format.poses
        return None if poses is None else poses(Path(self.location), self.names)


class LabelFolder(GridFrames):
    """A folder of `000000.label` files without params.json, as other tools write it.

    The folder may also have counts (`000000.bin`, float32), or masks of SemanticKITTI or SSCBench
    (`000000.invalid`, one bit or one byte per voxel). Labels are uint32, as in the layout, or
    uint16, as in these benchmarks; the type follows from the file size and the number of voxels. In
    these benchmarks, `000000.bin` is the occupancy of a scan as bits; it is distinguished from
    counts by its size.

    Attributes:
        format: format of the files; None for a plain folder.
        voxels: number of voxels per frame; None if it is not known.
    """

    def __init__(
        self,
        folder: Path,
        path: str = "",
        format: VoxelFormat | None = None,
        names: frozenset[str] | None = None,
    ) -> None:
        """Keep the folder. `names` are the only frames; None takes all of the folder."""
        self.folder, self.path, self.location = folder, path, str(folder)
        self.format, self._names = format, names
        self.spec, self.classes = None, None
        # bytes per label if the number of voxels is not known
        self._width = 4 if format is None else format.label_bytes
        self.voxels = self._count_voxels(int(self.frames()[0])) if len(self.frames()) else None
        if format is None:
            return
        self.classes, self.named, self.origin = format.classes, format.named, format.origin
        self.benchmark = next(iter(format.benchmark), None)
        if self.voxels is None and len(frames := self.frames()):
            self.voxels = self._file(int(frames[0]), ".label").stat().st_size // self._width
        if self.voxels == format.spec.num_voxels:
            self.spec = format.spec

    def _count_voxels(self, frame: int) -> int | None:
        """Return the number of voxels from the sizes of the files of a frame; None if only labels
        exist.
        """
        if (counts := self._counts(frame)) is not None:
            return counts.stat().st_size // 4
        if (invalid := self._file(frame, ".invalid")).is_file():
            size = invalid.stat().st_size
            # because labels have two or four bytes per voxel
            packed = self._file(frame, ".label").stat().st_size >= size * _BITS
            return size * _BITS if packed else size
        return None

    def _counts(self, frame: int) -> Path | None:
        """Return the file of counts of a frame, with four bytes per voxel; None if it does not
        exist.
        """
        counts, labels = self._file(frame, ".bin"), self._file(frame, ".label")
        if not counts.is_file() or self._file(frame, ".invalid").is_file():
            return None
        return counts if counts.stat().st_size >= labels.stat().st_size else None

    def follow(self, truth: GridFrames) -> None:
        """Take the number of voxels from the ground truth."""
        if truth.spec is not None:
            self.voxels = truth.spec.num_voxels
        elif isinstance(truth, LabelFolder) and truth.voxels is not None:
            self.voxels = truth.voxels

    @cached_property
    def _frames(self) -> IntArray:
        names = os.listdir(self.folder)
        if self._names is not None:
            names = [f"{name}.label" for name in self._names]
        numbers = [layout.frame_of(name, ".label") for name in names]
        return np.array(sorted(number for number in numbers if number is not None), np.int64)

    def frames(self) -> IntArray:
        """Return the sorted frames that have a `.label` file."""
        return self._frames

    def labels(self, frame: int) -> LabelArray:
        """Return (X * Y * Z,) labels.

        Raises:
            FormatError: the file size does not fit a grid.
        """
        path = self._file(frame, ".label")
        size = path.stat().st_size
        types: dict[float, np.dtype[np.unsignedinteger]] = {2: np.dtype("<u2"), 4: np.dtype("<u4")}
        width = self._width if self.voxels is None else size / max(self.voxels, 1)
        if width not in types or size % width:
            expected = (
                f"labels of {self._width} bytes"
                if self.voxels is None
                else f"{self.voxels} labels of 2 or 4 bytes"
            )
            raise FormatError(
                path,
                expected=expected,
                found=f"{size} bytes",
                advice="the file may be truncated, of another grid, or of another type",
            )
        # with the size of the file, because devices have no size
        return np.fromfile(path, types[width], int(size // width))

    def known(self, frame: int, seen_by: SeenBy = "lidar") -> BoolArray | None:
        """Return (X * Y * Z,) bool, the voxels that have votes or are not invalid; None if no such
        file exists.

        Raises:
            FormatError: the file does not have the size of a grid.
        """
        if seen_by == "camera":
            return None
        if (counts := self._counts(frame)) is not None:
            return np.fromfile(counts, "<f4") > 0
        if (invalid := self._file(frame, ".invalid")).is_file():
            mask = np.fromfile(invalid, np.uint8)
            if self.voxels is not None and mask.size not in (
                self.voxels,
                -(-self.voxels // _BITS),
            ):
                raise FormatError(
                    invalid,
                    expected=f"{self.voxels} bytes, or {-(-self.voxels // _BITS)} of packed bits",
                    found=str(mask.size),
                    advice="the file may be truncated, or of another grid",
                )
            if mask.size != self.voxels:
                mask = np.unpackbits(mask, count=self.voxels)
            return mask == 0
        return None

    def poses(self) -> FloatArray | None:
        """Return (F, 4, 4) poses of the grid; None if the folders hold none."""
        if self.format is None or self.format.poses is None:
            return None
        return self.format.poses(self.folder.parent, [f"{n:06d}" for n in self.frames().tolist()])

    def _file(self, frame: int, suffix: str) -> Path:
        return self.folder / f"{frame:06d}{suffix}"


class VoxelSequence(Sequence):
    """Grids in files of another program as a sequence of the layout: free voxels have the id 0, and
    ignored voxels the count 0.

    Attributes:
        frames_of: the frames of each grid, by its name.
    """

    split, coordinates = None, "cartesian"

    def __init__(self, path: str, frames_of: Mapping[str, GridFrames]) -> None:
        first = next(iter(frames_of.values()))
        self.path, self.location, self.frames_of = path, first.location, frames_of
        self.name = path.rpartition("/")[2] or Path(first.location).name

    def with_classes(self, classes: ClassTable) -> VoxelSequence:
        """Return the same files, read with another class table."""
        frames_of = {name: copy.copy(frames) for name, frames in self.frames_of.items()}
        for frames in frames_of.values():
            frames.classes, frames.named = classes, "option"
        return VoxelSequence(self.path, frames_of)

    @cached_property
    def metadata(self) -> Metadata:
        """The axes and classes of the format."""
        return Metadata(axes="right", classes=self._table(next(iter(self.frames_of))))

    @cached_property
    def grids(self) -> Mapping[str, GridSpec]:
        """The geometry of each grid; that of ground truth first.

        Raises:
            FormatError: the files do not have the size of the format.
        """
        return {name: self._spec(name) for name in self.frames_of}

    @cached_property
    def _fields(self) -> dict[str, IntArray]:
        fields = {}
        for name, grid in self.frames_of.items():
            numbers = grid.frames()
            fields[f"{name}/labels"] = fields[f"{name}/counts"] = numbers
            if grid.known(int(numbers[0]), "camera") is not None:
                fields[f"{name}/seen"] = numbers
        return fields

    def fields(self) -> frozenset[str]:
        """Return labels and counts of each grid, and `seen` where a file has a mask of cameras."""
        return frozenset(self._fields)

    def frames(self, field: str) -> IntArray:
        """Return the sorted numbers of the frames that have a field."""
        return self._fields.get(field, np.empty(0, np.int64))

    def read(self, field: str, frame: int) -> AnyArray:
        """Read one field of one frame.

        Raises:
            MissingDataError: the field or the frame does not exist.
            FormatError: the file does not have the format, or holds an id that is no class.
        """
        if frame not in self.frames(field):
            expected = f"{field} of frame {frame}"
            raise MissingDataError(self.location, expected=expected, found="none")
        name, _, part = field.rpartition("/")
        grid, spec = self.frames_of[name], self._spec(name)
        where = f"{grid.location}: frame {grid.name_of(frame)}"
        if part == "seen":
            seen = grid.known(frame, "camera")
            return np.zeros(spec.size, np.uint8) if seen is None else seen.astype(np.uint8)
        labels = grid.labels(frame)
        if labels.size != spec.num_voxels:
            found, expected = str(labels.size), f"{spec.num_voxels} voxels ({spec})"
            raise FormatError(where, expected=expected, found=found)
        labels, table = labels.reshape(spec.size), grid.classes or CARLASC11
        counted = labels != IGNORED_ID
        if part == "counts":
            known = grid.known(frame)
            counted &= True if known is None else known.reshape(spec.size)
            return counted.astype(np.float32)
        labels = np.where(counted, labels, table.free)
        if unknown := table.unknown(labels):
            raise FormatError(where, expected=f"class ids of {table.name}", found=times(unknown))
        swap = np.arange(max(table.names) + 1, dtype=table.dtype)
        swap[[0, table.free]] = table.free, 0
        return swap[labels]

    def documents(self) -> tuple[str, ...]:
        """Return carlasc.json and the params.json of each grid, which are made here."""
        return (layout.METADATA, *map(layout.params_file, self.frames_of))

    def read_document(self, name: str) -> bytes:
        """Return carlasc.json or a params.json.

        Raises:
            MissingDataError: it is another file.
        """
        if name == layout.METADATA:
            return self.metadata.to_json()
        grid = name.removesuffix(f"/{layout.PARAMS}")
        if grid not in self.frames_of:
            raise MissingDataError(self.location, expected=f"the file {name}", found="none")
        table = self._table(grid)
        record = {"format": layout.FORMAT, "classes": table_to_json(table)}
        return to_json(self._spec(grid).to_params(table.num_channels) | {"carlasc": record})

    def table_use(self, grid: str = "") -> TableUse:
        """Return the class table of a grid, which the format names."""
        frames = self.frames_of[grid or next(iter(self.frames_of))]
        return TableUse((frames.classes or CARLASC11).name, frames.named)

    def _table(self, name: str) -> ClassTable:
        return (self.frames_of[name].classes or CARLASC11).with_free_first

    def _spec(self, name: str) -> GridSpec:
        grid = self.frames_of[name]
        if grid.spec is not None:
            return grid.spec
        expected, found = "a grid of known geometry", "files of another size"
        if isinstance(grid, LabelFolder) and grid.format is not None:
            usual = grid.format.spec
            expected = f"{usual.num_voxels} voxels per frame, {usual}, as {grid.format.name} has"
            found = f"{grid.voxels}" + _same_area(grid.voxels or 0, usual)
        raise FormatError(
            grid.location,
            expected=expected,
            found=found,
            advice="the files are of another grid: name it in params.json beside them",
        )


def _same_area(voxels: int, spec: GridSpec) -> str:
    """Return the size of a grid with as many columns as `spec`, in words, if `voxels` fit one."""
    x, y, _ = spec.size
    return f", as {x} x {y} x {voxels // (x * y)} has" if voxels and voxels % (x * y) == 0 else ""


class VoxelSource(Source):
    """Voxel grids in the files of other programs, presented in the layout."""

    def __init__(self, place: Path, sequences: Mapping[str, Mapping[str, GridFrames]]) -> None:
        self.location, self._sequences = str(place), sequences

    def sequences(self) -> Mapping[str, Sequence]:
        """Return the sequences by path."""
        return {
            path: VoxelSequence(path, self._sequences[path]) for path in sorted(self._sequences)
        }

    def frames_of(self) -> Mapping[str, Mapping[str, GridFrames]]:
        """Return the frames of each grid of each sequence, with the ids of the files."""
        return self._sequences


def find_voxels(place: Path) -> VoxelSource | None:
    """Return the voxel grids of other programs at a place; None if there are none.

    Formats are tried in the order of their names; the first one that is found is taken.

    Args:
        place: a folder above the files, a folder of some of them, or one file.
    """
    place = place.absolute()
    for format in voxel_formats():
        sequences: dict[str, dict[str, GridFrames]] = {}
        for grid, frames in format.find(place):
            sequences.setdefault(frames.path, {}).setdefault(grid, frames)
        if sequences:
            return VoxelSource(place, sequences)
    return None


@cache
def voxel_formats() -> tuple[VoxelFormat, ...]:
    """Return the installed formats, in the order of their names."""
    return tuple(load_plugin(GROUP, name) for name in plugin_names(GROUP))


def matches(place: Path, template: str) -> Iterator[tuple[Path, dict[str, str]]]:
    """Yield the files that a template of `VoxelFormat` fits, with the names in their paths.

    `place` is above the first part of the template, or is one of its parts.
    """
    parts = [_part(part) for part in template.split("/")]
    for number in range(len(parts) + 1):
        own = place.parts[len(place.parts) - number :]
        given = [_names(part, name) for part, name in zip(parts, own, strict=False)]
        if None in given:
            continue
        below = parts[number:]
        found = [place] if not below and place.is_file() else []
        if below and place.is_dir():
            found = sorted(place.glob("/".join(glob for glob, _ in below)))
        for path in found:
            own_names = path.parts[len(path.parts) - len(below) :]
            rest = [_names(part, name) for part, name in zip(below, own_names, strict=True)]
            yield (
                path,
                {key: name for each in (*given, *rest) for key, name in (each or {}).items()},
            )
        if found:
            return


def _names(part: tuple[str, re.Pattern[str]], name: str) -> dict[str, str] | None:
    """Return the named pieces of one part of a path; None if the part does not fit."""
    glob, pattern = part
    match = pattern.fullmatch(name) if fnmatch.fnmatchcase(name, glob) else None
    return None if match is None else match.groupdict()


@cache
def _part(part: str) -> tuple[str, re.Pattern[str]]:
    """Return the glob pattern of a part of a template, and an expression of its named pieces."""
    pieces, expression = re.split(r"(\{\w+(?:=[^}]*)?\})", part), ""
    for piece in pieces:
        name = re.match(r"\{(\w+)", piece)
        expression += f"(?P<{name[1]}>.+)" if name else re.escape(piece).replace(r"\*", ".*")
    glob = re.sub(r"\{\w+(?:=([^}]*))?\}", lambda found: found[1] or "*", part)
    return glob, re.compile(expression)
