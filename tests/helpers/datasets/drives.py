"""Small sequences on disk for the tests of Dataset: a sensor that drives around a bend, random
points, random grids.
"""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from carlasc.core.geometry import relative_to, rotation_z, translation
from carlasc.core.grids import GridSpec
from carlasc.storage import layout
from carlasc.storage.files import to_json
from carlasc.storage.folder import FolderSink


def bend(frames: int, step_m: float = 0.8, yaw_rad: float = 0.02) -> NDArray[np.float64]:
    """Return the (F, 4, 4) poses of a drive around a bend, as in poses.txt."""
    world = np.stack(
        [
            translation((step_m * i, 0.02 * i, 0.001 * i)) @ rotation_z(yaw_rad * i)
            for i in range(frames)
        ]
    )
    return relative_to(world[0], world)


def random_points(rng: np.random.Generator, count: int) -> NDArray[np.float32]:
    """Return (N, 4) float32 points: many near the sensor, and some far outside of every grid."""
    points = rng.normal(0, (14, 14, 1.2), (count, 3)) - (0, 0, 0.6)
    return np.column_stack([points, np.zeros(count)]).astype(np.float32)


def write_drive(
    folder: Path,
    frames: Iterable[int] = range(4),
    *,
    spec: GridSpec | None = None,
    grid_frames: Iterable[int] | None = None,
    scans: Iterable[NDArray[np.float32]] | None = None,
    metadata: dict[str, object] | None = None,
    points: int = 300,
    seed: int = 0,
) -> Path:
    """Write one `<coordinates>` folder and return it.

    Args:
        folder: `<root>/<split>/<sequence>/<coordinates>`.
        frames: frames with scans, labels and flow. Empty: grids only.
        spec: grid of `evaluation/`.
        grid_frames: frames with grids. None: `frames`.
        scans: (N, 4) points of each frame. None: random points.
        metadata: content of carlasc.json.
        points: number of points per random scan.
        seed: seed of all random values.
    """
    rng = np.random.default_rng(seed)
    frames = list(frames)
    grid_frames = frames if grid_frames is None else list(grid_frames)
    spec = spec or GridSpec.published(
        "cylindrical" if folder.name == "cylindrical" else "cartesian"
    )
    writer = FolderSink(folder.parent).sequence(folder.name)
    scans = [random_points(rng, points) for _ in frames] if scans is None else list(scans)
    for frame, scan in zip(frames, scans, strict=True):
        writer.write("points", frame, scan)
        writer.write("labels", frame, rng.integers(0, 23, len(scan)).astype(np.uint32))
        writer.write("flow", frame, rng.normal(0, 3, (len(scan), 3)).astype(np.float32))
    if frames:
        writer.write_document(layout.POSES, layout.encode_poses(bend(max(frames) + 1)))
        writer.write_document(layout.TIMES, layout.encode_times(np.arange(max(frames) + 1) * 0.1))
    if metadata is not None:
        writer.write_document(layout.METADATA, to_json(metadata))
    if grid_frames:
        writer.write_document(layout.params_file(layout.EVALUATION), to_json(spec.to_params()))
    for frame in grid_frames:
        writer.write("evaluation/labels", frame, rng.integers(0, 23, spec.size).astype(np.uint32))
        writer.write("evaluation/counts", frame, rng.integers(0, 5, spec.size).astype(np.float32))
    return folder


def write_world(root: Path, spec: GridSpec) -> Path:
    """Write two training sequences, of six and four frames, and one of three frames to validate
    with; return the folder.
    """
    write_drive(root / "Train" / "Town01_Light" / "cartesian", range(6), spec=spec, seed=1)
    write_drive(root / "Train" / "Town02_Light" / "cartesian", range(4), spec=spec, seed=2)
    write_drive(root / "Val" / "Town07_Light" / "cartesian", range(3), spec=spec, seed=3)
    return root
