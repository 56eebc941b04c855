"""Reading and writing weights: state dicts as `.pt` or `.safetensors`.

Code in a file is never run.
"""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from carlasc.errors import FormatError, MissingDataError, import_extra, reading

StateDict = dict[str, Tensor]

_MARKS = {  # a name that only the state dict of one network has, searched in this order
    "motionsc": "stpn.conv_pre_1.weight",
    "lmscnet": "seg_head_1_2.conv0.weight",
    "lmscnet_ss": "seg_head_1_1.conv0.weight",
    "sscnet_full": "deconv_classes.weight",
    "sscnet": "conv_classes.weight",
    "js3cnet": "seg_head.sparseModel.2.0.1.weight",
    "js3cnet_kitti": "seg_head.sparseModel.2.0.1.0.weight",
    "baseline": "voxels.weight",
}
# networks whose weights have the same names as those of another
_VARIANTS = {
    "js3cnet_exact": "js3cnet",
    "baseline_hits": "baseline",
}


def read_weights(path: Path) -> StateDict:
    """Read a state dict onto the CPU.

    Raises:
        MissingDataError: the file does not exist.
        FormatError: it is not a state dict, or a pickle that would run code.
    """
    if not path.is_file():
        raise MissingDataError(path, expected="weights", found="nothing")
    if path.suffix == ".safetensors":
        safetensors = import_extra("safetensors.torch", "torch")
        with reading(path, "safetensors"):
            state = safetensors.load_file(path, device="cpu")
    else:
        state = read_checkpoint(path)
    if isinstance(state.get("network"), dict) and "epoch" in state:  # a checkpoint of ours
        state = state["network"]
    if not state or not all(
        isinstance(name, str) and isinstance(value, Tensor) for name, value in state.items()
    ):
        raise FormatError(path, expected="a state dict (names to tensors)", found=_describe(state))
    return state


def read_checkpoint(path: Path) -> dict[str, Any]:
    """Read a dict of tensors and plain values, `weights_only`.

    Raises:
        FormatError: the file holds something else.
    """
    with reading(path, "a state dict without code, which would not be run"):
        state = torch.load(path, map_location="cpu", weights_only=True)
    if not isinstance(state, Mapping):
        raise FormatError(
            path, expected="a state dict (names to tensors)", found=f"{type(state).__name__}"
        )
    return dict(state)


def write_weights(path: Path, network: nn.Module) -> None:
    """Write a network's state dict, as safetensors if the name ends in .safetensors.

    The file is complete or does not exist.
    """
    state = {
        name: value.detach().cpu().contiguous() for name, value in network.state_dict().items()
    }
    if path.suffix == ".safetensors":
        path.parent.mkdir(parents=True, exist_ok=True)
        import_extra("safetensors.torch", "torch").save_file(state, _beside(path))
        os.replace(_beside(path), path)
    else:
        write_checkpoint(path, state)


def write_checkpoint(path: Path, state: Mapping[str, Any]) -> None:
    """Write a dict of tensors and plain values. The file is complete or does not exist."""
    path.parent.mkdir(parents=True, exist_ok=True)
    torch.save(dict(state), _beside(path))
    os.replace(_beside(path), path)


def load_weights(network: nn.Module, state: Mapping[str, Tensor], where: str) -> None:
    """Load a state dict strictly; `where` is the file named in errors.

    Raises:
        FormatError: a layer is missing, unknown, or of another shape; the message names it and both
            shapes.
    """
    own = network.state_dict()
    for name, value in own.items():
        if name not in state:
            raise FormatError(
                where,
                expected=f"the layer {name} {_shape(value)}",
                found="none",
                advice="the weights may belong to another network",
            )
        if state[name].shape != value.shape:
            raise FormatError(
                f"{where}: layer {name}",
                expected=_shape(value),
                found=_shape(state[name]),
                advice=_advice(name),
            )
    if unknown := [name for name in state if name not in own]:
        raise FormatError(
            where,
            expected=f"no layer {unknown[0]}",
            found=_shape(state[unknown[0]]),
            advice="the weights may belong to another network",
        )
    network.load_state_dict(dict(state), strict=True)


def identify(
    state: Mapping[str, Tensor], where: str, trained: str | None = None
) -> tuple[str, int]:
    """Return the name of the network that a state dict belongs to, and the number of classes.

    `trained` is the name of the network in the settings of the run, which decides between networks
    with the same weights.

    Raises:
        FormatError: the network is unknown.
    """
    name = next((name for name, mark in _MARKS.items() if mark in state), None)
    if name is None:
        raise FormatError(
            where,
            expected=f"weights of {', '.join(_MARKS)}",
            found=f"a first layer named {next(iter(state))}",
        )
    if trained in _VARIANTS and _VARIANTS[trained] == name:
        name = trained
    last = {
        "motionsc": "segmentation_head.conv_classes.bias",
        "sscnet_full": "deconv_classes.bias",
        "sscnet": "conv_classes.bias",
        "js3cnet": "complet_head.Decoder.pre_conv2.0.bias",
        "js3cnet_kitti": "complet_head.Decoder.pre_conv2.0.bias",
        "baseline": "classes.bias",
    }
    layer = last.get(_VARIANTS.get(name, name), "seg_head_1_1.conv_classes.bias")
    if layer not in state or not state[layer].ndim:
        found = _shape(state[layer]) if layer in state else "none"
        raise FormatError(
            where, expected=f"the layer {layer}, a number for each class", found=found
        )
    return name, len(state[layer])


def _advice(layer: str) -> str:
    if "conv3d_" in layer:
        return "the weights are for another history (T)"
    if layer.startswith("seen."):
        return "the weights are for another history (T), or for another grid (cells along z)"
    if "classes" in layer or layer.startswith("seg_head.linear"):
        return "the weights are for another number of classes"
    return "the weights are for another grid (cells along z) or network"


def _describe(state: Mapping[str, Any]) -> str:
    other = [
        name
        for name, value in state.items()
        if not (isinstance(name, str) and isinstance(value, Tensor))
    ]
    return f"{type(state[other[0]]).__name__} under {other[0]!r}" if other else "an empty one"


def _shape(value: Tensor) -> str:
    return " x ".join(map(str, value.shape)) or "a single number"


def _beside(path: Path) -> Path:
    return path.with_name(f".{path.name}.part")
