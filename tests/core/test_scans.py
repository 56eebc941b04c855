import numpy as np
import pytest

from carlasc.core.scans import Scan, check_finite
from carlasc.errors import FormatError


def test_every_field_must_fit_the_points():
    points = np.zeros((3, 3), np.float32)
    with pytest.raises(
        FormatError, match=r"scan labels: expected shape \(3,\) for 3 points, found \(2,\)"
    ):
        Scan(points, labels=np.zeros(2, np.uint32))
    with pytest.raises(FormatError, match="scan flow"):
        Scan(points, flow=np.zeros((3, 2), np.float32))
    with pytest.raises(FormatError, match=r"expected shape \(N, 3\), found \(3, 4\)"):
        Scan(np.zeros((3, 4), np.float32))


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
    with pytest.raises(FormatError, match=r"velodyne/000001.bin: .*at point 2"):
        check_finite(points, "velodyne/000001.bin")
    check_finite(points[:2], "velodyne/000001.bin")
    check_finite(points[:0], "velodyne/000001.bin")
