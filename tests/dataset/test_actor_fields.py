"""Instances and velocities of voxels in samples: their shapes, flips, cylindrical grids, and files
that do not fit.
"""

import numpy as np
import pytest
from typer.testing import CliRunner

from carlasc import Dataset, Flip, GridSpec
from carlasc.cli import app
from carlasc.dataset import ACTOR_FIELDS
from carlasc.dataset.transforms import flip
from carlasc.errors import FormatError, MissingDataError
from carlasc.inspection import info, stats, validate
from carlasc.storage import FolderSink, field_files
from carlasc.testing.data import params

SIZE = (4, 6, 2)
ACTORS = ("instance", "velocity")


def write(root, coordinates="cartesian", parts=ACTORS, **changes):
    """Write a frame whose voxels 3, 10 and 40 belong to an actor; 10 and 40 move."""
    writer = FolderSink(root).sequence(f"Train/Town01_Light/{coordinates}")
    writer.write_document("evaluation/params.json", params(SIZE, coordinates))
    instance, velocity = np.zeros(48, np.uint32), np.zeros(2, field_files.VELOCITY_DTYPE)
    instance[[3, 10, 40]] = 70_000
    velocity["voxel"], velocity["velocity"] = [10, 40], [(1, 2, 0.5), (3, 4, 0)]
    arrays = {"instance": instance.reshape(SIZE), "velocity": velocity} | changes
    writer.write("points", 0, np.zeros((1, 4), np.float32))
    writer.write(
        "evaluation/labels", 0, np.where(instance > 0, 10, 7).astype(np.uint8).reshape(SIZE)
    )
    writer.write("evaluation/counts", 0, np.ones(SIZE, np.float32))
    for part in parts:
        writer.write(f"evaluation/{part}", 0, arrays[part])
    return root


def sample_of(root, coordinates="cartesian"):
    dataset = Dataset(
        root, "train", fields=("labels", *ACTOR_FIELDS), coordinates=coordinates, remap=None
    )
    return dataset, dataset[0]


@pytest.mark.parametrize("coordinates", ["cartesian", "cylindrical"])
def test_samples_have_numbers_and_dense_velocities(tmp_path, coordinates):
    _, sample = sample_of(write(tmp_path, coordinates), coordinates)
    assert sample["instances"].dtype == np.int64 and sample["instances"].shape == SIZE
    assert (
        np.flatnonzero(sample["instances"]).tolist() == [3, 10, 40]
        and sample["instances"].max() == 70_000
    )
    flow = sample["voxel_flow"]
    assert flow.dtype == np.float32 and flow.shape == (*SIZE, 3)
    assert np.flatnonzero(flow.any(axis=-1)).tolist() == [10, 40]
    assert flow.reshape(-1, 3)[[10, 40]].tolist() == [[1, 2, 0.5], [3, 4, 0]]


@pytest.mark.parametrize("direction", ["x", "y"])
def test_a_flip_of_a_cartesian_grid_mirrors_places_and_velocities(tmp_path, direction):
    dataset, sample = sample_of(write(tmp_path))
    axis = "xy".index(direction)
    turned = flip(sample, direction, dataset.spec)
    sign = np.where(np.arange(3) == axis, -1, 1)
    assert np.array_equal(turned["instances"], np.flip(sample["instances"], axis))
    assert np.array_equal(turned["voxel_flow"], np.flip(sample["voxel_flow"], axis) * sign)
    # the input is not changed
    assert sample["voxel_flow"].reshape(-1, 3)[10].tolist() == [
        1,
        2,
        0.5,
    ]
    again = flip(turned, direction, dataset.spec)
    assert np.array_equal(again["voxel_flow"], sample["voxel_flow"])


@pytest.mark.parametrize("direction", ["x", "y"])
def test_a_flip_of_a_cylindrical_grid_moves_each_voxel_to_its_mirror_image(direction):
    spec = GridSpec.published("cylindrical").with_size((4, 8, 2))
    rng = np.random.default_rng(0)
    flow = rng.normal(size=(*spec.size, 3)).astype(np.float32)
    numbers = np.arange(spec.num_voxels).reshape(spec.size)
    turned = flip({"instances": numbers, "voxel_flow": flow}, direction, spec)
    axis = "xy".index(direction)
    places = spec.from_axes(spec.centers()).reshape(-1, 3)
    mirrored = places.copy()
    mirrored[:, axis] *= -1
    to = spec.flat_index(mirrored)
    sign = np.where(np.arange(3) == axis, -1, 1)
    assert np.array_equal(turned["instances"].reshape(-1)[to], numbers.reshape(-1))
    assert np.allclose(turned["voxel_flow"].reshape(-1, 3)[to], flow.reshape(-1, 3) * sign)
    assert Flip(spec, probability=1, seed=0) is not None


def test_grids_without_actors_say_how_to_make_them(tmp_path):
    write(tmp_path, parts=())
    with pytest.raises(MissingDataError, match=r"keep_actors=True"):
        sample_of(tmp_path)


def velocities(voxels, value=1.0):
    table = np.zeros(len(voxels), field_files.VELOCITY_DTYPE)
    table["voxel"], table["velocity"] = voxels, value
    return table


@pytest.mark.parametrize(
    ("table", "message"),
    [
        (velocities([3, 48]), "voxels 0 to 47, found 48"),
        (velocities([-1, 3]), "voxels 0 to 47, found -1"),
        (velocities([3], np.inf), "finite velocities"),
    ],
)
def test_velocities_that_do_not_fit_are_named_by_samples_and_by_validate(tmp_path, table, message):
    write(tmp_path, velocity=table)
    with pytest.raises(FormatError, match=f"evaluation/velocity of frame 0: expected .*{message}"):
        sample_of(tmp_path)
    (finding,) = [f for f in validate(tmp_path).findings if f.check == "velocity"]
    assert finding.severity == "error" and "--keep-actors" in finding.advice


def test_validate_names_repeated_voxels_actors_in_free_voxels_and_grids_of_another_size(tmp_path):
    assert not [f for f in validate(write(tmp_path / "good")).findings if f.check in ACTORS]
    write(tmp_path / "twice", velocity=velocities([3, 3]))
    assert [f.check for f in validate(tmp_path / "twice").findings if f.check in ACTORS] == [
        "velocity"
    ]
    root = write(tmp_path / "free")
    (sequence,) = root.rglob("cartesian")
    FolderSink(root).sequence("Train/Town01_Light/cartesian").write(
        "evaluation/labels", 0, np.zeros(SIZE, np.uint8)
    )
    (finding,) = [f for f in validate(root).findings if f.check in ACTORS]
    assert finding.check == "instance" and "3 others" in finding.found
    file = sequence / "evaluation/000000.instance"
    file.write_bytes(file.read_bytes()[:-4])
    found = [f for f in validate(root).findings if f.check == "file-size"]
    assert len(found) == 1 and "192 bytes (4 x 6 x 2 uint32)" in found[0].expected
    with pytest.raises(FormatError, match="000000.instance"):
        sample_of(root)


def test_stats_count_the_voxels_of_actors(tmp_path):
    found = stats(write(tmp_path)).total
    assert (found.actor_voxels, found.moving_voxels) == (3, 2)
    assert stats(tmp_path).to_dict()["total"]["moving_voxels"] == 2
    result = CliRunner().invoke(app, ["stats", str(tmp_path)])
    assert "3 voxels belong to actors, 2 of them move" in result.output


def test_info_lists_both_fields(tmp_path):
    (sequence,) = info(write(tmp_path)).sequences
    assert {"instance", "velocity"} <= set(sequence.grids[0].parts)
