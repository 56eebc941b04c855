"""Voxel grids in the files of other programs, written by independent writers."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
from helpers import foreign_voxels as foreign
from helpers.errors import raises

import carlasc
from carlasc.errors import FormatError, MissingDataError

BOUNDS = {
    "semantickitti": foreign.KITTI,
    "sscbench": foreign.KITTI,
    "preprocessed": foreign.KITTI,
    "sscbench_preprocessed": foreign.KITTI,
    "occ3d": foreign.OCC3D,
    "openoccupancy": foreign.OPENOCCUPANCY,
    "surroundocc": foreign.SURROUNDOCC,
    "occnet": foreign.SURROUNDOCC,
    "carlasc_predictions": foreign.CARLASC,
}
NAMES = {
    "semantickitti": foreign.TO_KITTI,
    "sscbench": foreign.TO_KITTI,
    "preprocessed": foreign.TO_KITTI,
    "sscbench_preprocessed": foreign.TO_KITTI,
    "carlasc_predictions": foreign.TO_CARLASC,
}
Y_FORWARD = ("openoccupancy", "surroundocc", "occnet")
SLOW = {
    name: pytest.param(name, marks=pytest.mark.slow)
    for name in ("openoccupancy", "semantickitti", "sscbench", "sscbench_preprocessed")
}


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    """Return the folder of a format, which is written once."""
    root = tmp_path_factory.mktemp("foreign")
    return cache(lambda name: foreign.WRITERS[name](root / name))


def street_of(name):
    ground = {"occ3d": 0.0, "carlasc_predictions": -1.6}.get(name, -1.8)
    return foreign.street(*BOUNDS[name], forward="y" if name in Y_FORWARD else "x", ground=ground)


@pytest.mark.parametrize("name", [SLOW.get(name, name) for name in BOUNDS])
def test_every_format_is_opened_with_its_classes_geometry_and_axes(name, files):
    (sequence,) = carlasc.open(files(name)).sequences().values()
    grid = next(iter(sequence.grids))
    spec, table = sequence.grids[grid], sequence.classes_of(grid)
    lower, upper, size = BOUNDS[name]
    assert (spec.size, sequence.metadata.axes) == (size, "right")
    np.testing.assert_allclose((spec.lower, spec.upper), (lower, upper), rtol=1e-6)
    (*_, frame) = sequence.frames(f"{grid}/labels").tolist()
    read, scene = sequence.grid(grid, frame), street_of(name)
    to = NAMES.get(name, foreign.TO_NUSCENES)
    expected = np.array([0, *(table.id_of(to[kind]) for kind in foreign.KINDS[1:])])[scene]
    if name in ("preprocessed", "semantickitti"):  # above them, nothing counts
        assert not read.known[:, :, 20:].any() and read.known[:, :, :20].all()
        expected[:, :, 20:] = read.labels[:, :, 20:]
    if name in ("openoccupancy", "surroundocc"):
        assert (~read.known).sum() == 1  # noise
    np.testing.assert_array_equal(read.labels, expected)
    assert sequence.table_use(grid).found == (
        "assumed" if name == "carlasc_predictions" else "format"
    )


@pytest.mark.parametrize("name", ["challenge", pytest.param("flashocc", marks=pytest.mark.slow)])
def test_predictions_of_occ3d_are_found_by_their_tokens(name, files):
    (sequence,) = carlasc.open(files(name)).sequences().values()
    assert sequence.frames("pred/labels").tolist() == [0, 1]
    assert sequence.classes_of("pred").names[0] == "free"
    labels = sequence.read("pred/labels", 0)
    agreeing = (labels > 0) == (foreign.occ3d_labels() != 17)
    assert 0.97 < agreeing.mean() < 1


@pytest.mark.parametrize(
    ("name", "path", "frames"),
    [
        ("semantickitti", "sequences/08/voxels/000000.label", [0]),
        pytest.param("semantickitti", "sequences/08", [0], marks=pytest.mark.slow),
        pytest.param(
            "sscbench", "data_2d_raw/2013_05_28_drive_0009_sync/voxels", [5], marks=pytest.mark.slow
        ),
        pytest.param("preprocessed", "labels/08", [0], marks=pytest.mark.slow),
        ("preprocessed", "labels/08/000000_1_1.npy", [0]),
        pytest.param("sscbench_preprocessed", "preprocess", [5], marks=pytest.mark.slow),
        ("occ3d", "gts", [0, 1]),
        ("occ3d", "gts/scene-0001", [0, 1]),
        ("occ3d", "gts/scene-0001/bb1/labels.npz", [0]),
        ("challenge", "aa0.npz", [0]),
        ("surroundocc", "n015-2018__LIDAR_TOP__1533.pcd.bin.npy", [0]),
        ("occnet", "000.npy", [0]),
        ("carlasc_predictions", "Test/Town10_Heavy/cartesian/MotionSC_11_T1", [0]),
        ("carlasc_predictions", "Test/Town10_Heavy/cartesian/MotionSC_11_T1/000000.label", [0]),
    ],
)
def test_a_part_or_one_file_can_be_given(name, path, frames, files):
    root = files(name)
    sequence = carlasc.Scene(root / path).open().data.sequence
    (grid,) = sequence.grids
    assert sequence.frames(f"{grid}/labels").tolist() == frames


def test_masks_of_occ3d_are_counts_and_seen(files):
    (sequence,) = carlasc.open(files("occ3d")).sequences().values()
    seen, known = sequence.read("labels/seen", 0), sequence.read("labels/counts", 0)
    assert 0 < seen.sum() < known.sum() < known.size and set(np.unique(known)) == {0, 1}


def test_files_of_another_size_say_what_size_they_have(tmp_path):
    folder = tmp_path / "sequences/00/voxels"
    folder.mkdir(parents=True)
    np.zeros(256 * 256 * 16, "<u2").tofile(folder / "000000.label")
    with raises(
        FormatError,
        where="voxels",
        expected="256 x 256 x 32",
        found="256 x 256 x 16",
        advice="params.json",
    ):
        carlasc.Scene(tmp_path).open()


def test_a_folder_of_other_arrays_is_no_voxel_grid(tmp_path):
    np.save(tmp_path / "a.npy", np.zeros((5, 3)))
    np.savez(tmp_path / "b.npz", np.zeros((5, 3)))
    with pytest.raises(MissingDataError):
        carlasc.open(tmp_path).sequences()


def test_ids_that_the_format_does_not_have_are_named(tmp_path):
    rows = np.array([[1, 2, 3, 40], [1, 2, 4, 4]])
    np.save(tmp_path / "a.npy", rows)
    (sequence,) = carlasc.open(tmp_path).sequences().values()
    with raises(FormatError, where="a", expected="openoccupancy", found="40"):
        sequence.read("occupancy/labels", 0)
    np.save(tmp_path / "a.npy", np.array([[1, 2, 16, 4]]))
    (sequence,) = carlasc.open(tmp_path).sequences().values()
    with raises(FormatError, where="a.npy", expected="inside", found="16"):
        sequence.read("occupancy/labels", 0)


def test_files_of_other_programs_are_counted_and_shown(files, tmp_path):
    root = files("surroundocc")
    counted = carlasc.stats(root)
    street = street_of("surroundocc")
    cars = int((street == foreign.KINDS.index("car")).sum())
    assert counted.named(counted.total.voxels)["car"] == cars
    assert (counted.total.unknown, counted.uses[0].found) == (1, "format")
    assert carlasc.info(root).sequences[0].grids[0].size == (200, 200, 16)
    page = carlasc.view(root, tmp_path / "page.html")
    assert page.source_classes.table == "openoccupancy" and page.size_bytes > 1e5


def test_an_id_of_the_table_is_no_ignored_voxel(tmp_path):
    folder = tmp_path / "sequences/00/voxels"
    folder.mkdir(parents=True)
    labels = np.zeros(256 * 256 * 32, "<u2")
    labels[:3] = 40, 255, 255  # 255: a moving motorcyclist in the raw ids of SemanticKITTI
    labels.tofile(folder / "000000.label")
    (sequence,) = carlasc.open(tmp_path).sequences().values()
    grid = sequence.grid("voxels", 0)
    assert grid.known.all() and grid.labels.ravel()[:4].tolist() == [40, 255, 255, 0]


@pytest.mark.parametrize(
    ("name", "shown"), [("preprocessed", True), ("occ3d", False), ("surroundocc", False)]
)
def test_a_car_is_drawn_only_where_the_sensor_is_the_origin_and_x_is_forward(name, shown, files):
    assert carlasc.Scene(files(name)).open().shows_ego is shown
