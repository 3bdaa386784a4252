"""Colours of an object at the soft edges of its silhouette, without those of what stood behind it.

A pixel of a photograph at an edge shows C = a F + (1 - a) B: a part a of the object, the rest of what is behind. Composited on others as it is, it leaves
a fringe of B, another one in each photograph.
"""

import cv2
import numpy as np

MIN_ALPHA = 0.25  # share of a pixel from which its own colour is solved for; below, noise would be multiplied by more than four
WITHIN = 0.9  # share from which a pixel shows the object alone
NEAR, FAR = 1.0, 4.0  # px, standard deviations of the neighbourhoods that colours are taken from
AROUND = 5  # px, side of the neighbourhood within whose colours of the object a solution stays


def without_background(colour: np.ndarray, cover: np.ndarray) -> np.ndarray:
    """(H, W, 3) uint8: the object's colour F wherever it covers a part of a pixel; elsewhere as it was.

    colour  (H, W, 3) uint8, C: of the photograph, with its surroundings
    cover   (H, W) uint8, a

    B is the mean colour of the pixels nearby that are wholly outside. Solutions stay within the colours of pixels nearby that are wholly inside, where there
    are any, for masks are not exact; pixels of which little is covered take the colour of their neighbours.
    """
    share = cover.astype(np.float32) / 255
    soft = (cover > 0) & (cover < 255)
    if not soft.any():
        return colour
    seen = colour.astype(np.float32)
    behind, known = _mean_nearby(seen, (cover == 0).astype(np.float32))
    solved = (seen - (1 - share[..., None]) * behind) / np.maximum(share, MIN_ALPHA)[..., None]
    within = (share >= WITHIN)[..., None]
    window = np.ones((AROUND, AROUND), np.uint8)
    low, high = cv2.erode(np.where(within, seen, 255.0).astype(np.float32), window), cv2.dilate(np.where(within, seen, 0.0).astype(np.float32), window)
    bounded = low <= high
    solved = np.clip(np.where(bounded, np.clip(solved, low, high), solved), 0, 255)
    solved = np.where((soft & known)[..., None], solved, seen)
    nearby, some = _mean_nearby(solved, np.where(share >= MIN_ALPHA, share, np.float32(0)))
    solved = np.where((soft & (share < MIN_ALPHA) & some)[..., None], nearby, solved)
    return np.asarray(np.rint(solved).astype(np.uint8))


def _mean_nearby(values: np.ndarray, weight: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(H, W, 3) the weighted mean of values near each pixel, and (H, W) whether there is any weight: of a near neighbourhood, else of a farther one."""
    mean, some = np.zeros_like(values), np.zeros(weight.shape, bool)
    for sigma in (FAR, NEAR):
        total = cv2.GaussianBlur(weight, (0, 0), sigma)
        there = total > 1e-2
        found = cv2.GaussianBlur(values * weight[..., None], (0, 0), sigma) / np.maximum(total, 1e-6)[..., None]
        mean, some = np.where(there[..., None], found, mean), some | there
    return mean, some
