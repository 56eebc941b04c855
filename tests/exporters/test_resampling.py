"""Grids in the voxels and axes of other data sets."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from carlasc.converting import TargetFrame, is_same, resample_to, resampling_notes
from carlasc.core.grids import GridSpec


def spec_of(size, lower, upper):
    return GridSpec("cartesian", size, lower, upper)


def plain_resample(labels, known, source, target):
    """The rule in a loop: voxels of the source by their centres along coarser axes, the one at its
    centre along finer ones.
    """
    result, seen = np.zeros(target.size, labels.dtype), np.zeros(target.size, bool)
    steps = source.voxel_size, target.voxel_size
    for cell in np.ndindex(target.size):
        ranges = []
        for axis in range(3):
            low = target.lower[axis] + cell[axis] * steps[1][axis]
            if steps[1][axis] >= steps[0][axis] - 1e-9:
                centers = source.lower[axis] + (np.arange(source.size[axis]) + 0.5) * steps[0][axis]
                inside = (centers >= low - 1e-7) & (centers < low + steps[1][axis] - 1e-7)
                ranges.append(np.flatnonzero(inside))
            else:
                at = int(
                    np.floor(
                        (low + steps[1][axis] / 2 - source.lower[axis]) / steps[0][axis] + 1e-7
                    )
                )
                ranges.append(np.array([at]) if 0 <= at < source.size[axis] else np.empty(0, int))
        block, sure = labels[np.ix_(*ranges)], known[np.ix_(*ranges)]
        occupied = block[sure & (block > 0)]
        seen[cell] = sure.any()
        result[cell] = np.bincount(occupied).argmax() if len(occupied) else 0
    return result, seen


@given(
    st.integers(0, 2**32 - 1),
    st.tuples(*[st.sampled_from([0.1, 0.2, 0.25, 0.3, 0.4])] * 3),
    st.tuples(*[st.sampled_from([0.1, 0.2, 0.25, 0.3, 0.4])] * 3),
    st.tuples(*[st.sampled_from([-0.35, 0.0, 0.1, 0.55])] * 3),
)
def test_resampling_follows_the_rule(seed, fine, coarse, offset):
    rng = np.random.default_rng(seed)
    source = spec_of(
        (6, 5, 4), (0.0, 0.0, 0.0), tuple(n * s for n, s in zip((6, 5, 4), fine, strict=True))
    )
    lower = tuple(offset)
    upper = tuple(low + n * s for low, n, s in zip(lower, (4, 5, 3), coarse, strict=True))
    target = spec_of((4, 5, 3), lower, upper)
    labels = rng.integers(0, 4, source.size).astype(np.uint8)
    known = rng.random(source.size) < 0.7
    found, seen = resample_to(labels, known, source, target)
    expected, sure = plain_resample(labels, known, source, target)
    assert np.array_equal(seen, sure)
    assert np.array_equal(found, expected)


def test_occupied_voxels_are_not_outvoted_by_free_ones():
    source = spec_of((4, 4, 4), (0.0, 0.0, 0.0), (0.8, 0.8, 0.8))
    labels = np.zeros(source.size, np.uint8)
    labels[0, 0, 0] = 7
    labels[2:, 2:, 2:] = 3
    labels[2, 2, 2:] = 2
    known = np.ones(source.size, bool)
    known[:2, 2:] = False
    found, seen = resample_to(labels, known, source, source.with_size((2, 2, 2)))
    assert (found[0, 0, 0], found[1, 1, 1], found[1, 0, 0]) == (7, 3, 0)
    assert not seen[0, 1].any()
    assert seen.sum() == 6


def test_what_unknown_voxels_hold_does_not_matter():
    source = spec_of((2, 2, 2), (0.0, 0.0, 0.0), (1.0, 1.0, 1.0))
    labels = np.full(source.size, 9, np.uint8)
    known = np.zeros(source.size, bool)
    found, seen = resample_to(labels, known, source, source)
    assert not found.any()
    assert not seen.any()


@pytest.mark.parametrize("axes", ["left", "right"])
@pytest.mark.parametrize("forward", ["x", "y"])
def test_frames_turn_voxels_to_where_they_are(axes, forward):
    frame = TargetFrame(1.5, forward)
    spec = spec_of((8, 6, 4), (-1.0, -2.0, -2.0), (3.0, 4.0, 2.0))
    labels = np.zeros(spec.size, np.uint8)
    x, y, z = 2.2, 3.3, -0.4  # y is to the right in left-handed axes
    labels[tuple(spec.index(np.array([[x, y, z]]))[0][0])] = 1
    left = y if axes == "right" else -y
    there = {"x": (x, left, z + 1.5), "y": (-left, x, z + 1.5)}[forward]
    turned, geometry = frame.turn(labels, axes), frame.spec_in(spec, axes)
    assert turned.shape == geometry.size
    assert turned[tuple(geometry.index(np.array([there]))[0][0])] == 1
    assert is_same(frame.spec_from(geometry, axes), spec)


def test_notes_say_what_is_lost():
    target = spec_of((20, 20, 10), (-2.0, -2.0, -1.0), (2.0, 2.0, 1.0))
    assert resampling_notes(target, target, "same") == []
    assert resampling_notes(target.with_size((40, 20, 10)), target, "finer") == []
    (coarse,) = resampling_notes(target.with_size((20, 20, 5)), target, "coarse")
    assert (
        coarse
        == "the voxels of the grid coarse are larger than those that are written: 0.2 x 0.2 x 0.4 "
        "m, not 0.2 x 0.2 x 0.2 m"
    )
    (small,) = resampling_notes(
        spec_of((10, 20, 10), (0.0, -2.0, -1.0), (2.0, 2.0, 1.0)), target, "half"
    )
    assert small == "the grid half covers 50% of the volume that is written: the rest is unknown"
