"""Loaders with which the speed of `carlasc.Dataset` is compared: in NumPy alone, with which it must
agree, in NumPy with float32, and in a few lines of Numba.

Written from the format page (docs/format.md#training-samples), to be as fast as NumPy allows:
contiguous columns, one flat index per point, `bincount` for densities, and tables of the types that
samples have. It reads the published layout from the folder.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numba
import numpy as np
from numpy.typing import NDArray

from carlasc.core.tables import REMAPS


class PlainLoader:
    """One `<coordinates>` folder as samples of the last `history` scans.

    With `real=np.float32`, points at the edge of a voxel may be in its neighbour.
    """

    def __init__(
        self, folder: Path, history: int = 1, *, density: bool = False, real: Any = np.float64
    ) -> None:
        self.real = real
        self.folder, self.history, self.density = folder, history, density
        params = json.loads((folder / "evaluation" / "params.json").read_text())
        self.lower, self.upper = np.array(params["min_bound"]), np.array(params["max_bound"])
        self.size = np.array(params["grid_size"]).astype(int)
        self.voxel = (self.upper.astype(np.float32) - self.lower.astype(np.float32)) / self.size
        self.cylindrical = params["coordinates"] == "cylindrical"
        rows = np.loadtxt(folder / "poses.txt", ndmin=2).reshape(-1, 3, 4)
        self.poses = np.tile(np.eye(4), (len(rows), 1, 1))
        self.poses[:, :3] = rows
        self.to_current = np.linalg.inv(self.poses)
        self.remap = REMAPS["carlasc11"].table.astype(np.uint8)

    def __len__(self) -> int:
        return len(list((self.folder / "velodyne").iterdir()))

    def __getitem__(self, frame: int) -> dict[str, Any]:
        dtype = np.uint16 if self.density else np.uint8
        stack = np.zeros((self.history, *self.size), dtype)
        for back in range(min(self.history, frame + 1)):
            points = np.fromfile(self.folder / "velodyne" / f"{frame - back:06d}.bin", np.float32)
            current_T_past = self.to_current[frame] @ self.poses[frame - back]
            self.place(points.reshape(-1, 4), current_T_past, stack[self.history - 1 - back], back)
        labels = np.fromfile(self.folder / "evaluation" / f"{frame:06d}.label", np.uint32).reshape(
            self.size
        )
        counts = np.fromfile(self.folder / "evaluation" / f"{frame:06d}.bin", np.float32).reshape(
            self.size
        )
        name = "density" if self.density else "occupancy"
        return {name: stack, "labels": self.remap[labels], "known": counts > 0}

    def place(
        self,
        points: NDArray[np.float32],
        current_T_past: NDArray[np.float64],
        grid: NDArray[Any],
        back: int,
    ) -> None:
        """Mark or count the voxels of (N, 4) points of a scan in `grid`."""
        columns = points[:, :3].T.astype(self.real, order="C")
        if back:
            motion = current_T_past.astype(self.real)
            columns = motion[:3, :3] @ columns + motion[:3, 3:]
        self.bin(columns, grid)

    def bin(self, columns: NDArray[Any], grid: NDArray[Any]) -> None:
        """Mark or count the voxels of points, (3, N), in `grid`."""
        if self.cylindrical:
            x, y, z = columns
            columns = np.stack([np.sqrt(x * x + y * y), np.arctan2(y, x), z])
        inside = np.ones(columns.shape[1], bool)
        bounds = [bound.astype(self.real) for bound in (self.lower, self.upper, self.voxel)]
        for column, lower, upper in zip(columns, *bounds[:2], strict=True):
            inside &= (column >= lower) & (column < upper)
        flat = np.zeros(int(inside.sum()), np.int64)
        for column, lower, voxel, size in zip(
            columns, bounds[0], bounds[2], self.size, strict=True
        ):
            # not negative: truncation is floor
            cell = ((column[inside] - lower) / voxel).astype(np.int64)
            flat = flat * size + np.minimum(cell, size - 1)
        if self.density:
            grid[:] = np.bincount(flat, minlength=grid.size).reshape(grid.shape)
        else:
            grid.reshape(-1)[flat] = 1


class CompiledLoader(PlainLoader):
    """The same for Cartesian grids in ten lines of Numba, with float32."""

    def place(
        self,
        points: NDArray[np.float32],
        current_T_past: NDArray[np.float64],
        grid: NDArray[Any],
        back: int,
    ) -> None:
        """Mark or count the voxels of (N, 4) points of a scan in `grid`."""
        motion = current_T_past.astype(np.float32)
        bounds = self.lower.astype(np.float32), (1 / self.voxel).astype(np.float32)
        _place(points, motion, *bounds, grid, self.density)


LOADERS: dict[str, Callable[..., PlainLoader]] = {
    "plain": PlainLoader,
    "float32": partial(PlainLoader, real=np.float32),
    "numba": CompiledLoader,
}
"""The loaders by their names."""


@numba.njit(fastmath=True)
def _place(points, motion, lower, per_metre, grid, counts):  # type: ignore[no-untyped-def]
    for n in range(len(points)):
        x, y, z = points[n, 0], points[n, 1], points[n, 2]
        a = motion[0, 0] * x + motion[0, 1] * y + motion[0, 2] * z + motion[0, 3] - lower[0]
        b = motion[1, 0] * x + motion[1, 1] * y + motion[1, 2] * z + motion[1, 3] - lower[1]
        c = motion[2, 0] * x + motion[2, 1] * y + motion[2, 2] * z + motion[2, 3] - lower[2]
        a, b, c = a * per_metre[0], b * per_metre[1], c * per_metre[2]
        if 0 <= a < grid.shape[0] and 0 <= b < grid.shape[1] and 0 <= c < grid.shape[2]:
            grid[int(a), int(b), int(c)] = grid[int(a), int(b), int(c)] + 1 if counts else 1
