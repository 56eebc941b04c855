"""The voxel grids of CarlaOcc: `{sequence}/occupancy/{grid}/0000.npz`, rows x, y, z and label of the voxels that meshes fill."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from carlasc.core.benchmarks import CARLAOCC
from carlasc.core.grids import GridSpec
from carlasc.errors import FormatError, MissingDataError
from carlasc.metrics.grids import GridFrames
from carlasc.storage.arrays import NUMBERS, ArrayFormat, check_size, open_npz

CARLAOCC_GRIDS = ("vs_0_4_surround_view", "vs_0_2_forward_view", "vs_0_1")
"""Names of grids; the first that exists is the default."""


class CarlaOccGrids(GridFrames):
    """The grids of one name of a sequence of CarlaOcc.

    Args:
        folder: the folder of the sequence.
        grid: name of the folder in `occupancy/`.
    """

    classes = CARLAOCC

    def __init__(self, folder: Path, grid: str) -> None:
        self.path, self.location = sequence_name(folder), str(folder / "occupancy" / grid)
        self.files = {int(file.stem): file for file in Path(self.location).glob("[0-9]*.npz") if file.stem.isdecimal()}
        self.spec = read_geometry(self.files[min(self.files)]) if self.files else None

    def frames(self) -> NDArray[np.int64]:
        """Return the sorted frames that have a file."""
        return np.array(sorted(self.files), np.int64)

    def labels(self, frame: int) -> NDArray[np.unsignedinteger]:
        """Return (X, Y, Z) tags."""
        return self._read(frame)[0]

    def known(self, frame: int, seen_by: Literal["lidar", "camera"] = "lidar") -> NDArray[np.bool_]:
        """Return (X, Y, Z) which voxels have a class or are free: all but those that something without a class fills."""
        return self._read(frame)[1]

    def _read(self, frame: int) -> tuple[NDArray[np.uint8], NDArray[np.bool_]]:
        file = self.files[frame]
        if (spec := read_geometry(file)) != self.spec:
            raise FormatError(file, expected=f"the geometry of the first frame: {self.spec}", found=str(spec))
        return read_voxels(file, spec)


def find_carlaocc(folder: Path, grid: str | None) -> list[CarlaOccGrids]:
    """Return the grids of the sequences in a folder, or of the sequence that it is; None takes the first name of `CARLAOCC_GRIDS` that exists."""
    found = []
    for sequence in (folder, *sorted(path for path in folder.glob("*") if path.is_dir())):
        existing = sorted(path.name for path in (sequence / "occupancy").glob("*") if any(path.glob("[0-9]*.npz")))
        names = [name for name in (*CARLAOCC_GRIDS, *existing) if name in existing and grid in (None, name)]
        found += [CarlaOccGrids(sequence, name) for name in names[:1]]
    return found


def sequence_name(folder: Path) -> str:
    """Return the name that a sequence has in the layout: what follows the last "_" selects it."""
    return f"CARLAOCC_{folder.resolve().name.replace('_', '-')}"


def read_voxels(path: str | Path, spec: GridSpec) -> tuple[NDArray[np.uint8], NDArray[np.bool_]]:
    """Return (X, Y, Z) tags of a grid and which voxels are known: all but those that something without a class fills.

    Raises:
        FormatError: the file is no grid of this geometry.
    """
    rows = _read_arrays(path, {"occupancy": ArrayFormat(("<u2",), (None, 4), 4 * spec.num_voxels)})[0]
    cells = rows[:, :3].astype(np.int64)
    if outside := int((cells >= spec.size).any(axis=1).sum()):
        raise FormatError(path, expected=f"voxels inside of {spec}", found=f"{outside} voxels outside")
    semantic = semantic_ids(rows[:, 3])
    labels, known = np.zeros(spec.size, np.uint8), np.ones(spec.size, np.bool_)
    labels[tuple(cells.T)] = semantic
    known[tuple(cells[semantic == 0].T)] = False
    return labels, known


def semantic_ids(codes: NDArray[np.unsignedinteger]) -> NDArray[np.uint8]:
    """Return the classes of voxel labels, which also hold an instance.

    The documentation says `1000 * class + instance`, the code that made the files `2048 * class + instance`. Most voxels belong to
    classes whose instance is always 0, and no label above 0 is a multiple of both, so the labels tell which of the two they follow.
    """
    decimal, binary = int(np.count_nonzero(codes % 1000 == 0)), int(np.count_nonzero(codes % 2048 == 0))
    return (codes // (1000 if decimal > binary else 2048)).astype(np.uint8)


def read_geometry(path: str | Path) -> GridSpec:
    """Return the geometry of a grid, in the frame of the LiDAR.

    Raises:
        FormatError: the file does not describe a grid.
    """
    few = ArrayFormat(NUMBERS, None, 3)
    step, origin, size = _read_arrays(path, dict.fromkeys(("voxel_size", "voxel_origin", "volume_size"), few))
    try:
        lower = np.asarray(origin, np.float64).reshape(3)
        cells = np.asarray(size, np.int64).reshape(3)
        x, y, z = cells.tolist()
        check_size((x, y, z), np.dtype(np.uint8), str(path))
        # Decimals first, because the origin is float32 and the size of a voxel is not: the bounds are then those of the documentation,
        # in float32, as `--bounds` gives them.
        low, up = np.round(lower, 4).tolist(), np.round(lower + cells * float(step), 4).tolist()
        return GridSpec("cartesian", (x, y, z), (low[0], low[1], low[2]), (up[0], up[1], up[2])).with_bounds(low, up)
    except (TypeError, ValueError, OverflowError) as error:
        raise FormatError(
            path, expected="voxel_size, and 3 values of voxel_origin and volume_size", found=str(error)
        ) from error


def _read_arrays(path: str | Path, formats: dict[str, ArrayFormat]) -> list[NDArray[Any]]:
    try:
        with open_npz(path) as arrays:
            return [arrays.read(name, expected) for name, expected in formats.items()]
    except (MissingDataError, FormatError) as error:
        error.advice = error.advice or "the file is incomplete: copy it again"
        raise
