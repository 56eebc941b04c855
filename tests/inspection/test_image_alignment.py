"""Images that are shifted or late are found against the scans; where nothing tells, it is said."""

import numpy as np
import pytest
from helpers.scenes.box_street import Street, cast_image, drive, write_drive

from carlasc import validate
from carlasc.core import CameraModel
from carlasc.core.cameras import optical_axes
from carlasc.inspection.image_alignment import compare_images
from carlasc.storage.camera_files import cameras_to_json, encode_image
from carlasc.storage.folder import FolderSequence, FolderSink

pytest.importorskip("PIL")
FRAMES, WIDTH, HEIGHT = 9, 320, 120


def write(folder, shift=0, late=0, noise=False):
    """Write a drive with a camera that looks to the left; its images are shifted, or those of later
    frames.
    """
    poses, street, rng = (
        drive(FRAMES + late, speed_m=0.8),
        Street.random(4),
        np.random.default_rng(0),
    )
    write_drive(folder / "A/cartesian", poses[:FRAMES], labelled=False, seed=4)
    matrix = np.array([[200.0, 0, (WIDTH - 1) / 2], [0, 200, (HEIGHT - 1) / 2], [0, 0, 1]])
    place = optical_axes((0.3, -1.0), "left")
    one = CameraModel(name="side", width=WIDTH, height=HEIGHT, matrix=matrix, sensor_T_camera=place)
    writer = FolderSink(folder / "A").sequence("cartesian")
    writer.write_document("cameras.json", cameras_to_json([one]))
    for frame in range(FRAMES):
        points, _ = street.scan(poses[frame], rng, channels=32, columns=900)
        writer.write("points", frame, np.column_stack([points, np.zeros(len(points), np.float32)]))
        classes = np.roll(cast_image(street, poses[frame + late], one)[0], shift, axis=1)
        pixels = (
            rng.integers(0, 255, classes.shape).astype(np.uint8)
            if noise
            else classes * np.uint8(11)
        )
        writer.write(
            "images.side.png", frame, encode_image(np.repeat(pixels[..., None], 3, axis=2), "PNG")
        )
    return folder


def agreement(folder):
    (found,) = compare_images(FolderSequence(folder / "A/cartesian"))
    return found


@pytest.mark.slow
def test_images_that_fit_are_said_to_fit(tmp_path):
    found = agreement(write(tmp_path))
    assert found.shift_px == pytest.approx(0, abs=2) and found.late_s == pytest.approx(0, abs=0.02)
    assert not found.is_wrong


@pytest.mark.slow
def test_a_shift_of_the_image_is_a_warning_with_its_pixels(tmp_path):
    found = agreement(write(tmp_path, shift=8))
    assert found.shift_px == pytest.approx(8, abs=2) and found.is_wrong
    result = validate(tmp_path)
    (finding,) = [one for one in result.findings if one.check == "images-on-scans"]
    assert (
        finding.severity == "warning"
        and "side: +" in finding.found
        and "pixels to the right" in finding.found
    )
    assert "pixels to the right" in result.sequences[0].images["side"]


@pytest.mark.slow
def test_images_of_the_next_frame_are_late(tmp_path):
    found = agreement(write(tmp_path, late=1))
    assert found.late_s == pytest.approx(0.1, abs=0.02) and found.is_wrong


@pytest.mark.slow
def test_noise_determines_nothing(tmp_path):
    found = agreement(write(tmp_path, noise=True))
    assert (found.shift_px, found.late_s) == (None, None) and str(
        found
    ) == "undetermined, undetermined"
