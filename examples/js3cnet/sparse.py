"""Sparse 3-D convolutions in plain PyTorch, and the U-Net that JS3C-Net builds of them.

Features exist only at sites: the voxels that hold a point. Sites are sorted by one integer key
each, so that neighbours are found by binary search, and a convolution is one gather, one matrix
product and one `index_add` per kernel offset. There is no dense volume. Rows are gathered by
`index_select`, which on a CPU is several times faster than indexing with brackets. Names, order and
layout of the weights are those of SparseConvNet (B. Graham et al., CVPR 2018), whose checkpoints
load unchanged.
"""

from __future__ import annotations

from functools import cached_property
from typing import NamedTuple

import torch
from torch import Tensor, nn
from torch.nn.functional import batch_norm


class Level:
    """The sites of one resolution, sorted by batch item, x, y and z.

    Attributes:
        cells: (S, 4) int64: batch item, x, y, z of each site; x, y, z >= 0.
        site_of: (N,) int64: the site of each of the cells that the level was made from.
    """

    def __init__(self, cells: Tensor) -> None:
        """Find the sites among (N, 4) int64 `cells`, which may repeat."""
        # a neighbour beyond the border has a key of its own
        self._side = int(cells[:, 1:].max()) + 3 if len(cells) else 3
        self._keys, self.site_of = torch.unique(self._pack(cells), return_inverse=True)
        self.cells = cells.new_empty(len(self._keys), 4).index_copy_(0, self.site_of, cells)

    @cached_property
    def neighbours(self) -> list[tuple[Tensor, Tensor]]:
        """For the first 13 of the 27 offsets of a 3 x 3 x 3 kernel: the (P,) sites s + offset, and
        the (P,) sites s.

        The other offsets are the opposite ones, whose pairs are these in reverse.
        """
        pairs = []
        for k in range(13):
            dx, dy, dz = k // 9 - 1, k // 3 % 3 - 1, k % 3 - 1
            wanted = self._keys + ((dx * self._side) + dy) * self._side + dz
            # an earlier key, so that the index is never beyond the end
            place = torch.searchsorted(self._keys, wanted)
            sites = (self._keys[place] == wanted).nonzero().squeeze(1)
            pairs.append((place[sites], sites))
        return pairs

    @cached_property
    def coarser(self) -> Level:
        """The sites at half the resolution.

        Its `site_of` is the parent of each site of this level.
        """
        halved = self.cells.clone()
        halved[:, 1:] //= 2
        return Level(halved)

    @cached_property
    def children(self) -> list[Tensor]:
        """For each of the 8 offsets of a 2 x 2 x 2 kernel, the sites that have it from their
        parent.
        """
        x, y, z = (self.cells[:, 1:] % 2).unbind(1)
        offsets = 4 * x + 2 * y + z
        return [(offsets == k).nonzero().squeeze(1) for k in range(8)]

    def _pack(self, cells: Tensor) -> Tensor:
        item, x, y, z = cells.unbind(1)
        return ((item * self._side + x + 1) * self._side + y + 1) * self._side + z + 1


class Sites(NamedTuple):
    """Features (S, C) at the sites of the last of `levels`, which are those that led here, the
    finest first.
    """

    features: Tensor
    levels: tuple[Level, ...]


class ToSites(nn.Module):
    """From points to sites: the mean feature of the points that share a cell."""

    def forward(self, points: tuple[Tensor, Tensor]) -> Sites:
        """Take (N, C) float32 features and (N, 4) int64 cells."""
        features, cells = points
        level = Level(cells)
        sums = features.new_zeros(len(level.cells), features.shape[1]).index_add(
            0, level.site_of, features
        )
        counts = torch.bincount(level.site_of, minlength=len(level.cells))
        return Sites(sums / counts.unsqueeze(1), (level,))


class ToPoints(nn.Module):
    """From sites back to the points, in the order in which they were given."""

    def forward(self, sites: Sites) -> Tensor:
        """Return (N, C)."""
        return sites.features.index_select(0, sites.levels[-1].site_of)


class NormReLU(nn.Module):
    """Batch norm over the sites, then ReLU."""

    running_mean: Tensor
    running_var: Tensor

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.weight, self.bias = (
            nn.Parameter(torch.ones(channels)),
            nn.Parameter(torch.zeros(channels)),
        )
        self.register_buffer("running_mean", torch.zeros(channels))
        self.register_buffer("running_var", torch.ones(channels))

    def forward(self, sites: Sites) -> Sites:
        """Return sites of the same level.

        A single site has no variance: the running statistics are used for it.
        """
        training = self.training and len(sites.features) > 1
        own = self.running_mean, self.running_var, self.weight, self.bias
        normed = batch_norm(sites.features, *own, training, momentum=0.1, eps=1e-4)
        return sites._replace(features=normed.relu_())


class Convolution(nn.Module):
    """Weights (offsets, 1, inputs, outputs) of a sparse convolution without bias."""

    volume = 27

    def __init__(self, inputs: int, outputs: int) -> None:
        super().__init__()
        spread = (2 / (inputs * self.volume)) ** 0.5
        self.weight = nn.Parameter(torch.randn(self.volume, 1, inputs, outputs) * spread)

    @property
    def kernels(self) -> Tensor:
        """(offsets, inputs, outputs), the offset along x changing slowest."""
        return self.weight[:, 0]


class SameSites(Convolution):
    """A submanifold convolution, 3 x 3 x 3: sites stay the same, and absent neighbours count as
    zero.
    """

    def forward(self, sites: Sites) -> Sites:
        """Return sites of the same level."""
        kernels, x = self.kernels, sites.features
        out = x @ kernels[13]
        for k, (near, here) in enumerate(sites.levels[-1].neighbours):
            out.index_add_(0, here, x.index_select(0, near) @ kernels[k])
            out.index_add_(0, near, x.index_select(0, here) @ kernels[26 - k])
        return sites._replace(features=out)


class Down(Convolution):
    """A convolution 2 x 2 x 2 of stride 2: a site of the coarser level adds up its children."""

    volume = 8

    def forward(self, sites: Sites) -> Sites:
        """Return sites of the coarser level."""
        level = sites.levels[-1]
        out = sites.features.new_zeros(len(level.coarser.cells), self.weight.shape[-1])
        for kernel, rows in zip(self.kernels, level.children, strict=True):
            terms = sites.features.index_select(0, rows) @ kernel
            out.index_add_(0, level.coarser.site_of[rows], terms.to(out.dtype))
        return Sites(out, (*sites.levels, level.coarser))


class Up(Convolution):
    """The inverse of `Down`: from the coarser sites to the sites before it, one term per site."""

    volume = 8

    def forward(self, sites: Sites) -> Sites:
        """Return sites of the level before."""
        level = sites.levels[-2]
        out = sites.features.new_zeros(len(level.cells), self.weight.shape[-1])
        for kernel, rows in zip(self.kernels, level.children, strict=True):
            terms = sites.features.index_select(0, level.coarser.site_of[rows]) @ kernel
            out.index_add_(0, rows, terms.to(out.dtype))
        return Sites(out, sites.levels[:-1])


class PerSite(nn.Module):
    """A matrix product per site: a convolution 1 x 1 x 1."""

    def __init__(self, inputs: int, outputs: int) -> None:
        super().__init__()
        self.weight = nn.Parameter(torch.randn(inputs, outputs) * (2 / inputs) ** 0.5)

    def forward(self, sites: Sites) -> Sites:
        """Return sites of the same level."""
        return sites._replace(features=sites.features @ self.weight)


class Table(nn.ModuleList):
    """The outputs of several modules for the same sites."""

    def forward(self, sites: Sites) -> list[Sites]:
        """Return a list of sites of the same level."""
        return [module(sites) for module in self]


class Add(nn.Module):
    """The sum of the features of a table."""

    def forward(self, table: list[Sites]) -> Sites:
        """Return sites of the same level."""
        return table[0]._replace(features=table[0].features + table[1].features)


class Join(nn.Module):
    """The features of a table behind one another."""

    def forward(self, table: list[Sites]) -> Sites:
        """Return sites of the same level."""
        return table[0]._replace(features=torch.cat([sites.features for sites in table], 1))


def block(inputs: int, outputs: int, residual: bool) -> list[nn.Module]:
    """Return the modules of a block: norm, ReLU, convolution; residual: twice, and a shortcut
    around both.
    """
    once = [NormReLU(inputs), SameSites(inputs, outputs)]
    if not residual:
        return [nn.Sequential(*once)]
    shortcut = nn.Identity() if inputs == outputs else PerSite(inputs, outputs)
    return [
        Table([shortcut, nn.Sequential(*once, NormReLU(outputs), SameSites(outputs, outputs))]),
        Add(),
    ]


def unet(widths: tuple[int, ...], residual: bool) -> nn.Sequential:
    """Return the U-Net whose levels have these widths, the finest first.

    Its order makes the names of SparseConvNet's weights.
    """
    width, *deeper = widths
    if not deeper:
        return nn.Sequential(*block(width, width, residual))
    below = nn.Sequential(
        NormReLU(width),
        Down(width, deeper[0]),
        unet(tuple(deeper), residual),
        NormReLU(deeper[0]),
        Up(deeper[0], width),
    )
    return nn.Sequential(
        *block(width, width, residual),
        Table([nn.Identity(), below]),
        Join(),
        *block(2 * width, width, residual),
    )
