"""SSCNet: 3-D convolutions with dilation at a quarter of the scale, and SSCNet-full, which learns
the upsampling.

S. Song et al.: Semantic Scene Completion from a Single Depth Image, CVPR 2017. SSCNet-full as in
LMSCNet's paper.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn.functional import interpolate, max_pool3d


class SSCNet(nn.Module):
    """SSCNet, or SSCNet-full.

    Args:
        num_classes: K. X, Y and Z must be multiples of 4.
        full: upsample by a transposed convolution (SSCNet-full) rather than to the nearest coarse
            voxel.
    """

    divisors = (4, 4, 4)  # cells of the grid must be multiples of these

    def __init__(self, num_classes: int, *, full: bool = False) -> None:
        super().__init__()

        def convolution(inputs: int, outputs: int, dilation: int = 1) -> nn.Conv3d:
            return nn.Conv3d(inputs, outputs, 3, padding=dilation, dilation=dilation)

        self.conv1_1 = nn.Conv3d(1, 16, 7, stride=2, padding=3)

        self.reduction2_1 = nn.Conv3d(16, 32, 1)
        self.conv2_1, self.conv2_2 = convolution(16, 32), convolution(32, 32)

        self.reduction3_1 = nn.Conv3d(64, 64, 1)
        self.conv3_1, self.conv3_2 = convolution(32, 64), convolution(64, 64)

        self.conv3_3, self.conv3_4 = convolution(64, 64), convolution(64, 64)
        self.conv3_5, self.conv3_6 = (
            convolution(64, 64, dilation=2),
            convolution(64, 64, dilation=2),
        )
        self.conv3_7, self.conv3_8 = (
            convolution(64, 64, dilation=2),
            convolution(64, 64, dilation=2),
        )

        self.conv4_1, self.conv4_2 = nn.Conv3d(192, 128, 1), nn.Conv3d(128, 128, 1)
        if full:
            self.deconv_classes = nn.ConvTranspose3d(128, num_classes, 4, stride=4)
        else:
            self.conv_classes = nn.Conv3d(128, num_classes, 1)
        self.full = full

    def forward(self, occupancy: Tensor) -> Tensor:
        """Complete a scan.

        Args:
            occupancy: (B, 1, X, Y, Z) float32, 1 where the scan has a point.

        Returns:
            (B, X, Y, Z, K) logits.
        """
        x = self.conv1_1(occupancy.permute(0, 1, 4, 2, 3)).relu()

        x = self.reduction2_1(x) + self.conv2_2(self.conv2_1(x).relu())
        x = max_pool3d(x.relu(), 2)

        x = self.conv3_1(x).relu()
        x1 = (self.reduction3_1(x) + self.conv3_2(x)).relu()

        x2 = _context(self.conv3_3, self.conv3_4, x1)
        x3 = _context(self.conv3_5, self.conv3_6, x2)
        x4 = _context(self.conv3_7, self.conv3_8, x3)

        x = torch.cat([x4, x3, x2], dim=1)
        x = self.conv4_2(self.conv4_1(x).relu()).relu()
        logits = (
            self.deconv_classes(x)
            if self.full
            else interpolate(self.conv_classes(x), scale_factor=4)
        )
        return logits.permute(0, 3, 4, 2, 1)


def _context(first: nn.Conv3d, second: nn.Conv3d, x: Tensor) -> Tensor:
    x = first(x)
    return (x + second(x.relu())).relu()
