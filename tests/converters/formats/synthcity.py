"""The points of a simulated drive as an area of SynthCity: a cloud without time."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from converters.formats.paris_carla import in_world
from numpy.typing import NDArray

from carlasc.testing.drives import KINDS, SimulatedDrive

LABELS = {
    "none": 8, "road": 5, "building": 0, "vegetation": 7, "pole": 4, "car": 1, "van": 1, "pedestrian": 6, "cyclist": 6,
}  # fmt: skip
LABEL_OF_KIND = np.array([LABELS[kind] for kind in KINDS])
CORNER = np.array([1017.0, -300.0, 40.0])
"""Where the world of the drive lies in the city."""
NAMES = {"x": "x", "y": "y", "z": "z", "label": "label"}


def area_points(drive: SimulatedDrive) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Return the (N, 3) points and the (N,) labels of all scans of a drive in the city."""
    scans = [drive.scan(frame) for frame in range(drive.frames)]
    points = np.concatenate([in_world(scan) for scan in scans]) + CORNER
    return points, LABEL_OF_KIND[np.concatenate([scan.kinds for scan in scans])]


def write_area(
    path: Path, drive: SimulatedDrive, *, names: dict[str, str] | None = None, rows: int = 700
) -> Path:
    """Write a drive as a table with row groups of some rows, and columns of some names."""
    points, labels = area_points(drive)
    named = NAMES if names is None else names
    noise = points + 0.005
    columns = {named[axis]: points[:, i] for i, axis in enumerate("xyz")}
    columns |= {f"{named[axis]}_noise": noise[:, i] for i, axis in enumerate("xyz")}
    columns |= {color: np.full(len(points), 7, np.uint8) for color in ("r", "g", "b")}
    columns |= {"time": np.arange(len(points)) * 1e-4, named["label"]: labels}
    pq.write_table(pa.table(columns), path, row_group_size=rows)
    return path
