"""The input of the network: for each scan of a stack, voxels where rays ended, voxels that rays
passed, and voxels without rays.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from completion.tasks import Batch, Task
from numpy.typing import NDArray

from baseline.model import HIT, PASSED
from carlasc import GridSpec
from carlasc.dataset.visibility import stack_visibility


class Seen(Task):
    """The task of a network that takes `visibility`.

    Args:
        rays: whether the input contains the voxels that rays passed. Otherwise it is occupancy
            only, to measure the effect of rays.
    """

    weighting = "root"

    def __init__(self, *, rays: bool = True) -> None:
        self.fields = ("visibility",) if rays else ("occupancy",)

    def from_scan(self, points: NDArray[np.float32], spec: GridSpec) -> Batch:
        """Return the visibility of a scan (N, 4) in the sensor's frame."""
        if "occupancy" in self.fields:
            return super().from_scan(points, spec)
        return {"visibility": stack_visibility([points], np.eye(4)[None], spec)}

    def example(self, spec: GridSpec, history: int, rng: np.random.Generator) -> Batch:
        """Return a random sample with the density of a scan: returns in 1 of 20 voxels, and passing
        rays in 2 of 5.
        """
        if "occupancy" in self.fields:
            return super().example(spec, history, rng)
        draw = rng.random((history, *spec.size))
        return {
            "visibility": np.where(draw < 0.05, HIT, np.where(draw < 0.45, PASSED, 0)).astype(
                np.uint8
            )
        }

    def seen(self, sample: Batch, spec: GridSpec) -> NDArray[np.uint8]:
        """Return (X, Y, Z) occupancy of a sample's own scan, for pictures."""
        if "occupancy" in self.fields:
            return super().seen(sample, spec)
        return (sample["visibility"][-1] == HIT).astype(np.uint8)

    def prepare(
        self, batch: Batch, device: torch.device, draw: torch.Generator | None = None
    ) -> Batch:
        """Return the batch on the device."""
        (name,) = self.fields
        return {**batch} | {name: batch[name].to(device, non_blocking=True)}

    def arguments(self, batch: Batch, dtype: torch.dtype = torch.float32) -> tuple[Any, ...]:
        """Return the stack."""
        return (
            (HIT * batch["occupancy"] if "occupancy" in self.fields else batch["visibility"]).to(
                dtype
            ),
        )
