"""The voxel grids of CarlaOcc: `{sequence}/occupancy/{grid}/0000.npz` with rows x, y, z and label
of the voxels inside meshes.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from carlasc.core.arrays import BoolArray, IntArray, LabelArray, Uint8Array
from carlasc.core.grids import GridSpec
from carlasc.core.tables import CARLAOCC
from carlasc.errors import FormatError
from carlasc.storage.arrays import NUMBERS, ArrayFormat, check_size
from carlasc.storage.voxel_files import GridFrames, SeenBy, VoxelFormat
from carlasc_converters.files import read_arrays

_COPY = "the file is incomplete: copy it again"
CARLAOCC_GRIDS = ("vs_0_4_surround_view", "vs_0_2_forward_view", "vs_0_1")
"""Names of grids. The first existing one is the default."""


class CarlaOccGrids(GridFrames):
    """The grids of a sequence of CarlaOcc with one name.

    Args:
        folder: the folder of the sequence.
        grid: name of the folder in `occupancy/`.
    """

    classes = CARLAOCC
    named = "format"
    origin = (0.0, 0.0, 0.0)

    def __init__(self, folder: Path, grid: str) -> None:
        self.path = sequence_name(folder)
        self.location = str(folder / "occupancy" / grid)
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
                file, expected=f"the geometry of the first frame: {self.spec}", found=spec
            )
        return read_voxels(file, spec)


class CarlaOccFormat(VoxelFormat):
    """The folders of CarlaOcc: grids of several sizes, whose geometry is in each file."""

    def find(self, place: Path) -> Iterator[tuple[str, GridFrames]]:
        """Yield the grids of a sequence folder, or of all sequences in a folder, with their names;
        those of `CARLAOCC_GRIDS` first.
        """
        given = place if place.parent.name == "occupancy" else None
        above = place if given is None else place.parent.parent
        for sequence in (above, *sorted(path for path in above.glob("*") if path.is_dir())):
            names = {
                path.name
                for path in (sequence / "occupancy").glob("*")
                if any(path.glob("[0-9]*.npz")) and given in (None, path)
            }
            usual = [name for name in CARLAOCC_GRIDS if name in names]
            for name in (*usual, *sorted(names - {*usual})):
                yield name, CarlaOccGrids(sequence, name)


FORMAT = CarlaOccFormat("CarlaOcc", {}, CARLAOCC, GridSpec.published())


def sequence_name(folder: Path) -> str:
    """Return the name of a sequence in the layout: the part after the last "_" of the folder."""
    return f"CARLAOCC_{folder.resolve().name.replace('_', '-')}"


def read_voxels(path: str | Path, spec: GridSpec) -> tuple[Uint8Array, BoolArray]:
    """Return (X, Y, Z) tags of a grid, and (X, Y, Z) bool, the known voxels.

    Occupied voxels without a class are unknown.

    Raises:
        FormatError: the file is not a grid of this geometry.
    """
    rows = read_arrays(
        path, {"occupancy": ArrayFormat(("<u2",), (None, 4), 4 * spec.num_voxels)}, _COPY
    )[0]
    cells = rows[:, :3].astype(np.int64)
    if outside := int((cells >= spec.size).any(axis=1).sum()):
        raise FormatError(
            path, expected=f"voxels inside of {spec}", found=f"{outside} voxels outside"
        )
    semantic = semantic_ids(rows[:, 3])
    labels = np.zeros(spec.size, np.uint8)
    known = np.ones(spec.size, np.bool_)
    labels[tuple(cells.T)] = semantic
    known[tuple(cells[semantic == 0].T)] = False
    return labels, known


def semantic_ids(codes: LabelArray) -> Uint8Array:
    """Return the classes of voxel labels, which combine class and instance.

    The documentation has `1000 * class + instance`, the code that made the files `2048 * class +
    instance`. Most voxels belong to classes whose instance is always 0, and no label above 0 is a
    multiple of both numbers, so the formula can be determined from the labels.
    """
    decimal = int(np.count_nonzero(codes % 1000 == 0))
    binary = int(np.count_nonzero(codes % 2048 == 0))
    return (codes // (1000 if decimal > binary else 2048)).astype(np.uint8)


def read_geometry(path: str | Path) -> GridSpec:
    """Return the geometry of a grid, in the frame of the LiDAR.

    Raises:
        FormatError: the file does not describe a grid.
    """
    few = ArrayFormat(NUMBERS, None, 3)
    step, origin, size = read_arrays(
        path, dict.fromkeys(("voxel_size", "voxel_origin", "volume_size"), few), _COPY
    )
    try:
        lower = np.asarray(origin, np.float64).reshape(3)
        cells = np.asarray(size, np.int64).reshape(3)
        x, y, z = cells.tolist()
        check_size((x, y, z), np.dtype(np.uint8), str(path))
        # Rounded to decimals first, because the origin is float32 and the voxel size is not: the
        # bounds are then those of the documentation in float32, as with `--bounds`.
        low = np.round(lower, 4).tolist()
        up = np.round(lower + cells * float(step), 4).tolist()
        return GridSpec(
            "cartesian", (x, y, z), (low[0], low[1], low[2]), (up[0], up[1], up[2])
        ).with_bounds(low, up)
    except (TypeError, ValueError, OverflowError) as error:
        raise FormatError(
            path,
            expected="voxel_size, and 3 values of voxel_origin and volume_size",
            found=error,
        ) from error
