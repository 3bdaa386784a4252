"""Differences in exposure and white balance between photographs: gains of each photograph's colours, learned beside the field and left out of it.

    photograph v of the scene:   c_v = g_v * c,   g_v = exp(e_v - mean over all photographs)

With the mean fixed, the field is the scene as it was exposed on average, and held-out views are compared without any gain (as peers do). Gains act on
sRGB values: there a change of exposure is nearly a factor, too, for the curve is nearly a power. Off by default: docs/experiments/losses.md

What is made of the field with the photographs' help is the scene as it was exposed on average, too: it is fitted to the photographs over their gains.
"""

from __future__ import annotations

from typing import Any

import numpy as np
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


def averaged(colour: Any, gain: Any) -> Any:
    """Colours (R, 3) of photographs as those of the scene, by their gains (R, 3), arrays or tensors: what was exposed more is darker then, and at most 1."""
    return (colour / gain).clip(0, 1)


def averaged_image(image: np.ndarray, gain: np.ndarray) -> np.ndarray:
    """The same of a photograph (H, W, 3 or 4) uint8 and its gains (3,); alpha stays."""
    out = image.copy()
    out[..., :3] = np.rint(255 * averaged(image[..., :3].astype(np.float32) / np.float32(255), gain.astype(np.float32)))
    return out


def exposure_loss(learned: Tensor) -> Tensor:
    """The weighted mean square of the gains' logarithms."""
    return WEIGHT * (log_gains(learned) ** 2).mean()
