"""The original NeRF's network (Mildenhall et al. 2020, figure 7), for the baseline: the direction enters the network, so that it cannot be baked.

The trunk is that of `efficientnerf.fields.mlp`. From it come the density and a feature of the trunk's width, which with the encoded direction (4
frequencies, 27 numbers) goes through one layer of half the width to the colour. With 8 layers of 256: 595,844 parameters.
"""

import torch
from torch import Tensor

from efficientnerf.backends.torch.linear_chain import chain, precision_of
from efficientnerf.fields.mlp import PositionNetwork, linear_layers, positional_encoding
from efficientnerf.rendering.compositing import ray_of_sample
from efficientnerf.training.settings import TrainSettings

DIRECTION_FREQUENCIES = 4


class NerfField(PositionNetwork):
    """See `efficientnerf.fields.field`; its values are the density and the colour before its sigmoid."""

    def __init__(self, *, hidden: int, layers: int, generator: torch.Generator, precision: str = "float32") -> None:
        super().__init__(hidden=hidden, layers=layers, outputs=1 + hidden, generator=generator, precision=precision)
        directions = 3 + 6 * DIRECTION_FREQUENCIES
        self.colour_weights, self.colour_biases = linear_layers([(hidden + directions, hidden // 2), (hidden // 2, 3)], generator)

    def forward(self, points: Tensor, directions: Tensor) -> Tensor:
        """(N, 4) at points (N, 3) in grid coordinates, along unit directions (N, 3)."""
        both = self.network(points, self.weights[-1], self.biases[-1])
        inputs = torch.cat([both[:, 1:], positional_encoding(directions, DIRECTION_FREQUENCIES)], dim=-1)
        precision = precision_of(self.precision, points.device.type)
        colour = chain(inputs, list(self.colour_weights), list(self.colour_biases), precision=precision)
        return torch.cat([both[:, :1], colour], dim=-1)

    def along_rays(self, points: Tensor, directions: Tensor, first: Tensor) -> Tensor:
        return self.forward(points, directions[ray_of_sample(first, len(points))])


def coarse_and_fine(s: TrainSettings, generator: torch.Generator) -> tuple[NerfField, NerfField]:
    """NeRF's coarse and fine network (Mildenhall et al. 2020, section 5.2)."""
    return (
        NerfField(hidden=s.coarse_hidden_dim, layers=s.coarse_num_layers, generator=generator, precision=s.precision),
        NerfField(hidden=s.hidden_dim, layers=s.num_layers, generator=generator, precision=s.precision),
    )
