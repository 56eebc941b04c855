"""KITTI's tracking benchmark: what is read of a simulated drive in its layout, what is said of
wrong files, and the real sample.
"""

import re
import shutil
import tarfile
from pathlib import Path

import numpy as np
import pytest
from carlasc_converters.kitti_boxes import KITTI
from carlasc_converters.kitti_tracking import PERIOD_S, KittiTracking
from converters.formats.kitti_drive import small_drive
from converters.formats.kitti_tracking import OFFICIAL, OTHER, write_tracking

import carlasc
from carlasc.converting import LayoutOptions, convert
from carlasc.core.geometry import invert, transform_points
from carlasc.errors import FormatError, MissingDataError
from carlasc.motion import PoseOptions
from carlasc.running import Run

LABELS = {
    kind: KITTI.id_of(name)
    for kind, name in (
        ("car", "Car"),
        ("van", "Van"),
        ("pedestrian", "Pedestrian"),
        ("cyclist", "Cyclist"),
    )
}
TRUTH = small_drive()
FIRST = 20


@pytest.fixture(scope="module")
def root(tmp_path_factory):
    folder = tmp_path_factory.mktemp("tracking")
    write_tracking(folder, TRUTH, LABELS, first=FIRST)
    return folder


@pytest.fixture
def copy(root, tmp_path):
    """The part "training" of a data set that a test may damage."""
    return shutil.copytree(root, tmp_path / "copy") / "training"


def recording_of(folder):
    (recording,) = KittiTracking(folder).sequences()
    return recording


def test_points_are_kept_and_their_times_are_those_of_the_sweep(root):
    recording = recording_of(root)
    assert [frame.number for frame in recording.frames] == list(range(FIRST, FIRST + TRUTH.frames))
    for frame in recording.frames:
        (cloud,) = frame.read()
        scan = TRUTH.scan(frame.number - FIRST)
        assert cloud.points.tobytes() == scan.points.tobytes()
        assert np.abs(cloud.seconds - scan.seconds).max() < 1e-6
    assert not recording.sensors[0].deskewed


def test_a_point_in_the_sensor_is_kept(copy):
    path = copy / f"velodyne/0000/{FIRST:06d}.bin"
    points = np.vstack([TRUTH.scan(0).points, np.zeros((1, 4), np.float32)])
    points.tofile(path)
    (cloud,) = recording_of(copy).frames[0].read()
    assert cloud.points.tobytes() == points.tobytes()
    assert cloud.seconds[-1] == 0


def test_poses_from_oxts_are_those_of_the_lidar(root):
    trajectory = recording_of(root).poses()
    assert trajectory.seconds is None
    assert len(trajectory.world_T_vehicle) == FIRST + TRUTH.frames
    found, truth = trajectory.world_T_vehicle[FIRST:], TRUTH.world_T_lidar(TRUTH.times)
    assert np.abs(invert(found[0]) @ found - invert(truth[0]) @ truth).max() < 1e-6


def test_a_line_of_oxts_per_scan_goes_by_their_order(copy):
    path = copy / "oxts/0000.txt"
    path.write_text("\n".join(path.read_text().splitlines()[FIRST:]) + "\n")
    recording = recording_of(copy)
    found, truth = recording.poses().at(recording.times()[FIRST:]), TRUTH.world_T_lidar(TRUTH.times)
    assert np.abs(invert(found[0]) @ found - invert(truth[0]) @ truth).max() < 1e-6


def test_without_oxts_there_are_no_poses_and_times_are_assumed_in_either_case(copy):
    shutil.rmtree(copy / "oxts")
    recording = recording_of(copy)
    assert recording.poses() is None
    assert np.allclose(np.diff(recording.times()), PERIOD_S)
    assert len(recording.times()) == FIRST + TRUTH.frames
    assert any(
        "the benchmark has no times: 0.1033 s between frames is assumed" in note
        for note in recording.notes()
    )


@pytest.mark.parametrize("names", [OFFICIAL, OTHER])
def test_boxes_are_in_the_frame_of_the_lidar_and_tracks_count_from_1(tmp_path, names):
    write_tracking(tmp_path, TRUTH, LABELS, names=names)
    recording = recording_of(tmp_path)
    boxes = recording.boxes()
    assert sorted(boxes) == list(range(TRUTH.frames))
    for frame, found in boxes.items():
        truth = TRUTH.boxes(frame, LABELS)
        assert len(truth) >= 3
        assert found.tracks.tolist() == truth.tracks.tolist()
        assert found.labels.tolist() == truth.labels.tolist()
        assert np.abs(found.sensor_T_box - truth.sensor_T_box).max() < 1e-6
        assert np.abs(found.sizes - truth.sizes).max() < 1e-9
    assert (
        np.abs(
            recording.poses().world_T_vehicle[0, :3, :3] - TRUTH.world_T_lidar(0.0)[:3, :3]
        ).max()
        < 1e-6
    )


def test_a_frame_without_boxes_has_an_empty_entry_and_track_0_is_track_1(copy):
    path = copy / "label_02/0000.txt"
    car = "21 0 Car 0 0 0 0 0 0 0 1.5 1.8 4.4 0 1.6 10 0"
    path.write_text(f"20 -1 DontCare -1 -1 -10 1 2 3 4 -1000 -1000 -1000 -10 -1 -1 -1\n{car}\n")
    boxes = recording_of(copy).boxes()
    assert sorted(boxes) == list(range(FIRST, FIRST + TRUTH.frames))
    assert len(boxes[20]) == 0
    assert boxes[21].tracks.tolist() == [1]


def test_the_names_of_people_who_sit(copy):
    rows = [
        f"20 {track} {kind} 0 0 0 0 0 0 0 1 1 1 0 1 9 0"
        for track, kind in enumerate(("Person", "Person_sitting"))
    ]
    (copy / "label_02/0000.txt").write_text("\n".join(rows) + "\n")
    assert recording_of(copy).boxes()[20].labels.tolist() == [KITTI.id_of("Person_sitting")] * 2


def test_both_parts_are_found_and_one_of_them_is_a_source(tmp_path):
    write_tracking(tmp_path, small_drive(2), LABELS)
    shutil.copytree(tmp_path / "training", tmp_path / "testing")
    shutil.rmtree(tmp_path / "testing/label_02")
    recordings = KittiTracking(tmp_path).sequences()
    names = [(recording.name, recording.split) for recording in recordings]
    assert names == [("KITTI_tracking_0000", "Train"), ("KITTI_tracking_test0000", "Test")]
    assert recordings[0].boxes() is not None and recordings[1].boxes() is None
    assert [recording.name for recording in KittiTracking(tmp_path / "testing").sequences()] == [
        "KITTI_tracking_test0000"
    ]


def test_a_missing_scan_is_absent(copy):
    for frame in (22, 23):
        (copy / f"velodyne/0000/{frame:06d}.bin").unlink()
    recording = recording_of(copy)
    assert [frame.number for frame in recording.frames] == [20, 21, 24, 25]
    assert sorted(recording.boxes()) == [20, 21, 24, 25]


def fails(folder, read, error=FormatError):
    with pytest.raises(error) as raised:
        read(recording_of(folder))
    assert "\n" not in str(raised.value)
    return str(raised.value)


def test_a_scan_that_is_cut_short_is_named(copy):
    (copy / "velodyne/0000/000021.bin").write_bytes(b"0" * 30)
    assert "000021.bin: expected a multiple of 16 bytes, found 30" in fails(
        copy, lambda r: r.frames[1].read()
    )


def test_a_missing_line_of_oxts_is_named(copy):
    path = copy / "oxts/0000.txt"
    path.write_text("\n".join(path.read_text().splitlines()[:-1]) + "\n")
    message = fails(copy, lambda r: r.poses())
    assert "oxts/0000.txt: expected a line for each frame up to 25, found 25 lines" in message
    assert '`poses="kiss-icp"`' in message


def test_a_missing_calibration_is_named(copy):
    (copy / "calib/0000.txt").unlink()
    assert "calib/0000.txt: expected R0_rect and Tr_velo_to_cam" in fails(
        copy, lambda r: r.boxes(), MissingDataError
    )
    assert "calib/0000.txt: expected Tr_imu_to_velo" in fails(
        copy, lambda r: r.poses(), MissingDataError
    )
    assert len(recording_of(copy).poses(force=True).world_T_vehicle) == FIRST + TRUTH.frames


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        (
            "Tr_velo_to_cam",
            "Tr_other",
            r"calib/0000.txt: expected Tr_velo_to_cam or Tr_velo_cam, found only P2, R0_rect",
        ),
        (
            "R0_rect: ",
            "R0_rect: 1 ",
            r"calib/0000.txt: expected 9 numbers after R0_rect:, found 10",
        ),
        ("Tr_velo_to_cam: 0.0", "Tr_velo_to_cam: 0.5", r"calib/0000.txt: Tr_velo_to_cam: "),
    ],
)
def test_a_wrong_calibration_is_named(copy, old, new, message):
    path = copy / "calib/0000.txt"
    assert old in path.read_text()
    path.write_text(path.read_text().replace(old, new))
    assert re.search(message, fails(copy, lambda r: r.boxes()))


@pytest.mark.parametrize(
    ("row", "message"),
    [
        ("20 0 Horse 0 0 0 0 0 0 0 1 1 1 0 1 9 0", "line 1: expected a type of object: one of Car"),
        ("20 0 Car 0 0 0 0 0 0 0 1 1 1 0 1 9", "line 1: expected 17 columns, found 16"),
        (
            "20 0 Car 0 0 0 0 0 0 0 1 1 1 0 one 9 0",
            "line 1: expected numbers but in column 3, found could not convert",
        ),
        (
            "20 -1 Car 0 0 0 0 0 0 0 1 1 1 0 1 9 0",
            "line 1: expected a track 0..4294967294, found -1",
        ),
        (
            "20 4294967295 Car 0 0 0 0 0 0 0 1 1 1 0 1 9 0",
            "expected a track 0..4294967294, found 4294967295",
        ),
        ("20 0 Car 0 0 0 0 0 0 0 -1 1 1 0 1 9 0", "frame 20: boxes: sizes: expected positive"),
        (
            "20 0 Car 0 0 0 0 0 0 0 1 1 1 nan 1 9 0",
            "frame 20: boxes: centers: expected finite numbers",
        ),
        (
            "20 0 Car 0 0 0 0 0 0 0 1 1 1 0 1 9 0\n20 0 Car 0 0 0 0 0 0 0 1 1 1 4 1 9 0",
            "one box per track in a frame",
        ),
    ],
)
def test_wrong_boxes_are_named(copy, row, message):
    (copy / "label_02/0000.txt").write_text(f"{row}\n")
    found = fails(copy, lambda r: r.boxes())
    assert "label_02/0000.txt" in found and message in found


def test_a_folder_without_sequences_is_named(tmp_path):
    with pytest.raises(MissingDataError, match="expected training/velodyne/0000/ and so on"):
        KittiTracking(tmp_path).sequences()


@pytest.fixture(scope="module")
def sample(real, tmp_path_factory):
    """The real sample, unpacked."""
    file = real / "kitti_tracking_0000.tar.xz"
    if not file.exists():
        pytest.skip("the archive of the real drive is absent")
    folder = tmp_path_factory.mktemp("sample")
    with tarfile.open(file) as archive:
        archive.extractall(folder, filter="data")
    (training,) = folder.rglob("training")
    return training.parent


def corners_in(camera, sensor_T_box, size):
    """Return the (8, 2) pixels of the corners of a box."""
    corners = np.array(list(np.ndindex(2, 2, 2))) - 0.5
    return camera.project(
        transform_points(invert(camera.sensor_T_camera) @ sensor_T_box, corners * size)
    )


@pytest.mark.slow
@pytest.mark.parametrize("images", ["none", "link", "copy"])
def test_cameras_are_those_of_the_projections(copy, tmp_path, images):
    from PIL import Image

    from carlasc.storage import cameras_of, read_image

    (copy / "image_02/0000").mkdir(parents=True)
    pixels = np.random.default_rng(0).integers(0, 256, (370, 1224, 3)).astype(np.uint8)
    Image.fromarray(pixels).save(copy / f"image_02/0000/{FIRST + 1:06d}.png")
    for axes in ("left", "right"):
        options, poses = LayoutOptions(axes=axes, images=images), PoseOptions("file", force=True)
        result = convert(
            "kitti-tracking",
            copy,
            tmp_path / axes,
            grids=None,
            layout=options,
            poses=poses,
            run=Run(workers=1),
        )
        (sequence,) = carlasc.open(tmp_path / axes).values()
        (camera,) = cameras_of(sequence).values()
        assert (camera.name, camera.width, camera.height) == ("image_02", 1224, 370)
        points = sequence.read("points", FIRST)[:, :3].astype(np.float64)
        found = camera.project(transform_points(invert(camera.sensor_T_camera), points))
        lidar = points * ((1, -1, 1) if axes == "left" else (1, 1, 1))
        rows = np.array([[721.5, 0, 609.6, 44.9], [0, 721.5, 172.9, 0.2], [0, 0, 1, 0.003]])
        calibration = recording_of(copy)._calibration("")
        to_camera = calibration.rotation("R0_rect", "R_rect") @ calibration.transform(
            "Tr_velo_to_cam", "Tr_velo_cam"
        )
        u, v, depth = rows @ np.vstack([transform_points(to_camera, lidar).T, np.ones(len(lidar))])
        ahead = depth > 0.1
        assert (
            ahead.sum() > 100
            and np.abs(found[ahead] - np.stack([u, v], axis=1)[ahead] / depth[ahead, None]).max()
            < 1e-6
        )
        if images != "none":
            assert np.array_equal(read_image(sequence, camera, FIRST + 1), pixels)
        assert bool(list((tmp_path / axes).rglob("*.png"))) == (images == "copy")
        assert any("images of cameras do not exist" in note for note in result.notes) == (
            images == "copy"
        )
        with pytest.raises(MissingDataError, match=f"images/image_02/{FIRST:06d}.jpg or .png"):
            read_image(sequence, camera, FIRST)


def test_a_projection_that_is_none_is_refused_in_one_line(copy, tmp_path):
    path = copy / "calib/0000.txt"
    path.write_text(re.sub("P2: .*", f"P2: {' '.join(['1.0'] * 12)}", path.read_text()))
    with pytest.raises(FormatError, match="0000.txt: expected fx 0 cx.*after P2"):
        recording_of(copy).cameras()


@pytest.mark.slow
def test_boxes_of_the_real_sample_are_where_the_image_says(sample):
    """The van's edges fit to 2 pixels, all right edges to hundredths.

    The left edge of who rides differs by up to 2.6 from the box in space.
    """
    recording, errors, of_van = recording_of(sample), [], []
    camera = {one.name: one for one in recording.cameras()}["image_02"]
    boxes = recording.boxes()
    for line in (Path(recording.folder) / "label_02/0000.txt").read_text().splitlines():
        row = line.split()
        frame, track, own = int(row[0]), int(row[1]) + 1, np.array(row[6:10], float)
        touches = own.min() < 1 or own[2] > 1240 or own[3] > 373
        if row[2] == "DontCare" or frame not in boxes or float(row[3]) or int(row[4]) or touches:
            continue
        (number,) = np.flatnonzero(boxes[frame].tracks == track)
        pixels = corners_in(camera, boxes[frame].sensor_T_box[number], boxes[frame].sizes[number])
        errors.append(np.abs(np.array([*pixels.min(axis=0), *pixels.max(axis=0)]) - own))
        of_van += [errors[-1]] * (row[2] == "Van")
    assert len(of_van) == 40 and np.max(of_van) < 2
    errors = np.array(errors)
    assert len(errors) > 100
    assert errors[:, 2].max() < 0.05
    assert np.median(errors.max(axis=1)) < 2 and errors.max() < 2.7
    points = recording.frames[0].read()[0].points[:, :3].astype(np.float64)
    rows = np.reshape(recording._calibration("").values["P2"], (3, 4))
    to_camera = recording._calibration("").rotation("R0_rect", "R_rect") @ recording._calibration(
        ""
    ).transform("Tr_velo_to_cam", "Tr_velo_cam")
    u, v, depth = rows @ np.vstack([transform_points(to_camera, points).T, np.ones(len(points))])
    inside = (depth > 0) & (np.abs(u / depth - 620.5) < 621) & (np.abs(v / depth - 187) < 187.5)
    pixels = camera.project(transform_points(invert(camera.sensor_T_camera), points))
    assert inside.sum() == camera.contains(pixels).sum() > 10_000


@pytest.mark.slow
def test_the_real_sample_is_read(sample):
    recording = recording_of(sample)
    assert [frame.number for frame in recording.frames] == list(range(20, 105))
    assert recording.poses() is None
    boxes = recording.boxes()
    assert {track for found in boxes.values() for track in found.tracks.tolist()} == {1, 2, 4}
    assert {KITTI.names[int(label)] for found in boxes.values() for label in found.labels} == {
        "Van",
        "Cyclist",
    }
    for number in (20, 60, 104):
        (cloud,) = recording.frames[number - 20].read()
        assert (cloud.points[:, :3] == 0).all(axis=1).sum() == 1
        assert np.abs(cloud.seconds).max() <= PERIOD_S / 2 + 1e-6
        found = boxes[number]
        # most points in a box are on its surface, and it stands on the road
        for row, pose in enumerate(found.sensor_T_box):
            body = transform_points(
                invert(pose), cloud.points[found.contains(cloud.points[:, :3])[row], :3]
            )
            body = body[body[:, 2] > 0.15 - found.sizes[row, 2] / 2]
            assert len(body) > 50
            assert np.median((found.sizes[row] / 2 - np.abs(body)).min(axis=1)) < 0.4


@pytest.mark.slow
@pytest.mark.needs("kiss_icp")
def test_scans_of_the_real_sample_fit_best_with_the_times_of_their_points(sample):
    """Structure that many scans saw takes the fewest voxels if each point is put where the scanner
    was at its time.
    """
    from carlasc.core.geometry import slerp
    from carlasc.motion.odometry import estimate_poses

    clouds = [frame.read()[0] for frame in recording_of(sample).frames[:24]]
    first = estimate_poses(
        (cloud.points[:, :3] for cloud in clouds), max_range_m=50, min_range_m=2.5
    )
    times = np.arange(len(clouds)) * PERIOD_S

    def voxels(direction):
        """Correct scans by the motion, estimate poses again, and count the voxels that all scans
        fill.
        """
        placed = []
        for number, cloud in enumerate(clouds):
            then = invert(first[number]) @ slerp(
                first, times, times[number] + direction * cloud.seconds
            )
            placed.append(
                np.einsum("nij,nj->ni", then[:, :3, :3], cloud.points[:, :3]) + then[:, :3, 3]
            )
        poses = estimate_poses(iter(placed), max_range_m=50, min_range_m=2.5)
        world = []
        for pose, points in zip(poses, placed, strict=True):
            distance = np.linalg.norm(points, axis=1)
            used = (
                (distance > 4)
                & (distance < 30)
                & (points[:, 2] > -1.2)
                & (np.abs(points[:, 1]) > 4)
            )
            world.append(transform_points(pose, points[used]))
        return len(np.unique(np.floor(np.concatenate(world) / 0.1).astype(np.int32), axis=0))

    with_times, without, against = voxels(1), voxels(0), voxels(-1)
    assert with_times < 0.98 * without
    assert without < 0.98 * against


@pytest.fixture(scope="module")
def converted(sample, tmp_path_factory):
    """The real sample in one command, without grids."""
    out = tmp_path_factory.mktemp("converted")
    result = convert(
        "kitti-tracking",
        sample,
        out,
        layout=LayoutOptions(axes="right"),
        grids=None,
        run=Run(workers=2),
    )
    assert (result.made, result.failures) == (85, ())
    return out


@pytest.mark.slow
@pytest.mark.needs("kiss_icp")
def test_flow_of_the_real_sample_is_that_of_its_boxes_and_zero_on_the_parked_van(converted):
    """The boxes of an object move as fast as it does; over a second, their jitter of some
    centimetres does not matter.
    """
    (sequence,) = carlasc.open(converted).sequences().values()
    frames = sequence.frames("points").tolist()
    centers, speeds = {}, {}
    for frame in frames:
        boxes, pose = sequence.boxes(frame), sequence.read_pose(frame)
        instances, flow = sequence.read("instances", frame), sequence.read("flow", frame)
        assert not flow[instances == 4].any() and not flow[instances == 0].any()
        for track, center in zip(
            boxes.tracks.tolist(), transform_points(pose, boxes.centers), strict=True
        ):
            centers[track, frame] = center
            if (instances == track).any():
                speeds[track, frame] = np.linalg.norm(flow[instances == track].mean(axis=0))
    for track in (1, 2):
        expected = {
            frame: np.linalg.norm(centers[track, frame + 5] - centers[track, frame - 5])
            / (10 * PERIOD_S)
            for frame in frames[5:-5]
        }
        errors = np.abs([speeds[track, frame] - speed for frame, speed in expected.items()])
        assert np.mean(errors) < 0.1 and errors.max() < 0.4
    assert max(speeds[4, frame] for frame in frames if (4, frame) in speeds) == 0


@pytest.mark.slow
@pytest.mark.needs("kiss_icp")
def test_movers_of_the_real_sample_leave_no_trail_in_a_grid(converted, monkeypatch):
    from carlasc import GridSpec
    from carlasc.groundtruth import FromScans

    monkeypatch.syspath_prepend(str(Path(__file__).parents[2] / "docs/studies"))
    from real_measures import Judge

    window, frame = (-30, 30), 55
    (sequence,) = carlasc.open(converted).sequences().values()
    judge = Judge.of(sequence, window)
    assert sorted(body.name for body in judge.movers) == ["track 1", "track 2"]
    spec = GridSpec.published().with_resolution(0.2)
    frames = (frame, frame + 1)
    result = carlasc.regrid(
        converted,
        spec,
        name="fine",
        frames=frames,
        observe=FromScans(window=window),
        run=Run(workers=1),
    )
    assert not result.failures
    (sequence,) = carlasc.open(converted).sequences().values()
    measures = judge.measure(sequence.grid("fine", frame), frame)
    assert measures.trail.whole > 5000 and measures.trail.percent < 0.5
    assert measures.kept.percent > 95
