"""Learning rates and gradients of successive steps of an optimiser."""

import torch

RATES = [0.01, 0.02, 0.015, 0.01]


def gradients(shape: tuple[int, ...] = (50, 2)) -> list[torch.Tensor]:
    generator = torch.Generator().manual_seed(0)
    return [torch.randn(shape, generator=generator) * 10.0 ** -(2 * n) for n in range(len(RATES))]
