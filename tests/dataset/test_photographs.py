"""Images in samples: read, resized with the matrices that fit, and those of frames that lack one
left out.
"""

import numpy as np
import pytest
from helpers.datasets.drives import write_drive

from carlasc import Augment, Dataset, GridSpec, collate
from carlasc.core import CameraModel
from carlasc.core.cameras import optical_axes
from carlasc.dataset import ResizeImages
from carlasc.errors import ArgumentError, MissingDataError
from carlasc.storage import FolderSink
from carlasc.storage.camera_files import cameras_to_json, encode_image

pytest.importorskip("PIL")
SPEC = GridSpec("cartesian", (8, 8, 4), (-4.0, -4.0, -2.0), (4.0, 4.0, 2.0))
WIDTH, HEIGHT = 80, 40


@pytest.fixture
def data(tmp_path):
    """Three frames; the images of the first two, one of them beside the sequence."""
    folder = write_drive(tmp_path / "A/cartesian", range(3), spec=SPEC)
    matrix = np.array([[50.0, 0, 39.5], [0, 50, 19.5], [0, 0, 1]])
    values = {
        "width": WIDTH,
        "height": HEIGHT,
        "matrix": matrix,
        "sensor_T_camera": optical_axes((1.0, 0.0), "left"),
    }
    front = CameraModel(name="front", **values)
    other = CameraModel(name="other", images=("../other.png", "../other.png", ""), **values)
    writer = FolderSink(folder.parent).sequence("cartesian")
    writer.write_document("cameras.json", cameras_to_json([front, other]))
    pixels = np.zeros((HEIGHT, WIDTH, 3), np.uint8)
    pixels[:, WIDTH // 2 :] = 200
    for frame in range(2):
        writer.write("images.front.png", frame, encode_image(pixels + np.uint8(frame), "PNG"))
    (folder.parent / "other.png").write_bytes(encode_image(pixels, "PNG").tobytes())
    return tmp_path, pixels


def test_samples_have_the_images_of_frames_that_have_all(data):
    root, pixels = data
    dataset = Dataset(root, fields=("labels", "images", "cameras"))
    assert [sample["frame"] for sample in dataset] == [0, 1]
    sample = dataset[1]
    assert np.array_equal(sample["images"]["front"], pixels + np.uint8(1))
    assert np.array_equal(sample["images"]["other"], pixels) and list(sample["cameras"]) == [
        "front",
        "other",
    ]


def test_moved_points_are_seen_in_the_same_pixels_by_moved_cameras(data):
    augment = Augment(
        directions="xy", probability=1, rotate_rad=(0.7,), scale=0.3, translate_m=(1, 2, 3), seed=4
    )
    dataset = Dataset(data[0], fields=("points", "images", "cameras"))
    before = dataset[0]
    dataset.transform = augment
    after = dataset[0]
    for name, camera in before["cameras"].items():
        assert np.array_equal(after["images"][name], before["images"][name])
        moved = after["cameras"][name]
        pixels = [
            one.project(
                (
                    np.column_stack([points, np.ones(len(points))])
                    @ np.linalg.inv(one.sensor_T_camera).T
                )[:, :3]
            )
            for one, points in ((camera, before["points"]), (moved, after["points"]))
        ]
        assert np.isfinite(pixels[0]).any()
        np.testing.assert_allclose(pixels[1], pixels[0], atol=0.02)


def test_resized_images_have_matrices_that_fit(data):
    root, _ = data
    sample = Dataset(root, fields=("images", "cameras"), transform=ResizeImages(20, 10))[0]
    image, camera = sample["images"]["front"], sample["cameras"]["front"]
    assert image.shape == (10, 20, 3) and (camera.width, camera.height) == (20, 10)
    assert (image[:, :9] < 5).all() and (image[:, 11:] > 195).all()
    # still between the dark and the light half
    assert camera.project(np.array([[0.0, 0, 5]]))[0] == pytest.approx([9.5, 4.5])
    with pytest.raises(ArgumentError, match="1 or more pixels, found 0 x 10"):
        ResizeImages(0, 10)


def test_batches_have_images_as_tensors_and_cameras_as_lists(data):
    pytest.importorskip("torch")
    dataset = Dataset(data[0], fields=("images", "cameras"))
    batch = collate([dataset[0], dataset[1]])
    assert tuple(batch["images"]["front"].shape) == (2, HEIGHT, WIDTH, 3)
    assert [list(cameras) for cameras in batch["cameras"]] == [["front", "other"]] * 2


def test_data_without_images_are_one_line(data):
    root, _ = data
    folder = write_drive(root / "B/cartesian", range(2), spec=SPEC)
    with pytest.raises(MissingDataError, match="an image of each camera, found no cameras.json"):
        Dataset(folder, fields=("images",))
