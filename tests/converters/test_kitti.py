"""SemanticKITTI into the layout: what must hold of a sound data set."""

import json
import pickle

import numpy as np
import pytest
from helpers.datasets.tiny_kitti import write_tiny_kitti

import carlasc
from carlasc.converting import LayoutOptions, convert
from carlasc.core.tables import REMAPS
from carlasc.groundtruth import GridOptions
from carlasc.inspection.validation import validate
from carlasc.running import Run

SEQUENCE = "Train/KITTI_00/cartesian"
MIRROR = np.diag([1.0, -1.0, 1.0, 1.0])
PLAIN = {"grids": None, "layout": LayoutOptions(flow="none"), "run": Run(workers=1)}


@pytest.fixture(scope="module")
def converted(simulated, tmp_path_factory):
    """The simulated sequence in CarlaSC's frame and classes, with SemanticKITTI's voxels."""
    out = tmp_path_factory.mktemp("converted")
    result = convert(
        "kitti",
        simulated[0],
        out,
        layout=LayoutOptions("carla", flow="none"),
        grids="voxels",
        run=Run(workers=2),
    )
    assert (result.made, result.skipped, result.failures) == (24, 0, ())
    return out


def sequence_of(out, path=SEQUENCE):
    return carlasc.open(out).sequences()[path]


def raw(folder, frame):
    points = np.fromfile(folder / "velodyne" / f"{frame:06d}.bin", "<f4").reshape(-1, 4)
    return points, np.fromfile(folder / "labels" / f"{frame:06d}.label", "<u4")


def test_points_keep_their_number_order_and_remission_and_are_mirrored(simulated, converted):
    for frame in (0, 7):
        points, _ = raw(simulated[1].folder, frame)
        assert np.array_equal(
            sequence_of(converted).read("points", frame), points * np.float32([1, -1, 1, 1])
        )


def test_labels_become_carlas(simulated, converted):
    _, both = raw(simulated[1].folder, 3)
    expected = REMAPS["semantickitti_to_carla"](both & 0xFFFF)
    assert np.array_equal(sequence_of(converted).read("labels", 3), expected)
    assert {252, 254, 10} <= set(np.unique(both & 0xFFFF).tolist())


def test_instances_tell_actors_of_all_classes_apart_and_keep_their_numbers(simulated, converted):
    for frame in (0, 11):
        _, both = raw(simulated[1].folder, frame)
        instances = sequence_of(converted).read("instances", frame)
        assert np.array_equal(instances & 0xFFFF, both >> 16)
        assert np.array_equal(instances > 0, both >> 16 > 0)


def test_an_actor_has_one_number_whether_it_moves_or_stands_and_two_classes_share_none(tmp_path):
    folder = write_tiny_kitti(tmp_path / "in", frames=1, points=4)
    labels = np.array([10 | 5 << 16, 252 | 5 << 16, 30 | 5 << 16, 254], np.uint32)
    labels.tofile(folder / "labels" / "000000.label")
    convert("kitti", tmp_path / "in", tmp_path / "out", **PLAIN)
    car, moving_car, person, nobody = sequence_of(tmp_path / "out").read("instances", 0)
    assert car == moving_car != person
    assert nobody == 0


def test_poses_are_the_lidars_and_match_the_drive(simulated, converted):
    expected = MIRROR @ simulated[1].poses @ MIRROR
    assert np.abs(sequence_of(converted).poses - expected).max() < 1e-9


def test_carlasc_json_says_what_the_data_are(converted, simulated):
    values = json.loads((converted / SEQUENCE / "carlasc.json").read_text())
    assert values["axes"] == "left"
    assert values["classes"] == "carla"
    assert (values["min_range_m"], values["max_range_m"]) == (2.5, 70.0)
    assert "HDL-64E" in values["sensor"]


def test_own_voxels_become_a_grid_whose_invalid_ones_are_unknown(simulated, converted):
    sequence = sequence_of(converted)
    grid = sequence.grid("evaluation_256x256x32", 5)
    voxels = simulated[1].folder / "voxels"
    labels = np.fromfile(voxels / "000005.label", "<u2").reshape(256, 256, 32)[:, ::-1]
    invalid = (
        np.unpackbits(np.fromfile(voxels / "000005.invalid", np.uint8)).reshape(256, 256, 32)[
            :, ::-1
        ]
        > 0
    )
    assert np.array_equal(grid.known, ~invalid)
    assert np.array_equal(grid.labels[~invalid], REMAPS["semantickitti_to_carla"](labels)[~invalid])
    assert sequence.frames("evaluation_256x256x32/labels").tolist() == [0, 5, 10, 15, 20]
    assert grid.spec.upper == (51.2, 25.6, 4.4)


def test_what_convert_writes_is_valid(converted):
    result = validate(converted)
    assert result.ok
    assert result.sequences[0].pose_share > 0.8
    assert result.sequences[0].voxel_share["evaluation_256x256x32"] > 0.9


@pytest.mark.slow
@pytest.mark.parametrize("fault", ["mirrored", "camera", "transposed"])
def test_validate_points_out_a_faulty_copy(simulated, converted, tmp_path, fault):
    result = convert("kitti", simulated[0], tmp_path / "out", **PLAIN)
    assert not result.failures
    folder = tmp_path / "out" / SEQUENCE
    poses = carlasc.storage.layout.decode_poses((folder / "poses.txt").read_bytes(), "poses")
    if fault == "mirrored":
        poses = MIRROR @ poses @ MIRROR
    elif fault == "camera":
        camera = np.array([[0.0, -1, 0, 0], [0, 0, -1, 0], [1, 0, 0, 0], [0, 0, 0, 1]]) @ MIRROR
        poses = camera @ poses @ np.linalg.inv(camera)
    else:
        poses[:, :3, :3] = np.swapaxes(poses[:, :3, :3], 1, 2)
    (folder / "poses.txt").write_bytes(carlasc.storage.layout.encode_poses(poses))
    errors = [
        finding for finding in validate(tmp_path / "out").findings if finding.severity == "error"
    ]
    assert errors
    word = {"mirrored": "mirrored", "camera": "camera", "transposed": "transposed"}[fault]
    assert any(word in finding.found for finding in errors)


def test_labels_and_frame_of_kitti_leave_points_and_classes_as_they_are(simulated, tmp_path):
    layout = LayoutOptions("semantickitti", "right", "none")
    convert("kitti", simulated[0], tmp_path, **PLAIN | {"layout": layout})
    sequence = sequence_of(tmp_path)
    points, both = raw(simulated[1].folder, 4)
    assert sequence.read("points", 4).tobytes() == points.tobytes()
    assert np.array_equal(sequence.read("labels", 4), both & 0xFFFF)
    assert np.abs(sequence.poses - simulated[1].poses).max() < 1e-9
    assert (sequence.metadata.axes, sequence.metadata.classes.name) == ("right", "semantickitti")


def test_splits_are_those_of_the_benchmark_and_can_be_chosen(tmp_path):
    for number in ("00", "08", "11"):
        write_tiny_kitti(tmp_path / "in", number)
    result = convert("kitti", tmp_path / "in", tmp_path / "all", **PLAIN)
    assert [path.split("all/")[1] for path in result.sequences] == [
        "Train/KITTI_00/cartesian",
        "Val/KITTI_08/cartesian",
        "Test/KITTI_11/cartesian",
    ]
    assert (
        len(convert("kitti", tmp_path / "in", tmp_path / "val", split="val", **PLAIN).sequences)
        == 1
    )
    some = convert("kitti", tmp_path / "in", tmp_path / "some", sequences=["00", "11"], **PLAIN)
    assert [path.split("some/")[1][:4] for path in some.sequences] == ["Trai", "Test"]


@pytest.mark.parametrize("below", ["", "sequences", "sequences/08"])
def test_the_root_its_sequences_and_one_of_them_are_all_sources(tmp_path, below):
    write_tiny_kitti(tmp_path / "in", "08")
    assert convert("kitti", tmp_path / "in" / below, tmp_path / "out", **PLAIN).made == 3
    assert (tmp_path / "out" / "Val" / "KITTI_08" / "cartesian" / "poses.txt").is_file()


def test_an_odometry_root_has_its_poses_beside_and_neither_labels_nor_flow(tmp_path):
    folder = write_tiny_kitti(tmp_path / "in", labels=False)
    (tmp_path / "in" / "poses").mkdir()
    (folder / "poses.txt").rename(tmp_path / "in" / "poses" / "00.txt")
    result = convert("kitti", tmp_path / "in", tmp_path / "out", grids=None, run=Run(workers=1))
    assert sequence_of(tmp_path / "out").fields() == {"points"}
    assert sequence_of(tmp_path / "out").poses[2, 0, 3] == pytest.approx(1.0)
    assert "no labels" in result.notes[0]


def test_grids_are_made_from_scans_where_unlabelled_points_cast_no_vote(simulated, tmp_path):
    folder = write_tiny_kitti(tmp_path / "in", points=2000)
    for frame in range(3):
        np.zeros(2000, "<u4").tofile(folder / "labels" / f"{frame:06d}.label")
    result = convert("kitti", tmp_path / "in", tmp_path / "out", run=Run(workers=1))
    grid = sequence_of(tmp_path / "out").grid("evaluation", 1)
    assert result.grids
    assert not grid.labels.any()
    assert not grid.known.any()
    assert len(sequence_of(tmp_path / "out").read("points", 1)) == 2000


@pytest.mark.slow
def test_cylindrical_grids_stand_beside(tmp_path):
    from carlasc.core.grids import GridSpec

    write_tiny_kitti(tmp_path / "in", points=500)
    result = convert(
        "kitti",
        tmp_path / "in",
        tmp_path / "out",
        grids=GridOptions(spec=GridSpec.published("cylindrical")),
        run=Run(workers=1),
    )
    assert not result.failures
    path = SEQUENCE.replace("cartesian", "cylindrical")
    assert sequence_of(tmp_path / "out", path).grid("evaluation", 2).labels.shape == (128, 128, 8)


def test_a_recording_says_what_it_has(simulated, tmp_path):
    from carlasc_converters.kitti import SemanticKitti
    from carlasc_converters.kitti_voxels import GRID

    (recording,) = SemanticKitti(simulated[0]).sequences()
    assert (recording.has_labels, recording.has_instances, recording.voxels) == (True, True, GRID)
    assert (recording.sensors[0].deskewed, recording.sensors[0].height_m) == (True, 1.73)
    write_tiny_kitti(tmp_path, labels=False)
    (recording,) = SemanticKitti(tmp_path).sequences()
    assert (recording.has_labels, recording.has_instances, recording.voxels) == (False, False, None)
    assert recording.boxes() is None


def test_semanticposs_without_a_calibration_has_poses_of_the_lidar(tmp_path):
    from carlasc_converters.poss import SemanticPoss

    folder = write_tiny_kitti(tmp_path, "02", voxels=True)
    (recording,) = SemanticPoss(tmp_path).sequences()
    assert (recording.name, recording.split, recording.voxels) == ("POSS_02", "Val", None)
    with_calibration = recording.poses().world_T_vehicle
    (folder / "calib.txt").unlink()
    assert with_calibration[2, 0, 3] == pytest.approx(1.0)
    written = carlasc.storage.layout.decode_poses((folder / "poses.txt").read_bytes(), "poses")
    assert np.array_equal(recording.poses().world_T_vehicle, written)
    assert np.abs(written - with_calibration).max() > 0.5


def test_handles_are_light(simulated):
    from carlasc_converters.kitti import SemanticKitti

    (recording,) = SemanticKitti(simulated[0]).sequences()
    assert len(pickle.dumps(recording.frames[0])) < 400


def test_the_real_points_are_read(real, tmp_path):
    from carlasc_converters.kitti import SemanticKitti

    (content,) = SemanticKitti(real / "semantickitti").sequences()[0].frames[0].read()
    assert content.points.shape == (50, 4)
    assert set(np.unique(content.labels).tolist()) <= set(REMAPS["semantickitti_to_carla"].mapping)
    assert 0 <= content.points[:, 3].min() <= content.points[:, 3].max() <= 1  # remission
