"""Networks by name, for a number of classes and a grid."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

from baseline.model import Baseline
from baseline.task import Seen
from js3cnet.model import JS3CNet
from js3cnet.task import PointsAndVoxels
from lmscnet.model import LMSCNet
from motionsc.model import MotionSC
from sscnet.model import SSCNet
from torch import nn

from carlasc import GridSpec
from carlasc.errors import ArgumentError
from completion.tasks import VOXELS, Task


@dataclass(frozen=True)
class Kind:
    """A kind of network.

    Attributes:
        build: makes a network for K classes, a grid and T scans.
        task: its inputs, its loss and its predictions.
        history: whether T may be more than 1.
    """

    build: Callable[[int, GridSpec, int], nn.Module]
    task: Task = VOXELS
    history: bool = False


KINDS: Mapping[str, Kind] = {
    "motionsc": Kind(
        lambda classes, spec, frames: MotionSC(classes, spec.size[2], frames), history=True
    ),
    "lmscnet_ss": Kind(lambda classes, spec, _: LMSCNet(classes, spec.size[2])),
    "lmscnet": Kind(lambda classes, spec, _: LMSCNet(classes, spec.size[2], multiscale=True)),
    "sscnet": Kind(lambda classes, _spec, _frames: SSCNet(classes)),
    "sscnet_full": Kind(lambda classes, _spec, _frames: SSCNet(classes, full=True)),
    "js3cnet": Kind(lambda classes, spec, _: JS3CNet(classes, spec), PointsAndVoxels()),
    "js3cnet_exact": Kind(
        lambda classes, spec, _: JS3CNet(classes, spec, exact=True), PointsAndVoxels()
    ),
    "js3cnet_kitti": Kind(
        lambda classes, spec, _: JS3CNet(classes, spec, channels=(3,), residual=True),
        PointsAndVoxels(voxel_m=0.05, extent=4096, remission=True),
    ),
    "baseline": Kind(
        lambda classes, spec, frames: Baseline(classes, spec.size[2], frames), Seen(), history=True
    ),
    "baseline_hits": Kind(
        lambda classes, spec, frames: Baseline(classes, spec.size[2], frames),
        Seen(rays=False),
        history=True,
    ),
}


def build_network(name: str, num_classes: int, spec: GridSpec, history: int = 1) -> nn.Module:
    """Build a network for a grid. Its task is in its attribute `task`.

    Args:
        name: one of `completion.config.NETWORKS`.
        num_classes: K.
        spec: the grid of its input and output.
        history: T, scans in a stack.

    Raises:
        ArgumentError: the name is unknown, or the size of the grid is not a multiple of the
            network's divisors.
    """
    if name not in KINDS:
        raise ArgumentError("network", expected=f"one of {', '.join(KINDS)}", found=repr(name))
    kind = KINDS[name]
    if history > 1 and not kind.history:
        stacked = ", ".join(other for other, its in KINDS.items() if its.history)
        raise ArgumentError(
            "history",
            expected=f"1 for {name}",
            found=str(history),
            advice=f"only {stacked} take more",
        )
    network = kind.build(num_classes, spec, history)
    check_size(network, name, spec.size)
    network.task = kind.task  # type: ignore[assignment]
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
