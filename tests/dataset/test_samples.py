import pickle
import subprocess
import sys
import time
import zipfile
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
from helpers.datasets.drives import bend, write_drive, write_world
from helpers.references.plain_loader import PlainLoader

import carlasc.storage
from carlasc.core.grids import GridSpec
from carlasc.core.tables import CARLA, REMAPS, SEMANTICKITTI
from carlasc.dataset import FIELDS, Dataset
from carlasc.errors import ArgumentError, FormatError, MissingDataError
from carlasc.storage import FolderSource, layout
from carlasc.storage.files import to_json
from carlasc.storage.packing import pack

SMALL = GridSpec("cartesian", (16, 16, 4), (-8.0, -8.0, -2.0), (8.0, 8.0, 1.0))
SMALL_CYLINDRICAL = GridSpec("cylindrical", (8, 16, 4), (0.0, -np.pi, -2.0), (20.0, np.pi, 1.0))


@pytest.fixture(scope="module")
def world(tmp_path_factory):
    """Two training sequences and one to validate with, small grids."""
    return write_world(tmp_path_factory.mktemp("world"), SMALL)


@pytest.mark.parametrize("history", [1, 3])
@pytest.mark.parametrize("align", [True, False])
def test_stacks_labels_and_counts_are_those_of_the_published_loader(
    golden, golden_capture, history, align
):
    expected = np.load(golden / "loader.npz")
    fields = ("occupancy", "density", "labels", "counts", "known")
    sample = Dataset(golden_capture / "cartesian", history=history, align=align, fields=fields)[2]
    key = f"T{history}_pose{int(align)}_binary"
    np.testing.assert_array_equal(sample["occupancy"], expected[f"{key}1_input"])
    np.testing.assert_array_equal(sample["density"], expected[f"{key}0_input"])
    np.testing.assert_array_equal(sample["labels"], expected["labels_remapped"])
    np.testing.assert_array_equal(sample["counts"], expected["counts"])
    np.testing.assert_array_equal(sample["known"], expected["counts"] > 0)


def test_occupancy_alone_equals_the_published_loader_too(golden, golden_capture):
    sample = Dataset(golden_capture / "cartesian", history=3)[2]
    np.testing.assert_array_equal(
        sample["occupancy"], np.load(golden / "loader.npz")["T3_pose1_binary1_input"]
    )


def test_every_field_has_the_documented_shape_and_type(world):
    sample = Dataset(world, "train", history=3, fields=FIELDS)[4]
    found = {
        name: (array.dtype.name, array.shape)
        for name, array in sample.items()
        if isinstance(array, np.ndarray)
    }
    assert found == {
        "occupancy": ("uint8", (3, 16, 16, 4)),
        "density": ("int32", (3, 16, 16, 4)),
        "visibility": ("uint8", (3, 16, 16, 4)),
        "labels": ("uint8", (16, 16, 4)),
        "known": ("bool", (16, 16, 4)),
        "counts": ("float32", (16, 16, 4)),
        "points": ("float32", (300, 3)),
        "point_labels": ("uint8", (300,)),
        "flow": ("float32", (300, 3)),
        "remission": ("float32", (300,)),
        "poses": ("float64", (3, 4, 4)),
        "valid": ("bool", (3,)),
    }
    assert (sample["sequence"], sample["frame"]) == ("Town01_Light", 4)
    assert all(
        array.flags.writeable and array.flags.c_contiguous
        for array in sample.values()
        if hasattr(array, "flags")
    )


def test_values_are_those_of_the_files(world):
    dataset = Dataset(world, ["Town02_Light"], history=2, fields=FIELDS)
    sequence = FolderSource(world).sequences()["Train/Town02_Light/cartesian"]
    remap = REMAPS["carlasc11"]
    for sample in (dataset[i] for i in range(len(dataset))):
        frame = sample["frame"]
        np.testing.assert_array_equal(sample["points"], sequence.read("points", frame)[:, :3])
        np.testing.assert_array_equal(sample["point_labels"], remap(sequence.read("labels", frame)))
        np.testing.assert_array_equal(sample["flow"], sequence.read("flow", frame))
        np.testing.assert_array_equal(sample["remission"], sequence.read("points", frame)[:, 3])
        np.testing.assert_array_equal(
            sample["labels"], remap(sequence.read("evaluation/labels", frame))
        )
        np.testing.assert_array_equal(sample["counts"], sequence.read("evaluation/counts", frame))
        np.testing.assert_array_equal(sample["known"], sample["counts"] > 0)


@pytest.mark.parametrize("coordinates", ["cartesian", "cylindrical"])
def test_stacks_are_those_of_the_plain_loader(tmp_path, coordinates):
    folder = write_drive(tmp_path / "Train" / "Town01_Light" / coordinates, range(7), points=3000)
    for density in (False, True):
        what = "density" if density else "occupancy"
        dataset = Dataset(
            tmp_path, history=4, coordinates=coordinates, fields=(what, "labels", "known")
        )
        plain = PlainLoader(folder, 4, density=density)
        for frame in (6, 0, 3, 4, 5):
            for name, array in plain[frame].items():
                np.testing.assert_array_equal(dataset[frame][name], array)


def test_the_stack_is_padded_with_empty_invalid_scans_before_the_start(world):
    sample = Dataset(world, history=4, fields=("occupancy", "poses"))[1]
    assert sample["valid"].tolist() == [False, False, True, True]
    assert [grid.any() for grid in sample["occupancy"]] == [False, False, True, True]
    np.testing.assert_array_equal(sample["poses"][:2], np.tile(np.eye(4), (2, 1, 1)))


def test_history_crosses_neither_sequences_nor_gaps(tmp_path):
    write_drive(tmp_path / "Train" / "A" / "cartesian", [0, 1, 2, 5, 6], spec=SMALL)
    write_drive(tmp_path / "Train" / "B" / "cartesian", [0, 1], spec=SMALL)
    dataset = Dataset(tmp_path, history=3)
    valid = {
        (s["sequence"], s["frame"]): s["valid"].sum()
        for s in (dataset[i] for i in range(len(dataset)))
    }
    assert list(valid.values()) == [1, 2, 3, 1, 2, 1, 2]
    for (sequence, frame), count in valid.items():
        stack = dataset[dataset.index_of(sequence, frame)]["occupancy"]
        assert [grid.any() for grid in stack] == [False] * (3 - count) + [True] * count


def test_poses_take_past_points_to_the_current_frame(world):
    dataset = Dataset(world, "val", history=3, fields=("poses",))
    poses = bend(3)
    for past, current_T_past in enumerate(dataset[2]["poses"]):
        np.testing.assert_allclose(poses[2] @ current_T_past, poses[past], atol=1e-12)
    np.testing.assert_array_equal(dataset[2]["poses"][2], np.eye(4))


def test_frames_without_a_grid_are_left_out_only_when_a_grid_is_asked_for(tmp_path):
    write_drive(
        tmp_path / "Train" / "A" / "cartesian", range(11), grid_frames=[0, 5, 10], spec=SMALL
    )
    with_grid = Dataset(tmp_path, history=3)
    assert [with_grid[i]["frame"] for i in range(len(with_grid))] == [0, 5, 10]
    assert with_grid[1]["valid"].all()  # its past scans have no grids, and are there
    assert len(Dataset(tmp_path, history=3, fields=("occupancy", "points"))) == 11


def test_without_counts_every_voxel_is_known(tmp_path):
    folder = write_drive(tmp_path / "Train" / "A" / "cartesian", range(2), spec=SMALL)
    for frame in range(2):
        (folder / "evaluation" / f"{frame:06d}.bin").unlink()
    assert Dataset(tmp_path)[1]["known"].all()
    with pytest.raises(MissingDataError, match="evaluation/counts"):
        Dataset(tmp_path, fields=("counts",))


@pytest.mark.parametrize(
    "split", ["train", "Train", "TRAIN", ["Town01_Light", "Train/Town02_Light"]]
)
def test_a_split_is_named_in_any_case_or_is_a_list_of_sequences(world, split):
    assert [sequence.name for sequence in Dataset(world, split).sequences] == [
        "Town01_Light",
        "Town02_Light",
    ]


def test_no_split_means_all_and_the_root_may_be_any_level_or_a_source(world):
    assert len(Dataset(world)) == 13
    assert len(Dataset(world / "Val")) == len(Dataset(world / "Val" / "Town07_Light")) == 3
    assert len(Dataset(str(world / "Train" / "Town02_Light" / "cartesian"))) == 4
    assert len(Dataset(FolderSource(world), "val")) == 3


def test_grids_come_from_a_second_root_by_split_and_sequence(tmp_path, world):
    fine = SMALL.with_size((32, 32, 8))
    write_drive(
        tmp_path / "Train" / "Town01_Light" / "cartesian",
        [],
        grid_frames=[1, 3, 4],
        spec=fine,
        seed=7,
    )
    write_drive(
        tmp_path / "Val" / "Town01_Light" / "cartesian", [], grid_frames=[0], spec=fine, seed=8
    )
    dataset = Dataset(world, ["Town01_Light"], history=2, grids_source=tmp_path, remap=None)
    assert dataset.spec == fine and dataset.classes == CARLA
    assert [dataset[i]["frame"] for i in range(len(dataset))] == [1, 3, 4]
    truth = (
        FolderSource(tmp_path)
        .sequences()["Train/Town01_Light/cartesian"]
        .read("evaluation/labels", 3)
    )
    np.testing.assert_array_equal(dataset[1]["labels"], truth)
    assert dataset[1]["occupancy"].shape == (2, *fine.size) and dataset[1]["occupancy"][0].any()


def test_cylindrical_grids_of_a_second_root_take_scans_and_poses_from_cartesian(tmp_path, world):
    for split, name in (
        ("Train", "Town01_Light"),
        ("Train", "Town02_Light"),
        ("Val", "Town07_Light"),
    ):
        folder = tmp_path / split / name / "cylindrical"
        write_drive(
            folder, [], grid_frames=[2, 3] if split == "Train" else [2], spec=SMALL_CYLINDRICAL
        )
    dataset = Dataset(world, history=2, coordinates="cylindrical", grids_source=tmp_path)
    assert len(dataset) == 5 and dataset.spec == SMALL_CYLINDRICAL
    assert {sequence.coordinates for sequence in dataset.sequences} == {"cartesian"}
    same = Dataset(world, history=2, grid=SMALL_CYLINDRICAL, fields=("occupancy",))
    place = same.index_of("Town07_Light", 2)
    np.testing.assert_array_equal(dataset[4]["occupancy"], same[place]["occupancy"])


@pytest.mark.parametrize("own_scans", [True, False])
def test_cylindrical_grids_beside_cartesian_ones_take_their_own_scans_if_there_are_any(
    tmp_path, own_scans
):
    sequence = tmp_path / "Train" / "A"
    write_drive(sequence / "cartesian", range(3), spec=SMALL, seed=1)
    write_drive(
        sequence / "cylindrical",
        range(3 if own_scans else 0),
        grid_frames=range(3),
        spec=SMALL_CYLINDRICAL,
    )
    dataset = Dataset(tmp_path, coordinates="cylindrical")
    assert len(dataset) == 3 and dataset.spec == SMALL_CYLINDRICAL
    assert dataset.sequences[0].coordinates == ("cylindrical" if own_scans else "cartesian")


def test_two_roots_that_are_one_sequence_each_go_together(golden_capture):
    fine = Dataset(
        golden_capture / "cartesian", history=3, grids_source=golden_capture / "cartesian_fine"
    )
    assert fine.spec == GridSpec.published("fine") and len(fine) == 3
    cylindrical = Dataset(
        golden_capture / "cartesian",
        coordinates="cylindrical",
        grids_source=golden_capture / "cylindrical",
    )
    assert cylindrical.spec == GridSpec.published("cylindrical")
    assert cylindrical[2]["occupancy"].any()


def test_a_grid_is_chosen_by_name_or_by_geometry(tmp_path):
    folder = write_drive(tmp_path / "Train" / "A" / "cartesian", range(2), spec=SMALL)
    fine = SMALL.with_size((32, 16, 8))
    (folder / "evaluation_32x16x8").mkdir()
    (folder / "evaluation_32x16x8" / "params.json").write_bytes(to_json(fine.to_params()))
    labels = np.random.default_rng(0).integers(0, 23, fine.size).astype(np.uint32)
    for frame in range(2):
        (folder / "evaluation_32x16x8" / f"{frame:06d}.label").write_bytes(labels.tobytes())
    for grid in ("evaluation_32x16x8", fine):
        dataset = Dataset(tmp_path, grid=grid)
        assert dataset.spec == fine
        np.testing.assert_array_equal(dataset[0]["labels"], REMAPS["carlasc11"](labels))
    with pytest.raises(MissingDataError, match=r"evaluation_32x16x8 \(cartesian 32 x 16 x 8\)"):
        Dataset(tmp_path, grid="evaluation_9x9x9")
    with pytest.raises(MissingDataError, match="found evaluation"):
        Dataset(tmp_path, grid=GridSpec.published("fine"))


def test_scans_alone_take_any_geometry_and_need_no_grid(tmp_path):
    write_drive(tmp_path / "Train" / "A" / "cartesian", range(2), grid_frames=[])
    with pytest.raises(ArgumentError, match="needs a grid"):
        _ = Dataset(tmp_path, fields=("points",)).spec
    dataset = Dataset(tmp_path, grid=SMALL, fields=("occupancy",))
    assert dataset[0]["occupancy"].shape == (1, 16, 16, 4)
    with pytest.raises(MissingDataError, match="expected the grid evaluation, found none"):
        Dataset(tmp_path)


def test_grids_alone_need_no_scans(tmp_path):
    write_drive(tmp_path / "Test" / "A" / "cartesian", [], grid_frames=range(3), spec=SMALL)
    assert Dataset(tmp_path, "test", fields=("labels", "known"))[2]["valid"].tolist() == [False]
    with pytest.raises(MissingDataError, match="field points"):
        Dataset(tmp_path)


def test_remaps_by_name_table_mapping_or_none_agree(world):
    by_name = Dataset(world, fields=("labels", "point_labels"))[3]
    raw = Dataset(world, fields=("labels", "point_labels"), remap=None)[3]
    table = REMAPS["carlasc11"].table
    for remap in (REMAPS["carlasc11"], table, table.tolist(), dict(enumerate(table.tolist()))):
        sample = Dataset(world, fields=("labels", "point_labels"), remap=remap)[3]
        for name in ("labels", "point_labels"):
            assert sample[name].dtype == raw[name].dtype == np.uint8
            np.testing.assert_array_equal(sample[name], by_name[name])
            np.testing.assert_array_equal(sample[name], table[raw[name]])


def test_ids_over_255_are_not_wrapped(tmp_path):
    folder = write_drive(
        tmp_path / "A" / "cartesian", [0], spec=SMALL, metadata={"classes": "semantickitti"}
    )
    labels = np.full(SMALL.size, 259, np.uint32)
    (folder / "evaluation" / "000000.label").write_bytes(labels.tobytes())
    raw = Dataset(tmp_path, remap=None, fields=("labels",))
    assert (
        raw[0]["labels"].dtype == np.int32
        and (raw[0]["labels"] == 259).all()
        and raw.classes == SEMANTICKITTI
    )
    assert (Dataset(tmp_path, remap="semantickitti19", fields=("labels",))[0]["labels"] == 5).all()


def test_points_out_of_range_go_into_no_grid_and_stay_among_the_points(tmp_path):
    ranges = {"min_range_m": 2.5, "max_range_m": 9.0}
    for name, metadata in (("A", None), ("B", ranges)):
        write_drive(
            tmp_path / name / "cartesian", range(3), spec=SMALL, metadata=metadata, points=2000
        )
    every, ranged = (
        Dataset(tmp_path, [n], history=2, fields=("density", "points"))[2] for n in "AB"
    )
    np.testing.assert_array_equal(every["points"], ranged["points"])
    assert 0 < ranged["density"].sum() < every["density"].sum()
    distance = np.linalg.norm(ranged["points"].astype(np.float64), axis=1)
    kept = ranged["points"][(distance >= 2.5) & (distance <= 9)]
    inside = SMALL.flat_index(kept.astype(np.float64))
    assert ranged["density"][1].sum() == (inside >= 0).sum()


def test_right_handed_data_are_told_apart_never_mirrored_or_mixed(tmp_path):
    for name, metadata in (("A", None), ("B", {"frame": "kitti"})):
        write_drive(tmp_path / name / "cartesian", range(2), spec=SMALL, metadata=metadata)
    left, right = (Dataset(tmp_path, [name]) for name in "AB")
    assert (left.axes, right.axes) == ("left", "right")
    np.testing.assert_array_equal(left[0]["occupancy"], right[0]["occupancy"])
    with pytest.raises(
        FormatError, match=r"B/cartesian: expected the axes of .*A/cartesian \(left\), found right"
    ):
        Dataset(tmp_path)


def test_indices_count_from_either_end_and_end(world):
    dataset = Dataset(world)
    assert dataset[-1]["frame"] == dataset[12]["frame"] == dataset[np.int64(12)]["frame"] == 2
    for beyond in (13, -14):
        with pytest.raises(IndexError):
            dataset[beyond]
    assert sum(1 for _ in dataset) == 13


def test_a_transform_is_called_with_each_sample(world):
    dataset = Dataset(world, transform=lambda sample: sample | {"twice": sample["frame"] * 2})
    assert dataset[2]["twice"] == 4


def test_a_pickled_dataset_gives_the_same_samples_and_takes_no_scans_along(world):
    dataset = Dataset(world, history=4, fields=FIELDS)
    dataset[5]
    data = pickle.dumps(dataset)
    assert len(data) < 100_000
    copy = pickle.loads(data)
    for name, value in dataset[5].items():
        np.testing.assert_array_equal(copy[5][name], value)


def test_a_zip_is_read_in_place(world, tmp_path):
    with zipfile.ZipFile(tmp_path / "all.zip", "w", zipfile.ZIP_DEFLATED) as archive:
        for path in sorted(world.rglob("*")):
            archive.write(path, path.relative_to(world))
    plain, zipped = (
        Dataset(root, "train", history=3, fields=FIELDS) for root in (world, tmp_path / "all.zip")
    )
    for i in (7, 0, 3):
        for name, value in plain[i].items():
            np.testing.assert_array_equal(zipped[i][name], value)


@pytest.mark.parametrize(
    "ending, package", [("zarr", "zarr"), ("h5", "h5py"), ("parquet", "pyarrow")]
)
def test_a_packed_store_gives_the_samples_of_the_files(world, tmp_path, ending, package):
    pytest.importorskip(package)
    pack(world, tmp_path / f"packed.{ending}")
    plain, packed = (
        Dataset(root, history=3, fields=FIELDS) for root in (world, tmp_path / f"packed.{ending}")
    )
    assert len(plain) == len(packed)
    for i in (5, 0, 12, 7):
        for name, value in plain[i].items():
            np.testing.assert_array_equal(packed[i][name], value)


def test_threads_that_share_a_dataset_do_not_write_over_each_other(world, tmp_path):
    pytest.importorskip("zarr")
    pack(world, tmp_path / "packed.zarr")
    dataset = Dataset(tmp_path / "packed.zarr", history=3)
    alone = [dataset[i]["occupancy"] for i in range(len(dataset))]
    order = np.random.default_rng(0).integers(0, len(dataset), 200).tolist()
    with ThreadPoolExecutor(4) as pool:
        for i, sample in zip(order, pool.map(dataset.__getitem__, order), strict=True):
            np.testing.assert_array_equal(sample["occupancy"], alone[i])


def test_scans_read_in_order_are_read_once(world, monkeypatch):
    dataset = Dataset(world, ["Town01_Light"], history=4, fields=("occupancy", "points"))
    kind = type(dataset.sequences[0])
    read, original = [], kind.read_many
    monkeypatch.setattr(
        kind,
        "read_many",
        lambda self, field, frames: read.extend(frames) or original(self, field, frames),
    )
    for i in range(6):
        dataset[i]
    assert read == [0, 1, 2, 3, 4, 5]


def test_opening_a_set_of_24_sequences_stats_no_frame_and_takes_well_under_a_second(tmp_path):
    params = to_json(GridSpec.published().to_params())
    poses = layout.encode_poses(np.tile(np.eye(4), (60, 1, 1)))
    for town in range(24):
        folder = tmp_path / "Train" / f"Town{town:02d}" / "cartesian"
        for name, suffixes in (("velodyne", [".bin"]), ("evaluation", [".bin", ".label"])):
            (folder / name).mkdir(parents=True)
            for frame in range(60):
                for suffix in suffixes:
                    (folder / name / f"{frame:06d}{suffix}").touch()
        (folder / "evaluation" / "params.json").write_bytes(params)
        (folder / "poses.txt").write_bytes(poses)
    start = time.perf_counter()
    dataset = Dataset(tmp_path, history=5)
    assert len(dataset) == 24 * 60
    assert time.perf_counter() - start < 1.0


def test_constructing_prints_nothing_and_loads_neither_torch_nor_numba(world):
    code = f"import sys; from carlasc.dataset.samples import Dataset; Dataset({str(world)!r}, history=3); print(sorted(set(sys.modules) & {{'torch', 'numba'}}))"
    ran = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert (ran.stdout, ran.stderr) == ("[]\n", "")


@pytest.mark.parametrize(
    "arguments, message",
    [
        (
            {"split": "training"},
            "split: expected Train, Val, Test in any case, or one or more of Town01_Light, .*, "
            "found 'training'",
        ),
        (
            {"fields": ("occupancy", "label")},
            "fields: expected one of occupancy, .*, found 'label'",
        ),
        ({"fields": ()}, "fields: expected at least one"),
        ({"history": 0}, "history: expected a number of scans of 1 or more, found 0"),
        ({"history": 2.5}, "history: expected a whole number, found 2.5"),
        (
            {"coordinates": "polar"},
            "coordinates: expected one of cartesian, cylindrical, found 'polar'",
        ),
        ({"remap": "carlasc12"}, "remap: expected one of carlasc11.*found 'carlasc12'"),
        (
            {"remap": "carlasc12", "fields": ("points",)},
            "remap: expected one of carlasc11.*found 'carlasc12'",
        ),
        (
            {"remap": "semantickitti19"},
            "remap: expected a remap of .* class table carla, found semantickitti19, which maps "
            "semantickitti",
        ),
        ({"remap": {}}, "remap: expected ids"),
        ({"remap": [[1]]}, "remap: expected a name, a mapping or a table of ids"),
    ],
)
def test_a_senseless_argument_is_one_clear_line(world, arguments, message):
    with pytest.raises(ArgumentError, match=message) as raised:
        Dataset(world, **arguments)
    assert "\n" not in str(raised.value)


def expect(kind, message, *args, **arguments):
    with pytest.raises(kind, match=message) as raised:
        dataset = Dataset(*args, **arguments)
        dataset[len(dataset) - 1]
    assert "\n" not in str(raised.value)


def test_a_split_or_sequence_that_is_not_there_is_named_with_what_is(world):
    expect(MissingDataError, "expected the split test, found Train, Val", world, "test")
    expect(
        MissingDataError,
        "expected the sequence Town99, found Town01_Light, Town02",
        world,
        ["Town01_Light", "Town99"],
    )


def test_missing_or_short_or_broken_poses_are_named(tmp_path):
    folder = write_drive(tmp_path / "A" / "cartesian", range(4), spec=SMALL)
    lines = (folder / "poses.txt").read_text().splitlines()
    (folder / "poses.txt").write_text("\n".join(lines[:3]) + "\n")
    expect(FormatError, "poses.txt: expected a line for each of 4 frames", tmp_path, history=2)
    assert len(Dataset(tmp_path)) == 4  # one scan needs no pose
    (folder / "poses.txt").write_text(
        "\n".join([*lines[:2], " ".join(["nan"] * 12), lines[3]]) + "\n"
    )
    expect(
        FormatError,
        "poses.txt, line 3: expected a rigid transform, found .nan",
        tmp_path,
        history=2,
    )
    (folder / "poses.txt").write_text("\n".join([*lines[:3], " ".join(["0"] * 12)]) + "\n")
    expect(
        FormatError,
        "poses.txt, line 4: expected a rigid transform, found .0.0",
        tmp_path,
        history=2,
    )
    (folder / "poses.txt").unlink()
    expect(MissingDataError, "poses.txt: expected a file, found nothing", tmp_path, history=2)


def test_a_sequence_without_the_grid_is_named(tmp_path):
    write_drive(tmp_path / "Train" / "A" / "cartesian", range(2), spec=SMALL)
    write_drive(tmp_path / "Train" / "B" / "cartesian", range(2), grid_frames=[])
    expect(MissingDataError, "B/cartesian: expected the grid evaluation, found none", tmp_path)
    assert len(Dataset(tmp_path, ["A"])) == 2


def test_a_second_root_without_the_sequence_or_the_coordinates_is_named(tmp_path, world):
    write_drive(tmp_path / "Train" / "Town01_Light" / "cartesian", [], grid_frames=[1], spec=SMALL)
    message = (
        "expected cartesian grids of Train/Town02_Light, found the sequences Train/Town01_Light"
    )
    expect(MissingDataError, message, world, "train", grids_source=tmp_path)
    message = "expected cylindrical grids of Train/Town01_Light, found only cartesian"
    expect(
        MissingDataError,
        message,
        world,
        ["Town01_Light"],
        grids_source=tmp_path,
        coordinates="cylindrical",
    )


def test_an_empty_folder_and_a_level_too_low_are_told_what_to_give(tmp_path, world):
    expect(MissingDataError, "expected a data set, .*: give the folder that holds Train", tmp_path)
    low = world / "Train" / "Town01_Light" / "cartesian" / "velodyne"
    expect(
        MissingDataError,
        "expected a sequence or a folder above it, .*: give the folder above this one",
        low,
    )
    expect(MissingDataError, "expected a folder", tmp_path / "nowhere")


def test_a_level_too_high_is_understood(world):
    assert len(Dataset(world.parent / world.name / ".." / world.name)) == 13
    inside = FolderSource(world.parent)
    assert any(path.startswith(world.name) for path in inside.sequences())


def test_grids_of_different_geometry_are_not_mixed(tmp_path):
    write_drive(tmp_path / "A" / "cartesian", range(2), spec=SMALL)
    write_drive(tmp_path / "B" / "cartesian", range(2), spec=SMALL.with_size((8, 8, 8)))
    expect(FormatError, "B/cartesian: expected the grid geometry of .*A/cartesian", tmp_path)


def test_only_cylindrical_data_are_not_taken_for_cartesian(tmp_path):
    write_drive(tmp_path / "A" / "cylindrical", range(2), spec=SMALL_CYLINDRICAL)
    expect(
        MissingDataError,
        "expected cartesian data, found only cylindrical: give `coordinates='cylindrical'`",
        tmp_path,
    )


def test_damaged_files_are_named_when_they_are_read(tmp_path):
    folder = write_drive(tmp_path / "A" / "cartesian", range(2), spec=SMALL)
    (folder / "evaluation" / "000001.label").write_bytes(
        np.full(SMALL.size, 77, np.uint32).tobytes()
    )
    expect(
        FormatError, "evaluation/labels of frame 1: expected class ids of carla, found 77", tmp_path
    )
    expect(FormatError, r"expected class ids of carla, found 77", tmp_path, remap=None)
    (folder / "evaluation" / "000001.label").write_bytes(b"1234")
    expect(FormatError, "000001.label: expected 4096 bytes", tmp_path)
    (folder / "labels" / "000001.label").write_bytes(bytes(8))
    message = "frame 1: expected one value per point, found 300 points, 2 point_labels"
    expect(FormatError, message, tmp_path, fields=("points", "point_labels"))


def test_an_empty_scan_is_an_empty_grid(tmp_path):
    folder = write_drive(tmp_path / "A" / "cartesian", range(2), spec=SMALL)
    for name in ("velodyne/000001.bin", "labels/000001.label", "predictions/000001.bin"):
        (folder / name).write_bytes(b"")
    sample = Dataset(tmp_path, history=2, fields=FIELDS)[1]
    assert (
        sample["valid"].all() and sample["occupancy"][0].any() and not sample["occupancy"][1].any()
    )
    assert sample["points"].shape == sample["flow"].shape == (0, 3)
    assert sample["point_labels"].shape == sample["remission"].shape == (0,)


def test_open_source_objects_and_paths_give_the_same(world):
    assert repr(Dataset(carlasc.storage.open(world), "val")) == repr(Dataset(world, "val"))


def test_negative_indices_count_from_the_end_and_others_are_out_of_range(world):
    dataset = Dataset(world, "val", fields=("points",))
    assert [dataset[index]["frame"] for index in (-3, -1, 2)] == [0, 2, 2]
    for index in (-4, 3):
        with pytest.raises(
            IndexError, match=f"sample {index} is out of range: there are 3 samples"
        ):
            dataset[index]


def test_a_pickled_dataset_leaves_its_decoded_scans_behind(world):
    dataset = Dataset(world, "val", history=3)
    small = len(pickle.dumps(dataset))
    expected = dataset[2]["occupancy"]
    again = pickle.dumps(dataset)
    assert len(again) <= small + 1000
    np.testing.assert_array_equal(pickle.loads(again)[2]["occupancy"], expected)


def test_a_mirrored_pose_is_no_rigid_transform(tmp_path):
    folder = write_drive(tmp_path / "A" / "cartesian", range(3), spec=SMALL)
    poses = bend(3)
    poses[1, :, 1] *= -1
    (folder / "poses.txt").write_bytes(layout.encode_poses(poses))
    expect(FormatError, "poses.txt, line 2: expected a rigid transform", tmp_path, history=2)


@pytest.mark.parametrize("remap", [[0.5, 1.0], {0: -1}, [0, -2]])
def test_remaps_of_fractions_or_negative_ids_are_refused(world, remap):
    with pytest.raises(ArgumentError, match="remap: expected"):
        Dataset(world, remap=remap)
