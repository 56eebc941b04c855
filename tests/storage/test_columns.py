from __future__ import annotations

import numpy as np
import pytest
from helpers.errors import raises

from carlasc.errors import FormatError
from carlasc.storage.packed.columns import narrow, quantise


@pytest.mark.parametrize(
    ("highest", "wanted"),
    [(0, "u1"), (255, "u1"), (256, "<u2"), (65535, "<u2"), (65536, "<u4"), (2**32 - 1, "<u4")],
)
def test_labels_take_the_narrowest_type(highest: int, wanted: str) -> None:
    labels = np.array([0, highest], np.uint32)
    assert narrow(labels).dtype == wanted
    assert narrow(labels).tolist() == labels.tolist()


@pytest.mark.parametrize(
    ("count", "wanted"),
    [
        (255.0, "u1"),
        (256.0, "<u2"),
        (2.0**31, "<u4"),
        (2.0**32, "<f4"),
        (0.5, "<f4"),
        (-0.0, "<f4"),
        (-1.0, "<f4"),
    ],
)
def test_counts_take_the_narrowest_type_that_gives_every_bit_back(
    count: float, wanted: str
) -> None:
    counts = np.array([1, count], np.float32)
    assert narrow(counts).dtype == wanted
    assert narrow(counts).astype(np.float32).tobytes() == counts.tobytes()


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_counts_that_are_not_finite_stay_as_they_are(value: float) -> None:
    counts = np.array([1, value], np.float32)
    assert narrow(counts).tobytes() == counts.tobytes()


def test_an_empty_array_is_narrow() -> None:
    assert narrow(np.empty(0, np.uint32)).dtype == np.uint8
    assert narrow(np.empty(0, np.float32)).dtype == np.uint8


def test_coordinates_are_rounded_to_the_nearest_step() -> None:
    assert quantise(np.array([0.0014, 0.0016, -0.0016], np.float32), 0.001).tolist() == [1, 2, -2]


@pytest.mark.parametrize("coordinate", [np.nan, np.inf, -np.inf, 2.0**31, -(2.0**31)])
def test_coordinates_that_no_step_stands_for_are_refused(coordinate: float) -> None:
    with raises(FormatError, expected="finite coordinates within 2147483648 m"):
        quantise(np.array([1.0, coordinate]), 1.0)
    assert quantise(np.array([2.0**31 - 1]), 1.0).tolist() == [2**31 - 1]
