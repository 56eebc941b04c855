"""The interface between the scripts and a network: its inputs from a sample, its loss and its
predictions.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from carlasc import GridSpec
from carlasc.core import class_weights
from completion.losses import completion_loss

Batch = Mapping[str, Any]


def root_weights(counts: NDArray[np.floating | np.integer]) -> NDArray[np.float64]:
    """Return the cube root of the count of the most frequent class divided by the count of each
    class; 0 for classes that do not occur.
    """
    counts = np.asarray(counts, np.float64)
    return np.where(counts > 0, np.cbrt(counts.max() / np.maximum(counts, 1)), 0)


WEIGHTINGS: Mapping[str, Callable[[NDArray[Any]], NDArray[np.float64]]] = {
    "log": class_weights,
    "root": root_weights,
}
"""The class weights of the loss for the number of voxels of each class."""


class Task:
    """The task of a network from occupancy to the logits of all voxels.

    Networks with other tasks have a subclass.

    Attributes:
        fields: fields of a sample that are inputs of the network.
        training_fields: further fields for its loss, besides the labels of the voxels.
        weighting: default weighting of classes in its loss: one of `WEIGHTINGS`.
        fixed_shapes: whether the shapes of its inputs are always the same, so that it can be
            compiled.
    """

    fields: tuple[str, ...] = ("occupancy",)
    training_fields: tuple[str, ...] = ()
    weighting = "log"
    fixed_shapes = True

    def from_scan(self, points: NDArray[np.float32], spec: GridSpec) -> Batch:
        """Return the `fields` of a sample, made from a scan (N, 4) in the sensor's frame."""
        occupancy = np.zeros((1, *spec.size), np.uint8)
        voxels = spec.flat_index(points[:, :3])
        occupancy.reshape(-1)[voxels[voxels >= 0]] = 1
        return {"occupancy": occupancy}

    def example(self, spec: GridSpec, history: int, rng: np.random.Generator) -> Batch:
        """Return the `fields` of a random sample with the density of a scan (1 of 20 voxels), to
        measure times.
        """
        return {"occupancy": (rng.random((history, *spec.size)) < 0.05).astype(np.uint8)}

    def seen(self, sample: Batch, spec: GridSpec) -> NDArray[np.uint8]:
        """Return (X, Y, Z) occupancy of a sample's own scan, for pictures."""
        return sample["occupancy"][-1]

    def prepare(
        self, batch: Batch, device: torch.device, draw: torch.Generator | None = None
    ) -> Batch:
        """Return a batch with the inputs of the network and of its loss, on the device.

        Args:
            batch: the collated samples.
            device: the device of the network.
            draw: random generator of the CPU for augmentations. None does not augment.
        """
        return {**batch} | {"occupancy": batch["occupancy"].to(device, non_blocking=True)}

    def arguments(self, batch: Batch, dtype: torch.dtype = torch.float32) -> tuple[Any, ...]:
        """Return the arguments of the network for a prepared batch; occupancy in the dtype."""
        return (batch["occupancy"].to(dtype),)

    def loss(
        self, outputs: Any, batch: Batch, target: Tensor, class_weights: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Return the S parts of the loss, as `completion_loss` does: (S,) sums and (S,) weights."""
        return completion_loss(outputs, target, class_weights)

    def balance(self, network: nn.Module, parts: Tensor) -> tuple[Tensor, Tensor]:
        """Return (S,) factors of the parts in the loss, and a number to add.

        Here, the loss is the mean of the parts.
        """
        return torch.full_like(parts, 1 / len(parts)), parts.new_zeros(())

    def logits(self, outputs: Any) -> Tensor:
        """Return the (B, X, Y, Z, K) logits from the output of the network in eval mode."""
        logits: Tensor = outputs
        return logits

    def labels(self, outputs: Any) -> Tensor:
        """Return the (B, X, Y, Z) predicted classes from the output of the network in eval mode."""
        return self.logits(outputs).argmax(-1)

    def set_epoch(self, network: nn.Module, epoch: int) -> None:
        """Set the values of the network that depend on the epoch, counted from 0."""


VOXELS = Task()


def task_of(network: nn.Module) -> Task:
    """Return the task of a network from `build_network`; for other networks, the task of occupancy
    grids.
    """
    return getattr(network, "task", VOXELS)
