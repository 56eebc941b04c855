"""A U-Net over the ground plane.

Its input is the visibility of past scans: returns, and voxels that rays passed. It is small, and
fast on a CPU.

Height, time and the two kinds of observation (a ray passed, a ray ended) are channels of 2-D
convolutions, so one pass completes all layers of voxels. The last layer classifies each voxel by
its own features.
"""

from __future__ import annotations

from itertools import pairwise

import torch
from torch import Tensor, nn
from torch.nn.functional import interpolate

WIDTHS = (32, 64, 96, 128)
PASSED, HIT = 1, 2  # values of the field `visibility`
_FEATURES = 16  # of each voxel


def convolutions(inputs: int, outputs: int, stride: int = 1) -> nn.Sequential:
    """Return two 3 x 3 convolutions, the first with the stride, each with batch norm and ReLU."""
    layers: list[nn.Module] = []
    for first, last, step in ((inputs, outputs, stride), (outputs, outputs, 1)):
        layers += [
            nn.Conv2d(first, last, 3, step, 1, bias=False),
            nn.BatchNorm2d(last),
            nn.ReLU(inplace=True),
        ]
    return nn.Sequential(*layers)


class Baseline(nn.Module):
    """The network.

    Args:
        num_classes: K.
        height: Z, cells along z. X and Y must be multiples of 8.
        frames: T, 1 or more.
        widths: number of channels at each scale, each half as large as the one before.
    """

    divisors = (8, 8, 1)  # cells of the grid must be multiples of these

    def __init__(
        self, num_classes: int, height: int, frames: int = 1, widths: tuple[int, ...] = WIDTHS
    ) -> None:
        super().__init__()
        steps = list(pairwise(widths))
        self.seen = convolutions(2 * frames * height, widths[0])
        self.down = nn.ModuleList(convolutions(fine, coarse, stride=2) for fine, coarse in steps)
        self.up = nn.ModuleList(
            convolutions(coarse + fine, fine) for fine, coarse in reversed(steps)
        )
        self.voxels = nn.Conv2d(widths[0], _FEATURES * height, 1)
        self.classes = nn.Linear(_FEATURES, num_classes)

    def forward(self, visibility: Tensor) -> Tensor:
        """Complete the newest of a stack of scans.

        Args:
            visibility: (B, T, X, Y, Z) float32, oldest first: 2 where a scan has a point, 1 where
                only its rays passed, 0 elsewhere.

        Returns:
            (B, X, Y, Z, K) logits.
        """
        layers = visibility.permute(0, 1, 4, 2, 3).flatten(1, 2)
        x = self.seen(torch.cat([layers == PASSED, layers == HIT], dim=1).to(visibility.dtype))
        skips = []
        for stage in self.down:
            skips.append(x)
            x = stage(x)
        for stage in self.up:
            x = stage(torch.cat([interpolate(x, scale_factor=2), skips.pop()], dim=1))
        features = self.voxels(x).unflatten(1, (-1, _FEATURES)).permute(0, 3, 4, 1, 2)
        return self.classes(features.relu())
