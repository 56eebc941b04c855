import pickle

import numpy as np
import pytest
from helpers.datasets.drives import bend, random_points, write_drive
from hypothesis import given, settings
from hypothesis import strategies as st

from carlasc.core.grids import GridSpec
from carlasc.dataset import FIELDS, Dataset
from carlasc.dataset.stacking import stack_scans
from carlasc.dataset.transforms import Flip, flip
from carlasc.errors import ArgumentError

GRIDS = {
    "cartesian": GridSpec("cartesian", (15, 12, 4), (-9.0, -8.0, -2.0), (9.0, 8.0, 1.0)),
    "cylindrical": GridSpec("cylindrical", (8, 14, 4), (0.5, -np.pi, -2.0), (20.0, np.pi, 1.0)),
    "published cylindrical": GridSpec.published("cylindrical"),
}


def off_edges(points, spec, margin=1e-3):
    """Keep the points that lie clear of every cell edge: there half-open cells are mirrored to
    half-closed ones.
    """
    cells = (
        spec.to_axes(points[:, :3].astype(np.float64)) - np.array(spec.lower)
    ) / spec.voxel_size
    return points[(np.abs(cells - np.round(cells)) > margin).all(axis=1)]


def sample_of(points, spec):
    stacks = {
        what: stack_scans([points, points[::2]], bend(2), spec, what)
        for what in ("occupancy", "density")
    }
    return stacks | {"points": points[:, :3].copy(), "poses": bend(2), "sequence": "A", "frame": 0}


@pytest.mark.parametrize("grid", GRIDS)
@pytest.mark.parametrize("axis", ["x", "y"])
@given(seed=st.integers(0, 2**32 - 1))
@settings(max_examples=25, deadline=None)
def test_flipping_points_then_binning_is_binning_then_flipping(grid, axis, seed):
    spec = GRIDS[grid]
    points = off_edges(random_points(np.random.default_rng(seed), 400), spec)
    still = np.eye(4)[None]
    sample = {
        "density": stack_scans([points], still, spec, "density"),
        "points": points[:, :3].copy(),
    }
    flipped = flip(sample, axis, spec)
    np.testing.assert_array_equal(
        stack_scans([flipped["points"]], still, spec, "density"), flipped["density"]
    )
    assert flipped["density"].sum() == sample["density"].sum() > 0


@pytest.mark.parametrize("grid", GRIDS)
@pytest.mark.parametrize("axis", ["x", "y"])
def test_flipped_poses_still_bring_flipped_past_scans_into_the_current_frame(grid, axis):
    spec, rng = GRIDS[grid], np.random.default_rng(0)
    current_T_past = bend(4)[3]
    past = random_points(rng, 3000)
    moved = past[:, :3].astype(np.float64) @ current_T_past[:3, :3].T + current_T_past[:3, 3]
    cells = (spec.to_axes(moved) - np.array(spec.lower)) / spec.voxel_size
    past = past[(np.abs(cells - np.round(cells)) > 1e-3).all(axis=1)]
    sample = {
        "occupancy": stack_scans([past], current_T_past[None], spec),
        "poses": current_T_past[None],
    }
    sample = flip(sample | {"points": past[:, :3].copy()}, axis, spec)
    again = stack_scans([sample["points"]], sample["poses"], spec)
    np.testing.assert_array_equal(again, sample["occupancy"])


@pytest.mark.parametrize("grid", GRIDS)
def test_labels_known_and_counts_are_flipped_as_the_points_in_their_voxels(grid):
    spec = GRIDS[grid]
    centres = spec.from_axes(spec.centers().reshape(-1, 3)).astype(np.float32)
    labels = np.arange(spec.num_voxels).reshape(spec.size)
    for axis in ("x", "y"):
        sample = {
            "labels": labels,
            "counts": labels * 2.0,
            "known": labels % 3 == 0,
            "points": centres,
        }
        flipped = flip(sample, axis, spec)
        places = spec.flat_index(flipped["points"].astype(np.float64))
        np.testing.assert_array_equal(flipped["labels"].reshape(-1)[places], labels.reshape(-1))
        np.testing.assert_array_equal(flipped["counts"], flipped["labels"] * 2.0)
        np.testing.assert_array_equal(flipped["known"], flipped["labels"] % 3 == 0)


@pytest.mark.parametrize("coordinates", ["cartesian", "cylindrical"])
@pytest.mark.parametrize("axis", ["x", "y"])
def test_flipping_twice_gives_every_field_back(tmp_path, coordinates, axis):
    write_drive(tmp_path / "A" / coordinates, range(3), spec=GRIDS[coordinates])
    dataset = Dataset(tmp_path, history=3, coordinates=coordinates, fields=FIELDS)
    sample = dataset[2]
    once = flip(sample, axis, dataset.spec)
    twice = flip(once, axis, dataset.spec)
    column = "xy".index(axis)
    np.testing.assert_array_equal(once["flow"][:, column], -sample["flow"][:, column])
    for name, value in sample.items():
        np.testing.assert_array_equal(twice[name], value)
        assert type(once[name]) is type(value)
        if isinstance(value, np.ndarray):
            assert once[name].dtype == value.dtype and once[name].flags.c_contiguous
    for name in ("occupancy", "density", "labels", "counts", "points"):
        assert (once[name] != sample[name]).any()


def test_the_radius_is_never_flipped():
    spec = GRIDS["cylindrical"]
    rings = np.broadcast_to(np.arange(8)[:, None, None], spec.size)
    for axis in ("x", "y"):
        np.testing.assert_array_equal(flip({"labels": rings}, axis, spec)["labels"], rings)


@pytest.mark.parametrize(
    "spec, axis",
    [
        (GridSpec("cartesian", (4, 4, 4), (0.0, -8.0, -2.0), (16.0, 8.0, 1.0)), "x"),
        (GridSpec("cartesian", (4, 4, 4), (-8.0, -4.0, -2.0), (8.0, 8.0, 1.0)), "y"),
        (GridSpec("cylindrical", (4, 4, 4), (0.0, -1.0, -2.0), (16.0, 1.0, 1.0)), "x"),
        (GridSpec("cylindrical", (4, 5, 4), (0.0, -np.pi, -2.0), (16.0, np.pi, 1.0)), "x"),
        (GridSpec("cylindrical", (4, 4, 4), (0.0, 0.0, -2.0), (16.0, 2 * np.pi, 1.0)), "y"),
    ],
)
def test_a_grid_that_is_not_symmetric_is_refused(spec, axis):
    with pytest.raises(ArgumentError) as error:
        Flip(spec, [axis])
    assert error.value.where == f"flip of {axis}"
    assert error.value.expected.startswith("a ")
    with pytest.raises(ArgumentError) as error:
        flip({"labels": np.zeros(spec.size)}, axis, spec)
    assert error.value.where == f"flip of {axis}"
    assert error.value.expected.startswith("a ")


@pytest.mark.parametrize("arguments", [{"directions": "z"}, {"probability": 1.5}, {"seed": -1}])
def test_a_flip_with_a_wrong_argument_is_refused(arguments):
    with pytest.raises(ArgumentError) as error:
        Flip(GRIDS["cartesian"], **arguments)
    assert error.value.where == next(iter(arguments)) and error.value.expected


def how(transform, frame, sequence="A"):
    """Return which axes a transform flips for a frame."""
    sample = {"points": np.ones((1, 3), np.float32), "sequence": sequence, "frame": frame}
    return tuple(transform(sample)["points"][0, :2] < 0)


def test_a_seed_makes_flips_that_depend_on_seed_epoch_sequence_and_frame_alone():
    transform = Flip(None, seed=3)
    first = [how(transform, frame) for frame in range(200)]
    assert (
        first
        == [how(transform, frame) for frame in range(200)]
        == [how(Flip(None, seed=3), f) for f in range(200)]
    )
    assert first != [how(Flip(None, seed=4), frame) for frame in range(200)]
    assert first != [how(transform, frame, "B") for frame in range(200)]
    transform.set_epoch(1)
    assert first != [how(transform, frame) for frame in range(200)]
    transform.set_epoch(0)
    assert first == [how(transform, frame) for frame in range(200)]


def test_each_axis_has_its_own_fair_coin():
    flips = np.array([how(Flip(None, seed=0), frame) for frame in range(2000)])
    assert (np.abs(flips.mean(axis=0) - 0.5) < 0.05).all()
    assert abs(np.corrcoef(flips.T)[0, 1]) < 0.1


@pytest.mark.parametrize("probability, expected", [(0, (False, False)), (1, (True, False))])
def test_probability_and_axes_are_kept_to(probability, expected):
    assert {how(Flip(None, ["x"], probability=probability), frame) for frame in range(20)} == {
        expected
    }


def test_without_a_seed_the_same_sample_is_flipped_anew_each_time():
    assert len({how(Flip(None), 0) for _ in range(200)}) == 4


def test_a_flip_pickles_with_its_epoch():
    transform = Flip(GRIDS["cartesian"], seed=1)
    transform.set_epoch(5)
    copy = pickle.loads(pickle.dumps(transform))
    assert [how(copy, f) for f in range(50)] == [how(transform, f) for f in range(50)]


def test_the_input_is_left_as_it_is():
    spec = GRIDS["cartesian"]
    sample = sample_of(random_points(np.random.default_rng(0), 500), spec)
    before = pickle.dumps(sample)
    Flip(spec, probability=1)(sample)
    assert pickle.dumps(sample) == before
