import pickle
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from carlasc_converters.paris_carla import ParisCarla3D, ParisCarlaTown, headings
from converters.formats.paris_carla import (
    FIRST_ACTOR,
    FIRST_SCAN,
    ROW,
    TAG_OF_KIND,
    header,
    in_world,
    scan_rows,
    write_rows,
    write_town,
)

import carlasc
from carlasc.converting import LayoutOptions, convert
from carlasc.core.geometry import relative_to, transform_points
from carlasc.errors import CarlascError, FormatError, MissingDataError
from carlasc.running import Run
from carlasc.testing.drives import SimulatedDrive

DRIVE = SimulatedDrive(frames=6, rolling=True)


@pytest.fixture(scope="module")
def town(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_town(tmp_path_factory.mktemp("paris") / "Town03.ply", DRIVE)


def recording(path: Path) -> ParisCarlaTown:
    found = ParisCarla3D(path).sequences()[0]
    assert isinstance(found, ParisCarlaTown)
    return found


def test_scans_are_the_groups_of_the_file_with_everything_that_was_written(town: Path) -> None:
    found = recording(town)
    assert [frame.number for frame in found.frames] == list(range(DRIVE.frames))
    trajectory = found.poses()
    for frame in found.frames:
        truth, time = DRIVE.scan(frame.number), found.times()[frame.number]
        (cloud,) = pickle.loads(pickle.dumps(frame)).read()
        assert cloud.origins is not None
        assert cloud.seconds is not None
        pose = trajectory.at(found.times())[frame.number]
        np.testing.assert_allclose(
            transform_points(pose, cloud.points[:, :3]), in_world(truth), atol=1e-5
        )
        np.testing.assert_allclose(
            transform_points(pose, cloud.origins), truth.world_T_sensor[:, :3, 3], atol=1e-5
        )
        np.testing.assert_allclose(
            cloud.seconds, frame.number * DRIVE.period_s + truth.seconds - time, atol=1e-6
        )
        np.testing.assert_array_equal(cloud.labels, TAG_OF_KIND[truth.kinds])
        expected = np.where(truth.instances > 0, truth.instances + FIRST_ACTOR, 0)
        np.testing.assert_array_equal(cloud.instances, expected)
        assert expected.any()
        assert cloud.points.dtype == cloud.origins.dtype == np.float32


def test_a_scan_is_given_where_the_sensor_was_in_its_middle_headed_as_it_drives(town: Path) -> None:
    found = recording(town)
    mount = DRIVE.sensors[0].vehicle_T_sensor
    poses, times = found.poses().world_T_vehicle, found.times()
    np.testing.assert_allclose(times, DRIVE.times, atol=DRIVE.period_s / 4)
    truth = DRIVE.world_T_vehicle(times) @ mount
    np.testing.assert_allclose(poses[:, :3, 3], truth[:, :3, 3], atol=1e-5)
    np.testing.assert_allclose(poses[:, :3, :3], truth[:, :3, :3], atol=0.02)
    np.testing.assert_array_equal(poses[:, 2, :3], np.tile([0, 0, 1], (len(poses), 1)))  # upright
    (cloud,) = found.frames[2].read()
    assert cloud.origins is not None
    assert np.ptp(cloud.origins[:, 0]) > 0.4  # the sensor moved while it turned
    assert np.abs(cloud.origins).max() < 0.5


def test_a_vehicle_that_stands_keeps_its_heading() -> None:
    way = np.array([0, 0, 0, 0.8, 1.6, 2.4, 2.4, 2.4, *[2.4] * 60, 2.4, 2.4])
    positions = np.stack([np.zeros_like(way), way, np.zeros_like(way)], axis=1)
    np.testing.assert_allclose(headings(positions), np.pi / 2)
    np.testing.assert_array_equal(headings(np.zeros((4, 3))), 0)
    circle = np.linspace(0, 1, 50)
    around = np.stack([20 * np.cos(circle), 20 * np.sin(circle), circle], axis=1)
    np.testing.assert_allclose(headings(around)[5:-5], circle[5:-5] + np.pi / 2, atol=1e-6)


def test_the_rows_of_a_scan_may_be_in_several_places(town: Path, tmp_path: Path) -> None:
    rows = [scan_rows(DRIVE, frame) for frame in range(DRIVE.frames)]
    parts = [part for scan in rows[:4] for part in (scan[:100],)] + [
        scan[100:] for scan in rows[:4]
    ]
    write_rows(tmp_path / "Town03.ply", np.concatenate(parts))
    found, whole = recording(tmp_path), recording(town)
    assert len(found.frames) == 4
    np.testing.assert_allclose(found.times(), whole.times()[:4])
    for frame, other in zip(found.frames[1:3], whole.frames[1:3], strict=True):
        np.testing.assert_allclose(frame.read()[0].points, other.read()[0].points, atol=1e-5)


def test_towns_are_found_below_the_folder_with_the_splits_of_the_paper(tmp_path: Path) -> None:
    rows = scan_rows(DRIVE, 0)[:10]
    for name in ("Town01", "Town02", "Town06", "Soufflot_0"):
        (tmp_path / "CARLA" / name).mkdir(parents=True)
        write_rows(tmp_path / "CARLA" / name / f"{name}.ply", rows)
    found = {town.name: town.split for town in ParisCarla3D(tmp_path).sequences()}
    assert found == {
        "PARISCARLA_Town01": "Test",
        "PARISCARLA_Town02": "Train",
        "PARISCARLA_Town06": "Val",
    }


def test_notes_say_what_the_licence_forbids(town: Path) -> None:
    assert any("must not be shared" in note for note in recording(town).notes())


def test_a_conversion_keeps_points_times_and_where_rays_began(town: Path, tmp_path: Path) -> None:
    result = convert(
        "paris-carla-3d",
        town.parent,
        tmp_path,
        layout=LayoutOptions(axes="right"),
        grids=None,
        run=Run(workers=1),
    )
    assert result.failures == ()
    assert any("CC BY-NC-ND" in note for note in result.notes)
    (sequence,) = carlasc.open(tmp_path).sequences().values()
    found = recording(town)
    np.testing.assert_allclose(sequence.times, found.times() - found.times()[0], atol=1e-12)
    world = found.poses().world_T_vehicle
    np.testing.assert_allclose(sequence.poses, relative_to(world[0], world), atol=1e-12)
    (cloud,) = found.frames[3].read()
    np.testing.assert_array_equal(sequence.read("points", 3), cloud.points)
    np.testing.assert_array_equal(sequence.read("labels", 3), cloud.labels)
    np.testing.assert_array_equal(sequence.read("instances", 3), cloud.instances)
    np.testing.assert_array_equal(sequence.read("origins", 3), cloud.origins)
    np.testing.assert_allclose(sequence.read("seconds", 3), cloud.seconds, atol=1e-8)
    speeds = np.linalg.norm(sequence.read("flow", 3), axis=1)
    car = cloud.instances == FIRST_ACTOR + 1  # drives ahead at 8 m/s
    assert car.sum() > 10
    np.testing.assert_allclose(speeds[car], 8.0, atol=0.8)


def test_an_interrupted_conversion_goes_on_to_the_same_bytes(town: Path, tmp_path: Path) -> None:
    for out in (tmp_path / "whole", tmp_path / "broken"):
        convert("paris-carla-3d", town, out, grids=None, run=Run(workers=1))
    for path in (tmp_path / "broken").rglob("000002.*"):
        path.unlink()
    result = convert("paris-carla-3d", town, tmp_path / "broken", grids=None, run=Run(workers=1))
    assert result.made == 1
    for path in (path for path in (tmp_path / "whole").rglob("*") if path.is_file()):
        assert (
            tmp_path / "broken" / path.relative_to(tmp_path / "whole")
        ).read_bytes() == path.read_bytes()


def text_file(path: Path) -> None:
    path.write_bytes(path.read_bytes().replace(b"binary_little_endian", b"ascii"))


def other_version(path: Path) -> None:
    path.write_bytes(path.read_bytes().replace(b"uint index_frame", b"uint frame"))


def cut(path: Path) -> None:
    path.write_bytes(path.read_bytes()[:-30])


def empty(path: Path) -> None:
    write_rows(path, np.zeros(0, ROW))


def scattered(path: Path) -> None:
    rows = np.zeros(1_100_000, ROW)
    rows["index_frame"] = np.arange(len(rows)) % 2
    write_rows(path, rows)


def no_times(path: Path) -> None:
    rows = np.concatenate([scan_rows(DRIVE, 0), scan_rows(DRIVE, 1)])
    rows["timestamp"] = 0
    write_rows(path, rows)


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (text_file, "Town03.ply: expected a binary PLY file, found a text file"),
        (other_version, "Town03.ply: expected vertices with index_frame"),
        (cut, "the file is incomplete"),
        (empty, "Town03.ply: expected points, found none"),
        (scattered, "the rows of each scan (index_frame) one after the other"),
        (
            no_times,
            f"expected times that increase from scan to scan, found none from scan {FIRST_SCAN} to "
            f"{FIRST_SCAN + 1}",
        ),
    ],
)
def test_a_wrong_file_is_named_in_one_line(tmp_path: Path, spoil: object, message: str) -> None:
    assert callable(spoil)
    spoil(
        path := write_town(
            tmp_path / "Town03.ply", SimulatedDrive(frames=1, rolling=True, channels=4, columns=20)
        )
    )
    with pytest.raises(CarlascError) as error:
        recording(path).frames[0].read()
    assert isinstance(error.value, FormatError)
    assert message in str(error.value)
    assert "\n" not in str(error.value)


def test_a_folder_without_towns_is_refused(tmp_path: Path) -> None:
    with pytest.raises(MissingDataError, match=r"files such as Town01\.ply"):
        ParisCarla3D(tmp_path).sequences()


MEASURE = """
import sys, time
from pathlib import Path
from carlasc_converters.paris_carla import ParisCarla3D
start = time.perf_counter()
town = ParisCarla3D(Path(sys.argv[1])).sequences()[0]
frames, _ = town.frames, town.poses()
indexed = time.perf_counter() - start
points = sum(len(frame.read()[0].points) for frame in frames[::int(sys.argv[2])])
peak = int(Path("/proc/self/status").read_text().partition("VmHWM:")[2].split()[0])
print(len(frames), points, peak // 1024, round(indexed, 1), round(time.perf_counter() - start - indexed, 1))
"""


def write_large(path: Path, scans: int, points: int) -> None:
    """Write a file of `scans` times `points` rows, in which only what the index needs differs from
    0.
    """
    with path.open("wb") as file:
        file.write(header(scans * points))
        rows = np.zeros(points, ROW)
        for scan in range(scans):
            rows["index_frame"], rows["timestamp"] = scan, 0.1 * scan
            rows["x_lidar_position"] = 0.5 * scan
            file.write(rows.tobytes())


@pytest.mark.slow
@pytest.mark.skipif(
    not Path("/proc/self/status").exists(), reason="reads the peak memory of a process from Linux"
)
def test_a_large_file_is_read_in_little_memory(tmp_path: Path) -> None:
    path = tmp_path / "Town01.ply"
    write_large(path, 400, 50_000)  # 20 million points, 1 GB
    command = [sys.executable, "-c", MEASURE, str(path), "1"]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    path.unlink()
    frames, points, peak_mib = map(int, done.stdout.split()[:3])
    assert (frames, points) == (400, 20_000_000)
    assert peak_mib < 350  # most of it is Python with NumPy and numba
