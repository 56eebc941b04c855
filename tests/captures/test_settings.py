"""The model of a LiDAR, and where the sensors are."""

from __future__ import annotations

import numpy as np
import pytest
from helpers.errors import raises

from carlasc.captures import Lidar
from carlasc.captures.settings import sensor_offsets
from carlasc.errors import ArgumentError


def test_rays_span_the_field_of_view_of_the_data_set() -> None:
    directions = Lidar(channels=64, points=6400).directions
    assert directions.shape == (6400, 3)
    np.testing.assert_allclose(np.linalg.norm(directions, axis=1), 1.0)
    elevation = np.degrees(np.arcsin(directions[:, 2]))
    assert elevation.max() == pytest.approx(2.0)
    assert elevation.min() == pytest.approx(-25.0)
    assert len(np.unique(np.round(elevation, 6))) == 64


def test_channels_run_from_top_to_bottom_and_their_azimuth_grows_from_behind() -> None:
    directions = Lidar(channels=2, points=8).directions.reshape(2, 4, 3)
    assert (directions[0, :, 2] > directions[1, :, 2]).all()
    azimuth = np.degrees(np.arctan2(directions[1, :, 1], directions[1, :, 0]))
    np.testing.assert_allclose(azimuth, [-180.0, -90.0, 0.0, 90.0])


def test_the_default_is_the_lidar_of_the_data_set() -> None:
    lidar = Lidar()
    assert (lidar.channels, lidar.points, lidar.range_m, lidar.noise_m) == (64, 130_000, 50.0, 0.02)
    assert 129_000 <= len(lidar.directions) <= 130_000


@pytest.mark.parametrize(
    ("settings", "word"),
    [
        ({"channels": 0}, "channels"),
        ({"points": 3}, "points"),
        ({"range_m": 0.0}, "range_m"),
        ({"range_m": 1000.0}, "range_m"),
        ({"range_m": float("nan")}, "range_m"),
        ({"noise_m": -0.1}, "noise_m"),
        ({"noise_m": float("inf")}, "noise_m"),
        ({"upper_deg": -30.0}, "upper_deg"),
        ({"upper_deg": 91.0}, "upper_deg"),
        ({"lower_deg": -91.0}, "upper_deg"),
    ],
)
def test_values_out_of_range_are_refused(settings: dict[str, float], word: str) -> None:
    with raises(ArgumentError, where=f"^{word}$"):
        Lidar(**settings)  # type: ignore[arg-type]


def test_the_ego_sensor_is_first_and_the_others_fill_their_box() -> None:
    offsets = sensor_offsets(2000, np.random.default_rng(0))
    assert offsets[0].tolist() == [-0.5, 0.0, 1.8]
    low, high = offsets[1:].min(axis=0), offsets[1:].max(axis=0)
    np.testing.assert_allclose(low, [-20.0, -20.0, 1.0], atol=0.2)
    np.testing.assert_allclose(high, [20.0, 20.0, 5.0], atol=0.2)
    assert (low >= (-20, -20, 1)).all() and (high <= (20, 20, 5)).all()
