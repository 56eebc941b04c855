import numpy as np
import pytest

from carlasc.core.grids import GridSpec
from carlasc.viewing.rendering.meshes import arrows, box, footprint, grid_mesh, quads

SPECS = [
    GridSpec("cartesian", (6, 5, 4), (-3, -2.5, -2), (3, 2.5, 2)),
    GridSpec.published("cylindrical").with_size((5, 40, 4)),
    # wide wedges, part of a turn
    GridSpec("cylindrical", (5, 6, 4), (1.0, -1.0, -2.0), (6.0, 2.0, 2.0)),
]


def mesh_of(spec, cells):
    occupied = np.zeros(spec.size, bool)
    occupied[tuple(np.transpose(cells))] = True
    return grid_mesh(spec, np.zeros((*spec.size, 3), np.uint8), occupied)


def test_the_faces_of_voxels_are_those_between_occupied_and_not():
    spec = SPECS[0]
    assert len(mesh_of(spec, [(2, 2, 2)])) == 6
    assert len(mesh_of(spec, [(2, 2, 2), (3, 2, 2)])) == 10
    assert len(mesh_of(spec, [(0, 0, 0), (5, 4, 3)])) == 12
    full = [(x, y, z) for x in range(6) for y in range(5) for z in range(4)]
    assert len(mesh_of(spec, full)) == 2 * (6 * 5 + 5 * 4 + 6 * 4)


def test_a_full_turn_closes_on_itself():
    spec = SPECS[1]
    apart = mesh_of(spec, [(3, 0, 1), (3, 20, 1)])
    neighbours = mesh_of(spec, [(3, 0, 1), (3, 39, 1)])
    assert len(neighbours) < len(apart)


@pytest.mark.parametrize("spec", SPECS)
def test_normals_point_out_of_the_voxel_and_lie_on_its_cell(spec):
    cell = (2, 3, 1)
    mesh = mesh_of(spec, [cell])
    middle = spec.from_axes(spec.centers()[cell])
    centers = mesh.corners.mean(1)
    assert (np.einsum("qc,qc->q", mesh.normals, centers - middle) > 0).all()
    np.testing.assert_allclose(np.linalg.norm(mesh.normals, axis=1), 1, atol=1e-5)
    axes = spec.to_axes(mesh.corners.reshape(-1, 3).astype(float))
    lower = [spec.edges(a)[cell[a]] for a in range(3)]
    upper = [spec.edges(a)[cell[a] + 1] for a in range(3)]
    assert (axes >= np.array(lower) - 1e-4).all() and (axes <= np.array(upper) + 1e-4).all()


def test_wide_wedges_follow_the_arc_without_lines_across_them():
    spec = SPECS[2]
    mesh = mesh_of(spec, [(4, 3, 1)])
    outer = mesh.normals[:, 2] == 0
    radii = np.linalg.norm(mesh.corners[..., :2], axis=-1)
    front = outer & (radii > 5.99).all(1)
    assert front.sum() == 8  # 0.5 rad in pieces of at most 4 degrees
    upright = mesh.edges[front][:, [0, 2]].sum(), mesh.edges[front][:, [1, 3]].sum()
    assert sorted(upright) == [2, 16]  # two ends, and top and bottom of every piece


def test_corners_between_voxels_see_less_sky():
    spec = SPECS[0]
    lone, under_a_wall = mesh_of(spec, [(2, 2, 0)]), mesh_of(spec, [(2, 2, 0), (3, 2, 1)])
    assert (lone.openness == 1).all()
    assert under_a_wall.openness.min() < 1


def test_the_ground_plan_has_the_area_of_the_grid():
    for spec, area in ((SPECS[0], 30.0), (SPECS[2], 3 / 2 * (36 - 1))):
        corners = footprint(spec, -2.0).astype(float)
        diagonals = np.cross(corners[:, 2] - corners[:, 0], corners[:, 3] - corners[:, 1])
        assert (diagonals[:, 2] > 0).all()
        assert np.linalg.norm(diagonals, axis=1).sum() / 2 == pytest.approx(area, rel=2e-3)


def test_boxes_and_arrows_are_closed_and_face_outwards():
    tail, way = np.array([[1.0, 2.0, 3.0]]), np.array([[4.0, -3.0, 0.0]])
    for mesh, middle in (
        (box((-1, -2, -3), (1, 2, 3), (1, 2, 3), taper=0.2), (0, 0, 0)),
        (arrows(tail, way, (0, 0, 0), 0.3), None),
    ):
        corners = mesh.corners.astype(float)
        # the divergence theorem: the volume within a closed surface that faces outwards is
        # positive, wherever the origin is
        volumes = []
        for origin in np.random.default_rng(0).normal(0, 5, (3, 3)):
            c = corners - origin
            one = np.einsum("qc,qc->q", c[:, 0], np.cross(c[:, 1], c[:, 2]))
            two = np.einsum("qc,qc->q", c[:, 0], np.cross(c[:, 2], c[:, 3]))
            volumes.append((one + two).sum() / 6)
        assert volumes[0] > 0
        np.testing.assert_allclose(volumes, volumes[0], rtol=1e-4)
        if middle is None:
            np.testing.assert_allclose(corners.reshape(-1, 3).max(0)[0], 5.0, atol=1e-5)


def test_quads_of_one_colour_have_unit_normals():
    mesh = quads([[(0, 0, 0), (2, 0, 0), (2, 3, 0), (0, 3, 0)]], (9, 8, 7))
    np.testing.assert_allclose(mesh.normals, [[0, 0, 1]])
    assert mesh.colors.tolist() == [[9, 8, 7]]


def test_a_floor_hides_the_lowest_faces_of_the_lowest_cells_alone():
    spec = GridSpec("cartesian", (3, 3, 3), (0.0, 0.0, 0.0), (3.0, 3.0, 3.0))
    occupied = np.zeros(spec.size, np.bool_)
    occupied[1, 1, [0, 2]] = True
    colors = np.zeros((*spec.size, 3), np.uint8)
    bare, standing = (
        grid_mesh(spec, colors, occupied, on_floor=on_floor) for on_floor in (False, True)
    )
    lowest = (bare.corners[:, :, 2] == 0).all(1)
    assert lowest.sum() == 1
    for name in ("corners", "normals", "colors", "openness", "edges", "open_sky"):
        np.testing.assert_array_equal(getattr(standing, name), getattr(bare, name)[~lowest])
