"""Differences in exposure and white balance between photographs: gains of each photograph's colours, learned beside the field and left out of it.

    photograph v of the scene:   c_v = g_v * c,   g_v = exp(e_v - mean over all photographs)

With the mean fixed, the field is the scene as it was exposed on average, and held-out views are compared without any gain (as peers do). Gains act on
sRGB values: there a change of exposure is nearly a factor, too, for the curve is nearly a power. Off by default: docs/experiments/losses.md
"""

from __future__ import annotations

import torch
from torch import Tensor

SCALE = 0.1  # of what is learned: with the field's learning rate a gain changes by at most a thousandth in a step
# Weight of the mean square of the gains' logarithms in the loss: without a reason they stay at 1. docs/experiments/losses.md
WEIGHT = 0.1


def log_gains(learned: Tensor) -> Tensor:
    """(C, 3) logarithms of the gains, from what is learned (C, 3), zero to begin with; their mean over the photographs is zero."""
    return SCALE * (learned - learned.mean(dim=0))


def exposed(colour: Tensor, view: Tensor, learned: Tensor) -> Tensor:
    """Colours (R, 3) of the scene as photographs `view` (R,) show them."""
    return colour * torch.exp(log_gains(learned))[view]


def exposure_loss(learned: Tensor) -> Tensor:
    """The weighted mean square of the gains' logarithms."""
    return WEIGHT * (log_gains(learned) ** 2).mean()
