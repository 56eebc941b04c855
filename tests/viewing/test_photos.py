"""Images of cameras: small ones for pages, and the lines of what a camera sees."""

import io

import numpy as np
import pytest
from helpers.displays.browser import Page
from helpers.readers.page_arrays import unpack_arrays
from helpers.scenes.road_blocks import write_blocks
from PIL import Image

from carlasc.core.cameras import CameraModel, optical_axes
from carlasc.errors import FormatError
from carlasc.storage import FolderSink, layout
from carlasc.storage.camera_files import cameras_to_json, encode_image
from carlasc.viewing import Scene, view
from carlasc.viewing.page.contents import open_content, pack_arrays
from carlasc.viewing.photos import Photo

WIDTH, HEIGHT = 800, 400


def camera(name="front"):
    matrix = np.array([[400.0, 0, 400], [0, 400, 200], [0, 0, 1]])
    place = optical_axes((1.0, 0.0), "left")
    place[:3, 3] = 1.0, 0.5, -0.2
    return CameraModel(name=name, width=WIDTH, height=HEIGHT, matrix=matrix, sensor_T_camera=place)


@pytest.fixture(scope="module")
def photographed(tmp_path_factory):
    """Two frames, of which the second has no image of its second camera."""
    folder = write_blocks(
        tmp_path_factory.mktemp("photographed") / "Town01_Light" / "cartesian", frames=2
    )
    writer = FolderSink(folder.parent).sequence(folder.name)
    writer.write_document(
        layout.CAMERAS, cameras_to_json([camera(), camera("second"), camera("never")])
    )
    for name, frame, gray in (("front", 0, 60), ("front", 1, 90), ("second", 0, 200)):
        image = encode_image(np.full((HEIGHT, WIDTH, 3), gray, np.uint8), "PNG")
        writer.write(f"images.{name}.png", frame, image)
    return folder


def test_a_page_has_small_images_of_the_cameras_that_have_some(photographed):
    content = open_content(Scene(photographed), 0.2)
    assert content.describe([])["cameras"] == ["front", "second"]
    first, second = (unpack_arrays(pack_arrays(content.read(frame)[0])) for frame in (0, 1))
    assert "photos/second" in first and "photos/second" not in second
    for arrays, gray in ((first, 60), (second, 90)):
        image = Image.open(io.BytesIO(arrays["photos/front"].tobytes()))
        assert image.format == "JPEG" and image.size == (400, 200)
        assert np.abs(np.array(image).astype(int) - gray).max() <= 3
    assert len(first["actors/cameras"]) == 2 * len(second["actors/cameras"]) == 2 * 8 * 6


def test_without_images_nothing_is_added(tmp_path):
    folder = write_blocks(tmp_path / "Town01_Light" / "cartesian", frames=1)
    content = open_content(Scene(folder), 0.2)
    assert content.describe([])["cameras"] == []
    assert not [
        name for name in content.read(0)[0] if name.startswith("photos") or name == "actors/cameras"
    ]


def test_a_frustum_goes_from_the_camera_to_the_corners_of_its_image():
    own = camera()
    lines = Photo(own, own.sensor_T_camera, b"").frustum(2.0)
    assert lines.shape == (8, 2, 3)
    np.testing.assert_allclose(lines[:4, 0], np.tile((1.0, 0.5, -0.2), (4, 1)))
    looks = lines[:4, 1] - lines[:4, 0]
    np.testing.assert_allclose(np.linalg.norm(looks, axis=1), 2.0)
    assert (looks[:, 0] > 0).all()  # it looks ahead
    sides = {(bool(y > 0), bool(z > 0)) for _, y, z in looks}
    assert len(sides) == 4
    np.testing.assert_allclose(lines[4:, 1], np.roll(lines[4:, 0], -1, axis=0))


def test_a_damaged_image_is_one_line():
    with pytest.raises(FormatError, match="image of front: expected a whole JPEG or PNG"):
        Photo(camera(), np.eye(4), b"\x89PNG nothing").smaller(100)


@pytest.mark.slow
def test_the_page_shows_them_until_the_layer_is_off(browser, photographed, tmp_path):
    page = Page(browser, view(photographed, tmp_path / "scene.html").out)
    shown = "return [...document.querySelectorAll('#photos img')].map((i) => !i.hidden && i.naturalWidth)"
    page.run("return new Promise((done) => setTimeout(done, 200))")
    assert page.run(shown) == [400, 400]
    page.run("return carlasc.show(1)")
    assert page.run(shown)[1] is False
    assert (
        page.run("return carlasc.panels.frustums.lines[0].geometry.attributes.position.count") == 16
    )
    page.click('[data-layer="cameras"]')
    assert page.run("return document.getElementById('photos').hidden")
    assert not page.run("return carlasc.panels.frustums.lines[0].visible")
    assert page.complaints() == []
