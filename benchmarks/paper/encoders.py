"""Convolutional networks of the fields that look up source views: features of photographs, and the encoding of a cost volume."""

import torch
from torch import Tensor, nn


class FeatureNetwork(nn.Module):
    """A U-Net of three scales: images (V, H, W, 3) to features (V, h, w, channels) at half their size, rounded down.

    Kernels that halve are 4 wide, so that pixel (x, y) of a feature map is at (2x, 2y) of the image, both counted from the corner."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.at_half = nn.Sequential(_convolution(3, 8, 2), _convolution(8, 8))
        self.at_quarter = nn.Sequential(_convolution(8, 16, 2), _convolution(16, 16))
        self.at_eighth = nn.Sequential(_convolution(16, 16, 2), _convolution(16, 16))
        self.up = _convolution(32, 16)
        self.last = nn.Conv2d(24, channels, 3, padding=1)

    def forward(self, images: Tensor) -> Tensor:
        half = self.at_half(images.permute(0, 3, 1, 2) * 2 - 1)
        quarter = self.at_quarter(half)
        eighth = self.at_eighth(quarter)
        up = self.up(torch.cat([_resized(eighth, quarter), quarter], 1))
        out: Tensor = self.last(torch.cat([_resized(up, half), half], 1))
        return out.permute(0, 2, 3, 1).contiguous()


class VolumeNetwork(nn.Module):
    """A three-dimensional U-Net of three scales: cost volume (D, D, D, I) to encoding (D, D, D, O); D a multiple of 4.

    Only the halves and quarters are convolved: at full resolution, where most of the time would go, voxels are mapped one by one.
    """

    def __init__(self, inputs: int, outputs: int) -> None:
        super().__init__()
        self.at_whole = nn.Sequential(nn.Linear(inputs, 8), nn.ELU())
        self.at_half = nn.Sequential(_convolution3(8, 16, 2), _convolution3(16, 16))
        self.at_quarter = nn.Sequential(_convolution3(16, 16, 2), _convolution3(16, 16), _convolution3(16, 16))
        self.to_whole = _convolution3(16, 8)
        self.last = nn.Linear(8, outputs)

    def forward(self, cost: Tensor) -> Tensor:
        whole = self.at_whole(cost)
        half = self.at_half(whole.permute(3, 0, 1, 2)[None])
        half = half + _resized(self.at_quarter(half), half)
        up = nn.functional.interpolate(self.to_whole(half), size=cost.shape[:3], mode="trilinear")
        out: Tensor = self.last(whole + up[0].permute(1, 2, 3, 0))
        return out


def _convolution(inputs: int, outputs: int, stride: int = 1) -> nn.Sequential:
    return nn.Sequential(nn.Conv2d(inputs, outputs, 2 + stride, stride, 1), nn.InstanceNorm2d(outputs, affine=True), nn.ELU())


def _convolution3(inputs: int, outputs: int, stride: int = 1) -> nn.Sequential:
    return nn.Sequential(nn.Conv3d(inputs, outputs, 2 + stride, stride, 1), nn.ELU())


def _resized(coarse: Tensor, like: Tensor) -> Tensor:
    return nn.functional.interpolate(coarse, size=like.shape[2:], mode="nearest")
