"""Occluded voxels: the compiled walk of columns beside a walk of single voxels, and beside finely
sampled lines.
"""

import numpy as np
import pytest
from carlasc_converters.exporters.occlusion import occluded_voxels
from hypothesis import given, settings
from hypothesis import strategies as st

from carlasc.core.grids import GridSpec


def plain_walk(occupied, spec):
    """Walk from the centre of every voxel to the sensor, from voxel to voxel: the face that comes
    first, x before y before z.
    """
    sensor = -np.array(spec.lower) / spec.voxel_size
    occluded = np.zeros(spec.size, bool)
    for start in np.ndindex(spec.size):
        way = sensor - np.array(start) - 0.5
        with np.errstate(divide="ignore"):
            between = 1 / np.abs(way)
        following, cell = between / 2, np.array(start)
        while True:
            occluded[start] |= occupied[tuple(cell)]
            axis = int(np.argmin(following))
            if following[axis] >= 1:
                break
            cell[axis] += 1 if way[axis] > 0 else -1
            following[axis] += between[axis]
            if not 0 <= cell[axis] < spec.size[axis]:
                break
    return occluded


def sampled_lines(occupied, spec):
    """Sample every line finely: what the walk must agree with, but for lines that graze a voxel."""
    occluded = np.zeros(spec.size, bool)
    centers = spec.centers()
    for cell in np.ndindex(spec.size):
        line = centers[cell] * np.linspace(1, 0, 2000)[:, None]
        index = np.floor((line - spec.lower) / spec.voxel_size).astype(int)
        inside = ((index >= 0) & (index < spec.size)).all(axis=1)
        stop = len(inside) if inside.all() else int(np.argmin(inside))
        occluded[cell] = occupied[tuple(index[:stop].T)].any()
    return occluded


@st.composite
def grids(draw):
    """Return a small grid whose sensor is inside or outside its bounds on any axis, in the centre,
    on the face or beside it.
    """
    size = draw(st.tuples(st.integers(1, 9), st.integers(1, 9), st.integers(1, 12)))
    steps = draw(st.tuples(*[st.sampled_from([0.2, 0.5, 1.0])] * 3))
    places = [
        draw(st.one_of(st.integers(-2 * n, 4 * n).map(lambda half: half / 2), st.floats(-n, 2 * n)))
        for n in size
    ]
    lower = tuple(-place * step for place, step in zip(places, steps, strict=True))
    upper = tuple(low + n * step for low, n, step in zip(lower, size, steps, strict=True))
    seed, share = draw(st.integers(0, 2**32 - 1)), draw(st.sampled_from([0.01, 0.05, 0.2, 0.7]))
    return np.random.default_rng(seed).random(size) < share, GridSpec(
        "cartesian", size, lower, upper
    )


@given(grids())
@settings(max_examples=150, deadline=None)
def test_every_voxel_is_that_of_the_walk_from_its_centre(grid):
    occupied, spec = grid
    assert np.array_equal(occluded_voxels(occupied, spec), plain_walk(occupied, spec))


@pytest.mark.slow
@pytest.mark.parametrize("sensor_z", [-20.0, 0.5, 32.0, 63.9, 64.0, 70.3, 140.0, 200.0])
def test_columns_may_have_more_voxels_than_an_integer_has_bits(sensor_z):
    spec = GridSpec("cartesian", (4, 3, 150), (-1.3, -1.0, -sensor_z), (2.7, 2.0, 150 - sensor_z))
    occupied = np.random.default_rng(1).random(spec.size) < 0.004
    expected = plain_walk(occupied, spec)
    assert occupied.sum() < expected.sum() < spec.num_voxels
    assert np.array_equal(occluded_voxels(occupied, spec), expected)


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_a_wall_hides_what_is_behind_it_and_nothing_else(axis):
    size, lower, upper = (11, 11, 11), (-5.5, -5.5, -5.5), (5.5, 5.5, 5.5)
    occupied, hidden = np.zeros(size, bool), np.zeros(size, bool)
    np.moveaxis(occupied, axis, 0)[8] = True
    np.moveaxis(hidden, axis, 0)[8:] = True
    found = occluded_voxels(occupied, GridSpec("cartesian", size, lower, upper))
    assert (
        np.array_equal(found[5], hidden[5])
        if axis
        else np.array_equal(found[:, 5, 5], hidden[:, 5, 5])
    )
    assert not (found & ~hidden).any()


def test_the_walk_agrees_with_finely_sampled_lines():
    rng = np.random.default_rng(0)
    spec = GridSpec("cartesian", (9, 8, 5), (0.05, -4.1, -1.93), (9.05, 3.9, 0.57))
    for share in (0.02, 0.15):
        occupied = rng.random(spec.size) < share
        different = occluded_voxels(occupied, spec) != sampled_lines(occupied, spec)
        assert different.mean() < 0.01
    assert not occluded_voxels(np.zeros(spec.size, bool), spec).any()
    assert occluded_voxels(np.ones(spec.size, bool), spec).all()


def test_the_order_of_the_mask_in_memory_does_not_matter():
    spec = GridSpec("cartesian", (6, 5, 4), (0.0, -2.5, -2.0), (6.0, 2.5, 2.0))
    occupied = np.random.default_rng(2).random(spec.size) < 0.1
    mirrored = occupied[:, ::-1]
    assert np.array_equal(occluded_voxels(mirrored, spec), occluded_voxels(mirrored.copy(), spec))
    assert np.array_equal(
        occluded_voxels(np.asfortranarray(occupied), spec), occluded_voxels(occupied, spec)
    )
