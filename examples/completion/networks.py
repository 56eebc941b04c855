"""Networks by name, for a number of classes and a grid."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

from lmscnet.model import LMSCNet
from motionsc.model import MotionSC
from sscnet.model import SSCNet
from torch import nn

from carlasc import GridSpec
from carlasc.errors import ArgumentError

_BUILDERS: Mapping[str, Callable[[int, int, int], nn.Module]] = {  # (classes, Z, T)
    "motionsc": MotionSC,
    "lmscnet_ss": lambda classes, height, _: LMSCNet(classes, height),
    "lmscnet": lambda classes, height, _: LMSCNet(classes, height, multiscale=True),
    "sscnet": lambda classes, _height, _frames: SSCNet(classes),
    "sscnet_full": lambda classes, _height, _frames: SSCNet(classes, full=True),
}


def build_network(name: str, num_classes: int, spec: GridSpec, history: int = 1) -> nn.Module:
    """Build a network for a grid.

    Args:
        name: one of `completion.config.NETWORKS`.
        num_classes: K.
        spec: the grid of its input and output.
        history: T, scans in a stack.

    Raises:
        ArgumentError: no network has that name, or the size of the grid is not a multiple of what it needs.
    """
    if name not in _BUILDERS:
        raise ArgumentError("network", expected=f"one of {', '.join(_BUILDERS)}", found=repr(name))
    if history > 1 and name != "motionsc":
        raise ArgumentError("history", expected=f"1 for {name}", found=str(history), advice="only motionsc takes more")
    network = _BUILDERS[name](num_classes, spec.size[2], history)
    check_size(network, name, spec.size)
    return network


def check_size(network: nn.Module, name: str, size: tuple[int, int, int]) -> None:
    """Raise ArgumentError if `size` is not a multiple of the network's `divisors`."""
    divisors: Any = network.divisors
    if any(cells % divisor for cells, divisor in zip(size, divisors, strict=True)):
        raise ArgumentError(
            name,
            expected=f"a grid of multiples of {' x '.join(map(str, divisors))} cells",
            found=" x ".join(map(str, size)),
        )
