import numpy as np
import pytest

from carlasc.core.scans import Scan, check_finite
from carlasc.errors import FormatError


def test_every_field_must_fit_the_points():
    points = np.zeros((3, 3), np.float32)
    for wrong, where, found in (
        ({"points": points, "labels": np.zeros(2, np.uint32)}, "scan labels", "(2,)"),
        ({"points": points, "flow": np.zeros((3, 2), np.float32)}, "scan flow", "(3, 2)"),
        ({"points": np.zeros((3, 4), np.float32)}, "scan", "(3, 4)"),
    ):
        with pytest.raises(FormatError) as error:
            Scan(**wrong)
        assert error.value.where.startswith(where) and error.value.found == found


def test_selecting_points_takes_every_field_along():
    scan = Scan(
        np.arange(9, dtype=np.float32).reshape(3, 3),
        labels=np.array([4, 5, 6], np.uint32),
        remission=np.array([1, 2, 3], np.float32),
    )
    part = scan.select(np.array([True, False, True]))
    assert len(part) == 2
    assert part.labels is not None
    assert part.labels.tolist() == [4, 6]
    assert part.remission is not None
    assert part.remission.tolist() == [1, 3]
    assert part.flow is None


def test_a_point_that_is_not_finite_is_named():
    points = np.zeros((4, 3), np.float32)
    points[2, 1] = np.inf
    with pytest.raises(FormatError) as error:
        check_finite(points, "velodyne/000001.bin")
    assert error.value.where == "velodyne/000001.bin"
    assert error.value.found.endswith("at point 2")
    check_finite(points[:2], "velodyne/000001.bin")
    check_finite(points[:0], "velodyne/000001.bin")
