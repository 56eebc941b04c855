"""Ground below a grid is reported, with bounds that hold it."""

from __future__ import annotations

import json
import math

import numpy as np
import pytest

from carlasc.core.grids import GridSpec
from carlasc.inspection.agreement import GroundBelow
from carlasc.inspection.validation import validate
from carlasc.storage import FolderSink, FolderSource, layout
from carlasc.testing.drives import SimulatedDrive

ROUND = GridSpec("cylindrical", (10, 24, 6), (0.0, -math.pi, -2.0), (10.0, math.pi, 1.0))
ROAD = 7


def write_drive(folder, spec, labelled=False):
    """Write a drive whose road is at z = -1.73, and grids in which everything is unknown."""
    drive, writer = SimulatedDrive(frames=3), FolderSink(folder).sequence("cartesian")
    writer.write_document(layout.params_file("evaluation"), json.dumps(spec.to_params()).encode())
    writer.write_document(layout.POSES, layout.encode_poses(drive.world_T_vehicle(drive.times)))
    for frame in range(drive.frames):
        scan = drive.scan(frame)
        writer.write("points", frame, scan.points)
        if labelled:
            writer.write("labels", frame, np.where(scan.kinds == 1, ROAD, 1).astype(np.uint32))
        writer.write("evaluation/labels", frame, np.zeros(spec.size, np.uint32))
        writer.write("evaluation/counts", frame, np.zeros(spec.size, np.float32))
    return folder


@pytest.mark.parametrize("labelled", [False, True])
def test_a_road_below_the_grid_is_reported_with_bounds_that_hold_it(tmp_path, labelled):
    high = GridSpec("cartesian", (32, 32, 8), (-16.0, -16.0, -1.5), (16.0, 16.0, 1.5))
    (finding,) = [f for f in validate(write_drive(tmp_path, high, labelled)).findings if f.check == "ground-below-grid"]
    assert finding.severity == "warning"
    assert int(finding.found.split("%")[0]) > 95
    bounds = finding.advice.split("--bounds=")[1].rstrip("`")
    x0, x1, y0, y1, z0, z1 = map(float, bounds.split(","))
    assert (x0, x1, y0, y1) == (-16, 16, -16, 16)
    assert z1 - z0 == pytest.approx(3.0)
    assert -2.1 < z0 < -1.73


def test_a_road_in_the_grid_is_not_reported(tmp_path):
    result = validate(write_drive(tmp_path, GridSpec.published()))
    assert not [finding for finding in result.findings if finding.check == "ground-below-grid"]


@pytest.mark.parametrize(("below", "reported"), [(9, False), (11, True)])
def test_it_is_reported_from_a_tenth_of_the_ground(tmp_path, below, reported):
    evidence = GroundBelow(ROUND)
    z = np.where(np.arange(100) < below, -2.1, -1.9)
    evidence.add(np.column_stack([np.full(100, 5.0), np.zeros(100), z]).astype(np.float32))
    evidence.add(np.array([[11.0, 0, -5]], np.float32))  # beyond the radius of the grid
    FolderSink(tmp_path).sequence("cylindrical").write("points", 0, np.ones((1, 4), np.float32))
    (sequence,) = FolderSource(tmp_path).sequences().values()
    findings = list(evidence.findings(sequence, "evaluation"))
    assert evidence.share == pytest.approx(below / 100)
    assert bool(findings) is reported
    assert not reported or "--bounds=0,10,-180,180,-2.2,0.8`" in findings[0].advice


def test_no_ground_is_no_share():
    assert math.isnan(GroundBelow(ROUND).share)
