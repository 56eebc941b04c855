"""Exporting grids of SemanticKITTI's size: 256 x 256 x 32 voxels.

Small ones where benchmarks are off.
"""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from carlasc_converters.exporters.occlusion import occluded_voxels
from numpy.typing import NDArray

from carlasc.converting import export
from carlasc.core.grids import GridSpec
from carlasc.running import Run
from carlasc.storage import layout
from carlasc.storage.files import to_json
from carlasc.storage.folder import FolderSink

pytestmark = pytest.mark.slow

FRAMES = 4
SENSORS = {
    "in the grid": (0.0, 0.0, 0.0),
    "below the grid": (0.0, 0.0, -2.7),
    "behind the grid": (-3.0, 0.0, 0.0),
}
"""Where the sensor is, metres from its place in SemanticKITTI: 2 m above the lowest face of the
grid, and on its first face.
"""


def street(full: bool) -> tuple[NDArray[np.bool_], GridSpec]:
    """Return occupied voxels: a rough road, walls at both sides, 60 things as large as cars and
    trees; and the grid.
    """
    size = (256, 256, 32) if full else (32, 32, 8)
    spec = GridSpec("cartesian", size, (0.0, -25.6, -2.0), (51.2, 25.6, 4.4))
    rng = np.random.default_rng(0)
    x, y, z = np.moveaxis(spec.centers(), -1, 0)
    occupied = np.abs(z + 1.7 - 0.3 * (np.sin(x / 2) + np.cos(y / 2))) < 0.75 * spec.voxel_size[2]
    occupied &= rng.random(size) < 0.7
    for place in rng.uniform((4, -22, -2), (50, 22, -1), (60, 3)):
        inside = (np.abs(np.stack([x, y, z], -1) - place) < rng.uniform(0.2, (1.2, 1.2, 2.0))).all(
            axis=-1
        )
        occupied |= inside & (rng.random(size) < 0.5)
    return occupied | ((np.abs(y) > 24.4) & (z < 3)), spec


@pytest.mark.benchmark(group="occluded voxels")
@pytest.mark.parametrize("sensor", SENSORS)
def test_bench_occluded_voxels(benchmark: Any, sensor: str) -> None:
    occupied, spec = street(benchmark.enabled)
    moved = GridSpec(
        "cartesian",
        spec.size,
        *(tuple(np.subtract(b, SENSORS[sensor])) for b in (spec.lower, spec.upper)),
    )
    occluded_voxels(occupied, moved)  # compiled and loaded
    assert occluded_voxels(occupied, moved).sum() > occupied.sum()
    benchmark(occluded_voxels, occupied, moved)


def write_street(root: Path, full: bool) -> None:
    """Write a sequence whose frames have a grid, and a scan of a point in each of its occupied
    voxels.
    """
    occupied, spec = street(full)
    writer = FolderSink(root).sequence("Val/Town07_Light/cartesian")
    writer.write_document(layout.POSES, layout.encode_poses(np.tile(np.eye(4), (FRAMES, 1, 1))))
    writer.write_document("fine/params.json", to_json(spec.to_params()))
    points = np.column_stack([spec.centers()[occupied], np.zeros(occupied.sum())]).astype(
        np.float32
    )
    for frame in range(FRAMES):
        writer.write("points", frame, points)
        writer.write("labels", frame, np.full(len(points), 7, np.uint32))
        writer.write("fine/labels", frame, np.where(occupied, 7, 0).astype(np.uint32))
        writer.write("fine/counts", frame, np.ones(spec.size, np.float32))


@pytest.mark.benchmark(group="export kitti")
def test_bench_export_kitti(benchmark: Any, tmp_path: Path) -> None:
    write_street(tmp_path / "in", benchmark.enabled)

    def run() -> int:
        shutil.rmtree(tmp_path / "out", ignore_errors=True)
        return export("kitti", tmp_path / "in", tmp_path / "out", run=Run(workers=1)).made

    assert benchmark(run) == FRAMES
