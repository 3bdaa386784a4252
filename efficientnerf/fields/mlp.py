"""The paper's networks: positional encoding of the position alone, a ReLU network with one skip, density and harmonics out.

With 10 frequencies, 63 numbers in, and degree 3, 49 out, the standard network (8 layers of 256) has 505,649 parameters and serves the fine stage; the
lightweight one (4 of 128) has 72,113 and serves the coarse stage (EfficientNeRF, section 3.2).
"""

import math

import torch
from torch import Tensor, nn

from efficientnerf.backends.torch.linear_chain import chain, precision_of
from efficientnerf.fields.field import BakeableField, Field
from efficientnerf.rendering.harmonics import harmonics_count
from efficientnerf.training.settings import TrainSettings

FREQUENCIES = 10


def positional_encoding(points: Tensor, frequencies: int = FREQUENCIES) -> Tensor:
    """(N, 3) in [-1, 1] to (N, 3 + 6 frequencies): the point itself, then sines and cosines of 2^l x (Mildenhall et al. 2020, equation 4).

    Without the factor pi of that equation, as in NeRF's code and in the authors' release. Four octaves out of five follow from the one before by
    the formulas of the double angle, which takes a third of the time; the error of float32 grows to about 1e-5 on the way.
    """
    sines: list[Tensor] = []
    cosines: list[Tensor] = []
    for octave in range(frequencies):
        if octave % 5 == 0:
            sine, cosine = torch.sin(points * 2**octave), torch.cos(points * 2**octave)
        else:
            sine, cosine = 2 * sine * cosine, 1 - 2 * sine * sine
        sines.append(sine)
        cosines.append(cosine)
    return torch.cat([points, *sines, *cosines], dim=-1)


def linear_layers(shapes: list[tuple[int, int]], generator: torch.Generator) -> tuple[nn.ParameterList, nn.ParameterList]:
    """Weights and biases of layers from I to O: He initialisation for those before a ReLU, the last smaller; no bias."""
    weights, biases = nn.ParameterList(), nn.ParameterList()
    for layer, (fan_in, fan_out) in enumerate(shapes):
        bound = math.sqrt((6 if layer < len(shapes) - 1 else 1) / fan_in)
        weights.append(nn.Parameter((torch.rand(fan_out, fan_in, generator=generator) * 2 - 1) * bound))
        biases.append(nn.Parameter(torch.zeros(fan_out)))
    return weights, biases


class PositionNetwork(Field):
    """`layers` of `hidden` units over the encoded position, which enters again in the middle; then `outputs` numbers, the raw density first.

    precision  "auto", "float32" or "bfloat16": what products are computed in (`efficientnerf.backends.torch.linear_chain`)
    """

    activation = "softplus"

    def __init__(self, *, hidden: int, layers: int, outputs: int, generator: torch.Generator, precision: str) -> None:
        super().__init__()
        self.precision = precision
        self.skip = layers // 2 or None
        inputs = 3 + 6 * FREQUENCIES
        widths = [inputs] + [hidden + (inputs if layer == self.skip else 0) for layer in range(1, layers)] + [hidden]
        self.weights, self.biases = linear_layers(list(zip(widths, [*[hidden] * layers, outputs], strict=True)), generator)

    def density(self, points: Tensor) -> Tensor:
        return self.network(points, self.weights[-1][:1], self.biases[-1][:1])[:, 0]

    def network(self, points: Tensor, weight: Tensor, bias: Tensor) -> Tensor:
        """What the last layer gives at points (N, 3), with these rows of its weights and biases."""
        weights, biases = [*list(self.weights)[:-1], weight], [*list(self.biases)[:-1], bias]
        precision = precision_of(self.precision, points.device.type)
        return chain(positional_encoding(points * 2 - 1), weights, biases, skip=self.skip, precision=precision)


class MlpField(PositionNetwork, BakeableField):
    """The paper's network; see `efficientnerf.fields.field`."""

    def __init__(self, *, hidden: int, layers: int, degree: int, generator: torch.Generator, precision: str = "float32") -> None:
        super().__init__(hidden=hidden, layers=layers, outputs=1 + 3 * harmonics_count(degree), generator=generator, precision=precision)
        self.degree = degree

    def forward(self, points: Tensor) -> Tensor:
        return self.network(points, self.weights[-1], self.biases[-1])


def coarse_and_fine(s: TrainSettings, generator: torch.Generator) -> tuple[MlpField, MlpField]:
    """The paper's lightweight and standard networks (EfficientNeRF, section 3.2)."""
    return (
        MlpField(hidden=s.coarse_hidden_dim, layers=s.coarse_num_layers, degree=s.sh_degree, generator=generator, precision=s.precision),
        MlpField(hidden=s.hidden_dim, layers=s.num_layers, degree=s.sh_degree, generator=generator, precision=s.precision),
    )
