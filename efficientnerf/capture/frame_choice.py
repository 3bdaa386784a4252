"""Which frames of a video are chosen: the sharpest of windows of equal motion, no two alike, none that is blurred. docs/experiments/video.md"""

from collections.abc import Sequence
from itertools import pairwise

import numpy as np

ALIKE = 0.004  # of the picture's diagonal: frames between which less has moved are alike
APART = 0.4  # of a window: motion between two that are chosen, at least where
AS_SHARP = 0.9  # a frame so far from the one before has this share of the sharpness of one that is nearer
DISCOUNT = 4  # power of a frame's sharpness over the median round it, by which its motion counts less: a shaking hand moves much, without a new view
AROUND = 15  # frames on each side that this median is of
BLURRED = 0.7  # of the median sharpness of the chosen round it
NEIGHBOURS = 8  # chosen frames on each side that this median is of
CHOSEN, LESS_SHARP, SAME, BLUR = "chosen", "less sharp than a frame near it", "like a chosen one", "blurred"


def choose(motion: np.ndarray, sharpness: np.ndarray, count: int) -> list[str]:
    """The verdict on each frame: `CHOSEN`, or why not.

    motion     (F,) how far the picture has moved up to each frame, in shares of its diagonal, never falling
    sharpness  (F,) as `efficientnerf.capture.frame_motion.sharpness`
    count      frames to choose at most

    Time does not count: a camera that stands gives one frame, and frames may come at any rate. Of equally sharp frames the first is chosen.
    """
    usual = np.array([np.median(sharpness[max(0, frame - AROUND) : frame + AROUND + 1]) for frame in range(len(motion))])
    counts = np.clip(sharpness / np.maximum(usual, 1e-9), 0.0, 1.0) ** DISCOUNT
    useful = np.concatenate([[0.0], np.cumsum(np.diff(motion) * np.minimum(counts[1:], counts[:-1]))])  # from and to blurred frames less
    windows = max(1, min(count, 1 + int(useful[-1] / ALIKE)))
    chosen = _sharpest(motion, useful, sharpness, windows)
    blurred = _blurred(sharpness, chosen)
    kept = np.array([frame for frame in chosen if frame not in blurred], int)
    verdicts = []
    for frame in range(len(motion)):
        if frame in blurred:
            verdicts.append(BLUR)
        elif frame in kept:
            verdicts.append(CHOSEN)
        else:
            verdicts.append(SAME if np.abs(motion[kept] - motion[frame]).min() < ALIKE else LESS_SHARP)
    return verdicts


def _sharpest(motion: np.ndarray, useful: np.ndarray, sharpness: np.ndarray, windows: int) -> list[int]:
    """The sharpest frame of each window of equal `useful` motion that is not like the one before, nor needlessly near to it."""
    width = useful[-1] / windows
    window = np.minimum(useful / max(width, 1e-12), windows - 1).astype(int)
    chosen: list[int] = []
    bounds = np.searchsorted(window, np.arange(windows + 1))
    for begin, end in pairwise(bounds):
        before, reached = (motion[chosen[-1]], useful[chosen[-1]]) if chosen else (-np.inf, -np.inf)
        frames = begin + np.flatnonzero(motion[begin:end] >= before + ALIKE)
        if not len(frames):
            continue
        best = frames[np.argmax(sharpness[frames])]
        frames = frames[(useful[frames] >= reached + APART * width) & (sharpness[frames] >= AS_SHARP * sharpness[best])]
        chosen.append(int(frames[np.argmax(sharpness[frames])] if len(frames) else best))
    return chosen


def _blurred(sharpness: np.ndarray, chosen: Sequence[int]) -> set[int]:
    """Those of the chosen that are blurred compared with neighbours; never two that follow each other, so that the next still overlaps."""
    found: set[int] = set()
    values = sharpness[list(chosen)]
    for place, frame in enumerate(chosen):
        around = values[max(0, place - NEIGHBOURS) : place + NEIGHBOURS + 1]
        if 0 < place < len(chosen) - 1 and values[place] < BLURRED * np.median(around) and chosen[place - 1] not in found:
            found.add(frame)
    return found


def shares(motions: Sequence[float], count: int) -> list[int]:
    """How many frames each of several videos gives at most, by how far the picture moves in it: `count` together, at least 2 of each."""
    total = sum(motions)
    return [max(2, int(count * (motion / total if total > 0 else 1 / len(motions)) + 0.5)) for motion in motions]
