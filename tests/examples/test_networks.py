"""The networks against the reference: names and shapes of every weight, and outputs."""

from __future__ import annotations

import json

import numpy as np
import pytest

pytest.importorskip("torch", reason="needs carlasc[torch]")

import torch
from lmscnet.model import LMSCNet
from motionsc.model import MotionSC
from sscnet.model import SSCNet

FRAMES = (1, 2, 3, 4, 5, 10, 16)
NETWORKS = {f"MotionSC_T{t}": (lambda t=t: MotionSC(11, 8, t)) for t in FRAMES} | {
    "LMSCNet_SS": lambda: LMSCNet(11, 8),
    "SSCNet_full": lambda: SSCNet(11, full=True),
    "SSCNet": lambda: SSCNet(11),
}


def fill(network: torch.nn.Module) -> None:
    """Fill a network's weights by the rule of the golden files."""
    state = network.state_dict()
    for i, key in enumerate(sorted(state)):
        rng, shape = np.random.default_rng(i), tuple(state[key].shape)
        if key.endswith("num_batches_tracked"):
            state[key] = torch.zeros(shape, dtype=torch.int64)
            continue
        values = rng.standard_normal(shape)
        if key.endswith("running_var"):
            values = np.abs(values) + 0.5
        elif (
            key.endswith("weight")
            and len(shape) == 1
            and f"{key.removesuffix('weight')}running_var" in state
        ):
            values = 1 + 0.1 * values
        elif len(shape) >= 2:
            values = values / np.sqrt(np.prod(shape[1:]))
        else:
            values = values / 10
        state[key] = torch.from_numpy(np.asarray(values, np.float32))
    network.load_state_dict(state)


@pytest.mark.parametrize("name", NETWORKS)
def test_weights_have_the_published_names_and_shapes(name, golden):
    expected = json.loads((golden / "state_dicts.json").read_text())[name]
    found = {key: list(value.shape) for key, value in NETWORKS[name]().state_dict().items()}
    assert found == expected


@pytest.mark.parametrize("name", NETWORKS)
def test_outputs_are_the_golden_ones(name, golden):
    network = NETWORKS[name]().eval()
    fill(network)
    frames = int(name.rpartition("_T")[2]) if "_T" in name else 1
    occupancy = (np.random.default_rng(1000 + frames).random((2, frames, 16, 16, 8)) < 0.15).astype(
        np.float32
    )
    with torch.no_grad(), np.load(golden / "models.npz") as expected:
        np.testing.assert_allclose(
            network(torch.from_numpy(occupancy)).numpy(), expected[name], rtol=0, atol=1e-4
        )


@pytest.mark.parametrize("frames", [1, 6, 7, 13])
def test_motionsc_takes_any_number_of_frames(frames):
    network = MotionSC(5, 4, frames).eval()
    with torch.no_grad():
        assert network(torch.zeros(1, frames, 16, 32, 4)).shape == (1, 16, 32, 4, 5)


def test_lmscnet_gives_every_scale_while_training_and_the_full_one_afterwards():
    network = LMSCNet(5, 8, multiscale=True)
    shapes = [tuple(logits.shape) for logits in network(torch.zeros(2, 1, 16, 24, 8))]
    assert shapes == [(2, 16, 24, 8, 5), (2, 8, 12, 4, 5), (2, 4, 6, 2, 5), (2, 2, 3, 1, 5)]
    assert network.eval()(torch.zeros(2, 1, 16, 24, 8)).shape == (2, 16, 24, 8, 5)


def test_sizes_are_those_of_the_papers():
    def size(network):
        return sum(p.numel() for p in network.parameters())

    assert size(LMSCNet(11, 8)) == 34_013
    assert size(MotionSC(11, 8, 1)) == pytest.approx(7.86e6, rel=1e-3)


@pytest.mark.parametrize(
    ("name", "weights", "outputs"),
    [
        ("LMSCNet_SS", "LMSC_11_T1B.pt", "published_lmsc.npz"),
        ("SSCNet_full", "SSC_Full_11_T1B.pt", "published_ssc_full.npz"),
    ],
)
def test_the_published_weights_load_strictly_and_give_the_published_outputs(
    real, golden, name, weights, outputs
):
    network = NETWORKS[name]().eval()
    network.load_state_dict(
        torch.load(real / weights, map_location="cpu", weights_only=True), strict=True
    )
    occupancy = (np.random.default_rng(7).random((1, 1, 128, 128, 8)) < 0.05).astype(np.float32)
    with torch.no_grad(), np.load(golden / outputs) as expected:
        logits = network(torch.from_numpy(occupancy)).numpy()
        np.testing.assert_allclose(
            logits[:, :24, :24], expected["logits_corner"], rtol=0, atol=1e-4
        )
        np.testing.assert_array_equal(logits.argmax(-1), expected["labels"])
