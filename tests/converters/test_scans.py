"""Folders of scans: every format there and back, poses and times of every kind, what is found out,
and what is refused.
"""

from __future__ import annotations

import json

import numpy as np
import pytest
from carlasc_converters.scans import Scans
from helpers.converters import bags
from helpers.converters.scan_writers import PCD, write_poses, write_scan
from helpers.errors import raises

import carlasc
from carlasc import GridSpec, Run
from carlasc.converting import LayoutOptions, Sensor, convert
from carlasc.core.geometry import quaternions_of, rotation_z, translation
from carlasc.errors import ArgumentError, FormatError, MissingDataError
from carlasc.groundtruth import GridOptions
from carlasc.motion import PoseOptions
from carlasc.testing import KINDS, ConverterContract, SimulatedDrive
from carlasc.testing.drives import world_T_sensor

IDS = {
    "road": 7,
    "building": 1,
    "car": 10,
    "van": 10,
    "pedestrian": 4,
    "cyclist": 10,
    "pole": 5,
    "vegetation": 9,
}
START_NS = 1_700_000_000_123_456_789
DRIVE = SimulatedDrive(6, rolling=True, channels=12, columns=90)


def fields_of(drive, frame, ids=None, sensor=0):
    scan = drive.scan(frame, sensor)
    fields = dict(zip(("x", "y", "z", "intensity"), scan.points.T, strict=True)) | {
        "time": scan.seconds
    }
    if ids is not None:
        lookup = np.array([ids.get(kind, 0) for kind in KINDS], np.uint32)
        fields |= {"label": lookup[scan.kinds], "instance": scan.instances}
    return fields


def poses_of(drive):
    return np.stack([world_T_sensor(drive, frame) for frame in range(drive.frames)])


def write_drive(folder, drive, suffix, ids=None, poses="tum", **how):
    """Write scans/, poses of the sensor, times.txt."""
    for frame in range(drive.frames):
        write_scan(
            folder / "scans" / f"scan{frame + 8}{suffix}", fields_of(drive, frame, ids), **how
        )
    seconds = START_NS / 1e9 + drive.times
    write_poses(folder / f"poses.{poses}", poses_of(drive), seconds, poses)
    np.savetxt(folder / "times.txt", seconds, "%.17g")
    return folder / "scans"


class ScansContract(ConverterContract):
    converter = "scans"
    ids = IDS
    drive = SimulatedDrive(8)
    keeps = frozenset({"labels", "instances", "poses", "times", "seconds"})
    suffix, kind, how = ".npy", "tum", {}

    def write(self, folder):
        write_drive(folder, self.drive, self.suffix, IDS, self.kind, **self.how)
        type(self).options = {
            "pose_file": str(folder / f"poses.{self.kind}"),
            "time_file": str(folder / "times.txt"),
            "source_classes": "carla",
        }


class TestNpy(ScansContract):
    pass


@pytest.mark.needs("open3d")
class TestPcd(ScansContract):
    drive = SimulatedDrive(8, rolling=True)
    keeps = frozenset({"labels", "poses", "times", "seconds"})
    points_m = 2e-2  # moved to the time of the frame by poses at 10 Hz
    suffix, kind, how = ".pcd", "csv", PCD["compressed"]


FORMATS = [
    (".bin", {}),
    (".npy", {}),
    (".npz", {}),
    (".csv", {}),
    pytest.param(".ply", {}, marks=pytest.mark.needs("open3d")),
    *(
        pytest.param(".pcd", how, marks=pytest.mark.needs("open3d"), id=f"pcd-{name}")
        for name, how in PCD.items()
    ),
    pytest.param(".las", {}, marks=pytest.mark.needs("laspy")),
    pytest.param(".laz", {}, marks=pytest.mark.needs("laspy", "lazrs")),
]


@pytest.mark.parametrize(("suffix", "how"), FORMATS)
def test_points_and_their_times_come_back_from_every_format(tmp_path, suffix, how):
    scans = write_drive(tmp_path, DRIVE, suffix, **how)
    options = {"deskewed": True, "columns": "x,y,z,intensity,time" if suffix == ".bin" else ""}
    (recording,) = Scans(scans, **options).sequences()
    assert [frame.location.rpartition("/")[2] for frame in recording.frames] == [
        f"scan{number}{suffix}" for number in range(8, 8 + DRIVE.frames)
    ]
    for number, frame in enumerate(recording.frames):
        (cloud,) = frame.read()
        truth = DRIVE.scan(number)
        if suffix in (".las", ".laz"):
            np.testing.assert_allclose(cloud.points[:, :3], truth.points[:, :3], atol=5.1e-5)
        else:
            np.testing.assert_array_equal(cloud.points, truth.points)
        np.testing.assert_allclose(cloud.seconds, truth.seconds, atol=1e-6)


@pytest.mark.parametrize("kind", ["tum", "kitti", "euroc", "csv", "npy"])
def test_poses_come_back_from_every_format(tmp_path, kind):
    scans = write_drive(tmp_path, DRIVE, ".npy", poses=kind)
    options = {
        "pose_file": str(tmp_path / f"poses.{kind}"),
        "time_file": str(tmp_path / "times.txt"),
    }
    (recording,) = Scans(scans, pose_of="sensor", **options).sequences()
    trajectory = recording.poses()
    np.testing.assert_allclose(trajectory.world_T_vehicle, poses_of(DRIVE), atol=1e-9)
    if trajectory.seconds is not None:
        np.testing.assert_allclose(trajectory.seconds, DRIVE.times, atol=1e-6)


def test_poses_of_the_vehicle_and_several_lidars_go_by_the_calibration(tmp_path):
    sensors = (
        Sensor("top", translation((0.2, 0, 1.6)) @ rotation_z(0.3)),
        Sensor("left", translation((0, 0.8, 1.0)) @ rotation_z(1.2)),
    )
    drive = SimulatedDrive(4, sensors=sensors, channels=8, columns=60)
    for frame in range(drive.frames):
        for index, sensor in enumerate(sensors):
            fields = fields_of(drive, frame, sensor=index)
            del fields["time"]
            write_scan(tmp_path / "in" / sensor.name / f"{frame}.npy", fields)
    records = {"top": {"matrix": sensors[0].vehicle_T_sensor.tolist()}}
    half = 0.6
    records["left"] = {
        "translation": [0, 0.8, 1.0],
        "rotation": [0, 0, float(np.sin(half)), float(np.cos(half))],
    }
    (tmp_path / "rig.json").write_text(json.dumps({"sensors": records}))
    truth = drive.world_T_vehicle(drive.times)
    write_poses(tmp_path / "poses.euroc", truth, drive.times + 100, "euroc")
    options = {
        "pose_file": str(tmp_path / "poses.euroc"),
        "calibration": str(tmp_path / "rig.json"),
    }
    (recording,) = Scans(tmp_path / "in", **options).sequences()
    for found, sensor in zip(recording.sensors, sensors, strict=True):
        assert found.name == sensor.name
        np.testing.assert_allclose(found.vehicle_T_sensor, sensor.vehicle_T_sensor, atol=1e-12)
    np.testing.assert_allclose(recording.poses().world_T_vehicle, truth, atol=1e-9)
    clouds = recording.frames[2].read()
    assert [cloud.sensor for cloud in clouds] == [0, 1]
    np.testing.assert_array_equal(clouds[1].points, drive.scan(2, 1).points)
    with raises(MissingDataError, expected="`calibration`, because these are poses of the vehicle"):
        Scans(tmp_path / "in/top", pose_file=options["pose_file"]).sequences()[0].poses()


@pytest.mark.parametrize(("axes", "signs"), [("fru", (1, -1, 1)), ("frd", (1, -1, -1))])
def test_other_axes_give_the_same_points_and_poses(tmp_path, axes, signs):
    turn = np.diag([*signs, 1.0])
    for frame in range(DRIVE.frames):
        fields = fields_of(DRIVE, frame)
        fields |= {
            name: fields[name] * np.float32(sign) for name, sign in zip("xyz", signs, strict=True)
        }
        write_scan(tmp_path / "in" / f"{frame}.npy", fields)
    write_poses(tmp_path / "poses.kitti", turn @ poses_of(DRIVE) @ turn, DRIVE.times, "kitti")
    (recording,) = Scans(
        tmp_path / "in", source_axes=axes, pose_file=str(tmp_path / "poses.kitti")
    ).sequences()
    np.testing.assert_allclose(recording.poses().world_T_vehicle, poses_of(DRIVE), atol=1e-12)
    np.testing.assert_array_equal(recording.frames[3].read()[0].points, DRIVE.scan(3).points)


def test_times_are_found_in_points_and_in_names_and_it_is_said(tmp_path):
    stamps = START_NS + (DRIVE.times * 1e9).astype(np.int64)
    for frame, stamp in enumerate(stamps.tolist()):
        fields = fields_of(DRIVE, frame)
        own = np.round((fields["time"] - fields["time"].min()) * 1e9).astype(np.int64)
        write_scan(tmp_path / "clock" / f"{frame}.npy", fields | {"time": own + stamp})
        del fields["time"]
        write_scan(tmp_path / "names" / f"{stamp}.npy", fields)
    (clock,), (names,) = (
        Scans(tmp_path / "clock").sequences(),
        Scans(tmp_path / "names").sequences(),
    )
    np.testing.assert_allclose(clock.times(), DRIVE.times, atol=1e-9)
    np.testing.assert_allclose(names.times(), DRIVE.times, atol=1e-9)
    assert clock.frames[2].read()[0].seconds.min() == 0
    assert (
        "the times of points are in ns, because scans then have a usual duration" in clock.notes()
    )
    assert "the times of scans are from the names of the files" in names.notes()


def test_points_that_hit_nothing_are_left_out_with_their_labels(tmp_path):
    points = np.array([[1, 2, 3], [np.nan, 0, 0], [4, 5, 6]], np.float32)
    (tmp_path / "in").mkdir()
    (tmp_path / "labels").mkdir()
    np.save(tmp_path / "in/a.npy", points)
    np.array([1, 2, (9 << 16) + 3], np.uint32).tofile(tmp_path / "labels/a.label")
    (recording,) = Scans(
        tmp_path / "in", label_dir=str(tmp_path / "labels"), source_classes="carla"
    ).sequences()
    (cloud,) = recording.frames[0].read()
    assert cloud.points.tolist() == [[1, 2, 3, 0], [4, 5, 6, 0]]
    assert cloud.labels.tolist() == [1, 3]


def test_a_table_of_ones_own_keeps_its_ids(tmp_path):
    own = {
        "name": "mine",
        "names": {"0": "none", "1": "thing"},
        "colors": {"0": [0, 0, 0], "1": [9, 9, 9]},
    }
    (tmp_path / "mine.json").write_text(json.dumps(own))
    write_scan(
        tmp_path / "in/a.npy", {name: np.ones(5, np.float32) for name in ("x", "y", "z", "label")}
    )
    given = {"source_classes": str(tmp_path / "mine.json")}
    with raises(ArgumentError, where="classes", expected="mine, because no map to CarlaSC"):
        convert(
            "scans",
            tmp_path / "in",
            tmp_path / "out",
            options=given,
            grids=None,
            run=Run(workers=1),
        )
    kept = LayoutOptions(classes="mine")
    poses = PoseOptions(force=True)
    np.save(tmp_path / "p.npy", np.eye(4)[None])
    given["pose_file"] = str(tmp_path / "p.npy")
    convert(
        "scans",
        tmp_path / "in",
        tmp_path / "out",
        layout=kept,
        poses=poses,
        options=given,
        grids=None,
        run=Run(1),
    )
    (sequence,) = carlasc.open(tmp_path / "out").sequences().values()
    assert sequence.read("labels", 0).tolist() == [1] * 5


def test_the_folder_and_the_poses_of_any_format_give_the_same_grids_byte_for_byte(tmp_path):
    spec, grids = GridSpec.published().with_size((32, 32, 4)), []
    for suffix, kind in ((".npy", "tum"), (".npz", "csv")):
        folder = tmp_path / suffix[1:]
        scans = write_drive(folder, DRIVE, suffix, poses=kind)
        given = {"pose_file": str(folder / f"poses.{kind}"), "time_file": str(folder / "times.txt")}
        out = tmp_path / f"{suffix[1:]}.out"
        assert (
            convert(
                "scans", scans, out, grids=GridOptions(spec), options=given, run=Run(workers=1)
            ).failures
            == ()
        )
        grids.append({file.name: file.read_bytes() for file in out.glob("**/evaluation*/0*")})
    assert len(grids[0]) >= 2 * DRIVE.frames
    assert grids[0] == grids[1]


@pytest.mark.slow
@pytest.mark.needs("rosbags")
def test_the_folder_and_the_bag_give_the_same_grids_byte_for_byte(tmp_path):
    store, spec = bags.Messages("mcap"), GridSpec.published().with_size((32, 32, 4))
    (sensor,) = DRIVE.sensors
    bag = bags.write_bag(tmp_path, "mcap", bags.drive_messages(store, DRIVE), store=store)
    stamps = bags.START_NS + np.round(DRIVE.times * 1e9).astype(np.int64)
    for frame, stamp in enumerate(stamps.tolist()):
        fields = fields_of(DRIVE, frame)
        write_scan(
            tmp_path / f"scans/{stamp}.npy", fields | {"time": fields["time"].astype(np.float32)}
        )
    times = np.arange(-0.1, DRIVE.times[-1] + 0.2, DRIVE.period_s / 2)
    times[np.abs(times[:, None] - DRIVE.times).argmin(axis=0)] = DRIVE.times
    write_poses(
        tmp_path / "poses.euroc", DRIVE.world_T_vehicle(times), times, "euroc", bags.START_NS
    )
    w, x, y, z = quaternions_of(sensor.vehicle_T_sensor[None, :3, :3])[0].tolist()
    place = {"translation": sensor.vehicle_T_sensor[:3, 3].tolist(), "rotation": [x, y, z, w]}
    (tmp_path / "rig.json").write_text(json.dumps({"sensors": {sensor.name: place}}))
    given = {"pose_file": str(tmp_path / "poses.euroc"), "calibration": str(tmp_path / "rig.json")}
    grids = []
    for name, source, options in (("bag", bag, {}), ("scans", tmp_path / "scans", given)):
        out = tmp_path / f"{name}.out"
        assert (
            convert(
                name, source, out, grids=GridOptions(spec), options=options, run=Run(workers=1)
            ).failures
            == ()
        )
        grids.append({file.name: file.read_bytes() for file in out.glob("**/evaluation*/0*")})
    assert len(grids[0]) >= 2 * DRIVE.frames
    assert grids[0] == grids[1]


@pytest.fixture
def folder(tmp_path):
    write_drive(tmp_path, DRIVE, ".npy")
    return tmp_path


def refused(folder, error, message, **options):
    def look():
        (recording,) = Scans(folder / "scans", **options).sequences()
        return recording.poses(), recording.times(), [frame.read() for frame in recording.frames]

    with pytest.raises(error, match=message) as found:
        look()
    assert "\n" not in str(found.value)


def test_scans_that_do_not_fit_are_refused_in_one_line(folder):
    first = folder / "scans/scan8.npy"
    good = first.read_bytes()
    np.save(folder / "scans/scan9.npy", np.zeros((4, 3), np.float32))
    refused(
        folder,
        FormatError,
        r"scan9.npy: expected the fields of the first scan \(points, time\), found points",
    )
    np.save(folder / "scans/scan9.npy", np.zeros((0, 4), np.float32))
    refused(folder, FormatError, r"scan9.npy: expected points, found none")
    write_scan(folder / "scans/scan9.npz", fields_of(DRIVE, 0))
    refused(folder, FormatError, r"scans: expected scans of one format, found 6 .npy, 1 .npz")
    (folder / "scans/scan9.npz").unlink()
    first.write_bytes(good[:60])
    refused(folder, FormatError, r"scan8.npy: expected a .npy array, found something else \(EOF")
    for path in (folder / "scans").iterdir():
        path.unlink()
    refused(folder, MissingDataError, r"scans: expected scans: files with the suffix .bin")
    np.zeros((10, 6), np.float32).tofile(folder / "scans/a.bin")
    refused(
        folder,
        ArgumentError,
        r"columns: expected the names .* are points of 3 or 4 or 5 or 6 or 10 or 12 float32",
    )
    refused(
        folder,
        FormatError,
        r"a.bin: expected a multiple of 28 bytes .*found 240",
        columns="x,y,z,i,t,ring,label",
    )


def test_an_archive_that_would_fill_the_memory_is_refused(tmp_path):
    (tmp_path / "scans").mkdir()
    np.savez_compressed(tmp_path / "scans/a.npz", points=np.zeros((5_000_000, 4), np.float32))
    refused(
        tmp_path,
        FormatError,
        r"a.npz: points: expected at most 100 times .* made to fill the memory",
    )
    np.savez(tmp_path / "scans/a.npz", points=np.ones((5, 3), np.float32), note=np.array("by hand"))
    assert len(Scans(tmp_path / "scans").sequences()[0].frames[0].read()[0].points) == 5


def test_poses_and_times_that_do_not_fit_are_refused_in_one_line(folder):
    poses, times = str(folder / "poses.tum"), str(folder / "times.txt")
    lines = (folder / "poses.tum").read_text().splitlines()
    (folder / "few.txt").write_text("\n".join(lines[:4]))
    refused(
        folder,
        FormatError,
        "few.txt: expected a pose for each of 6 scans, found 3",
        pose_file=str(folder / "few.txt"),
    )
    (folder / "late.txt").write_text("\n".join(str(float(t) + 500) for t in DRIVE.times))
    message = r"poses.tum: expected poses over the time of the scans, 500.000 to 500.500 s, found poses over 1700000000"
    refused(folder, FormatError, message, pose_file=poses, time_file=str(folder / "late.txt"))
    (folder / "long.txt").write_text("0 0 0 0 0 0 0 2\n")
    refused(
        folder,
        FormatError,
        "long.txt: expected a rotation: a quaternion",
        pose_file=str(folder / "long.txt"),
    )
    (folder / "words.txt").write_text("a b c\n1 2 3\n")
    refused(
        folder,
        FormatError,
        "words.txt: expected the columns x, y, z",
        pose_file=str(folder / "words.txt"),
    )
    (folder / "back.txt").write_text("\n".join([lines[2], lines[1]]))
    refused(
        folder,
        FormatError,
        "back.txt: expected times that increase",
        pose_file=str(folder / "back.txt"),
    )
    (folder / "short.txt").write_text("1\n2\n")
    refused(
        folder,
        FormatError,
        "short.txt: expected a time for each of 6 scans",
        time_file=str(folder / "short.txt"),
    )
    refused(
        folder,
        MissingDataError,
        "none.txt: expected poses as text, found nothing",
        pose_file=str(folder / "none.txt"),
    )
    refused(folder, ArgumentError, "source_axes: expected directions", source_axes="xyz")
    assert times


def test_labels_that_do_not_fit_are_refused_in_one_line(folder):
    labels = folder / "labels"
    refused(
        folder, ArgumentError, "source_classes: expected the class table", label_dir=str(labels)
    )
    given = {"label_dir": str(labels), "source_classes": "carla"}
    refused(
        folder,
        MissingDataError,
        "labels: expected a file .label, .npy, .txt for each scan, found none for",
        **given,
    )
    labels.mkdir()
    for frame in range(DRIVE.frames):
        np.save(labels / f"scan{frame + 8}.npy", np.zeros(3, np.uint8))
    refused(
        folder, FormatError, r"scan8.npy: expected a label for each of \d+ points, found 3", **given
    )
    refused(
        folder, ArgumentError, "source_classes: expected one of carla", source_classes="nothing"
    )


def test_classes_outside_of_the_table_are_failures_of_their_frames(tmp_path):
    scans = write_drive(tmp_path, DRIVE, ".npy", {"road": 77})
    given = {"source_classes": "carla", "pose_file": str(tmp_path / "poses.tum")}
    result = convert(
        "scans", scans, tmp_path / "out", options=given, grids=None, run=Run(workers=1)
    )
    assert "expected class ids of carla, found 77" in result.failures[0].message


def test_a_folder_that_another_converter_reads_names_it(tmp_path):
    (tmp_path / "in/sensors").mkdir(parents=True)
    write_scan(tmp_path / "in/a.npy", fields_of(DRIVE, 0))
    with raises(MissingDataError, advice="use `carlasc convert scans`, which can read this folder"):
        convert("argoverse2", tmp_path / "in", tmp_path / "out", run=Run(workers=1))
    options = {"pose_file": str(tmp_path / "p.npy")}
    np.save(tmp_path / "p.npy", np.eye(4)[None])
    convert(
        "scans", tmp_path / "in", tmp_path / "own", grids=None, options=options, run=Run(workers=1)
    )
    with raises(MissingDataError, advice="this folder has CarlaSC.s layout already"):
        convert("argoverse2", tmp_path / "own", tmp_path / "out", run=Run(workers=1))


def test_scans_of_two_lidars_in_one_folder_are_refused(tmp_path):
    for name in ("front_0", "front_1", "rear_0", "rear_1"):
        np.save(tmp_path / f"{name}.npy", np.ones((9, 3), np.float32))
    with raises(FormatError, where=str(tmp_path), found="front_#, rear_#"):
        Scans(tmp_path).sequences()
    (tmp_path / "rear_0.npy").rename(tmp_path / "rear_2.npy")
    (tmp_path / "rear_1.npy").rename(tmp_path / "rear_3.npy")
    assert len(Scans(tmp_path).sequences()) == 1  # the end of the drive may have another name
