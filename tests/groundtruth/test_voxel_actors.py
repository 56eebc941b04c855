"""Who is in each voxel, and how fast: from captures, and from scans whose actors are found in
several ways.
"""

import pickle
import shutil
from dataclasses import replace

import numpy as np
import pytest
from helpers.datasets.captures import make_recording, write_capture
from helpers.scenes.passing_car import SPEC, SPEED_M_S, sensor_pose, street, write_sequence
from typer.testing import CliRunner

import carlasc
from carlasc import Boxes, FromCapture, FromGrid, FromScans, GridSpec, Run, Scan, Voting
from carlasc.captures import CaptureWriter, SensorRecording
from carlasc.cli import app
from carlasc.core.frames import FrameRange
from carlasc.core.geometry import invert, rotate_vectors, rotation_z, translation
from carlasc.errors import ArgumentError
from carlasc.groundtruth.from_scans.actor_voxels import velocity_at
from carlasc.groundtruth.from_scans.feed import ScanFeed
from carlasc.groundtruth.from_scans.sequences import ScanFrame, ScanSequence
from carlasc.groundtruth.inputs import GridPlan
from carlasc.groundtruth.voxel_actors import ActorPoints, number_actors
from carlasc.motion import Extent, MotionOptions, Track
from carlasc.motion.tracks import FIRST_FOUND, MovingActors
from carlasc.storage import FolderSink, FolderSource, field_files

NOW = 7
GRID = "evaluation_128x128x8"
KEEP = Voting(keep_actors=True)
COARSE = GridSpec.published()
ROUGH = SPEC.with_resolution(0.8)
FOLDERS = {"labels": "labels", "flow": "predictions", "instances": "instances"}


@pytest.fixture(scope="module")
def drive(tmp_path_factory):
    """A drive of 12 scans with all fields, to be copied."""
    folder = tmp_path_factory.mktemp("drive")
    write_sequence(folder, tuple(FOLDERS), frames=12)
    return folder


def copy(drive, folder, *fields):
    """Copy the drive with only some of its fields."""
    left_out = [name for field, name in FOLDERS.items() if field not in fields]
    return shutil.copytree(drive, folder, ignore=lambda *_: left_out, dirs_exist_ok=True)


def make(drive, folder, fields, spec=SPEC, frames=slice(NOW, NOW + 2), **options):
    copy(drive, folder, *fields)
    given = {
        "motion": MotionOptions(options.pop("motion", "auto")),
        "window": (-3, 3),
        "own_path": False,
    }
    result = carlasc.regrid(
        folder,
        spec,
        observe=FromScans(**given | options),
        voting=KEEP,
        frames=frames,
        name="made",
        run=Run(workers=1),
    )
    assert not result.failures
    return next(one for one in FolderSource(folder).sequences().values() if "made" in one.grids)


def track(frames):
    """A track along x at 10 m/s."""
    poses = np.stack([translation((frame, 0.0, 0.0)) for frame in range(frames)])
    half = np.array([2.0, 1.0, 0.75])
    extent = Extent(-half, half, (True,) * 4, 100)
    return Track(10, 0, {}, 0, poses, np.tile([10.0, 0, 0], (frames, 1)), -half, half, extent)


def in_box(frame, box, spec=SPEC):
    """Return (V,) the voxels whose centres are in a box of the street."""
    centers = spec.from_axes(spec.centers()).reshape(-1, 3) + sensor_pose(frame)[:3, 3]
    here = street(frame)
    return ((centers > here.lower[box]) & (centers < here.upper[box])).all(axis=1)


@pytest.mark.parametrize(
    "fields",
    [
        ("labels", "instances"),
        pytest.param(("labels", "flow"), marks=pytest.mark.slow),
        pytest.param(("labels",), marks=pytest.mark.slow),
    ],
    ids=["numbers", "flow", "nothing"],
)
def test_a_passing_car_has_one_number_and_its_velocity_and_a_parked_one_the_number_of_the_data(
    drive, tmp_path, fields
):
    sequence = make(drive, tmp_path, fields)
    numbers = set()
    for frame in (NOW, NOW + 1):
        instance = sequence.read("made/instance", frame).reshape(-1)
        labels = sequence.read("made/labels", frame).reshape(-1)
        velocity = sequence.read("made/velocity", frame)
        passing = np.unique(instance[in_box(frame, -1) & (labels > 0)])
        numbers |= set(passing[passing > 0].tolist())
        assert np.isin(instance[in_box(frame, -1) & (labels == 10)], passing[passing > 0]).all()
        assert (
            velocity.dtype == field_files.VELOCITY_DTYPE and (np.diff(velocity["voxel"]) > 0).all()
        )
        assert (
            np.isin(velocity["voxel"], np.flatnonzero(np.isin(instance, list(numbers)))).all()
            and len(velocity) > 20
        )
        assert np.abs(velocity["velocity"].astype(float) - [SPEED_M_S, 0, 0]).max() < (
            0.1 if "flow" in fields else 1.0
        )
        parked = instance[in_box(frame, -2) & (labels == 10)]
        assert len(parked) and (parked == (4 if "instances" in fields else 0)).all()
        assert not instance[labels == 0].any()
        assert not np.isin(labels[instance > 0], [7, 1]).any()  # the road below, houses
    assert numbers == {9 if "instances" in fields else 1}


def test_a_cylindrical_grid_has_velocities_along_the_axes_of_the_sensor(drive, tmp_path):
    spec = GridSpec.published("cylindrical")
    sequence = make(drive, tmp_path, ("labels", "flow"), spec, frames=slice(NOW, NOW + 1))
    velocity = sequence.read("made/velocity", NOW)["velocity"].astype(float)
    assert len(velocity) > 20 and np.abs(velocity - [SPEED_M_S, 0, 0]).max() < 0.1


def test_parked_cars_have_the_numbers_of_their_boxes(drive, tmp_path):
    folder = copy(drive, tmp_path / "data", "labels", "flow")
    writer = FolderSink(folder).sequence("Val/Street/cartesian")
    here = street(NOW)
    for frame in range(12):
        pose = invert(sensor_pose(frame)) @ translation((here.lower[-2] + here.upper[-2]) / 2)
        boxes = Boxes.from_poses(
            np.array([77], np.uint32),
            np.array([10], np.uint32),
            pose[None],
            (here.upper - here.lower)[-2:-1],
        )
        writer.write("boxes", frame, boxes.to_table())
    carlasc.regrid(
        folder,
        ROUGH,
        observe=FromScans(window=(-3, 3)),
        voting=KEEP,
        frames=[NOW],
        name="made",
        run=Run(workers=1),
    )
    (sequence,) = FolderSource(folder).sequences().values()
    instance, labels = (
        sequence.read(f"made/{part}", NOW).reshape(-1) for part in ("instance", "labels")
    )
    parked = instance[in_box(NOW, -2, ROUGH) & (labels == 10)]
    assert len(parked) and (parked == 77).all()


def test_a_turning_body_has_another_velocity_at_each_end(drive, tmp_path):
    """A body that turns by 0.3 rad/s: two metres ahead of its middle, it moves sideways by 0.6 m/s."""
    copy(drive, tmp_path, "labels")
    (sequence,) = FolderSource(tmp_path).sequences().values()
    feed = ScanFeed(sequence, FromScans())
    one = track(40)
    angles = 0.03 * np.arange(40)
    poses = one.world_T_actor.copy()
    poses[:, 0, 0] = poses[:, 1, 1] = np.cos(angles)
    poses[:, 1, 0], poses[:, 0, 1] = np.sin(angles), -np.sin(angles)
    middle = poses[NOW, :3, 3]
    found = velocity_at(
        replace(one, world_T_actor=poses),
        NOW,
        middle + [[2.0, 0, 0], [0, 0, 0], [0, -2.0, 1]],
        feed,
    )
    assert np.allclose(found, [[10, 0.6, 0], [10, 0, 0], [10.6, 0, 0]], atol=1e-6)


# --- from a capture
# -----------------------------------------------------------------------------------------------------------


def test_a_capture_gives_each_voxel_the_actor_that_most_points_of_its_class_have(tmp_path):
    capture = write_capture(tmp_path / "town", frames=1, sensors=3, points=3000)
    carlasc.regrid(
        tmp_path / "town", COARSE, observe=FromCapture(), voting=KEEP, run=Run(workers=1)
    )
    (sequence,) = FolderSource(tmp_path / "town").sequences().values()
    labels, instance = (
        sequence.read(f"evaluation/{part}", 0).reshape(-1) for part in ("labels", "instance")
    )
    velocity = sequence.read("evaluation/velocity", 0)
    ego, counts, speeds = capture.read(0, 100), {}, {}
    for sensor in range(3):
        recording = capture.read(sensor, 100)
        ego_T_sensor = invert(ego.world_T_sensor) @ recording.world_T_sensor
        points = recording.scan.points @ ego_T_sensor[:3, :3].T + ego_T_sensor[:3, 3]
        for row in recording.velocities:
            speeds.setdefault(int(row[0]), ego_T_sensor[:3, :3] @ row[1:])
        for voxel, label, actor in zip(
            COARSE.flat_index(points), recording.scan.labels, recording.scan.instances, strict=True
        ):
            if voxel >= 0 and label:
                own = counts.setdefault((int(voxel), int(label)), {})
                own[int(actor)] = own.get(int(actor), 0) + 1
    wanted = np.zeros(labels.size, int)
    for (voxel, label), own in counts.items():
        if labels[voxel] == label:
            wanted[voxel] = min(own, key=lambda actor: (-own[actor], actor))
    assert np.count_nonzero(wanted) > 1000
    assert np.array_equal(instance, wanted)
    moving = np.flatnonzero(
        np.isin(wanted, [a for a, v in speeds.items() if np.linalg.norm(v) > 0.3])
    )
    assert np.array_equal(velocity["voxel"], moving)
    expected = np.array([speeds[wanted[voxel]] for voxel in moving])
    assert np.allclose(velocity["velocity"], expected, atol=2e-3)


def test_the_voxels_of_a_turning_actor_of_a_capture_differ(tmp_path):
    """A bus of 10 m drives at 6 m/s and turns by 0.4 rad/s; a person beside it, whose way turns
    too, has one velocity.
    """
    writer, rate, rng = CaptureWriter(tmp_path / "town"), 0.4, np.random.default_rng(0)
    pose = translation((3.0, -2.0, 2.0)) @ rotation_z(0.7)
    for frame in range(3):
        angle = 0.2 + rate * 0.1 * (frame - 1)
        velocity = rotate_vectors(invert(pose), 6 * np.array([[np.cos(angle), np.sin(angle), 0]]))[
            0
        ]
        points = np.concatenate(
            [
                rng.uniform((0, -1.5, -2), (10, 1.5, 0.6), (4000, 3)),
                rng.uniform((-4, -4, -1.5), (-3, -3, 0), (50, 3)),
            ]
        )
        instances = np.repeat(np.array([7, 8], np.uint32), (4000, 50))
        scan = Scan(
            points.astype(np.float32),
            np.where(instances == 7, 10, 4).astype(np.uint32),
            None,
            instances,
        )
        writer.write(
            0, frame, SensorRecording(scan, pose, np.array([[7, *velocity], [8, *velocity]]))
        )
        writer.write_times({frame: [frame * 0.1]})
    carlasc.regrid(
        tmp_path / "town",
        COARSE,
        observe=FromCapture(),
        voting=KEEP,
        frames=[1],
        run=Run(workers=1),
    )
    (sequence,) = FolderSource(tmp_path / "town").sequences().values()
    found, instance = (
        sequence.read("evaluation/velocity", 0),
        sequence.read("evaluation/instance", 0).reshape(-1),
    )
    own = rotate_vectors(invert(pose), 6 * np.array([[np.cos(0.2), np.sin(0.2), 0]]))
    arm = COARSE.centers_of(found["voxel"]) - [5.0, 0, 0]
    turning = own + rate * np.column_stack([-arm[:, 1], arm[:, 0], np.zeros(len(arm))])
    expected = np.where(instance[found["voxel"], None] == 7, turning, own)
    assert set(instance[found["voxel"]].tolist()) == {7, 8} and np.ptp(turning, axis=0).max() > 3
    assert np.abs(found["velocity"] - expected).max() < 0.03


def test_recordings_without_actors_have_none():
    points = ActorPoints(SPEC, {}, ())
    recording = make_recording()
    points.add(replace(recording, scan=replace(recording.scan, instances=None)), np.eye(4))
    found = points.of(np.zeros(SPEC.size, np.uint8))
    assert not found.instance.any() and len(found.velocity) == 0


# --- what a run writes
# --------------------------------------------------------------------------------------------------------


def test_nothing_is_written_that_was_not_asked_for_and_runs_are_equal(drive, tmp_path):
    for folder, voting in (("a", Voting()), ("b", KEEP), ("c", KEEP)):
        carlasc.regrid(
            copy(drive, tmp_path / folder, "labels", "flow"),
            ROUGH,
            observe=FromScans(window=(-1, 1)),
            voting=voting,
            frames=[NOW],
            name="made",
            run=Run(workers=1),
        )
    a, b, c = (
        {
            p.name: p.read_bytes()
            for p in (tmp_path / f).rglob("made/*")
            if p.is_file() and p.suffix != ".json"
        }
        for f in "abc"
    )
    assert b == c
    assert {name: data for name, data in b.items() if name in a} == a
    assert set(b) - set(a) == {f"{NOW:06d}.instance", f"{NOW:06d}.velocity.npz"}


def test_voxels_that_become_unknown_have_no_actor(drive, tmp_path):
    copy(drive, tmp_path, "labels", "flow")
    voting = Voting(keep_actors=True, min_confidence=0.97)
    carlasc.regrid(
        tmp_path,
        ROUGH,
        observe=FromScans(window=(-3, 3)),
        voting=voting,
        frames=[NOW],
        name="made",
        run=Run(workers=1),
    )
    (sequence,) = FolderSource(tmp_path).sequences().values()
    labels, instance = (sequence.read(f"made/{part}", NOW) for part in ("labels", "instance"))
    assert instance.any() and not instance[labels == 0].any()
    assert (labels.reshape(-1)[sequence.read("made/velocity", NOW)["voxel"]] > 0).all()


@pytest.mark.parametrize(
    ("observe", "found"),
    [(FromScans(dynamic="drop"), 'dynamic "drop"'), (FromGrid(), "a finer grid")],
    ids=["drop", "grid"],
)
def test_what_does_not_know_bodies_cannot_keep_actors(tmp_path, observe, found):
    write_sequence(tmp_path, ("labels", "flow"), frames=3)
    with pytest.raises(ArgumentError, match=f"keep_actors: .*found {found}"):
        carlasc.regrid(tmp_path, SPEC, observe=observe, voting=KEEP)


def test_the_command_takes_it(tmp_path, monkeypatch):
    write_sequence(tmp_path, ("labels", "flow"), frames=3)
    given = [
        "regrid",
        str(tmp_path),
        "--observe",
        "scans",
        "--res",
        "0.8",
        "--keep-actors",
        "--workers",
        "1",
        "--frames",
        "1",
    ]
    result = CliRunner().invoke(app, given)
    assert result.exit_code == 0, result.output
    assert (
        len(list(tmp_path.rglob("*.instance"))) == len(list(tmp_path.rglob("*.velocity.npz"))) == 1
    )
    result = CliRunner().invoke(app, [*given, "--dynamic", "tube", "--name", "other"])
    assert result.exit_code == 2 and "--keep-actors" in result.output


def test_worker_processes_get_the_numbers(drive, tmp_path):
    copy(drive, tmp_path, "labels", "flow")
    (sequence,) = FolderSource(tmp_path).sequences().values()
    plan = GridPlan(SPEC, "made", FromScans(), KEEP, FrameRange())
    inputs = ScanSequence(sequence, plan, FromScans())
    inputs.actors = MovingActors({5: track(12)}, numbers={5: 3})
    assert pickle.loads(pickle.dumps(ScanFrame(inputs, 4, 4))).inputs.actors.numbers == {5: 3}


CAR, PERSON = 10, 4


def one_track(
    first, frames, *, x=0.0, instance=0, label=CAR, rigid=True, half=(2.0, 1.0, 0.75), seen=None
):
    """A track at 1 m per frame along x, from x at frame 0 on, whose members are in all frames, or
    in those of `seen`.
    """
    poses = np.stack([translation((x + frame, 0.0, 0.0)) for frame in range(first, first + frames)])
    members = {
        frame: np.arange(5) for frame in (range(first, first + frames) if seen is None else seen)
    }
    upper = np.array(half)
    extent = Extent(-upper, upper, (True,) * 4, 100)
    velocity = np.tile([10.0, 0, 0], (frames, 1))
    return Track(label, instance, members, first, poses, velocity, -upper, upper, extent, rigid)


def test_numbers_of_the_data_are_kept_and_others_are_new_and_above_them():
    tracks = {
        3: one_track(0, 9, instance=7),
        4: one_track(0, 9, x=50, instance=FIRST_FOUND + 2),
        8: one_track(2, 9, x=-50),
        9: one_track(1, 9, x=90),
    }
    assert number_actors(tracks) == {3: 7, 4: 8, 9: 9, 8: 10}
    assert number_actors(tracks, highest=70_000) == {3: 7, 4: 70_001, 9: 70_002, 8: 70_003}
    assert number_actors({}) == {}


@pytest.mark.parametrize(
    ("second", "is_same"),
    [
        (one_track(6, 10, x=1.5), True),
        (one_track(6, 10, x=2.2), True),  # at the body
        (one_track(6, 10, x=2.4), False),  # beside it
        (one_track(7, 10, x=1.5), True),  # three common frames
        (one_track(8, 10, x=1.5), False),  # two
        (one_track(6, 10, x=1.5, label=PERSON), False),
        (one_track(6, 10, x=1.5, half=(0.5, 0.5, 0.5)), True),
    ],
)
def test_tracks_of_one_class_of_which_one_is_in_the_body_of_the_other_are_one_actor(
    second, is_same
):
    found = number_actors({0: one_track(0, 10), 1: second})
    assert (found[0] == found[1]) == is_same


@pytest.mark.parametrize(("seen", "is_same"), [(range(10, 16), True), (range(9, 16), False)])
def test_two_people_who_are_seen_at_once_are_two(seen, is_same):
    first, second = (one_track(n, 10, label=PERSON, rigid=False) for n in (0, 6))
    found = number_actors({0: first, 1: replace(second, members={f: np.arange(5) for f in seen})})
    assert (found[0] == found[1]) == is_same


def test_a_track_without_a_number_takes_that_of_its_actor_and_two_numbers_are_never_joined():
    assert number_actors({0: one_track(0, 10), 1: one_track(5, 10, instance=6)}) == {0: 6, 1: 6}
    assert number_actors({0: one_track(0, 10, instance=3), 1: one_track(5, 10, instance=6)}) == {
        0: 3,
        1: 6,
    }
    # the one in the middle is of both, and both have numbers: it goes with the first
    tracks = {
        0: one_track(0, 10, instance=3),
        1: one_track(5, 10),
        2: one_track(10, 10, instance=6),
    }
    assert number_actors(tracks) == {0: 3, 1: 3, 2: 6}


def test_a_number_that_is_in_two_places_at_once_is_of_the_longer_track():
    tracks = {
        0: one_track(0, 5, instance=3),
        1: one_track(2, 20, x=40, instance=3),
        2: one_track(60, 5, x=90, instance=3),
    }
    assert number_actors(tracks) == {0: 4, 1: 3, 2: 3}
