"""The shares at which `validate` reports warnings and errors, on small sequences made for each of
them.
"""

from __future__ import annotations

import json

import numpy as np
import pytest

from carlasc.core.grids import GridSpec
from carlasc.inspection.validation import validate
from carlasc.storage import FolderSink, layout

SPEC = GridSpec("cartesian", (40, 40, 12), (-10.0, -10.0, -3.0), (10.0, 10.0, 3.0))
COARSE = GridSpec("cartesian", (20, 20, 6), (-10.0, -10.0, -3.0), (10.0, 10.0, 3.0))
OTHER = 9  # a class that is nowhere in the grid


def write_scans(folder, right, frames=4, metadata=None, far=None, spec=SPEC):
    """Write scans and grids: a share of the points is in voxels of their class; points farther than
    `far` never are.
    """
    rng, writer = np.random.default_rng(0), FolderSink(folder).sequence("cartesian")
    writer.write_document(layout.params_file("evaluation"), json.dumps(spec.to_params()).encode())
    writer.write_document(layout.POSES, layout.encode_poses(np.tile(np.eye(4), (frames, 1, 1))))
    writer.write_document(layout.TIMES, layout.encode_times(0.1 * np.arange(frames)))
    if metadata:
        writer.write_document(layout.METADATA, json.dumps(metadata).encode())
    for frame in range(frames):
        labels = rng.integers(1, OTHER, spec.size)
        cells = rng.integers(0, spec.size, (2000, 3))
        points = spec.centers()[tuple(cells.T)]
        wrong = np.arange(2000) >= round(2000 * right)
        if far is not None:
            wrong |= np.linalg.norm(points, axis=1) > far
        writer.write(
            "points", frame, np.concatenate([points, np.ones((2000, 1))], axis=1).astype(np.float32)
        )
        writer.write(
            "labels", frame, np.where(wrong, OTHER, labels[tuple(cells.T)]).astype(np.uint32)
        )
        writer.write("evaluation/labels", frame, labels.astype(np.uint32))
        writer.write("evaluation/counts", frame, np.ones(spec.size, np.float32))
    return folder


def severities(result, check):
    return [finding.severity for finding in result.findings if finding.check == check]


@pytest.mark.parametrize(
    ("right", "expected"),
    [(0.71, []), (0.69, ["warning"]), (0.51, ["warning"]), (0.49, ["error"]), (0.0, ["error"])],
)
def test_the_share_of_points_in_voxels_of_their_class_decides(tmp_path, right, expected):
    result = validate(write_scans(tmp_path, right))
    assert severities(result, "scan-in-voxels") == expected
    assert result.sequences[0].voxel_share["evaluation"] == pytest.approx(right)
    found = [str(one) for one in result.findings if one.check == "scan-in-voxels"]
    assert expected == [] or "labels of another class table" in found[0]


def test_in_coarse_voxels_a_small_share_is_no_mistake(tmp_path):
    result = validate(write_scans(tmp_path, 0.3, spec=COARSE))
    assert severities(result, "scan-in-voxels") == []
    assert result.sequences[0].voxel_share["evaluation"] == pytest.approx(0.3)


def test_points_outside_the_ranges_of_the_sensor_are_not_compared(tmp_path):
    folder = write_scans(tmp_path, 1.0, metadata={"max_range_m": 8.0}, far=8.0)
    assert validate(folder).sequences[0].voxel_share["evaluation"] == 1.0
    (folder / "cartesian" / layout.METADATA).unlink()
    assert validate(folder).sequences[0].voxel_share["evaluation"] < 0.7


def test_points_nearer_than_the_least_range_are_not_compared(tmp_path):
    folder = write_scans(tmp_path, 1.0, metadata={"min_range_m": 8.0})
    shares = validate(folder).sequences[0].voxel_share
    for path in folder.glob("cartesian/labels/*"):
        points = np.fromfile(folder / "cartesian/velodyne" / f"{path.stem}.bin", "<f4").reshape(
            -1, 4
        )
        labels = np.fromfile(path, "<u4")
        labels[np.linalg.norm(points[:, :3], axis=1) < 8] = OTHER
        labels.tofile(path)
    assert validate(folder).sequences[0].voxel_share == shares == {"evaluation": 1.0}


def test_scans_that_do_not_overlap_at_all_are_an_error(tmp_path):
    rng, writer = np.random.default_rng(0), FolderSink(tmp_path).sequence("cartesian")
    writer.write_document(layout.POSES, layout.encode_poses(np.tile(np.eye(4), (6, 1, 1))))
    writer.write_document(layout.TIMES, layout.encode_times(0.1 * np.arange(6)))
    for frame in range(6):
        points = rng.uniform(-20, 20, (400, 3))
        writer.write(
            "points", frame, np.concatenate([points, np.ones((400, 1))], axis=1).astype(np.float32)
        )
        writer.write("labels", frame, np.ones(400, np.uint32))
    result = validate(tmp_path)
    assert severities(result, "poses-on-scans") == ["error"]
    assert result.sequences[0].pose_share < 0.1


@pytest.mark.parametrize(("frames", "every", "read"), [(80, None, 40), (79, None, 79), (80, 20, 4)])
def test_about_forty_frames_are_read_by_default(tmp_path, frames, every, read):
    writer = FolderSink(tmp_path).sequence("cartesian")
    for frame in range(frames):
        writer.write("points", frame, np.ones((1, 4), np.float32))
    assert validate(tmp_path, every=every).sequences[0].sampled == read
