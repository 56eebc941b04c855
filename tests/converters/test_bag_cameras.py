"""The cameras of bags: models, places, and the image nearest to each scan."""

import numpy as np
import pytest
from carlasc_converters.bag import Bag
from helpers.converters.bags import BASE, KINDS, START_NS, Messages, drive_messages, write_bag
from helpers.errors import raises

from carlasc import Run
from carlasc.converting import LayoutOptions, convert
from carlasc.core.geometry import translation
from carlasc.errors import FormatError
from carlasc.storage import cameras_of, read_image
from carlasc.storage.camera_files import encode_image
from carlasc.storage.folder import FolderSource
from carlasc.testing import SimulatedDrive

pytest.importorskip("rosbags")
DRIVE = SimulatedDrive(3, channels=4, columns=30)
MATRIX = np.array([[60.0, 0, 31.5], [0, 60, 15.5], [0, 0, 1]])
SIZE, LATER_NS = (64, 32), 12_000_000
PLACE = translation((1.2, 0.1, 1.5)) @ np.array(
    [[0.0, 0, 1, 0], [-1, 0, 0, 0], [0, -1, 0, 0], [0, 0, 0, 1]]
)
DISTORTION = (-0.1, 0.02, 0.001, -0.002, 0.003)


def pixels(frame):
    return np.full((SIZE[1], SIZE[0], 3), (10 * frame, 50, 200), np.uint8)


def write(folder, kind, model="plumb_bob", distortion=DISTORTION, encoding="bgr8"):
    """Write a bag of three scans; a camera with images 12 ms later, and a camera without images
    that nothing places.
    """
    store = Messages(kind)
    messages = [
        *drive_messages(store, DRIVE),
        store.transform("/tf_static", START_NS, BASE, "eye", PLACE),
    ]
    stamps = [START_NS + round(seconds * 1e9) + LATER_NS for seconds in DRIVE.times.tolist()]
    messages.append(
        store.camera_info("/front/camera_info", stamps[0], "eye", SIZE, MATRIX, model, distortion)
    )
    messages.append(store.camera_info("/lost/camera_info", stamps[0], "nowhere", SIZE, MATRIX))
    for frame, stamp in enumerate(stamps):
        messages.append(
            store.image("/front/image_raw", stamp, "eye", pixels(frame)[..., ::-1], encoding)
        )
    return write_bag(folder, kind, sorted(messages, key=lambda one: one[2]), store=store), store


@pytest.mark.parametrize("kind", KINDS)
def test_cameras_have_their_model_place_times_and_images(tmp_path, kind):
    bag, _ = write(tmp_path, kind)
    (recording,) = Bag(bag).sequences()
    (camera,) = recording.cameras()
    assert (camera.name, camera.width, camera.height, camera.model) == (
        "front",
        *SIZE,
        "radial-tangential",
    )
    assert camera.distortion == DISTORTION and np.array_equal(camera.matrix, MATRIX)
    np.testing.assert_allclose(camera.sensor_T_camera, PLACE, atol=1e-12)
    np.testing.assert_allclose(camera.times - recording.times(), LATER_NS * 1e-9, atol=1e-9)
    assert any("from nowhere to base_link: lost is left out" in note for note in recording.notes())


def test_images_are_copied_and_cannot_be_linked(tmp_path):
    bag, _ = write(tmp_path, "mcap")
    for images in ("copy", "link"):
        layout = LayoutOptions(images=images)
        result = convert("bag", bag, tmp_path / images, layout=layout, run=Run(workers=1))
        (sequence,) = FolderSource(tmp_path / images).sequences().values()
        camera = cameras_of(sequence)["front"]
        if images == "copy":
            assert np.array_equal(read_image(sequence, camera, 2), pixels(2))
        else:
            assert any("--images copy" in note for note in result.notes)


def test_a_compressed_image_is_taken_as_it_is_and_a_rectified_one_has_no_distortion(tmp_path):
    store, jpeg = Messages("bag"), encode_image(pixels(1), "JPEG").tobytes()
    messages = [
        *drive_messages(store, DRIVE),
        store.transform("/tf_static", START_NS, BASE, "eye", PLACE),
    ]
    messages.append(
        store.camera_info("/a/camera_info", START_NS, "eye", SIZE, MATRIX, "plumb_bob", DISTORTION)
    )
    messages.append(store.compressed("/a/image_rect/compressed", START_NS, "eye", jpeg))
    messages.append(store.image("/a/image_rect", START_NS, "eye", pixels(1)))
    bag = write_bag(tmp_path, "bag", sorted(messages, key=lambda one: one[2]), store=store)
    (recording,) = Bag(bag).sequences()
    (camera,) = recording.cameras()
    assert camera.model == "pinhole" and recording.image(camera, 0) == ("jpg", jpeg)
    assert recording.image(camera, 2) is None  # its only image is nearer to the first frame


def test_an_unknown_model_and_an_unknown_encoding_are_one_line(tmp_path):
    for number, (model, distortion) in enumerate((("fov", (0.9,)), ("plumb_bob", (0.1, 0.2)))):
        (tmp_path / str(number)).mkdir()
        bag, _ = write(tmp_path / str(number), "bag", model, distortion)
        (recording,) = Bag(bag).sequences()
        with raises(
            FormatError, expected="one of the models plumb_bob", found=f"'{model}' with"
        ) as error:
            recording.cameras()
        assert "\n" not in str(error.value)
    bag, _ = write(tmp_path, "bag", encoding="bayer_rggb8")
    (recording,) = Bag(bag).sequences()
    (camera,) = recording.cameras()
    with raises(FormatError, expected="one of mono8", found="'bayer_rggb8'"):
        recording.image(camera, 0)
