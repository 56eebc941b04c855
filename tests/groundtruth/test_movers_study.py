"""The study of movers: its street, its counts on grids of which everything is known, and one small
drive from the recording to the tables.
"""

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from carlasc import Boxes, Grid, GridSpec
from carlasc.core.tables import CARLA

VEHICLE, PEDESTRIAN, ROAD = (CARLA.id_of(name) for name in ("Vehicle", "Pedestrian", "Road"))
SPEC = GridSpec("cartesian", (4, 4, 2), (0.0, 0.0, 0.0), (4.0, 4.0, 2.0))
MODULES = (
    "study",
    "railed",
    "street",
    "movers",
    "movers_drives",
    "movers_rows",
    "movers_scores",
    "movers_tables",
)


@pytest.fixture(autouse=True)
def studies(monkeypatch):
    monkeypatch.syspath_prepend(str(Path(__file__).parents[2] / "docs/studies"))
    yield
    for name in MODULES:
        sys.modules.pop(name, None)


# --- the street
# -----------------------------------------------------------------------------------------------------------------


@pytest.fixture
def street():
    pytest.importorskip("embreex")
    pytest.importorskip("trimesh")
    from street import StreetDrive

    return StreetDrive


def test_vehicles_stay_ahead_and_behind_in_the_lane_of_the_vehicle_that_records(street):
    drive = street(7)
    gaps = []
    for frame in (0, 90):
        ego, *others = drive.actors(frame)
        lane = [a.world_T_actor[:2, 3] - ego.world_T_actor[:2, 3] for a in others]
        gaps.append(sorted(float(x) for x, y in lane if abs(y) < 0.1))
    assert gaps[0] == pytest.approx(gaps[1])
    assert sum(gap < 0 for gap in gaps[0]) == sum(gap > 0 for gap in gaps[0]) == 2
    assert min(map(abs, gaps[0])) > 5


def test_nobody_drives_through_another_and_all_kinds_are_there(street):
    drive = street(8)
    for frame in (0, 45, 90):
        spans = []
        for actor in drive.actors(frame):
            lower, upper = actor.mesh.vertices.min(axis=0)[:2], actor.mesh.vertices.max(axis=0)[:2]
            place = actor.world_T_actor[:2, 3]
            turned = actor.world_T_actor[0, 0] < 0
            spans.append(
                (place - upper, place - lower) if turned else (place + lower, place + upper)
            )
        vehicles = spans[:-28]  # people come last, and may pass each other closely
        for index, (low, high) in enumerate(vehicles):
            for other_low, other_high in vehicles[index + 1 :]:
                assert ((low > other_high) | (high < other_low)).any()
    sizes = np.array([np.ptp(a.mesh.vertices, axis=0) for a in drive.actors(45)])
    assert (sizes[:, 0] > 11).any() and (sizes[:, 1] < 0.8).sum() > 20


def test_a_street_depends_on_its_seed_alone(street):
    one, same, other = street(3).actors(10), street(3).actors(10), street(4).actors(10)
    assert all(
        np.array_equal(a.world_T_actor, b.world_T_actor) for a, b in zip(one, same, strict=True)
    )
    assert not np.array_equal(one[2].world_T_actor, other[2].world_T_actor)


# --- counts and figures
# ---------------------------------------------------------------------------------------------------------


def scene():
    """Return a grid and its reference: four voxels of a fast car (actor 5) and two of a walker
    (actor 6), on free space.
    """
    from movers_drives import Reference

    truth, owner = np.zeros(SPEC.size, np.uint8), np.zeros(SPEC.size, np.uint16)
    truth[0], owner[0, :, 0] = ROAD, 5
    truth[0, :, 0] = VEHICLE
    truth[3, :2, 1], owner[3, :2, 1] = PEDESTRIAN, 6
    made, counts = truth.copy(), np.ones(SPEC.size, np.uint32)
    made[0, 0, 0] = 0  # called free
    counts[0, 1, 0] = 0  # unknown
    made[1, 0, 0] = made[1, 1, 0] = VEHICLE  # wrongly
    judged = np.ones(SPEC.size, np.bool_)
    judged[1, 1, 0] = False
    return Grid(SPEC, made, counts), Reference(truth, judged, owner, {5: 6.0, 6: 1.4})


def test_counts_of_a_known_scene():
    from movers_scores import count, figures, groups

    grid, reference = scene()
    counts = count(grid, reference, {5: 2})
    found = figures(counts + counts)
    # 2 right, 1 free, 1 wrongly; the voxel that is not judged does not count
    assert found["Vehicle IoU"] == pytest.approx(2 / 4)
    assert found["Vehicle IoU, all"] == pytest.approx(2 / 5)
    assert (found["Vehicle found"], found["Vehicle free"]) == (0.5, 0.25)
    assert found["wrongly Vehicle"] == found["wrongly occupied"] == 1
    assert found["Pedestrian IoU"] == found["Road IoU"] == 1
    assert np.isnan(found["Building IoU"]) and np.isnan(found["ECE"])
    shares = groups(counts)
    assert shares["vehicles, 4 to 8 m/s"] == shares["vehicles, 2 sides seen"] == (0.5, 0.25, 4)
    assert shares["people"] == (1.0, 0.0, 2) and shares["vehicles, 1 side seen"][2] == 0


def test_counts_survive_json():
    from movers_scores import Counts, count

    grid, reference = scene()
    counts = count(grid, reference, {}, np.full(SPEC.size, 0.3), 1.5)
    again = Counts.from_json(counts.to_json())
    for name, value in vars(counts).items():
        assert np.array_equal(np.asarray(getattr(again, name)), np.asarray(value))


def test_the_calibration_error_is_zero_for_true_probabilities_and_the_gap_for_others():
    from movers_scores import calibration_error, histogram

    rng = np.random.default_rng(0)
    p = rng.uniform(0, 1, 200_000)
    true = histogram(p, rng.uniform(size=len(p)) < p)
    assert calibration_error(true) < 0.01 and calibration_error(true, 0.05) < 0.01
    assert calibration_error(
        histogram(np.full(1000, 0.9), np.zeros(1000, np.bool_))
    ) == pytest.approx(0.9)
    mostly_sure = histogram(np.r_[np.full(900, 0.001), np.full(100, 0.5)], np.zeros(1000, np.bool_))
    assert calibration_error(mostly_sure, 0.05) == pytest.approx(0.5)
    assert calibration_error(mostly_sure) < 0.06


# --- what the rows are given, and a run
# -----------------------------------------------------------------------------------------


@pytest.fixture
def small(monkeypatch, tmp_path):
    """A drive of twelve frames of a street, with few rays, of which one frame is judged."""
    pytest.importorskip("embreex")
    pytest.importorskip("trimesh")
    import movers_drives

    kinds = {
        "street": replace(
            movers_drives.KINDS["street"], frames=12, candidates=(3,), judged=1, sensors=3
        )
    }
    monkeypatch.setattr(movers_drives, "KINDS", kinds)
    monkeypatch.setattr(movers_drives, "POINTS", {16: 4000, 32: 6000})
    return tmp_path


@pytest.mark.slow
def test_a_drive_is_recorded_once_with_exact_boxes(small):
    import movers_drives
    from movers_drives import record

    one, two = record("street", 5, (16, 32), small)
    times = [path.stat().st_mtime_ns for path in sorted(small.rglob("*")) if path.is_file()]
    again, _ = record("street", 5, (16, 32), small)
    assert times == [path.stat().st_mtime_ns for path in sorted(small.rglob("*")) if path.is_file()]
    assert again.sequence.poses.shape == (movers_drives.KINDS["street"].frames, 4, 4)
    assert len(two.sequence.read("points", 3)) > len(one.sequence.read("points", 3))
    scan = two.sequence.scan(3)
    owners = scan.boxes.owners(scan.points, 0.05)  # noise is at most 2 cm
    actor = scan.instances > 0
    assert actor.sum() > 100 and (owners[actor] >= 0).all()
    own = scan.boxes.tracks[owners[actor]] == scan.instances[actor]
    assert own.mean() > 0.99  # a point may be in two boxes
    sides = two.sides(3, (-3, 3))
    assert set(np.unique(scan.instances[actor]).tolist()) <= set(sides)
    assert max(sides.values()) >= 2 and all(0 <= count <= 3 for count in sides.values())


@pytest.mark.slow
def test_rows_change_what_they_say(small):
    from movers_drives import record
    from movers_rows import NoisyPoses, noisy_boxes, without_movers, wrong_ids

    (drive,) = record("street", 5, (32,), small)
    exact = drive.sequence
    moving = np.linalg.norm(exact.read("flow", 2), axis=1) > 1
    removed = without_movers(drive, 3)
    assert (
        len(removed.scan(2)) == (~moving).sum() < len(exact.scan(2))
        and not removed.scan(2).flow.any()
    )
    assert len(removed.scan(3)) == len(exact.scan(3))
    ids, wrong = exact.read("instances", 2), wrong_ids(drive, 0).read("instances", 2)
    assert (
        0 < (ids != wrong).mean() < 0.4
        and set(wrong) <= set(ids)
        and ((ids == 0) == (wrong == 0)).all()
    )
    boxes = noisy_boxes(drive, 0)
    assert set(boxes.frames("boxes")) < set(exact.frames("boxes"))
    frame = int(boxes.frames("boxes")[0])
    offset = Boxes.from_table(boxes.read("boxes", frame)).centers - exact.boxes(frame).centers
    assert 0.05 < offset.std() < 0.2
    turned = NoisyPoses(0.0, 0.5)(drive, 0).poses
    shifted = NoisyPoses(0.2, 0.0)(drive, 0).poses - exact.poses
    angles = np.arccos((np.einsum("fij,fij->f", turned[:, :3, :3], exact.poses[:, :3, :3]) - 1) / 2)
    assert 0.1 < np.degrees(angles).mean() < 2 and np.array_equal(
        turned[:, :3, 3], exact.poses[:, :3, 3]
    )
    assert 0.1 < shifted[:, :3, 3].std() < 0.3 and not shifted[:, :3, :3].any()


@pytest.mark.slow
def test_a_run_makes_rows_once_and_the_tables_show_them(small, capsys):
    from movers import Setting, Task, held_out, run, tables
    from movers_tables import write_tables

    tasks = [
        Task(Setting("street", seed, 16), ("coarse",), ("tube", "align, flow"), small)
        for seed in (5, 6)
    ]
    for task in tasks:
        run(task)
    assert capsys.readouterr().out.count("Vehicle IoU") == 4
    run(tasks[0])
    assert not capsys.readouterr().out
    (table,) = tables(tasks)
    assert table.drives == ["street5", "street6"]
    text = write_tables([table], held_out(tasks), small / "out" / "movers")
    assert (small / "out/movers.md").read_text() == text and (small / "out/movers.json").exists()
    rows = [line for line in text.splitlines() if line.startswith("| align, flow")]
    assert rows and "±" not in rows[0] and "(1/" in rows[0]  # two drives have no spread
    assert "side" in text


def test_the_tasks_cover_the_report(tmp_path):
    import argparse

    from movers import SEEDS, tasks_of
    from movers_rows import ABLATIONS, ROWS

    options = {"work": tmp_path, "part": None, "channels": [32], **SEEDS}
    tasks = tasks_of(argparse.Namespace(parked=False, **options))
    made = {
        (task.setting.channels, grid, row)
        for task in tasks
        for grid in task.grids
        for row in task.rows
    }
    assert {(32, "coarse", row.name) for row in (*ROWS, *ABLATIONS)} <= made
    others = {(16, "coarse"), (64, "coarse"), (32, "0.2 m")}
    assert {(*other, "align, free space") for other in others} <= made
    assert len({task.setting.drive for task in tasks}) == 10
    parked = tasks_of(argparse.Namespace(parked=True, **options))
    assert {task.setting.seed for task in parked} == {1, 2, 3}
