"""What the scripts must know of a network: what it takes of a sample, how its loss is measured, what it predicts."""

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
    """Return the cube root of how many times rarer each class is than the most frequent one; 0 for classes that never occur."""
    counts = np.asarray(counts, np.float64)
    return np.where(counts > 0, np.cbrt(counts.max() / np.maximum(counts, 1)), 0)


WEIGHTINGS: Mapping[str, Callable[[NDArray[Any]], NDArray[np.float64]]] = {"log": class_weights, "root": root_weights}
"""The class weights of the loss for the number of voxels of each class."""


class Task:
    """The task of a network that takes occupancy to the logits of all voxels. A network that does something else has a subclass.

    Attributes:
        fields: fields of a sample that the network takes.
        training_fields: more fields, which only its loss takes, beside the labels of the voxels.
        weighting: how much more a rare class weighs in its loss, if the settings do not say: one of `WEIGHTINGS`.
        fixed_shapes: whether the shapes of its inputs are always the same, so that it can be compiled.
    """

    fields: tuple[str, ...] = ("occupancy",)
    training_fields: tuple[str, ...] = ()
    weighting = "log"
    fixed_shapes = True

    def from_scan(self, points: NDArray[np.float32], spec: GridSpec) -> Batch:
        """Return the `fields` of a sample, made of a scan (N, 4) in the sensor's frame alone."""
        occupancy = np.zeros((1, *spec.size), np.uint8)
        voxels = spec.flat_index(points[:, :3])
        occupancy.reshape(-1)[voxels[voxels >= 0]] = 1
        return {"occupancy": occupancy}

    def example(self, spec: GridSpec, history: int, rng: np.random.Generator) -> Batch:
        """Return the `fields` of a made-up sample, to measure times: as dense as a scan is, 1 voxel in 20."""
        return {"occupancy": (rng.random((history, *spec.size)) < 0.05).astype(np.uint8)}

    def seen(self, sample: Batch, spec: GridSpec) -> NDArray[np.uint8]:
        """Return (X, Y, Z) occupancy of a sample's own scan, for pictures."""
        return sample["occupancy"][-1]

    def prepare(self, batch: Batch, device: torch.device, draw: torch.Generator | None = None) -> Batch:
        """Return a batch with what the network and its loss take, on the device.

        Args:
            batch: the collated samples.
            device: the device of the network.
            draw: random generator of the CPU for augmentations. None does not augment.
        """
        return {**batch} | {"occupancy": batch["occupancy"].to(device, non_blocking=True)}

    def arguments(self, batch: Batch, dtype: torch.dtype = torch.float32) -> tuple[Any, ...]:
        """Return the arguments of the network for a prepared batch; occupancy in the dtype."""
        return (batch["occupancy"].to(dtype),)

    def loss(self, outputs: Any, batch: Batch, target: Tensor, class_weights: Tensor) -> tuple[Tensor, Tensor]:
        """Return the S parts of the loss, as `completion_loss` does: (S,) sums and (S,) weights."""
        return completion_loss(outputs, target, class_weights)

    def balance(self, network: nn.Module, parts: Tensor) -> tuple[Tensor, Tensor]:
        """Return how the parts make the loss: (S,) factors, and a number to add. Here the loss is the mean of the parts."""
        return torch.full_like(parts, 1 / len(parts)), parts.new_zeros(())

    def logits(self, outputs: Any) -> Tensor:
        """Return the (B, X, Y, Z, K) logits from what the network returns when it is not training."""
        logits: Tensor = outputs
        return logits

    def labels(self, outputs: Any) -> Tensor:
        """Return the (B, X, Y, Z) predicted classes from what the network returns when it is not training."""
        return self.logits(outputs).argmax(-1)

    def set_epoch(self, network: nn.Module, epoch: int) -> None:
        """Change what the network changes from epoch to epoch, counted from 0."""


VOXELS = Task()


def task_of(network: nn.Module) -> Task:
    """Return the task that `build_network` noted in a network; that of occupancy grids for all others."""
    return getattr(network, "task", VOXELS)
