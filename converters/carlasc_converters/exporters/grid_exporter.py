"""The common part of exporters of voxel grids: the choice of the grid, its classes, its axes and
its voxels.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Annotated, ClassVar, Literal

import numpy as np

from carlasc import storage
from carlasc.converting import FrameExporter, TargetFrame, is_same, resample_to, resampling_notes
from carlasc.core.arrays import BoolArray, Float32Array, LabelArray
from carlasc.core.benchmarks import IGNORED
from carlasc.core.geometry import mirror_points
from carlasc.core.grids import GridSpec
from carlasc.errors import ArgumentError, MissingDataError
from carlasc_converters.exporters.classes import classes_of, lookup_of, mapping_of

GridName = Annotated[
    str | None,
    "Grid to export. Default: the grid with exactly the voxels of the other data set, otherwise "
    "the grid with the smallest voxels.",
]
Predictions = Annotated[
    bool, "The grids are predictions without counts: all of their voxels are known."
]
_MOSTLY = 0.5  # share of the occupied voxels above which structure without a class gives a note
_CARLASC_HEIGHT_M = 1.8  # docs/format.md#coordinate-frame


@dataclass(eq=False)
class GridExporter(FrameExporter):
    """Writes voxel grids of a given geometry, in classes of a given table.

    Attributes:
        target: geometry of the grids that are written, in the frame that `frame_of` returns.
        maps: name of a class table -> id -> class that is written, or IGNORED for classes whose
            voxels are unknown.
        kind: the attribute of a `Kind` that holds its class.
        free: the class of free voxels.
        slug: a name for the exact grid in the layout.
    """

    target: ClassVar[GridSpec]
    maps: ClassVar[Mapping[str, Mapping[int, int]]]
    kind: ClassVar[Literal["occ3d", "raw"]] = "occ3d"
    free: ClassVar[int]
    slug: ClassVar[str]

    grid: GridName = None
    predictions: Predictions = field(default=False, kw_only=True)

    def frame_of(self, sequence: storage.Sequence) -> TargetFrame:
        """Return the frame of the grids that are written."""
        return TargetFrame()

    def check(self, sequence: storage.Sequence) -> list[str]:
        """Return notes on what resampling loses; raise if the grid or the map of its classes does
        not exist.
        """
        name = self.grid_of(sequence)
        axes = sequence.metadata.axes
        frame = self.frame_of(sequence)
        mapping_of(self.maps, self.kind, sequence.classes_of(name), f"{sequence.location}/{name}")
        if not self.predictions and f"{name}/counts" not in sequence.fields():
            raise MissingDataError(
                f"{sequence.location}/{name}",
                expected="counts, for the known voxels",
                found="none",
                advice="if the grids are predictions, give `predictions=True`",
            )
        notes = resampling_notes(frame.spec_in(sequence.grids[name], axes), self.target, name)
        if notes and sequence.metadata.has_rays:  # no grids can be made from scans without rays
            exact = frame.spec_from(self.target, axes)
            size = ",".join(map(str, exact.size))
            bounds = ",".join(
                f"{value:g}"
                for pair in zip(exact.lower, exact.upper, strict=True)
                for value in pair
            )
            notes.append(
                f"`carlasc regrid SOURCE --observe scans --size {size} --bounds {bounds} --name "
                f"{self.slug}` makes the exact grid"
            )
        return notes + self._structure_without_class(sequence, name)

    def _structure_without_class(self, sequence: storage.Sequence, name: str) -> list[str]:
        """Return a note on the class of structure, if it has no class in the first frame, as in
        data with boxes only.
        """
        table = sequence.classes_of(name)
        frames = sequence.frames(f"{name}/labels")
        if not len(frames):
            return []
        occupied = np.asarray(sequence.read(f"{name}/labels", int(frames[0])))
        occupied = occupied[occupied > 0]
        share = np.mean(occupied == table.geometry_id) if occupied.size else 0.0
        if share <= _MOSTLY:
            return []
        becomes = mapping_of(self.maps, self.kind, table, sequence.location)[table.geometry_id]
        what = "unknown voxels" if becomes == IGNORED else f"class {becomes}"
        return [
            f"{sequence.location}/{name}: {share:.0%} of the occupied voxels are "
            f"{table.names[table.geometry_id]}, structure without a class of its own: they become "
            f"{what} of {self.slug}"
        ]

    def frames(self, sequence: storage.Sequence) -> list[int]:
        """Return the frames that have the grid."""
        return sequence.frames(f"{self.grid_of(sequence)}/labels").tolist()

    def grid_of(self, sequence: storage.Sequence) -> str:
        """Return the name of the grid to export.

        Raises:
            MissingDataError: the sequence has no Cartesian grid, or none of that name.
            ArgumentError: the grid of that name is not Cartesian.
        """
        grids = {
            name: spec
            for name, spec in sequence.grids.items()
            if f"{name}/labels" in sequence.fields()
        }
        return choose_grid(sequence, grids, self.grid, (self.target, self.frame_of(sequence)))

    def read(self, sequence: storage.Sequence, frame: int) -> tuple[LabelArray, BoolArray]:
        """Return a frame's grid in the target's voxels and classes: (X, Y, Z) labels, and which
        voxels are known.

        Raises:
            CarlascError: the grid cannot be read, or has an id that is not in its class table.
        """
        codes, known = self.read_codes(sequence, frame)
        classes = np.arange(-1, int(codes.max(initial=0))).astype(codes.dtype)
        classes[0] = self.free
        return classes[codes], known

    def read_codes(self, sequence: storage.Sequence, frame: int) -> tuple[LabelArray, BoolArray]:
        """Return the result of `read`, with 0 for free or unknown voxels, else class + 1."""
        name = self.grid_of(sequence)
        axes = sequence.metadata.axes
        place = self.frame_of(sequence)
        grid = sequence.grid(name, frame)
        table = sequence.classes_of(name)
        where = f"{sequence.location}: {name} of frame {frame}"
        lookup = lookup_of(mapping_of(self.maps, self.kind, table, where))
        classes = classes_of(grid.labels, lookup, table, where)
        known = (
            np.ones(grid.spec.size, np.bool_)
            if self.predictions
            else grid.known & (classes != IGNORED)
        )
        codes: LabelArray = np.where(classes == self.free, 0, classes + 1).astype(
            np.uint16 if lookup.max() > 254 else np.uint8
        )
        return resample_to(
            place.turn(codes, axes),
            place.turn(known, axes),
            place.spec_in(grid.spec, axes),
            self.target,
        )


def choose_grid(
    sequence: storage.Sequence,
    grids: Mapping[str, GridSpec],
    wanted: str | None,
    target: tuple[GridSpec, TargetFrame] | None = None,
) -> str:
    """Return the name of the grid to export.

    Args:
        sequence: the sequence.
        grids: geometry of its grids, by name.
        wanted: the requested grid; None takes the one with the voxels of the target, otherwise the
            one with the smallest voxels.
        target: geometry that is written, and its frame.

    Raises:
        MissingDataError: the sequence has no Cartesian grid, or none of that name.
        ArgumentError: the grid of that name is not Cartesian.
    """
    if wanted is not None:
        if wanted not in grids:
            found = ", ".join(grids) or "none"
            raise MissingDataError(sequence.location, expected=f"the grid {wanted}", found=found)
        if grids[wanted].coordinates != "cartesian":
            found = f"{sequence.location}/{wanted}, which is cylindrical"
            raise ArgumentError("grid", expected="a Cartesian grid", found=found)
        return wanted
    flat = {name: spec for name, spec in grids.items() if spec.coordinates == "cartesian"}
    if not flat:
        found = "only cylindrical ones" if grids else "none"
        raise MissingDataError(
            sequence.location,
            expected="a Cartesian grid",
            found=found,
            advice="make one: `carlasc regrid`",
        )
    if target is not None:
        spec, frame = target
        for name, candidate in flat.items():
            if is_same(frame.spec_in(candidate, sequence.metadata.axes), spec):
                return name
    return min(flat, key=lambda name: (float(np.prod(flat[name].voxel_size)), name))


def number_folders(names: Sequence[str], prefix: str, digits: int) -> dict[str, str]:
    """Return a number for each name: the number at its end, after the prefix, or the next free
    number.

    Args:
        names: names of sequences.
        prefix: the text before the number.
        digits: number of digits.
    """
    numbers = {
        name: match[1]
        for name in names
        if (match := re.search(rf"{prefix}(\d{{{digits}}})$", name))
    }
    free = (
        f"{number:0{digits}d}"
        for number in range(10_000)
        if f"{number:0{digits}d}" not in numbers.values()
    )
    return {name: numbers.get(name) or next(free) for name in names}


def sensor_height(sequence: storage.Sequence, given: float | None) -> tuple[float, bool]:
    """Return the height of the sensor above the ground in metres, and whether it was assumed.

    It is the given height, that of the first sensor in carlasc.json, or that of CarlaSC. Sequences
    without carlasc.json are CarlaSC's, and captures that CarlaSC's simulators recorded are alike.
    """
    metadata = sequence.metadata
    height = metadata.height_m if given is None else given
    if height is not None:
        return height, False
    simulated = metadata.extra.get("simulated") is True and "sensors" not in metadata.extra
    is_own = simulated or storage.layout.METADATA not in sequence.documents()
    return _CARLASC_HEIGHT_M, not is_own


def read_points(sequence: storage.Sequence, frame: int) -> Float32Array:
    """Return (N, 4) right-handed points and remission of a frame; none without a scan."""
    if not np.isin(frame, sequence.frames("points")):
        return np.empty((0, 4), np.float32)
    points = np.asarray(sequence.read("points", frame), np.float32)
    return points if sequence.metadata.axes == "right" else mirror_points(points)


def scan_occupancy(sequence: storage.Sequence, points: Float32Array, spec: GridSpec) -> BoolArray:
    """Return the voxels that hold a point of a scan.

    Args:
        sequence: the sequence, for the ranges of points to use.
        points: (N, 4) points and remission, right-handed.
        spec: geometry of the grid, right-handed.

    Returns:
        (X, Y, Z) bool.
    """
    occupancy = np.zeros(spec.num_voxels, np.bool_)
    distance = np.linalg.norm(points[:, :3].astype(np.float64), axis=1)
    low = sequence.metadata.min_range_m or 0.0
    high = sequence.metadata.max_range_m or np.inf
    index = spec.flat_index(points[(distance >= low) & (distance <= high), :3])
    occupancy[index[index >= 0]] = True
    return occupancy.reshape(spec.size)
