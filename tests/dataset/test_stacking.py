"""Compiled stacking against `GridSpec`'s rules in plain NumPy, voxel for voxel."""

import itertools

import numpy as np
import pytest
from helpers.datasets.drives import bend, random_points
from hypothesis import example, given, settings
from hypothesis import strategies as st

from carlasc.core.geometry import rotation_z, translation
from carlasc.core.grids import GridSpec
from carlasc.core.tables import REMAPS
from carlasc.dataset.stacking import look_up, stack_scans

PI32 = float(np.float32(np.pi))


def plainly(points, grid_T_scan, spec, near=0.0, far=np.inf):
    """Count the points of each voxel: float64, one term after the other, then GridSpec's own rules."""
    x, y, z = points[:, :3].astype(np.float64).T
    squared = x * x + y * y + z * z
    moved = np.stack([r[0] * x + r[1] * y + r[2] * z + r[3] for r in grid_T_scan[:3]], axis=1)
    cells = spec.flat_index(moved[(squared >= near * near) & (squared <= far * far)])
    return np.bincount(cells[cells >= 0], minlength=spec.num_voxels).reshape(spec.size)


def agree(points, grid_T_scan, spec):
    truth = plainly(points, grid_T_scan, spec)
    density = stack_scans([points], grid_T_scan[None], spec, "density")
    occupancy = stack_scans([points], grid_T_scan[None], spec)
    assert density.dtype == np.int32 and occupancy.dtype == np.uint8
    np.testing.assert_array_equal(density[0], truth)
    np.testing.assert_array_equal(occupancy[0], truth > 0)


float32 = st.floats(-60, 60, width=32)


@st.composite
def specs(draw):
    size = draw(st.tuples(*[st.integers(1, 300)] * 3).filter(lambda s: np.prod(s) < 100_000))
    lower = draw(st.tuples(float32, float32, float32))
    upper = tuple(float(np.float32(low + draw(st.floats(0.5, 60, width=32)))) for low in lower)
    if draw(st.booleans()):
        return GridSpec("cartesian", size, lower, upper)
    start = draw(st.sampled_from([-PI32, -1.0, 0.0, 2.0]))
    turn = draw(st.sampled_from([2 * PI32, np.pi, 1.0]))
    return GridSpec(
        "cylindrical",
        size,
        (abs(lower[0]), start, lower[2]),
        (abs(lower[0]) + 20, start + turn, upper[2]),
    )


@st.composite
def moves(draw):
    return translation(draw(st.tuples(*[st.floats(-5, 5)] * 3))) @ rotation_z(
        draw(st.floats(-3.2, 3.2))
    )


@given(specs(), moves(), st.integers(0, 700), st.integers(0, 2**32 - 1))
@settings(max_examples=150, deadline=None)
def test_any_grid_and_pose_bin_as_the_rules_say(spec, move, count, seed):
    agree(random_points(np.random.default_rng(seed), count), move, spec)


@given(specs(), st.lists(st.integers(-3, 400), min_size=1, max_size=40), st.integers(-2, 2))
@settings(max_examples=150, deadline=None)
def test_points_on_and_beside_cell_edges_fall_as_the_rules_say(spec, places, ulps):
    axes = np.stack(
        [
            spec.lower[a] + (np.roll(places, a) % (spec.size[a] + 3) - 1) * spec.voxel_size[a]
            for a in range(3)
        ],
        1,
    )
    points = np.asarray(spec.from_axes(axes), np.float32)
    for _ in range(abs(ulps)):
        points = np.nextafter(points, np.float32(np.sign(ulps) * 1000))
    agree(points, np.eye(4), spec)


@pytest.mark.parametrize("name", ["coarse", "fine", "cylindrical"])
def test_published_grids_agree_on_a_drive(name):
    spec, rng = GridSpec.published(name), np.random.default_rng(1)
    for current_T_past in bend(12, step_m=1.3, yaw_rad=0.1):
        agree(random_points(rng, 20_000), current_T_past, spec)


def test_bounds_that_are_no_float32_numbers_agree():
    spec = GridSpec("cartesian", (100, 7, 9), (-0.1, -1e-3, 1e6), (0.7, 0.9, 1e6 + 1 / 3))
    points = (
        np.random.default_rng(2)
        .uniform((-0.2, 0, 1e6), (0.8, 1, 1e6 + 0.4), (5000, 3))
        .astype(np.float32)
    )
    agree(points, np.eye(4), spec)


def test_what_is_not_finite_is_in_no_voxel():
    values = [np.nan, np.inf, -np.inf, 0.5]
    points = np.array(
        [p for p in itertools.product(values, repeat=3) if not np.isfinite(p).all()], np.float32
    )
    for name in ("cartesian", "cylindrical"):
        assert not stack_scans([points], bend(3)[2:], GridSpec.published(name)).any()


@pytest.mark.parametrize("near, far", [(2.0, 10.0), (None, 5.0), (3.0, None)])
def test_points_nearer_or_farther_than_the_ranges_are_left_out(near, far):
    points, spec = random_points(np.random.default_rng(3), 3000), GridSpec.published()
    move = bend(5)[4]
    density = stack_scans([points], move[None], spec, "density", near, far)
    truth = plainly(points, move, spec, near or 0.0, far or np.inf)
    np.testing.assert_array_equal(density[0], truth)
    assert truth.sum() < plainly(points, move, spec).sum()


def test_none_and_an_empty_scan_leave_their_grids_empty():
    points = random_points(np.random.default_rng(4), 500)
    stack = stack_scans(
        [None, points, points[:0]], np.tile(np.eye(4), (3, 1, 1)), GridSpec.published()
    )
    assert [grid.any() for grid in stack] == [False, True, False]


def test_density_counts_more_points_than_a_uint16_holds():
    points = np.zeros((70_000, 4), np.float32)
    assert stack_scans([points], np.eye(4)[None], GridSpec.published(), "density").max() == 70_000


@pytest.mark.parametrize(
    "layout",
    [
        "columns of another order",
        "three columns",
        "every second row",
        "unaligned",
        "float64",
        "planes",
        "padded planes",
    ],
)
def test_points_in_any_memory_layout_bin_alike(layout):
    points, spec = random_points(np.random.default_rng(5), 801), GridSpec.published()
    truth = stack_scans([points], bend(3)[2:], spec)
    unaligned = np.frombuffer(b"?" + points.tobytes(), np.uint8)[1:].view(np.float32).reshape(-1, 4)
    same = {
        "columns of another order": np.asfortranarray(points),
        "three columns": points[:, :3],
        "every second row": np.repeat(points, 2, axis=0)[::2],
        "unaligned": unaligned,
        "float64": points.astype(np.float64),
        "planes": np.ascontiguousarray(points[:, :3].T).T,
        "padded planes": np.pad(points[:, :3].T, [(0, 0), (0, 200)])[:, :801].T,
    }[layout]
    np.testing.assert_array_equal(stack_scans([same], bend(3)[2:], spec), truth)


@given(st.lists(st.integers(0, 30), max_size=50), st.sampled_from([np.uint8, np.uint16, np.uint32]))
@example([22], np.uint32)
@settings(max_examples=60, deadline=None)
def test_look_up_is_the_table_or_none(labels, dtype):
    remap = REMAPS["carlasc11"]
    found = look_up(np.array(labels, dtype), remap.table, np.dtype(np.uint8))
    if any(label not in remap.mapping for label in labels):
        assert found is None
    else:
        np.testing.assert_array_equal(found, remap(np.array(labels, dtype)))
