"""Recordings as people have them: clocks that count from power-on, values that were not filled in,
points in the world frame, names that are no times, one bad scan or pose among many.
"""

from __future__ import annotations

import bz2
import struct
import zipfile
from dataclasses import replace

import numpy as np
import pytest
from carlasc_converters.bag import Bag
from carlasc_converters.bag_messages import decompressed
from carlasc_converters.files import MAX_UNPACKED
from carlasc_converters.point_fields import (
    find_clock,
    named_fields,
    point_seconds,
    returns,
    unread,
)
from carlasc_converters.point_files import read_columns
from carlasc_converters.pose_files import read_poses, stamps_of_names
from carlasc_converters.scans import Scans
from helpers.converters import bags
from helpers.errors import raises

from carlasc.converting.assembling import Rig, VehicleMotion, read_scan
from carlasc.converting.plausibility import check_scan
from carlasc.core.geometry import quaternions_of, rotation_z, transform_points, translation
from carlasc.errors import FormatError, MissingDataError
from carlasc.testing import SimulatedDrive
from carlasc.testing.drives import world_T_sensor

DRIVE = SimulatedDrive(6, rolling=True, channels=12, columns=90)
POWER_ON_S = 523.1
COUNT = 50
SECONDS = np.linspace(0, 0.098, COUNT)


def columns_of(times, name="t"):
    return {
        "x": np.ones(len(times)),
        "y": np.ones(len(times)),
        "z": np.ones(len(times)),
        name: times,
    }


def seconds_of(columns, stamp_ns=None, unit="auto", **how):
    clock = find_clock([(columns, stamp_ns)], unit, "x", **how)
    return clock and clock.seconds(columns, returns(columns), stamp_ns, "x")


@pytest.mark.parametrize("start", [2.0, POWER_ON_S, 345678.5, 1.6e9], ids=str)
@pytest.mark.parametrize(("unit", "scale"), [("s", 1), ("ms", 1e3), ("us", 1e6), ("ns", 1e9)])
def test_times_of_any_clock_are_taken_after_the_first_point(start, unit, scale):
    seconds = seconds_of(columns_of((start + SECONDS) * scale), bags.START_NS)
    np.testing.assert_allclose(seconds, SECONDS, atol=1e-6)


def test_a_clock_near_that_of_the_messages_is_related_to_it():
    times = np.int64(bags.START_NS) + np.round((SECONDS + 0.25) * 1e9).astype(np.int64)
    np.testing.assert_allclose(
        seconds_of(columns_of(times), bags.START_NS), SECONDS + 0.25, atol=1e-8
    )


def test_a_clock_that_begins_with_the_recording_is_found_from_a_late_scan():
    early, late = columns_of(SECONDS), columns_of(SECONDS + 60.0)
    clock = find_clock([(early, None), (late, None)], "auto", "x")
    assert clock.absolute
    np.testing.assert_allclose(clock.seconds(late, returns(late), None, "x"), SECONDS, atol=1e-9)


@pytest.mark.parametrize("missing", [0.0, np.nan])
def test_times_of_points_without_a_return_do_not_count(missing):
    columns = columns_of(1.7e9 + SECONDS)
    columns["t"][::3], columns["x"][::3] = missing, np.nan
    seconds = seconds_of(columns)
    np.testing.assert_allclose(seconds, SECONDS, atol=3e-3)
    seen = np.isfinite(columns["x"])
    np.testing.assert_allclose(np.diff(seconds[seen]), np.diff(SECONDS[seen]), atol=1e-6)


def test_a_time_that_was_not_filled_in_is_that_of_the_neighbours():
    columns = columns_of(1.7e9 + SECONDS)
    columns["t"][7] = 0.0
    np.testing.assert_allclose(seconds_of(columns), SECONDS, atol=1e-6)


def test_unsigned_times_before_the_scan_do_not_overflow():
    times = np.round((SECONDS - 0.01) * 1e9).astype(np.int64).astype(np.uint32)
    np.testing.assert_allclose(seconds_of(columns_of(times)), SECONDS - 0.01, atol=1e-9)


def test_every_scan_is_checked_not_only_the_first():
    good = columns_of(np.round(SECONDS * 1e9).astype(np.int64))
    bad = columns_of(np.where(np.arange(COUNT) < 9, good["t"] + 10**10, good["t"]))
    clock = find_clock([(good, None)], "auto", "x")
    with raises(FormatError, where="x: times of points", expected="at most 3 s", found="ns"):
        clock.seconds(bad, returns(bad), None, "x")
    assert replace(clock, needed=False).seconds(bad, returns(bad), None, "x") is None


@pytest.mark.parametrize("value", [0.0, 1.7e18, np.nan])
def test_times_that_do_not_differ_are_no_times(value):
    assert seconds_of(columns_of(np.full(COUNT, value))) is None


@pytest.mark.parametrize(
    ("name", "scale", "kind"),
    [
        ("time_offset_ns", 1e9, np.uint32), ("timestamp_ns", 1e9, np.int64),
        ("t_us", 1e6, np.float32), ("curvature", 1e3, np.float32), ("ts", 1, np.float32),
        ("scalar_GpsTime", 1, np.float32), ("point_time_offset", 1, np.float32),
        ("Timestamp_msec", 1e3, np.float32),
    ],
)  # fmt: skip
def test_times_under_other_names_are_read_in_the_unit_of_the_name(name, scale, kind):
    columns = columns_of((SECONDS * scale).astype(kind), name)
    np.testing.assert_allclose(seconds_of(columns), SECONDS, atol=1e-7)


def test_seconds_and_nanoseconds_are_one_time():
    nanoseconds = 1_700_000_000_950_000_000 + np.round(SECONDS * 1e9).astype(np.int64)
    columns = columns_of(nanoseconds // 10**9, "timestamp_s")
    columns["timestamp_ns"] = nanoseconds % 10**9
    np.testing.assert_allclose(seconds_of(columns), SECONDS, atol=1e-9)
    assert unread(columns, find_clock([(columns, None)], "auto", "x")) == []


def test_a_curvature_and_a_flag_are_no_times_and_are_named():
    columns = columns_of(np.linspace(0, 0.3, COUNT), "curvature")
    columns["timestamp_valid"] = np.ones(COUNT)
    clock = find_clock([(columns, None)], "auto", "x")
    assert clock is None
    assert unread(columns, clock) == ["curvature", "timestamp_valid"]


@pytest.mark.parametrize("offset", [(500123.4, 5400321.7, 0), (0, 3000, 0), (0, 0, 1e6)])
def test_points_farther_than_a_sensor_can_see_are_refused(offset):
    columns = {axis: np.linspace(1, 9, 20) + add for axis, add in zip("xyz", offset, strict=True)}
    with raises(FormatError, where="scan", expected="frame of the sensor", advice="world frame"):
        check_scan(named_fields(columns, "scan")["points"], None, "scan")


@pytest.mark.parametrize(
    "names",
    [
        ["1600000000_200000000", "1600000000_400000000"],
        ["lidar_1600000000200000000", "lidar_1600000000400000000"],
        ["2020-09-13-12-26-40.200", "2020-09-13-12-26-40.400"],
        ["20200913_122640_200_top", "20200913_122640_400_top"],
        ["1600000000.200000", "1600000000.400000"],
        ["000007_1600000000-200000000", "000008_1600000000-400000000"],
    ],
)
def test_names_that_are_times_are_read(names):
    stamps = stamps_of_names(names)
    assert stamps.tolist() == [1_600_000_000_200_000_000, 1_600_000_000_400_000_000]


@pytest.mark.parametrize(
    "names",
    [
        ["0000000000", "0000000001"], ["000000", "000001"], ["scan8", "scan9"],
        ["2024-13-45-99-00-00", "2024-13-45-99-00-01"], ["1600000000200", "1600000000100"],
    ],
)  # fmt: skip
def test_numbers_are_no_times(names):
    assert stamps_of_names(names) is None


def write_pcd(path, columns, viewpoint=(0, 0, 0, 1, 0, 0, 0), kind="binary"):
    rows = np.rec.fromarrays(list(columns.values()), names=list(columns))
    types = [rows.dtype[name] for name in columns]
    head = (
        f"VERSION 0.7\nFIELDS {' '.join(columns)}\nSIZE {' '.join(str(t.itemsize) for t in types)}\n"
        f"TYPE {' '.join(t.kind.upper() for t in types)}\nCOUNT {' '.join('1' for _ in types)}\n"
        f"WIDTH {len(rows)}\nHEIGHT 1\nVIEWPOINT {' '.join(map(str, viewpoint))}\n"
        f"POINTS {len(rows)}\nDATA {kind}\n"
    )
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(head.encode() + rows.tobytes())


def pose_of(frame):
    return np.array(world_T_sensor(DRIVE, frame), np.float64)


def points_of(frame, pose=None):
    points = DRIVE.scan(frame).points[:, :3].astype(np.float64)
    points = points if pose is None else transform_points(pose, points)
    return dict(zip("xyz", points.astype(np.float32).T, strict=True))


@pytest.mark.parametrize("world", [True, False])
def test_the_viewpoint_of_pcd_files_is_the_pose_of_the_scan(tmp_path, world):
    apart = [translation((1500.0 * frame, 0, 0)) @ pose_of(frame) for frame in range(3)]
    for frame, pose in enumerate(apart):
        numbers = (*pose[:3, 3], *quaternions_of(pose[None, :3, :3])[0])
        write_pcd(
            tmp_path / "s" / f"{frame}.pcd", points_of(frame, pose if world else None), numbers
        )
    (recording,) = Scans(tmp_path / "s").sequences()
    np.testing.assert_allclose(recording.poses().world_T_vehicle, apart, atol=1e-9)
    for frame, handle in enumerate(recording.frames):
        (cloud,) = handle.read()
        np.testing.assert_allclose(cloud.points[:, :3], DRIVE.scan(frame).points[:, :3], atol=1e-3)
    assert recording.sensors[0].deskewed
    assert any("VIEWPOINT" in note for note in recording.notes())


@pytest.mark.parametrize("empty", [0, 3, 5])
def test_one_empty_scan_among_others_fails_alone(tmp_path, empty):
    for frame in range(DRIVE.frames):
        columns = points_of(frame) | {
            "timestamp": POWER_ON_S + 0.1 * frame + DRIVE.scan(frame).seconds
        }
        write_pcd(
            tmp_path / "s" / f"{frame}.pcd",
            {name: values[: 0 if frame == empty else None] for name, values in columns.items()},
        )
    (recording,) = Scans(tmp_path / "s").sequences()
    np.testing.assert_allclose(recording.times(), 0.1 * np.arange(DRIVE.frames), atol=2e-3)
    for frame, handle in enumerate(recording.frames):
        if frame == empty:
            with raises(FormatError, where=f"{frame}.pcd", expected="points", found="none"):
                handle.read()
        else:
            assert len(handle.read()[0].points) == len(DRIVE.scan(frame).points)


def write_tum(path, swapped=False):
    times = POWER_ON_S + 0.1 * np.arange(DRIVE.frames)
    poses = np.stack([pose_of(frame) for frame in range(DRIVE.frames)])
    w, x, y, z = quaternions_of(poses[:, :3, :3]).T
    turns = (w, x, y, z) if swapped else (x, y, z, w)
    np.savetxt(path, np.stack([times, *poses[:, :3, 3].T, *turns], axis=1), "%.12g")
    return poses


@pytest.mark.parametrize("swapped", [True, False])
def test_the_order_of_quaternions_is_the_one_with_the_ground_below(tmp_path, swapped):
    for frame in range(DRIVE.frames):
        write_pcd(
            tmp_path / "s" / f"{frame}.pcd",
            points_of(frame) | {"timestamp": POWER_ON_S + 0.1 * frame + DRIVE.scan(frame).seconds},
        )
    poses = write_tum(tmp_path / "poses.txt", swapped)
    (recording,) = Scans(tmp_path / "s", pose_file=str(tmp_path / "poses.txt")).sequences()
    np.testing.assert_allclose(recording.poses().world_T_vehicle, poses, atol=1e-9)
    assert any("w, x, y, z" in note for note in recording.notes()) == swapped


def test_one_bad_row_and_one_time_twice_are_left_out_of_poses(tmp_path):
    rows = [f"{0.1 * row:.1f} {row} 0 0 0 0 0 1" for row in range(30)]
    rows[4] = "0.4 nan nan nan 0 0 0 1"
    rows[9] = "0.9 9 0 0 0 0 0 0"
    rows.insert(20, rows[20].replace(" 20 ", " 99 "))
    (tmp_path / "poses.txt").write_text("\n".join(rows))
    found = read_poses(tmp_path / "poses.txt")
    assert found.world_T_body[:, 0, 3].tolist() == [row for row in range(30) if row not in (4, 9)]
    assert len(found.notes) == 2
    (tmp_path / "poses.txt").write_text("\n".join(rows[3:10]))
    with raises(FormatError, where="poses.txt"):
        read_poses(tmp_path / "poses.txt")


def test_poses_of_kitti360_go_by_the_numbers_of_scans(tmp_path):
    for number in (4, 5, 6):
        write_pcd(tmp_path / "s" / f"{number:010d}.pcd", points_of(0))
    rows = [[number, *translation((number, 0, 0))[:3].reshape(12)] for number in (2, 4, 8)]
    np.savetxt(tmp_path / "poses.txt", rows)
    options = {"pose_file": str(tmp_path / "poses.txt")}
    (recording,) = Scans(tmp_path / "s", **options).sequences()
    assert recording.poses().world_T_vehicle[:, 0, 3].tolist() == [4, 5, 6]
    assert recording.times() is None
    write_pcd(tmp_path / "s" / "0000000099.pcd", points_of(0))
    (recording,) = Scans(tmp_path / "s", **options).sequences()
    with raises(FormatError, where="poses.txt", expected="4 to 99", found="2 to 8"):
        recording.poses()


def test_the_folders_of_hdl_graph_slam_are_read(tmp_path):
    for frame in range(3):
        folder = tmp_path / "graph" / f"{frame:06d}"
        write_pcd(folder / "cloud.pcd", points_of(frame))
        pose = "\n".join(" ".join(map(str, row)) for row in pose_of(frame))
        (folder / "data").write_text(f"stamp 1600000000 {frame}00000000\nestimate\n{pose}\nid 1\n")
    (recording,) = Scans(tmp_path / "graph").sequences()
    assert len(recording.frames) == 3
    np.testing.assert_allclose(recording.times(), [0, 0.1, 0.2], atol=1e-9)
    np.testing.assert_allclose(
        recording.poses().world_T_vehicle, [pose_of(frame) for frame in range(3)], atol=1e-9
    )


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("a.csv", '"x","y","z"\n1,2,3\n1,2,4\n'), ("a.csv", "x;y;z\n1,0;2,0;3,0\n1;2;4\n"),
        ("a.csv", "1;2;3\n1;2;4\n"), ("a.xyz", "1 2 3\n1 2 4\n"), ("a.pts", "2\n1 2 3\n1 2 4\n"),
        ("a.pcd", "FIELDS x y z t\nSIZE 4 4 4 4\nTYPE F F F U\nWIDTH 2\nHEIGHT 1\nDATA ascii\n"
                  "1 2 3 0.0e+00\n1 2 4 1.5e+03\n"),
    ],
)  # fmt: skip
def test_tables_of_text_in_usual_spellings_are_read(tmp_path, name, text):
    (tmp_path / name).write_text(text)
    columns = read_columns(tmp_path / name)
    assert [columns[axis].tolist() for axis in "xyz"] == [[1, 1], [2, 2], [3, 4]]


@pytest.mark.parametrize("kind", ["ascii", "binary_little_endian", "binary_big_endian"])
@pytest.mark.parametrize("first", [True, False])
def test_lists_of_ply_files_are_passed_over(tmp_path, kind, first):
    order = ">" if "big" in kind else "<"
    rows, faces = [(1.0, 2.0, 3.0, [5, 6]), (1.0, 2.0, 4.0, [])], [[0, 1, 0], [1, 0]]
    vertex = (
        "element vertex 2\nproperty float x\nproperty float y\nproperty float z\n"
        "property list uchar int seen\n"
    )
    face = "element face 2\nproperty list uchar short vertex_indices\n"
    head = f"ply\nformat {kind} 1.0\n{face + vertex if first else vertex + face}end_header\n"
    if kind == "ascii":
        of_faces = "".join(f"{len(face)} {' '.join(map(str, face))}\n" for face in faces)
        of_rows = "\n".join(
            f"{x} {y} {z} {len(seen)} {' '.join(map(str, seen))}\n" for x, y, z, seen in rows
        )
        body = (of_faces + of_rows if first else of_rows + of_faces).encode()
    else:
        of_faces = b"".join(struct.pack(f"{order}B{len(f)}h", len(f), *f) for f in faces)
        of_rows = b"".join(
            struct.pack(f"{order}3fB{len(s)}i", x, y, z, len(s), *s) for x, y, z, s in rows
        )
        body = of_faces + of_rows if first else of_rows + of_faces
    (tmp_path / "a.ply").write_bytes(head.encode() + body)
    columns = read_columns(tmp_path / "a.ply")
    assert [columns[axis].tolist() for axis in "xyz"] == [[1, 1], [2, 2], [3, 4]]
    if kind != "ascii":
        (tmp_path / "a.ply").write_bytes(head.encode() + body[:12])
        with raises(FormatError, where=r"a\.ply"):
            read_columns(tmp_path / "a.ply")


def test_a_binary_file_of_five_columns_is_not_read_as_four(tmp_path):
    points = DRIVE.scan(0).points
    rows = np.tile(np.c_[points, np.arange(len(points)) % 12], (8, 1))[: len(points) * 8 // 4 * 4]
    rows.astype("<f4").tofile(tmp_path / "a.bin")
    names = ("x", "y", "z", "intensity", "ring")
    np.testing.assert_array_equal(read_columns(tmp_path / "a.bin", names)["ring"], rows[:, 4])
    with raises(FormatError, where=r"a\.bin", expected="4 columns", found="5"):
        read_columns(tmp_path / "a.bin", names[:4])


def test_an_intensity_that_is_no_number_is_zero(tmp_path):
    columns = points_of(0)
    columns["intensity"] = np.full(len(columns["x"]), np.nan, np.float32)
    write_pcd(tmp_path / "s" / "0.pcd", columns)
    (recording,) = Scans(tmp_path / "s").sequences()
    (cloud,) = recording.frames[0].read()
    assert len(cloud.points) == len(columns["x"]) and not cloud.points[:, 3].any()


@pytest.mark.parametrize(
    ("name", "tool"),
    [("a.pcap", "ouster-cli"), ("a.osf", "ouster-sdk"), ("a.lvx", "Livox"), ("a.e57", "pdal")],
)
def test_the_tool_of_the_maker_is_named_for_raw_recordings(tmp_path, name, tool):
    (tmp_path / name).write_bytes(b"raw")
    for converter, source in ((Scans, tmp_path), (Bag, tmp_path), (Bag, tmp_path / name)):
        with raises(MissingDataError if source == tmp_path else FormatError, advice=tool):
            converter(source).sequences()


@pytest.mark.parametrize("codec", ["bz2", "lz4", "zstd"])
def test_nothing_is_unpacked_beyond_its_size(codec):
    content = bytes(range(250)) * 4
    if codec == "bz2":
        packed = bz2.compress(content)
    elif codec == "lz4":
        packed = pytest.importorskip("lz4.frame").compress(content)
    else:
        packed = pytest.importorskip("backports.zstd").compress(content)
    assert decompressed(packed, codec, "x", 1000) == decompressed(packed, codec, "x") == content
    with raises(FormatError, where="x", expected="999 bytes", found="more"):
        decompressed(packed, codec, "x", 999)
    with raises(FormatError, where="x", expected="256 MiB", found="1,024 MiB"):
        decompressed(packed, codec, "x", 4 * MAX_UNPACKED)
    with raises(FormatError, where="x", expected=codec, found="damage"):
        decompressed(packed[:-9], codec, "x", 1000)


def test_a_compressed_scan_that_claims_gigabytes_is_refused(tmp_path):
    points = (1 << 32) // 16 - 1
    head = f"FIELDS x y z i\nSIZE 4 4 4 4\nTYPE F F F F\nPOINTS {points}\nDATA binary_compressed\n"
    body = struct.pack("<II", 6, points * 16) + b"\0\0\xe0\xff\0\0"
    (tmp_path / "a.pcd").write_bytes(head.encode() + body)
    with raises(FormatError, where=r"a\.pcd", expected="at most 256 MiB", found="4,095 MiB"):
        read_columns(tmp_path / "a.pcd")


def test_a_pose_that_is_none_is_left_out_and_the_bag_may_be_zipped(tmp_path):
    def messages(store):
        found = list(bags.drive_messages(store, DRIVE))
        first = next(row for row, message in enumerate(found) if message[0] == "/odom")
        bad = store.odometry("/odom", found[first][2] - 1, np.eye(4))
        bad[3].pose.pose.orientation.w = 0.0
        return [*found[:first], bad, *found[first:]]

    store = bags.Messages("mcap")
    file = bags.file_of(bags.write_bag(tmp_path, "mcap", messages(store), store=store))
    with zipfile.ZipFile(tmp_path / "drive.zip", "w") as archive:
        archive.write(file, "drive.mcap")
    for source in (file, tmp_path / "drive.zip"):
        (recording,) = Bag(source).sequences()
        found = recording.poses().at(recording.times())
        np.testing.assert_allclose(found, DRIVE.world_T_vehicle(DRIVE.times), atol=1e-9)
        said = " ".join(recording.notes())
        assert "no pose: 1 of" in said and "/chatter (String" in said


@pytest.mark.parametrize("poses", ["odometry", "tf"])
def test_points_of_a_bag_in_the_frame_of_the_world_are_refused(tmp_path, poses):
    def messages(store):
        found = bags.drive_messages(store, DRIVE, poses)
        for message in found:
            if message[0].endswith("/points"):
                message[3].header.frame_id = bags.WORLD
        return found

    store = bags.Messages("mcap")
    bag = bags.write_bag(tmp_path, "mcap", messages(store), store=store)
    (recording,) = Bag(bag).sequences()
    with raises(FormatError, expected="does not move", found=bags.WORLD, advice="sensor"):
        recording.poses()
        recording.sensors  # noqa: B018


def test_whole_data_with_a_wrong_size_of_rows_are_read():
    store = bags.Messages("db3")
    points = bags.velodyne(DRIVE.scan(0).points, DRIVE.scan(0).seconds)
    from carlasc_converters import point_fields

    message = store.cloud("/points", 1, points)[3]
    for row_step in (len(points), 7 * len(points) * points.itemsize):
        message.row_step = row_step
        columns = point_fields.read_columns(message, "message")
        np.testing.assert_array_equal(columns["x"], points["x"])


def test_the_times_of_a_survey_are_not_those_of_a_scan():
    with raises(FormatError, expected="at most 3 s", found="4414"):
        point_seconds(np.linspace(245369, 249783, 9), "s", "x")


@pytest.mark.parametrize("rolling", [True, False])
def test_a_lidar_that_moves_on_the_vehicle_is_placed_by_the_transforms(tmp_path, rolling):
    drive = replace(DRIVE, rolling=rolling, frames=4)
    mount, name = drive.sensors[0].vehicle_T_sensor, drive.sensors[0].name

    def turn(seconds):
        return rotation_z(0.8 * np.sin(4.0 * seconds))

    def messages(store):
        found = [one for one in bags.drive_messages(store, drive) if one[0] != "/tf_static"]
        found = [one for one in found if not one[0].endswith("/points")]
        for frame, seconds in enumerate(drive.times):
            scan = drive.scan(frame)
            turns = np.array([turn(seconds + after) for after in scan.seconds])
            points = scan.points.copy()
            points[:, :3] = np.einsum("nji,nj->ni", turns[:, :3, :3], points[:, :3])
            cloud = bags.velodyne(points, scan.seconds if rolling else None)
            stamp = bags.START_NS + round(seconds * 1e9)
            found.append(store.cloud(f"/{name}/points", stamp, cloud, name))
        for seconds in np.arange(-0.1, drive.times[-1] + 0.1, 0.005):
            stamp = bags.START_NS + round(seconds * 1e9)
            found.append(store.transform("/tf", stamp, bags.BASE, name, mount @ turn(seconds)))
        found.append(store.transform("/tf_static", bags.START_NS, bags.BASE, "imu", mount))
        return sorted(found, key=lambda message: message[2])

    store = bags.Messages("mcap")
    bag = bags.write_bag(tmp_path, "mcap", messages(store), store=store)
    (recording,) = Bag(bag).sequences()
    trajectory = recording.poses()
    for frame, handle in enumerate(recording.frames):
        motion = VehicleMotion(trajectory, recording.times()[frame])
        scan = read_scan(handle, Rig.of(recording), motion)
        np.testing.assert_allclose(scan.points[:, :3], drive.scan(frame).deskewed[:, :3], atol=0.01)
    said = " ".join(recording.notes())
    assert f"{name} moves on {bags.BASE}" in said
    assert f"transforms that were not used: {bags.BASE} > imu" in said


@pytest.mark.parametrize("degrees", [90, 135, 180])
def test_the_order_of_quaternions_is_found_for_any_heading(tmp_path, degrees):
    for frame in range(3):
        write_pcd(tmp_path / "s" / f"{frame}.pcd", points_of(frame))
    turn = rotation_z(np.deg2rad(degrees))
    poses = np.stack([turn @ pose_of(frame) for frame in range(3)])
    turns = quaternions_of(poses[:, :3, :3])  # w first
    np.savetxt(tmp_path / "poses.txt", np.column_stack([np.arange(3) / 10, poses[:, :3, 3], turns]))
    (recording,) = Scans(tmp_path / "s", pose_file=str(tmp_path / "poses.txt")).sequences()
    found = recording.poses()
    certain = degrees != 180  # else the ground is below in both, and the overlap of scans decides
    assert (found.other is None) == certain
    np.testing.assert_allclose(found.world_T_vehicle if certain else found.other, poses, atol=1e-9)


def test_points_in_the_frame_of_a_map_projection_keep_their_millimetres(tmp_path):
    offset = translation((500123.456, 5400321.789, 250.0))
    for frame in range(3):
        pose = offset @ pose_of(frame)
        points = transform_points(pose, DRIVE.scan(frame).points[:, :3].astype(np.float64))
        numbers = (*pose[:3, 3], *quaternions_of(pose[None, :3, :3])[0])
        columns = dict(zip("xyz", points.T, strict=True))
        write_pcd(tmp_path / "s" / f"{frame}.pcd", columns, numbers)
    (recording,) = Scans(tmp_path / "s").sequences()
    for frame, handle in enumerate(recording.frames):
        (cloud,) = handle.read()
        np.testing.assert_allclose(cloud.points[:, :3], DRIVE.scan(frame).points[:, :3], atol=1e-3)


@pytest.mark.parametrize("beside", [True, False])
def test_scans_without_labels_among_others_are_unlabelled(tmp_path, beside):
    (tmp_path / "labels").mkdir()
    for frame in range(3):
        columns, labels = points_of(frame), np.full(len(DRIVE.scan(frame).points), 40, np.uint32)
        if frame != 1 and beside:
            labels.tofile(tmp_path / "labels" / f"{frame}.label")
        elif frame != 1:
            columns["label"] = labels
        write_pcd(tmp_path / "s" / f"{frame}.pcd", columns)
    options = {"label_dir": str(tmp_path / "labels")} if beside else {}
    (recording,) = Scans(tmp_path / "s", source_classes="semantickitti", **options).sequences()
    clouds = [handle.read()[0] for handle in recording.frames]
    assert [set(cloud.labels.tolist()) for cloud in clouds] == [{40}, {0}, {40}]
    if beside:
        assert any("1 of 3 scans have no file of labels" in note for note in recording.notes())
        for file in (tmp_path / "labels").iterdir():
            file.unlink()
        (recording,) = Scans(tmp_path / "s", source_classes="semantickitti", **options).sequences()
        with raises(MissingDataError, where="labels", found="none for any scan"):
            recording.frames  # noqa: B018


def test_names_give_the_times_of_scans_whose_points_have_another_clock_than_the_poses(tmp_path):
    poses = np.zeros((9, 8))
    poses[:, 0], poses[:, 1], poses[:, 7] = 1.7e9 + 0.05 * np.arange(9), np.arange(9), 1.0
    (tmp_path / "scans").mkdir()
    for row in range(0, 9, 2):  # every other pose has a scan
        seconds = poses[row, 0] - 1.7e9 + POWER_ON_S + SECONDS
        table = np.zeros(COUNT, [*((name, "<f4") for name in "xyz"), ("time", "<f8")])
        table["x"], table["time"] = 5.0, seconds * 1e3
        np.save(tmp_path / "scans" / f"{poses[row, 0]:.6f}.npy", table)
    np.savetxt(tmp_path / "poses.txt", poses, fmt="%.6f")
    (recording,) = Scans(tmp_path / "scans", pose_file=str(tmp_path / "poses.txt")).sequences()
    assert any("the names of the files" in note for note in recording.notes())
    np.testing.assert_allclose(recording.times(), 0.1 * np.arange(5), atol=1e-6)
