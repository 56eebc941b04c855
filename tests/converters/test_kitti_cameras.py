"""The cameras of KITTI's three layouts are the same ones: points have the pixels that the
projection says.
"""

import numpy as np
import pytest
from carlasc_converters.kitti import KittiRecording
from carlasc_converters.kitti360 import Kitti360Drive, Kitti360Files
from carlasc_converters.kitti_raw import RawDrive
from carlasc_converters.kitti_tracking import TrackingSequence

from carlasc.core.geometry import invert, transform_points

ROWS = np.array([[721.5, 0, 609.6, -339.5], [0, 721.5, 172.9, 2.2], [0, 0, 1, 0.003]])
TO_CAMERA = np.array([[0.0, -1, 0, 0.02], [0, 0, -1, -0.06], [1, 0, 0, -0.33]])
ANGLE = 0.01
RECTIFY = np.array(
    [[np.cos(ANGLE), 0, np.sin(ANGLE)], [0, 1, 0], [-np.sin(ANGLE), 0, np.cos(ANGLE)]]
)


def line(name, values):
    return f"{name}: {' '.join(map(repr, np.asarray(values, float).reshape(-1).tolist()))}\n"


def scan(folder, name):
    folder.mkdir(parents=True)
    np.zeros((1, 4), np.float32).tofile(folder / name)


def odometry(root):
    scan(root / "velodyne", "000004.bin")
    both = RECTIFY @ TO_CAMERA
    (root / "calib.txt").write_text(line("P3", ROWS) + line("Tr", both))
    return KittiRecording(root, "KITTI_00", "Train"), "image_3"


def raw(root):
    scan(root / "drive/velodyne_points/data", "0000000004.bin")
    (root / "calib_cam_to_cam.txt").write_text(
        "calib_time: 09-Jan-2012 13:57:47\n" + line("R_rect_00", RECTIFY) + line("P_rect_03", ROWS)
    )
    (root / "calib_velo_to_cam.txt").write_text(
        line("R", TO_CAMERA[:, :3]) + line("T", TO_CAMERA[:, 3])
    )
    return RawDrive(root / "drive"), "image_03"


def tracking(root):
    scan(root / "velodyne/0000", "000004.bin")
    (root / "calib").mkdir()
    (root / "calib/0000.txt").write_text(
        line("P3", ROWS) + line("R0_rect", RECTIFY) + line("Tr_velo_to_cam", TO_CAMERA)
    )
    return TrackingSequence(root, "0000", "KITTI_tracking_0000", "Train"), "image_03"


def kitti360(root):
    scan(root / "data_3d_raw/drive/velodyne_points/data", "0000000004.bin")
    (root / "calibration").mkdir()
    camera_T_lidar = np.vstack([TO_CAMERA, [0, 0, 0, 1]])
    (root / "calibration/perspective.txt").write_text(
        "calib_time: 09-Jan-2012\n" + line("R_rect_00", RECTIFY) + line("P_rect_01", ROWS)
    )
    places = line("x", np.linalg.inv(camera_T_lidar)[:3]).removeprefix("x: ")
    (root / "calibration/calib_cam_to_velo.txt").write_text(places)
    return Kitti360Drive(Kitti360Files(str(root), "drive")), "image_01"


@pytest.mark.parametrize("layout", [odometry, raw, tracking, kitti360])
def test_points_have_the_pixels_of_the_projection(layout, tmp_path):
    recording, name = layout(tmp_path)
    (camera,) = recording.cameras()
    assert (camera.name, camera.width, camera.height, camera.images) == (
        name,
        *((1408, 376) if layout is kitti360 else (1242, 375)),
        None,
    )
    points = np.random.default_rng(0).uniform((3, -20, -2), (60, 20, 3), (200, 3))
    in_rectified = RECTIFY @ (TO_CAMERA @ np.vstack([points.T, np.ones(200)]))
    u, v, depth = ROWS @ np.vstack([in_rectified, np.ones(200)])
    found = camera.project(transform_points(invert(camera.sensor_T_camera), points))
    assert np.abs(found - np.stack([u / depth, v / depth], axis=1)).max() < 1e-6


@pytest.mark.parametrize("layout", [odometry, raw, tracking, kitti360])
def test_without_a_calibration_there_are_no_cameras(layout, tmp_path):
    recording, _ = layout(tmp_path)
    for path in tmp_path.rglob("*cal*.txt"):
        path.unlink()
    for path in (*tmp_path.rglob("calib/0000.txt"), *tmp_path.rglob("perspective.txt")):
        path.unlink()
    assert not recording.cameras()
