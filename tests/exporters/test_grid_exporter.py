"""Voxel grids as Occ3D, OpenOccupancy and SSCBench have them, read again by the facts of these
formats.
"""

import json
import re
import shutil

import numpy as np
import pytest
from helpers.datasets.exported import (
    CAR,
    PATH,
    SPEC,
    THINGS,
    files_and_bytes,
    occ3d_cell,
    read_occ3d,
    read_openoccupancy,
    read_sscbench,
    write_scene,
)

from carlasc.converting import export
from carlasc.core.grids import GridSpec
from carlasc.errors import ArgumentError, ConflictError, FormatError, MissingDataError
from carlasc.metrics import evaluate
from carlasc.running import Run
from carlasc.storage import FolderSink, layout
from carlasc.storage.files import to_json

HEIGHT_M = 1.8
GRID_FORMATS = ("occ3d", "openoccupancy", "sscbench")
NAME = "Town07_Light"


@pytest.fixture(scope="module")
def source(tmp_path_factory):
    return write_scene(tmp_path_factory.mktemp("scene"), frames=6)


@pytest.fixture(scope="module")
def occ3d(source, tmp_path_factory):
    out = tmp_path_factory.mktemp("occ3d")
    return out, export("occ3d", source, out, run=Run(workers=1))


def test_occ3d_has_things_where_they_are_from_the_ground_below_the_sensor(occ3d):
    annotations, arrays = read_occ3d(occ3d[0], NAME)
    classes = {CAR: 4, 4: 7, 12: 0}
    tokens = list(annotations["scene_infos"][NAME])
    assert len(tokens) == 6
    for number, token in enumerate(tokens):
        semantics, mask = arrays[token]["semantics"], arrays[token]["mask_lidar"]
        assert (semantics.shape, semantics.dtype, mask.dtype) == (
            (200, 200, 16),
            np.uint8,
            np.uint8,
        )
        for (x, y, z), label in THINGS.items():
            cell = occ3d_cell(x + 0.4 * number, -y, z + HEIGHT_M)
            assert semantics[cell] == classes[label]
            assert mask[cell] == 1
        assert semantics[occ3d_cell(1, 0, 0.1)] == 11  # the road is at the height of the ground
        assert semantics[occ3d_cell(1, 0, 2)] == 17
        assert mask[occ3d_cell(1, 0, 2)] == 1


def test_occ3d_masks_what_no_voxel_of_the_source_knows(occ3d):
    _, arrays = read_occ3d(occ3d[0], NAME)
    for array in arrays.values():
        assert np.array_equal(array["mask_lidar"], array["mask_camera"])
        # no votes, beside the grid, above it
        for unknown in (
            (-7, 0, 0.1),
            (20, 0, 0.1),
            (1, 0, 5.3),
        ):
            assert array["mask_lidar"][occ3d_cell(*unknown)] == 0
            assert array["semantics"][occ3d_cell(*unknown)] == 17


def test_occ3d_says_that_the_mask_of_cameras_is_a_copy(occ3d):
    annotations, _ = read_occ3d(occ3d[0], NAME)
    assert (
        annotations["carlasc"]
        == "mask_camera is a copy of mask_lidar, because no cameras are known"
    )
    assert sum(annotations["carlasc"] in note for note in occ3d[1].notes) == 1


def test_occ3d_masks_what_no_camera_sees(tmp_path):
    write_scene(tmp_path / "in", frames=1)
    (place,) = (tmp_path / "in").glob("**/small/000000.label")
    counts = np.fromfile(place.with_suffix(".bin"), np.float32)
    # two cameras see all voxels of one half along x
    bits = np.where(np.arange(len(counts)) < len(counts) // 2, 5, 0)
    place.with_suffix(".seen").write_bytes(bits.astype(np.uint8).tobytes())
    result = export("occ3d", tmp_path / "in", tmp_path / "out", run=Run(workers=1))
    annotations, arrays = read_occ3d(tmp_path / "out", NAME)
    (array,) = arrays.values()
    assert annotations["carlasc"] == "mask_camera is 1 where a camera sees a known voxel"
    assert not any("mask_camera" in note for note in result.notes)
    lidar, camera = array["mask_lidar"].astype(bool), array["mask_camera"].astype(bool)
    assert set(np.unique(array["mask_camera"])) == {0, 1} and not (camera & ~lidar).any()
    params = json.loads(place.with_name("params.json").read_text())
    middle = (params["min_bound"][0] + params["max_bound"][0]) / 2
    x = -40 + 0.4 * (np.arange(200) + 0.5)
    near, far = x < middle - 0.5, x > middle + 0.5
    assert lidar[near].any() and np.array_equal(camera[near], lidar[near]) and not camera[far].any()


@pytest.mark.parametrize("name", GRID_FORMATS)
def test_structure_without_a_class_of_its_own_is_said_to_become_something(tmp_path, name):
    write_scene(tmp_path / "in", frames=1)
    plain = export(name, tmp_path / "in", tmp_path / "plain", run=Run(workers=1))
    assert not any("without a class of its own" in note for note in plain.notes)
    (place,) = (tmp_path / "in").glob("**/small/000000.label")
    labels = np.fromfile(place, np.uint32)
    labels[np.flatnonzero(labels)[::3]] = 10
    np.where((labels > 0) & (labels != 10), 3, labels).astype(np.uint32).tofile(place)
    result = export(name, tmp_path / "in", tmp_path / "out", run=Run(workers=1))
    (note,) = [note for note in result.notes if "without a class of its own" in note]
    becomes = {
        "occ3d": "class 0 of occ3d",
        "openoccupancy": "class 0 of openoccupancy",
        "sscbench": "sscbench",
    }[name]
    assert re.search(
        rf"small: 6\d% of the occupied voxels are Other, .* they become .*{becomes}$", note
    )


def test_occ3d_names_scenes_frames_and_poses(occ3d):
    annotations, _ = read_occ3d(occ3d[0], NAME)
    assert (annotations["train_split"], annotations["val_split"]) == ([], [NAME])
    infos = list(annotations["scene_infos"][NAME].items())
    assert [token for token, _ in infos] == sorted(token for token, _ in infos)
    for number, (token, info) in enumerate(infos):
        assert info["timestamp"] == str(100_000 * number)
        assert info["prev"] == (infos[number - 1][0] if number else "")
        assert info["next"] == (infos[number + 1][0] if number < 5 else "")
        assert info["ego_pose"]["translation"] == pytest.approx([number, 0, 0])
        assert info["ego_pose"]["rotation"] == pytest.approx([1, 0, 0, 0])
        assert len(token) == 32


def test_occ3d_says_what_is_lost_and_how_to_make_the_exact_grid(occ3d):
    notes = " ".join(occ3d[1].notes)
    assert "the grid small covers 3% of the volume" in notes
    assert "--size 200,200,16 --bounds -40,40,-40,40,-2.8,3.6 --name occ3d" in notes
    assert "larger" not in notes


def test_clouds_without_rays_are_not_sent_to_regrid_which_refuses_them(source, tmp_path):
    shutil.copytree(source, tmp_path / "tiles")
    (poses,) = (tmp_path / "tiles").rglob("poses.txt")
    metadata = {"format": 2, "axes": "left", "classes": "carla", "rays": False}
    poses.with_name("carlasc.json").write_text(json.dumps(metadata))
    notes = " ".join(
        export("occ3d", tmp_path / "tiles", tmp_path / "out", run=Run(workers=1)).notes
    )
    assert "the grid small covers 3% of the volume" in notes
    assert "regrid" not in notes


def test_occ3d_is_scored_as_its_source_is(source, occ3d):
    assert evaluate(occ3d[0], occ3d[0], convention="occ3d-lidar").miou == 1.0
    changed = json.loads((occ3d[0] / "annotations.json").read_text())
    assert set(changed["scene_infos"]) == {NAME}


def test_scenes_of_earlier_exports_stay_in_the_annotations(source, tmp_path):
    export("occ3d", source, tmp_path / "out", run=Run(workers=1))
    other = write_scene(tmp_path / "other", path="Train/Town01_Light/cartesian")
    export("occ3d", other, tmp_path / "out", run=Run(workers=1))
    annotations = json.loads((tmp_path / "out" / "annotations.json").read_text())
    assert (annotations["train_split"], annotations["val_split"]) == (["Town01_Light"], [NAME])
    assert set(annotations["scene_infos"]) == {"Town01_Light", NAME}
    (tmp_path / "out" / "annotations.json").write_text("damaged")
    with pytest.raises(FormatError, match="annotations.json: expected JSON"):
        export("occ3d", other, tmp_path / "out", run=Run(workers=1))


@pytest.mark.parametrize(
    ("metadata", "options", "height"),
    [
        ({"axes": "left"}, {}, 1.8),
        ({"axes": "left", "sensors": [{"name": "top", "height_m": 1.0}]}, {}, 1.0),
        ({"axes": "left", "sensors": [{"name": "top", "height_m": 1.0}]}, {"height_m": "2.2"}, 2.2),
        ({"axes": "left", "sensors": [{"name": "top"}]}, {"height_m": 1.4}, 1.4),
    ],
)
def test_the_height_of_the_sensor_is_taken_from_where_it_is_known(
    tmp_path, metadata, options, height
):
    write_scene(tmp_path / "in", frames=1, metadata=metadata)
    result = export("occ3d", tmp_path / "in", tmp_path / "out", options=options, run=Run(workers=1))
    _, arrays = read_occ3d(tmp_path / "out", NAME)
    (array,) = arrays.values()
    assert array["semantics"][occ3d_cell(5.1, -3.1, -1.1 + height)] == 4
    assert array["semantics"][occ3d_cell(1, 0, -1.75 + height)] == 11
    assumed = [note for note in result.notes if "height of the sensor is not known" in note]
    assert len(assumed) == (height == 1.8)


def test_right_handed_data_are_not_mirrored(tmp_path):
    write_scene(tmp_path / "in", frames=1, metadata={"axes": "right"})
    export("occ3d", tmp_path / "in", tmp_path / "out", run=Run(workers=1))
    _, arrays = read_occ3d(tmp_path / "out", NAME)
    (array,) = arrays.values()
    assert array["semantics"][occ3d_cell(5.1, 3.1, 0.7)] == 4


def test_openoccupancy_has_the_axes_of_the_lidar_of_nuscenes(source, tmp_path):
    export("openoccupancy", source, tmp_path, run=Run(workers=1))
    (scene,) = tmp_path.glob("scene_*")
    files = sorted((scene / "occupancy").glob("*.npy"))
    assert len(files) == 6
    assert np.load(files[0]).dtype == np.uint16
    for number, file in enumerate(files):
        dense = read_openoccupancy(file)
        for (forward, right, up), label in THINGS.items():
            cell = (right + 51.2, forward + 0.4 * number + 51.2, up + 5.0)
            assert dense[tuple(int(c // 0.2) for c in cell)] == {CAR: 4, 4: 7, 12: 0}[label]
        assert dense[int(51.2 / 0.2), int(52.2 / 0.2), int(4.0 / 0.2)] == 255  # free
        assert (dense != 255).sum() < 6000  # unknown voxels are absent too
    assert evaluate(tmp_path, tmp_path, convention="openoccupancy").class_iou["car"] == 1.0


def test_sscbench_has_raw_ids_and_a_byte_for_each_invalid_voxel(source, tmp_path):
    result = export("sscbench", source, tmp_path, run=Run(workers=1))
    folder = tmp_path / "data_2d_raw" / "2013_05_28_drive_0000_sync" / "voxels"
    assert result.made == 2
    assert sorted(path.name for path in folder.glob("*.label")) == ["000000.label", "000005.label"]
    for frame in (0, 5):
        labels, invalid, occupied = read_sscbench(folder, frame)
        cells = {
            label: tuple(int(c // 0.2) for c in (x + 0.4 * frame, -y + 25.6, z + 2))
            for (x, y, z), label in THINGS.items()
        }
        assert labels[cells[CAR]] == 10
        assert invalid[cells[CAR]] == 0
        assert labels[cells[12]] == 81
        assert labels[int(1 / 0.2), int(25.6 / 0.2), int(0.2 / 0.2)] == 40
        assert invalid[200, 128, 10] == 1  # 40 m ahead
        assert labels[invalid == 1].max() == 0
        assert occupied[cells[CAR]] == 1
        assert occupied.sum() == 2
    assert evaluate(folder, folder, convention="sscbench").class_iou["car"] == pytest.approx(
        1.0, abs=1e-4
    )


def test_sscbench_takes_as_many_frames_as_asked_for(source, tmp_path):
    assert (
        export("sscbench", source, tmp_path, options={"every": "2"}, run=Run(workers=1)).made == 3
    )
    with pytest.raises(ArgumentError, match="every: expected 1 or more, found 0"):
        export("sscbench", source, tmp_path, options={"every": 0}, run=Run(workers=1))
    with pytest.raises(ArgumentError, match="every: expected a whole number, found 'often'"):
        export("sscbench", source, tmp_path, options={"every": "often"}, run=Run(workers=1))
    with pytest.raises(ConflictError, match="every=2"):
        export("sscbench", source, tmp_path, options={"every": 3}, run=Run(workers=1))


def test_a_sequence_without_a_frame_to_export_is_named(tmp_path):
    write_scene(tmp_path / "in", frames=2)
    (tmp_path / "in" / PATH / "small" / "000000.label").unlink()
    result = export("sscbench", tmp_path / "in", tmp_path / "out", run=Run(workers=1))
    assert result.made == 0
    assert any(
        note.endswith("Town07_Light/cartesian has no frame to export") for note in result.notes
    )


def test_sscbench_keeps_the_numbers_of_kitti_360(tmp_path):
    for name in ("KITTI360_0001", "Town07_Light"):
        write_scene(tmp_path / "in", frames=1, path=f"Train/{name}/cartesian")
    result = export("sscbench", tmp_path / "in", tmp_path / "out", run=Run(workers=1))
    assert sorted(result.sequences.values()) == [
        f"data_2d_raw/2013_05_28_drive_{number}_sync" for number in ("0000", "0001")
    ]


@pytest.mark.parametrize("name", GRID_FORMATS)
def test_the_exact_grid_is_exported_voxel_for_voxel(tmp_path, name):
    exact = {
        "occ3d": GridSpec("cartesian", (200, 200, 16), (-40.0, -40.0, -2.8), (40.0, 40.0, 3.6)),
        "openoccupancy": GridSpec(
            "cartesian", (512, 512, 40), (-51.2, -51.2, -5.0), (51.2, 51.2, 3.0)
        ),
        "sscbench": GridSpec("cartesian", (256, 256, 32), (0.0, -25.6, -2.0), (51.2, 25.6, 4.4)),
    }[name]
    exact = exact.with_bounds(exact.lower, exact.upper)  # float32, as regrid writes them
    rng = np.random.default_rng(0)
    labels = np.where(rng.random(exact.size) < 0.01, rng.choice([7, 8, 10], exact.size), 0).astype(
        np.uint32
    )
    counts = (rng.random(exact.size) < 0.5) | (labels > 0)
    write_scene(tmp_path / "in", frames=1)
    writer = FolderSink(tmp_path / "in").sequence(PATH)
    writer.write_document("whole/params.json", to_json(exact.to_params()))
    writer.write("whole/labels", 0, labels)
    writer.write("whole/counts", 0, counts.astype(np.float32))
    result = export(name, tmp_path / "in", tmp_path / "out", run=Run(workers=1))
    assert [note for note in result.notes if "mask_camera" not in note] == []
    mirrored, known = labels[:, ::-1], counts[:, ::-1]
    if name == "occ3d":
        (array,) = read_occ3d(tmp_path / "out", NAME)[1].values()
        assert np.array_equal(array["mask_lidar"], known)
        assert np.array_equal(
            array["semantics"],
            np.select([mirrored == 7, mirrored == 8, mirrored == 10], [11, 13, 4], 17),
        )
    elif name == "openoccupancy":
        (file,) = (tmp_path / "out").glob("*/occupancy/*.npy")
        right_forward = labels.transpose(1, 0, 2)  # y is to the right in the layout
        expected = np.select(
            [right_forward == 7, right_forward == 8, right_forward == 10], [11, 13, 4], 255
        )
        assert np.array_equal(read_openoccupancy(file), expected)
    else:
        (folder,) = (tmp_path / "out").glob("*/*/voxels")
        raw, invalid, _ = read_sscbench(folder, 0)
        assert np.array_equal(
            raw, np.select([mirrored == 7, mirrored == 8, mirrored == 10], [40, 48, 10], 0)
        )
        assert np.array_equal(invalid, ~known)


@pytest.mark.parametrize("name", GRID_FORMATS)
def test_an_interrupted_export_gives_the_same_bytes(source, tmp_path, name):
    export(name, source, tmp_path / "whole", run=Run(workers=1))
    export(name, source, tmp_path / "parts", run=Run(workers=1))
    whole = files_and_bytes(tmp_path / "whole")
    frames = [path for path in whole if path.endswith((".npz", ".npy", ".label"))]
    for path in frames[1:]:
        (tmp_path / "parts" / path).unlink()
    result = export(name, source, tmp_path / "parts", run=Run(workers=1))
    assert (result.made, result.skipped) == (len(frames) - 1, 1)
    assert files_and_bytes(tmp_path / "parts") == whole


@pytest.mark.parametrize("name", GRID_FORMATS)
def test_a_frame_that_fails_does_not_stop_the_others(source, tmp_path, name):
    write_scene(tmp_path / "in", frames=6)
    (tmp_path / "in" / PATH / "small" / "000005.label").write_bytes(b"short")
    result = export(name, tmp_path / "in", tmp_path / "out", run=Run(workers=1))
    assert [failure.frame for failure in result.failures] == [5]
    assert "000005.label" in result.failures[0].message
    assert result.made == (1 if name == "sscbench" else 5)
    if name == "occ3d":
        annotations, _ = read_occ3d(tmp_path / "out", NAME)
        assert len(annotations["scene_infos"][NAME]) == 5


@pytest.mark.parametrize("name", GRID_FORMATS)
def test_predictions_need_no_counts(tmp_path, name):
    write_scene(tmp_path / "in", frames=1, counts=False)
    with pytest.raises(MissingDataError, match="small: expected counts, .*`predictions=True`"):
        export(name, tmp_path / "in", tmp_path / "out", run=Run(workers=1))
    assert not (tmp_path / "out").exists()
    assert (
        export(
            name,
            tmp_path / "in",
            tmp_path / "out",
            options={"predictions": True},
            run=Run(workers=1),
        ).made
        == 1
    )


@pytest.mark.parametrize("name", GRID_FORMATS)
def test_what_cannot_be_exported_is_named_in_one_line(tmp_path, name):
    write_scene(tmp_path / "in", frames=1)
    with pytest.raises(MissingDataError, match="expected the grid fine, found small"):
        export(
            name, tmp_path / "in", tmp_path / "out", options={"grid": "fine"}, run=Run(workers=1)
        )
    with pytest.raises(ArgumentError, match="options: expected one of grid, .*, found nonsense"):
        export(name, tmp_path / "in", tmp_path / "out", options={"nonsense": 1}, run=Run(workers=1))
    writer = FolderSink(tmp_path / "in").sequence(PATH)
    round_ = GridSpec("cylindrical", (4, 4, 2), (0.0, -3.0, -2.0), (8.0, 3.0, 0.5))
    writer.write_document("round/params.json", to_json(round_.to_params()))
    writer.write("round/labels", 0, np.zeros(round_.size, np.uint32))
    with pytest.raises(
        ArgumentError, match="grid: expected a Cartesian grid, found .*round, which is cylindrical"
    ):
        export(
            name, tmp_path / "in", tmp_path / "out", options={"grid": "round"}, run=Run(workers=1)
        )
    scans = FolderSink(tmp_path / "scans").sequence(PATH)
    scans.write("points", 0, np.ones((1, 4), np.float32))
    with pytest.raises(
        MissingDataError, match="expected a Cartesian grid, found none: make one: `carlasc regrid`"
    ):
        export(name, tmp_path / "scans", tmp_path / "out", run=Run(workers=1))
    table = {
        "name": "lab",
        "names": {"0": "free", "1": "road"},
        "colors": {"0": [0, 0, 0], "1": [1, 1, 1]},
    }
    (tmp_path / "in" / PATH / layout.METADATA).write_bytes(to_json({"classes": table}))
    with pytest.raises(FormatError, match="expected classes with a map: carla, .*, found lab"):
        export(name, tmp_path / "in", tmp_path / "out", run=Run(workers=1))
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("classes", "ids", "semantics"),
    [
        ("carlasc11", (0, 1, 2, 7, 10), (17, 15, 1, 14, 4)),
        ("semantickitti", (0, 13, 32, 52, 258), (17, 3, 7, 15, 10)),
        ("semantickitti19", (0, 1, 13, 15, 19), (17, 4, 15, 16, 0)),
        ("semanticposs", (0, 4, 7, 15, 22), (17, 7, 4, 15, 14)),  # by way of CarlaSC's classes
    ],
)
def test_class_tables_have_maps(tmp_path, classes, ids, semantics):
    write_scene(tmp_path / "in", frames=1, metadata={"classes": classes})
    labels = np.resize(np.array(ids, np.uint32), SPEC.size[0])[:, None, None] * np.ones(
        SPEC.size, np.uint32
    )
    labels = np.repeat(labels[::2], 2, axis=0)  # alike in both voxels of one of the target
    FolderSink(tmp_path / "in").sequence(PATH).write("small/labels", 0, labels)
    export("occ3d", tmp_path / "in", tmp_path / "out", run=Run(workers=1))
    (array,) = read_occ3d(tmp_path / "out", NAME)[1].values()
    inside = array["semantics"][:, 100, 4][array["mask_lidar"][:, 100, 4] == 1]
    assert set(inside.tolist()) == set(semantics)


def test_an_id_beyond_the_table_fails_its_frame(tmp_path):
    write_scene(tmp_path / "in", frames=2)
    writer = FolderSink(tmp_path / "in").sequence(PATH)
    labels = np.zeros(SPEC.size, np.uint32)
    labels[40, 3, 4] = 24
    writer.write("small/labels", 1, labels)
    result = export("occ3d", tmp_path / "in", tmp_path / "out", run=Run(workers=1))
    assert [failure.frame for failure in result.failures] == [1]
    assert (
        "small of frame 1: expected class ids of carla, found 24 (1 times)"
        in result.failures[0].message
    )
