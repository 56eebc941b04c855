"""The layout as SemanticKITTI's files, and there and back again."""

import numpy as np
import pytest
from carlasc_converters.kitti import SemanticKitti
from carlasc_converters.kitti_voxels import pack_bits, unpack_bits
from carlasc_converters.occlusion import occluded_voxels
from helpers.sequences import write_dataset
from helpers.tiny_kitti import write_tiny_kitti
from hypothesis import given, settings
from hypothesis.extra.numpy import arrays

import carlasc
from carlasc.converting import convert, export
from carlasc.core.grids import GridSpec
from carlasc.core.tables import REMAPS
from carlasc.errors import ArgumentError, ConflictError, MissingDataError
from carlasc.storage import FolderSink, layout
from carlasc.storage.files import to_json

SEQUENCE = "Train/KITTI_00/cartesian"
SPEC = GridSpec("cartesian", (10, 8, 5), (-2.0, -4.0, -2.0), (8.0, 4.0, 0.5))


def frame_files(folder, name, suffix):
    return {path.name: path.read_bytes() for path in sorted((folder / name).glob(f"*{suffix}"))}


@pytest.fixture(scope="module")
def there_and_back(simulated, tmp_path_factory):
    middle, back = tmp_path_factory.mktemp("middle"), tmp_path_factory.mktemp("back")
    convert(
        "kitti", simulated[0], middle, classes="semantickitti", axes="right", grids="voxels", flow="none", workers=1
    )
    result = export("kitti", middle, back, workers=1)
    assert (result.made, result.failures, result.sequences) == (24, (), {SEQUENCE: "sequences/00"})
    return simulated[1].folder, back / "sequences" / "00"


@pytest.mark.parametrize(
    ("name", "suffix"), [("velodyne", ".bin"), *(("voxels", s) for s in (".bin", ".label", ".invalid", ".occluded"))]
)
def test_scans_and_voxels_come_back_as_they_were(there_and_back, name, suffix):
    before, after = (frame_files(folder, name, suffix) for folder in there_and_back)
    assert before
    assert before == after


def test_classes_come_back_as_they_were_and_instances_are_0(there_and_back):
    before, after = (frame_files(folder, "labels", ".label") for folder in there_and_back)
    assert before.keys() == after.keys()
    for name in before:
        assert np.array_equal(np.frombuffer(before[name], "<u4") & 0xFFFF, np.frombuffer(after[name], "<u4"))


def test_poses_come_back(there_and_back):
    before, after = (SemanticKitti(folder).sequences()[0].poses() for folder in there_and_back)
    assert np.abs(np.linalg.inv(before[0]) @ before - after).max() < 1e-6


def test_the_mirrored_frame_comes_back_too(simulated, tmp_path):
    convert("kitti", simulated[0], tmp_path / "middle", classes="semantickitti", grids="voxels", flow="none", workers=1)
    export("kitti", tmp_path / "middle", tmp_path / "back", workers=1)
    before, after = simulated[1].folder, tmp_path / "back" / "sequences" / "00"
    assert frame_files(before, "velodyne", ".bin") == frame_files(after, "velodyne", ".bin")
    assert frame_files(before, "voxels", ".label") == frame_files(after, "voxels", ".label")
    poses = SemanticKitti(after).sequences()[0].poses()
    assert np.abs(simulated[1].poses - poses).max() < 1e-6


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
    labels = np.where(rng.random(SPEC.size) < 0.1, rng.integers(1, 23, SPEC.size), 0).astype(np.uint32)
    counts = np.where(labels > 0, 3, rng.integers(0, 2, SPEC.size)).astype(np.float32)
    writer.write("small/labels", 0, labels)
    writer.write("small/counts", 0, counts)
    return points.astype(np.float32), labels, counts


def test_a_grid_of_carlasc_gets_masks_by_the_rules(tmp_path):
    points, labels, counts = write_carlasc(tmp_path / "in")
    export("kitti", tmp_path / "in", tmp_path / "out", workers=1)
    voxels = tmp_path / "out" / "sequences" / "00" / "voxels"
    expected = REMAPS["carla_to_semantickitti"](labels)[:, ::-1]
    assert np.array_equal(np.fromfile(voxels / "000000.label", "<u2").reshape(SPEC.size), expected)
    bits = {s: unpack_bits((voxels / f"000000.{s}").read_bytes(), SPEC.size, s) for s in ("bin", "invalid", "occluded")}
    assert np.array_equal(bits["invalid"], (counts == 0)[:, ::-1])
    cells = np.floor((points[:, :3] * [1, -1, 1] - [-2, -4, -2]) / [1, 1, 0.5]).astype(int)
    inside = ((cells >= 0) & (cells < SPEC.size)).all(axis=1)
    occupied = np.zeros(SPEC.size, bool)
    occupied[tuple(cells[inside].T)] = True
    assert np.array_equal(bits["bin"], occupied)
    assert np.array_equal(bits["occluded"], occluded_voxels(expected > 0, SPEC))


def test_right_handed_sequences_are_not_mirrored(tmp_path):
    _, labels, _ = write_carlasc(tmp_path / "in", "kitti")
    export("kitti", tmp_path / "in", tmp_path / "out", workers=1)
    written = np.fromfile(tmp_path / "out" / "sequences" / "00" / "voxels" / "000000.label", "<u2").reshape(SPEC.size)
    assert np.array_equal(written, REMAPS["carla_to_semantickitti"](labels))


def plain_occlusion(occupied, spec):
    """Sample every line finely: what the walk must agree with, but for lines that graze a voxel."""
    occluded = np.zeros(spec.size, bool)
    centers = spec.centers()
    for cell in np.ndindex(spec.size):
        line = centers[cell] * np.linspace(1, 0, 2000)[:, None]
        index = np.floor((line - spec.lower) / spec.voxel_size).astype(int)
        inside = ((index >= 0) & (index < spec.size)).all(axis=1)
        stop = len(inside) if inside.all() else int(np.argmin(inside))
        occluded[cell] = occupied[tuple(index[:stop].T)].any()
    return occluded


def test_occlusion_agrees_with_finely_sampled_lines():
    rng = np.random.default_rng(0)
    spec = GridSpec("cartesian", (9, 8, 5), (0.05, -4.1, -1.93), (9.05, 3.9, 0.57))
    for share in (0.02, 0.15):
        occupied = rng.random(spec.size) < share
        different = occluded_voxels(occupied, spec) != plain_occlusion(occupied, spec)
        assert different.mean() < 0.01
    assert not occluded_voxels(np.zeros(spec.size, bool), spec).any()
    assert occluded_voxels(np.ones(spec.size, bool), spec).all()


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
    writer.write_document("evaluation/params.json", to_json(SPEC.to_params() | {"carlasc": {"classes": classes}}))
    grid = np.resize(np.array(labels, np.uint32), SPEC.size)
    writer.write("evaluation/labels", 5, grid)
    export("kitti", tmp_path / "in", tmp_path / "out", predictions=True, workers=1)
    written = np.fromfile(tmp_path / "out" / "sequences" / "08" / "predictions" / "000005.label", "<u2")
    assert np.array_equal(written.reshape(SPEC.size)[:, ::-1], np.resize(np.array(raw), SPEC.size))
    assert [path.name for path in (tmp_path / "out" / "sequences" / "08").iterdir()] == ["predictions"]


def test_sequences_get_numbers_and_kittis_keep_theirs(tmp_path):
    write_dataset(tmp_path / "in")
    writer = FolderSink(tmp_path / "in").sequence("Train/KITTI_00/cartesian")
    writer.write("points", 0, np.ones((1, 4), np.float32))
    result = export("kitti", tmp_path / "in", tmp_path / "out", sequences=["KITTI_00", "Town01_Light"], workers=1)
    assert result.sequences == {SEQUENCE: "sequences/00", "Train/Town01_Light/cartesian": "sequences/01"}


def test_a_second_export_goes_on(tmp_path):
    write_carlasc(tmp_path / "in")
    export("kitti", tmp_path / "in", tmp_path / "out", workers=1)
    assert export("kitti", tmp_path / "in", tmp_path / "out", workers=1).skipped == 1
    (tmp_path / "out" / "sequences" / "00" / "voxels" / "000000.bin").unlink()
    assert export("kitti", tmp_path / "in", tmp_path / "out", workers=1).made == 1


def test_what_cannot_be_exported_is_named(tmp_path):
    write_carlasc(tmp_path / "in")
    with pytest.raises(ConflictError, match="expected a place outside"):
        export("kitti", tmp_path / "in", tmp_path / "in" / "out", workers=1)
    with pytest.raises(MissingDataError, match="expected the sequences Town99"):
        export("kitti", tmp_path / "in", tmp_path / "out", sequences=["Town99"], workers=1)
    with pytest.raises(MissingDataError, match="expected the grid fine, found small"):
        export("kitti", tmp_path / "in", tmp_path / "out", grid="fine", workers=1)
    with pytest.raises(ArgumentError, match="expected a data set that can be written"):
        export("poss", tmp_path / "in", tmp_path / "out", workers=1)


def test_tiny_round_trip_of_several_sequences(tmp_path):
    for number in ("00", "08"):
        write_tiny_kitti(tmp_path / "in", number, voxels=True)
    options = {"classes": "semantickitti", "axes": "right", "grids": "voxels", "flow": "none", "workers": 2}
    convert("kitti", tmp_path / "in", tmp_path / "middle", **options)
    export("kitti", tmp_path / "middle", tmp_path / "out", workers=2)
    for number in ("00", "08"):
        for name, suffix in (("velodyne", ".bin"), ("voxels", ".occluded")):
            before, after = (
                frame_files(tmp_path / side / "sequences" / number, name, suffix) for side in ("in", "out")
            )
            assert before == after
    assert carlasc.open(tmp_path / "middle").sequences().keys() == {SEQUENCE, "Val/KITTI_08/cartesian"}


def test_frames_are_written_again_only_if_asked_for(tmp_path):
    write_carlasc(tmp_path / "in")
    export("kitti", tmp_path / "in", tmp_path / "out", workers=1)
    scan = tmp_path / "out" / "sequences" / "00" / "velodyne" / "000000.bin"
    written = scan.read_bytes()
    scan.write_bytes(b"changed")
    assert export("kitti", tmp_path / "in", tmp_path / "out", workers=1).made == 0
    assert scan.read_bytes() == b"changed"
    assert export("kitti", tmp_path / "in", tmp_path / "out", overwrite=True, workers=1).made == 1
    assert scan.read_bytes() == written


def test_points_out_of_range_are_in_no_voxel(tmp_path):
    points, _, _ = write_carlasc(tmp_path / "in")
    ranges = {"frame": "carlasc", "classes": "carla", "min_range_m": 2.0, "max_range_m": 4.0}
    (tmp_path / "in" / "Val/Town07_Light/cartesian/carlasc.json").write_bytes(to_json(ranges))
    export("kitti", tmp_path / "in", tmp_path / "out", workers=1)
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
    export("kitti", tmp_path / "in", tmp_path / "out", workers=1)
    labels = tmp_path / "out" / "sequences" / "00" / "voxels" / "000000.label"
    assert labels.stat().st_size == 2 * SPEC.num_voxels
    round_ = GridSpec("cylindrical", (4, 4, 2), (0.0, -3.0, -2.0), (8.0, 3.0, 0.5))
    writer.write_document("round/params.json", to_json(round_.to_params()))
    with pytest.raises(ArgumentError, match="grid: expected a Cartesian grid, found .*round, which is cylindrical"):
        export("kitti", tmp_path / "in", tmp_path / "other", grid="round", workers=1)


def test_a_grid_that_is_named_is_exported_instead_of_the_original_voxels(tmp_path):
    write_tiny_kitti(tmp_path / "in", frames=1, voxels=True)
    options = {"classes": "semantickitti", "axes": "right", "grids": "voxels", "flow": "none", "workers": 1}
    convert("kitti", tmp_path / "in", tmp_path / "middle", **options)
    export("kitti", tmp_path / "middle", tmp_path / "out", grid="evaluation_256x256x32", workers=1)
    before, after = (tmp_path / side / "sequences" / "00" / "voxels" for side in ("in", "out"))
    size = (256, 256, 32)
    labels = np.fromfile(after / "000000.label", "<u2").reshape(size)
    occluded = unpack_bits((after / "000000.occluded").read_bytes(), size, "occluded")
    assert occluded[labels > 0].all()
    assert (before / "000000.occluded").read_bytes() != (after / "000000.occluded").read_bytes()


@pytest.mark.parametrize("order", [("cartesian", "cylindrical"), ("cylindrical", "cartesian")])
def test_of_two_coordinates_the_cartesian_sequence_is_exported(tmp_path, order):
    for coordinates in order:
        writer = FolderSink(tmp_path / "in").sequence(f"Val/Town07_Light/{coordinates}")
        writer.write("points", 0, np.ones((1, 4), np.float32))
    result = export("kitti", tmp_path / "in", tmp_path / "out", workers=1)
    assert list(result.sequences) == ["Val/Town07_Light/cartesian"]
