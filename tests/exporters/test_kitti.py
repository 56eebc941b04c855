"""The layout as SemanticKITTI's files."""

import numpy as np
import pytest
from carlasc_converters.exporters.kitti import TO_PREDICTED, TO_RAW
from carlasc_converters.exporters.occlusion import occluded_voxels
from carlasc_converters.kitti_files import Calibration
from carlasc_converters.kitti_voxels import pack_bits, unpack_bits
from converters.formats.kitti_drive import write_scan
from helpers.datasets.exported import files_and_bytes, write_scene
from helpers.datasets.sequences import write_dataset
from hypothesis import given, settings
from hypothesis.extra.numpy import arrays

from carlasc.converting import convert, export
from carlasc.core.geometry import invert
from carlasc.core.grids import GridSpec
from carlasc.core.tables import REMAPS
from carlasc.errors import ArgumentError, ConflictError, FormatError, MissingDataError
from carlasc.metrics import evaluate
from carlasc.running import Run
from carlasc.storage import FolderSink, layout
from carlasc.storage.files import to_json
from carlasc.testing import SimulatedDrive

SEQUENCE = "Train/KITTI_00/cartesian"
SPEC = GridSpec("cartesian", (10, 8, 5), (-2.0, -4.0, -2.0), (8.0, 4.0, 0.5))


def write_carlasc(root, frame_name="carlasc", classes="carla"):
    """One frame of a CarlaSC-like sequence with a small grid."""
    rng = np.random.default_rng(5)
    writer = FolderSink(root).sequence("Val/Town07_Light/cartesian")
    points = np.column_stack(
        [rng.uniform(-2, 8, 500), rng.uniform(-4, 4, 500), rng.uniform(-2, 0.5, 500), np.zeros(500)]
    )
    writer.write("points", 0, points.astype(np.float32))
    writer.write("labels", 0, rng.integers(0, 23, 500).astype(np.uint32))
    writer.write_document(layout.POSES, layout.encode_poses(np.eye(4)[None]))
    writer.write_document(layout.TIMES, layout.encode_times(np.zeros(1)))
    writer.write_document("carlasc.json", to_json({"frame": frame_name, "classes": classes}))
    writer.write_document("small/params.json", to_json(SPEC.to_params()))
    labels = np.where(rng.random(SPEC.size) < 0.1, rng.integers(1, 23, SPEC.size), 0).astype(
        np.uint32
    )
    counts = np.where(labels > 0, 3, rng.integers(0, 2, SPEC.size)).astype(np.float32)
    writer.write("small/labels", 0, labels)
    writer.write("small/counts", 0, counts)
    return points.astype(np.float32), labels, counts


def test_a_grid_of_carlasc_gets_masks_by_the_rules(tmp_path):
    points, labels, counts = write_carlasc(tmp_path / "in")
    export("kitti", tmp_path / "in", tmp_path / "out", run=Run(workers=1))
    voxels = tmp_path / "out" / "sequences" / "00" / "voxels"
    expected = REMAPS["carla_to_semantickitti"](labels)[:, ::-1]
    assert np.array_equal(np.fromfile(voxels / "000000.label", "<u2").reshape(SPEC.size), expected)
    bits = {
        s: unpack_bits((voxels / f"000000.{s}").read_bytes(), SPEC.size, s)
        for s in ("bin", "invalid", "occluded")
    }
    assert np.array_equal(bits["invalid"], (counts == 0)[:, ::-1])
    cells = np.floor((points[:, :3] * [1, -1, 1] - [-2, -4, -2]) / [1, 1, 0.5]).astype(int)
    inside = ((cells >= 0) & (cells < SPEC.size)).all(axis=1)
    occupied = np.zeros(SPEC.size, bool)
    occupied[tuple(cells[inside].T)] = True
    assert np.array_equal(bits["bin"], occupied)
    assert np.array_equal(bits["occluded"], occluded_voxels(expected > 0, SPEC))


def write_points(root, labels, classes="carla", **fields):
    writer = FolderSink(root).sequence("Val/Town07_Light/cartesian")
    writer.write("points", 0, np.zeros((len(labels), 4), np.float32))
    writer.write("labels", 0, np.array(labels, np.uint32))
    for name, values in fields.items():
        writer.write(name, 0, values)
    writer.write_document("carlasc.json", to_json({"frame": "carlasc", "classes": classes}))


def exported_labels(root, out, **options):
    result = export("kitti", root, out, options=options, run=Run(workers=1))
    return result, np.fromfile(
        out / "sequences/00/labels/000000.label", "<u4"
    ) if result.made else None


def test_points_that_move_get_classes_that_move_and_actors_keep_their_numbers(tmp_path):
    flow = np.array([[9.8, 0, 0], [0.3, 0, 0], [0, -1.2, 0], [5, 0, 0], [0, 0, 0]], np.float32)
    instances = np.array([7, 8, 65535, 0, 0], np.uint32)
    write_points(tmp_path / "in", [10, 10, 4, 1, 0], flow=flow, instances=instances)
    _, both = exported_labels(tmp_path / "in", tmp_path / "out")
    assert list(both & 0xFFFF) == [252, 10, 254, 50, 0]  # buildings have no class that moves
    assert list(both >> 16) == instances.tolist()
    _, both = exported_labels(tmp_path / "in", tmp_path / "moving", labels="moving")
    assert list(both & 0xFFFF) == [251, 9, 251, 9, 0]


def test_classes_that_move_are_kept_whatever_the_flow_says(tmp_path):
    write_points(
        tmp_path / "in",
        [252, 10, 1],
        "semantickitti",
        flow=np.zeros((3, 3), np.float32) + [[0], [9], [0]],
    )
    assert list(exported_labels(tmp_path / "in", tmp_path / "out")[1]) == [252, 10, 1]
    assert list(exported_labels(tmp_path / "in", tmp_path / "moving", labels="moving")[1]) == [
        251,
        9,
        0,
    ]


def test_numbers_of_actors_that_do_not_fit_are_named(tmp_path):
    write_points(tmp_path / "in", [10, 10], instances=np.array([1, 70_000], np.uint32))
    result, _ = exported_labels(tmp_path / "in", tmp_path / "out")
    (failure,) = result.failures
    assert (
        "instances of frame 0: expected numbers of at most 16 bits, found 70000" in failure.message
    )
    with pytest.raises(
        ArgumentError, match="labels: expected one of semantic, moving, found 'binary'"
    ):
        exported_labels(tmp_path / "in", tmp_path / "other", labels="binary")


def test_right_handed_sequences_are_not_mirrored(tmp_path):
    _, labels, _ = write_carlasc(tmp_path / "in", "kitti")
    export("kitti", tmp_path / "in", tmp_path / "out", run=Run(workers=1))
    written = np.fromfile(
        tmp_path / "out" / "sequences" / "00" / "voxels" / "000000.label", "<u2"
    ).reshape(SPEC.size)
    assert np.array_equal(written, REMAPS["carla_to_semantickitti"](labels))


@given(arrays(bool, (3, 5, 2)))
@settings(max_examples=25, deadline=None)
def test_bits_come_back_first_voxel_in_the_highest_bit(mask):
    assert np.array_equal(unpack_bits(pack_bits(mask), (3, 5, 2), "mask"), mask)
    assert (pack_bits(mask)[0] & 0x80 > 0) == mask[0, 0, 0]


@pytest.mark.parametrize(
    ("classes", "labels", "raw"),
    [
        ("carlasc11", (0, 1, 4, 10, 6), (0, 50, 30, 10, 40)),
        ("semantickitti19", (0, 1, 9, 19), (0, 10, 40, 81)),
        ("carla", (0, 7, 10), (0, 40, 10)),
    ],
)
def test_predictions_go_where_the_evaluator_looks(tmp_path, classes, labels, raw):
    writer = FolderSink(tmp_path / "in").sequence("Val/KITTI_08/cartesian")
    writer.write_document(
        "evaluation/params.json", to_json(SPEC.to_params() | {"carlasc": {"classes": classes}})
    )
    grid = np.resize(np.array(labels, np.uint32), SPEC.size)
    writer.write("evaluation/labels", 5, grid)
    export(
        "kitti",
        tmp_path / "in",
        tmp_path / "out",
        options={"predictions": True},
        run=Run(workers=1),
    )
    written = np.fromfile(
        tmp_path / "out" / "sequences" / "08" / "predictions" / "000005.label", "<u2"
    )
    assert np.array_equal(written.reshape(SPEC.size)[:, ::-1], np.resize(np.array(raw), SPEC.size))
    assert [path.name for path in (tmp_path / "out" / "sequences" / "08").iterdir()] == [
        "predictions"
    ]


def test_sequences_get_numbers_by_the_whole_source_and_kittis_keep_theirs(tmp_path):
    write_dataset(tmp_path / "in")
    writer = FolderSink(tmp_path / "in").sequence("Train/KITTI_00/cartesian")
    writer.write("points", 0, np.ones((1, 4), np.float32))
    result = export(
        "kitti",
        tmp_path / "in",
        tmp_path / "out",
        sequences=["KITTI_00", "Town01_Light"],
        run=Run(workers=1),
    )
    assert result.sequences == {
        SEQUENCE: "sequences/00",
        "Train/Town01_Light/cartesian": "sequences/02",
    }


def test_a_second_export_goes_on(tmp_path):
    write_carlasc(tmp_path / "in")
    export("kitti", tmp_path / "in", tmp_path / "out", run=Run(workers=1))
    assert export("kitti", tmp_path / "in", tmp_path / "out", run=Run(workers=1)).skipped == 1
    (tmp_path / "out" / "sequences" / "00" / "voxels" / "000000.bin").unlink()
    assert export("kitti", tmp_path / "in", tmp_path / "out", run=Run(workers=1)).made == 1


def test_what_cannot_be_exported_is_named(tmp_path):
    write_carlasc(tmp_path / "in")
    with pytest.raises(ConflictError, match="expected a place outside"):
        export("kitti", tmp_path / "in", tmp_path / "in" / "out", run=Run(workers=1))
    with pytest.raises(MissingDataError, match="expected the sequences Town99"):
        export("kitti", tmp_path / "in", tmp_path / "out", sequences=["Town99"], run=Run(workers=1))
    with pytest.raises(MissingDataError, match="expected the grid fine, found small"):
        export(
            "kitti", tmp_path / "in", tmp_path / "out", options={"grid": "fine"}, run=Run(workers=1)
        )
    with pytest.raises(ArgumentError, match="name: expected one of kitti, .*, found 'poss'"):
        export("poss", tmp_path / "in", tmp_path / "out", run=Run(workers=1))
    with pytest.raises(
        ArgumentError,
        match="options: expected one of grid, predictions, labels, check, zip, found every",
    ):
        export("kitti", tmp_path / "in", tmp_path / "out", options={"every": 5}, run=Run(workers=1))
    assert not (tmp_path / "out").exists()


def test_frames_are_written_again_only_if_asked_for(tmp_path):
    write_carlasc(tmp_path / "in")
    export("kitti", tmp_path / "in", tmp_path / "out", run=Run(workers=1))
    scan = tmp_path / "out" / "sequences" / "00" / "velodyne" / "000000.bin"
    written = scan.read_bytes()
    scan.write_bytes(b"changed")
    assert export("kitti", tmp_path / "in", tmp_path / "out", run=Run(workers=1)).made == 0
    assert scan.read_bytes() == b"changed"
    assert (
        export("kitti", tmp_path / "in", tmp_path / "out", overwrite=True, run=Run(workers=1)).made
        == 1
    )
    assert scan.read_bytes() == written


def test_points_out_of_range_are_in_no_voxel(tmp_path):
    points, _, _ = write_carlasc(tmp_path / "in")
    ranges = {"frame": "carlasc", "classes": "carla", "min_range_m": 2.0, "max_range_m": 4.0}
    (tmp_path / "in" / "Val/Town07_Light/cartesian/carlasc.json").write_bytes(to_json(ranges))
    export("kitti", tmp_path / "in", tmp_path / "out", run=Run(workers=1))
    distance = np.linalg.norm(points[:, :3].astype(np.float64), axis=1)
    index = SPEC.flat_index(points[(distance >= 2) & (distance <= 4), :3] * [1, -1, 1])
    expected = np.zeros(SPEC.num_voxels, bool)
    expected[index[index >= 0]] = True
    path = tmp_path / "out" / "sequences" / "00" / "voxels" / "000000.bin"
    assert np.array_equal(unpack_bits(path.read_bytes(), SPEC.size, "bin").reshape(-1), expected)


def test_the_finest_grid_is_taken_and_a_cylindrical_one_is_refused(tmp_path):
    write_carlasc(tmp_path / "in")
    writer = FolderSink(tmp_path / "in").sequence("Val/Town07_Light/cartesian")
    coarse = SPEC.with_size((5, 4, 5))
    writer.write_document("coarse/params.json", to_json(coarse.to_params()))
    writer.write("coarse/labels", 0, np.zeros(coarse.size, np.uint32))
    writer.write("coarse/counts", 0, np.ones(coarse.size, np.float32))
    export("kitti", tmp_path / "in", tmp_path / "out", run=Run(workers=1))
    labels = tmp_path / "out" / "sequences" / "00" / "voxels" / "000000.label"
    assert labels.stat().st_size == 2 * SPEC.num_voxels
    round_ = GridSpec("cylindrical", (4, 4, 2), (0.0, -3.0, -2.0), (8.0, 3.0, 0.5))
    writer.write_document("round/params.json", to_json(round_.to_params()))
    with pytest.raises(
        ArgumentError, match="grid: expected a Cartesian grid, found .*round, which is cylindrical"
    ):
        export(
            "kitti",
            tmp_path / "in",
            tmp_path / "other",
            options={"grid": "round"},
            run=Run(workers=1),
        )


@pytest.mark.parametrize("order", [("cartesian", "cylindrical"), ("cylindrical", "cartesian")])
def test_of_two_coordinates_the_cartesian_sequence_is_exported(tmp_path, order):
    for coordinates in order:
        writer = FolderSink(tmp_path / "in").sequence(f"Val/Town07_Light/{coordinates}")
        writer.write("points", 0, np.ones((1, 4), np.float32))
    result = export("kitti", tmp_path / "in", tmp_path / "out", run=Run(workers=1))
    assert list(result.sequences) == ["Val/Town07_Light/cartesian"]


REFUSED = (1, 52, 99)
"""The ids that SemanticKITTI's own table maps to 0, but 0 itself."""
SCORED = {
    0,
    10,
    11,
    13,
    15,
    16,
    18,
    20,
    30,
    31,
    32,
    40,
    44,
    48,
    49,
    50,
    51,
    60,
    70,
    71,
    72,
    80,
    81,
    *range(252, 260),
}


def test_predictions_hold_only_ids_that_the_evaluator_scores():
    for name, mapping in TO_PREDICTED.items():
        assert set(mapping) == set(TO_RAW[name])
        assert set(mapping.values()) <= SCORED
        changed = {label for label, raw in mapping.items() if raw != TO_RAW[name][label]}
        assert changed <= {label for label, raw in TO_RAW[name].items() if raw in REFUSED}
        # what is occupied stays so
        assert all(mapping[label] for label in changed if TO_RAW[name][label] != 1)


def test_ground_truth_keeps_the_ids_that_predictions_may_not_have(tmp_path):
    writer = FolderSink(tmp_path / "in").sequence("Val/KITTI_08/cartesian")
    writer.write_document("evaluation/params.json", to_json(SPEC.to_params()))
    # Other, Wall, Bridge, Static, Dynamic
    grid = np.resize(np.array([0, 3, 11, 15, 19, 20], np.uint32), SPEC.size)
    writer.write("evaluation/labels", 0, grid)
    writer.write("evaluation/counts", 0, np.ones(SPEC.size, np.float32))
    folder = tmp_path / "out" / "sequences" / "08"
    for predictions, raw in ((False, (0, 99, 52, 52, 52, 99)), (True, (0, 50, 51, 50, 50, 50))):
        export(
            "kitti",
            tmp_path / "in",
            tmp_path / "out",
            options={"predictions": predictions},
            run=Run(workers=1),
        )
        name = "predictions" if predictions else "voxels"
        written = np.fromfile(folder / name / "000000.label", "<u2").reshape(SPEC.size)[:, ::-1]
        assert np.array_equal(written, np.resize(np.array(raw), SPEC.size))


def test_an_export_with_other_options_is_not_mixed_with_an_earlier_one(tmp_path):
    write_carlasc(tmp_path / "in")
    export("kitti", tmp_path / "in", tmp_path / "out", run=Run(workers=1))
    with pytest.raises(
        ConflictError, match="expected frames that were exported with grid=small, .*found grid=None"
    ):
        export(
            "kitti",
            tmp_path / "in",
            tmp_path / "out",
            options={"grid": "small"},
            run=Run(workers=1),
        )
    assert (
        export(
            "kitti",
            tmp_path / "in",
            tmp_path / "out",
            overwrite=True,
            options={"grid": "small"},
            run=Run(workers=1),
        ).made
        == 1
    )
    assert (
        export(
            "kitti",
            tmp_path / "in",
            tmp_path / "out",
            options={"grid": "small"},
            run=Run(workers=1),
        ).skipped
        == 1
    )


def test_a_folder_that_holds_another_sequence_is_not_continued(tmp_path):
    write_carlasc(tmp_path / "in")
    export("kitti", tmp_path / "in", tmp_path / "out", run=Run(workers=1))
    other = FolderSink(tmp_path / "other").sequence("Test/Town10_Light/cartesian")
    other.write("points", 0, np.ones((1, 4), np.float32))
    with pytest.raises(
        ConflictError, match="expected the sequence Test/Town10_Light.*, found Val/Town07_Light"
    ):
        export("kitti", tmp_path / "other", tmp_path / "out", run=Run(workers=1))


def test_an_interrupted_export_gives_the_same_bytes(tmp_path):
    write_scene(tmp_path / "in", frames=3)
    for place in ("whole", "parts"):
        export("kitti", tmp_path / "in", tmp_path / place, run=Run(workers=1))
    folder = tmp_path / "parts" / "sequences" / "00"
    for name in ("velodyne/000001.bin", "voxels/000002.occluded", "poses.txt"):
        (folder / name).unlink()
    result = export("kitti", tmp_path / "in", tmp_path / "parts", run=Run(workers=1))
    assert (result.made, result.skipped) == (2, 1)
    assert files_and_bytes(tmp_path / "parts") == files_and_bytes(tmp_path / "whole")


@pytest.mark.parametrize("predictions", [False, True])
def test_classes_without_a_map_are_named_before_anything_is_written(tmp_path, predictions):
    table = {
        "name": "lab",
        "names": {"0": "free", "1": "road"},
        "colors": {"0": [0, 0, 0], "1": [1, 1, 1]},
    }
    write_scene(tmp_path / "in", frames=1, metadata={"classes": table})
    with pytest.raises(FormatError, match="expected classes with a map: carla, .*, found lab"):
        export(
            "kitti",
            tmp_path / "in",
            tmp_path / "out",
            options={"predictions": predictions},
            run=Run(workers=1),
        )
    assert not (tmp_path / "out").exists()


def test_predictions_without_a_grid_are_refused(tmp_path):
    FolderSink(tmp_path / "in").sequence("Val/A/cartesian").write(
        "points", 0, np.ones((1, 4), np.float32)
    )
    with pytest.raises(MissingDataError, match="expected a Cartesian grid, found none"):
        export(
            "kitti",
            tmp_path / "in",
            tmp_path / "out",
            options={"predictions": True},
            run=Run(workers=1),
        )


def test_what_is_exported_is_scored_as_the_benchmark_scores_it(tmp_path):
    """Predictions in CarlaSC's classes, and the same ones as the benchmark's evaluator reads them."""
    write_scene(tmp_path / "in", frames=2)
    for predictions in (False, True):
        export(
            "kitti",
            tmp_path / "in",
            tmp_path / "out",
            options={"predictions": predictions},
            run=Run(workers=1),
        )
    result = evaluate(tmp_path / "out", tmp_path / "out")
    assert (result.convention.name, result.frames, result.failures) == ("semantickitti", 2, [])
    scored = {name: value for name, value in result.class_iou.items() if not np.isnan(value)}
    assert scored == {"car": 1.0, "person": 1.0, "road": 1.0, "traffic-sign": 1.0}


def test_a_calibration_goes_out_as_it_came_in(tmp_path):
    drive = SimulatedDrive(frames=3)
    folder = tmp_path / "in" / "sequences" / "00"
    for frame in range(drive.frames):
        write_scan(folder / "velodyne" / f"{frame:06d}.bin", drive.scan(frame).points)
    camera_T_lidar = np.eye(4)
    camera_T_lidar[:3] = [[0, -1, 0, 0.01], [0, 0, -1, -0.08], [1, 0, 0, -0.27]]
    poses = camera_T_lidar @ drive.world_T_vehicle(drive.times) @ invert(camera_T_lidar)
    poses = invert(poses[0]) @ poses
    (folder / "poses.txt").write_bytes(layout.encode_poses(poses))
    matrix = np.array([[718.9, 0, 607.2], [0, 718.9, 185.2], [0, 0, 1]])
    lines = {
        f"P{number}": np.column_stack([matrix, [shift, 0.1 * number, 0]])
        for number, shift in enumerate((0.0, -386.1, 45.4, -337.3))
    } | {"Tr": camera_T_lidar[:3]}
    text = [f"{name}: {' '.join(map(str, rows.ravel()))}\n" for name, rows in lines.items()]
    (folder / "calib.txt").write_text("".join(text))
    convert("kitti", tmp_path / "in", tmp_path / "made", grids=None, run=Run(workers=1))
    export("kitti", tmp_path / "made", tmp_path / "out", run=Run(workers=1))
    out = tmp_path / "out" / "sequences" / "00"
    found = Calibration.read(out / "calib.txt").values
    assert set(found) == set(lines)
    for name, rows in lines.items():
        assert np.allclose(found[name], rows.ravel(), atol=1e-9)
    written = layout.decode_poses((out / "poses.txt").read_bytes(), "poses.txt")
    assert np.allclose(written, poses, atol=1e-9)
