"""The model of a LiDAR, and where the sensors are."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from helpers.errors import raises

from carlasc.captures import Lidar, LidarEffects
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


@pytest.mark.parametrize(
    ("name", "rays", "highest", "lowest", "widest"),
    [
        ("carlasc", 129_984, 2.0, -25.0, 27 / 63),
        ("hdl-64e", 133_312, 2.0, -24.33, 0.5),
        ("vlp-16", 28_800, 15.0, -15.0, 2.0),
        ("os1-128", 131_072, 22.5, -22.5, 45 / 127),
        ("pandar64", 115_200, 15.0, -25.0, 6.0),
    ],
)
def test_a_named_lidar_has_the_angles_of_its_data_sheet(
    name: Any, rays: int, highest: float, lowest: float, widest: float
) -> None:
    lidar = Lidar.named(name)
    assert len(lidar.directions) == rays
    elevations = np.degrees(np.arcsin(lidar.directions[:: lidar.points // lidar.channels, 2]))
    assert elevations[[0, -1]] == pytest.approx([highest, lowest], abs=1e-9)
    assert -np.diff(elevations).min() == pytest.approx(widest, abs=0.01)


def test_scans_of_a_lidar_without_channels_differ_and_are_even() -> None:
    lidar = Lidar.named("mid-360", points=5000)
    first, next = lidar.directions, lidar.directions_of(1)
    assert not np.isclose(first[:, None, :100], next[None, :100]).all(axis=-1).any()
    assert (np.diff(lidar.phases) > 0).all()
    for rays in (first, next, lidar.directions_of(700)):
        elevation = np.degrees(np.arcsin(rays[:, 2]))
        in_each = np.histogram(elevation, 20, (-7, 52))[0]
        assert in_each.sum() == 5000
        assert np.abs(in_each - 250).max() < 15
    spinning = Lidar(channels=2, points=8)
    np.testing.assert_array_equal(spinning.directions_of(5), spinning.directions)
    assert spinning.phases.tolist() == [0, 0.25, 0.5, 0.75] * 2


@pytest.mark.parametrize("name", ["drop_outs", "range_noise", "reflections", "rain"])
@pytest.mark.parametrize("value", [-0.1, 1.5, float("nan")])
def test_effects_are_shares(name: str, value: float) -> None:
    with raises(ArgumentError, where=name, expected="0 to 1"):
        LidarEffects(**{name: value})
