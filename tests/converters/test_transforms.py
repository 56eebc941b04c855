"""The tree of frames: paths up and down, at a time, and what is said where there is none."""

import numpy as np
import pytest
from carlasc_converters.transforms import FrameTree, PlacedFrame
from helpers.errors import raises

from carlasc.core.geometry import invert, quaternions_of, rotation_z, translation
from carlasc.errors import FormatError


def placed(parent, child, pose, stamp_ns=0):
    return PlacedFrame(
        stamp_ns, parent, child, (*pose[:3, 3], *quaternions_of(pose[None, :3, :3])[0])
    )


BASE_T_MAST, MAST_T_LIDAR, BASE_T_REAR = (
    translation((1, 2, 3)),
    rotation_z(0.5),
    translation((-2, 0, 1)) @ rotation_z(3),
)


@pytest.fixture
def tree():
    tree = FrameTree("drive.bag")
    for row in (
        ("base", "mast", BASE_T_MAST),
        ("mast", "lidar", MAST_T_LIDAR),
        ("base", "rear", BASE_T_REAR),
    ):
        tree.add(placed(*row))
    for second in range(3):
        tree.add(placed("odom", "base", translation((second, 0, 0)), second * 10**9))
    return tree


def test_frames_are_found_up_across_and_down(tree):
    at = np.array([0])
    np.testing.assert_allclose(
        tree.lookup("base", "lidar", at)[0], BASE_T_MAST @ MAST_T_LIDAR, atol=1e-12
    )
    np.testing.assert_allclose(
        tree.lookup("lidar", "base", at)[0], invert(BASE_T_MAST @ MAST_T_LIDAR), atol=1e-12
    )
    across = invert(BASE_T_REAR) @ BASE_T_MAST @ MAST_T_LIDAR
    np.testing.assert_allclose(tree.lookup("rear", "lidar", at)[0], across, atol=1e-12)
    np.testing.assert_allclose(tree.lookup("rear", "rear", at)[0], np.eye(4))


def test_what_moves_is_interpolated_and_stays_before_the_first_and_after_the_last(tree):
    places = tree.lookup("odom", "base", np.array([-(10**9), 500_000_000, 9 * 10**9]))[:, 0, 3]
    np.testing.assert_allclose(places, [0, 0.5, 2])
    assert [edge.moves for edge in tree.edges("mast", "odom")] == [False, True]


def test_frames_without_a_path_are_not_connected_and_the_tree_names_them(tree):
    assert tree.connected("rear", "lidar") and not tree.connected("camera", "lidar")
    assert str(tree) == "base > mast, base > rear, mast > lidar, odom > base"
    assert str(FrameTree("drive.bag")) == "no frames"


def test_a_circle_is_named(tree):
    tree.add(placed("lidar", "odom", np.eye(4)))
    with raises(
        FormatError,
        expected="a tree of frames",
        found="a circle: lidar, mast, base, odom, lidar",
    ):
        tree.ancestors("lidar")


def test_a_quaternion_that_is_no_rotation_is_named(tree):
    tree.add(PlacedFrame(0, "base", "imu", (0, 0, 0, 0, 0, 0, 0)))
    with raises(FormatError, where="drive.bag: base to imu", expected="a rotation"):
        tree.lookup("base", "imu", np.array([0]))
