"""Differences in exposure and white balance between photographs: a factor for each colour and photograph, learned beside the field and left out of it.

    photograph v of the scene:   c_v = g_v * c,   g_v = exp(e_v - mean over all photographs)

With the mean fixed, the field is the scene as it was exposed on average, and held-back views are compared without any factor (as peers do). Factors act on
sRGB values: there a change of exposure is nearly a factor, too, for the curve is nearly a power.

Off by default, for photographs that were exposed alike lose by it: on 36 of a still life, after 1000 steps, held-back views came to 25.8 dB without, 25.0
with a pull of 0.01 and 25.6 with one of 0.5; on 15 of bananas, after 600 steps, to 25.1 without and 24.7 with a pull of 0.01.
"""

from __future__ import annotations

import torch
from torch import Tensor

SCALE = 0.1  # of what is learned: with the field's learning rate a factor moves by at most a thousandth in a step
# Weight of the mean square of the factors' logarithms in the loss: without a reason they stay at 1. At mid grey about 0.7 of a true difference is found.
PULL = 0.1


def log_gains(learned: Tensor) -> Tensor:
    """(C, 3) logarithms of the factors, from what is learned (C, 3), zero to begin with; their mean over the photographs is zero."""
    return SCALE * (learned - learned.mean(dim=0))


def exposed(colour: Tensor, view: Tensor, learned: Tensor) -> Tensor:
    """Colours (R, 3) of the scene as photographs `view` (R,) show them."""
    return colour * torch.exp(log_gains(learned))[view]


def exposure_loss(learned: Tensor) -> Tensor:
    """How much the factors differ from 1."""
    return PULL * (log_gains(learned) ** 2).mean()
