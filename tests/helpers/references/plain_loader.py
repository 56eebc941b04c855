"""A loader in NumPy alone, with which `carlasc.Dataset` must agree and whose speed it is compared
with.

Written from the format page (docs/format.md#training-samples), to be as fast as NumPy allows:
contiguous columns, one flat index per point, `bincount` for densities, and tables of the types that
samples have. It reads the published layout from the folder.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from carlasc.core.tables import REMAPS


class PlainLoader:
    """One `<coordinates>` folder as samples of the last `history` scans."""

    def __init__(self, folder: Path, history: int = 1, *, density: bool = False) -> None:
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
            columns = points.reshape(-1, 4)[:, :3].T.astype(np.float64, order="C")
            if back:
                current_T_past = self.to_current[frame] @ self.poses[frame - back]
                columns = current_T_past[:3, :3] @ columns + current_T_past[:3, 3:]
            self.bin(columns, stack[self.history - 1 - back])
        labels = np.fromfile(self.folder / "evaluation" / f"{frame:06d}.label", np.uint32).reshape(
            self.size
        )
        counts = np.fromfile(self.folder / "evaluation" / f"{frame:06d}.bin", np.float32).reshape(
            self.size
        )
        name = "density" if self.density else "occupancy"
        return {name: stack, "labels": self.remap[labels], "known": counts > 0}

    def bin(self, columns: NDArray[np.float64], grid: NDArray[Any]) -> None:
        """Mark or count the voxels of points, (3, N), in `grid`."""
        if self.cylindrical:
            x, y, z = columns
            columns = np.stack([np.sqrt(x * x + y * y), np.arctan2(y, x), z])
        inside = np.ones(columns.shape[1], bool)
        for column, lower, upper in zip(columns, self.lower, self.upper, strict=True):
            inside &= (column >= lower) & (column < upper)
        flat = np.zeros(int(inside.sum()), np.int64)
        for column, lower, voxel, size in zip(
            columns, self.lower, self.voxel, self.size, strict=True
        ):
            # not negative: truncation is floor
            cell = ((column[inside] - lower) / voxel).astype(np.int64)
            flat = flat * size + np.minimum(cell, size - 1)
        if self.density:
            grid[:] = np.bincount(flat, minlength=grid.size).reshape(grid.shape)
        else:
            grid.reshape(-1)[flat] = 1
