"""How sharp a frame is, and how far the picture has moved since the first; frames are chosen by both. docs/experiments/video.md"""

from typing import Any

import cv2
import numpy as np

DETAIL = 640  # px, longest side of the picture in which sharpness is measured
TRACKED = 320  # px, longest side of the one in which motion is
NOISE = 0.7  # px, standard deviation of the blur that takes the noise away
BLUR = 8  # px
FLAT = 0.02  # squared levels: the contrast of a flat picture
CORNERS = 160
QUALITY, APART = 0.01, 9  # of the corners: least share of the best one's response; px
WINDOW = 15  # px, of a patch that is tracked
ROUND_TRIP = 1.0  # px at most between a corner and where it is tracked back to
ANCHOR = 0.04  # of the diagonal: from here on, motion is measured from a later frame
FEWEST = 12  # corners that are found again, or the picture is another
MAX_BLURRED_FRAMES = 6  # frames for which a picture that is not found again may be blurred only
MOVED = 75  # percentile of the corners' motions: the subject may fill a part of the picture, and stay while the rest moves


def sharpness(grey: np.ndarray) -> float:
    """The share of a picture's contrast from pixel to pixel that a blur would remove, in the direction in which that is least: motion blur has one direction.

    grey     (h, w) uint8, longest side `DETAIL`
    returns  0 for a flat picture, toward 1 the sharper; about the same for pictures that are equally sharp, whatever they show

    Crete et al. 2007, "The blur effect", with squares, which need no blurred picture: the difference of two neighbours that were blurred over n pixels
    is that of two pixels n apart, by n.
    """
    picture = cv2.GaussianBlur(grey.astype(np.float32), (0, 0), NOISE)
    near, far = _energies(picture, 1), _energies(picture, BLUR)
    return float(((near - far / BLUR**2) / (near + FLAT)).min().clip(0.0))


def _energies(picture: np.ndarray, n: int) -> np.ndarray:
    """(4,) mean squared differences of pixels that are n apart along rows, along columns and along both diagonals."""
    pairs = (
        (picture[:, n:], picture[:, :-n]),
        (picture[n:], picture[:-n]),
        (picture[n:, n:], picture[:-n, :-n]),
        (picture[n:, :-n], picture[:-n, n:]),
    )
    return np.array([cv2.norm(a, b, cv2.NORM_L2SQR) / max(1, a.size) for a, b in pairs])


class Motion:
    """How far the picture has moved along a video, in shares of its diagonal.

    Corners are tracked from an anchor; a new one is taken once they have moved by `ANCHOR`. So a hand that trembles in one place adds nothing;
    a pan, a walk and a turn add their motion.
    """

    def __init__(self) -> None:
        self._anchor: np.ndarray | None = None
        self._corners = self._latest = np.empty((0, 1, 2), np.float32)
        self._base = self._total = 0.0
        self._lost = 0

    def add(self, grey: np.ndarray) -> float:
        """The motion up to this frame; never less than up to the one before.

        grey  (h, w) uint8, longest side `TRACKED`
        """
        if self._anchor is None or self._anchor.shape != grey.shape:
            self._base = self._total + (0.0 if self._anchor is None else ANCHOR)
            self._set_anchor(grey)
            self._total = self._base
            return self._total
        moved = self._moved(grey)
        if moved is None:
            self._lost += 1
            if self._lost > MAX_BLURRED_FRAMES:  # a cut, or a pan that was quicker than can be tracked
                self._base = self._total = self._total + ANCHOR
                self._set_anchor(grey)
            return self._total
        self._lost = 0
        self._total = max(self._total, self._base + moved)
        if moved >= ANCHOR:
            self._base = self._total
            self._set_anchor(grey)
        return self._total

    def _set_anchor(self, grey: np.ndarray) -> None:
        corners = cv2.goodFeaturesToTrack(grey, CORNERS, QUALITY, APART)
        self._anchor, self._lost = grey, 0
        self._corners = self._latest = np.empty((0, 1, 2), np.float32) if corners is None else corners

    def _moved(self, grey: np.ndarray) -> float | None:
        """Since the anchor; None where its corners are not found again. Nothing moves in a picture without corners."""
        if len(self._corners) < FEWEST:
            self._set_anchor(grey)  # there may be some now
            self._base = self._total
            return 0.0
        options: dict[str, Any] = {"winSize": (WINDOW, WINDOW), "maxLevel": 3, "flags": cv2.OPTFLOW_USE_INITIAL_FLOW}
        there, seen, _ = cv2.calcOpticalFlowPyrLK(self._anchor, grey, self._corners, self._latest.copy(), **options)
        back, seen_back, _ = cv2.calcOpticalFlowPyrLK(grey, self._anchor, there, self._corners.copy(), **options)
        found = (seen[:, 0] > 0) & (seen_back[:, 0] > 0) & (np.linalg.norm(back - self._corners, axis=2)[:, 0] < ROUND_TRIP)
        if found.sum() < max(FEWEST, 0.2 * len(found)):
            return None
        steps = (there - self._corners)[:, 0]  # (N, 2)
        typical = np.median(steps[found], axis=0)
        self._latest = np.where(found[:, None, None], there, self._corners + typical.astype(np.float32))
        return float(np.percentile(np.linalg.norm(steps[found], axis=1), MOVED) / np.hypot(*grey.shape))
