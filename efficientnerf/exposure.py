"""Differences in exposure and white balance between photographs: a factor for each colour and photograph, learned beside the field and left out of it.

    photograph v of the scene:   c_v = g_v * c,   g_v = exp(e_v - mean over all photographs)

With the mean fixed, the field is the scene as it was exposed on average, and held-back views are compared without any factor (as peers do). Factors act on
sRGB values: there a change of exposure is nearly a factor, too, for the curve is nearly a power.
"""

from __future__ import annotations

import torch
from torch import Tensor

SCALE = 0.1  # of what is learned: with the field's learning rate a factor moves by at most a thousandth in a step
PULL = 0.01  # weight of the mean square of the factors' logarithms in the loss: without a reason they stay at 1


def log_gains(learned: Tensor) -> Tensor:
    """(C, 3) logarithms of the factors, from what is learned (C, 3), zero to begin with; their mean over the photographs is zero."""
    return SCALE * (learned - learned.mean(dim=0))


def exposed(colour: Tensor, view: Tensor, learned: Tensor) -> Tensor:
    """Colours (R, 3) of the scene as photographs `view` (R,) show them."""
    return colour * torch.exp(log_gains(learned))[view]


def exposure_loss(learned: Tensor) -> Tensor:
    """How much the factors differ from 1."""
    return PULL * (log_gains(learned) ** 2).mean()
