"""Voxel grids in the files of other programs: the frames of one grid, what describes a format, and
a Source that presents the files in the layout.

A format is an entry point of the group `carlasc.voxels`, whose value is a `VoxelFormat`.
"""

from __future__ import annotations

import copy
import os
import re
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from functools import cache, cached_property
from pathlib import Path
from typing import Literal, cast

import numpy as np

from carlasc.core.arrays import AnyArray, BoolArray, FloatArray, IntArray, LabelArray
from carlasc.core.classes import ClassTable, TableUse, tables_with, times
from carlasc.core.grids import GridSpec
from carlasc.core.tables import CARLASC11, table_to_json
from carlasc.errors import FormatError, MissingDataError, load_plugin, plugin_names
from carlasc.storage import layout
from carlasc.storage.files import to_json
from carlasc.storage.layout import Metadata
from carlasc.storage.protocol import Sequence
from carlasc.storage.views import ChosenSequences

SeenBy = Literal["lidar", "camera"]
"""Whose mask of observed voxels is taken, for data that have both."""

_Read = Callable[[Path], LabelArray]
GROUP = "carlasc.voxels"
IGNORED_ID = 255  # in files of other programs: a voxel that does not count
_BITS = 8  # voxels per byte of an .invalid file


def is_counted(labels: LabelArray, table: ClassTable) -> BoolArray:
    """Return the voxels, of any shape, that do not have the id of ignored ones in files of other
    programs; in the raw ids of SemanticKITTI, this id is a class.
    """
    return (labels != IGNORED_ID) | (IGNORED_ID in table.names)


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
        classes: class table of the ids in files; None if it is not known.
        spec: geometry; None if it is not known.
        read: function that returns the (X, Y, Z) ids of a file; 255 is an ignored voxel. None for
            `.label` files, which `LabelFrames` reads.
        mask: function that returns the (X, Y, Z) bool mask of the voxels that the LiDAR or a camera
            observed, or None if the file has no such mask. None if no file has one.
        holds: function that returns whether a file has the format, for templates whose names also
            fit other files; None if the name is sufficient.
        label_bytes: bytes per label of `.label` files without a mask.
        named: as in `GridFrames`.
        benchmark: name of the convention that scores the files; a second name is for files without
            camera masks.
        place: frame of the grid in words.
        y_forward: whether the vehicle drives in the direction of y; otherwise in that of x.
        origin: position of the LiDAR in the grid, metres; None if it is not known.
        poses: function that returns (F, 4, 4) poses of the grid in one fixed frame, given the
            folder of its files and the names of its frames; None if they are not known.
    """

    name: str
    files: Mapping[str, str]
    classes: ClassTable | None
    spec: GridSpec | None
    read: _Read | None = None
    mask: Callable[[Path, SeenBy], BoolArray | None] | None = None
    holds: Callable[[Path], bool] | None = None
    label_bytes: int = 2
    named: str = "format"
    benchmark: tuple[str, ...] = ()
    place: str = "the sensor, x forward"
    y_forward: bool = False
    origin: tuple[float, float, float] | None = (0.0, 0.0, 0.0)
    poses: Callable[[Path, list[str]], FloatArray | None] | None = None

    def find(self, place: Path) -> Iterator[tuple[str, GridFrames]]:
        """Yield the grids at a place, each with its name: a folder above the files, a folder of
        some of them, or one file.
        """
        kind = LabelFrames if self.read is None else VoxelFrames
        seen = set[Path]()
        for grid, template in self.files.items():
            depth = template.partition("{frame")[2].count("/")
            found: dict[tuple[str, Path], dict[str, Path]] = {}
            for path, names in matches(place, template):
                if path not in seen:
                    key = names.get("sequence", ""), path.parents[depth]
                    found.setdefault(key, {})[names["frame"]] = path
                    seen.add(path)
            for (sequence, folder), files in sorted(found.items()):
                if self.holds is None or self.holds(next(iter(files.values()))):
                    yield grid, kind(self, folder, sequence, files)


class VoxelFrames(GridFrames):
    """The frames of a sequence in files of arrays, one per frame.

    Frames are numbered by the names of their files if these are numbers; otherwise in the order of
    the names (tokens) of the ground truth.

    Attributes:
        format: format of the files.
        files: file of each frame, by name.
        names: names of the frames in order.
    """

    def __init__(
        self, format: VoxelFormat, folder: Path, path: str, files: Mapping[str, Path]
    ) -> None:
        """Keep the files, which are in `folder` or in folders of their frames in it."""
        self.format = format
        self.path = path
        self.location = str(folder)
        self.classes = format.classes
        self.named = format.named
        self.origin = format.origin
        self.spec = format.spec
        self.files = files
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
        """Take the numbering of frames from the ground truth, unless both have numbers."""
        if isinstance(truth, VoxelFrames) and not (self.numbered and truth.numbered):
            self.names = truth.names
            self.numbered = truth.numbered
            vars(self).pop("_name", None)

    def only(self, names: list[str]) -> VoxelFrames:
        """Return the frames with these names."""
        files = {name: self.files[name] for name in names}
        return VoxelFrames(self.format, Path(self.location), self.path, files)

    @cached_property
    def _name(self) -> dict[int, str]:
        return {int(n) if self.numbered else i: n for i, n in enumerate(self.names)}

    def frames(self) -> IntArray:
        """Return the numbers of the frames that have a file."""
        return np.array([i for i, name in self._name.items() if name in self.files], np.int64)

    def name_of(self, frame: int) -> str:
        """Return the name of a frame's file."""
        return str(frame) if self.numbered else self._name[frame]

    def file_of(self, frame: int) -> Path:
        """Return the file of a frame."""
        return self.files[self._name[frame]]

    def labels(self, frame: int) -> LabelArray:
        """Return (X, Y, Z) ids as they are in the file."""
        return cast("_Read", self.format.read)(self.file_of(frame))

    def known(self, frame: int, seen_by: SeenBy = "lidar") -> BoolArray | None:
        """Return (X, Y, Z) bool, the voxels that the LiDAR or a camera observed; None if the file
        does not contain the mask.
        """
        mask = self.format.mask
        return None if mask is None else mask(self.file_of(frame), seen_by)

    def poses(self) -> FloatArray | None:
        """Return (F, 4, 4) poses of the grid; None if the folders hold none."""
        poses = self.format.poses
        return None if poses is None else poses(Path(self.location), self.names)


class LabelFrames(VoxelFrames):
    """The frames of a folder of `000000.label` files without params.json.

    The folder may also have counts (`000000.bin`, float32), or masks of SemanticKITTI or SSCBench
    (`000000.invalid`, one bit or one byte per voxel). Labels are uint32, as in the layout, or
    uint16, as in these benchmarks; the type follows from the file size and the number of voxels. In
    these benchmarks, `000000.bin` is the occupancy of a scan as bits; it is distinguished from
    counts by its size.

    Attributes:
        voxels: number of voxels per frame; None if it is not known.
    """

    def __init__(
        self, format: VoxelFormat, folder: Path, path: str, files: Mapping[str, Path]
    ) -> None:
        """Keep the files. The geometry is that of the format if the size of the first file fits."""
        super().__init__(format, folder, path, files)
        first = files[self.names[0]]
        size = first.stat().st_size
        invalid = first.with_suffix(".invalid")
        self.voxels: int | None = None
        if (counts := _counts_of(first)) is not None:
            self.voxels = counts.stat().st_size // 4
        elif invalid.is_file():
            self.voxels = invalid.stat().st_size
            if size >= self.voxels * _BITS:  # because labels have two or four bytes per voxel
                self.voxels *= _BITS
        elif self.spec is not None:
            self.voxels = size // format.label_bytes
        if self.spec is not None and self.voxels != self.spec.num_voxels:
            self.spec = None

    def follow(self, truth: GridFrames) -> None:
        """Take the number of voxels from the ground truth."""
        if truth.spec is not None:
            self.voxels = truth.spec.num_voxels
        elif isinstance(truth, LabelFrames) and truth.voxels is not None:
            self.voxels = truth.voxels

    def labels(self, frame: int) -> LabelArray:
        """Return (X * Y * Z,) labels.

        Raises:
            FormatError: the file size does not fit a grid.
        """
        path = self.file_of(frame)
        usual = self.format.label_bytes
        size = path.stat().st_size
        types: dict[float, np.dtype[np.unsignedinteger]] = {2: np.dtype("<u2"), 4: np.dtype("<u4")}
        width = usual if self.voxels is None else size / max(self.voxels, 1)
        if width not in types or size % width:
            expected = f"{self.voxels} labels of 2 or 4 bytes"
            raise FormatError(
                path,
                expected=f"labels of {usual} bytes" if self.voxels is None else expected,
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
        file = self.file_of(frame)
        if (counts := _counts_of(file)) is not None:
            return np.fromfile(counts, "<f4") > 0
        if not (invalid := file.with_suffix(".invalid")).is_file():
            return None
        mask = np.fromfile(invalid, np.uint8)
        if self.voxels is not None and mask.size != self.voxels:
            packed = -(-self.voxels // _BITS)
            if mask.size != packed:
                raise FormatError(
                    invalid,
                    expected=f"{self.voxels} bytes, or {packed} of packed bits",
                    found=mask.size,
                    advice="the file may be truncated, or of another grid",
                )
            mask = np.unpackbits(mask, count=self.voxels)
        return mask == 0


_PLAIN = VoxelFormat("labels", {}, None, None, label_bytes=4, named="assumed", origin=None)


def label_frames(folder: Path, path: str = "") -> LabelFrames | None:
    """Return the frames of the `.label` files of a folder, whatever its name; None without any."""
    names = [name for name in os.listdir(folder) if layout.frame_of(name, ".label") is not None]
    files = {name.removesuffix(".label"): folder / name for name in names}
    return LabelFrames(_PLAIN, folder, path, files) if files else None


def _counts_of(labels: Path) -> Path | None:
    """Return the file of a frame's counts, with four bytes per voxel; None without."""
    counts = labels.with_suffix(".bin")
    if not counts.is_file() or labels.with_suffix(".invalid").is_file():
        return None
    return counts if counts.stat().st_size >= labels.stat().st_size else None


class VoxelSequence(Sequence):
    """Grids in files of another program as a sequence of the layout: free voxels have the id 0, and
    ignored voxels the count 0.

    Attributes:
        frames_of: the frames of each grid, by its name.
    """

    split = None
    coordinates = "cartesian"

    def __init__(self, path: str, frames_of: Mapping[str, GridFrames]) -> None:
        first = next(iter(frames_of.values()))
        self.path = path
        self.location = first.location
        self.frames_of = frames_of
        self.name = path.rpartition("/")[2] or Path(first.location).name

    @property
    def is_at_sensor(self) -> bool:
        """Whether the grids have the frame of the layout: the sensor's, x forward."""
        grid = next(iter(self.frames_of.values()))
        turned = isinstance(grid, VoxelFrames) and grid.format.y_forward
        return grid.origin == (0.0, 0.0, 0.0) and not turned

    def with_classes(self, classes: ClassTable) -> VoxelSequence:
        """Return the same files, read with another class table."""
        frames_of = {name: copy.copy(frames) for name, frames in self.frames_of.items()}
        for frames in frames_of.values():
            # with the ids of the files
            frames.classes = classes
            frames.named = "option"
        return VoxelSequence(self.path, frames_of)

    def follow(self, grid: str, truth: Sequence, truth_grid: str) -> None:
        """Take the numbers of frames, which are named by tokens, from the ground truth."""
        if isinstance(truth, VoxelSequence):
            self.frames_of[grid].follow(truth.frames_of[truth_grid])
            vars(self).pop("_fields", None)

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
        grid = self.frames_of[name]
        spec = self._spec(name)
        where = f"{grid.location}: frame {grid.name_of(frame)}"
        if part == "seen":
            seen = grid.known(frame, "camera")
            return np.zeros(spec.size, np.uint8) if seen is None else seen.astype(np.uint8)
        labels = grid.labels(frame)
        if labels.size != spec.num_voxels:
            found = str(labels.size)
            expected = f"{spec.num_voxels} voxels ({spec})"
            raise FormatError(where, expected=expected, found=found)
        labels = labels.reshape(spec.size)
        table = grid.classes or CARLASC11
        counted = is_counted(labels, table)
        if part == "counts":
            known = grid.known(frame)
            counted &= True if known is None else known.reshape(spec.size)
            return counted.astype(np.float32)
        labels = np.where(counted, labels, table.free)
        if unknown := table.unknown(labels):
            names = [one.name for one in tables_with(np.unique(labels).tolist(), table)]
            best = grid.benchmark if grid.benchmark in names else next(iter(names), None)
            raise FormatError(
                where,
                expected=f"class ids of {table.name}",
                found=times(unknown),
                advice=f"if they are ids of {best}, give `source_classes={best}`"
                if best
                else "correct the labels, or name their table with `source_classes`",
            )
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
        expected = "a grid of known geometry"
        found = "files of another size"
        if isinstance(grid, LabelFrames) and (usual := grid.format.spec) is not None:
            expected = f"{usual.num_voxels} voxels per frame, {usual}, as {grid.format.name} has"
            found, (x, y, _) = str(grid.voxels), usual.size
            if grid.voxels and grid.voxels % (x * y) == 0:
                found += f", as {x} x {y} x {grid.voxels // (x * y)} has"
        raise FormatError(
            grid.location,
            expected=expected,
            found=found,
            advice="the files are of another grid: name it in params.json beside them",
        )


def find_voxels(place: Path) -> ChosenSequences | None:
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
            found = {path: VoxelSequence(path, sequences[path]) for path in sorted(sequences)}
            return ChosenSequences(str(place), found)
    return None


@cache
def voxel_formats() -> tuple[VoxelFormat, ...]:
    """Return the installed formats, in the order of their names."""
    return tuple(load_plugin(GROUP, name) for name in plugin_names(GROUP))


def matches(place: Path, template: str) -> Iterator[tuple[Path, dict[str, str]]]:
    """Yield the files that a template of `VoxelFormat` fits, with the names in their paths.

    `place` is above the first part of the template, or is one of its parts.
    """
    glob, expression = _patterns(template)
    parts = glob.split("/")
    for number in range(len(parts) + 1):
        above = "/".join(parts[:number])
        below = "/".join(parts[number:])
        if above and not place.match(above):
            continue
        paths = [place] if place.is_file() and not below else []
        if place.is_dir() and below:
            paths = sorted(place.glob(below))
        for path in paths:
            if found := expression.fullmatch("/".join(path.parts[-len(parts) :])):
                yield path, found.groupdict()
        if paths:
            return


@cache
def _patterns(template: str) -> tuple[str, re.Pattern[str]]:
    """Return the glob pattern of a template, and an expression of its named parts."""
    first, *rest = re.split(r"\{(\w+)(?:=([^}]*))?\}", template)
    glob = first
    expression = _escaped(first)
    for name, pattern, text in zip(rest[::3], rest[1::3], rest[2::3], strict=True):
        glob += (pattern or "*") + text
        expression += f"(?P<{name}>[^/]+)" + _escaped(text)
    return glob, re.compile(expression)


def _escaped(text: str) -> str:
    return re.escape(text).replace(r"\*", "[^/]*")
