"""Recording from a stand-in for the server.

No test here has used a live server (see docs/commands/capture.md).
"""

import io
import json
import queue
from types import SimpleNamespace

import numpy as np
import pytest
from helpers.errors import raises
from typer.testing import CliRunner

pytest.importorskip(
    "carla", reason="the carla package is not installed: pip install 'carlasc[carla]'"
)

import carla
from carlasc_recorders import ServerError
from carlasc_recorders.carla.sensors import ActorNumbers
from carlasc_recorders.carla.server import DETECTION, Server, decode_sweep
from helpers.servers.carla_server import PEDESTRIAN, SPEED_M_S, TAGS, FakeServer

from carlasc.captures import Capture, Lidar, ServerOptions, record
from carlasc.captures.settings import sensor_offsets
from carlasc.cli import app
from carlasc.core.geometry import transform_points
from carlasc.core.tables import CARLA
from carlasc.errors import ArgumentError, CarlascError, ConflictError, DependencyError
from carlasc.storage.camera_files import decode_image

ROAD, VEHICLE, WALKER = (CARLA.id_of(name) for name in ("Road", "Vehicle", "Pedestrian"))


def call(out, server, timeout_s=5.0, **options):
    chosen = {
        "count": 3,
        "sensors": 4,
        "town": "Town01",
        "traffic": "light",
        "bev": False,
    } | options
    return record(out, server=ServerOptions(timeout_s=timeout_s), carla=server, **chosen)


@pytest.fixture(params=["0.9.13", "0.9.14", "0.9.16-dirty"])
def server(request):
    return FakeServer(request.param)


def test_a_capture_is_recorded_that_reads_back(server, tmp_path):
    result = call(tmp_path, server)
    capture = Capture(tmp_path)
    assert capture.sensors == (0, 1, 2, 3) and capture.frames.tolist() == [0, 1, 2]
    assert (result.written, result.sensors, result.vehicles, result.walkers) == (3, 4, 19, 25)
    assert result.server_version == server.version
    for frame in range(3):
        for sensor in range(4):
            recording = capture.read(sensor, frame)
            assert len(recording.scan) > 40
            assert set(np.unique(recording.scan.labels)) <= {ROAD, VEHICLE, WALKER}
    times = [capture.read_time(frame) for frame in range(3)]
    assert np.allclose(np.diff(times), 0.1)


def test_class_ids_do_not_depend_on_the_servers_version(tmp_path):
    assert TAGS[False] != TAGS[True]
    old, new = (FakeServer(version) for version in ("0.9.13", "0.9.15"))
    call(tmp_path / "old", old)
    call(tmp_path / "new", new)
    for frame in range(3):
        one, other = (Capture(tmp_path / name).read(1, frame).scan for name in ("old", "new"))
        assert np.array_equal(one.labels, other.labels)
        assert {ROAD, VEHICLE, WALKER} == set(np.unique(one.labels))
        road = transform_points(
            Capture(tmp_path / "new").read_pose(1, frame), other.points[other.labels == ROAD]
        )
        # poses take points to the world: the ground is level there
        assert np.abs(road[:, 2]).max() < 0.05


def test_sensors_are_placed_as_the_format_says(tmp_path):
    server = FakeServer()
    call(tmp_path, server, sensors=20, count=1)
    capture = Capture(tmp_path)
    poses = np.stack([capture.read_pose(sensor, 0) for sensor in range(20)])
    (ego,) = [a for a in server.worlds[-1].actors if a.attributes.get("role_name") == "hero"]
    world_T_ego = poses[0] @ np.linalg.inv(
        np.block([[np.eye(3), np.array([[-0.5], [0.0], [1.8]])], [np.zeros(3), 1]])
    )
    assert np.allclose(
        world_T_ego[:3, 3],
        [ego.transform.location.x, ego.transform.location.y, ego.transform.location.z],
        atol=1e-4,
    )
    offsets = np.stack([(np.linalg.inv(world_T_ego) @ pose)[:3, 3] for pose in poses])
    # the vehicle's own orientation
    assert np.allclose(poses[:, :3, :3], poses[0, :3, :3], atol=1e-6)
    assert np.allclose(offsets, sensor_offsets(20, np.random.default_rng(0)), atol=1e-4)
    assert (
        (np.abs(offsets[1:, :2]) <= 20).all()
        and (offsets[1:, 2] >= 1).all()
        and (offsets[1:, 2] <= 5).all()
    )
    assert not np.allclose(sensor_offsets(20, np.random.default_rng(1))[1:], offsets[1:], atol=0.1)
    assert np.allclose(sensor_offsets(1, np.random.default_rng(1)), [[-0.5, 0, 1.8]])
    lidars = [a for a in server.worlds[-1].actors if "lidar" in a.type_id]
    wanted = {
        "channels": "64",
        "range": "50.0",
        "points_per_second": "1300000",
        "rotation_frequency": "10",
        "upper_fov": "2.0",
        "lower_fov": "-25.0",
    }
    assert all(wanted.items() <= lidar.attributes.items() for lidar in lidars)


def test_the_ego_vehicle_is_not_recorded_and_others_are_at_their_positions(tmp_path):
    server = FakeServer()
    call(tmp_path, server)
    (ego,) = [a for a in server.worlds[-1].actors if a.attributes.get("role_name") == "hero"]
    capture = Capture(tmp_path)
    for sensor in range(4):
        recording = capture.read(sensor, 2)
        actors = recording.scan.labels != ROAD
        places = transform_points(recording.world_T_sensor, recording.scan.points[actors])
        at = ego.transform.location
        assert np.linalg.norm(places - (at.x, at.y, at.z), axis=1).min() > 1.0
        positions = np.array(
            [
                [place.x, place.y, place.z]
                for a in server.worlds[-1].actors
                if a.type_id[:7] in ("vehicle", "walker.")
                for place in [a.transform.location]
            ]
        )
        nearest = np.abs(places[:, None] - positions[None]).max(-1).min(1)
        assert nearest.max() < 0.45  # within the body's points and 2 cm of noise


def test_points_have_noise_of_at_most_two_centimetres(tmp_path):
    call(tmp_path / "plain", FakeServer(), lidar=Lidar(noise_m=0.0), count=1)
    call(tmp_path / "noisy", FakeServer(), count=1)
    plain, noisy = (Capture(tmp_path / name).read(0, 0).scan.points for name in ("plain", "noisy"))
    error = np.abs(plain - noisy)
    assert 0.015 < error.max() <= 0.0201


def test_velocities_are_over_ground_in_the_sensors_frame(tmp_path):
    server = FakeServer()
    call(tmp_path, server)
    recording = Capture(tmp_path).read(0, 1)
    hit = np.unique(recording.scan.instances[recording.scan.instances > 0])
    assert recording.velocities[:, 0].tolist() == hit.tolist()
    vehicles = np.unique(recording.scan.instances[recording.scan.labels == VEHICLE])
    rows = {int(row[0]): row[1:] for row in recording.velocities}
    speeds = [np.linalg.norm(rows[actor]) for actor in vehicles]
    assert np.allclose(speeds, SPEED_M_S, atol=1e-4)
    later = Capture(tmp_path).read(0, 2)
    for actor in vehicles:  # and they go where the velocity points, in the world
        if not (later.scan.instances == actor).any():
            continue
        middle = [
            transform_points(r.world_T_sensor, r.scan.points[r.scan.instances == actor]).mean(0)
            for r in (recording, later)
        ]
        assert np.allclose(
            middle[1] - middle[0], 0.1 * recording.world_T_sensor[:3, :3] @ rows[actor], atol=0.03
        )


def test_an_actor_keeps_its_number_through_the_sequence_and_in_a_second_run(tmp_path):
    call(tmp_path / "one", FakeServer())
    server = FakeServer()
    server.last_id = 5000  # a server that has been running for long
    call(tmp_path / "other", server)
    one, other = (Capture(tmp_path / name).read(2, 2) for name in ("one", "other"))
    assert np.array_equal(one.scan.instances, other.scan.instances)
    assert one.scan.instances.max() < 100


def test_actors_are_numbered_in_the_order_in_which_they_were_spawned():
    numbers = ActorNumbers([300, 205, 290])
    assert numbers.of(np.array([290, 0, 300, 205, 300])).tolist() == [3, 0, 1, 2, 1]
    assert numbers.of(np.array([999])).tolist() == [4]  # one that was spawned later
    assert numbers.of(np.array([], np.uint32)).tolist() == []


def test_a_measurement_of_another_tick_is_skipped_or_refused():
    with Server(ServerOptions("127.0.0.1", 2000, timeout_s=0.1), FakeServer()) as server:
        arrived = queue.Queue()
        for tick in (4, 5, 7):
            arrived.put(SimpleNamespace(frame=tick))
        assert server.measurement(arrived, 5, "LiDAR 0").frame == 5
        with raises(
            ServerError,
            expected="tick 6 of LiDAR 0",
            found="tick 7",
            advice="check that no other client",
        ):
            server.measurement(arrived, 6, "LiDAR 0")


def test_the_picture_from_above_has_the_published_size(tmp_path):
    from PIL import Image

    call(tmp_path, FakeServer(), bev=True, count=1, sensors=1)
    picture = Image.open(io.BytesIO(Capture(tmp_path).read_bev(0)))
    assert picture.size == (1920, 1080)
    assert np.abs(np.asarray(picture)[5, 5].astype(int) - (10, 120, 250)).max() < 8


def assert_cleaned_up(server):
    settings = server.worlds[-1].settings
    assert server.left_behind == [] and server.complaints == []
    assert not settings.synchronous_mode and not settings.fixed_delta_seconds
    assert not any(manager.synchronous for manager in server.managers.values())


def test_the_server_is_cleaned_up(server, tmp_path):
    call(tmp_path, server)
    assert_cleaned_up(server)


@pytest.mark.parametrize(
    "error", [KeyboardInterrupt(), RuntimeError("time-out of 5000ms"), MemoryError()]
)
@pytest.mark.parametrize(
    ("what", "after"), [("tick", 0), ("tick", 2), ("spawn", 0), ("spawn", 9), ("spawn", 70)]
)
def test_the_server_is_cleaned_up_after_any_error(tmp_path, error, what, after):
    server = FakeServer()
    server.fail_at = (what, after, error)
    expected = ServerError if isinstance(error, RuntimeError) else type(error)
    with pytest.raises(expected):
        call(tmp_path, server)
    assert_cleaned_up(server)


def test_a_failed_clean_up_is_reported(tmp_path):
    server = FakeServer()
    server.cannot_destroy = True
    with raises(ServerError, problem="could not be cleaned up"):
        call(tmp_path, server)
    # the others were destroyed all the same
    assert set(server.left_behind) <= {
        "vehicle.tesla.model3",
        "vehicle.audi.tt",
    }
    assert not server.worlds[-1].settings.synchronous_mode


def test_an_interrupted_recording_is_continued(tmp_path):
    whole = call(tmp_path / "whole", FakeServer(), count=5)
    server = FakeServer()
    server.fail_at = ("tick", 4, KeyboardInterrupt())  # the first tick is the pedestrians'
    with pytest.raises(KeyboardInterrupt):
        call(tmp_path / "cut", server, count=5)
    assert Capture(tmp_path / "cut").frames.tolist() == [0, 1, 2]
    # and a frame in the middle is not whole
    (tmp_path / "cut" / "raw" / "labels2" / "1.npy").unlink()
    kept = (tmp_path / "cut" / "raw" / "velodyne0" / "0.npy").stat().st_mtime_ns
    result = call(tmp_path / "cut", FakeServer(), count=5)
    assert (result.written, whole.written) == (3, 5)
    assert (tmp_path / "cut" / "raw" / "velodyne0" / "0.npy").stat().st_mtime_ns == kept
    for frame in range(5):
        for sensor in range(4):
            one, other = (Capture(tmp_path / name).read(sensor, frame) for name in ("whole", "cut"))
            assert np.array_equal(one.scan.labels, other.scan.labels) and np.allclose(
                one.world_T_sensor, other.world_T_sensor
            )
    idle = FakeServer()
    assert call(tmp_path / "cut", idle, count=5).written == 0
    assert idle.ticks == 0  # nothing to do: the town is not even loaded


def test_a_replay_that_departs_from_the_drive_is_refused(tmp_path):
    call(tmp_path, FakeServer(), count=2)
    server = FakeServer()
    server.drift = 0.5
    with raises(ConflictError, where="frame 0", expected="a replay that follows"):
        call(tmp_path, server, count=4)
    assert Capture(tmp_path).frames.tolist() == [0, 1]
    assert_cleaned_up(server)


@pytest.mark.parametrize(("drift_m", "follows"), [(0.005, True), (0.03, False)])
def test_a_replay_follows_within_two_centimetres(tmp_path, drift_m, follows):
    call(tmp_path, FakeServer(), count=1)
    server = FakeServer()
    # the first tick is the pedestrians', so frame 0 is two ticks away from the start
    server.drift = drift_m / 2
    if follows:
        assert call(tmp_path, server, count=2).written == 1
    else:
        with raises(ConflictError, found=f"the ego sensor {drift_m:.2f} m away"):
            call(tmp_path, server, count=2)


def test_traffic_and_pedestrians_are_seeded_and_synchronous(tmp_path):
    server = FakeServer()
    server.fail_at = ("tick", 2, KeyboardInterrupt())
    with pytest.raises(KeyboardInterrupt):
        call(tmp_path, server, seed=7)
    assert [(manager.seed, manager.was_synchronous) for manager in server.managers.values()] == [
        (7, True)
    ]
    assert server.pedestrians_seed == 7


def test_pedestrians_walk_to_a_destination(tmp_path):
    server = FakeServer()
    call(tmp_path, server, count=1)
    controllers = [a for a in server.worlds[-1].actors if a.type_id == "controller.ai.walker"]
    assert len(controllers) == 25
    assert sum(controller.destination is not None for controller in controllers) > 10
    assert all(0.8 <= controller.max_speed <= 2.2 for controller in controllers)


def test_the_camera_looks_down_from_50_metres(tmp_path):
    server = FakeServer()
    call(tmp_path, server, count=1, bev=True)
    (camera,) = [a for a in server.worlds[-1].actors if a.type_id == "sensor.camera.rgb"]
    place, turn = camera.offset.location, camera.offset.rotation
    assert (place.x, place.y, place.z, turn.pitch, turn.yaw, turn.roll) == (0, 0, 50, -90, 0, 0)


def test_cameras_have_colour_class_and_depth_where_the_town_has_them(server, tmp_path):
    call(tmp_path, server, count=2, cameras=("front", "left"))
    capture = Capture(tmp_path)
    assert list(capture.cameras) == ["front", "left"]
    mounted = [actor for actor in server.worlds[-1].actors if actor.type_id == "sensor.camera.rgb"]
    turns = [one.offset.rotation.yaw for one in mounted]
    assert turns == pytest.approx([0, -90]) and float(
        mounted[0].attributes["fov"]
    ) == pytest.approx(70)
    place = (
        capture.cameras["left"].sensor_T_camera[:3, 3]
        + sensor_offsets(1, np.random.default_rng(0))[0]
    )
    at = mounted[1].offset.location
    assert [at.x, at.y, at.z] == pytest.approx(place.tolist(), abs=1e-5)
    images = capture.read_images(1)
    assert set(images) == {
        f"{name}.{camera}.{end}" for camera in ("front", "left") for name, end in
        (("images", "jpg"), ("image_labels", "png"), ("image_depths", "png"))
    }  # fmt: skip
    one = capture.cameras["front"]
    kinds = {
        name: decode_image(images[f"{name}.front.png"].tobytes(), "a", one, color=False)
        for name in ("image_labels", "image_depths")
    }
    old = server.version == "0.9.13"
    # tag 10
    assert set(np.unique(kinds["image_labels"])) == {10 if old else CARLA.id_of("Terrain")}
    assert set(np.unique(kinds["image_depths"])) == {
        round((64 + 128 * 256) / (2**24 - 1) * 1000 * 256)
    }
    color = decode_image(images["images.front.jpg"].tobytes(), "a", one, color=True)
    assert np.abs(color.astype(int) - (10, 120, 250)).max() < 8
    with pytest.raises(ConflictError):
        call(tmp_path, server, count=2)


def test_each_frame_and_sensor_has_its_own_noise(tmp_path):
    call(tmp_path / "plain", FakeServer(), lidar=Lidar(noise_m=0.0), count=2)
    call(tmp_path / "noisy", FakeServer(), count=2)
    noise = []
    for sensor, frame in ((0, 0), (1, 0), (0, 1)):
        plain, noisy = (
            Capture(tmp_path / name).read(sensor, frame).scan.points for name in ("plain", "noisy")
        )
        noise.append((noisy - plain)[:40, 0])
    assert all(
        abs(np.corrcoef(one, other)[0, 1]) < 0.6
        for one, other in zip(noise, noise[1:] + noise[:1], strict=True)
    )


def test_a_frame_without_times_is_recorded_again(tmp_path):
    call(tmp_path, FakeServer(), count=2)
    times = tmp_path / "raw" / "times3.txt"
    times.write_text(times.read_text().splitlines(keepends=True)[0])
    assert call(tmp_path, FakeServer(), count=2).written == 1
    assert Capture(tmp_path).read_time(1, 3) > 0


def test_without_pillow_nothing_is_written(tmp_path, monkeypatch):
    import sys

    for name in [name for name in sys.modules if name.startswith("PIL.")]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, "PIL", None)
    with raises(DependencyError, advice=r"pip install .*\[carla\]'"):
        call(tmp_path / "out", FakeServer(), bev=True)
    assert not (tmp_path / "out").exists()


def test_other_settings_are_refused(tmp_path):
    call(tmp_path, FakeServer(), count=1)
    with raises(ConflictError, expected="seed"):
        call(tmp_path, FakeServer(), count=1, seed=1)
    with raises(ConflictError, expected="server_version"):
        call(tmp_path, FakeServer("0.9.15"), count=1)
    (tmp_path / "else" / "raw" / "velodyne0").mkdir(parents=True)
    with raises(ConflictError, found=r"recording\.json"):
        call(tmp_path / "else", FakeServer())


def test_a_town_without_room_has_fewer_vehicles_but_the_ego_vehicle(tmp_path):
    server = FakeServer()
    server.places = 3
    result = call(tmp_path, server, count=1)
    assert result.vehicles == 2
    server = FakeServer()
    server.places = 0
    with raises(CarlascError, expected="spawn point"):
        call(tmp_path / "none", server)


def test_a_sensor_without_measurements_is_named(tmp_path):
    server = FakeServer()
    server.silent = True
    with raises(ServerError, expected="a measurement of LiDAR 0 within"):
        call(tmp_path, server, timeout_s=0.2)
    assert_cleaned_up(server)


def test_the_error_of_an_unknown_town_lists_the_towns(tmp_path):
    with raises(ArgumentError, expected="Town01, Town10HD_Opt"):
        call(tmp_path / "a", FakeServer(), town="Town99")
    assert not (tmp_path / "a").exists()


@pytest.mark.parametrize(
    "options", [{"count": 0}, {"sensors": 0}, {"seed": -1}, {"traffic": "none"}]
)
def test_arguments_out_of_range_are_refused(tmp_path, options):
    with pytest.raises(ArgumentError):
        call(tmp_path, FakeServer(), **options)


def test_bytes_and_poses_of_the_official_package_are_decoded():
    transform = carla.Transform(
        carla.Location(1.0, 2.0, 3.0), carla.Rotation(pitch=10.0, yaw=30.0, roll=5.0)
    )
    records = np.array([(1, 2, 3, 0.5, 77, 14)], DETECTION)
    assert records.dtype.itemsize == 24
    measurement = type(
        "Measurement", (), {"raw_data": records.tobytes(), "transform": transform, "timestamp": 1.5}
    )
    sweep = decode_sweep(measurement)
    assert sweep.detections["actor"].tolist() == [77] and sweep.detections["tag"].tolist() == [14]
    moved = carla.Location(1.0, 2.0, 3.0)
    moved = transform.transform(moved)
    assert np.allclose(
        transform_points(sweep.world_T_sensor, np.array([[1.0, 2, 3]])),
        [[moved.x, moved.y, moved.z]],
        atol=1e-4,
    )
    measurement.raw_data = b"abc"
    with raises(CarlascError, expected="24 bytes"):
        decode_sweep(measurement)


@pytest.mark.parametrize(
    ("text", "numbers"),
    [("0.9.13", (0, 9, 13)), ("0.9.15-dirty", (0, 9, 15)), ("0.10.0", (0, 10, 0))],
)
def test_versions_are_read(text, numbers):
    assert (
        Server(ServerOptions("127.0.0.1", 2000, timeout_s=1.0), FakeServer(text)).version_numbers
        == numbers
    )


def test_without_a_server_the_command_says_so_in_one_line(tmp_path):
    result = CliRunner().invoke(
        app, ["capture", str(tmp_path / "a"), "--port", "1", "--timeout", "1", "--count", "1"]
    )
    assert result.exit_code == 1
    assert "127.0.0.1:1" in result.stderr and "--host" in result.stderr
    assert not (tmp_path / "a").exists()


def test_the_command_records(tmp_path, monkeypatch):
    import sys

    monkeypatch.setitem(sys.modules, "carla", FakeServer())
    options = ["--count", "2", "--sensors", "2", "--traffic", "light", "--no-bev", "--json"]
    result = CliRunner().invoke(app, ["capture", str(tmp_path / "a"), *options])
    assert result.exit_code == 0, result.stderr
    assert json.loads(result.stdout)["written"] == 2
    assert PEDESTRIAN and Capture(tmp_path / "a").frames.tolist() == [0, 1]
