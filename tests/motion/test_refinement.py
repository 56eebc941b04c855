"""Refined poses: scans of simulated streets under poses with known errors, and places where scans
do not tell enough.
"""

from __future__ import annotations

import numpy as np
import pytest

from carlasc.core.geometry import invert, transform_points
from carlasc.errors import ArgumentError, FormatError
from carlasc.motion import refinement
from carlasc.motion.joint_alignment import align, clusters, move
from carlasc.motion.refinement import RefinedPoses, ThinnedScan, disagreement, refine_poses
from carlasc.motion.solving import solve_positive
from carlasc.testing import SimulatedDrive, Thing, wrong_poses

DEGREE = np.deg2rad(1.0)
ROWS = {
    "jitter": {"jitter_m": 0.08, "jitter_rad": 0.3 * DEGREE},
    "drift": {"drift_m": 0.01, "drift_rad": 0.05 * DEGREE},
    "height": {"height_drift_m": 0.03},
}
LIDAR = {"channels": 16, "columns": 360}
TUNNEL = (
    Thing("building", (50, 6, 3), (400, 1, 6)),
    Thing("building", (50, -6, 3), (400, 1, 6)),
    Thing("building", (50, 0, 6.5), (400, 14, 1)),
)


def record(drive, seed=0):
    """Return the points of each scan, with errors of 2 cm, and world_T_sensor."""
    rng, scans = np.random.default_rng(seed), []
    for frame in range(drive.frames):
        points = drive.scan(frame).points[:, :3]
        away = np.linalg.norm(points, axis=1, keepdims=True)
        scans.append((points * (1 + rng.normal(0, 0.02, away.shape) / away)).astype(np.float32))
    return scans, drive.world_T_vehicle(drive.times) @ drive.sensors[0].vehicle_T_sensor


@pytest.fixture(scope="module")
def street():
    return record(SimulatedDrive(frames=95, **LIDAR))


@pytest.fixture(scope="module")
def dense():
    """The street by a LiDAR that sees walls well."""
    return record(SimulatedDrive(frames=30, channels=32, columns=540))


@pytest.fixture(scope="module")
def tunnel():
    return record(SimulatedDrive(frames=40, speed=10.0, things=TUNNEL, **LIDAR))


@pytest.fixture(scope="module")
def plain():
    return record(SimulatedDrive(frames=40, speed=10.0, things=(), **LIDAR))


def refine(scans, given, **options):
    thinned = (ThinnedScan.of(points, pose) for points, pose in zip(scans, given, strict=True))
    return refine_poses(thinned, given, **options)


def errors(found, true, lag=30):
    """Return root mean square errors of motions over some scans, metres on the axes of the sensor,
    and radians.
    """
    motions = [invert(poses[:-lag]) @ poses[lag:] for poses in (true, found)]
    off = invert(motions[0]) @ motions[1]
    turns = np.stack([off[:, 2, 1], off[:, 0, 2], off[:, 1, 0]], axis=1)
    return np.sqrt((off[:, :3, 3] ** 2).mean(axis=0)), np.sqrt((turns**2).mean(axis=0))


class TestStreet:
    @pytest.mark.parametrize("row", ROWS)
    def test_errors_of_poses_are_repaired_to_a_centimetre(self, street, row):
        scans, true = street
        given = wrong_poses(true, **ROWS[row], seed=1)
        found = refine(scans, given)
        moved, turned = errors(found.poses, true)
        assert moved.max() < 0.01 and turned.max() < 0.0006
        assert found.refined.all()
        assert np.nanmean(found.after_m) < 0.5 * np.nanmean(found.before_m)

    def test_exact_poses_are_left_alone(self, street):
        scans, true = street
        found = refine(scans, true)
        assert not found.refined.any() and np.array_equal(found.poses, true)
        assert np.array_equal(found.before_m, found.after_m, equal_nan=True)

    def test_refining_exact_poses_all_the_same_changes_millimetres(self, street):
        scans, true = street
        moved, _ = errors(refine(scans, true, always=True).poses, true)
        assert 0 < moved.max() < 0.01

    @pytest.mark.parametrize("row", ["drift", None])
    def test_finished_stretches_are_not_aligned_again(self, street, row, monkeypatch):
        scans, true = street
        given = wrong_poses(true, **ROWS[row], seed=3) if row else true
        kept, aligned = [], []
        whole = refine(scans, given, keep=lambda begun: kept.append(begun.to_bytes("a")))
        (begun,) = (RefinedPoses.from_bytes(data, "a")[0] for data in kept)
        assert 0 < len(begun.poses) < len(true)
        count = lambda *args: aligned.append(0) or align(*args)  # noqa: E731
        monkeypatch.setattr(refinement, "align", count)
        assert refine(scans, given, begun=begun).to_bytes("a") == whole.to_bytes("a")
        assert len(aligned) == 1

    def test_over_the_whole_drive_the_given_poses_hold(self, street):
        scans, true = street
        found = refine(scans, wrong_poses(true, **ROWS["jitter"], seed=2))
        assert np.linalg.norm((found.poses - true)[:, :3, 3], axis=1).max() < 0.3

    @pytest.mark.slow
    @pytest.mark.parametrize("mistake", ["faster", "slower", "shuffled", "another drive"])
    def test_poses_of_another_drive_are_not_made_plausible(self, dense, mistake):
        scans, true = dense
        other = true.copy()
        if mistake == "shuffled":
            other = true[np.random.default_rng(0).permutation(len(true))]
        elif mistake == "another drive":
            turns = np.arange(len(true))[:, None] * (0.0, 0.0, 0.0, 0.0, 0.0, 0.02)
            move(other, turns, 0)
        else:
            other[:, 0, 3] *= 1.4 if mistake == "faster" else 0.5
        found = refine(scans, other)
        assert not found.refined.any() and np.array_equal(found.poses, other)
        assert not found.fits.any()

    def test_the_same_scans_give_the_same_bits(self, street):
        scans, true = street
        given = wrong_poses(true, **ROWS["jitter"], seed=3)
        one, other = (refine(scans[:40], given[:40]).to_bytes("key") for _ in range(2))
        assert one == other

    def test_scans_without_points_keep_their_motion_among_the_others(self, street):
        scans, true = street
        given = wrong_poses(true, **ROWS["jitter"], seed=4)[:40]
        some = [
            np.empty((0, 3), np.float32) if 15 <= row < 18 else scan
            for row, scan in enumerate(scans[:40])
        ]
        found = refine(some, given)
        assert np.isnan(found.before_m[15:18]).all() and np.isfinite(found.poses).all()
        rows = np.r_[:15, 18:40]
        assert errors(found.poses[rows], true[:40][rows], 10)[0].max() < 0.01

    def test_points_that_are_no_numbers_or_far_away_do_not_count(self, street):
        scans, true = street
        bad = np.full((50, 3), np.nan, np.float32)
        bad[10:20], bad[20:30] = np.inf, 1e30
        dirty = [np.concatenate([bad, scan]) for scan in scans[:30]]
        given = wrong_poses(true[:30], **ROWS["jitter"])
        assert np.array_equal(refine(dirty, given).poses, refine(scans[:30], given).poses)

    def test_places_far_from_the_origin_make_no_difference(self, street):
        scans, true = street
        away = true[:30].copy()
        away[:, :3, 3] += (4_500_000.0, -600_000.0, 100.0)
        given = wrong_poses(away, **ROWS["jitter"])
        assert errors(refine(scans[:30], given).poses, away, 10)[0].max() < 0.01


class TestPlacesThatTellLittle:
    def test_along_a_tunnel_the_given_poses_hold(self, tunnel):
        scans, true = tunnel
        given = wrong_poses(true, **ROWS["jitter"], seed=1)
        found, before = errors(refine(scans, given).poses, true, 1)[0], errors(given, true, 1)[0]
        assert found[1:].max() < 0.01
        assert found[0] == pytest.approx(before[0], rel=0.15)

    def test_exact_poses_on_a_plain_are_left_alone(self, plain):
        scans, true = plain
        found = refine(scans, true)
        assert not found.refined.any() and np.array_equal(found.poses, true)

    def test_on_a_plain_the_ground_repairs_height_roll_and_pitch_only(self, plain):
        scans, true = plain
        given = wrong_poses(true, **ROWS["jitter"], seed=1)
        (moved, turned), (moved_before, turned_before) = (
            errors(poses, true, 1) for poses in (refine(scans, given).poses, given)
        )
        assert moved[2] < 0.005 and turned[:2].max() < 0.0005
        assert moved[:2] == pytest.approx(moved_before[:2], rel=0.1)
        assert turned[2] == pytest.approx(turned_before[2], rel=0.1)

    @pytest.mark.parametrize("count", [0, 1, 2, 3])
    def test_few_scans(self, street, count):
        scans, true = street
        found = refine(scans[:count], true[:count])
        assert np.array_equal(found.poses, true[:count]) and len(found.before_m) == count

    def test_a_vehicle_that_stands(self, street):
        scans, true = street
        rng = np.random.default_rng(5)
        still = [
            scans[0] + rng.normal(0, 0.01, scans[0].shape).astype(np.float32) for _ in range(70)
        ]
        given = np.repeat(true[:1], 70, axis=0)
        assert not refine(still, given).refined.any()
        wrong = wrong_poses(given, jitter_m=0.05)
        assert errors(refine(still, wrong).poses, given, 5)[0].max() < 0.01


def test_what_was_found_comes_back_from_its_file(street):
    scans, true = street
    found = refine(scans[:10], wrong_poses(true[:10], **ROWS["jitter"]))
    data = found.to_bytes("a key")
    again, key = RefinedPoses.from_bytes(data, "poses")
    assert key == "a key"
    for name, value in vars(found).items():
        assert np.array_equal(getattr(again, name), value, equal_nan=value.dtype != bool)
    assert [*again.stretches()] == [(0, 9, True)]
    assert again.changes().shape == (9, 6)
    for damaged in (b"", data[:200], data[:-100]):
        with pytest.raises(FormatError) as error:
            RefinedPoses.from_bytes(damaged, "poses")
        assert error.value.where.startswith("poses")


def test_stretches_are_runs_of_scans_that_were_or_were_not_refined():
    refined = np.array([False, False, True, True, True, False])
    poses = np.tile(np.eye(4), (6, 1, 1))
    found = RefinedPoses(poses, poses, np.zeros(6), np.zeros(6), refined, np.ones(6, bool))
    assert [*found.stretches()] == [(0, 1, False), (2, 4, True), (5, 5, False)]


def test_clusters_are_the_sums_of_the_points_of_each_cell(street):
    scans, true = street
    points, pose = scans[0][:2000], true[0]
    keys, sums = clusters(points, pose, 1.0, 0.5)
    seen = points.astype(np.float64) @ pose[:3, :3].T
    cells = np.floor(seen + pose[:3, 3] + 0.5).astype(int)
    _, row = np.unique(cells, axis=0, return_inverse=True)
    assert len(keys) == len(set(keys.tolist())) == row.max() + 1
    columns = np.column_stack(
        [np.ones(len(seen)), seen, (seen[:, :, None] * seen[:, None, :])[:, *np.triu_indices(3)]]
    )
    expected = np.zeros((row.max() + 1, 10))
    np.add.at(expected, row.reshape(-1), columns)
    order, wanted = np.lexsort(sums.T), np.lexsort(expected.T)
    assert np.allclose(sums[order], expected[wanted])


def test_fixed_scans_stay_and_the_others_come_to_them(street):
    scans, true = street
    given = wrong_poses(true[:30], jitter_m=0.05)
    start = given.copy()
    start[:10] = true[:10]
    thinned = [
        ThinnedScan.of(points, pose).used for points, pose in zip(scans[:30], start, strict=True)
    ]
    found = align(thinned, start, given, 10)
    assert np.array_equal(found[:10], true[:10])
    assert np.linalg.norm((found - true[:30])[:, :3, 3], axis=1).max() < 0.02
    assert np.array_equal(start[10:], given[10:])  # what is given is not changed


def test_a_disagreement_grows_with_the_error_of_the_poses(street):
    scans, true = street
    points = scans[:20]
    values = [
        np.nanmean(disagreement(points, wrong_poses(true[:20], jitter_m=m)))
        for m in (0.0, 0.02, 0.05, 0.1)
    ]
    assert values == sorted(values) and values[0] < 0.02 and 0.03 < values[2] < 0.07


def test_moves_are_rotations(street):
    poses = street[1][:3].copy()
    steps = np.random.default_rng(0).normal(0, 0.2, (2, 6))
    move(poses, steps, 1)
    assert np.array_equal(poses[0], street[1][0])
    assert np.allclose(poses[1:, :3, :3] @ poses[1:, :3, :3].transpose(0, 2, 1), np.eye(3))
    assert np.allclose(poses[1:, :3, 3], street[1][1:3, :3, 3] + steps[:, :3])
    axis = steps[0, 3:] / np.linalg.norm(steps[0, 3:])
    turn = poses[1, :3, :3] @ street[1][1, :3, :3].T
    assert np.allclose(turn @ axis, axis)
    assert np.arccos((np.trace(turn) - 1) / 2) == pytest.approx(np.linalg.norm(steps[0, 3:]))


@pytest.mark.parametrize("count", [1, 2, 30])
def test_positive_definite_systems_are_solved(count):
    rng = np.random.default_rng(count)
    half = rng.normal(size=(count, count))
    matrix, right = half @ half.T + np.eye(count), rng.normal(size=count)
    assert np.allclose(solve_positive(np.tril(matrix), right), np.linalg.solve(matrix, right))


class TestWrongPoses:
    POSES = np.tile(np.eye(4), (500, 1, 1))

    def test_nothing_is_wrong_without_errors_and_equal_seeds_give_equal_poses(self, street):
        assert np.array_equal(wrong_poses(street[1]), street[1])
        one, same, other = (wrong_poses(self.POSES, jitter_m=0.1, seed=seed) for seed in (1, 1, 2))
        assert np.array_equal(one, same) and not np.array_equal(one, other)

    def test_errors_have_the_sizes_that_are_asked_for(self):
        jitter = wrong_poses(self.POSES, jitter_m=0.1, jitter_rad=0.01)
        assert jitter[:, :3, 3].std(axis=0) == pytest.approx([0.1] * 3, rel=0.15)
        assert jitter[:, 1, 0].std() == pytest.approx(0.01, rel=0.15)
        drift = wrong_poses(self.POSES, drift_m=0.1, drift_rad=0.01)
        steps = invert(drift[:-1]) @ drift[1:]
        assert steps[:, :3, 3].std(axis=0) == pytest.approx([0.1] * 3, rel=0.15)
        assert steps[:, 1, 0].std() == pytest.approx(0.01, rel=0.15)
        assert np.array_equal(drift[0], np.eye(4))
        height = wrong_poses(self.POSES, height_drift_m=0.1)
        assert not height[:, :2, 3].any() and np.diff(height[:, 2, 3]).std() == pytest.approx(
            0.1, rel=0.15
        )

    @pytest.mark.parametrize("value", [-0.1, float("nan"), float("inf")])
    @pytest.mark.parametrize(
        "name", ["jitter_m", "jitter_rad", "drift_m", "drift_rad", "height_drift_m"]
    )
    def test_a_deviation_is_a_positive_number(self, name, value):
        with pytest.raises(ArgumentError) as error:
            wrong_poses(self.POSES, **{name: value})
        assert error.value.where == name


def test_transforming_the_thinned_points_gives_points_of_both_kinds(street):
    scans, true = street
    thinned = ThinnedScan.of(scans[0], true[0])
    assert 0.1 < len(thinned.measured) / (len(thinned.used) + len(thinned.measured)) < 0.4
    places = [
        {
            tuple(cell)
            for cell in np.floor(transform_points(true[0], points) / 2.0).astype(int).tolist()
        }
        for points in (thinned.used, thinned.measured)
    ]
    assert not places[0] & places[1]
