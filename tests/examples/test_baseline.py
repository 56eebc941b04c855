"""The small network of our own: what it takes, that it learns, and what it refuses."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from helpers.datasets.completion import SPEC, write_split

from carlasc import Dataset
from carlasc import open as open_source
from carlasc.errors import ArgumentError, CarlascError, FormatError

pytest.importorskip("torch", reason="needs carlasc[torch]")

import torch
from baseline.model import HIT, PASSED, Baseline
from baseline.task import Seen
from completion.config import Config
from completion.latency import measure_network
from completion.networks import build_network
from completion.predicting import Model, predict_dataset, predict_scans
from completion.processes import Processes
from completion.training import LAST, train
from completion.weights import read_weights, write_weights
from helpers.errors import raises

CPU = torch.device("cpu")
ALONE = Processes(0, 1, CPU)
QUICK = Config(
    "baseline",
    history=2,
    epochs=2,
    batch_size=2,
    workers=0,
    learning_rate=0.01,
    class_weights="train",
)


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    root = tmp_path_factory.mktemp("data")
    write_split(root, "Train", ["Town01_Light", "Town02_Light"], frames=3)
    write_split(root, "Val", ["Town07_Light"], frames=3, seed=1)
    return root


@pytest.fixture(scope="module")
def weights(tmp_path_factory):
    torch.manual_seed(0)
    path = tmp_path_factory.mktemp("weights") / "net.safetensors"
    write_weights(path, build_network("baseline", 11, SPEC, 2))
    return path


@pytest.mark.parametrize("frames", [1, 5])
def test_a_stack_gives_logits_of_every_voxel(frames):
    network = Baseline(5, 4, frames).eval()
    with torch.no_grad():
        assert network(torch.zeros(2, frames, 16, 24, 4)).shape == (2, 16, 24, 4, 5)


def test_it_tells_apart_what_was_hit_what_was_passed_and_what_was_never_seen():
    torch.manual_seed(0)
    network = Baseline(5, 4).eval()
    with torch.no_grad():
        nothing, passed, hit = (
            network(torch.full((1, 1, 8, 8, 4), float(value))) for value in (0, PASSED, HIT)
        )
    assert (
        not torch.equal(nothing, passed)
        and not torch.equal(passed, hit)
        and not torch.equal(nothing, hit)
    )


def test_the_layers_of_height_are_not_mixed_up():
    """A class that depends on the height alone is learned from the bias of each layer."""
    torch.manual_seed(0)
    network = Baseline(4, 4)
    optimizer = torch.optim.Adam(network.parameters(), lr=0.02)
    target = torch.arange(4).expand(2, 8, 8, 4)
    for _ in range(40):
        stack = torch.randint(0, 3, (2, 1, 8, 8, 4)).float()
        loss = torch.nn.functional.cross_entropy(network(stack).movedim(-1, 1), target)
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
    assert (network(torch.zeros(2, 1, 8, 8, 4)).argmax(-1) == target).float().mean() > 0.9


@pytest.mark.slow
def test_it_learns_and_a_resumed_run_ends_with_the_weights_of_one_that_was_never_stopped(
    data, tmp_path
):
    config = replace(QUICK, epochs=3, soft_labels=False)
    whole = train(data, config, tmp_path / "whole", ALONE)
    assert whole.losses[-1] < whole.losses[0]
    train(data, replace(config, epochs=1), tmp_path / "parts", ALONE)
    parts = train(data, replace(config, keep_samples=True), tmp_path / "parts", ALONE, resume=True)
    assert parts.losses == whole.losses  # also with samples that are kept in memory
    expected, found = (
        read_weights(tmp_path / "whole" / LAST),
        read_weights(tmp_path / "parts" / LAST),
    )
    for name, value in expected.items():
        assert torch.equal(value, found[name]), name


def test_history_may_be_shuffled_and_the_newest_scan_stays_last(data):
    from completion.data import open_split

    config = replace(QUICK, history=3)
    plain, shuffled = (
        open_split(data, "train", replace(config, shuffle_history=on))[2] for on in (False, True)
    )
    np.testing.assert_array_equal(plain["visibility"][-1], shuffled["visibility"][-1])
    assert sorted(grid.tobytes() for grid in plain["visibility"]) == sorted(
        grid.tobytes() for grid in shuffled["visibility"]
    )


def test_without_rays_it_is_told_the_hits_alone(data, weights, tmp_path):
    from completion.networks import KINDS

    told, hits = KINDS["baseline"].task, KINDS["baseline_hits"].task
    sample = Dataset(data, "val", history=2, fields=("visibility", "occupancy"))[1]
    batch = {name: torch.from_numpy(sample[name])[None] for name in ("visibility", "occupancy")}
    (all_seen,), (hit,) = (task.arguments(task.prepare(batch, CPU)) for task in (told, hits))
    assert (
        torch.equal(hit, torch.where(all_seen == HIT, all_seen, 0.0)) and (all_seen == PASSED).any()
    )
    np.testing.assert_array_equal(hits.seen(sample, SPEC), told.seen(sample, SPEC))
    assert np.isfinite(
        train(data, replace(QUICK, network="baseline_hits", epochs=1), tmp_path, ALONE).losses[0]
    )
    # by the settings of the run
    assert Model.read(tmp_path / "best.safetensors").network == "baseline_hits"
    assert Model.read(weights, 2).network == "baseline"


def test_its_weights_are_recognised_and_complete_a_data_set(data, weights, tmp_path):
    model = Model.read(weights, 2)
    assert (model.network, model.classes.name) == ("baseline", "carlasc11")
    assert predict_dataset(model, str(data), tmp_path / "out", CPU, "eager", split="val") == 3
    network = build_network("baseline", 11, SPEC, 2).eval()
    network.load_state_dict(model.state)
    sample = Dataset(data, "val", history=2, fields=("visibility",))[1]
    with torch.no_grad():
        expected = network(torch.from_numpy(sample["visibility"]).float()[None]).argmax(-1)[0]
    (sequence,) = open_source(tmp_path / "out").sequences().values()
    np.testing.assert_array_equal(sequence.grid("evaluation", 1).labels, expected)


def test_raw_scans_are_completed_by_a_network_of_one_scan(data, tmp_path):
    torch.manual_seed(0)
    write_weights(tmp_path / "one.pt", build_network("baseline", 11, SPEC))
    scans = data / "Val/Town07_Light/cartesian/velodyne"
    model = Model.read(tmp_path / "one.pt")
    assert predict_scans(model, scans, tmp_path / "raw", CPU, "eager", spec=SPEC) == 3
    assert predict_dataset(model, str(data), tmp_path / "out", CPU, "eager", split="val") == 3
    (one,), (other,) = (
        open_source(tmp_path / name).sequences().values() for name in ("raw", "out")
    )
    np.testing.assert_array_equal(
        one.grid("evaluation", 2).labels, other.grid("evaluation", 2).labels
    )


def test_weights_for_another_history_or_grid_and_grids_that_do_not_divide_are_refused(weights):
    with raises(
        FormatError,
        where="seen.0.weight",
        expected="32 x 16 x 3 x 3",
        found="32 x 32",
        advice="history",
    ):
        Model.read(weights, 1).complete_on(SPEC, CPU, "eager")
    with raises(ArgumentError, expected="8 x 8 x 1", found="12 x 16 x 8"):
        build_network("baseline", 11, SPEC.with_size((12, 16, 8)))


@pytest.mark.slow
def test_what_it_takes_is_measured_like_other_networks():
    sample = Seen().example(SPEC, 3, np.random.default_rng(0))
    assert set(np.unique(sample["visibility"])) == {0, PASSED, HIT}
    assert 0 < Seen().seen(sample, SPEC).mean() < 0.2
    (latency,) = measure_network("baseline", 3, CPU, spec=SPEC, repetitions=2, modes=["eager"])
    assert (latency.network, latency.history) == ("baseline", 3) and latency.fastest_ms > 0


@pytest.mark.needs("tensorboard")
def test_a_sample_that_is_alone_in_its_batch_is_too_little_for_the_batch_norms_of_a_small_grid(
    data, tmp_path
):
    # 6 samples, 16 x 16 cells
    config = Config("motionsc", epochs=1, batch_size=5, workers=0, class_weights="none")
    with raises(
        CarlascError, where="epoch 1, batch 2", problem="1 sample", advice="batch_size"
    ) as error:
        train(data, config, tmp_path, ALONE)
    assert "\n" not in str(error.value)
