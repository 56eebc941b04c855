import json

import numpy as np
import pytest
from typer.testing import CliRunner

import carlasc
from carlasc import GridSpec
from carlasc.cli import app
from carlasc.core import CARLA, CameraModel
from carlasc.core.cameras import optical_axes
from carlasc.errors import ArgumentError, MissingDataError
from carlasc.storage import FolderSink
from carlasc.storage.camera_files import cameras_to_json, encode_image
from carlasc.viewing import overlay

pytest.importorskip("PIL")
SPEC = GridSpec("cartesian", (20, 10, 5), (0.0, -5.0, -2.0), (20.0, 5.0, 3.0))
GREY = 100


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    """Two frames with a camera that looks along x, a vehicle of one voxel, and a building of one
    voxel behind it and one beside it.
    """
    root = tmp_path_factory.mktemp("scene")
    writer = FolderSink(root).sequence("Train/A/cartesian")
    matrix = np.array([[100.0, 0, 99.5], [0, 100, 59.5], [0, 0, 1]])
    place = optical_axes((1.0, 0.0), "left")
    camera = CameraModel(name="front", width=200, height=120, matrix=matrix, sensor_T_camera=place)
    writer.write_document("cameras.json", cameras_to_json([camera]))
    writer.write_document("evaluation/params.json", json.dumps(SPEC.to_params()).encode())
    labels = np.zeros(SPEC.size, np.uint32)
    labels[8, 5, 2], labels[12, 5, 2], labels[12, 8, 2] = 10, 1, 1
    for frame in range(2):
        writer.write("evaluation/labels", frame, labels)
        writer.write("evaluation/counts", frame, np.ones(SPEC.size, np.float32))
        writer.write(
            "images.front.png", frame, encode_image(np.full((120, 200, 3), GREY, np.uint8), "PNG")
        )
    return root, camera


def pixel_of(camera, x, y, z):
    """Return row and column of a point of the scan's frame: x ahead, y to the right."""
    ((u, v),) = camera.project(np.array([[y, -z, x]]))
    return int(np.rint(v)), int(np.rint(u))


def test_voxels_are_drawn_where_they_are_and_hidden_ones_are_not(scene, tmp_path):
    from PIL import Image

    root, camera = scene
    result = overlay(root, "front", tmp_path / "a.png", opacity=0.5)
    picture = np.asarray(Image.open(tmp_path / "a.png")).astype(int)
    assert picture.shape == (120, 200, 3) and result.frames == (0,)
    expected = {label: (GREY + CARLA.palette[label].astype(int)) // 2 for label in (1, 10)}
    # the building behind is hidden
    assert np.abs(picture[pixel_of(camera, 8, 0.5, 0.5)] - expected[10]).max() <= 1
    assert np.abs(picture[pixel_of(camera, 12.2, 3.5, 0.5)] - expected[1]).max() <= 1
    for nothing in ((8, 1.5, 0.5), (8, 0.5, 2.0), (8, -0.5, 0.5)):
        assert (picture[pixel_of(camera, *nothing)] == GREY).all()
    drawn = (picture != GREY).any(axis=2).sum()
    assert drawn == pytest.approx((100 / 8) ** 2 + (100 / 12) ** 2 * 1.3, rel=0.25)


def test_the_command_draws_a_picture_and_a_film(scene, tmp_path):
    pytest.importorskip("imageio_ffmpeg")
    for name, frames in (("a.png", 1), ("b.gif", 2)):
        arguments = [
            "render",
            str(scene[0]),
            "--camera",
            "front",
            "-o",
            str(tmp_path / name),
            "--json",
        ]
        ran = CliRunner().invoke(app, arguments)
        assert ran.exit_code == 0, ran.output
        assert (
            json.loads(ran.output)["pictures"] == frames and (tmp_path / name).stat().st_size > 100
        )


def test_what_cannot_be_drawn_is_said_in_one_line(scene, tmp_path):
    root, _ = scene
    with pytest.raises(MissingDataError, match="expected the camera top, found front"):
        overlay(root, "top", tmp_path / "a.png")
    with pytest.raises(ArgumentError, match="opacity: expected 0 to 1"):
        overlay(root, "front", tmp_path / "a.png", opacity=2)
    with pytest.raises(ArgumentError, match="a single frame for a PNG"):
        overlay(carlasc.Scene(root, frames="0:2"), "front", tmp_path / "a.png")
    assert not (tmp_path / "a.png").exists()
