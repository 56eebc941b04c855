"""The frames of a grid to score, from a sequence, a plain folder of `.label` files or CarlaOcc; and
voxel-by-voxel comparison of grids.

CarlaOcc has files `{sequence}/occupancy/{grid}/0000.npz` with rows x, y, z and label of the voxels
inside meshes.
"""

from __future__ import annotations

import os
from abc import ABC, abstractmethod
from enum import IntEnum
from functools import cached_property
from pathlib import Path
from typing import Literal

import numpy as np

from carlasc.core.arrays import AnyArray, BoolArray, IntArray, LabelArray, Uint8Array
from carlasc.core.classes import ClassTable
from carlasc.core.grids import Grid, GridSpec
from carlasc.core.tables import CARLAOCC
from carlasc.errors import ArgumentError, FormatError, MissingDataError
from carlasc.storage import Sequence, layout
from carlasc.storage.arrays import NUMBERS, ArrayFormat, check_size, open_npz

SeenBy = Literal["lidar", "camera"]
"""Whose mask of observed voxels is taken, for data that have both."""

_BITS = 8  # voxels per byte of an .invalid file


class GridFrames(ABC):
    """The frames of one grid.

    Attributes:
        path: path of the sequence; "" for a plain folder.
        location: name of the grid in errors.
        spec: geometry; None if it is not known.
        classes: class table of the ids; None if it is not known.
        benchmark: name of the convention of the benchmark with this file format; None for other
            data.
    """

    path: str
    location: str
    spec: GridSpec | None
    classes: ClassTable | None
    benchmark: str | None = None

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

    def follow(self, truth: GridFrames) -> None:  # noqa: B027 (only some data need it)
        """Take the number of voxels and the frame numbers from the ground truth, if the files of
        predictions lack them.
        """


class SequenceGrid(GridFrames):
    """A grid of a sequence of a Source."""

    def __init__(self, sequence: Sequence, grid: str) -> None:
        self.sequence, self.grid = sequence, grid
        self.path, self.location = sequence.path, f"{sequence.location}/{grid}"
        self.spec, self.classes = sequence.grids[grid], sequence.classes_of(grid)

    def frames(self) -> IntArray:
        """Return the sorted frames that have labels."""
        return self.sequence.frames(f"{self.grid}/labels")

    def labels(self, frame: int) -> LabelArray:
        """Return (X, Y, Z) labels."""
        return self.sequence.read(f"{self.grid}/labels", frame)

    def known(self, frame: int, seen_by: SeenBy = "lidar") -> BoolArray | None:
        """Return (X, Y, Z) bool, the voxels with votes, or those that a camera also sees; None if
        the grid has no such fields.
        """
        fields = [f"{self.grid}/counts"] + ([f"{self.grid}/seen"] if seen_by == "camera" else [])
        if not set(fields) <= self.sequence.fields():
            return None
        return np.logical_and.reduce([self.sequence.read(field, frame) > 0 for field in fields])


class LabelFolder(GridFrames):
    """A folder of `000000.label` files without params.json, as other tools write it.

    The folder may also have counts (`000000.bin`, float32), or masks of SemanticKITTI or SSCBench
    (`000000.invalid`, one bit or one byte per voxel). Labels are uint32, as in the layout, or
    uint16, as in these benchmarks; the type follows from the file size and the number of voxels. In
    these benchmarks, `000000.bin` is the occupancy of a scan as bits; it is distinguished from
    counts by its size.

    Attributes:
        voxels: number of voxels per frame; None if it is not known.
    """

    spec: GridSpec | None = None
    classes: ClassTable | None = None
    _width = 4  # bytes per label if the number of voxels is not known

    def __init__(self, folder: Path, path: str = "") -> None:
        self.folder, self.path, self.location = folder, path, str(folder)
        self.voxels = self._count_voxels(int(self.frames()[0])) if len(self.frames()) else None

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
        numbers = [layout.frame_of(name, ".label") for name in os.listdir(self.folder)]
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

    def _file(self, frame: int, suffix: str) -> Path:
        return self.folder / f"{frame:06d}{suffix}"


class VoxelOutcome(IntEnum):
    """Result of the comparison of one voxel of a prediction with the ground truth."""

    NOT_COMPARED = 0
    """The ground truth is unknown, or both are free."""
    RIGHT = 1
    """Occupied in both, with the same class."""
    WRONG = 2
    """Occupied in both, with different classes."""
    MISSED = 3
    """Occupied in the ground truth, predicted free."""
    INVENTED = 4
    """Free in the ground truth, predicted occupied."""


def compare_grids(prediction: Grid, truth: Grid) -> Uint8Array:
    """Compare a prediction with the ground truth, voxel by voxel.

    Args:
        prediction: predicted grid, with the same class table as the ground truth.
        truth: true grid. Voxels with count 0 are unknown and are not compared; without counts, all
            voxels are known.

    Returns:
        (X, Y, Z) uint8, a `VoxelOutcome` per voxel.

    Raises:
        ArgumentError: the grids differ in their geometry.
    """
    check_same_geometry(prediction.spec, truth.spec)
    predicted, occupied = prediction.labels > 0, truth.labels > 0
    right = occupied & (prediction.labels == truth.labels)
    # the first condition that holds decides
    conditions = [~truth.known, right, occupied & predicted, occupied, predicted]
    outcomes = np.select(conditions, list(VoxelOutcome), VoxelOutcome.NOT_COMPARED)
    return outcomes.astype(np.uint8)


def check_same_geometry(prediction: GridSpec, truth: GridSpec) -> None:
    """Raise ArgumentError if the grids of prediction and ground truth have different sizes, bounds
    or coordinates.
    """
    if prediction != truth:
        raise ArgumentError(
            "truth",
            expected=f"the geometry of the predicted grid ({prediction}, {prediction.lower} to "
            f"{prediction.upper})",
            found=f"{truth}, {truth.lower} to {truth.upper}",
            advice="choose another grid with `grid` or `truth_grid`",
        )


CARLAOCC_GRIDS = ("vs_0_4_surround_view", "vs_0_2_forward_view", "vs_0_1")
"""Names of grids. The first existing one is the default."""


class CarlaOccGrids(GridFrames):
    """The grids of a sequence of CarlaOcc with one name.

    Args:
        folder: the folder of the sequence.
        grid: name of the folder in `occupancy/`.
    """

    classes = CARLAOCC

    def __init__(self, folder: Path, grid: str) -> None:
        self.path, self.location = sequence_name(folder), str(folder / "occupancy" / grid)
        self.files = {
            int(file.stem): file
            for file in Path(self.location).glob("[0-9]*.npz")
            if file.stem.isdecimal()
        }
        self.spec = read_geometry(self.files[min(self.files)]) if self.files else None

    def frames(self) -> IntArray:
        """Return the sorted frames that have a file."""
        return np.array(sorted(self.files), np.int64)

    def labels(self, frame: int) -> LabelArray:
        """Return (X, Y, Z) tags."""
        return self._read(frame)[0]

    def known(self, frame: int, seen_by: SeenBy = "lidar") -> BoolArray:
        """Return (X, Y, Z) bool, the voxels that have a class or are free.

        Occupied voxels without a class are unknown.
        """
        return self._read(frame)[1]

    def _read(self, frame: int) -> tuple[Uint8Array, BoolArray]:
        file = self.files[frame]
        if (spec := read_geometry(file)) != self.spec:
            raise FormatError(
                file, expected=f"the geometry of the first frame: {self.spec}", found=str(spec)
            )
        return read_voxels(file, spec)


def find_carlaocc(folder: Path, grid: str | None) -> list[CarlaOccGrids]:
    """Return the grids of a sequence folder, or of all sequences in a folder.

    With None, the first existing name of `CARLAOCC_GRIDS` is used.
    """
    grids = []
    for sequence in (folder, *sorted(path for path in folder.glob("*") if path.is_dir())):
        existing = sorted(
            path.name for path in (sequence / "occupancy").glob("*") if any(path.glob("[0-9]*.npz"))
        )
        usual = next((name for name in (*CARLAOCC_GRIDS, *existing) if name in existing), None)
        if existing and (grid or usual) in existing:
            grids.append(CarlaOccGrids(sequence, str(grid or usual)))
    return grids


def sequence_name(folder: Path) -> str:
    """Return the name of a sequence in the layout: the part after the last "_" of the folder."""
    return f"CARLAOCC_{folder.resolve().name.replace('_', '-')}"


def read_voxels(path: str | Path, spec: GridSpec) -> tuple[Uint8Array, BoolArray]:
    """Return (X, Y, Z) tags of a grid, and (X, Y, Z) bool, the known voxels.

    Occupied voxels without a class are unknown.

    Raises:
        FormatError: the file is not a grid of this geometry.
    """
    rows = _read_arrays(path, {"occupancy": ArrayFormat(("<u2",), (None, 4), 4 * spec.num_voxels)})[
        0
    ]
    cells = rows[:, :3].astype(np.int64)
    if outside := int((cells >= spec.size).any(axis=1).sum()):
        raise FormatError(
            path, expected=f"voxels inside of {spec}", found=f"{outside} voxels outside"
        )
    semantic = semantic_ids(rows[:, 3])
    labels, known = np.zeros(spec.size, np.uint8), np.ones(spec.size, np.bool_)
    labels[tuple(cells.T)] = semantic
    known[tuple(cells[semantic == 0].T)] = False
    return labels, known


def semantic_ids(codes: LabelArray) -> Uint8Array:
    """Return the classes of voxel labels, which combine class and instance.

    The documentation has `1000 * class + instance`, the code that made the files `2048 * class +
    instance`. Most voxels belong to classes whose instance is always 0, and no label above 0 is a
    multiple of both numbers, so the formula can be determined from the labels.
    """
    decimal, binary = (
        int(np.count_nonzero(codes % 1000 == 0)),
        int(np.count_nonzero(codes % 2048 == 0)),
    )
    return (codes // (1000 if decimal > binary else 2048)).astype(np.uint8)


def read_geometry(path: str | Path) -> GridSpec:
    """Return the geometry of a grid, in the frame of the LiDAR.

    Raises:
        FormatError: the file does not describe a grid.
    """
    few = ArrayFormat(NUMBERS, None, 3)
    step, origin, size = _read_arrays(
        path, dict.fromkeys(("voxel_size", "voxel_origin", "volume_size"), few)
    )
    try:
        lower = np.asarray(origin, np.float64).reshape(3)
        cells = np.asarray(size, np.int64).reshape(3)
        x, y, z = cells.tolist()
        check_size((x, y, z), np.dtype(np.uint8), str(path))
        # Rounded to decimals first, because the origin is float32 and the voxel size is not: the
        # bounds are then those of the documentation in float32, as with `--bounds`.
        low, up = np.round(lower, 4).tolist(), np.round(lower + cells * float(step), 4).tolist()
        return GridSpec(
            "cartesian", (x, y, z), (low[0], low[1], low[2]), (up[0], up[1], up[2])
        ).with_bounds(low, up)
    except (TypeError, ValueError, OverflowError) as error:
        raise FormatError(
            path,
            expected="voxel_size, and 3 values of voxel_origin and volume_size",
            found=str(error),
        ) from error


def _read_arrays(path: str | Path, formats: dict[str, ArrayFormat]) -> list[AnyArray]:
    try:
        with open_npz(path) as arrays:
            return [arrays.read(name, expected) for name, expected in formats.items()]
    except (MissingDataError, FormatError) as error:
        error.advice = error.advice or "the file is incomplete: copy it again"
        raise
