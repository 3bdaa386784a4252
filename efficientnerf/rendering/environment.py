"""Environment maps: colours without parallax, by direction; equirectangular, z up.

    azimuth = atan2(y, x) in -pi to pi      column coordinate = (azimuth / (2 pi) + 1/2) W
    polar   = acos(z)     in 0 to pi        row coordinate    = polar / pi H

Texels have their centres at halves; values between them are interpolated linearly, the columns wrap, the rows end.

H, W rows and columns, R rays.
"""

import numpy as np
import torch
from scipy.ndimage import gaussian_filter
from torch import Tensor


def lookup(environment: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """Colours (R, 3) of a map (H, W, 3) along unit directions (R, 3)."""
    height, width = environment.shape[:2]
    d = np.asarray(directions, np.float64)
    column = (np.arctan2(d[:, 1], d[:, 0]) / (2 * np.pi) + 0.5) * width - 0.5
    row = np.clip(np.arccos(np.clip(d[:, 2], -1, 1)) / np.pi * height - 0.5, 0, height - 1)
    left, top = np.floor(column).astype(int), np.floor(row).astype(int)
    across, down = (column - left)[:, None], (row - top)[:, None]
    low = np.minimum(top + 1, height - 1)
    upper = environment[top, left % width] * (1 - across) + environment[top, (left + 1) % width] * across
    lower = environment[low, left % width] * (1 - across) + environment[low, (left + 1) % width] * across
    return np.asarray(upper * (1 - down) + lower * down, np.float32)


def lookup_on(environment: Tensor, directions: Tensor) -> Tensor:
    """`lookup` on the tensors' device."""
    height, width = environment.shape[:2]
    column = (torch.atan2(directions[:, 1], directions[:, 0]) / (2 * np.pi) + 0.5) * width - 0.5
    # The angle by both of its sides: in float32 the arc cosine loses half of the digits at the poles.
    row = (torch.atan2(torch.hypot(directions[:, 0], directions[:, 1]), directions[:, 2]) / np.pi * height - 0.5).clamp(0, height - 1)
    left, top = column.floor().long(), row.floor().long()
    across, down = (column - left)[:, None], (row - top)[:, None]
    low = (top + 1).clamp(max=height - 1)
    upper = environment[top, left % width] * (1 - across) + environment[top, (left + 1) % width] * across
    lower = environment[low, left % width] * (1 - across) + environment[low, (left + 1) % width] * across
    return upper * (1 - down) + lower * down


def texels_of(directions: np.ndarray, height: int) -> np.ndarray:
    """(R,) int64 flat texels, row by row, that unit directions (R, 3) fall into in a map of so many rows."""
    d = np.asarray(directions, np.float64)
    column = np.floor((np.arctan2(d[:, 1], d[:, 0]) / (2 * np.pi) + 0.5) * 2 * height).astype(np.int64) % (2 * height)
    row = np.floor(np.arccos(np.clip(d[:, 2], -1, 1)) / np.pi * height).astype(np.int64).clip(0, height - 1)
    return np.asarray(row * 2 * height + column)


HALF_WEIGHT = 4.0  # weight of a texel at which half of its colour is its own


def filled(total: np.ndarray, weight: np.ndarray, mean: np.ndarray) -> np.ndarray:
    """A map (H, 2 H, 3) float32 of weighted sums of colours (H, 2 H, 3): where the weight (H, 2 H) is small, the known colours around it fade in, from near and
    far; without any, `mean` (3,)."""
    known = weight.sum()
    out = np.broadcast_to(np.asarray(mean if known < 1e-6 else total.reshape(-1, 3).sum(axis=0) / known, np.float64), total.shape)
    sigma = len(total) / 4
    while True:
        def blurred(values: np.ndarray, width: float = sigma) -> np.ndarray:
            return values if width < 0.5 else np.asarray(gaussian_filter(values, width, mode=("nearest", "wrap")))

        around = np.maximum(blurred(weight) * max(1.0, 2 * np.pi * sigma**2), 0)
        colour = np.stack([blurred(total[..., channel]) for channel in range(3)], axis=-1) * max(1.0, 2 * np.pi * sigma**2)
        share = (around / (around + HALF_WEIGHT))[..., None]
        out = np.where(around[..., None] > 1e-9, share * colour / np.maximum(around, 1e-9)[..., None] + (1 - share) * out, out)
        if sigma < 0.5:
            return np.clip(out, 0, 1).astype(np.float32)
        sigma /= 2
