"""The order of ShardSampler: every sample once, the same for any number of processes, continued
anywhere, few shards at a time.
"""

from __future__ import annotations

import pickle
from types import SimpleNamespace

import numpy as np
import pytest
from helpers.datasets.drives import write_drive
from helpers.errors import raises
from hypothesis import given, settings
from hypothesis import strategies as st

from carlasc.core.grids import GridSpec
from carlasc.dataset import Dataset, ShardSampler
from carlasc.errors import ArgumentError

SPEC = GridSpec("cartesian", (8, 8, 2), (-8.0, -8.0, -2.0), (8.0, 8.0, 1.0))


class Numbers(Dataset):
    """Stands in for a Dataset of sequences with these frames: only the numbers matter here."""

    frames, is_cached = (), False

    def __init__(self, frames, sequences, history):
        self.frames, self.sequences, self.history = frames, sequences, history

    def __repr__(self):
        return f"sequences_of{self.frames}"


def sequences_of(*frames, history=1):
    named = tuple(SimpleNamespace(name=f"Town{k}") for k in range(len(frames)))
    arrays = tuple(np.array(sorted(numbers), np.int64) for numbers in frames)
    return Numbers(arrays, named, history)


data = st.lists(st.sets(st.integers(0, 150), min_size=1, max_size=60), min_size=1, max_size=4).map(
    lambda frames: sequences_of(*frames)
)
shapes = st.fixed_dictionaries(
    {"shard": st.integers(1, 40), "window": st.integers(1, 6), "seed": st.integers(0, 9)}
)


def samples_in(dataset):
    return sum(map(len, dataset.frames))


def steps(dataset, world, batch, shape, state=None):
    """Return the set of samples of each step, over all processes; their batches come from loaders
    of `batch // world` samples.
    """
    drawn = []
    for rank in range(world):
        sampler = ShardSampler(dataset, rank=rank, num_replicas=world, **shape)
        if state:
            sampler.load_state_dict(state)
        indices = list(sampler)
        size = batch // world
        drawn.append([indices[k : k + size] for k in range(0, len(indices), size)])
    assert len({len(batches) for batches in drawn}) == 1, (
        "a process would wait for the others forever"
    )
    return [
        sorted(index for batches in step for index in batches) for step in zip(*drawn, strict=True)
    ]


@given(data, shapes, st.integers(0, 3))
def test_an_epoch_gives_every_sample_exactly_once(dataset, shape, epoch):
    sampler = ShardSampler(dataset, **shape)
    sampler.set_epoch(epoch)
    indices = list(sampler)
    assert sorted(indices) == list(range(samples_in(dataset))) and len(indices) == len(sampler)
    assert indices == list(sampler) == sampler.order(epoch).tolist()


@given(data, shapes, st.sampled_from([4, 8, 12]))
def test_each_step_has_the_same_samples_for_one_two_and_four_processes(dataset, shape, batch):
    alone = steps(dataset, 1, batch, shape)
    for world in (2, 4):
        shared = steps(dataset, world, batch, shape)
        assert len(shared) == len(alone)
        assert shared[:-1] == alone[:-1]
        # up to world - 1 samples are given twice, to make the steps equal
        assert set(shared[-1]) >= set(alone[-1])
        assert sum(map(len, shared)) - sum(map(len, alone)) == -samples_in(dataset) % world


@given(
    data,
    shapes,
    st.integers(0, 2),
    st.floats(0, 1),
    st.sampled_from([1, 2, 4]),
    st.sampled_from([1, 2, 4]),
)
def test_it_goes_on_at_any_position_with_any_other_number_of_processes(
    dataset, shape, epoch, part, before, after
):
    count = samples_in(dataset)
    first = ShardSampler(dataset, rank=before - 1, num_replicas=before, **shape)
    first.set_epoch(epoch)
    taken = iter(first)
    for _ in range(int(part * len(first))):
        next(taken)
    state = first.state_dict()
    position = min(int(part * len(first)) * before, count)
    assert state["position"] == position
    left = [index for step in steps(dataset, after, after, shape, state) for index in step]
    expected = sorted(first.order(epoch)[position:].tolist())
    assert sorted(set(left)) == expected and len(left) - len(expected) == -len(expected) % after


@given(data, shapes)
def test_frames_of_few_shards_are_mixed_at_any_time(dataset, shape):
    sampler = ShardSampler(dataset, **shape)
    # the shard of each sample, found in another way
    names = np.concatenate(
        [frames // shape["shard"] + 1000 * k for k, frames in enumerate(dataset.frames)]
    )
    order = names[sampler.order(0)]
    first = {shard: place for place, shard in reversed(list(enumerate(order.tolist())))}
    last = {shard: place for place, shard in enumerate(order.tolist())}
    in_use = np.zeros(len(order), int)
    for shard, place in first.items():
        in_use[place : last[shard] + 1] += 1
    assert in_use.max() <= shape["window"]


def test_a_window_of_one_shard_reads_shard_after_shard_and_a_wide_one_mixes_them():
    dataset = sequences_of(range(640))
    narrow = ShardSampler(dataset, shard=16, window=1).order(0) // 16
    assert (np.diff(narrow) != 0).sum() == 39 and not np.array_equal(narrow, np.sort(narrow))
    wide = ShardSampler(dataset, shard=16, window=10).order(0)
    assert len(np.unique(wide[320:336] // 16)) > 5
    assert abs(np.corrcoef(np.arange(640), wide)[0, 1]) < 0.3


def test_epochs_and_seeds_differ_and_repeat():
    dataset = sequences_of(range(100), range(50))
    orders = {
        (seed, epoch): tuple(ShardSampler(dataset, seed=seed).order(epoch))
        for seed in range(2)
        for epoch in range(2)
    }
    assert len(set(orders.values())) == 4
    assert orders[1, 1] == tuple(ShardSampler(dataset, seed=1).order(1))


def test_the_order_is_that_of_earlier_versions():
    """A run that is continued after an upgrade must not see a sample twice."""
    order = ShardSampler(sequences_of(range(12), range(5)), seed=3, shard=4, window=2).order(1)
    assert order.tolist() == [1, 9, 2, 3, 10, 0, 11, 6, 7, 8, 5, 4, 14, 13, 15, 12, 16]


def test_shards_are_longer_where_samples_have_histories():
    assert ShardSampler(sequences_of(range(9))).shard == 16
    assert ShardSampler(sequences_of(range(9), history=5)).shard == 64
    assert ShardSampler(sequences_of(range(9), history=16)).shard == 64
    assert ShardSampler(sequences_of(range(9), history=18)).shard == 128


def test_a_state_says_what_was_trained_on_although_a_loader_drew_more():
    sampler = ShardSampler(sequences_of(range(100)))
    drawing = iter(sampler)
    for _ in range(30):
        next(drawing)
    assert sampler.state_dict()["position"] == 30
    state = sampler.state_dict(trained=12)
    other = ShardSampler(sequences_of(range(100)), seed=9)
    other.load_state_dict(state)
    rest = list(other)
    assert rest == sampler.order(0).tolist()[12:]
    assert list(other) == sampler.order(0).tolist(), "the iteration after it is a whole epoch"
    other.load_state_dict(state)
    drawing = iter(other)
    next(drawing)
    assert other.state_dict(trained=5)["position"] == 17, "it counts from where the iteration began"


def test_set_epoch_keeps_the_position_of_its_own_epoch_only():
    sampler = ShardSampler(sequences_of(range(40)))
    sampler.set_epoch(2)
    list(zip(range(10), sampler, strict=False))
    state = sampler.state_dict(trained=10)
    for epoch, expected in ((2, 30), (3, 40)):
        other = ShardSampler(sequences_of(range(40)))
        other.load_state_dict(state)
        assert other.epoch == 2
        other.set_epoch(epoch)
        assert len(list(other)) == expected


def test_after_the_state_of_a_finished_epoch_nothing_is_left_and_the_next_epoch_follows():
    sampler = ShardSampler(sequences_of(range(40)))
    list(sampler)
    state = sampler.state_dict()
    assert (state["epoch"], state["position"]) == (0, 40)
    other = ShardSampler(sequences_of(range(40)))
    other.load_state_dict(state)
    assert list(other) == []
    assert list(other) == sampler.order(1).tolist()


@pytest.mark.parametrize(
    "change",
    [
        {"shard": 8},
        {"window": 3},
        {"frames": [range(30)]},
        {"frames": [range(1, 41)]},
        {"position": 41},
    ],
)
def test_the_state_of_other_data_or_another_order_is_refused(change):
    state = ShardSampler(sequences_of(range(40))).state_dict()
    arguments = {name: value for name, value in change.items() if name in ("shard", "window")}
    sampler = ShardSampler(sequences_of(*change.get("frames", [range(40)])), **arguments)
    with pytest.raises(ArgumentError, match="state: expected the state of a ShardSampler with"):
        sampler.load_state_dict(state | ({"position": 41} if "position" in change else {}))


@pytest.mark.parametrize(
    "name, value",
    [
        ("seed", -1),
        ("shard", 0),
        ("window", 0),
        ("num_replicas", 0),
        ("rank", 1),
        ("read_ahead", -1),
    ],
)
def test_wrong_arguments_are_named(name, value):
    with pytest.raises(ArgumentError) as error:
        ShardSampler(sequences_of(range(3)), **{name: value})
    assert error.value.where == name and error.value.expected


def test_a_part_is_a_slice():
    dataset = sequences_of(range(3))
    with raises(ArgumentError, where="^dataset$", expected="a carlasc.Dataset", advice="a slice"):
        ShardSampler(SimpleNamespace(dataset=dataset, indices=[0]))


@pytest.mark.slow
@settings(max_examples=10)
@given(st.integers(1, 4))
def test_a_sampler_of_a_real_data_set_can_be_pickled_in_the_middle(tmp_path_factory, history):
    folder = tmp_path_factory.mktemp("drive")
    for seed in range(2):
        write_drive(
            folder / "Train" / f"Town0{seed}_Light" / "cartesian",
            range(20),
            spec=SPEC,
            seed=seed,
            points=20,
        )
    dataset = Dataset(folder, history=history)
    sampler = ShardSampler(dataset, shard=4, window=2)
    drawing = iter(sampler)
    begun = [next(drawing) for _ in range(7)]
    copy = pickle.loads(pickle.dumps(sampler))
    copy.load_state_dict(sampler.state_dict())
    assert begun + list(copy) == sampler.order(0).tolist()
    assert [frames.tolist() for frames in dataset.frames] == [list(range(20))] * 2
