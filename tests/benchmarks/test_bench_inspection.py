"""`validate --full` on scans of 131,072 rays and the published grids.

Small scans where benchmarks are off.
"""

from __future__ import annotations

from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers.scenes.lidar_frames import street_frame

from carlasc.core.grids import Grid, GridSpec
from carlasc.groundtruth.voting.ballot import Observation, count_votes
from carlasc.inspection import validate
from carlasc.inspection.agreement import GridEvidence
from carlasc.storage import layout
from carlasc.storage.files import to_json
from carlasc.storage.folder import FolderSink

pytestmark = pytest.mark.slow

FRAMES = 40  # the poses are checked on 24 pairs of scans at most, however many frames there are


@cache
def frame(full: bool, coordinates: str) -> tuple[Observation, Grid]:
    """Return a scan, and the grid of six LiDARs around it."""
    observations = street_frame(6, distinct=2) if full else street_frame(2, 16, 128)
    return observations[0], count_votes(observations, GridSpec.published(coordinates)).to_grid()


@pytest.mark.benchmark(group="points in shifted grids")
@pytest.mark.parametrize("coordinates", ["cartesian", "cylindrical"])
def test_bench_agreement(benchmark: Any, coordinates: str) -> None:
    scan, grid = frame(benchmark.enabled, coordinates)
    evidence = GridEvidence(grid.spec)
    benchmark(evidence.add, scan.points, scan.labels, grid)
    assert evidence.diagnose().frames >= 1


@pytest.mark.benchmark(group="validate --full")
@pytest.mark.parametrize("coordinates", ["cartesian", "cylindrical"])
def test_bench_validate(benchmark: Any, tmp_path: Path, coordinates: str) -> None:
    scan, grid = frame(benchmark.enabled, coordinates)
    frames = FRAMES if benchmark.enabled else 2
    writer = FolderSink(tmp_path).sequence(f"Train/Town01_Light/{coordinates}")
    writer.write_document(layout.POSES, layout.encode_poses(np.tile(np.eye(4), (frames, 1, 1))))
    writer.write_document(layout.TIMES, layout.encode_times(np.arange(frames) * 0.1))
    writer.write_document("evaluation/params.json", to_json(grid.spec.to_params()))
    points = np.column_stack([scan.points, np.zeros(len(scan.points))]).astype(np.float32)
    for number in range(frames):
        writer.write("points", number, points)
        writer.write("labels", number, scan.labels.astype(np.uint32))
        writer.write("flow", number, np.zeros((len(points), 3), np.float32))
        writer.write("evaluation/labels", number, grid.labels.astype(np.uint32))
        writer.write("evaluation/counts", number, np.asarray(grid.counts, np.float32))
    result = benchmark.pedantic(
        validate, (tmp_path,), {"every": 1}, rounds=3 if benchmark.enabled else 1
    )
    assert [(found.sampled, list(found.voxel_share)) for found in result.sequences] == [
        (frames, ["evaluation"])
    ]
