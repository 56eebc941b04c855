"""The classes of torch: `isinstance`, `+`, splits and spawned workers, in either order of imports."""

import subprocess
import sys

import numpy as np
import pytest
from helpers.datasets.drives import write_drive
from helpers.errors import raises

from carlasc import Dataset, Flip, GridSpec, ShardSampler, collate, collate_sparse
from carlasc.errors import ArgumentError

pytest.importorskip("torch", reason="needs carlasc[torch]")

SMALL = GridSpec("cartesian", (8, 8, 4), (-8.0, -8.0, -2.0), (8.0, 8.0, 1.0))
SCRIPT = """
import pickle, sys
{first}
from carlasc import Dataset, ShardSampler
dataset = Dataset(sys.argv[1], history=2)
sampler = ShardSampler(dataset)
assert ("torch" in sys.modules) == bool({first!r})
import torch.utils.data as data
for one, kind in ((dataset, data.Dataset), (sampler, data.Sampler)):
    assert isinstance(one, kind) and isinstance(pickle.loads(pickle.dumps(one)), kind)
    assert issubclass(type(one), kind) and type(one).__module__.startswith("carlasc.dataset")
both = dataset + dataset
assert type(both) is data.ConcatDataset and len(both) == 2 * len(dataset)
parts = data.random_split(data.ConcatDataset([dataset, dataset[:2]]), [3, len(dataset) - 1])
loader = data.DataLoader(parts[1], 2)
assert sum(len(batch["frame"]) for batch in loader) == len(dataset) - 1
"""


@pytest.fixture(scope="module")
def drive(tmp_path_factory):
    root = tmp_path_factory.mktemp("drive")
    write_drive(root / "A" / "cartesian", range(6), spec=SMALL)
    return root


@pytest.mark.parametrize(
    "first", ["", pytest.param("import torch", marks=pytest.mark.slow)], ids=["carlasc", "torch"]
)
def test_data_sets_and_samplers_are_those_of_torch(drive, first):
    subprocess.run([sys.executable, "-c", SCRIPT.format(first=first), str(drive)], check=True)


def test_a_sampler_takes_its_rank_from_the_process_group(drive, monkeypatch):
    import torch

    dataset = Dataset(drive)
    assert (ShardSampler(dataset).num_replicas, ShardSampler(dataset).rank) == (1, 0)
    for name, value in {"is_initialized": True, "get_world_size": 3, "get_rank": 2}.items():
        monkeypatch.setattr(torch.distributed, name, lambda value=value: value)
    assert (ShardSampler(dataset).num_replicas, ShardSampler(dataset).rank) == (3, 2)
    assert ShardSampler(dataset, num_replicas=2, rank=1).rank == 1


def test_tensors_can_be_indexed_with_and_computed_with(drive):
    import torch
    from torch.utils.data import default_collate

    dataset = Dataset(drive, fields=("density", "labels"), remap=None)
    batch = default_collate([dataset[torch.tensor(1)], dataset[np.int64(2)]])
    assert batch["frame"].tolist() == [1, 2]
    assert (batch["density"] + 1).max() > 1 and batch["density"].sum() > 0


def test_classes_are_counted_per_sample(drive):
    dataset = Dataset(drive, fields=("occupancy", "labels", "known", "point_labels"), history=2)
    dataset.transform = Flip(seed=0)
    counts = dataset.class_counts()
    by_hand = [
        [(sample["labels"][sample["known"]] == k).sum() for k in range(11)]
        for sample in Dataset(drive, fields=("labels", "known"))
    ]
    assert counts.dtype == np.int64 and counts.tolist() == np.array(by_hand).tolist()
    points = dataset[:2].class_counts("point_labels")
    assert points.sum(axis=1).tolist() == [300, 300]
    with raises(ArgumentError, where="^field$", expected="labels", found="occupancy"):
        dataset.class_counts("occupancy")


@pytest.mark.parametrize("fields", [("occupancy",), ("visibility", "density")])
def test_sparse_batches_hold_what_dense_ones_do(drive, fields):
    import torch

    dataset = Dataset(drive, fields=(*fields, "labels", "points"), history=3)
    samples = [dataset[i] for i in (4, 0, 5)]
    batch, dense = collate_sparse(samples), collate(samples)
    indices, features = batch["indices"], batch["features"]
    assert (indices.dtype, features.dtype) == (torch.int32, torch.float32)
    assert batch.keys() == dense.keys() - set(fields) | {"indices", "features"}
    assert len(torch.unique(indices, dim=0)) == len(indices) and (features != 0).any(1).all()
    stacks = torch.cat([dense[name] for name in fields], dim=1).float()
    again = torch.zeros_like(stacks).movedim(1, -1)
    again[tuple(indices.long().T)] = features
    assert torch.equal(again.movedim(-1, 1), stacks)
    assert torch.equal(batch["labels"], dense["labels"])
    with raises(ArgumentError, where="^samples$"):
        collate_sparse([dataset[0] | dict.fromkeys(fields)][:0])


@pytest.mark.slow
@pytest.mark.needs("spconv")
def test_spconv_takes_sparse_batches(drive):
    import torch
    from spconv.pytorch import SparseConvTensor

    dataset = Dataset(drive, fields=("occupancy",), history=2)
    batch = collate_sparse([dataset[1], dataset[2]])
    tensor = SparseConvTensor(batch["features"], batch["indices"], list(SMALL.size), 2)
    stacks = torch.stack([torch.from_numpy(dataset[i]["occupancy"]) for i in (1, 2)]).float()
    assert torch.equal(tensor.dense(), stacks)
