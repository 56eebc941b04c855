import numpy as np
import pytest

from carlasc.core.grids import Grid, GridSpec
from carlasc.errors import ArgumentError
from carlasc.metrics import VoxelOutcome, compare_grids

SPEC = GridSpec("cartesian", (7, 1, 1), (0, 0, 0), (7, 1, 1))


def grid(labels, counts=None):
    counts = None if counts is None else np.array(counts, np.float32).reshape(SPEC.size)
    return Grid(SPEC, np.array(labels, np.uint8).reshape(SPEC.size), counts)


def test_each_kind_of_error_is_found_where_the_truth_is_known():
    prediction, truth = (
        grid([7, 7, 0, 7, 0, 7, 0]),
        grid([7, 10, 7, 0, 0, 7, 7], [1, 1, 1, 1, 1, 0, 0]),
    )
    outcomes = compare_grids(prediction, truth)
    assert outcomes.dtype == np.uint8 and outcomes.shape == SPEC.size
    none = VoxelOutcome.NOT_COMPARED
    expected = [
        VoxelOutcome.RIGHT,
        VoxelOutcome.WRONG,
        VoxelOutcome.MISSED,
        VoxelOutcome.INVENTED,
        none,
        none,
        none,
    ]
    assert outcomes.reshape(-1).tolist() == expected


def test_a_truth_without_counts_is_known_everywhere():
    outcomes = compare_grids(grid([0] * 6 + [3]), grid([0] * 7))
    assert outcomes.reshape(-1).tolist() == [0] * 6 + [VoxelOutcome.INVENTED]


def test_counts_of_the_prediction_are_ignored():
    truth, labels = grid([1, 2, 0, 0, 0, 0, 5]), [1, 3, 0, 4, 0, 0, 0]
    np.testing.assert_array_equal(
        compare_grids(grid(labels), truth), compare_grids(grid(labels, [0] * 7), truth)
    )


@pytest.mark.parametrize(
    "other",
    [
        SPEC.with_size((3, 1, 1)),
        GridSpec("cartesian", (7, 1, 1), (1, 0, 0), (8, 1, 1)),
    ],
)
def test_grids_of_different_geometry_are_refused(other):
    with pytest.raises(ArgumentError, match="truth: expected the geometry of the predicted grid"):
        compare_grids(grid([0] * 7), Grid(other, np.zeros(other.size, np.uint8)))
