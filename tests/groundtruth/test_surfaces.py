"""Meshes enclose the occupied cells, whatever block they are in; distances are those of a loop over
all voxels.
"""

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from carlasc import Grid, GridSpec
from carlasc.core.tables import CARLA
from carlasc.groundtruth.maps.map_files import MapCells, SurfaceMesh, write_distances

BOX = np.argwhere(np.ones((3, 4, 5)))


def meshed(cells, labels=None, size=(1.0, 1.0, 1.0)):
    labels = np.full(len(cells), 7) if labels is None else labels
    return SurfaceMesh.of(MapCells(cells, labels, np.zeros(3), np.array(size)))


@pytest.mark.parametrize("corner", [(0, 0, 0), (126, -2, 7), (-1, 127, -9)])
def test_a_box_has_its_size_on_both_sides_of_a_block(corner):
    trimesh = pytest.importorskip("trimesh")
    mesh = meshed(BOX + corner, size=(0.5, 1.0, 2.0))
    solid = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)
    assert solid.is_watertight and solid.is_winding_consistent
    assert_allclose(
        solid.bounds, [corner * np.array([0.5, 1, 2]), (corner + np.array([3, 4, 5])) * (0.5, 1, 2)]
    )
    assert 0.85 * 60 < solid.volume < 60  # outwards; marching cubes cuts the edges


def test_vertices_have_the_class_of_their_cell():
    pytest.importorskip("skimage")
    cells = np.array([[0, 0, 0], [2, 0, 0]])
    mesh = meshed(cells, np.array([3, 300]))
    assert_array_equal(mesh.labels, np.where(mesh.vertices[:, 0] < 1.5, 3, 300))
    assert len(mesh.faces) == 16


def test_a_mesh_is_written_with_colours(tmp_path):
    trimesh = pytest.importorskip("trimesh")
    pytest.importorskip("skimage")
    mesh = meshed(np.array([[0, 0, 0], [0, 0, 2]]), np.array([1, 7]))
    mesh.write(tmp_path / "mesh.ply", CARLA)
    read = trimesh.load(tmp_path / "mesh.ply", process=False)
    assert_allclose(read.vertices, mesh.vertices)
    expected = [CARLA.colors[int(label)] for label in mesh.labels]
    assert_array_equal(read.visual.vertex_colors[:, :3], expected)


def plain_distances(grid):
    """Return the distances by comparing each voxel with every other one."""
    centers = grid.spec.centers().reshape(-1, 3)
    known, occupied = grid.known.reshape(-1), (grid.known & (grid.labels > 0)).reshape(-1)
    far = np.linalg.norm(centers[:, None] - centers, axis=2)
    outside, inside = far[:, occupied].min(axis=1), far[:, ~occupied].min(axis=1)
    return np.where(known, np.where(occupied, -inside, outside), np.nan).reshape(grid.spec.size)


def test_distances_are_those_of_a_loop_over_all_voxels(tmp_path):
    pytest.importorskip("scipy")
    rng, spec = (
        np.random.default_rng(1),
        GridSpec("cartesian", (9, 8, 5), (-2, -2, -1), (2.5, 2, 0.5)),
    )
    labels = np.where(rng.random(spec.size) < 0.1, 5, 0).astype(np.uint8)
    grid = Grid(spec, labels, np.where(rng.random(spec.size) < 0.8, 3, 0).astype(np.float32))
    write_distances(tmp_path / "far.npz", grid)
    made = np.load(tmp_path / "far.npz")
    assert made["distance"].dtype == np.float32
    assert_allclose(made["distance"], plain_distances(grid), rtol=1e-6)
    assert_allclose(made["lower"] + made["voxel_size"] * spec.size, made["upper"])


@pytest.mark.parametrize(("label", "expected"), [(0, np.inf), (4, -np.inf)])
def test_without_a_surface_distances_are_infinite(tmp_path, label, expected):
    pytest.importorskip("scipy")
    spec = GridSpec("cartesian", (2, 2, 2), (0, 0, 0), (1, 1, 1))
    write_distances(tmp_path / "far.npz", Grid(spec, np.full(spec.size, label, np.uint8)))
    assert (np.load(tmp_path / "far.npz")["distance"] == expected).all()
