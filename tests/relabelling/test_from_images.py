"""Classes of pixels written to points: a street of boxes whose images are cast exactly."""

import json
import shutil

import numpy as np
import pytest
from helpers.scenes.box_street import Street, cast_image, drive, write_drive
from typer.testing import CliRunner

import carlasc
from carlasc import Run
from carlasc.cli import app
from carlasc.core import CameraModel, GridSpec
from carlasc.core.cameras import optical_axes
from carlasc.errors import ArgumentError, FormatError, MissingDataError
from carlasc.groundtruth.seen import see_points
from carlasc.storage import cameras_of
from carlasc.storage.camera_files import cameras_to_json, encode_image
from carlasc.storage.folder import FolderSequence

pytest.importorskip("PIL")
ONE, SEED, FRAMES = Run(workers=1), 3, 4
WIDTH, HEIGHT = 200, 100


def street_camera(yaw_deg):
    place = optical_axes((np.cos(np.deg2rad(yaw_deg)), np.sin(np.deg2rad(yaw_deg))), "left")
    place[:3, 3] = 0.4, 0.0, -0.2
    matrix = np.array([[110.0, 0, (WIDTH - 1) / 2], [0, 110, (HEIGHT - 1) / 2], [0, 0, 1]])
    return CameraModel(
        name=f"at{yaw_deg}", width=WIDTH, height=HEIGHT, matrix=matrix, sensor_T_camera=place
    )


@pytest.fixture(scope="module")
def labelled(tmp_path_factory):
    """A drive without labels, the classes of the pixels of two cameras, and what `label_images`
    makes of them.
    """
    folder, poses, street = tmp_path_factory.mktemp("street"), drive(FRAMES), Street.random(SEED)
    write_drive(folder / "in/Train/A/cartesian", poses, labelled=False, seed=SEED)
    write_drive(folder / "truth/Train/A/cartesian", poses, seed=SEED)
    ones = [street_camera(0), street_camera(180)]
    (folder / "in/Train/A/cartesian/cameras.json").write_bytes(cameras_to_json(ones))
    for one in ones:
        (folder / "pixels/A" / one.name).mkdir(parents=True)
        for frame, pose in enumerate(poses):
            image = encode_image(cast_image(street, pose, one)[0], "PNG")
            (folder / "pixels/A" / one.name / f"{frame:06d}.png").write_bytes(image.tobytes())
    result = carlasc.label_images(folder / "in", folder / "out", pixels=folder / "pixels", run=ONE)
    return folder, poses, street, result


def the_sequence(folder):
    return FolderSequence(folder / "Train/A/cartesian")


def test_points_that_cameras_see_get_the_classes_of_their_pixels(labelled):
    folder, poses, street, result = labelled
    sequence, truth = the_sequence(folder / "out"), the_sequence(folder / "truth")
    seen, right, unseen = 0, 0, 0
    for frame, pose in enumerate(poses):
        points, labels = truth.read("points", frame)[:, :3], truth.read("labels", frame)
        found, pairs = sequence.read("labels", frame), sequence.read("probabilities", frame)
        assert (pairs[:, 0] == found).all()
        by_any = np.zeros(len(points), bool)
        for one in cameras_of(sequence).values():
            local = (points - one.sensor_T_camera[:3, 3]) @ one.sensor_T_camera[:3, :3]
            pixels = one.project(local)
            inside = np.flatnonzero(one.contains(pixels))
            columns, rows = np.rint(pixels[inside]).astype(int).T
            distances = cast_image(street, pose, one)[1][rows, columns]
            by_any[inside] |= np.abs(distances / np.linalg.norm(local[inside], axis=1) - 1) < 0.03
        seen += by_any.sum()
        right += (found == labels)[by_any].sum()
        unseen += (pairs[~by_any, 1] < 0.1 * 65535).sum()
    assert seen > 5000 and right > 0.97 * seen and unseen > 1000
    assert sequence.metadata.predicted == "predicted by pixels" and result.frames == FRAMES
    assert result.linked == FRAMES and result.files == 2 * FRAMES  # labels and probabilities


def test_what_is_hidden_by_voxels_is_not_seen_and_the_ground_is():
    spec = GridSpec("cartesian", (20, 10, 5), (0.0, -5.0, -2.0), (20.0, 5.0, 3.0))
    occupied = np.zeros(spec.size, bool)
    occupied[:, :, 0] = True  # ground
    occupied[8, 4:6, :4] = True  # a wall
    eye = np.array([0.5, 0.0, 0.5])
    points = [
        [8.5, 0.3, 0.5],
        [15.5, 0.3, 0.5],
        [15.5, 4.5, 0.5],
        [15.5, 4.5, -1.9],
        [30.0, 0.3, 0.5],
        [30.0, 9.0, 0.5],
    ]
    assert see_points(np.array(points), occupied, spec, eye).tolist() == [
        True,
        False,
        True,
        True,
        False,
        True,
    ]


def test_probabilities_of_pixels_and_the_command(labelled, tmp_path):
    """`.npy` of probabilities say the same as PNGs; a single sequence needs no folder of its name."""
    from PIL import Image

    folder, _, _, _ = labelled
    for path in (folder / "pixels/A").rglob("*.png"):
        out = tmp_path / "net" / path.parent.name / f"{path.stem}.npy"
        out.parent.mkdir(parents=True, exist_ok=True)
        np.save(out, np.eye(23, dtype=np.float16)[np.asarray(Image.open(path))])
    call = [
        "label",
        folder / "in",
        "-o",
        tmp_path / "out",
        "--from",
        "images",
        "--pixels",
        tmp_path / "net",
    ]
    done = CliRunner().invoke(app, [*map(str, call), "--workers", "1", "--json"])
    assert done.exit_code == 0 and json.loads(done.stdout)["by"] == "net"
    first, second = (
        the_sequence(one).read("labels", 2) for one in (folder / "out", tmp_path / "out")
    )
    assert (first == second).mean() > 0.999


def test_bad_input_is_one_line(labelled, tmp_path):
    folder, _, _, _ = labelled
    source, good = folder / "in", folder / "pixels"

    def refused(error, match, pixels, source=source, **more):
        with pytest.raises(error, match=match) as found:
            carlasc.label_images(
                source, tmp_path / f"out{abs(hash(match))}", pixels=pixels, run=ONE, **more
            )
        assert "\n" not in str(found.value)

    def changed(name, change):
        shutil.copytree(good, tmp_path / name)
        change(tmp_path / name / "A/at0")
        return tmp_path / name

    def other_size(camera):
        (camera / "000000.png").write_bytes(
            encode_image(np.zeros((HEIGHT, 20), np.uint8), "PNG").tobytes()
        )

    def cut_short(camera):
        (camera / "000000.png").write_bytes((camera / "000000.png").read_bytes()[:50])

    def unknown_class(camera):
        (camera / "000000.png").write_bytes(
            encode_image(np.full((HEIGHT, WIDTH), 99, np.uint8), "PNG").tobytes()
        )

    def other_array(camera):
        (camera / "000000.png").unlink()
        np.save(camera / "000000.npy", np.zeros((HEIGHT, 20), np.uint8))

    refused(FormatError, "200 x 100 pixels.*found 20 x 100", changed("size", other_size))
    refused(
        FormatError,
        r"\(100, 200\) integers.*found uint8 of shape \(100, 20\)",
        changed("array", other_array),
    )
    refused(FormatError, "a whole JPEG or PNG", changed("short", cut_short))
    refused(FormatError, "ids of the class table carla.*found 99", changed("class", unknown_class))
    refused(
        FormatError,
        "top, which has no calibration",
        changed("top", lambda camera: camera.rename(camera.with_name("top"))),
    )
    refused(MissingDataError, "classes of pixels, such as A/at0/000000.png", None)
    refused(MissingDataError, "cameras in cameras.json, found none", good, source=folder / "truth")
    refused(ArgumentError, "a name in one line", good, by="\n")
    for more in (["--frames", "1:"], ["--logits"]):
        call = [
            "label",
            source,
            "-o",
            tmp_path / "out",
            "--from",
            "images",
            "--pixels",
            good,
            *more,
        ]
        done = CliRunner().invoke(app, list(map(str, call)))
        assert done.exit_code == 2 and f"no {more[0]} with --from images" in done.stderr
    done = CliRunner().invoke(
        app, ["label", str(source), "-o", str(tmp_path / "o"), "--from", "motion", "--pixels", "x"]
    )
    assert done.exit_code == 2 and "expected --from images" in done.stderr
