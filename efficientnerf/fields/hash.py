"""A multiresolution hash grid (Mueller et al. 2022, "Instant neural graphics primitives") with spherical-harmonics output.

L levels of lattices between `coarsest` and `finest` points a side, two features a lattice point, in tables of 2^log2_table entries (a level that
fits is dense, one that does not is hashed); then a small ReLU network. The outputs do not see the direction, so the field bakes.
"""

import itertools
import math

import numpy as np
import torch
from torch import Tensor, nn

from efficientnerf.backends import dispatch
from efficientnerf.backends.torch.hash_grid import HashLevels
from efficientnerf.backends.torch.linear_chain import fused_precision_of
from efficientnerf.fields.field import BakeableField
from efficientnerf.fields.gradient_buffer import GradientBuffer
from efficientnerf.rendering.harmonics import harmonics_count
from efficientnerf.settings import resolved
from efficientnerf.training.settings import FINEST, LOG2_TABLE, TrainSettings

COARSEST = 16  # resolution of the coarsest level
FEATURES = 2


def level_sizes(levels: int, log2_table: int, coarsest: int, finest: int) -> tuple[list[int], list[int]]:
    """Of each level, the points a side of its lattice, and the entries of its table."""
    growth = math.exp((math.log(finest) - math.log(coarsest)) / max(levels - 1, 1))
    sides = [round(coarsest * growth**level) for level in range(levels)]
    return sides, [min(side**3, 2**log2_table) for side in sides]


class HashField(BakeableField):
    """hidden x layers ReLU network over 2L features; see `efficientnerf.fields.field`."""

    activation = "exp"

    def __init__(
        self, *, levels: int, log2_table: int, coarsest: int, finest: int, hidden: int, layers: int, degree: int,
        initial_density: float, generator: torch.Generator, precision: str = "float32",
    ) -> None:  # fmt: skip
        super().__init__()
        self.degree = degree
        sides, counts = level_sizes(levels, log2_table, coarsest, finest)
        dense = np.array([side**3 <= 2**log2_table for side in sides])
        starts = np.array([0, *np.cumsum(counts)[:-1]], np.int64)
        self.hash_levels = HashLevels(np.array(sides, np.int64), dense, starts, np.uint32(2**log2_table - 1))
        self.table = nn.Parameter((torch.rand(sum(counts), FEATURES, generator=generator) * 2 - 1) * 1e-4)
        self.table_gradient = GradientBuffer()
        widths = [levels * FEATURES, *[hidden] * layers, 1 + 3 * harmonics_count(degree)]
        self.weights = nn.ParameterList()
        for inputs, outputs in itertools.pairwise(widths):
            bound = math.sqrt(6 / inputs)  # He initialisation for ReLU
            self.weights.append(nn.Parameter((torch.rand(outputs, inputs, generator=generator) * 2 - 1) * bound))
        # The last layer starts small: grey colours, a density so thin that every ray sees through.
        self.weights[-1].data.mul_(0.1)
        self.log_initial_density = math.log(initial_density)
        self.precision = precision

    @property
    def gradient_buffers(self) -> dict[str, GradientBuffer]:
        return {"table": self.table_gradient}

    def forward(self, points: Tensor) -> Tensor:
        return self._network(points, self.weights[-1])

    def density(self, points: Tensor) -> Tensor:
        return self._network(points, self.weights[-1][:1])[:, 0]

    def _network(self, points: Tensor, last: Tensor) -> Tensor:
        weights = [*list(self.weights)[:-1], last]
        training = torch.is_grad_enabled() and dispatch.backend_of(points, self.table) != "torch"
        precision = fused_precision_of(self.precision, points.device.type) if training else points.dtype
        return dispatch.hash_network(points, self.table, self.hash_levels, weights, self.log_initial_density, precision, self.table_gradient)


def grids(s: TrainSettings) -> tuple[dict[str, int], dict[str, int]]:
    """The arguments of `level_sizes` for the coarse field and the fine one."""
    log2_table, finest = resolved(s.log2_hashmap_size) or LOG2_TABLE, resolved(s.finest_resolution) or FINEST
    return {
        "levels": max(1, s.num_levels // 2), "log2_table": max(8, log2_table - 2), "coarsest": COARSEST, "finest": max(COARSEST, finest // 4),
    }, {"levels": s.num_levels, "log2_table": log2_table, "coarsest": COARSEST, "finest": finest}  # fmt: skip


def coarse_and_fine(s: TrainSettings, generator: torch.Generator) -> tuple[HashField, HashField]:
    """The coarse field is a proposal field: lighter, and of densities alone. docs/experiments/proposal-field.md"""
    coarse, fine = grids(s)
    return HashField(
        **coarse,
        hidden=s.coarse_hidden_dim, layers=s.coarse_num_layers, degree=0, initial_density=s.initial_density, generator=generator, precision=s.precision,
    ), HashField(
        **fine,
        hidden=s.hidden_dim, layers=s.num_layers, degree=s.sh_degree, initial_density=s.initial_density, generator=generator, precision=s.precision,
    )  # fmt: skip
