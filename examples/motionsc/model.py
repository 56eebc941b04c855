"""MotionSC: a spatio-temporal pyramid over a stack of scans, and the segmentation head of LMSCNet.

J. Wilson et al.: MotionSC: Data Set and Network for Real-Time Semantic Mapping in Dynamic
Environments, RA-L 2022. The backbone is MotionNet's (P. Wu, S. Chen, D. Metaxas, CVPR 2020).
"""

from __future__ import annotations

import torch
from lmscnet.model import SegmentationHead, voxels_last
from torch import Tensor, nn
from torch.nn.functional import interpolate


class TemporalConvolution(nn.Module):
    """A convolution over time only: (B, T, C, X, Y) to (B, T - kernel + 1, C, X, Y)."""

    def __init__(self, channels: int, kernel: int) -> None:
        super().__init__()
        self.conv3d = nn.Conv3d(channels, channels, (kernel, 1, 1))
        self.bn3d = nn.BatchNorm3d(channels)

    def forward(self, x: Tensor) -> Tensor:
        """Convolve over time."""
        return self.bn3d(self.conv3d(x.transpose(1, 2))).relu().transpose(1, 2)


class SpatioTemporalPyramid(nn.Module):
    """MotionNet's backbone (STPN): four stages down, time convolved away after the first two, and
    four stages up.

    Args:
        height: Z, the channels of the input and of the output. X and Y must be multiples of 16.
        frames: T; the temporal kernels are 3 if enough frames are left, otherwise 1.
    """

    def __init__(self, height: int, frames: int) -> None:
        super().__init__()
        self._add_stage("_pre", height, 32)

        self._add_stage("1", 32, 64, stride=2)
        self.conv3d_1 = TemporalConvolution(64, kernel=3 if frames >= 3 else 1)
        self._add_stage("2", 64, 128, stride=2)
        self.conv3d_2 = TemporalConvolution(128, kernel=3 if frames >= 5 else 1)
        self._add_stage("3", 128, 256, stride=2)
        self._add_stage("4", 256, 512, stride=2)

        self._add_stage("5", 512 + 256, 256)
        self._add_stage("6", 256 + 128, 128)
        self._add_stage("7", 128 + 64, 64)
        self._add_stage("8", 64 + 32, height)

    def forward(self, x: Tensor) -> Tensor:
        """Take (B, T, Z, X, Y) to (B, Z, X, Y)."""
        x0 = self._encode("_pre", x)
        x1 = self.conv3d_1(self._encode("1", x0))
        x2 = self.conv3d_2(self._encode("2", x1))
        x3 = self._encode("3", x2)
        x4 = self._encode("4", x3)

        # over what is left of time
        x0, x1, x2, x3, x4 = (features.amax(dim=1) for features in (x0, x1, x2, x3, x4))

        x3 = self._decode("5", x4, x3)
        x2 = self._decode("6", x3, x2)
        x1 = self._decode("7", x2, x1)
        return self._decode("8", x1, x0)

    def _add_stage(self, name: str, inputs: int, outputs: int, stride: int = 1) -> None:
        """Two 3 x 3 convolutions, the first with the stride, each with its batch norm."""
        self.add_module(f"conv{name}_1", nn.Conv2d(inputs, outputs, 3, stride=stride, padding=1))
        self.add_module(f"bn{name}_1", nn.BatchNorm2d(outputs))
        self.add_module(f"conv{name}_2", nn.Conv2d(outputs, outputs, 3, padding=1))
        self.add_module(f"bn{name}_2", nn.BatchNorm2d(outputs))

    def _stage(self, name: str, x: Tensor) -> Tensor:
        for part in (1, 2):
            convolution, norm = (
                self.get_submodule(f"conv{name}_{part}"),
                self.get_submodule(f"bn{name}_{part}"),
            )
            x = norm(convolution(x)).relu()
        return x

    def _encode(self, name: str, x: Tensor) -> Tensor:
        """Run a stage on every frame: (B, T, C, X, Y) to (B, T, C', X', Y')."""
        frames = self._stage(name, x.flatten(0, 1))
        return frames.reshape(*x.shape[:2], *frames.shape[1:])

    def _decode(self, name: str, deeper: Tensor, skip: Tensor) -> Tensor:
        """Upsample the deeper map by 2, put it before the skip map, run a stage."""
        return self._stage(name, torch.cat([interpolate(deeper, scale_factor=2), skip], dim=1))


class MotionSC(nn.Module):
    """MotionSC for stacks of T scans.

    Args:
        num_classes: K.
        height: Z, cells along z. X and Y must be multiples of 16.
        frames: T, 1 or more.
    """

    divisors = (16, 16, 1)  # cells of the grid must be multiples of these

    def __init__(self, num_classes: int, height: int, frames: int = 1) -> None:
        super().__init__()
        self.stpn = SpatioTemporalPyramid(height, frames)
        self.segmentation_head = SegmentationHead(num_classes)

    def forward(self, occupancy: Tensor) -> Tensor:
        """Complete the newest of a stack of scans.

        Args:
            occupancy: (B, T, X, Y, Z) float32, oldest first, 1 where a scan has a point.

        Returns:
            (B, X, Y, Z, K) logits.
        """
        features = self.stpn(occupancy.permute(0, 1, 4, 2, 3))
        return voxels_last(self.segmentation_head(features))
