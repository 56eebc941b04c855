"""Files of predictions: labels and probabilities are read as they are, and what does not fit is one
line that names the file.
"""

import json
from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_array_equal

from carlasc.core import ClassTable
from carlasc.core.frames import FrameRange
from carlasc.core.tables import CARLA, CARLASC11, SEMANTICKITTI, SEMANTICKITTI19, to_table
from carlasc.errors import ArgumentError, FormatError, MissingDataError
from carlasc.relabelling.predictions import PredictionReader, find_predictions
from carlasc.storage import open as open_store
from carlasc.storage.class_files import read_classes
from carlasc.storage.layout import CERTAIN
from carlasc.testing import write_dataset
from carlasc.testing.data import SCANS, WHOLE

CARLA_ONLY = PredictionReader(CARLA, CARLA)


def shares(count, classes, seed=0):
    return np.random.default_rng(seed).dirichlet(np.full(classes, 0.5), count).astype(np.float32)


def test_the_lower_16_bits_of_a_label_file_are_the_class(tmp_path):
    labels = np.array([7, 7 | (12 << 16), 1], np.uint32)
    (tmp_path / "000000.label").write_bytes(labels.tobytes())
    found, pairs = CARLA_ONLY.read(tmp_path / "000000.label", 3)
    assert_array_equal(found, [7, 7, 1])
    assert found.dtype == np.uint32 and pairs is None


@pytest.mark.parametrize("dtype", ["u1", "<i4", "<i8", ">u2"])
def test_whole_numbers_of_any_type_are_classes(tmp_path, dtype):
    np.save(tmp_path / "000000.npy", np.array([0, 22, 10], dtype))
    assert_array_equal(CARLA_ONLY.read(tmp_path / "000000.npy", 3)[0], [0, 22, 10])


@pytest.mark.parametrize("dtype", [np.float16, np.float32, np.float64])
def test_the_three_likeliest_classes_are_kept_the_likeliest_is_the_label(tmp_path, dtype):
    given = shares(500, 23).astype(dtype)
    np.save(tmp_path / "000000.npy", given)
    labels, pairs = CARLA_ONLY.read(tmp_path / "000000.npy", 500)
    assert_array_equal(labels, given.argmax(axis=1))
    order = np.argsort(-given.astype(np.float64), axis=1, kind="stable")[:, :3]
    wanted = np.rint(np.take_along_axis(given.astype(np.float32), order, 1) * np.float32(CERTAIN))
    assert_array_equal(pairs[:, 1::2], wanted)
    assert_array_equal(pairs[:, ::2], np.where(wanted > 0, order, 0))


def test_scores_before_the_softmax_are_refused_unless_they_are_said_to_be_such(tmp_path):
    scores = np.random.default_rng(0).normal(scale=4, size=(200, 23)).astype(np.float32)
    np.save(tmp_path / "000000.npy", scores)
    with pytest.raises(
        FormatError, match=r"000000\.npy: .*sum to 1.*at point 0: give `logits=True`"
    ):
        CARLA_ONLY.read(tmp_path / "000000.npy", 200)
    labels, pairs = replace(CARLA_ONLY, logits=True).read(tmp_path / "000000.npy", 200)
    exact = np.exp(scores.astype(np.float64))
    exact /= exact.sum(axis=1, keepdims=True)
    assert_array_equal(labels, scores.argmax(axis=1))
    assert np.abs(pairs[:, 1] / CERTAIN - exact.max(axis=1)).max() < 2e-5


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_numbers_that_are_none_are_no_scores(tmp_path, value):
    scores = np.zeros((3, 23), np.float32)
    scores[1, 2] = value
    np.save(tmp_path / "000000.npy", scores)
    with pytest.raises(FormatError) as error:
        replace(CARLA_ONLY, logits=True).read(tmp_path / "000000.npy", 3)
    assert error.value.found.endswith("at point 1")


def test_negative_shares_are_refused(tmp_path):
    np.save(tmp_path / "000000.npy", np.array([[0.5, 0.5], [1.5, -0.5]], np.float32))
    with pytest.raises(FormatError) as error:
        CARLA_ONLY.read(tmp_path / "000000.npy", 2)
    assert error.value.found.endswith("a minimum of -0.5 at point 1")


def test_an_npz_has_labels_probabilities_or_both(tmp_path):
    given, labels = shares(40, 23), np.arange(40) % 23
    np.savez_compressed(tmp_path / "000000.npz", labels=labels, probabilities=given)
    found, pairs = CARLA_ONLY.read(tmp_path / "000000.npz", 40)
    assert_array_equal(found, labels)
    assert_array_equal(pairs[:, 0], given.argmax(axis=1))
    np.savez(tmp_path / "000000.npz", labels=labels)
    assert CARLA_ONLY.read(tmp_path / "000000.npz", 40)[1] is None
    np.savez(tmp_path / "000000.npz", probabilities=given)
    assert_array_equal(CARLA_ONLY.read(tmp_path / "000000.npz", 40)[0], given.argmax(axis=1))
    np.savez(tmp_path / "000000.npz", others=labels)
    with pytest.raises(FormatError) as error:
        CARLA_ONLY.read(tmp_path / "000000.npz", 40)
    assert error.value.found == "neither"


def test_classes_are_converted_and_the_probabilities_of_those_that_become_one_are_added(tmp_path):
    given = shares(300, 23)
    np.save(tmp_path / "000000.npy", given)
    labels, pairs = PredictionReader(CARLA, CARLASC11).read(tmp_path / "000000.npy", 300)
    assert_array_equal(
        labels, to_table(given.argmax(axis=1).astype(np.uint32), CARLA, CARLASC11, "x")
    )
    target = to_table(np.arange(23, dtype=np.uint32), CARLA, CARLASC11, "x")
    summed = np.stack([given[:, target == k].sum(axis=1) for k in range(11)], axis=1)
    assert np.abs(pairs[:, 1::2] / CERTAIN - -np.sort(-summed, axis=1)[:, :3]).max() < 2e-5
    assert_array_equal(pairs[:, 0], summed.argmax(axis=1))


def test_a_scan_without_points_has_predictions_without_rows(tmp_path):
    np.save(tmp_path / "000000.npy", np.zeros((0, 23), np.float32))
    labels, pairs = CARLA_ONLY.read(tmp_path / "000000.npy", 0)
    assert labels.shape == (0,) and pairs.shape == (0, 6)


@pytest.mark.parametrize(
    ("array", "message"),
    [
        (np.zeros(4, np.int64), "expected 3 rows, one per point, found 4"),
        (np.zeros((4, 23), np.float32), "expected 3 rows"),
        (np.array([1, -1, 2]), "class table carla, up to 22, found -1"),
        (np.array([1, 23, 2]), "class table carla, up to 22, found 23"),
        (np.eye(3, 30, 25, dtype=np.float32), "class table carla, up to 22, found 25"),
        (
            np.zeros(3, np.float32),
            r"\(N,\) integers, or \(N, C\) floats.*found float32 of shape \(3,\)",
        ),
        (np.zeros((3, 23), np.uint8), r"found uint8 of shape \(3, 23\)"),
        (np.array(["a", "b", "c"]), "expected numeric values"),
    ],
)
def test_what_does_not_fit_is_one_line_that_names_the_file(tmp_path, array, message):
    np.save(tmp_path / "000007.npy", array)
    with pytest.raises(FormatError, match=message) as error:
        CARLA_ONLY.read(tmp_path / "000007.npy", 3)
    assert "000007.npy" in str(error.value) and "\n" not in str(error.value)


def test_a_label_file_that_is_cut_short_is_refused(tmp_path):
    (tmp_path / "000000.label").write_bytes(b"123456")
    with pytest.raises(FormatError) as error:
        CARLA_ONLY.read(tmp_path / "000000.label", 1)
    assert error.value.where.endswith(".label")


def test_ids_of_a_table_with_gaps_must_be_in_it(tmp_path):
    np.save(tmp_path / "000000.npy", np.array([10, 2, 40]))  # SemanticKITTI has no class 2
    with pytest.raises(FormatError) as error:
        PredictionReader(SEMANTICKITTI, SEMANTICKITTI19).read(tmp_path / "000000.npy", 3)
    assert error.value.found == "2"


@pytest.fixture(scope="module")
def sequences(tmp_path_factory):
    found = open_store(write_dataset(tmp_path_factory.mktemp("data") / "data")).sequences()
    return {path: found[path] for path in (SCANS, WHOLE)}


def write(folder, frames=(0, 1, 2), suffix=".label"):
    folder.mkdir(parents=True, exist_ok=True)
    for frame in frames:
        (folder / f"{frame:06d}{suffix}").write_bytes(b"")


ALL = FrameRange()


@pytest.mark.parametrize(
    "folder",
    [
        "Val/Town07_Heavy",
        "Val/Town07_Heavy/cartesian",
        "Town07_Heavy",
        "sequences/Town07_Heavy/predictions",
        ".",
        "labels",
        "predictions",
    ],
)
def test_the_files_of_a_sequence_are_found_where_networks_write_them(sequences, tmp_path, folder):
    write(tmp_path / folder)
    found = find_predictions(tmp_path, {SCANS: sequences[SCANS]}, ALL)[SCANS]
    assert (
        found.folder == tmp_path / folder and found.frames == (0, 1, 2) and found.suffix == ".label"
    )


def test_predictions_of_several_sequences_are_in_folders_of_their_names(sequences, tmp_path):
    write(tmp_path / "Town07_Heavy")
    write(tmp_path / "Town01_Light", (0, 1, 2, 5), ".npz")
    found = find_predictions(tmp_path, sequences, ALL)
    assert {path: files.folder.name for path, files in found.items()} == {
        SCANS: "Town07_Heavy",
        WHOLE: "Town01_Light",
    }


def test_a_data_set_in_the_layout_is_a_folder_of_predictions(sequences, tmp_path):
    write_dataset(tmp_path / "data")  # with grids and instances, whose files have the same names
    found = find_predictions(tmp_path / "data", sequences, ALL)
    assert {path: files.folder for path, files in found.items()} == {
        path: tmp_path / "data" / path / "labels" for path in sequences
    }


def test_frames_without_a_file_are_named_unless_they_are_left_out(sequences, tmp_path):
    write(tmp_path / "Town07_Heavy")
    write(tmp_path / "Town01_Light", (0, 1, 7))
    message = r"expected a file for each frame, found none for 2 of 4 frames of .*cartesian \(000002, 000005\): .*`frames`"
    with pytest.raises(MissingDataError, match=message):
        find_predictions(tmp_path, sequences, ALL)
    assert find_predictions(tmp_path, sequences, FrameRange(None, 2))[WHOLE].frames == (0, 1)


def test_files_of_another_split_or_of_another_sequence_are_not_taken(sequences, tmp_path):
    write(tmp_path / "Test/Town07_Heavy")
    write(tmp_path / "Val/Town03_Light")
    with pytest.raises(MissingDataError) as error:
        find_predictions(tmp_path, {SCANS: sequences[SCANS]}, ALL)
    assert error.value.found.startswith("Test/Town07_Heavy, Val")


def test_two_folders_of_a_sequence_and_two_kinds_of_files_are_refused(sequences, tmp_path):
    write(tmp_path / "a/Town07_Heavy")
    write(tmp_path / "b/Town07_Heavy")
    with pytest.raises(FormatError) as error:
        find_predictions(tmp_path, {SCANS: sequences[SCANS]}, ALL)
    assert error.value.found == "a/Town07_Heavy, b/Town07_Heavy"
    write(tmp_path / "a/Town07_Heavy", suffix=".npy")
    with pytest.raises(FormatError) as error:
        find_predictions(tmp_path, {SCANS: sequences[SCANS]}, ALL)
    assert error.value.found == ".label and .npy"


def test_names_of_frames_have_six_digits_as_those_of_the_layout(sequences, tmp_path):
    write(tmp_path)
    (tmp_path / "000001.label").rename(tmp_path / "0000000001.label")
    with pytest.raises(MissingDataError) as error:
        find_predictions(tmp_path, {SCANS: sequences[SCANS]}, ALL)
    assert error.value.found.startswith("none for 1 of 3 frames") and error.value.found.endswith(
        "(000001)"
    )


@pytest.mark.parametrize(
    "make", [lambda path: None, lambda path: path.write_text("x"), lambda path: path.mkdir()]
)
def test_a_folder_without_predictions_is_one_line(sequences, tmp_path, make):
    make(tmp_path / "x")
    with pytest.raises(MissingDataError) as error:
        find_predictions(tmp_path / "x", sequences, ALL)
    assert error.value.found == "none"


def test_a_class_table_is_a_name_a_table_or_a_file(tmp_path):
    own = ClassTable("mine", {0: "free", 1: "wall"}, {0: (0, 0, 0), 1: (9, 9, 9)})
    assert read_classes("semantickitti19")[0] is SEMANTICKITTI19 and read_classes(own)[0] is own
    (tmp_path / "own.json").write_text(json.dumps(own.to_dict()))
    (tmp_path / "carlasc.json").write_text(json.dumps({"format": 2, "classes": own.to_dict()}))
    (tmp_path / "named.json").write_text(json.dumps({"format": 2, "classes": "semantickitti"}))
    assert (
        read_classes(tmp_path / "own.json")[0]
        == own
        == read_classes(str(tmp_path / "carlasc.json"))[0]
    )
    assert read_classes(tmp_path / "named.json")[0] is SEMANTICKITTI
    (tmp_path / "bad.json").write_text('{"names": {"0": "a"}}')
    with pytest.raises(FormatError) as error:
        read_classes(tmp_path / "bad.json")[0]
    assert error.value.where.endswith("bad.json: classes")
    with pytest.raises(ArgumentError) as error:
        read_classes("kitti")[0]
    assert error.value.where == "classes" and error.value.found == "'kitti'"
