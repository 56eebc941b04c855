"""Soft labels, and which voxels are known, from grids that say how certain each voxel is."""

import numpy as np
import pytest
from helpers.datasets.drives import write_drive

import carlasc
from carlasc import Dataset, GridSpec
from carlasc.core.grids import VoxelFlag
from carlasc.core.tables import CARLA, REMAPS
from carlasc.dataset import EVIDENCE_FIELDS
from carlasc.dataset.transforms import flip
from carlasc.errors import ArgumentError, FormatError, MissingDataError
from carlasc.storage import FolderSink, field_files, layout

SPEC = GridSpec("cartesian", (6, 4, 2), (-8.0, -8.0, -2.0), (8.0, 8.0, 1.0))
CLASSES = (1, 6, 7, 13, 20)  # 6 and 7, 13 and 20 are one class of the eleven


def write_evidence(folder, frames, seed=0):
    """Write what is known of each voxel: up to three classes, whose probabilities add up to at most
    1.
    """
    rng = np.random.default_rng(seed)
    writer = FolderSink(folder.parent).sequence(folder.name)
    for frame in frames:
        rows = []
        for voxel in range(SPEC.num_voxels):
            labels = np.sort(rng.choice(CLASSES, rng.integers(0, 4), replace=False))
            shares = rng.dirichlet(np.ones(4))[: len(labels)]
            rows += [
                (voxel, label, int(share * layout.CERTAIN))
                for label, share in zip(labels, shares, strict=True)
            ]
        writer.write("evaluation/occupied", frame, rng.random(SPEC.size).astype(np.float16))
        writer.write("evaluation/classes", frame, np.array(rows, field_files.VOTES_DTYPE))
        writer.write("evaluation/flags", frame, rng.integers(0, 16, SPEC.size).astype(np.uint8))
        writer.write("evaluation/views", frame, rng.integers(0, 500, SPEC.size).astype(np.uint16))
    return writer


@pytest.fixture(scope="module")
def world(tmp_path_factory):
    root = tmp_path_factory.mktemp("world")
    folder = write_drive(root / "Train/Town01_Light/cartesian", range(3), spec=SPEC)
    write_evidence(folder, range(3))
    write_drive(root / "Val/Town07_Light/cartesian", range(3), spec=SPEC)
    return root


def sequence_of(world):
    return carlasc.open(world).sequences()["Train/Town01_Light/cartesian"]


def plain(sequence, frame, known, remap, num_classes):
    """Return soft labels as their definition says, voxel by voxel."""
    posterior = np.zeros((num_classes, SPEC.num_voxels))
    p = sequence.read("evaluation/occupied", frame).reshape(-1).astype(np.float64)
    posterior[0] = 1 - p
    for voxel, label, votes in sequence.read("evaluation/classes", frame).tolist():
        posterior[remap[label], voxel] += p[voxel] * votes / 65535
    return (posterior * known.reshape(-1)).reshape(num_classes, *SPEC.size)


@pytest.mark.parametrize("remap", ["carlasc11", None, {label: label % 3 for label in CARLA.names}])
def test_soft_labels_are_those_of_the_definition_in_the_classes_of_the_samples(world, remap):
    dataset = Dataset(world, "train", fields=("posterior", "known"), remap=remap)
    mapping = {"carlasc11": REMAPS["carlasc11"].mapping, None: {i: i for i in CARLA.names}}.get(
        remap if remap is None or isinstance(remap, str) else "", remap
    )
    sample = dataset[1]
    wanted = plain(sequence_of(world), 1, sample["known"], mapping, max(dataset.classes.names) + 1)
    assert sample["posterior"].dtype == np.float32 and sample["posterior"].flags.c_contiguous
    np.testing.assert_allclose(sample["posterior"], wanted, atol=1e-6)
    assert (sample["posterior"].sum(axis=0) <= 1 + 1e-6).all()
    assert not sample["posterior"][:, ~sample["known"]].any() and not sample["known"].all()


def test_samples_say_which_cameras_see_each_voxel(tmp_path):
    folder = write_drive(tmp_path / "A/cartesian", range(2), spec=SPEC)
    with pytest.raises(MissingDataError, match=r"field evaluation/seen.*keep_seen=True"):
        Dataset(tmp_path, fields=("camera_visible",))
    writer, bits = (
        FolderSink(folder.parent).sequence("cartesian"),
        np.arange(SPEC.num_voxels).reshape(SPEC.size),
    )
    writer.write("evaluation/seen", 1, bits.astype(np.uint8))
    dataset = Dataset(tmp_path, fields=("labels", "camera_visible"))
    (sample,) = dataset
    assert sample["frame"] == 1 and sample["camera_visible"].dtype == np.uint8
    assert np.array_equal(sample["camera_visible"], bits)
    assert np.array_equal(flip(sample, "x", SPEC)["camera_visible"], bits[::-1])


def test_certain_voxels_have_soft_labels_that_are_exactly_their_labels(tmp_path):
    folder = write_drive(tmp_path / "A/cartesian", [0], spec=SPEC)
    writer = FolderSink(folder.parent).sequence("cartesian")
    labels = FolderSink(folder.parent).sequence("cartesian").read("evaluation/labels", 0)
    voxel = np.flatnonzero(labels)
    classes = np.zeros(len(voxel), field_files.VOTES_DTYPE)
    classes["voxel"], classes["label"], classes["votes"] = voxel, labels[voxel], layout.CERTAIN
    writer.write("evaluation/occupied", 0, (labels > 0).astype(np.float16).reshape(SPEC.size))
    writer.write("evaluation/classes", 0, classes)
    sample = Dataset(tmp_path, fields=("posterior", "labels", "known"), remap=None)[0]
    wanted = (np.arange(23)[:, None, None, None] == sample["labels"]) & sample["known"]
    np.testing.assert_array_equal(sample["posterior"], wanted.astype(np.float32))


def test_a_grid_in_which_nothing_is_occupied_is_free(tmp_path):
    folder = write_drive(tmp_path / "A/cartesian", [0], spec=SPEC)
    writer = FolderSink(folder.parent).sequence("cartesian")
    writer.write("evaluation/occupied", 0, np.zeros(SPEC.size))
    writer.write("evaluation/classes", 0, np.zeros(0, field_files.VOTES_DTYPE))
    sample = Dataset(tmp_path, fields=("posterior", "known"))[0]
    np.testing.assert_array_equal(sample["posterior"][0], sample["known"])
    assert not sample["posterior"][1:].any()


def test_the_other_fields_are_those_of_the_files(world):
    sample = Dataset(world, "train", fields=EVIDENCE_FIELDS, history=2)[2]
    found = {
        name: (array.dtype.name, array.shape)
        for name, array in sample.items()
        if name in EVIDENCE_FIELDS
    }
    assert found == {
        "posterior": ("float32", (11, *SPEC.size)),
        "occupied": ("float32", SPEC.size),
        "flags": ("uint8", SPEC.size),
        "views": ("int32", SPEC.size),
    }
    for name in ("occupied", "flags", "views"):
        np.testing.assert_array_equal(
            sample[name], sequence_of(world).read(f"evaluation/{name}", 2)
        )
        assert sample[name].flags.writeable


@pytest.mark.parametrize("min_confidence", [0.0, 0.8])
@pytest.mark.parametrize("inferred", [True, False])
def test_inferred_and_doubtful_voxels_can_be_left_out_of_what_is_known(
    world, inferred, min_confidence
):
    fields = ("known", "posterior", "counts", "labels")
    whole = Dataset(world, "train", fields=fields)[0]
    sample = Dataset(
        world, "train", fields=fields, inferred=inferred, min_confidence=min_confidence
    )[0]
    sequence = sequence_of(world)
    p, flags = sequence.read("evaluation/occupied", 0), sequence.read("evaluation/flags", 0)
    known = whole["counts"] > 0
    known &= inferred | (flags & VoxelFlag.INFERRED == 0)
    known &= np.maximum(p, 1 - p) >= min_confidence
    np.testing.assert_array_equal(sample["known"], known)
    np.testing.assert_array_equal(sample["posterior"], whole["posterior"] * known)
    for name in ("counts", "labels"):
        np.testing.assert_array_equal(sample[name], whole[name])
    assert (known.sum() < whole["known"].sum()) == (not inferred or min_confidence > 0)


@pytest.mark.parametrize("direction", ["x", "y"])
def test_flips_turn_every_field_as_they_turn_labels(world, direction):
    sample = Dataset(world, "train", fields=("labels", *EVIDENCE_FIELDS), remap=None)[0]
    flipped = flip(sample, direction, SPEC)
    axis = "xy".index(direction)
    for name in EVIDENCE_FIELDS:
        np.testing.assert_array_equal(
            flipped[name], np.flip(sample[name], axis + (name == "posterior"))
        )
        assert (flipped[name] != sample[name]).any() and flipped[name].flags.c_contiguous
    np.testing.assert_array_equal(flipped["labels"], np.flip(sample["labels"], axis))


@pytest.mark.parametrize("ending", ["zarr", "h5", "parquet"])
def test_packed_stores_give_the_same_samples(world, tmp_path, ending):
    pytest.importorskip({"zarr": "zarr", "h5": "h5py", "parquet": "pyarrow"}[ending])
    carlasc.pack(world, tmp_path / f"packed.{ending}")
    fields = (*EVIDENCE_FIELDS, "known")
    wanted, found = (
        Dataset(root, "train", fields=fields)[1] for root in (world, tmp_path / f"packed.{ending}")
    )
    for name in fields:
        np.testing.assert_array_equal(found[name], wanted[name])
        assert found[name].dtype == wanted[name].dtype


@pytest.mark.parametrize(
    "arguments",
    [
        *({"fields": [name]} for name in EVIDENCE_FIELDS),
        {"inferred": False},
        {"min_confidence": 0.9},
    ],
)
def test_a_grid_that_does_not_say_how_certain_it_is_is_named_with_what_to_do(world, arguments):
    with pytest.raises(MissingDataError) as error:
        Dataset(world, "val", **arguments)
    assert str(error.value).startswith(
        f"{world / 'Val/Town07_Light/cartesian'}: expected the field evaluation/"
    )
    assert "regrid with `voting=Voting(keep_evidence=True)`" in str(error.value)


def test_options_that_nothing_depends_on_ask_for_nothing(world):
    assert len(Dataset(world, "val", fields=("labels",), inferred=False, min_confidence=0.9)) == 3


@pytest.mark.parametrize(
    "row, message", [((48, 7, 1), "voxels 0 to 47, found 48"), ((-1, 7, 1), "found -1")]
)
def test_voxels_outside_of_the_grid_are_named(tmp_path, row, message):
    folder = write_drive(tmp_path / "A/cartesian", [0], spec=SPEC)
    writer = write_evidence(folder, [0])
    writer.write("evaluation/classes", 0, np.array([(0, 7, 1), row], field_files.VOTES_DTYPE))
    with pytest.raises(FormatError, match=f"evaluation/classes of frame 0: expected.*{message}"):
        Dataset(tmp_path, fields=("posterior",))[0]


def test_class_ids_without_a_target_are_named(tmp_path):
    folder = write_drive(tmp_path / "A/cartesian", [0], spec=SPEC)
    writer = write_evidence(folder, [0])
    writer.write("evaluation/classes", 0, np.array([(0, 200, 1)], field_files.VOTES_DTYPE))
    with pytest.raises(
        FormatError, match="evaluation/classes of frame 0: expected class ids of carla, found 200"
    ):
        Dataset(tmp_path, fields=("posterior",))[0]


def test_a_remap_of_other_classes_is_refused_for_soft_labels_too(world):
    with pytest.raises(ArgumentError, match="remap: expected a remap of .*class table carla"):
        Dataset(world, "train", fields=("posterior",), remap="semantickitti19")


@pytest.mark.parametrize("min_confidence", [-0.1, 1.0, float("nan")])
def test_a_confidence_is_a_probability_below_1(world, min_confidence):
    with pytest.raises(
        ArgumentError, match="min_confidence: expected a probability from 0 to below 1"
    ):
        Dataset(world, min_confidence=min_confidence)
