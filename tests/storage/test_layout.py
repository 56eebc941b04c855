import io

import numpy as np
import pytest
from helpers.errors import raises
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from carlasc.core.boxes import BOXES_DTYPE
from carlasc.core.grids import GridSpec
from carlasc.errors import FormatError
from carlasc.storage import FolderSource, field_files, layout
from carlasc.testing import write_dataset

finite = st.floats(allow_nan=False, allow_infinity=False)


@given(arrays(np.float64, st.tuples(st.integers(0, 5), st.just(3), st.just(4)), elements=finite))
def test_poses_come_back_bit_for_bit(rows):
    poses = np.tile(np.eye(4), (len(rows), 1, 1))
    poses[:, :3] = rows
    assert np.array_equal(layout.decode_poses(layout.encode_poses(poses), "poses.txt"), poses)


@given(arrays(np.float64, st.integers(0, 20), elements=finite))
def test_times_come_back_bit_for_bit(times):
    assert np.array_equal(layout.decode_times(layout.encode_times(times), "times.txt"), times)


def test_the_golden_text_files_are_written_as_they_stand(golden_capture):
    for name, decode, encode in (
        ("poses.txt", layout.decode_poses, layout.encode_poses),
        ("times.txt", layout.decode_times, layout.encode_times),
    ):
        data = (golden_capture / "cartesian" / name).read_bytes()
        assert encode(decode(data, name)) == data


@pytest.mark.parametrize(
    "field", [f for f in layout.SCAN_FIELDS.values() if f.dtype], ids=lambda field: field.name
)
@given(rows=st.integers(0, 7), seed=st.integers(0, 99))
def test_scan_fields_come_back(field, rows, seed):
    shape = (rows,) if field.columns is None else (rows, field.columns)
    array = np.random.default_rng(seed).integers(0, 255, shape).astype(field.dtype)
    data = bytes(field.encode(array, "x"))
    assert len(data) == array.nbytes
    assert np.array_equal(field.decode(data, "x"), array)


@pytest.mark.parametrize("part, nbytes", [("occupied", 2), ("flags", 1), ("views", 2)])
def test_fields_per_voxel_come_back_as_they_are_on_disk(part, nbytes):
    field = layout.field_named(f"evaluation/{part}")
    array = (
        np.random.default_rng(0)
        .integers(0, 2 ** (8 * nbytes), (2, 3, 4))
        .astype(f"<u{nbytes}")
        .view(field.dtype)
    )
    data = bytes(field.encode(array, "x"))
    assert data == array.tobytes()
    assert field.decode(data, "x", (2, 3, 4)).tobytes() == data
    # it is not a file of counts
    assert layout.frame_of(field.file(3).partition("/")[2], ".bin") is None


def test_probabilities_are_rounded_to_float16_when_they_are_written():
    field = layout.field_named("evaluation/occupied")
    found = field.decode(field.encode(np.array([0, 0.5, 0.9001, 1], np.float32), "x"), "x")
    assert found.tolist() == [0, 0.5, float(np.float16(0.9001)), 1]


def test_flags_and_views_that_do_not_fit_are_refused():
    with raises(FormatError, expected="uint8 or a smaller type", found="uint16"):
        layout.field_named("evaluation/flags").encode(np.zeros(2, np.uint16), "x")
    with raises(FormatError, expected="uint16 or a smaller type", found="uint32"):
        layout.field_named("evaluation/views").encode(np.zeros(2, np.uint32), "x")


def test_votes_come_back():
    field = layout.field_named("evaluation/votes")
    for dtype in (field_files.VOTES_DTYPE, field_files.WIDE_VOTES_DTYPE):
        votes = np.array([(3, 7, 2), (3, 0, 1), (9, 10, 65535)], dtype)
        back = field.decode(bytes(field.encode(votes, "x")), "x")
        assert back.dtype == dtype
        assert (back == votes).all()
    with raises(FormatError, where="v.npz", expected="an .npz"):
        field.decode(b"PK nonsense", "v.npz")


def test_velocities_come_back_bit_for_bit():
    field = layout.field_named("evaluation/velocity")
    for count in (0, 3):
        table = np.zeros(count, field_files.VELOCITY_DTYPE)
        table["voxel"] = np.arange(count) * 7
        table["velocity"] = np.random.default_rng(0).normal(size=(count, 3))
        data = bytes(field.encode(table, "x"))
        assert field.decode(data, "x", (2, 3, 4)).tobytes() == table.tobytes()
        with np.load(io.BytesIO(data)) as file:
            assert file.files == ["voxel", "velocity"] and file["velocity"].shape == (count, 3)
    with raises(FormatError, where="v.npz: voxel", expected="at most 2 values", found="3"):
        field.decode(data, "v.npz", (1, 1, 2))
    with raises(
        FormatError,
        where="v.npz",
        expected="a table of velocities: voxel, velocity",
        found="float32",
    ):
        field.encode(np.zeros((2, 4), np.float32), "v.npz")


def test_boxes_come_back_bit_for_bit():
    field = layout.field_named("boxes")
    for count in (0, 3):
        table = np.frombuffer(np.random.default_rng(count).bytes(89 * count), BOXES_DTYPE)
        data = bytes(field.encode(table, "x"))
        assert len(data) == 89 * count
        assert field.decode(data, "x").tobytes() == table.tobytes()


def test_boxes_of_another_size_or_type_are_refused():
    field = layout.field_named("boxes")
    with raises(
        FormatError, where="boxes/0.bin", expected=r"a multiple of 89 bytes \(one box\)", found="90"
    ):
        field.decode(bytes(90), "boxes/0.bin")
    with raises(FormatError, expected="a table of boxes", found="float64"):
        field.encode(np.zeros((2, 13)), "boxes/0.bin")
    with raises(FormatError, found=r".*shape \(1, 2\)"):
        field.encode(np.zeros((1, 2), BOXES_DTYPE), "boxes/0.bin")


def test_file_names_are_those_of_the_format():
    assert layout.field_named("points").file(7) == "velodyne/000007.bin"
    assert layout.field_named("flow").file(7) == "predictions/000007.bin"
    assert (
        layout.field_named("evaluation_64x64x8/counts").file(12) == "evaluation_64x64x8/000012.bin"
    )
    assert layout.field_named("evaluation/votes").file(1234567) == "evaluation/1234567.votes.npz"
    assert layout.grid_folder(GridSpec.published()) == "evaluation"
    assert layout.grid_folder(GridSpec.published("cylindrical")) == "evaluation"
    assert layout.grid_folder(GridSpec.published("fine")) == "evaluation_256x256x16"
    # the published number of cells, but -2..1.2 m high: not the published grid
    assert layout.grid_folder(GridSpec.published().with_resolution(0.4)) == "evaluation_128x128x8"
    assert layout.frame_of("000012.label", ".label") == 12
    assert [
        layout.frame_of(name, ".label")
        for name in ("12.label", "000012.bin", "x00012.label", ".000012.label.part")
    ] == [None] * 4
    with raises(FormatError, where="'colour'", expected="one of points"):
        layout.field_named("colour")


def test_a_file_cut_short_is_refused_with_both_sizes():
    with raises(
        FormatError,
        where="a.bin",
        expected=r"a multiple of 16 bytes \(4 float32 per row\)",
        found="17",
    ):
        layout.field_named("points").decode(bytes(17), "a.bin")
    with raises(FormatError, expected=r"96 bytes \(2 x 3 x 4 uint32\)", found="92"):
        layout.field_named("evaluation/labels").decode(bytes(92), "a.label", (2, 3, 4))


def test_arrays_that_do_not_fit_are_refused():
    with pytest.raises(FormatError, match=r"expected shape \(N, 4\), found \(2, 3\)"):
        layout.field_named("points").encode(np.zeros((2, 3), np.float32), "a.bin")
    with raises(FormatError, expected="unsigned integers", found="int64"):
        layout.field_named("labels").encode(np.zeros(2, np.int64), "a.label")
    with raises(FormatError, expected="uint32 or a smaller type"):
        layout.field_named("labels").encode(np.zeros(2, np.uint64), "a.label")


def test_broken_lines_are_named():
    with raises(
        FormatError, where="poses.txt", expected="12 numbers per line", found="11 in line 2"
    ):
        layout.decode_poses(b"1 " * 12 + b"\n" + b"1 " * 11, "poses.txt")
    with raises(FormatError, where="times.txt", expected="1 numbers per line"):
        layout.decode_times(b"zero\n", "times.txt")


def test_the_data_set_of_the_contract_tests_has_every_field(tmp_path):
    sequences = FolderSource(write_dataset(tmp_path)).sequences().values()
    names = {name.rpartition("/")[2] for sequence in sequences for name in sequence.fields()}
    images = {name for name in names if name.partition(".")[0] in layout.IMAGE_FOLDERS}
    assert images == {"images.front.jpg", "images.left-1.png", "image_depths.front.png"}
    assert names - images == {*layout.SCAN_FIELDS, *layout.GRID_FIELDS}


def test_a_field_of_images_is_a_folder_per_camera():
    field = layout.field_named("image_labels.front_left.png")
    assert (field.file(7), field.per, field.kind) == (
        "image_labels/front_left/000007.png",
        "scan",
        "picture",
    )
    for name in (
        "images.front.gif",
        "images.jpg",
        "images..jpg",
        "pictures.front.jpg",
        "images.a/b.jpg",
    ):
        with raises(FormatError, expected="one of"):
            layout.field_named(name)
