import numpy as np
import pytest

from carlasc.core.cameras import CameraModel, optical_axes
from carlasc.errors import FormatError

K = np.array([[1100.0, 0, 799.5], [0, 1105, 449.5], [0, 0, 1]])
LENSES = {
    "pinhole": ("pinhole", ()),
    "kitti": ("radial-tangential", (-0.37, 0.2, 1e-3, -5e-4, -0.07)),
    "four": ("radial-tangential", (-0.05, 0.02, 1e-3, 2e-4)),
    "rational": ("radial-tangential", (0.3, 0.1, 1e-4, 2e-4, 0.01, 0.6, 0.2, 0.01)),
    "fisheye": ("fisheye", (0.05, -0.01, 0.002, -0.0003)),
}


def camera(model="pinhole", distortion=(), **changes):
    values = {
        "name": "front",
        "width": 1600,
        "height": 900,
        "matrix": K,
        "sensor_T_camera": optical_axes((1, 0), "right"),
    }
    return CameraModel(**values | {"model": model, "distortion": distortion} | changes)


@pytest.mark.parametrize("lens", LENSES)
def test_pixels_come_back_within_a_hundredth_of_a_pixel(lens):
    model, distortion = LENSES[lens]
    matrix = np.array([[700.0, 0, 799.5], [0, 705, 449.5], [0, 0, 1]]) if model == "fisheye" else K
    one = camera(model, distortion, matrix=matrix)
    pixels = np.random.default_rng(0).uniform((-0.5, -0.5), (1599.5, 899.5), (5000, 2))
    rays = one.unproject(pixels)
    there = np.isfinite(rays).all(axis=1)
    assert there.mean() > 0.99  # the strongest lens has corners that look nowhere
    assert np.abs(np.linalg.norm(rays[there], axis=1) - 1).max() < 1e-12
    assert np.abs(one.project(rays[there] * 7.3) - pixels[there]).max() < 0.01


@pytest.mark.parametrize("lens", ["pinhole", "kitti", "four", "rational", "fisheye"])
def test_points_are_projected_as_opencv_says(lens):
    """The formulas of OpenCV's documentation, point by point."""
    model, distortion = LENSES[lens]
    one = camera(model, distortion)
    for x, y, z in np.random.default_rng(1).uniform((-3, -2, 6), (3, 2, 20), (50, 3)):
        k = (*distortion, *[0.0] * (8 - len(distortion)))
        a, b = x / z, y / z
        r2 = a * a + b * b
        if model == "fisheye":
            r = np.sqrt(r2)
            t = np.arctan(r)
            scale = (t + k[0] * t**3 + k[1] * t**5 + k[2] * t**7 + k[3] * t**9) / r
            u, v = a * scale, b * scale
        else:
            f = (1 + k[0] * r2 + k[1] * r2**2 + k[4] * r2**3) / (
                1 + k[5] * r2 + k[6] * r2**2 + k[7] * r2**3
            )
            u = a * f + 2 * k[2] * a * b + k[3] * (r2 + 2 * a * a)
            v = b * f + k[2] * (r2 + 2 * b * b) + 2 * k[3] * a * b
        expected = (K @ (u, v, 1))[:2]
        assert np.allclose(one.project(np.array([[x, y, z]]))[0], expected, atol=1e-9)


def test_what_is_behind_or_beyond_the_lens_has_no_pixel():
    points = np.array([[0, 0, -1.0], [0, 0, 0.0], [3, 0, 1.0]])
    assert np.isnan(camera().project(points)[:2]).all()
    # the last one would come back into the image
    assert np.isnan(camera(*LENSES["kitti"]).project(points)).all()
    # wider than half a turn
    assert np.isfinite(camera(*LENSES["fisheye"]).project(np.array([[1.0, 0, -0.1]]))).all()


@pytest.mark.parametrize("axes", ["left", "right"])
def test_a_camera_looks_along_its_axis_with_its_columns_to_the_right(axes):
    turn = optical_axes((0.0, 1.0), axes)[:3, :3]
    assert np.allclose(turn @ (0, 0, 1), (0, 1, 0)) and np.allclose(turn @ (0, 1, 0), (0, 0, -1))
    assert np.allclose(turn @ (1, 0, 0), (1, 0, 0) if axes == "right" else (-1, 0, 0))
    assert np.linalg.det(turn) == pytest.approx(1 if axes == "right" else -1)


def test_a_smaller_image_has_the_matrix_that_fits():
    small, points = camera().resized(400, 225), np.array([[1.0, 0.5, 7], [-2, 1, 9]])
    assert np.allclose((small.project(points) + 0.5) * 4, camera().project(points) + 0.5)


def test_a_camera_comes_back_from_its_text():
    one = camera(*LENSES["kitti"], times=np.array([0.01, np.nan]), images=("a.png", ""))
    again = CameraModel.from_dict(one.to_dict(), "cameras.json")
    assert again.to_dict() == one.to_dict() and np.isnan(again.times[1])


@pytest.mark.parametrize(
    "change, expected",
    [
        ({"model": "omnidirectional"}, "one of the models pinhole"),
        ({"distortion": (0.1,)}, "0 coefficients of distortion"),
        ({"name": "../front"}, "a name of letters"),
        ({"width": 0}, "a width of 1 to 65536"),
        ({"matrix": np.eye(4)}, "a matrix of fx s cx"),
        ({"matrix": np.diag([0.0, 1, 1])}, "a matrix of fx s cx"),
        ({"sensor_T_camera": 2 * np.eye(4)}, "a rigid transform"),
    ],
)
def test_what_is_no_camera_is_refused_in_one_line(change, expected):
    with pytest.raises(FormatError) as error:
        camera(**change)
    assert error.value.expected.startswith(expected)
    assert "\n" not in str(error.value)
    about = camera().to_dict() | {
        name: np.asarray(value).tolist() for name, value in change.items()
    }
    with pytest.raises(FormatError) as error:
        CameraModel.from_dict(about, "cameras.json")
    assert error.value.where.startswith("cameras.json")


def test_a_camera_that_lacks_a_value_is_refused():
    about = camera().to_dict()
    del about["matrix"]
    with pytest.raises(FormatError) as error:
        CameraModel.from_dict(about, "cameras.json")
    assert error.value.where.startswith("cameras.json") and "matrix" in error.value.found
