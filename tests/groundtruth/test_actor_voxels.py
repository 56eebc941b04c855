"""Which voxels belong to which body, and which of them no scan could see."""

import numpy as np
import pytest

from carlasc.core.geometry import rotation_z, transform_points, translation
from carlasc.core.grids import GridSpec
from carlasc.groundtruth.from_scans.merging import STATIC, BodyRegions
from carlasc.motion import BODY_MARGIN_M, Extent, Track

SPEC = GridSpec("cartesian", (50, 50, 10), (-10, -10, -2), (10, 10, 2))
CENTERS = SPEC.centers().reshape(-1, 3)
HALF = np.array([2.2, 1.0, 0.8])
ALL, REAR_AND_LOW = (True,) * 4, (True, False, True, False)


def body(faces=ALL, half=HALF):
    extent = Extent(-half, half, faces, 100)
    poses = np.eye(4)[None]
    return Track(
        10, 0, {}, 0, poses, np.zeros((1, 3)), -half - BODY_MARGIN_M, half + BODY_MARGIN_M, extent
    )


def regions_of(pose, track):
    return BodyRegions.of_bodies(SPEC, np.eye(4), [(7, track, pose)])


@pytest.mark.parametrize("turn", [0.0, 0.3, np.pi / 2, 2.5])
def test_a_body_has_all_voxels_that_its_box_touches_wherever_it_is_turned(turn):
    pose = translation((1.3, -2.1, 0.1)) @ rotation_z(turn)
    regions = regions_of(pose, body())
    assert regions.actors == {1: 7}
    inside = transform_points(
        pose, np.random.default_rng(0).uniform(-1, 1, (5000, 3)) * (HALF + BODY_MARGIN_M)
    )
    assert (regions.of_voxel[SPEC.flat_index(inside)] == 1).all()
    apart = transform_points(np.linalg.inv(pose), CENTERS[regions.of_voxel == 1])
    assert (np.abs(apart) < HALF + BODY_MARGIN_M + 0.2 * np.sqrt(2) + 1e-6).all()


def test_a_body_outside_the_grid_has_no_region():
    regions = regions_of(translation((50.0, 0.0, 0.0)), body())
    assert not regions.of_voxel.any()
    assert not regions.actors


def test_nothing_is_hidden_of_a_body_that_was_seen_from_all_sides():
    regions = regions_of(np.eye(4), body())
    assert not len(regions.hidden) and not len(regions.hidden_ends)


def test_voxels_that_touch_only_a_face_that_no_scan_saw_are_hidden():
    regions = regions_of(np.eye(4), body(REAR_AND_LOW))
    hidden = CENTERS[regions.hidden]
    at_front, at_high = hidden[:, 0] > HALF[0] - 0.21, hidden[:, 1] > HALF[1] - 0.21
    assert at_front.any() and at_high.any() and (at_front | at_high).all()
    assert (hidden[:, 0] > -HALF[0] + 0.2).all() and (hidden[:, 1] > -HALF[1] + 0.2).all()
    ends = CENTERS[regions.hidden_ends]  # a mirror image shows the other side, but not the front
    assert len(ends) and (ends[:, 0] > HALF[0] - 0.21).all()
    assert (regions.of_voxel[regions.hidden] == 1).all()


def test_the_sides_are_those_of_the_actor_and_not_of_the_grid():
    pose = rotation_z(np.pi)
    plain, turned = (regions_of(place, body(REAR_AND_LOW)) for place in (np.eye(4), pose))
    one, other = CENTERS[plain.hidden], transform_points(pose, CENTERS[turned.hidden])
    assert np.allclose(
        one[np.lexsort(one.round(3).T)], other[np.lexsort(other.round(3).T)], atol=1e-5
    )


def test_points_without_a_body_have_a_region_of_their_own():
    points = np.array([[5.1, 5.1, 0.1], [5.15, 5.1, 0.1], [0.0, 0.0, 0.0], [99.0, 0.0, 0.0]])
    with_body = regions_of(np.eye(4), body())
    regions = with_body.with_points(SPEC, points)
    assert regions.of_voxel[SPEC.flat_index(points[:1])].tolist() == [2]
    assert regions.of_voxel[SPEC.flat_index(points[2:3])].tolist() == [1]  # a body keeps its voxels
    assert np.count_nonzero(regions.of_voxel != with_body.of_voxel) == 1
    assert regions.actors == {1: 7}  # no actor is carried into the new region
    # the first regions stay as they were
    assert not with_body.of_voxel[SPEC.flat_index(points[:1])].any()
    alone = BodyRegions.of_bodies(SPEC, np.eye(4), []).with_points(SPEC, points[:1])
    assert alone.of_voxel[SPEC.flat_index(points[:1])] != STATIC


def test_the_wider_cells_of_a_cylindrical_grid_are_touched_too():
    spec = GridSpec("cylindrical", (20, 36, 4), (0, -np.pi, -2), (20, np.pi, 2))
    pose = translation((9.0, 6.0, 0.0)) @ rotation_z(0.7)
    regions = BodyRegions.of_bodies(spec, np.eye(4), [(0, body(), pose)])
    inside = transform_points(pose, np.random.default_rng(0).uniform(-1, 1, (2000, 3)) * HALF)
    assert (regions.of_voxel[spec.flat_index(inside)] == 1).all()
