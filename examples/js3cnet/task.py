"""The task of JS3C-Net: it predicts points and voxels, with learned weights of the two losses."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from completion.losses import completion_loss
from completion.tasks import VOXELS, Batch, Task
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn.functional import cross_entropy, pad

from carlasc import GridSpec
from carlasc.errors import ArgumentError
from js3cnet.model import Prediction


class PointsAndVoxels(Task):
    """The task of JS3C-Net.

    Args:
        voxel_m: width of the cells of the U-Net.
        extent: number of its cells per axis. Points beyond are left out.
        remission: whether the network needs the remission of each point.
    """

    training_fields = ("point_labels",)
    weighting = "root"
    fixed_shapes = False

    def __init__(
        self, voxel_m: float = 0.1, extent: int = 2048, *, remission: bool = False
    ) -> None:
        self.fields = ("points", "remission") if remission else ("points",)
        self.voxel_m = voxel_m
        self.extent = extent

    def from_scan(self, points: NDArray[np.float32], spec: GridSpec) -> Batch:
        """Return the scan."""
        columns = {"points": points[:, :3], "remission": points[:, 3]}
        return {name: np.array(columns[name], np.float32, order="C") for name in self.fields}

    def example(self, spec: GridSpec, history: int, rng: np.random.Generator) -> Batch:
        """Return a scan of 120,000 points: 64 beams in a street with houses on both sides, with
        noise of 2 cm.
        """
        azimuth = np.tile(np.linspace(-np.pi, np.pi, 1875, endpoint=False), 64)
        elevation = np.repeat(np.radians(np.linspace(-24.8, 2.0, 64)), 1875)
        rays = np.stack([np.cos(azimuth), np.sin(azimuth), np.tan(elevation)], 1)
        # distance of the fronts of houses from the sensor
        side_m = 9 + 3 * (np.floor(8 * azimuth / np.pi) % 3)
        with np.errstate(divide="ignore"):
            reach = np.minimum(side_m / np.abs(rays[:, 1]), 45)
            ground = np.where(rays[:, 2] < 0, -1.8 / rays[:, 2], np.inf)
        points = rays * np.minimum(reach, ground)[:, None] + rng.normal(0, 0.02, rays.shape)
        remission = rng.random((len(points), 1))
        return self.from_scan(np.concatenate([points, remission], 1).astype(np.float32), spec)

    def seen(self, sample: Batch, spec: GridSpec) -> NDArray[np.uint8]:
        """Return (X, Y, Z) occupancy of a sample's scan, for pictures."""
        return VOXELS.from_scan(sample["points"], spec)["occupancy"][0]

    def prepare(
        self, batch: Batch, device: torch.device, draw: torch.Generator | None = None
    ) -> Batch:
        """Add the U-Net's `cells`, and leave points beyond them out.

        Raises:
            ArgumentError: a scan has no points, or values that are not finite, or no remission if
                it needs one; names the frame.
        """
        prepared = {**batch} | {"points": [], "cells": [], "point_labels": []}
        for i, xyz in enumerate(batch["points"]):
            scan = pad(xyz, (0, 1))
            if "remission" in self.fields:
                scan[:, 3] = batch["remission"][i]
            self._check(
                scan,
                f"{batch['sequence'][i]} {int(batch['frame'][i])}: points"
                if "frame" in batch
                else "points",
            )
            cells, within = site_cells(xyz, self.voxel_m, self.extent, draw)
            prepared["points"].append(scan[within].to(device))
            prepared["cells"].append(cells[within].to(device))
            if "point_labels" in batch:
                prepared["point_labels"].append(batch["point_labels"][i][within].to(device))
        return prepared

    def _check(self, scan: Tensor, where: str) -> None:
        if not len(scan):
            raise ArgumentError(
                where, expected="one point or more", found="none", advice="leave the frame out"
            )
        if wrong := int((~torch.isfinite(scan)).any(1).sum()):
            raise ArgumentError(
                where, expected="finite values", found=f"{wrong} points with others"
            )
        if "remission" in self.fields and not scan[:, 3].any():
            raise ArgumentError(
                where,
                expected="their remission in the fourth column, as in KITTI",
                found="zeros",
                advice="use js3cnet",
            )

    def arguments(self, batch: Batch, dtype: torch.dtype = torch.float32) -> tuple[Any, ...]:
        """Return points and cells."""
        return batch["points"], batch["cells"]

    def loss(
        self, outputs: Prediction, batch: Batch, target: Tensor, class_weights: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Return the parts for the points and for the voxels.

        Points of class 0, which means free for voxels, are left out.
        """
        labels, weights = torch.cat(batch["point_labels"]).long() - 1, class_weights[1:]
        points = cross_entropy(
            outputs.points.float(), labels, weights, ignore_index=-1, reduction="sum"
        )
        voxels, counted = completion_loss(outputs.voxels, target, class_weights)
        return torch.cat([points[None], voxels]), torch.cat(
            [weights[labels[labels >= 0]].sum()[None], counted]
        )

    def balance(self, network: nn.Module, parts: Tensor) -> tuple[Tensor, Tensor]:
        """Return 1 / s^2 of both parts, and the sum of 2 ln s: a larger s reduces the weight of its
        part.
        """
        variances = (
            torch.cat([network.get_parameter("seg_sigma"), network.get_parameter("complet_sigma")])
            ** 2
        )
        return 1 / variances, variances.log().sum()

    def logits(self, outputs: Prediction) -> Tensor:
        """Return the logits of the voxels."""
        return outputs.voxels

    def set_epoch(self, network: nn.Module, epoch: int) -> None:
        """Set the momentum of the norms of points and neighbours, which falls every ten epochs."""
        for module in network.modules():
            # The norms of the U-Net and of the decoder are of other types, and keep their momentum.
            if isinstance(module, nn.BatchNorm1d):
                module.momentum = max(0.5 * 0.5 ** (epoch // 10), 0.01)


def site_cells(
    xyz: Tensor, voxel_m: float, extent: int, draw: torch.Generator | None = None
) -> tuple[Tensor, Tensor]:
    """Return the U-Net's (N, 3) int64 cell of each of (N, 3) points, and (N,) which of them are
    within its extent.

    With a generator the scan is sheared, mirrored, turned and moved at random, as the authors do
    for training. Without one it is only moved to the corner of the grid.
    """
    if draw is None:
        moved, room = xyz / voxel_m, torch.zeros(3)
    else:
        matrix = torch.eye(3) + 0.1 * torch.randn(3, 3, generator=draw)
        matrix[0, 0] *= 2 * torch.randint(2, (), generator=draw) - 1
        angle = 2 * torch.pi * torch.rand((), generator=draw)
        turn = torch.eye(3)
        turn[0, 0] = turn[1, 1] = angle.cos()
        turn[0, 1], turn[1, 0] = angle.sin(), -angle.sin()
        moved = (xyz - xyz.mean(0)) @ (matrix / voxel_m @ turn)
        room = (extent - 1 - (moved.amax(0) - moved.amin(0))).clamp_min(0) * torch.rand(
            3, generator=draw
        )
    cells = (moved - moved.amin(0) + room).long()
    return cells, (cells < extent).all(1)
