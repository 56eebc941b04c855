"""The compiled cell rule against the rule as `GridSpec` says it."""

import numpy as np
import pytest

from carlasc.core.cells import AZIMUTH_ERROR, Cells, as_pose, fast_azimuth, find_voxel, transform
from carlasc.core.geometry import rotation_z, transform_points, translation
from carlasc.core.grids import GridSpec

GRIDS = [
    GridSpec.published(),
    GridSpec.published("cylindrical"),
    GridSpec("cylindrical", (5, 7, 3), (2.0, -1.0, -2.0), (9.0, 2.5, 1.0)),
    GridSpec("cartesian", (3, 1, 4), (-1.0, 0.0, -0.1), (2.0, 0.7, 0.3)),
]


def points_at_edges(spec):
    """Random points, and points on and beside every edge of an axis, where the two others are in
    the middle of the grid.
    """
    rng = np.random.default_rng(0)
    reach = [max(abs(low), abs(up)) * 1.2 for low, up in zip(spec.lower, spec.upper, strict=True)]
    points = [rng.uniform(-1, 1, (2000, 3)) * (reach[0], reach[0], reach[2]), np.zeros((1, 3))]
    middle = (np.array(spec.lower) + spec.upper) / 2
    for axis in range(3):
        edges = spec.edges(axis)
        for shifted in (edges, np.nextafter(edges, -np.inf), np.nextafter(edges, np.inf)):
            rows = np.tile(middle, (len(edges), 1))
            rows[:, axis] = shifted
            points.append(spec.from_axes(rows))
    return np.concatenate(points)


@pytest.mark.parametrize("spec", GRIDS, ids=str)
def test_the_compiled_rule_is_the_rule(spec):
    points, cells = points_at_edges(spec), Cells.of(spec)
    found = [find_voxel(*point, cells) for point in points.tolist()]
    wanted = spec.flat_index(points)
    assert found == np.where(wanted < 0, spec.num_voxels, wanted).tolist()
    assert (wanted >= 0).any() and (wanted < 0).any()


def test_points_that_are_not_numbers_are_outside():
    for spec in GRIDS:
        assert find_voxel(np.nan, 0.0, 0.0, Cells.of(spec)) == spec.num_voxels


def test_the_fast_azimuth_is_within_its_error():
    rng = np.random.default_rng(1)
    corners = [
        (x, y) for x in (-1, -0.0, 0.0, 1e-30, 1) for y in (-1, -0.0, 0.0, 1e-30, 1) if x or y
    ]
    angles = np.linspace(-np.pi, np.pi, 1601)
    circle = np.stack([np.cos(angles), np.sin(angles)], axis=1)
    for x, y in np.concatenate([corners, circle, rng.normal(scale=20, size=(3000, 2))]).tolist():
        off = abs(fast_azimuth(x, y) - np.arctan2(y, x))
        assert min(off, abs(off - 2 * np.pi)) < AZIMUTH_ERROR
    assert np.isnan(fast_azimuth(0.0, 0.0))


def test_a_pose_as_scalars_moves_points_as_the_matrix_does():
    pose = translation((1, 2, 3)) @ rotation_z(0.3)
    assert transform(as_pose(pose), 4.0, 5.0, 6.0) == pytest.approx(
        transform_points(pose, np.array([4.0, 5.0, 6.0]))
    )
