"""The background that stands still behind an object on a turntable, photographed by a camera on a stand.

A pixel that shows the background shows the same colour again and again; the object's texture turns away. A pixel without such a colour is object in all
photographs. N photographs of (h, w).
"""

import cv2
import numpy as np
from scipy.ndimage import binary_fill_holes

from efficientnerf.capture.keying import large_parts, without_specks
from pipeline.errors import BadInput

SIDE = 480  # px, longest side of what is compared
FEWEST, MOST = 5, 40  # photographs that are compared
QUIET = 0.2  # share of the pixels that are background in all photographs, at least: their noise is the camera's
LEAST_SUPPORT, LEAST_SEEN = 3, 0.12  # photographs, and share of them, in which a colour comes back
LEAST_DIFFERENCE, MOST_DIFFERENCE, NOISE = 12.0, 24.0, 5.0  # of 255, from which a pixel is no background; in deviations of the background's own noise
LEAST_STILL = 0.5  # of the border's pixels
BORDER = 0.06  # of the longer side
CLOSING, SHARE = 0.012, 0.05  # of the longer side: gaps that are closed; of the largest part: parts that are kept
GUIDE_RADIUS, GUIDE_EPSILON = 6, 1e-4  # the guided filter that brings edges to those of the photograph


class StillBackground:
    """The background of photographs of one size, from all of them (N, h, w, 3) uint8. Raises BadInput where it does not stand still."""

    def __init__(self, stack: np.ndarray) -> None:
        if len(stack) < FEWEST:
            raise BadInput(f"--mask static needs at least {FEWEST} photographs of one size; these are {len(stack)}.")
        stack = stack[np.linspace(0, len(stack) - 1, min(len(stack), MOST)).astype(int)]
        self._exposure = np.median(stack[:, border_of(stack.shape[1:3])].mean(-1))
        even = np.stack([self._even(each) for each in stack])
        spread = np.median(np.abs(even - np.median(even, axis=0)).max(-1), axis=0)  # (h, w)
        self._limit = float(np.clip(NOISE * np.quantile(spread, QUIET), LEAST_DIFFERENCE, MOST_DIFFERENCE))
        self._colour, support = _commonest(even, self._limit / 2)
        self._never = support < max(LEAST_SUPPORT, LEAST_SEEN * len(even))
        still = float((spread < self._limit)[border_of(spread.shape)].mean())
        if still < LEAST_STILL:
            raise BadInput(
                f"--mask static: only {still:.0%} of the border is the same in most photographs. It is for a camera on a stand and an object that turns; where"
                " the camera moves, leave --mask away."
            )

    def mask(self, small: np.ndarray) -> np.ndarray:
        """(h, w) uint8 of one of the photographs (h, w, 3): 255 where it shows the object."""
        off = np.abs(self._even(small) - self._colour).max(-1)
        found = ((off > self._limit) | self._never).astype(np.uint8)
        wide = max(1, round(CLOSING * max(found.shape)))
        disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * wide + 1, 2 * wide + 1))
        found = cv2.morphologyEx(cv2.medianBlur(found, 3), cv2.MORPH_CLOSE, disc)
        return np.where(large_parts(binary_fill_holes(found), SHARE), np.uint8(255), np.uint8(0))

    def _even(self, image: np.ndarray) -> np.ndarray:
        """An image in float32, its border as bright as that of the others."""
        own = float(np.median(image[border_of(image.shape[:2])].mean(-1)))
        return np.asarray(image * ((self._exposure + 1) / (own + 1)), np.float32)


def _commonest(images: np.ndarray, near: float) -> tuple[np.ndarray, np.ndarray]:
    """The colour (h, w, 3) of each pixel of images (N, h, w, 3) that most of the others are near to, and how many are (h, w): a background recurs, and a
    texture that turns does not."""
    best, support = images[0].copy(), np.zeros(images.shape[1:3], np.int32)
    for one in images:
        close = np.zeros(support.shape, np.int32)
        total = np.zeros_like(one)
        for other in images:
            like = np.abs(other - one).max(-1) < near
            close += like
            total += other * like[..., None]
        more = close > support
        support = np.where(more, close, support)
        best[more] = total[more] / close[more, None]
    return best, support


def sharpened(mask: np.ndarray, rgb: np.ndarray) -> np.ndarray:
    """A mask at the size of its photograph (H, W, 3) uint8, its edge moved to the photograph's."""
    large = cv2.resize(mask, (rgb.shape[1], rgb.shape[0]), interpolation=cv2.INTER_LINEAR).astype(np.float32) / 255
    radius = max(2, round(GUIDE_RADIUS * max(rgb.shape[:2]) / SIDE))
    soft = cv2.ximgproc.guidedFilter(rgb.astype(np.float32) / 255, large, radius, GUIDE_EPSILON)
    return without_specks(np.round(np.clip((soft - 0.25) * 2, 0, 1) * 255).astype(np.uint8))


def border_of(shape: tuple[int, ...]) -> np.ndarray:
    """(h, w) bool: the strip along the border of a picture."""
    wide = max(1, round(BORDER * max(shape)))
    strip = np.ones(shape, bool)
    strip[wide:-wide, wide:-wide] = False
    return strip
