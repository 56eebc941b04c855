"""A plain NumPy loader, with which `carlasc.Dataset` must agree and whose speed it is compared with.

Written from the format page (docs/format.md#training-samples), on (N, 3) float64 rows. It reads the published layout from the folder.
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
        self.remap = REMAPS["carlasc11"].table

    def __len__(self) -> int:
        return len(list((self.folder / "velodyne").iterdir()))

    def __getitem__(self, frame: int) -> dict[str, Any]:
        dtype = np.uint16 if self.density else np.uint8
        stack = np.zeros((self.history, *self.size), dtype)
        for back in range(min(self.history, frame + 1)):
            points = np.fromfile(self.folder / "velodyne" / f"{frame - back:06d}.bin", np.float32)
            rows = points.reshape(-1, 4)[:, :3].astype(np.float64)
            if back:
                current_T_past = np.linalg.inv(self.poses[frame]) @ self.poses[frame - back]
                rows = rows @ current_T_past[:3, :3].T + current_T_past[:3, 3]
            self.bin(rows, stack[self.history - 1 - back])
        labels = np.fromfile(self.folder / "evaluation" / f"{frame:06d}.label", np.uint32).reshape(self.size)
        counts = np.fromfile(self.folder / "evaluation" / f"{frame:06d}.bin", np.float32).reshape(self.size)
        name = "density" if self.density else "occupancy"
        return {name: stack, "labels": self.remap[labels].astype(np.uint8), "known": counts > 0}

    def bin(self, rows: NDArray[np.float64], grid: NDArray[Any]) -> None:
        """Mark or count the voxels of (N, 3) rows in `grid`."""
        if self.cylindrical:
            radius = np.sqrt(rows[:, 0] ** 2 + rows[:, 1] ** 2)
            rows = np.stack([radius, np.arctan2(rows[:, 1], rows[:, 0]), rows[:, 2]], axis=1)
        rows = rows[np.all((rows >= self.lower) & (rows < self.upper), axis=1)]
        cells = np.floor((rows - self.lower) / self.voxel).astype(int)
        cells = np.clip(cells, 0, self.size - 1)
        if self.density:
            cells, counts = np.unique(cells, axis=0, return_counts=True)
            grid[cells[:, 0], cells[:, 1], cells[:, 2]] = counts
        else:
            grid[cells[:, 0], cells[:, 1], cells[:, 2]] = 1
