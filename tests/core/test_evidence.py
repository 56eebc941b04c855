import numpy as np
import pytest

import carlasc
from carlasc.core import VoxelFlag
from carlasc.core.grids import is_confident


def test_the_bits_are_those_of_the_format():
    assert [(flag.name, flag.value) for flag in VoxelFlag] == [
        ("INFERRED", 1),
        ("CONTESTED", 2),
        ("SEEN_NOW", 4),
        ("IN_ACTOR", 8),
    ]
    flags = np.array([0, 1, 5, 14, 15], np.uint8)
    assert (flags & carlasc.VoxelFlag.INFERRED != 0).tolist() == [False, True, True, False, True]


@pytest.mark.parametrize(
    ("min_confidence", "expected"),
    [(0, [1, 1, 1, 1, 1]), (0.5, [1, 1, 1, 1, 1]), (0.75, [1, 1, 0, 0, 1]), (0.9, [1, 0, 0, 0, 1])],
)
def test_a_voxel_is_confident_if_it_is_free_or_occupied_with_some_probability(min_confidence, expected):
    occupied = np.array([0.05, 0.25, 0.5, 0.7, 1.0])
    assert is_confident(occupied, min_confidence).tolist() == [bool(value) for value in expected]


def test_confidence_is_that_of_the_file_and_not_a_number_is_none():
    p = np.array([[0.8, np.nan]])
    assert float(np.float16(0.8)) < 0.8
    assert is_confident(p, 0.8).tolist() == is_confident(p.astype(np.float16), 0.8).tolist() == [[True, False]]
