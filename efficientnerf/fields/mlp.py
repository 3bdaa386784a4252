"""The paper's networks: positional encoding of the position alone, a ReLU network with one skip, density and harmonics out.

The standard network (8 layers of 256) serves the fine stage, the lightweight one (4 of 128) the coarse stage.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor, nn

from efficientnerf.harmonics import harmonics_count

FREQUENCIES = 10


def positional_encoding(points: Tensor, frequencies: int = FREQUENCIES) -> Tensor:
    """(N, 3) in [-1, 1] to (N, 3 + 6 frequencies): the point itself, then sines and cosines of 2^l x (Mildenhall et al. 2020, equation 4)."""
    scales = 2.0 ** torch.arange(frequencies, device=points.device, dtype=points.dtype)
    angles = (points[:, None] * scales[:, None]).reshape(len(points), 3 * frequencies)
    return torch.cat([points, torch.sin(angles), torch.cos(angles)], dim=-1)


class MlpField(nn.Module):
    """`layers` of `hidden` units; the input enters again in the middle. See `efficientnerf.fields`."""

    activation = "softplus"

    def __init__(self, *, hidden: int, layers: int, degree: int, generator: torch.Generator) -> None:
        super().__init__()
        self.degree = degree
        self.skip = layers // 2
        inputs = 3 + 6 * FREQUENCIES
        widths = [inputs] + [hidden + (inputs if layer == self.skip else 0) for layer in range(1, layers)]
        self.weights, self.biases = nn.ParameterList(), nn.ParameterList()
        for fan_in, fan_out in zip([*widths, hidden], [*[hidden] * layers, 1 + 3 * harmonics_count(degree)], strict=True):
            bound = math.sqrt(6 / fan_in) if len(self.weights) < layers else math.sqrt(1 / fan_in)
            self.weights.append(nn.Parameter((torch.rand(fan_out, fan_in, generator=generator) * 2 - 1) * bound))
            self.biases.append(nn.Parameter(torch.zeros(fan_out)))

    def forward(self, points: Tensor) -> Tensor:
        return torch.nn.functional.linear(self._trunk(points), self.weights[-1], self.biases[-1])

    def density(self, points: Tensor) -> Tensor:
        return torch.nn.functional.linear(self._trunk(points), self.weights[-1][:1], self.biases[-1][:1])[:, 0]

    def _trunk(self, points: Tensor) -> Tensor:
        features = positional_encoding(points * 2 - 1)
        x = features
        for layer, (weight, bias) in enumerate(zip(list(self.weights)[:-1], list(self.biases)[:-1], strict=True)):
            if layer == self.skip and layer > 0:
                x = torch.cat([x, features], dim=-1)
            x = torch.relu(torch.nn.functional.linear(x, weight, bias))
        return x
