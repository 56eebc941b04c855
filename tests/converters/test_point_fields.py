"""Fields of points by their usual names, and the unit of their times."""

import numpy as np
from carlasc_converters.point_fields import named_fields, point_seconds
from helpers.errors import raises
from hypothesis import given
from hypothesis import strategies as st

from carlasc.errors import FormatError

UNITS = {"s": 10**9, "ms": 10**6, "us": 10**3, "ns": 1}


@given(st.sampled_from(sorted(UNITS)), st.floats(0.005, 0.5), st.booleans())
def test_the_unit_is_found_from_the_span_of_a_scan_and_times_come_back(unit, span, absolute):
    start = 1_700_000_000_000_000_000 if absolute else 0
    seconds = np.linspace(0, span, 50)
    times = seconds * 1e9 / UNITS[unit]
    times = times.astype(np.int64) + start if unit == "ns" else times + start / UNITS[unit]
    found, begin, said = point_seconds(times, "auto", "x")
    assert said == unit
    assert (begin is not None) == absolute
    np.testing.assert_allclose(found, seconds, atol=1e-6 if absolute else 1e-9)


def test_a_span_that_no_lidar_has_asks_for_the_unit():
    with raises(
        FormatError,
        where="x: times of points",
        expected="a scan of 4 ms to 0.6 s",
        advice="`time_unit`",
    ):
        point_seconds(np.array([0.0, 2.0]), "auto", "x")
    assert point_seconds(np.array([0.0, 2.0]), "s", "x")[0].tolist() == [0, 2]
    with raises(FormatError, expected="finite"):
        point_seconds(np.array([0.0, np.nan]), "s", "x")


def test_a_column_that_nobody_filled_has_no_unit():
    seconds, begin, _ = point_seconds(np.zeros(3), "auto", "x")
    assert seconds.tolist() == [0, 0, 0] and begin is None


def test_names_are_recognised_in_any_case_and_absent_intensity_is_zero():
    columns = {
        "X": np.ones(2),
        "Y": np.ones(2),
        "Z": np.ones(2),
        "Reflectivity": np.array([3, 4], np.uint16),
    }
    assert named_fields(columns, "x")["points"].tolist() == [[1, 1, 1, 3], [1, 1, 1, 4]]
    del columns["Reflectivity"]
    assert named_fields(columns | {"label": np.array([1.0, 2.0])}, "x")["label"].dtype == np.uint32
    with raises(FormatError, where="x: label", expected="whole numbers", found="1.5"):
        named_fields(columns | {"label": np.array([1.5, 2.0])}, "x")
    with raises(FormatError, expected="points with z", found="only X, Y"):
        named_fields({"X": np.ones(1), "Y": np.ones(1)}, "x")
