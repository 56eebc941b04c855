"""From weights and scans to grids: what is written, what is refused."""

from __future__ import annotations

import pickle
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest
from helpers.datasets.completion import SPEC, write_split

from carlasc import Dataset, GridSpec
from carlasc import open as open_source
from carlasc.core import CARLASC11
from carlasc.errors import ArgumentError, ConflictError, FormatError, MissingDataError
from carlasc.metrics import evaluate

pytest.importorskip("torch", reason="needs carlasc[torch]")

import torch
from completion.config import Config
from completion.networks import build_network
from completion.predicting import Model, predict_dataset, predict_scans
from completion.weights import read_weights, write_weights
from helpers.errors import raises

CPU = torch.device("cpu")


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    root = tmp_path_factory.mktemp("data")
    write_split(root, "Test", ["Town10_Light"], frames=3)
    return root


def save(path, name="lmscnet_ss", classes=11, spec=SPEC, history=1):
    torch.manual_seed(0)
    write_weights(path, build_network(name, classes, spec, history))
    return path


def run(model, sample):
    network = build_network(model.network, 11, SPEC, model.history).eval()
    network.load_state_dict(model.state)
    with torch.no_grad():
        return network(torch.from_numpy(sample["occupancy"]).float()[None]).argmax(-1)[0].numpy()


@pytest.mark.parametrize(
    ("name", "history"),
    [
        ("motionsc", 3),
        ("lmscnet", 1),
        ("sscnet", 1),
        ("sscnet_full", 1),
        ("js3cnet", 1),
        ("js3cnet_kitti", 1),
    ],
)
@pytest.mark.parametrize("suffix", [".pt", ".safetensors"])
def test_weights_say_what_they_are_of(tmp_path, name, history, suffix):
    model = Model.read(save(tmp_path / f"weights{suffix}", name, history=history), history)
    assert (model.network, model.classes.name) == (name, "carlasc11")
    model.complete_on(SPEC, CPU, "eager")


def test_a_data_set_is_completed_into_a_folder_that_evaluate_and_open_read(data, tmp_path):
    model = Model.read(save(tmp_path / "motionsc.pt", "motionsc", history=2), 2)
    made = predict_dataset(
        model, str(data), tmp_path / "out", CPU, "eager", split="test", frames=(1, None)
    )
    assert made == 2
    sequence = open_source(tmp_path / "out").sequences()["Test/Town10_Light/cartesian"]
    assert sequence.metadata.classes.name == "carlasc11"
    samples = Dataset(data, history=2)
    for frame in (1, 2):
        np.testing.assert_array_equal(
            sequence.grid("evaluation", frame).labels, run(model, samples[frame])
        )
    assert evaluate(tmp_path / "out", data, frames=(1, 3)).frames == 2
    # the others are there
    assert predict_dataset(model, str(data), tmp_path / "out", CPU, "eager") == 1


def test_grids_beside_the_data_leave_the_data_as_they_are(data, tmp_path):
    write_split(tmp_path / "data", "Test", ["Town10_Light"], frames=2)
    root = tmp_path / "data"
    before = {path: path.read_bytes() for path in root.rglob("*") if path.is_file()}
    model = Model.read(save(tmp_path / "net.pt"))
    predict_dataset(model, str(root), None, CPU, "eager")
    assert all(path.read_bytes() == content for path, content in before.items())
    assert evaluate(root, root, grid="completion").frames == 2
    with raises(ConflictError, expected="sscnet"):
        predict_dataset(
            Model.read(save(tmp_path / "other.pt", "sscnet")), str(root), None, CPU, "eager"
        )


def test_a_folder_of_raw_scans_is_completed_and_mirrored_if_right_handed(data, tmp_path):
    scans = data / "Test/Town10_Light/cartesian/velodyne"
    model = Model.read(save(tmp_path / "net.pt"))
    assert predict_scans(model, scans, tmp_path / "left", CPU, "eager", spec=SPEC) == 3
    samples = Dataset(data)
    labels = open_source(tmp_path / "left").sequences()["cartesian"].grid("evaluation", 1).labels
    np.testing.assert_array_equal(labels, run(model, samples[1]))

    (tmp_path / "mirrored").mkdir()
    points = np.fromfile(scans / "000001.bin", np.float32).reshape(-1, 4) * np.array(
        [1, -1, 1, 1], np.float32
    )
    points.tofile(tmp_path / "mirrored" / "a scan.bin")
    predict_scans(
        model, tmp_path / "mirrored", tmp_path / "right", CPU, "eager", spec=SPEC, right_handed=True
    )
    mirrored = open_source(tmp_path / "right").sequences()["cartesian"].grid("evaluation", 0).labels
    np.testing.assert_array_equal(mirrored, labels)


def test_networks_of_points_complete_data_sets_and_raw_scans_alike(data, tmp_path):
    model = Model.read(save(tmp_path / "net.pt", "js3cnet"))
    assert predict_dataset(model, str(data), tmp_path / "out", CPU, "compile") == 3
    scans = data / "Test/Town10_Light/cartesian/velodyne"
    assert predict_scans(model, scans, tmp_path / "raw", CPU, "eager", spec=SPEC) == 3
    (one,), (other,) = (
        open_source(tmp_path / name).sequences().values() for name in ("out", "raw")
    )
    for frame in range(3):
        np.testing.assert_array_equal(
            one.grid("evaluation", frame).labels, other.grid("evaluation", frame).labels
        )
    (tmp_path / "empty").mkdir()
    (tmp_path / "empty" / "000000.bin").write_bytes(b"")
    with raises(ArgumentError, where="points", found="none"):
        predict_scans(model, tmp_path / "empty", tmp_path / "none", CPU, "eager", spec=SPEC)
    with raises(ArgumentError, where="points", expected="remission"):
        predict_scans(
            Model.read(save(tmp_path / "kitti.pt", "js3cnet_kitti")),
            scans,
            tmp_path / "k",
            CPU,
            "eager",
            spec=SPEC,
        )


def test_the_settings_of_a_run_tell_networks_with_the_same_weights_apart(tmp_path):
    path = save(tmp_path / "best.pt", "js3cnet_exact")
    assert Model.read(path).network == "js3cnet"
    Config("js3cnet_exact").write(tmp_path / "config.yaml")
    assert Model.read(path).network == "js3cnet_exact"
    assert Model.read(save(tmp_path / "other.pt", "sscnet")).network == "sscnet"


def test_points_of_another_class_table_are_refused(tmp_path):
    model = Model.read(save(tmp_path / "kitti.pt", "js3cnet", classes=20))
    assert model.classes.name == "semantickitti19"
    with raises(
        FormatError,
        where="seg_head.linear.weight",
        expected="10 x 16",
        found="19 x 16",
        advice="classes",
    ):
        replace(model, classes=CARLASC11).complete_on(SPEC, CPU, "eager")


def test_weights_that_do_not_fit_name_the_layer_and_both_shapes(tmp_path):
    taller = GridSpec("cartesian", (16, 16, 16), SPEC.lower, SPEC.upper)
    cases = {
        "grid": (
            save(tmp_path / "grid.pt", "lmscnet_ss", spec=taller),
            1,
            {"where": "Encoder_block1.0.weight", "expected": "8 x 8 x", "found": "16 x 16 x"},
        ),
        "history": (
            save(tmp_path / "T.pt", "motionsc", history=5),
            1,
            {"where": "conv3d_1.conv3d.weight", "expected": "x 1 x 1 x 1", "found": "x 3 x 1 x 1"},
        ),
    }
    for path, history, parts in cases.values():
        with raises(FormatError, **parts):
            Model.read(path, history).complete_on(SPEC, CPU, "eager")
    with raises(FormatError, where="classes.pt", expected="11", found="7"):
        Model.read(save(tmp_path / "classes.pt", classes=7))
    from completion.weights import load_weights

    with raises(
        FormatError,
        where="conv_classes.weight",
        expected="11 x 128 x 1 x 1 x 1",
        found="7 x 128",
        advice="classes",
    ):
        load_weights(
            build_network("sscnet", 11, SPEC),
            read_weights(save(tmp_path / "k.pt", "sscnet", classes=7)),
            "k.pt",
        )
    with raises(FormatError, where="s.pt", expected="layer", found="none"):
        load_weights(
            build_network("sscnet_full", 11, SPEC),
            read_weights(save(tmp_path / "s.pt", "sscnet")),
            "s.pt",
        )


class Evil:
    def __reduce__(self):
        return (print, ("this must never run",))


def test_files_that_are_no_state_dict_are_refused_and_nothing_in_them_runs(tmp_path, capsys):
    evil, text, tensor = tmp_path / "evil.pt", tmp_path / "text.pt", tmp_path / "tensor.pt"
    evil.write_bytes(pickle.dumps({"weight": Evil()}))
    text.write_text("not weights")
    torch.save(torch.zeros(3), tensor)
    torch.save({"epochs": 3}, tmp_path / "numbers.pt")
    torch.save({"weight": torch.zeros(3)}, tmp_path / "foreign.pt")
    (tmp_path / "text.safetensors").write_text("not weights")
    for name in ("evil.pt", "text.pt", "tensor.pt", "numbers.pt", "foreign.pt", "text.safetensors"):
        with pytest.raises(FormatError) as error:
            Model.read(tmp_path / name)
        assert name in str(error.value)
        assert "\n" not in str(error.value)
    assert "must never run" not in capsys.readouterr().out
    with pytest.raises(MissingDataError):
        Model.read(tmp_path / "none.pt")


def test_scans_without_poses_take_no_history_and_an_empty_folder_is_named(tmp_path):
    model = Model.read(save(tmp_path / "net.pt", "motionsc", history=2), 2)
    with raises(ArgumentError, where="history", expected="1", found="2"):
        predict_scans(model, tmp_path, tmp_path / "out", CPU, "eager", spec=SPEC)
    with raises(MissingDataError, where=str(tmp_path), expected=".bin"):
        predict_scans(
            Model.read(save(tmp_path / "one.pt")),
            tmp_path,
            tmp_path / "out",
            CPU,
            "eager",
            spec=SPEC,
        )


def test_grids_that_do_not_divide_are_refused():
    with raises(ArgumentError, expected="16 x 16 x 1", found="24 x 16 x 8"):
        build_network("motionsc", 11, SPEC.with_size((24, 16, 8)))
    with raises(ArgumentError, expected="4 x 4 x 4", found="16 x 16 x 15"):
        build_network("sscnet", 11, SPEC.with_size((16, 16, 15)))


@pytest.mark.slow
def test_the_script_completes_and_a_mistake_is_one_line(data, tmp_path, examples):
    weights = save(tmp_path / "net.pt")
    command = [sys.executable, str(examples / "predict.py")]
    done = subprocess.run(
        [*command, weights, data, tmp_path / "out", "--eager"],
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert "3 frames completed" in done.stdout
    failed = subprocess.run(
        [*command, tmp_path / "none.pt", data], capture_output=True, text=True, check=False
    )
    assert (failed.returncode, failed.stderr.count("\n")) == (1, 1)
    assert "expected weights, found nothing" in failed.stderr
