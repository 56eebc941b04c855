import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from carlasc.core.geometry import rotation_z, translation
from carlasc.errors import ArgumentError
from carlasc.viewing.rendering.cameras import Viewpoint, birdseye_camera, perspective_camera

BOX = np.array([(x, y, z) for x in (-25.6, 25.6) for y in (-25.6, 25.6) for z in (-2.0, 1.0)])
angles = st.floats(-3.1, 3.1)


@given(angles, st.floats(-1.5, 1.5), st.floats(0.2, 2.0), st.floats(0.3, 4.0), st.booleans())
def test_a_fitted_camera_sees_the_whole_scene_and_fills_the_picture(
    azimuth, elevation, fov, aspect, left_handed
):
    viewpoint = Viewpoint(azimuth_rad=azimuth, elevation_rad=elevation, fov_rad=fov)
    camera = perspective_camera(
        BOX, viewpoint, aspect, axes="left" if left_handed else "right", margin=0.0
    )
    columns, rows, depths = camera.project(BOX, round(1000 * aspect), 1000)
    assert (depths > 0).all()
    assert columns.min() > -1 and columns.max() < round(1000 * aspect) + 1
    assert rows.min() > -1 and rows.max() < 1001
    spans = np.ptp(columns) / round(1000 * aspect), np.ptp(rows) / 1000
    assert max(spans) > 0.95 or depths.min() == pytest.approx(1.0)  # nearer it does not come


@given(angles, st.floats(-1.5, 1.5), st.booleans())
def test_axes_are_unit_vectors_at_right_angles_and_up_is_up(azimuth, elevation, left_handed):
    camera = perspective_camera(
        BOX, Viewpoint(azimuth, elevation), 1.5, axes="left" if left_handed else "right"
    )
    np.testing.assert_allclose(camera.axes @ camera.axes.T, np.eye(3), atol=1e-9)
    assert camera.axes[1, 2] > 0
    assert abs(camera.axes[0, 2]) < 1e-9
    # right x up points at the viewer in a right-handed frame, away from it in a left-handed one
    assert np.linalg.det(camera.axes) == pytest.approx(1.0 if left_handed else -1.0)


@pytest.mark.parametrize(("left_handed", "right"), [(True, 1.0), (False, -1.0)])
def test_the_vehicles_right_is_on_the_right(left_handed, right):
    beside = np.array([[10.0, 5.0 * right, -1.0], [10.0, -5.0 * right, -1.0]])
    for camera in (
        perspective_camera(BOX, Viewpoint(), 1.5, axes="left" if left_handed else "right"),
        birdseye_camera(BOX, 1.5, axes="left" if left_handed else "right"),
    ):
        columns, rows, _ = camera.project(beside, 300, 200)
        assert columns[0] > 150 > columns[1]
        assert rows[0] == pytest.approx(rows[1])
        assert (rows < 100).all()


def test_azimuth_90_stands_on_the_vehicles_right():
    for left_handed in (True, False):
        camera = perspective_camera(
            BOX, Viewpoint(azimuth_rad=np.pi / 2), 1.5, axes="left" if left_handed else "right"
        )
        assert camera.position[1] * (1 if left_handed else -1) > 20
        assert abs(camera.position[0]) < 1e-6


def test_a_ray_through_a_pixel_meets_what_is_projected_there():
    point = np.array([[7.0, -4.0, 0.5]])
    for camera in (perspective_camera(BOX, Viewpoint(0.4, 0.5), 1.6), birdseye_camera(BOX, 1.6)):
        column, row, depth = (float(value[0]) for value in camera.project(point, 160, 100))
        origins, directions = camera.rays(160, 100, slice(int(row), int(row) + 1))
        met = origins[int(column)] + depth * directions[int(column)]
        assert np.linalg.norm(met - point[0]) < 1.5 * camera.footprint(100) * (
            1 if camera.orthographic else depth
        )


def test_a_moved_camera_sees_the_same_of_a_moved_scene():
    there_T_here = translation((3, -8, 1)) @ rotation_z(0.7)
    camera = perspective_camera(BOX, Viewpoint(), 1.5)
    moved = camera.moved(there_T_here)
    points = BOX @ there_T_here[:3, :3].T + there_T_here[:3, 3]
    np.testing.assert_allclose(
        moved.project(points, 300, 200), camera.project(BOX, 300, 200), atol=1e-9
    )


def test_a_viewpoint_is_read_from_words():
    viewpoint = Viewpoint.parse("azimuth=90 elevation=30; distance=50 target=1,2,3 fov=60")
    assert viewpoint.azimuth_rad == pytest.approx(np.pi / 2)
    assert viewpoint.elevation_rad == pytest.approx(np.pi / 6)
    assert (viewpoint.distance_m, viewpoint.target) == (50.0, (1.0, 2.0, 3.0))
    assert viewpoint.fov_rad == pytest.approx(np.pi / 3)
    placed = perspective_camera(BOX, Viewpoint.parse("position=-20,0,10 target=0,0,0"), 1.5)
    np.testing.assert_allclose(placed.position, (-20, 0, 10))
    assert placed.axes[2] @ np.array([20, 0, -10]) == pytest.approx(np.sqrt(500))


@pytest.mark.parametrize(
    "text",
    [
        "azimuth",
        "azimuth=x",
        "zoom=3",
        "target=1,2",
        "distance=0",
        "distance=-1",
        "fov=0",
        "fov=180",
        "elevation=91",
    ]
    + ["azimuth=nan", "distance=inf", "position=1,2,nan"],
)
def test_an_impossible_viewpoint_is_refused(text):
    with pytest.raises(ArgumentError, match="viewpoint"):
        Viewpoint.parse(text)


def test_a_camera_at_its_own_target_is_refused():
    with pytest.raises(ArgumentError, match="away from the position"):
        perspective_camera(BOX, Viewpoint(position=(1, 2, 3), target=(1, 2, 3)), 1.5)
    with pytest.raises(ArgumentError, match="orbit"):
        Viewpoint(position=(1, 2, 3)).turned(0.1)
