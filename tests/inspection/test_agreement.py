"""Agreement of points with a grid: shares, mistakes and the limits between them."""

from __future__ import annotations

import json
import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from carlasc.core.geometry import rotation_z
from carlasc.core.grids import Grid, GridSpec
from carlasc.inspection.agreement import GridEvidence, GroundBelow
from carlasc.inspection.alignment import choose_pairs, diagnose_poses
from carlasc.inspection.points_in_voxels import labels_at
from carlasc.inspection.validation import validate
from carlasc.storage import FolderSink, FolderSource, layout
from carlasc.testing.drives import SimulatedDrive

PI32 = float(np.float32(np.pi))
SPECS = {
    "cartesian": GridSpec("cartesian", (6, 5, 3), (-3.0, -2.5, -1.0), (3.0, 2.5, 0.7)),
    "a full turn": GridSpec("cylindrical", (4, 9, 3), (1.0, -PI32, -1.0), (5.0, PI32, 0.7)),
    "a part of a turn": GridSpec("cylindrical", (4, 9, 3), (0.0, 2.0, -1.0), (5.0, 4.5, 0.7)),
    "one cell": GridSpec("cartesian", (1, 1, 1), (-3.0, -2.5, -1.0), (3.0, 2.5, 0.7)),
}
SHIFTS = np.array([(x, y, z) for x in (0, -1, 1) for y in (0, -1, 1) for z in (0, -1, 1)])


def count(grid, points, classes, shifts):
    """Return (S, 3) points in known voxels, of these in voxels of their class, and of any class."""
    found = labels_at(points, grid.spec, grid.labels, grid.known, shifts=shifts)
    known = found >= 0
    return np.stack([known, known & (found == classes), found > 0], axis=2).sum(axis=1)


def plain_count(grid, points, labels, shifts):
    """Place the points, move their cells, and look each up; those that leave the grid stay where
    they are.
    """
    spec = grid.spec
    cells, inside = spec.index(spec.to_axes(points))
    cells, labels = cells[inside], labels[inside]
    counted = []
    for shift in shifts:
        moved = cells + shift
        if spec == SPECS["a full turn"]:
            moved[:, 1] %= spec.size[1]
        outside = ((moved < 0) | (moved >= spec.size)).any(axis=1)
        moved[outside] = cells[outside]
        known, voxels = grid.known[tuple(moved.T)], grid.labels[tuple(moved.T)]
        counted.append(
            [known.sum(), (known & (voxels == labels)).sum(), (known & (voxels != 0)).sum()]
        )
    return np.array(counted)


@given(
    st.sampled_from(sorted(SPECS)),
    st.sampled_from([np.float32, np.float64]),
    st.sampled_from([np.uint8, np.uint32, np.int64]),
    st.sampled_from([np.uint8, np.uint16, np.uint32]),
    st.booleans(),
    st.integers(0, 2**32 - 1),
)
@settings(max_examples=60, deadline=None)
def test_points_are_counted_as_in_plain_numpy(name, real, whole, narrow, with_counts, seed):
    spec, rng = SPECS[name], np.random.default_rng(seed)
    labels = rng.integers(0, 4, spec.size).astype(narrow)
    grid = Grid(
        spec, labels, rng.integers(0, 2, spec.size).astype(np.float32) if with_counts else None
    )
    points = rng.uniform(-6, 6, (200, 3)) * (1, 1, 0.3)
    points[::3] = np.round(points[::3] * 2) / 2  # on faces and edges
    points[:4, 0] = (math.nan, math.inf, -math.inf, 1e300)
    with np.errstate(over="ignore", invalid="ignore"):
        points, classes = points.astype(real), rng.integers(0, 4, 200).astype(whole)
        found = count(grid, points, classes, SHIFTS)
        exact = points.astype(np.float64)
        np.testing.assert_array_equal(found, plain_count(grid, exact, classes, SHIFTS))


@pytest.mark.parametrize("name", SPECS)
def test_points_in_the_middle_of_voxels_are_found_where_the_grid_has_them(name):
    spec = SPECS[name]
    labels = np.random.default_rng(0).integers(0, 5, spec.size).astype(np.uint8)
    points = spec.from_axes(spec.centers()).reshape(-1, 3)
    counted = count(Grid(spec, labels), points, labels.reshape(-1), SHIFTS[:1])
    assert counted.tolist() == [[spec.num_voxels, spec.num_voxels, np.count_nonzero(labels)]]


def test_grids_in_any_order_in_memory_count_alike():
    spec, rng = SPECS["cartesian"], np.random.default_rng(1)
    labels, counts = rng.integers(0, 4, spec.size).astype(np.uint32), rng.integers(0, 2, spec.size)
    points = spec.centers().reshape(-1, 3)
    args = (points, labels.reshape(-1), SHIFTS)
    expected = count(Grid(spec, labels, counts), *args)
    found = count(
        Grid(spec, np.asfortranarray(labels), counts[::-1, ::-1].copy()[::-1, ::-1]), *args
    )
    np.testing.assert_array_equal(found, expected)


ROUND_ROAD = GridSpec("cylindrical", (10, 24, 6), (0.0, -math.pi, -2.0), (10.0, math.pi, 1.0))
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
    (finding,) = [
        f
        for f in validate(write_drive(tmp_path, high, labelled)).findings
        if f.check == "ground-below-grid"
    ]
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
    evidence = GroundBelow(ROUND_ROAD)
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
    assert math.isnan(GroundBelow(ROUND_ROAD).share)


SPEC = GridSpec("cartesian", (20, 20, 6), (-10.0, -10.0, -3.0), (10.0, 10.0, 3.0))
ROUND = GridSpec("cylindrical", (10, 24, 6), (0.0, -math.pi, -3.0), (10.0, math.pi, 3.0))


def scene(spec=SPEC, seed=0, right=1.0, count=2000):
    """Return points at the centres of voxels, their labels, and a grid in which a share of them has
    its class.
    """
    rng = np.random.default_rng(seed)
    labels = rng.integers(1, 9, spec.size).astype(np.uint8)
    cells = rng.integers(0, spec.size, (count, 3))
    points = spec.from_axes(spec.centers())[tuple(cells.T)]
    wrong = rng.random(count) >= right
    return (
        points,
        np.where(wrong, 9, labels[tuple(cells.T)]),
        Grid(spec, labels, np.ones(spec.size, np.float32)),
    )


def diagnose(points, labels, grid, frames=1):
    evidence = GridEvidence(grid.spec)
    for _ in range(frames):
        evidence.add(points, labels, grid)
    return evidence.diagnose()


@pytest.mark.parametrize("spec", [SPEC, ROUND])
def test_points_in_voxels_of_their_class_agree(spec):
    result = diagnose(*scene(spec), frames=2)
    assert (result.share, result.occupied_share, result.frames, result.mistake) == (
        1.0,
        1.0,
        2,
        None,
    )


def test_the_share_is_that_of_the_points_in_known_voxels():
    points, labels, grid = scene(right=0.8)
    counts = np.ones(SPEC.size, np.float32)
    counts[:, :10] = 0
    known = points[:, 1] >= 0
    cells, _ = SPEC.index(points)
    right = grid.labels[tuple(cells.T)] == labels
    result = diagnose(points, labels, Grid(SPEC, grid.labels, counts))
    assert result.share == pytest.approx(right[known].mean())
    assert result.mistake is None


def test_unlabelled_points_do_not_count():
    points, labels, grid = scene()
    labels[::2] = 0
    assert diagnose(points, labels, grid).share == 1.0


def test_frames_with_few_points_in_known_voxels_are_left_out():
    points, labels, grid = scene()
    assert diagnose(points[:99], labels[:99], grid).frames == 0
    assert math.isnan(diagnose(points[:99], labels[:99], grid).share)
    assert diagnose(points[:100], labels[:100], grid).frames == 1


def test_without_labels_occupied_voxels_count():
    points, _, grid = scene()
    free = grid.labels.copy()
    free[:10] = 0
    result = diagnose(points, None, Grid(SPEC, free, grid.counts))
    assert result.share == pytest.approx((points[:, 0] >= 0).mean())
    assert result.share == result.occupied_share


@pytest.mark.parametrize("spec", [SPEC, ROUND])
@pytest.mark.parametrize("step", [1, -1])
def test_a_grid_shifted_along_its_second_axis_is_named(spec, step):
    points, labels, grid = scene(spec)
    result = diagnose(
        points, labels, Grid(spec, np.roll(grid.labels, step, axis=1), grid.counts), frames=2
    )
    axis = "y" if spec is SPEC else "azimuth"
    assert result.mistake == f"a grid shifted by one cell towards {'+' if step > 0 else '-'}{axis}"
    assert result.corrected_share > 0.9
    if spec is ROUND:  # the azimuth is periodic: nothing leaves the grid
        assert result.corrected_share == 1.0


def test_a_mistake_in_a_minority_of_frames_is_not_reported():
    points, labels, grid = scene()
    mirrored = points * [1, -1, 1]
    evidence = GridEvidence(SPEC)
    # the mistake would be better on average, but not on three quarters
    for wrong in (
        True,
        True,
        False,
        True,
        False,
    ):
        evidence.add(mirrored if wrong else points, labels, grid)
    assert evidence.diagnose().mistake is None
    for _ in range(4):
        evidence.add(mirrored, labels, grid)
    assert "y mirrored" in evidence.diagnose().mistake


@pytest.mark.parametrize(("part", "reported"), [(np.s_[:1], True), (np.s_[:1, :, :1], False)])
def test_a_mistake_is_reported_from_one_percent_of_the_points(part, reported):
    points, _, grid = scene(count=20_000)
    labels = np.minimum(grid.labels, grid.labels[:, ::-1])  # y mirrored makes no difference,
    labels[part] = grid.labels[part]  # but for this part: 5%, or 0.8% of the grid
    cells, _ = SPEC.index(points)
    result = diagnose(
        points * [1, -1, 1], labels[tuple(cells.T)], Grid(SPEC, labels, grid.counts), frames=4
    )
    assert 0.9 < result.share < 0.999
    assert (result.mistake is not None and "y mirrored" in result.mistake) is reported


def walls(seed=0):
    rng = np.random.default_rng(seed)
    return np.concatenate([rng.uniform((-25, -25, 0), (25, 25, 3), (400, 3)) for _ in range(3)])


def structure_along(poses, world):
    """Return what a sensor sees of fixed points at each of its poses."""
    return lambda i: (world - poses[i, :3, 3]) @ poses[i, :3, :3]


def straight(count, step):
    poses = np.tile(np.eye(4), (count, 1, 1))
    poses[:, 0, 3] = step * np.arange(count)
    return poses


def test_poses_under_which_scans_fall_on_each_other_have_no_mistake():
    poses = straight(12, 0.5)
    result = diagnose_poses(structure_along(poses, walls()), poses)
    assert (result.correction, result.offset_m) == (None, None)
    assert result.share > 0.9


def test_an_offset_is_from_where_the_scan_fits_to_where_the_poses_put_it():
    true, stored = straight(12, 0.5), straight(12, 0.5)
    stored[:, 1, 3] = 0.4 * np.arange(12)  # the poses drift to +y: 4 frames, 1.6 m per pair
    result = diagnose_poses(structure_along(true, walls()), stored)
    assert result.correction is None
    assert result.offset_m == pytest.approx((0.0, 1.6, 0.0), abs=0.41)


def bend(count):
    """Return the poses of a drive round a bend, half a metre and 3 degrees per frame."""
    motion = rotation_z(0.05)
    motion[0, 3] = 0.5
    return np.stack([np.linalg.matrix_power(motion, frame) for frame in range(count)])


@pytest.mark.parametrize(("wrong", "reported"), [(40, False), (60, True)])
def test_a_mistake_in_poses_is_reported_if_it_explains_three_quarters_of_the_pairs(wrong, reported):
    true, mirror = bend(60), np.diag([1.0, -1, 1, 1])
    stored = np.concatenate([mirror @ true[:wrong] @ mirror, true[wrong:]])
    correction = diagnose_poses(structure_along(true, walls()), stored).correction
    assert (
        correction is not None and correction.name == "poses with y mirrored against the scans"
    ) is reported
    assert reported or correction is None


def test_pairs_are_two_metres_apart_or_ten_frames():
    assert all(
        later - earlier == 4 for earlier, later in choose_pairs(straight(30, 0.5)) if later < 29
    )
    assert all(
        later - earlier == 10 for earlier, later in choose_pairs(straight(40, 0.1)) if later < 39
    )
    assert {
        later - earlier for earlier, later in choose_pairs(straight(40, 0.0)) if later < 39
    } == {1, 4}
    assert choose_pairs(straight(1, 1.0)) == []
    assert len(choose_pairs(straight(60, 0.5))) == 24
