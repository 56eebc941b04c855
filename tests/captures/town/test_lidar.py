from __future__ import annotations

import numpy as np
import pytest

from carlasc.captures import Lidar
from carlasc.captures.town.meshes import MeshBuilder
from carlasc.captures.town.rays import RayScene
from carlasc.errors import ArgumentError


def test_rays_span_the_data_sets_field_of_view() -> None:
    directions = Lidar(channels=64, points=6400).directions
    assert directions.shape == (6400, 3)
    np.testing.assert_allclose(np.linalg.norm(directions, axis=1), 1.0)
    elevation = np.degrees(np.arcsin(directions[:, 2]))
    assert elevation.max() == pytest.approx(2.0)
    assert elevation.min() == pytest.approx(-25.0)
    assert len(np.unique(np.round(elevation, 6))) == 64


def test_the_default_is_about_130_000_rays() -> None:
    assert 129_000 <= len(Lidar().directions) <= 130_000


def test_a_ray_meets_the_nearest_triangle_at_its_true_distance() -> None:
    builder = MeshBuilder()
    builder.boxes(1, (10, 0, -1), (2, 2, 2))
    builder.boxes(2, (20, 0, -1), (2, 2, 2))
    mesh = builder.build()
    scene = RayScene(mesh, np.zeros(3))
    directions = np.array([[1.0, 0.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
    rays, triangles, distances = scene.cast(np.array([0.0, 0.1, 0.2]), directions, 50.0)
    assert rays.tolist() == [0]
    assert mesh.labels[triangles].tolist() == [1]
    np.testing.assert_allclose(distances, 9.0, atol=1e-6)


def test_nothing_is_seen_beyond_the_range() -> None:
    builder = MeshBuilder()
    builder.boxes(1, (10, 0, -1), (2, 2, 2))
    scene = RayScene(builder.build(), np.zeros(3))
    assert len(scene.cast(np.zeros(3), np.array([[1.0, 0.0, 0.0]]), 8.9)[0]) == 0
    assert len(scene.cast(np.zeros(3), np.array([[1.0, 0.0, 0.0]]), 9.1)[0]) == 1


@pytest.mark.parametrize(
    ("settings", "word"),
    [
        ({"channels": 0}, "channels"),
        ({"points": 3}, "points"),
        ({"range_m": 0.0}, "range_m"),
        ({"range_m": 1000.0}, "range_m"),
        ({"range_m": float("nan")}, "range_m"),
        ({"noise_m": -0.1}, "noise_m"),
        ({"upper_deg": -30.0}, "upper_deg"),
    ],
)
def test_a_senseless_lidar_is_refused(settings: dict[str, float], word: str) -> None:
    with pytest.raises(ArgumentError, match=word):
        Lidar(**settings)  # type: ignore[arg-type]
