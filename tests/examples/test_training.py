"""Training on a tiny data set: what is written, resumed, stopped, and shared among processes."""

from __future__ import annotations

import csv
import json
import os
import subprocess
import sys
import time
from dataclasses import replace

import numpy as np
import pytest
from helpers.datasets.completion import write_split
from helpers.servers.range_server import serve_folder

import carlasc
from carlasc import ShardSampler, pack
from carlasc.core import REMAPS
from carlasc.errors import ArgumentError, CarlascError, ConflictError, FormatError, MissingDataError

pytest.importorskip("torch", reason="needs carlasc[torch]")

import torch
from completion import training
from completion.config import Config
from completion.data import EpochSampler, TrainLoader, open_split
from completion.processes import Processes
from completion.training import BEST, LAST, train
from completion.weights import read_checkpoint, read_weights
from helpers.errors import raises

ALONE = Processes(0, 1, torch.device("cpu"))
QUICK = Config(
    "lmscnet_ss", epochs=2, batch_size=2, workers=0, learning_rate=0.01, class_weights="train"
)


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    root = tmp_path_factory.mktemp("data")
    write_split(root, "Train", ["Town01_Light", "Town02_Light"], frames=3)
    write_split(root, "Val", ["Town07_Light"], frames=3, seed=1)
    return root


def test_a_run_writes_weights_checkpoint_settings_and_curves(data, tmp_path, capsys):
    progress = train(data, replace(QUICK, epochs=4), tmp_path / "run", ALONE)
    assert progress.epoch == 4
    assert progress.losses[-1] < progress.losses[0]
    assert progress.best_miou == max(progress.mious) == progress.mious[progress.best_epoch - 1]
    names = {path.name for path in (tmp_path / "run").iterdir()}
    assert {LAST, BEST, "config.yaml", "tensorboard"} <= names
    assert Config.read(tmp_path / "run" / "config.yaml") == replace(QUICK, epochs=4)
    assert "epoch 4/4" in capsys.readouterr().err

    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    events = EventAccumulator(str(tmp_path / "run" / "tensorboard"))
    events.Reload()
    assert [e.value for e in events.Scalars("val/mIoU")] == pytest.approx(progress.mious)
    assert len(events.Tags()["images"]) == 3

    with (tmp_path / "run" / "epochs.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [int(row["epoch"]) for row in rows] == [1, 2, 3, 4]
    assert [float(row["val/mIoU"]) for row in rows] == pytest.approx(progress.mious)
    assert [float(row["train/loss"]) for row in rows] == pytest.approx(progress.losses)


@pytest.mark.slow
@pytest.mark.needs("wandb")
def test_weights_and_biases_logs_without_sending(data, tmp_path):
    train(data, replace(QUICK, epochs=2, wandb=True), tmp_path / "run", ALONE)
    (log,) = (tmp_path / "run" / "wandb").glob("offline-run-*/*.wandb")
    end = time.monotonic() + 60  # its service writes the file after the run is finished
    while b"train/loss" not in log.read_bytes() and time.monotonic() < end:
        time.sleep(0.2)
    assert b"val/mIoU" in log.read_bytes()


@pytest.mark.slow
@pytest.mark.parametrize("network", ["lmscnet_ss", "sscnet", "js3cnet"])
def test_a_resumed_run_ends_with_the_weights_of_one_that_was_never_stopped(data, tmp_path, network):
    config = replace(QUICK, network=network, free_ratio=2.0)
    whole = train(data, config, tmp_path / "whole", ALONE)
    train(data, replace(config, epochs=1), tmp_path / "parts", ALONE)
    parts = train(data, config, tmp_path / "parts", ALONE, resume=True)
    assert parts.losses == whole.losses
    expected, found = (
        read_weights(tmp_path / "whole" / LAST),
        read_weights(tmp_path / "parts" / LAST),
    )
    for name, value in expected.items():
        assert torch.equal(value, found[name]), name


@pytest.mark.slow
@pytest.mark.parametrize("store", ["files", "zarr"])
@pytest.mark.parametrize("workers", [0, 2])
def test_a_run_that_is_stopped_in_the_middle_of_an_epoch_ends_with_the_same_weights(
    data, tmp_path, monkeypatch, store, workers
):
    source = data if store == "files" else pack(data, tmp_path / "data.zarr").out
    config = replace(QUICK, free_ratio=2.0, save_every=1)
    whole = train(source, config, tmp_path / "whole", ALONE)
    steps = []

    def stop_in_the_second_epoch(networks, optimizer, batch, weights, place, *others):
        steps.append(place)
        if place == (1, 2):
            raise KeyboardInterrupt
        return training._train_step_before(networks, optimizer, batch, weights, place, *others)

    with monkeypatch.context() as patch:
        patch.setattr(training, "_train_step_before", training._train_step, raising=False)
        patch.setattr(training, "_train_step", stop_in_the_second_epoch)
        with pytest.raises(KeyboardInterrupt):
            train(source, replace(config, workers=workers), tmp_path / "parts", ALONE)
    assert steps == [(0, 0), (0, 1), (0, 2), (1, 0), (1, 1), (1, 2)]
    parts = train(source, config, tmp_path / "parts", ALONE, resume=True)
    assert parts.losses == whole.losses and parts.mious == whole.mious
    expected, found = (
        read_weights(tmp_path / "whole" / LAST),
        read_weights(tmp_path / "parts" / LAST),
    )
    for name, value in expected.items():
        assert torch.equal(value, found[name]), name


@pytest.mark.needs("zarr", "urllib3")
def test_training_from_a_server_gives_the_weights_of_training_from_disk(data, tmp_path):
    store = pack(data, tmp_path / "served" / "data.zarr").out
    here = train(store, replace(QUICK, epochs=1), tmp_path / "here", ALONE)
    with serve_folder(store.parent) as served:
        source = carlasc.open(f"{served.url}/data.zarr", cache=tmp_path / "cache")
        there = train(source, replace(QUICK, epochs=1), tmp_path / "there", ALONE)
    assert there.losses == here.losses and there.mious == here.mious
    assert (
        max(served.sent[path] - (store.parent / path).stat().st_size for path in served.sent) == 0
    )


def test_shards_of_a_packed_store_are_read_one_after_another_and_files_in_any_order(data, tmp_path):
    assert isinstance(TrainLoader(open_split(data, "train", QUICK), QUICK).sampler, EpochSampler)
    packed = pack(data, tmp_path / "data.zarr").out
    loaders = [
        TrainLoader(open_split(packed, "train", QUICK), replace(QUICK, batch_size=4), r, 2)
        for r in range(2)
    ]
    assert all(isinstance(loader.sampler, ShardSampler) for loader in loaders)
    places = [[str(b["sequence"]) + str(b["frame"]) for b in loader.epoch(0)] for loader in loaders]
    assert len(places[0]) == len(places[1]) == 2 and not set(places[0]) & set(places[1])


def test_a_run_is_neither_overwritten_nor_resumed_with_other_settings(data, tmp_path):
    train(data, replace(QUICK, epochs=1), tmp_path, ALONE)
    with raises(ConflictError, where="last.pt", found="one", advice="--resume"):
        train(data, QUICK, tmp_path, ALONE)
    with raises(ConflictError, where="config.yaml", found="batch_size"):
        train(data, replace(QUICK, batch_size=3), tmp_path, ALONE, resume=True)


def test_training_stops_early_when_nothing_gets_better(data, tmp_path):
    config = replace(QUICK, epochs=9, learning_rate=1e-12, network="sscnet", patience=2, flips="")
    progress = train(data, config, tmp_path, ALONE)
    assert (progress.best_epoch, progress.epoch) == (1, 3)


@pytest.mark.slow
@pytest.mark.parametrize(
    "changes",
    [
        {"network": "motionsc", "history": 3, "shuffle_history": True},
        {"network": "lmscnet"},
        {"precision": "bf16"},
        {"network": "js3cnet_exact", "precision": "bf16"},
    ],
)
def test_every_network_and_precision_trains(data, tmp_path, changes):
    progress = train(data, replace(QUICK, epochs=1, **changes), tmp_path, ALONE)
    assert np.isfinite(progress.losses[0])


def test_points_with_remission_train_the_network_that_takes_it(tmp_path):
    for split in ("Train", "Val"):
        write_split(tmp_path, split, [f"Town01_{split}"], frames=2, remission=0.5)
    progress = train(
        tmp_path, replace(QUICK, network="js3cnet_kitti", epochs=1), tmp_path / "run", ALONE
    )
    assert np.isfinite(progress.losses[0])


@pytest.mark.needs("tensorboard")
def test_a_loss_that_is_no_number_stops_the_run_and_names_the_batch(data, tmp_path):
    with raises(CarlascError, where="epoch 1, batch", problem="_Light "):
        train(data, replace(QUICK, learning_rate=1e30, flips=""), tmp_path, ALONE)


@pytest.mark.needs("tensorboard")
def test_running_out_of_memory_says_which_batch_size_to_try(data, tmp_path, monkeypatch):
    def no_memory(*_):
        raise torch.OutOfMemoryError("CUDA out of memory")

    monkeypatch.setattr(training, "target_of", no_memory)
    with raises(
        CarlascError, where="batch size 2", advice="--set batch_size=1 or --set precision=bf16"
    ):
        train(data, QUICK, tmp_path, ALONE)


def test_data_that_cannot_be_trained_on_is_named(data, tmp_path):
    write_split(tmp_path / "only_train", "Train", ["Town01_Light"], frames=2)
    with raises(MissingDataError, where="split 'val'"):
        train(tmp_path / "only_train", QUICK, tmp_path / "a", ALONE)
    with raises(ArgumentError, where="history", expected="3 frames", found="4"):
        train(data, replace(QUICK, network="motionsc", history=4), tmp_path / "b", ALONE)
    with raises(ArgumentError, where="compile", expected="False for js3cnet"):
        train(data, replace(QUICK, network="js3cnet", compile=True), tmp_path / "d", ALONE)
    with raises(ArgumentError, where="history", advice="motionsc"):
        replace(QUICK, history=2)
    with raises(FormatError, where="none.json", expected="carlasc stats --json"):
        train(
            data, replace(QUICK, class_weights=str(tmp_path / "none.json")), tmp_path / "c", ALONE
        )


def test_class_weights_come_from_the_table_the_split_or_a_file_of_carlasc_stats(data, tmp_path):
    from completion.data import class_weights

    split = open_split(data, "train", QUICK)
    names = split.classes.names
    assert len(class_weights(data, split, replace(QUICK, class_weights="table"))) == 11
    np.testing.assert_array_equal(
        class_weights(data, split, replace(QUICK, class_weights="none")), np.ones(11)
    )
    (tmp_path / "stats.json").write_text(
        json.dumps({"class_weights": {name: i / 10 for i, name in names.items()}})
    )
    found = class_weights(data, split, replace(QUICK, class_weights=str(tmp_path / "stats.json")))
    np.testing.assert_allclose(found, np.arange(11) / 10)


def test_how_much_rare_classes_weigh_is_the_networks_own_unless_the_settings_say(data):
    from completion.data import class_weights, open_split
    from completion.tasks import root_weights

    split = open_split(data, "train", QUICK)
    log, root = (
        class_weights(data, split, replace(QUICK, weighting=kind)) for kind in ("log", "root")
    )
    np.testing.assert_array_equal(class_weights(data, split, QUICK), log)
    np.testing.assert_array_equal(
        class_weights(data, split, replace(QUICK, network="baseline")), root
    )
    assert root.max() / root[0] > log.max() / log[0]
    np.testing.assert_allclose(root_weights(np.array([800, 100, 0])), [1, 2, 0])
    with raises(ArgumentError, where="weighting", found="'much'"):
        replace(QUICK, weighting="much")


def test_a_score_with_certainty_is_the_score_and_its_calibration(data):
    from completion.data import eval_loader, open_split
    from completion.networks import build_network
    from completion.scoring import score, score_with_certainty

    val = open_split(data, "val", QUICK)
    network = build_network("lmscnet_ss", 11, val.spec)
    matrix, certainty = score_with_certainty(network, eval_loader(val, QUICK), 11, ALONE)
    np.testing.assert_array_equal(
        matrix.counts, score(network, eval_loader(val, QUICK), 11, ALONE).counts
    )
    result = certainty.compute()
    voxels = result.empty.count.sum() + result.occupied.count.sum()
    assert voxels == matrix.total
    right = np.nansum(result.empty.accuracy * result.empty.count) + np.nansum(
        result.occupied.accuracy * result.occupied.count
    )
    assert right == pytest.approx(matrix.true_positives.sum())


def test_the_mistakes_of_the_fork_of_js3cnet_are_not_made(data):
    """Ground stays ground in the labels of points; class weights are those of the voxel counts."""
    from completion.data import class_weights

    split = open_split(data, "train", replace(QUICK, network="js3cnet"), training=True)
    sequence = split.sequences[0]
    raw, found = sequence.read("labels", 0), split[0]["point_labels"]
    np.testing.assert_array_equal(found, REMAPS["carlasc11"](raw))
    weights = class_weights(data, split, replace(QUICK, network="js3cnet", class_weights="table"))
    counts = [
        4166593275,
        42309744,
        33332681,
        8179519,
        905663,
        3083923,
        235769663,
        87601245,
        112863867,
        29816894,
        13839655,
    ]
    np.testing.assert_allclose(weights, np.cbrt(counts[0] / np.array(counts)), rtol=1e-5)


def test_semantickitti_trains_on_its_19_classes_and_leaves_ignored_ones_out(tmp_path):
    raw = (10, 40, 52, 99)  # car, road, and two that the benchmark ignores
    for split in ("Train", "Val"):
        write_split(
            tmp_path, split, [f"KITTI_{split}"], frames=2, classes=raw, table="semantickitti"
        )
    config = replace(QUICK, remap="semantickitti19", epochs=1)
    sample = open_split(tmp_path, "train", config)[0]
    assert set(np.unique(sample["labels"])) == {0, 1, 9}
    assert not sample["known"][8:][sample["occupancy"][-1][8:] > 0].any()
    assert np.isfinite(train(tmp_path, config, tmp_path / "run", ALONE).losses[0])
    assert read_weights(tmp_path / "run" / BEST)["seg_head_1_1.conv_classes.bias"].shape == (20,)
    points = open_split(tmp_path, "train", replace(config, network="js3cnet"), training=True)[0]
    assert set(np.unique(points["point_labels"])) == {0, 1, 9}
    write_split(tmp_path / "carla", "Train", ["Town01_Light"], frames=2)
    with raises(ArgumentError, where="remap", expected="carla", found="semantickitti19"):
        open_split(tmp_path / "carla", "train", config)


def test_settings_files_of_every_network_are_read(examples):
    files = sorted(examples.glob("*/*.yaml"))
    assert len(files) == 9
    for file in files:
        assert Config.read(file, ["epochs=3"]).epochs == 3
    with raises(ArgumentError, where=str(files[0]), found="speed"):
        Config.read(files[0], ["speed=3"])
    with raises(ArgumentError, where="epochs", expected="int", found="'many'"):
        Config.read(files[0], ["epochs=many"])


@pytest.mark.slow
def test_two_processes_of_torchrun_end_with_the_weights_of_one(data, tmp_path, examples):
    config = tmp_path / "config.yaml"
    # no batch norm: its statistics would be each process's own
    settings = replace(QUICK, network="sscnet", epochs=1)
    settings.write(config)
    train(data, settings, tmp_path / "one", ALONE)
    command = [
        sys.executable,
        "-m",
        "torch.distributed.run",
        "--standalone",
        "--nproc-per-node",
        "2",
    ]
    command += [
        str(examples / "train.py"),
        str(config),
        str(data),
        "--out",
        str(tmp_path / "two"),
        "--device",
        "cpu",
    ]
    done = subprocess.run(
        command,
        env=os.environ | {"OMP_NUM_THREADS": "1"},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    one, two = read_checkpoint(tmp_path / "one" / LAST), read_checkpoint(tmp_path / "two" / LAST)
    assert two["losses"] == pytest.approx(one["losses"], rel=1e-4)
    assert two["mious"] == pytest.approx(one["mious"], rel=1e-2)
    # Adam turns rounding into steps where a gradient is nearly zero
    for name, value in one["network"].items():
        assert (
            torch.isclose(value, two["network"][name], rtol=1e-3, atol=1e-4).double().mean() > 0.98
        ), name


@pytest.fixture(scope="module")
def certain(tmp_path_factory):
    """The data of `data`, with certain labels that the grid says are certain."""
    root = tmp_path_factory.mktemp("certain")
    write_split(root, "Train", ["Town01_Light", "Town02_Light"], frames=3, certainty=1.0)
    write_split(root, "Val", ["Town07_Light"], frames=3, seed=1)
    return root


@pytest.mark.slow
@pytest.mark.parametrize(
    "network, free_ratio",
    [("lmscnet_ss", 0.0), ("lmscnet", 0.0), ("sscnet", 2.0), ("js3cnet", 0.0)],
)
def test_training_on_certain_probabilities_is_training_on_labels(
    certain, tmp_path, network, free_ratio
):
    config = replace(QUICK, network=network, free_ratio=free_ratio, epochs=1)
    hard = train(certain, config, tmp_path / "hard", ALONE)
    soft = train(certain, replace(config, soft_labels=True), tmp_path / "soft", ALONE)
    assert soft.losses == hard.losses and soft.mious == hard.mious
    expected, found = (read_weights(tmp_path / name / LAST) for name in ("hard", "soft"))
    for name, value in expected.items():
        assert torch.equal(value, found[name]), name


def test_a_run_on_soft_labels_learns(tmp_path):
    write_split(
        tmp_path / "data", "Train", ["Town01_Light", "Town02_Light"], frames=3, certainty=0.9
    )
    write_split(tmp_path / "data", "Val", ["Town07_Light"], frames=3, seed=1)
    hard = train(tmp_path / "data", replace(QUICK, epochs=4), tmp_path / "hard", ALONE)
    soft = train(
        tmp_path / "data", replace(QUICK, epochs=4, soft_labels=True), tmp_path / "run", ALONE
    )
    assert soft.losses[-1] < soft.losses[0]
    assert soft.losses != hard.losses
    assert Config.read(tmp_path / "run" / "config.yaml").soft_labels


def test_data_that_have_no_soft_labels_are_refused_with_what_to_do(data, tmp_path):
    with raises(MissingDataError, where="split 'train'"):
        train(data, replace(QUICK, soft_labels=True), tmp_path, ALONE)
    with raises(ArgumentError, where="soft_labels", expected="remap=semantickitti19", found="True"):
        replace(QUICK, soft_labels=True, remap="semantickitti19")


@pytest.mark.slow
def test_the_script_takes_soft_labels(certain, tmp_path, examples):
    settings = {"epochs": 1, "batch_size": 2, "workers": 0, "class_weights": "none"}
    options = [word for name, value in settings.items() for word in ("--set", f"{name}={value}")]
    command = [sys.executable, examples / "train.py", examples / "sscnet" / "carlasc.yaml", certain]
    command += ["--out", tmp_path / "run", "--soft-labels", "--device", "cpu", *options]
    done = subprocess.run(command, capture_output=True, text=True, timeout=240, check=False)
    assert done.returncode == 0, done.stderr
    assert Config.read(tmp_path / "run" / "config.yaml").soft_labels
