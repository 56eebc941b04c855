"""Recordings of NCore: quick tests on stores that we write, and NCore's own library as the judge."""

from __future__ import annotations

import os
import subprocess
import venv
from pathlib import Path

import numpy as np
import pytest
from carlasc_converters.ncore import Ncore
from carlasc_converters.ncore_classes import NCORE, NCORE_TO_CARLA, OTHER_OBJECT, class_of_name
from helpers.converters.ncore_files import NAMES, START_US, contents, for_library, write_store

from carlasc.converting import Sensor, convert, export
from carlasc.core.geometry import rotation_z, translation
from carlasc.errors import FormatError, MissingDataError
from carlasc.running import Run
from carlasc.storage.camera_files import encode_image
from carlasc.testing import ConverterContract, SimulatedDrive

pytestmark = pytest.mark.needs("cbor2", "numcodecs")
SENSORS = (
    Sensor("lidar_front", translation((1.2, 0.1, 1.7)) @ rotation_z(0.4)),
    Sensor("lidar_rear", translation((-1, 0, 1.6)) @ rotation_z(3.0)),
)
DRIVE = SimulatedDrive(4, sensors=SENSORS, rolling=True, channels=10, columns=80)


IDS = {kind: class_of_name(name) for kind, name in NAMES.items()}


class TestNcore(ConverterContract):
    converter = "ncore"
    ids = IDS
    drive = SimulatedDrive(8)
    keeps = frozenset({"boxes", "poses", "times"})

    def write(self, folder):
        write_store(folder, self.drive)

    def _points(self, frame):
        """Every fifth ray has a second return, one metre behind the first; all first returns come
        before all second ones.
        """
        for points in super()._points(frame):
            sensor = self.drive.sensors[0].vehicle_T_sensor
            own = self.drive.scan(frame).deskewed[::5, :3].astype(np.float64)
            behind = own * (1 + 1 / np.linalg.norm(own, axis=1, keepdims=True))
            yield np.concatenate([points, behind @ sensor[:3, :3].T])

    def test_what_moves_has_flow_and_what_stands_has_none(self, sequence):
        pytest.skip("points of second returns are in no thing")


def check_against(recording, library):
    """Compare a recording with what NCore's library read of the same store, or with what was
    written.
    """
    spans = library[f"{SENSORS[0].name}/spans"].astype(np.int64)
    np.testing.assert_allclose(recording.times(), (spans[:, 1] - spans[0, 1]) / 1e6, atol=1e-9)
    for index, sensor in enumerate(recording.sensors):
        np.testing.assert_allclose(
            sensor.vehicle_T_sensor, library[f"{sensor.name}/mount"], atol=1e-6
        )
        for number, frame in enumerate(recording.frames):
            cloud = frame.read()[index]
            both = [library[f"{sensor.name}/{number}/points{which}"] for which in range(2)]
            valid = [np.isfinite(points).all(axis=1) for points in both]
            np.testing.assert_array_equal(
                cloud.points[:, :3],
                np.concatenate([points[keep] for points, keep in zip(both, valid, strict=True)]),
            )
            stamps = library[f"{sensor.name}/{number}/stamps"].astype(np.int64)
            expected = np.concatenate([stamps[keep] for keep in valid]) - spans[number, 1]
            np.testing.assert_allclose(cloud.seconds, expected / 1e6, atol=1e-9)
    poses = recording.poses().at(recording.times())
    np.testing.assert_allclose(poses, library[f"{SENSORS[0].name}/poses"], atol=1e-6)
    boxes = recording.boxes()
    rows = library["boxes"]
    assert sum(map(len, boxes.values())) == len(rows) > 0
    for number, end in enumerate(spans[:, 1].tolist()):
        for track, _, *values in rows[rows[:, 1] == end].tolist():
            (place,) = np.flatnonzero(boxes[number].tracks == track)
            np.testing.assert_allclose(boxes[number].centers[place], values[:3], atol=1e-5)
            np.testing.assert_allclose(boxes[number].sizes[place], values[3:], atol=1e-6)


def test_two_lidars_are_read_as_they_were_written(tmp_path):
    (recording,) = Ncore(write_store(tmp_path, DRIVE)).sequences()
    assert recording.name == "drive_1"
    content = contents(DRIVE)
    for index, sensor in enumerate(recording.sensors):
        np.testing.assert_allclose(
            sensor.vehicle_T_sensor, SENSORS[index].vehicle_T_sensor, atol=1e-12
        )
        for number, frame in enumerate(recording.frames):
            given, cloud = content["frames"][sensor.name, number], frame.read()[index]
            first = len(given["direction"])
            np.testing.assert_array_equal(
                cloud.points[:first, :3], given["direction"] * given["distance_m"][0][:, None]
            )
            assert cloud.seconds.max() <= 0 and cloud.seconds.min() >= -DRIVE.period_s
    ends = recording.times() + DRIVE.period_s / 2
    np.testing.assert_allclose(
        recording.poses().at(recording.times()), DRIVE.world_T_vehicle(ends), atol=2e-3
    )


def test_damage_is_one_line(tmp_path):
    path = write_store(tmp_path, DRIVE)
    good = path.read_bytes()
    for share in (0.3, 0.7, 0.99):
        path.write_bytes(good[: int(len(good) * share)])
        with pytest.raises(
            FormatError, match=r"itar: expected an (index at the end|indexed tar)"
        ) as found:
            Ncore(Path(path)).sequences()
        assert "\n" not in str(found.value)
    other = tmp_path / "other"
    other.mkdir()
    with pytest.raises(FormatError, match="expected NCore v4, found v9"):
        Ncore(write_store(other, DRIVE, version="v9")).sequences()
    (tmp_path / "none").mkdir()
    with pytest.raises(
        MissingDataError, match=r"expected stores of NCore: \*.zarr.itar or \*.zarr, found none"
    ):
        Ncore(tmp_path / "none").sequences()


def test_names_of_classes_belong_to_classes_and_unknown_ones_are_said(tmp_path):
    named = {
        "automobile": "Vehicle",
        "BICYCLIST": "Rider",
        "MOBILE_PEDESTRIAN_CROSSING_SIGN": "Sign",
        "dog": "Animal",
    }
    assert {name: NCORE.names[class_of_name(name)] for name in named} == named
    assert class_of_name("scarecrow") is None
    assert (
        NCORE_TO_CARLA.target.names[NCORE_TO_CARLA.mapping[class_of_name("cyclist")]]
        == "Pedestrian"
    )

    def rename(content):
        for entry in content["observations"]:
            entry["class_id"] = "scarecrow" if entry["class_id"] == "van" else entry["class_id"]

    (recording,) = Ncore(write_store(tmp_path, DRIVE, edit=rename)).sequences()
    assert recording.notes() == ["objects of unknown classes became Other object: scarecrow"]
    assert any((boxes.labels == OTHER_OBJECT).any() for boxes in recording.boxes().values())


def test_frames_that_nobody_annotated_have_no_entry_and_far_observations_are_left_out(tmp_path):
    def thin(content):
        first, last = START_US + 50_000, START_US + 350_000
        kept = [
            entry for entry in content["observations"] if entry["timestamp_us"] in (first, last)
        ]
        far = {**kept[0], "timestamp_us": last + 14_000_000}
        content["observations"] = [*kept, far]

    (recording,) = Ncore(write_store(tmp_path, DRIVE, edit=thin)).sequences()
    assert sorted(recording.boxes()) == [0, 3]
    assert recording.notes() == ["1 observation of boxes left out, not near any frame"]


def test_a_lidar_that_starts_late_gives_each_frame_once(tmp_path):
    def start_late(content):
        for number in range(2):
            del content["frames"]["lidar_rear", number]

    (recording,) = Ncore(write_store(tmp_path, DRIVE, edit=start_late)).sequences()
    assert [[cloud.sensor for cloud in frame.read()] for frame in recording.frames] == [
        [0],
        [0],
        [0, 1],
        [0, 1],
    ]


def test_lidars_without_frames_are_left_out(tmp_path):
    def empty(content, names):
        content["frames"] = {
            key: frame for key, frame in content["frames"].items() if key[0] not in names
        }

    (recording,) = Ncore(
        write_store(tmp_path, DRIVE, edit=lambda content: empty(content, ["lidar_front"]))
    ).sequences()
    assert [sensor.name for sensor in recording.sensors] == ["lidar_rear"]
    assert recording.notes() == ["LiDARs without frames were left out: lidar_front"]
    both = ["lidar_front", "lidar_rear"]
    # the same file, written again
    path = write_store(tmp_path, DRIVE, edit=lambda content: empty(content, both))
    with pytest.raises(MissingDataError, match="expected a LiDAR with frames, found none"):
        Ncore(path).sequences()


@pytest.fixture(scope="module")
def library(tmp_path_factory):
    """The Python of an environment with NCore's library, which needs zarr below 3."""
    given = os.environ.get("CARLASC_NCORE_PYTHON")
    if given:
        return given
    folder = tmp_path_factory.mktemp("ncore") / "venv"
    venv.create(folder, with_pip=True)
    python = folder / "bin" / "python"
    packages = ("torch==2.13.0", "nvidia-ncore==19.8.0")
    command = [python, "-m", "pip", "install", "--quiet", "--no-compile", *packages]
    done = subprocess.run(command, check=False, capture_output=True, text=True, timeout=500)
    if done.returncode:
        pytest.skip(f"nvidia-ncore cannot be installed: {done.stderr.strip().splitlines()[-1:]}")
    return python


@pytest.mark.slow
@pytest.mark.parametrize("writer", ["the library", "the tests"])
def test_a_store_is_read_as_the_library_reads_it(tmp_path, library, writer):
    if writer == "the library":
        for_library(tmp_path, contents(DRIVE))
    else:
        write_store(tmp_path, DRIVE)
    script = Path(__file__).with_name("ncore_library.py")
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    done = subprocess.run(
        [library, script, tmp_path],
        check=False,
        capture_output=True,
        text=True,
        timeout=300,
        env=environment,
    )
    assert done.returncode == 0, done.stderr
    (recording,) = Ncore(tmp_path).sequences()
    with np.load(tmp_path / "library.npz") as found:
        check_against(recording, found)


CAMERA = {
    "resolution": [64, 48],
    "shutter_type": "GLOBAL",
    "principal_point": [32.5, 24.5],
    "focal_length": [60.0, 61.0],
    "radial_coeffs": [0.1, 0.02, 0.003, 0.0, 0.0, 0.0],
    "tangential_coeffs": [0.001, -0.002],
    "thin_prism_coeffs": [0.0] * 4,
}
FISHEYE = {**CAMERA, "radial_coeffs": [0.01, 0.0, 0.0, 0.0], "max_angle": 1.5}


def photographed(drive):
    """Return what adds cameras to a store: two that can be projected, and three that cannot."""
    image = encode_image(np.full((48, 64, 3), 80, np.uint8), "PNG").tobytes()
    spans = [(START_US + round(1e6 * t), START_US + round(1e6 * t) + 2000) for t in drive.times]
    # what follows the image is not lost
    images = dict.fromkeys(spans[:-1], (image + b"\x00\x00", "png"))
    ahead = np.eye(4)
    ahead[:3, :3], ahead[:3, 3] = [[0, 0, 1], [-1, 0, 0], [0, -1, 0]], (1.5, 0, 1.4)
    prism = {**CAMERA, "thin_prism_coeffs": [0.1, 0, 0, 0]}
    kinds = {
        "front": ("opencv-pinhole", CAMERA),
        "round": ("opencv-fisheye", FISHEYE),
        "theta": ("ftheta", CAMERA),
        "prism": ("opencv-pinhole", prism),
    }
    found = {
        name: {
            "lens": {"camera_model_type": kind, "camera_model_parameters": given},
            "rig_T_camera": ahead,
            "images": images if name == "front" else {},
        }
        for name, (kind, given) in kinds.items()
    }
    found["nowhere"] = {
        key: value for key, value in found["front"].items() if key != "rig_T_camera"
    }
    return lambda content: content.update(cameras=found)


def test_cameras_are_where_the_rig_has_them_with_the_image_nearest_to_each_frame(tmp_path):
    write_store(tmp_path, DRIVE, edit=photographed(DRIVE))
    (recording,) = Ncore(tmp_path).sequences()
    front, wide = recording.cameras()
    assert (front.name, front.width, front.height, front.model) == (
        "front",
        64,
        48,
        "radial-tangential",
    )
    assert front.distortion == (0.1, 0.02, 0.001, -0.002, 0.003, 0, 0, 0)
    # centres of pixels are whole numbers
    np.testing.assert_allclose(front.matrix, [[60, 0, 32], [0, 61, 24], [0, 0, 1]])
    np.testing.assert_allclose(front.sensor_T_camera[:3, 3], (1.5, 0, 1.4))
    np.testing.assert_allclose(front.sensor_T_camera[:3, 2], (1, 0, 0), atol=1e-9)  # it looks ahead
    assert (wide.model, len(wide.distortion), wide.times) == ("fisheye", 4, None)
    ends = recording.times()
    assert np.isnan(front.times[-1]) and np.abs(front.times[:-1] - ends[:-1]).max() < 0.06
    ending, data = recording.image(front, 0)
    assert ending == "png" and data.startswith(b"\x89PNG") and data.endswith(b"\0\0")
    assert recording.image(front, len(ends) - 1) is None and recording.image(wide, 0) is None


def test_cameras_of_other_models_are_left_out_and_named(tmp_path):
    write_store(tmp_path, DRIVE, edit=photographed(DRIVE))
    (recording,) = Ncore(tmp_path).sequences()
    notes = "\n".join(recording.notes())
    for name, why in (
        ("theta", "the model ftheta"),
        ("prism", "thin prisms"),
        ("nowhere", "no poses lead to rig"),
    ):
        assert f"the camera {name} was left out: {why}" in notes


def test_a_camera_without_numbers_is_one_line(tmp_path):
    def damage(content):
        photographed(DRIVE)(content)
        content["cameras"]["front"]["lens"] = {
            "camera_model_type": "opencv-pinhole",
            "camera_model_parameters": {"resolution": [64, 48]},
        }

    write_store(tmp_path, DRIVE, edit=damage)
    (recording,) = Ncore(tmp_path).sequences()
    with pytest.raises(FormatError, match="intrinsics of front: .*camera of NCore"):
        recording.cameras()


READS_CUBOIDS = """
import sys
from ncore.data.v4 import SequenceComponentGroupsReader, SequenceLoaderV4
from upath import UPath
reader = SequenceComponentGroupsReader([UPath(path) for path in sys.argv[1:]])
for name in ("default", "carlasc"):
    loader = SequenceLoaderV4(reader, cuboids_component_group_name=name)
    for one in loader.get_cuboid_track_observations():
        print(name, one.timestamp_us, *one.bbox3.centroid, *one.bbox3.dim, *one.bbox3.rot)
"""


@pytest.mark.slow
def test_the_library_reads_exported_cuboids_beside_the_recording(tmp_path, library):
    own, seq = write_store(tmp_path, SimulatedDrive(4)), tmp_path / "seq"
    convert("ncore", own, seq, grids=None, run=Run(workers=1))
    export("ncore", seq, tmp_path, options={"recording": str(own)}, run=Run(workers=1))
    (more,) = tmp_path.glob("*.zarr")
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    command = [library, "-c", READS_CUBOIDS, str(own), str(more)]
    done = subprocess.run(
        command, check=False, capture_output=True, text=True, timeout=300, env=environment
    )
    assert done.returncode == 0, done.stderr
    rows = [line.split() for line in done.stdout.splitlines()]
    found, given = (
        np.array(sorted([float(value) for value in row[1:]] for row in rows if row[0] == name))
        for name in ("carlasc", "default")
    )
    assert len(found) > 4
    np.testing.assert_allclose(found, given, rtol=0, atol=1e-6)
