"""Casting rays at meshes."""

from __future__ import annotations

import numpy as np
import pytest
from carlasc_recorders.town.meshes import MeshBuilder, RayScene, rotate_exactly

from carlasc.core.geometry import rotate_vectors, rotation_z, translation

pytest.importorskip("embreex", reason="the simulator needs carlasc[simulate]")
pytest.importorskip("trimesh", reason="the simulator needs carlasc[simulate]")


def test_a_ray_hits_the_nearest_triangle_at_its_exact_distance() -> None:
    builder = MeshBuilder()
    builder.boxes(1, (10, 0, -1), (2, 2, 2))
    builder.boxes(2, (20, 0, -1), (2, 2, 2))
    mesh = builder.build()
    scene = RayScene(mesh, np.zeros(3))
    directions = np.array([[1.0, 0.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
    rays, triangles, distances = scene.cast(np.array([0.0, 0.1, 0.2]), directions, 50.0)
    assert rays.tolist() == [0]
    assert mesh.labels[triangles].tolist() == [1]
    assert distances.tolist() == pytest.approx([9.0], abs=1e-6)
    assert np.abs(scene.normals(triangles)[0]).tolist() == [1.0, 0.0, 0.0]


def test_nothing_is_hit_beyond_the_range() -> None:
    builder = MeshBuilder()
    builder.boxes(1, (10, 0, -1), (2, 2, 2))
    scene = RayScene(builder.build(), np.zeros(3))
    assert len(scene.cast(np.zeros(3), np.array([[1.0, 0.0, 0.0]]), 8.9)[0]) == 0
    assert len(scene.cast(np.zeros(3), np.array([[1.0, 0.0, 0.0]]), 9.1)[0]) == 1


def test_distances_do_not_depend_on_the_centre_of_the_scene() -> None:
    builder = MeshBuilder()
    builder.boxes(1, (1010, 500, -1), (2, 2, 2))
    scene = RayScene(builder.build(), np.array([1000.0, 500.0, 0.0]))
    _, _, distances = scene.cast(np.array([1000.0, 500.1, 0.2]), np.array([[1.0, 0.0, 0.0]]), 50.0)
    assert distances.tolist() == pytest.approx([9.0], abs=1e-6)


def test_the_exact_rotation_is_a_rotation() -> None:
    vectors = np.random.default_rng(0).normal(size=(50, 3))
    pose = translation((5.0, -3.0, 1.0)) @ rotation_z(0.7)
    np.testing.assert_allclose(
        rotate_exactly(pose, vectors), rotate_vectors(pose, vectors), atol=1e-12
    )
