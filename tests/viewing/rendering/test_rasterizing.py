from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from carlasc.core.grids import GridSpec
from carlasc.viewing.rendering.cameras import Camera, Viewpoint, birdseye_camera, perspective_camera
from carlasc.viewing.rendering.meshes import box, footprint, grid_mesh, join, quads
from carlasc.viewing.rendering.rasterizing import hits, visible_triangles

pytest.importorskip("embreex")
from embreex.mesh_construction import TriangleMesh
from embreex.rtcore_scene import EmbreeScene

WIDTH, HEIGHT = 160, 90
VIEWS = {
    "behind": Viewpoint(),
    "turned": Viewpoint(azimuth_rad=0.7, elevation_rad=0.3),
    "below": Viewpoint(azimuth_rad=0.2, elevation_rad=-0.5),
    "inside": Viewpoint(position=(-1.3, 0.4, 0.2), target=(6.0, 0.1, -0.6), fov_rad=1.3),
}


def cast_rays(mesh, camera):
    """Return what a ray through every sample hits, by Embree."""
    scene = EmbreeScene()
    geometry = TriangleMesh(scene, *mesh.triangles())
    found = scene.run(*camera.rays(WIDTH, HEIGHT, slice(0, HEIGHT)), output=True)
    del geometry
    return found


def check(mesh, camera, share=2e-4):
    """Compare with rays; only samples on an edge, at most a share of all, may show another face,
    which is equally near.
    """
    origins, directions = camera.rays(WIDTH, HEIGHT, slice(0, HEIGHT))
    triangle = visible_triangles(mesh, camera, WIDTH, HEIGHT).reshape(-1)
    expected = cast_rays(mesh, camera)
    u, v, depth = hits(mesh.corners, triangle, origins, directions)
    same = triangle == expected["primID"]
    assert (~same).mean() <= share
    cosine = (mesh.normals[triangle >> 1] * directions).sum(1) / np.linalg.norm(directions, axis=1)
    # along a face, single precision is only as exact as that
    hit = same & (triangle >= 0) & (abs(cosine) > 0.05)
    np.testing.assert_allclose(u[hit], expected["u"][hit], atol=1e-4)
    np.testing.assert_allclose(v[hit], expected["v"][hit], atol=1e-4)
    np.testing.assert_allclose(depth[hit], expected["tfar"][hit], rtol=1e-5, atol=1e-4)
    assert np.isinf(depth[triangle < 0]).all()
    return hit.mean()


def town(coordinates):
    lower = (0.2, -np.pi, -2.0) if coordinates == "cylindrical" else (-8.0, -8.0, -2.0)
    spec = GridSpec(
        coordinates, (24, 32, 6), lower, (8.0, np.pi if coordinates == "cylindrical" else 8.0, 1.0)
    )
    occupied = np.random.default_rng(3).random(spec.size) < 0.15
    mesh = grid_mesh(spec, np.zeros((*spec.size, 3), np.uint8), occupied)
    floor = quads(footprint(spec, spec.lower[2] - 2e-3), (9, 9, 9))
    return join([mesh, floor, box((-1.7, -0.9, -1.6), (2.7, 0.9, -0.9), (5, 5, 5), taper=0.2)])


@pytest.mark.parametrize("view", VIEWS)
@pytest.mark.parametrize("coordinates", ["cartesian", "cylindrical"])
def test_samples_show_what_rays_hit(coordinates, view):
    mesh = town(coordinates)
    camera = perspective_camera(
        mesh.corners.reshape(-1, 3).astype(float), VIEWS[view], WIDTH / HEIGHT
    )
    assert check(mesh, camera) > 0.3


def test_a_camera_above_shows_what_parallel_rays_hit():
    mesh = town("cartesian")
    # no row of samples is on edges
    extent = mesh.corners.reshape(-1, 3).astype(float) + (
        0.013,
        0.007,
        0.0,
    )
    assert check(mesh, birdseye_camera(extent, WIDTH / HEIGHT)) > 0.3


@settings(max_examples=60, deadline=None)
@given(st.integers(0, 2**32 - 1), st.booleans())
def test_triangles_anywhere_also_around_and_behind_the_camera(seed, orthographic):
    rng = np.random.default_rng(seed)
    middle, one, two = rng.normal(scale=(4, 4, 4), size=(3, 12, 1, 3))
    corners = (
        middle + np.concatenate([-one - two, one - two, one + two, two - one], axis=1)
    ).astype(np.float32)
    camera = Camera(
        rng.normal(size=3), np.linalg.qr(rng.normal(size=(3, 3)))[0], 0.7, orthographic=orthographic
    )
    check(quads(corners, (1, 2, 3)), camera, share=2e-3)


def test_faces_with_a_common_edge_leave_no_gap():
    x = np.linspace(-3, 3, 40)
    corners = [
        [(a, c, 0), (b, c, 0), (b, d, 0), (a, d, 0)] for a, b in pairwise(x) for c, d in pairwise(x)
    ]
    camera = Camera(
        np.array([0.1, 0.2, 1.0]),
        np.array([[1.0, 0, 0], [0, 1, 0], [0, 0, -1]]) * [[1], [-1], [1]],
        1.0,
    )
    assert (visible_triangles(quads(corners, (1, 2, 3)), camera, WIDTH, HEIGHT) >= 0).all()


def test_a_face_seen_from_its_edge_shows_nothing():
    face = quads([[(1, 0, 2), (2, 0, 4), (3, 0, 6), (4, 0, 8)]], (1, 2, 3))
    camera = Camera(np.zeros(3), np.eye(3), 1.0)
    assert (visible_triangles(face, camera, WIDTH, HEIGHT) == -1).all()


def test_a_ray_along_a_face_raises_nothing():
    face = quads([[(1, 0, 2), (2, 0, 4), (3, 0, 6), (4, 0, 8)]], (1, 2, 3))
    origins, directions = np.zeros((1, 3), np.float32), np.array([[0.5, 0, 1]], np.float32)
    assert not np.isfinite(hits(face.corners, np.zeros(1, np.int32), origins, directions)[2]).any()
