"""Datasets in torch's DataLoader: worker processes, shuffling, several ranks, determinism, batches."""

import pickle

import numpy as np
import pytest
from helpers.datasets.drives import write_drive

from carlasc.core.grids import GridSpec
from carlasc.dataset import FIELDS, Augment, Dataset, Flip, collate

pytest.importorskip("torch", reason="needs carlasc[torch]")

import torch
from torch.utils.data import DataLoader, DistributedSampler

pytestmark = pytest.mark.posix("fork")

RAGGED = ("points", "point_labels", "flow", "remission")

SPEC = GridSpec("cartesian", (16, 16, 4), (-8.0, -8.0, -2.0), (8.0, 8.0, 1.0))
DENSE = tuple(field for field in FIELDS if field not in RAGGED)


@pytest.fixture(scope="module")
def world(tmp_path_factory):
    root = tmp_path_factory.mktemp("workers")
    for seed, name in enumerate(("Town01_Light", "Town02_Light")):
        write_drive(root / "Train" / name / "cartesian", range(9), spec=SPEC, seed=seed)
    return root


def loader(dataset, workers=2, **arguments):
    method = {"multiprocessing_context": arguments.pop("method", "fork")} if workers else {}
    return DataLoader(dataset, batch_size=4, num_workers=workers, **method, **arguments)


def same(batches, others):
    assert len(batches) == len(others)
    for batch, other in zip(batches, others, strict=True):
        assert batch.keys() == other.keys()
        for name, value in batch.items():
            if isinstance(value, torch.Tensor):
                assert value.dtype == other[name].dtype and torch.equal(value, other[name])
            else:
                assert all(np.array_equal(a, b) for a, b in zip(value, other[name], strict=True))


def test_default_collate_takes_every_dense_field_as_it_is(world):
    dataset = Dataset(world, history=3, fields=DENSE)
    batch = next(iter(loader(dataset, workers=0)))
    assert {
        name: value.dtype for name, value in batch.items() if isinstance(value, torch.Tensor)
    } == {
        "occupancy": torch.uint8,
        "density": torch.int32,
        "visibility": torch.uint8,
        "labels": torch.uint8,
        "known": torch.bool,
        "counts": torch.float32,
        "poses": torch.float64,
        "valid": torch.bool,
        "frame": torch.int64,
    }
    assert batch["occupancy"].shape == (4, 3, 16, 16, 4)
    assert batch["sequence"] == ["Town01_Light"] * 4 and batch["frame"].tolist() == [0, 1, 2, 3]
    for i in range(4):
        for name in ("occupancy", "density", "labels", "known", "counts", "poses", "valid"):
            np.testing.assert_array_equal(batch[name][i].numpy(), dataset[i][name])


def test_collate_keeps_ragged_fields_as_lists(tmp_path):
    for seed, name in enumerate(("A", "B")):
        write_drive(tmp_path / name / "cartesian", [0], spec=SPEC, points=200 + 50 * seed)
    dataset = Dataset(tmp_path, fields=("points", "labels", "point_labels", "flow", "remission"))
    (batch,) = loader(dataset, workers=0, collate_fn=collate)
    assert list(batch) == [
        "points",
        "labels",
        "point_labels",
        "flow",
        "remission",
        "valid",
        "sequence",
        "frame",
    ]
    assert [tuple(points.shape) for points in batch["points"]] == [(200, 3), (250, 3)]
    assert batch["labels"].shape == (2, *SPEC.size)
    for name in RAGGED:
        for i in range(2):
            np.testing.assert_array_equal(batch[name][i].numpy(), dataset[i][name])


def test_workers_give_what_one_process_gives(world):
    dataset = Dataset(world, history=3, fields=FIELDS)
    alone = list(loader(dataset, 0, collate_fn=collate))  # the workers inherit its decoded scans
    same(list(loader(dataset, 2, collate_fn=collate)), alone)


def test_shuffled_epochs_of_persistent_workers_give_every_sample_once(world):
    dataset = Dataset(world, history=2)
    batches = loader(
        dataset,
        2,
        shuffle=True,
        persistent_workers=True,
        generator=torch.Generator().manual_seed(0),
    )
    orders = []
    for _ in range(3):
        seen = [
            (s, f)
            for batch in batches
            for s, f in zip(batch["sequence"], batch["frame"].tolist(), strict=True)
        ]
        orders.append(seen)
        assert sorted(seen) == sorted(
            (s, f) for s in ("Town01_Light", "Town02_Light") for f in range(9)
        )
    assert orders[0] != orders[1] != orders[2]


def test_distributed_ranks_share_the_samples(world):
    dataset = Dataset(world)
    seen = []
    for rank in range(2):
        sampler = DistributedSampler(dataset, num_replicas=2, rank=rank, seed=1)
        sampler.set_epoch(2)
        for batch in loader(dataset, 0, sampler=sampler):
            seen += zip(batch["sequence"], batch["frame"].tolist(), strict=True)
    assert len(seen) == len(set(seen)) == len(dataset)


@pytest.mark.parametrize("method", ["fork", pytest.param("spawn", marks=pytest.mark.slow)])
def test_seeded_flips_are_those_of_one_process_and_follow_the_epoch_into_persistent_workers(
    world, method
):
    dataset = Dataset(world, history=2, fields=(*DENSE, "points", "flow"))
    dataset.transform = transform = Flip(dataset.spec, seed=5)
    alone = loader(dataset, 0, collate_fn=collate)
    persistent = loader(dataset, 2, method=method, persistent_workers=True, collate_fn=collate)
    epochs = []
    for epoch in range(3):
        transform.set_epoch(epoch)
        expected = list(alone)
        same(list(persistent), expected)
        epochs.append(torch.cat([batch["occupancy"] for batch in expected]))
    assert not torch.equal(epochs[0], epochs[1]) and not torch.equal(epochs[1], epochs[2])


def test_flips_do_not_depend_on_how_many_workers_there_are_or_on_the_order(world):
    dataset = Dataset(world, transform=None)
    dataset.transform = Flip(dataset.spec, seed=5)

    def by_frame(batches):
        return {
            (s, f): grid.numpy()
            for batch in batches
            for s, f, grid in zip(
                batch["sequence"], batch["frame"].tolist(), batch["occupancy"], strict=True
            )
        }

    plain = by_frame(loader(dataset, 0))
    shuffled = by_frame(loader(dataset, 1, shuffle=True))
    assert plain.keys() == shuffled.keys()
    for key, grid in plain.items():
        np.testing.assert_array_equal(grid, shuffled[key])


def test_what_is_sent_to_workers_does_not_grow_with_the_frames(tmp_path):
    sizes = []
    for frames in (5, 40):
        write_drive(tmp_path / str(frames) / "cartesian", range(frames), spec=SPEC)
        dataset = Dataset(tmp_path / str(frames), history=3, fields=DENSE)
        dataset[frames - 1]
        sizes.append(len(pickle.dumps(dataset)))
    assert sizes[1] < sizes[0] + 50


def test_a_pickled_dataset_has_the_same_samples_where_frames_are_missing(tmp_path):
    write_drive(tmp_path / "cartesian", (0, 1, 2, 5, 6, 9), spec=SPEC)
    dataset = Dataset(tmp_path, history=3, fields=DENSE)
    other = pickle.loads(pickle.dumps(dataset))
    for sample, again in zip(dataset, other, strict=True):
        assert all(np.array_equal(sample[name], again[name]) for name in sample)


def test_seeded_augmentations_are_equal_for_every_number_of_workers(world):
    dataset = Dataset(world, history=3, fields=(*DENSE, *RAGGED))
    dataset.transform = Augment(
        directions="xy", rotate_rad=1, scale=0.1, translate_m=1, drop=0.5, seed=7
    )
    alone = list(loader(dataset, 0, collate_fn=collate))
    for workers in (2, 4):
        same(list(loader(dataset, workers, collate_fn=collate)), alone)


def test_without_a_seed_the_seed_of_torch_decides_in_workers(world):
    dataset = Dataset(world, fields=("points",), transform=Augment(rotate_rad=1))
    epochs = []
    for seed in (0, 0, 1):
        torch.manual_seed(seed)
        epochs.append(list(loader(dataset, 2, collate_fn=collate)))
    same(epochs[0], epochs[1])
    assert not torch.equal(epochs[0][0]["points"][0], epochs[2][0]["points"][0])
