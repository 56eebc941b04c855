"""Points looked up in shifted grids: the compiled loop beside look-ups in plain NumPy."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from carlasc.core.grids import Grid, GridSpec
from carlasc.inspection.agreement import KNOWN, OCCUPIED, RIGHT, Voxels

PI32 = float(np.float32(np.pi))
SPECS = {
    "cartesian": GridSpec("cartesian", (6, 5, 3), (-3.0, -2.5, -1.0), (3.0, 2.5, 0.7)),
    "a full turn": GridSpec("cylindrical", (4, 9, 3), (1.0, -PI32, -1.0), (5.0, PI32, 0.7)),
    "a part of a turn": GridSpec("cylindrical", (4, 9, 3), (0.0, 2.0, -1.0), (5.0, 4.5, 0.7)),
    "one cell": GridSpec("cartesian", (1, 1, 1), (-3.0, -2.5, -1.0), (3.0, 2.5, 0.7)),
}
SHIFTS = np.array([(x, y, z) for x in (0, -1, 1) for y in (0, -1, 1) for z in (0, -1, 1)])


def plain_count(grid, points, labels, shifts):
    """Place the points, move their cells, and look each up; those that leave the grid stay where they are."""
    spec = grid.spec
    cells, inside = spec.index(spec.to_axes(points))
    cells, labels = cells[inside], labels[inside]
    counted = []
    for shift in shifts:
        moved = cells + shift
        if spec == SPECS["a full turn"]:
            moved[:, 1] %= spec.size[1]
        outside = ((moved < 0) | (moved >= spec.size)).any(axis=1)
        moved[outside] = cells[outside]
        known, voxels = grid.known[tuple(moved.T)], grid.labels[tuple(moved.T)]
        counted.append([known.sum(), (known & (voxels == labels)).sum(), (known & (voxels != 0)).sum()])
    return np.array(counted)


@given(
    st.sampled_from(sorted(SPECS)),
    st.sampled_from([np.float32, np.float64]),
    st.sampled_from([np.uint8, np.uint32, np.int64]),
    st.sampled_from([np.uint8, np.uint16, np.uint32]),
    st.booleans(),
    st.integers(0, 2**32 - 1),
)
@settings(max_examples=60, deadline=None)
def test_points_are_counted_as_in_plain_numpy(name, real, whole, narrow, with_counts, seed):
    spec, rng = SPECS[name], np.random.default_rng(seed)
    labels = rng.integers(0, 4, spec.size).astype(narrow)
    grid = Grid(spec, labels, rng.integers(0, 2, spec.size).astype(np.float32) if with_counts else None)
    points = rng.uniform(-6, 6, (200, 3)) * (1, 1, 0.3)
    points[::3] = np.round(points[::3] * 2) / 2  # on faces and edges
    points[:4, 0] = (math.nan, math.inf, -math.inf, 1e300)
    with np.errstate(over="ignore", invalid="ignore"):
        points, classes = points.astype(real), rng.integers(0, 4, 200).astype(whole)
        found = Voxels(grid).count(points, classes, SHIFTS)
        np.testing.assert_array_equal(found, plain_count(grid, points, classes, SHIFTS))


@pytest.mark.parametrize("name", SPECS)
def test_points_in_the_middle_of_voxels_are_found_where_the_grid_has_them(name):
    spec = SPECS[name]
    labels = np.random.default_rng(0).integers(0, 5, spec.size).astype(np.uint8)
    points = spec.from_axes(spec.centers()).reshape(-1, 3)
    counted = Voxels(Grid(spec, labels)).count(points, labels.reshape(-1), SHIFTS[:1])
    assert counted[0, KNOWN] == counted[0, RIGHT] == spec.num_voxels
    assert counted[0, OCCUPIED] == np.count_nonzero(labels)


def test_grids_in_any_order_in_memory_count_alike():
    spec, rng = SPECS["cartesian"], np.random.default_rng(1)
    labels, counts = rng.integers(0, 4, spec.size).astype(np.uint32), rng.integers(0, 2, spec.size)
    points = spec.centers().reshape(-1, 3)
    args = (points, labels.reshape(-1), SHIFTS)
    expected = Voxels(Grid(spec, labels, counts)).count(*args)
    found = Voxels(Grid(spec, np.asfortranarray(labels), counts[::-1, ::-1].copy()[::-1, ::-1])).count(*args)
    np.testing.assert_array_equal(found, expected)
