"""LMSCNet: a 2-D U-Net over the ground plane, height as channels, and a light 3-D segmentation
head.

L. Roldao, R. de Charette, A. Verroust-Blondet: LMSCNet: Lightweight Multiscale 3D Semantic
Completion, 3DV 2020.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn


class SegmentationHead(nn.Module):
    """Lift (B, Z, X, Y) features to (B, K, Z, X, Y) logits: 3-D convolutions around a dilated
    pyramid (ASPP).
    """

    def __init__(
        self, num_classes: int, features: int = 8, dilations: tuple[int, ...] = (1, 2, 3)
    ) -> None:
        super().__init__()

        def branches() -> nn.ModuleList:
            return nn.ModuleList(
                nn.Conv3d(features, features, 3, padding=d, dilation=d, bias=False)
                for d in dilations
            )

        self.conv0 = nn.Conv3d(1, features, 3, padding=1)
        self.conv1, self.bn1 = (
            branches(),
            nn.ModuleList(nn.BatchNorm3d(features) for _ in dilations),
        )
        self.conv2, self.bn2 = (
            branches(),
            nn.ModuleList(nn.BatchNorm3d(features) for _ in dilations),
        )
        self.conv_classes = nn.Conv3d(features, num_classes, 3, padding=1)

    def forward(self, features: Tensor) -> Tensor:
        """Take (B, Z, X, Y) to (B, K, Z, X, Y)."""
        x = self.conv0(features.unsqueeze(1)).relu()
        pyramid = x
        for conv1, bn1, conv2, bn2 in zip(self.conv1, self.bn1, self.conv2, self.bn2, strict=True):
            pyramid = pyramid + bn2(conv2(bn1(conv1(x)).relu()))
        return self.conv_classes(pyramid.relu())


def voxels_last(logits: Tensor) -> Tensor:
    """Turn (B, K, Z, X, Y) into (B, X, Y, Z, K)."""
    return logits.permute(0, 3, 4, 2, 1)


class LMSCNet(nn.Module):
    """LMSCNet SS (`multiscale=False`: one head, at full scale) or LMSCNet (heads at 1/1, 1/2, 1/4
    and 1/8).

    Args:
        num_classes: K.
        height: Z, cells along z; the number f of feature channels. X, Y and Z must be multiples of
            8.
        multiscale: whether the coarse outputs are classified, too.
    """

    divisors = (8, 8, 8)  # cells of the grid must be multiples of these

    def __init__(self, num_classes: int, height: int, *, multiscale: bool = False) -> None:
        super().__init__()
        f, f2, f3, f4 = height, int(height * 1.5), height * 2, int(height * 2.5)
        # channels of the coarse outputs: their heights
        c2, c4, c8 = (
            height // 2,
            height // 4,
            height // 8,
        )

        self.Encoder_block1 = nn.Sequential(*_two_convolutions(f, f))
        self.Encoder_block2 = nn.Sequential(nn.MaxPool2d(2), *_two_convolutions(f, f2))
        self.Encoder_block3 = nn.Sequential(nn.MaxPool2d(2), *_two_convolutions(f2, f3))
        self.Encoder_block4 = nn.Sequential(nn.MaxPool2d(2), *_two_convolutions(f3, f4))

        self.conv_out_scale_1_8 = nn.Conv2d(f4, c8, 3, padding=1)
        self.deconv_1_8__1_2 = nn.ConvTranspose2d(c8, c8, 4, stride=4)
        self.deconv_1_8__1_1 = nn.ConvTranspose2d(c8, c8, 8, stride=8)

        self.deconv1_8 = nn.ConvTranspose2d(c8, c8, 6, stride=2, padding=2)
        self.conv1_4 = nn.Conv2d(c8 + f3, f3, 3, padding=1)
        self.conv_out_scale_1_4 = nn.Conv2d(f3, c4, 3, padding=1)
        self.deconv_1_4__1_1 = nn.ConvTranspose2d(c4, c4, 4, stride=4)

        self.deconv1_4 = nn.ConvTranspose2d(c4, c4, 6, stride=2, padding=2)
        self.conv1_2 = nn.Conv2d(c4 + f2 + c8, f2, 3, padding=1)
        self.conv_out_scale_1_2 = nn.Conv2d(f2, c2, 3, padding=1)

        self.deconv1_2 = nn.ConvTranspose2d(c2, c2, 6, stride=2, padding=2)
        self.conv1_1 = nn.Conv2d(c2 + f + c4 + c8, f, 3, padding=1)

        self.seg_head_1_1 = SegmentationHead(num_classes)
        self.multiscale = multiscale
        if multiscale:
            self.seg_head_1_2 = SegmentationHead(num_classes)
            self.seg_head_1_4 = SegmentationHead(num_classes)
            self.seg_head_1_8 = SegmentationHead(num_classes)

    def forward(self, occupancy: Tensor) -> Tensor | list[Tensor]:
        """Complete a scan.

        Args:
            occupancy: (B, 1, X, Y, Z) float32, 1 where the scan has a point.

        Returns:
            (B, X, Y, Z, K) logits. LMSCNet in training mode: a list of them, at 1/1, 1/2, 1/4 and
            1/8 of the scale.
        """
        skip1 = self.Encoder_block1(occupancy[:, -1].permute(0, 3, 1, 2))
        skip2 = self.Encoder_block2(skip1)
        skip4 = self.Encoder_block3(skip2)
        out8 = self.conv_out_scale_1_8(self.Encoder_block4(skip4))

        x = torch.cat([self.deconv1_8(out8), skip4], dim=1)
        out4 = self.conv_out_scale_1_4(self.conv1_4(x).relu())

        x = torch.cat([self.deconv1_4(out4), skip2, self.deconv_1_8__1_2(out8)], dim=1)
        out2 = self.conv_out_scale_1_2(self.conv1_2(x).relu())

        x = torch.cat(
            [self.deconv1_2(out2), skip1, self.deconv_1_4__1_1(out4), self.deconv_1_8__1_1(out8)],
            dim=1,
        )
        out1 = self.conv1_1(x).relu()

        full = voxels_last(self.seg_head_1_1(out1))
        if not (self.multiscale and self.training):
            return full
        coarse = [self.seg_head_1_2(out2), self.seg_head_1_4(out4), self.seg_head_1_8(out8)]
        return [full, *map(voxels_last, coarse)]


def _two_convolutions(inputs: int, outputs: int) -> list[nn.Module]:
    return [
        nn.Conv2d(inputs, outputs, 3, padding=1),
        nn.ReLU(),
        nn.Conv2d(outputs, outputs, 3, padding=1),
        nn.ReLU(),
    ]
