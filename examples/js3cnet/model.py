"""JS3C-Net: a sparse U-Net labels the points, a dense network completes the scene from their
logits, and nearby points refine each voxel.

X. Yan et al.: Sparse Single Sweep LiDAR Point Cloud Segmentation via Learning Contextual Shape
Priors from Scene Completion, AAAI 2021.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal, NamedTuple

import torch
from torch import Tensor, nn
from torch.nn.functional import leaky_relu, linear, pad

from carlasc import GridSpec
from carlasc.errors import ArgumentError, import_extra
from js3cnet.sparse import NormReLU, SameSites, ToPoints, ToSites, unet

Search = Literal["tree", "topk"]

WIDTH = 16  # of the U-Net's finest level, and of the points' shape features
LEVELS = 7
POINTS_PER_CELL = 5  # that a cell's feature is the mean of
NEIGHBOURS = 8


class Prediction(NamedTuple):
    """The output: (N, K - 1) logits of all points, scan after scan, and (B, X, Y, Z, K) logits of
    the voxels.
    """

    points: Tensor
    voxels: Tensor


class Unit(nn.Module):
    """A matrix product per row without bias, batch norm, leaky ReLU."""

    def __init__(self, name: str, layer: nn.Linear | nn.Conv1d) -> None:
        super().__init__()
        self.add_module(name, layer)
        nn.init.kaiming_normal_(layer.weight)
        self.bn = nn.ModuleDict({"bn": nn.BatchNorm1d(len(layer.weight))})
        self._weight = f"{name}.weight"

    def forward(self, rows: Tensor) -> Tensor:
        """Take (N, C) to (N, D)."""
        return leaky_relu(
            self.bn["bn"](linear(rows, self.get_parameter(self._weight).flatten(1))), 0.2
        )


class SegmentationHead(nn.Module):
    """From points to their logits and their shape features."""

    def __init__(self, num_classes: int, inputs: int, residual: bool) -> None:
        super().__init__()
        widths = tuple(WIDTH * (level + 1) for level in range(LEVELS))
        self.sparseModel = nn.Sequential(
            ToSites(), SameSites(inputs, WIDTH), unet(widths, residual), NormReLU(WIDTH), ToPoints()
        )
        self.shape_embedding = Unit("conv", nn.Conv1d(WIDTH, WIDTH, 1, bias=False))
        self.linear = nn.Linear(WIDTH, num_classes)

    def forward(self, features: Tensor, cells: Tensor) -> tuple[Tensor, Tensor]:
        """Take (N, inputs) features and (N, 4) int64 cells (item, x, y, z) to (N, K - 1) logits and
        (N, 16) shape features.
        """
        x = self.sparseModel((features, cells))
        shape = self.shape_embedding(x)
        return self.linear(x + shape), shape


def pool(features: Tensor, cells: Tensor, size: tuple[int, int, int, int]) -> Tensor:
    """Return a dense volume of the points' features: zeros, and the mean over five slots where a
    cell has points.

    The slots hold the first five points of the cell in order; remaining slots hold the first point
    again.

    Args:
        features: (N, C).
        cells: (N,) int64, flat index of each point's cell.
        size: number of batch items and of cells along x, y and z.

    Returns:
        (B, C, X, Y, Z).
    """
    ordered, points = cells.sort(stable=True)
    _, counts = torch.unique_consecutive(ordered, return_counts=True)
    rank = torch.arange(len(cells), device=cells.device) - (
        counts.cumsum(0) - counts
    ).repeat_interleave(counts)
    empty = (POINTS_PER_CELL - counts).clamp_min(0).repeat_interleave(counts)
    slots = torch.where(rank == 0, 1 + empty, 1)
    kept = rank < POINTS_PER_CELL
    rows = features[points[kept]] * (slots[kept] / POINTS_PER_CELL).unsqueeze(1).to(features.dtype)
    batch, x, y, z = size
    volume = features.new_zeros(batch * x * y * z, features.shape[1]).index_add(
        0, ordered[kept], rows
    )
    return volume.reshape(batch, x, y, z, -1).permute(0, 4, 1, 2, 3)


def convolution(
    inputs: int, outputs: int, kernel: int = 3, stride: int = 1, dilation: int = 1
) -> nn.Sequential:
    """Return a dense convolution with batch norm and ReLU."""
    padding = kernel // 2 * dilation
    layer = nn.Conv3d(inputs, outputs, kernel, stride, padding, dilation)
    return nn.Sequential(layer, nn.BatchNorm3d(outputs), nn.ReLU())


class Decoder(nn.Module):
    """From a dense volume (B, F, X, Y, Z) to coarse logits (B, K, X / 2, Y / 2, Z / 2)."""

    def __init__(self, inputs: int, num_classes: int, width: int = 32) -> None:
        super().__init__()
        self.b1_conv1 = convolution(inputs, 16, kernel=7, stride=2)
        self.b1_conv2, self.b1_conv3, self.b1_res = (convolution(c, width) for c in (16, width, 16))
        self.b2_conv1, self.b2_conv2, self.b2_res = (convolution(width, width) for _ in range(3))
        self.b3_conv1, self.b3_conv2 = (convolution(width, width) for _ in range(2))
        self.b4_conv1, self.b4_conv2 = (convolution(width, width, dilation=2) for _ in range(2))
        self.b5_conv1, self.b5_conv2 = (convolution(width, width, dilation=2) for _ in range(2))
        self.pre_conv1 = convolution(3 * width, 2 * width, kernel=1)
        self.pre_conv2 = nn.Sequential(nn.Conv3d(2 * width, num_classes, 1))

    def forward(self, volume: Tensor) -> Tensor:
        """Return the coarse logits."""
        x = self.b1_conv1(volume)
        x = self.b1_conv3(self.b1_conv2(x)) + self.b1_res(x)
        x = self.b2_conv2(self.b2_conv1(x)) + self.b2_res(x)
        x = self.b3_conv1(x)
        x3 = x + self.b3_conv2(x)
        x = self.b4_conv1(x3)
        x4 = x + self.b4_conv2(x)
        x = self.b5_conv1(x4)
        x5 = x + self.b5_conv2(x)
        return self.pre_conv2(self.pre_conv1(torch.cat([x3, x4, x5], 1)))


def nearest(supports: Tensor, queries: Tensor, search: Search) -> Tensor:
    """Return the (Q, 8) int64 nearest supports of each query, the nearest first, for whole-numbered
    positions (S, 3) and (Q, 3).

    "topk" takes the lower index if two are equally near. "tree" takes either, and is many times
    faster on a CPU. If there are fewer than eight supports, the first one is repeated. It also
    replaces index 0, which the reference implementation treats as empty.
    """
    count = min(NEIGHBOURS, len(supports))
    if search == "tree":
        tree = import_extra("scipy.spatial", "kitti").cKDTree(supports.cpu().numpy())
        indices = tree.query(queries.cpu().numpy(), range(1, count + 1))[1]
        found = torch.from_numpy(indices).to(queries.device)
    else:
        places, own = torch.arange(len(supports), device=queries.device), supports.double()
        parts = []
        # 128 MiB of distances at a time
        for part in torch.split(queries.double(), max(1, 2**24 // len(supports))):
            squared = (part**2).sum(1, keepdim=True) + (own**2).sum(1) - 2 * part @ own.T
            parts.append((squared * len(supports) + places).topk(count, largest=False).indices)
        found = torch.cat(parts)
    found = torch.cat([found, found[:, :1].expand(-1, NEIGHBOURS - count)], 1)
    return torch.where(found == 0, found[:, :1], found)


class Interaction(nn.Module):
    """Refines the logits of each coarse voxel with the shape features of the occupied voxels
    nearest to it.
    """

    lower: Tensor  # (3,) float32, the corner of the grid
    voxel: Tensor  # (3,) float32, the widths of a voxel

    def __init__(self, num_classes: int, spec: GridSpec, exact: bool, search: Search) -> None:
        super().__init__()
        self.relation_w = Unit("conv", nn.Conv1d(10, WIDTH, 1, bias=False))
        self.fuse_mlps = Unit("fc", nn.Linear(WIDTH + num_classes, num_classes, bias=False))
        self.exact = exact
        self.search: Search = search
        lower, voxel = _geometry(spec)
        self.register_buffer("lower", lower.float(), persistent=False)
        self.register_buffer("voxel", voxel.float(), persistent=False)

    def forward(self, coarse: Tensor, shape: Tensor) -> Tensor:
        """Take (B, K, x, y, z) coarse logits and a (B, 16, X, Y, Z) volume of shape features to
        fused coarse logits.
        """
        cells = torch.cartesian_prod(
            *(torch.arange(n, device=coarse.device) for n in coarse.shape[2:])
        )
        near = coarse.new_zeros(len(coarse), len(cells), WIDTH)
        found = {
            item: self._relate(cells, volume)
            for item, volume in enumerate(shape.detach())
            if volume.any()
        }
        if found:  # otherwise, no point is inside the grid
            relations, features = (
                torch.stack(parts) for parts in zip(*found.values(), strict=True)
            )
            weights = self.relation_w(relations.flatten(0, 2)).reshape(features.shape)
            near = near.index_copy(
                0,
                torch.tensor(list(found), device=near.device),
                (features * weights).mean(2).to(near.dtype),
            )
        rows = torch.cat([near, coarse.flatten(2).transpose(1, 2)], 2).flatten(0, 1)
        return (
            self.fuse_mlps(rows)
            .reshape(len(coarse), len(cells), -1)
            .transpose(1, 2)
            .reshape(coarse.shape)
        )

    def _relate(self, cells: Tensor, volume: Tensor) -> tuple[Tensor, Tensor]:
        """Return (Q, 8, 10) positions of the neighbours of each coarse cell, and (Q, 8, 16) their
        features, for one item.
        """
        supports = volume.any(0).nonzero()
        here, there = self._centres(cells, 2), self._centres(supports, 1)
        if self.exact:  # in units of half a voxel
            found = nearest(2 * supports + 1, 4 * cells + 2, self.search)
        else:
            found = nearest(there, here, self.search)
        p, q = there[found], here.unsqueeze(1).expand(-1, NEIGHBOURS, -1)
        relation = torch.cat([p - q, q, p, (p - q).norm(dim=2, keepdim=True)], 2)
        return relation, volume[:, supports[:, 0], supports[:, 1], supports[:, 2]].T[found]

    def _centres(self, cells: Tensor, step: int) -> Tensor:
        """Return the centres of cells that are `step` voxels wide, in metres; without `exact`, in
        whole metres, as in the reference implementation.
        """
        centres = (cells + 0.5) * (step * self.voxel) + self.lower
        return centres if self.exact else centres.trunc()


class CompletionHead(nn.Module):
    """From a dense volume of point features to the logits of all voxels."""

    def __init__(
        self, inputs: int, num_classes: int, spec: GridSpec, exact: bool, search: Search
    ) -> None:
        super().__init__()
        self.Decoder = Decoder(inputs, num_classes)
        self.interaction_module = Interaction(num_classes, spec, exact, search)
        self.upsample = nn.Sequential(
            nn.Conv3d(num_classes, 8 * num_classes, 1), nn.BatchNorm3d(8 * num_classes)
        )

    def forward(self, volume: Tensor) -> Tensor:
        """Take (B, F, X, Y, Z), the last 16 of F the shape features, to (B, X, Y, Z, K) logits,
        which are 0 or more.
        """
        fused = self.interaction_module(self.Decoder(volume), volume[:, -WIDTH:])
        parts = self.upsample(fused).relu().unflatten(1, (-1, 2, 2, 2))  # (B, K, a, b, d, x, y, z)
        return parts.permute(0, 5, 2, 6, 3, 7, 4, 1).reshape(len(volume), *volume.shape[2:], -1)


class JS3CNet(nn.Module):
    """JS3C-Net for a grid.

    Args:
        num_classes: K, classes of the voxels. 0 is free; the classes of points are the others.
        spec: the Cartesian grid to complete. X, Y and Z must be even.
        channels: columns of a point (x, y, z in metres, and a fourth) that are its features.
        residual: use residual blocks in the U-Net.
        exact: search neighbours by their true distance. The reference implementation truncates all
            positions to whole metres.
        search: how neighbours are searched: "tree" (needs SciPy) or "topk".
    """

    divisors = (2, 2, 2)  # cells of the grid must be multiples of these

    def __init__(
        self,
        num_classes: int,
        spec: GridSpec,
        *,
        channels: Sequence[int] = (0, 1, 2, 3),
        residual: bool = False,
        exact: bool = False,
        search: Search = "tree",
    ) -> None:
        super().__init__()
        if spec.coordinates != "cartesian":
            raise ArgumentError(
                "grid", expected="a Cartesian one for JS3C-Net", found=spec.coordinates
            )
        self.spec, self.channels = spec, list(channels)
        self.seg_head = SegmentationHead(num_classes - 1, len(channels), residual)
        self.complet_head = CompletionHead(
            num_classes - 1 + WIDTH, num_classes, spec, exact, search
        )
        self.seg_sigma, self.complet_sigma = (
            nn.Parameter(torch.empty(1).uniform_(0.2, 1)) for _ in range(2)
        )
        # Weights of the published files that the network does not use.
        self.voxelpool = nn.ModuleDict({"relation_w": nn.Conv1d(10, WIDTH, 1)}).requires_grad_(
            False
        )

    def forward(self, points: Sequence[Tensor], cells: Sequence[Tensor]) -> Prediction:
        """Label points and complete scans.

        Args:
            points: (N_i, 4) float32 of each scan, sensor frame, metres; the fourth column is used
                by some configurations.
            cells: (N_i, 3) int64, the U-Net's cell of each point, 0 or more (see
                `js3cnet.task.site_cells`).
        """
        logits, shape = self.segment(points, cells)
        places = [self._places(scan[:, :3]) for scan in points]
        flat = torch.cat(
            [
                place + item * self.spec.num_voxels * (place >= 0)
                for item, place in enumerate(places)
            ]
        )
        inside = flat >= 0
        volume = pool(
            torch.cat([logits, shape], 1)[inside], flat[inside], (len(points), *self.spec.size)
        )
        return Prediction(logits, self.complet_head(volume))

    def segment(self, points: Sequence[Tensor], cells: Sequence[Tensor]) -> tuple[Tensor, Tensor]:
        """Return (N, K - 1) logits and (N, 16) shape features of the points, scan after scan."""
        keyed = [pad(scan, (1, 0), value=item) for item, scan in enumerate(cells)]
        return self.seg_head(torch.cat(list(points))[:, self.channels], torch.cat(keyed))

    def _places(self, xyz: Tensor) -> Tensor:
        """Return the flat index of each point's voxel, -1 outside.

        The reference divides in float64, by bounds in float32.
        """
        lower, voxel = (value.to(xyz.device) for value in _geometry(self.spec))
        size = torch.tensor(self.spec.size, device=xyz.device)
        grid = ((xyz.double() - lower) / voxel).floor().long()
        x, y, z = grid.unbind(1)
        return torch.where(
            ((grid >= 0) & (grid < size)).all(1), (x * size[1] + y) * size[2] + z, -1
        )


def _geometry(spec: GridSpec) -> tuple[Tensor, Tensor]:
    """Return the lower corner and the widths of a voxel, rounded to float32, as float64."""
    lower, upper = (torch.tensor(bound, dtype=torch.float64) for bound in (spec.lower, spec.upper))
    return lower.float().double(), ((upper - lower) / torch.tensor(spec.size)).float().double()
