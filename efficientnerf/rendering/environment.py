"""Environment maps: the colour of what has no parallax, by direction; equirectangular, z up.

    azimuth = atan2(y, x) in -pi to pi      column coordinate = (azimuth / (2 pi) + 1/2) W
    polar   = acos(z)     in 0 to pi        row coordinate    = polar / pi H

Texels have their centres at halves; values between them are interpolated linearly, the columns wrap, the rows end.

H, W rows and columns, R rays.
"""

from __future__ import annotations

import numpy as np


def directions_of(height: int, width: int) -> np.ndarray:
    """(H, W, 3) unit directions of the texels' centres."""
    polar = (np.arange(height) + 0.5) / height * np.pi
    azimuth = ((np.arange(width) + 0.5) / width - 0.5) * 2 * np.pi
    sine = np.sin(polar)[:, None]
    return np.stack([sine * np.cos(azimuth), sine * np.sin(azimuth), np.broadcast_to(np.cos(polar)[:, None], (height, width))], axis=-1)


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
