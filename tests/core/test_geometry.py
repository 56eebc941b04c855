import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from carlasc.core import geometry
from carlasc.errors import FormatError

angles = st.floats(-10, 10)
offsets = arrays(np.float64, 3, elements=st.floats(-1e3, 1e3))


def rigid(yaw, pitch, xyz):
    tilt = np.eye(4)
    tilt[:3, :3] = [
        [np.cos(pitch), 0, np.sin(pitch)],
        [0, 1, 0],
        [-np.sin(pitch), 0, np.cos(pitch)],
    ]
    return geometry.translation(xyz) @ geometry.rotation_z(yaw) @ tilt


@given(angles, angles, offsets, arrays(np.float64, (5, 3), elements=st.floats(-1e3, 1e3)))
def test_the_inverse_brings_points_back(yaw, pitch, xyz, points):
    transform = rigid(yaw, pitch, xyz)
    there = geometry.transform_points(transform, points)
    assert np.allclose(
        geometry.transform_points(geometry.invert(transform), there), points, atol=1e-9
    )
    assert np.allclose(geometry.invert(transform), np.linalg.inv(transform), atol=1e-9)


def test_points_are_rotated_from_the_left_then_moved():
    transform = geometry.translation((10, 0, 0)) @ geometry.rotation_z(np.pi / 2)
    assert np.allclose(geometry.transform_points(transform, np.array([[1.0, 0, 0]])), [[10, 1, 0]])
    assert np.allclose(geometry.rotate_vectors(transform, np.array([[1.0, 0, 0]])), [[0, 1, 0]])


def test_many_transforms_invert_at_once():
    transforms = np.stack([rigid(0.3, 0.1, (1, 2, 3)), rigid(-2, 0.5, (4, 5, 6))])
    assert np.allclose(geometry.invert(transforms) @ transforms, np.eye(4))


def test_poses_are_relative_to_the_first():
    poses = np.stack([rigid(0.3, 0.1, (1, 2, 3)), rigid(-2, 0.5, (4, 5, 6))])
    relative = geometry.relative_to(poses[0], poses)
    assert np.allclose(relative[0], np.eye(4))
    assert np.allclose(poses[0] @ relative[1], poses[1])


@pytest.mark.parametrize(
    ("spoil", "words"),
    [
        (lambda t: t.__setitem__((0, 3), np.nan), "NaN or infinity"),
        (lambda t: t.__setitem__((1, 3), -1e12), "1e+12 m"),
        (lambda t: t.__imul__(2), "rigid transform"),
        (lambda t: t.__setitem__((3, 0), 1), "rigid transform"),
        (lambda t: t.__setitem__((slice(None), 1), -t[:, 1]), "reflection"),
    ],
)
def test_what_is_no_rigid_transform_is_refused_with_its_place(spoil, words):
    transforms = np.stack([np.eye(4), np.eye(4)])
    spoil(transforms[1])
    with pytest.raises(FormatError) as error:
        geometry.check_rigid(transforms, "poses.txt")
    assert error.value.where == "poses.txt: transform 1" and words in str(error.value)


def test_a_wrong_shape_is_refused():
    with pytest.raises(FormatError) as error:
        geometry.check_rigid(np.zeros((3, 4)), "pose.npy")
    assert (error.value.where, error.value.found) == ("pose.npy", "shape (3, 4)")
