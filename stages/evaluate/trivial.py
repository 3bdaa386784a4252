"""The scores of pictures without any detail: the photograph's mean colour everywhere, and the photograph itself, blurred.

A PSNR by itself says little: 22 dB are good for leaves, and fog for a bare table. `equivalent_blur` gives the blur of the photograph that costs as much:
docs/experiments/verdict.md.
"""

import itertools
import math
from collections.abc import Sequence

import cv2
import numpy as np

BLURS = (0.0025, 0.005, 0.01, 0.02, 0.04, 0.08)  # standard deviations of the Gaussian, of the longest side: each twice the one before
INVISIBLE = 40.0  # dB: an error of 2.5 of 255 levels; two pictures that differ by less are the same, however plain they are
SHADING = 0.04  # standard deviation of the Gaussian, of the longest side, whose means are shading; what differs from them is detail
REDUCED = 4.0  # px of standard deviation from which the photograph is reduced first: the same blur to a hundredth of a level, in a fraction of the time


def mean_colour_psnr(truth: np.ndarray, mask: np.ndarray | None) -> float:
    """PSNR of a picture of one colour, the mean of the pixels that count: decibels, at most INVISIBLE.

    truth  (H, W, 3) float, sRGB 0 to 1
    mask   (H, W) bool, pixels that count; None: all. At least one has to
    """
    used = (truth if mask is None else truth[mask]).reshape(-1, 3).astype(np.float64)
    return _decibels(float(np.square(used - used.mean(0)).mean()))


def blurred_psnrs(truth: np.ndarray, mask: np.ndarray | None) -> list[float]:
    """PSNR of the photograph, or its detail, blurred by each of BLURS, falling: decibels, at most INVISIBLE. What does not count takes no part in it.
    Arguments as above."""
    found: list[float] = []
    for blur in BLURS:
        picture = blurred(truth, blur * max(truth.shape[:2]), mask)
        errors = np.square(picture.astype(np.float64) - truth).mean(-1)
        found.append(min([_decibels(float((errors if mask is None else errors[mask]).mean())), *found]))
    return found


def detail(picture: np.ndarray, mask: np.ndarray | None) -> np.ndarray:
    """(H, W, 3) float32: a picture less its shading, that of the pixels that count alone. Arguments as above.

    Light, shadows and exposure change the shading of a plain table from photograph to photograph, and a blur does not.
    """
    return picture.astype(np.float32) - blurred(picture, SHADING * max(picture.shape[:2]), mask)


def blurred(picture: np.ndarray, deviation: float, mask: np.ndarray | None = None) -> np.ndarray:
    """(H, W, 3) float32: a picture blurred by a Gaussian of a standard deviation in pixels, of the pixels that count alone."""
    height, width = picture.shape[:2]
    weights = np.ones((height, width, 1), np.float32) if mask is None else mask[..., None].astype(np.float32)
    layers = np.concatenate([picture.astype(np.float32) * weights, weights], axis=-1)  # (H, W, 4)
    factor = max(1, int(deviation / REDUCED))
    small = (max(1, round(width / factor)), max(1, round(height / factor)))
    if factor > 1:
        layers = cv2.resize(layers, small, interpolation=cv2.INTER_AREA)
    layers = cv2.GaussianBlur(layers, (0, 0), max(deviation / factor, 1e-3), borderType=cv2.BORDER_REFLECT)
    if factor > 1:
        layers = cv2.resize(layers, (width, height), interpolation=cv2.INTER_LINEAR)
    return np.asarray(layers[..., :3] / np.maximum(layers[..., 3:], 1e-6), np.float32)


def equivalent_blur(psnr: float, blurred: Sequence[float]) -> float:
    """The blur, of the longest side, after which the photograph would score this PSNR: interpolated over its logarithm, from the first to the last of BLURS.

    blurred  `blurred_psnrs`
    """
    if psnr >= min(INVISIBLE, blurred[0]):
        return BLURS[0]
    for (fine, high), (coarse, low) in itertools.pairwise(zip(BLURS, blurred, strict=True)):
        if psnr >= low:
            share = (high - psnr) / (high - low)
            return math.exp(math.log(fine) * (1 - share) + math.log(coarse) * share)
    return BLURS[-1]


def _decibels(error: float) -> float:
    return min(INVISIBLE, -10.0 * math.log10(error)) if error > 0 else INVISIBLE
