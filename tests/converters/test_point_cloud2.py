"""Points of any layout: holes, rows with padding, either order of bytes, and layouts that cannot
be.
"""

import numpy as np
import pytest
from carlasc_converters.point_fields import read_columns, unpack_fields
from helpers.converters.bags import VELODYNE, Messages
from helpers.errors import raises

from carlasc.errors import FormatError

pytestmark = pytest.mark.needs("rosbags")
LAYOUT = np.dtype(
    {
        "names": ["x", "y", "z", "t", "stamp", "reflectivity", "near_ir"],
        "formats": ["<f4", "<f4", "<f4", "<u4", "<f8", "<u2", "i1"],
        "offsets": [0, 4, 8, 20, 24, 32, 39],
        "itemsize": 48,
    }
)


def points_of(count, layout=LAYOUT):
    random = np.random.default_rng(1)
    points = np.zeros(count, layout)
    for name in layout.names:
        points[name] = (
            random.integers(-100, 100, count)
            if layout[name].kind == "i"
            else random.random(count) * 100
        )
    return points


@pytest.mark.parametrize("big_endian", [False, True])
@pytest.mark.parametrize(("height", "padding"), [(1, 0), (4, 0), (4, 5)])
def test_every_field_comes_back_to_the_bit(big_endian, height, padding):
    points = points_of(24)
    kind = {"height": height, "row_padding": padding, "big_endian": big_endian}
    columns = read_columns(Messages("db3").cloud("/points", 1, points, **kind)[3], "message")
    assert list(columns) == list(LAYOUT.names)
    for name, values in columns.items():
        assert values.astype(LAYOUT[name]).tobytes() == points[name].tobytes()


def test_data_of_another_size_are_named():
    message = Messages("bag").cloud("/points", 1, points_of(6, VELODYNE))[3]
    message.data = message.data[:-1]
    with raises(
        FormatError, where="message", expected="1 rows of 6 points of 32 bytes", found="191 bytes"
    ):
        read_columns(message, "message")


def test_a_field_outside_of_the_point_is_named():
    with raises(FormatError, expected="points of 8 bytes", found="the field z up to byte 12"):
        unpack_fields(np.zeros(8, np.uint8), [("x", 0, "f4", 1), ("z", 8, "f4", 1)], 8, "message")


def test_fields_of_several_values_or_of_unknown_types_are_left_out():
    fields = [
        ("x", 0, "f4", 1),
        ("descriptor", 4, "f4", 2),
        ("other", 4, "<V", 1),
        ("", 4, "f4", 1),
    ]
    assert list(unpack_fields(np.zeros(12, np.uint8), fields, 12, "message")) == ["x"]
