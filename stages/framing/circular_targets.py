"""Circular coded targets, as photogrammetry programs print them: a disc, a plain gap, and arcs round it that are a code, in one ring or two.

They are counted, so that they can be named; what they encode differs from program to program, and is not read. docs/experiments/true-size.md
"""

import cv2
import numpy as np

SMALLEST, LARGEST = 3.5, 200.0  # px, semi-axes of the disc
FLATTEST = 0.3  # its shorter axis over its longer one
ROUND = 0.02  # of the square of its outline's length, its area at least
CONTRAST = 40  # grey levels between the disc and the gap
RADII = np.arange(0.5, 6.01, 0.1)  # of circles round the disc, in its own radii
ANGLES = 120
PLAIN = 0.04  # share of a circle that may be of the other colour where it is plain
GAP, ARCS, MARGIN = (2, 16), (4, 30), 3  # steps of RADII, how wide
MAX_UNEVENNESS = 0.1  # of the contrast, how far it is from the paper's light in the mean
FEWEST, SHORTEST = 4, 3  # arcs and spaces between them; steps of ANGLES that one has
SHARP = 0.8  # share of a code's samples that are dark or bright, and not between
STEADY = 0.94  # share of them that are as those of the next circle
UNEVEN = 1.9  # times its shortest arc or space the longest of a code: rays and spokes are alike
Ellipse = tuple[tuple[float, float], tuple[float, float], float]  # as OpenCV has them: middle, axes, degrees


def count_targets(grey: np.ndarray) -> int:
    """How many a picture (H, W) uint8 shows."""
    middles: list[np.ndarray] = []
    for ellipse in discs(grey):
        middle, reach = np.array(ellipse[0]), max(ellipse[1]) / 2
        if all(np.linalg.norm(middle - other) > reach for other in middles) and is_coded(circles_round(grey, ellipse)):
            middles.append(middle)
    return len(middles)


def discs(grey: np.ndarray) -> list[Ellipse]:
    """Ellipses that an outline follows."""
    dark = cv2.adaptiveThreshold(grey, 255, cv2.ADAPTIVE_THRESH_MEAN_C, cv2.THRESH_BINARY_INV, 41, 9)
    found = []
    for contour in cv2.findContours(dark, cv2.RETR_LIST, cv2.CHAIN_APPROX_NONE)[0]:
        if not 5 * SMALLEST < len(contour) < 7 * LARGEST:
            continue
        area = cv2.contourArea(contour)
        if area < ROUND * len(contour) ** 2:
            continue
        ellipse = cv2.fitEllipseDirect(contour)
        short, long = sorted(ellipse[1])
        whole = abs(area / (np.pi / 4 * short * long) - 1) < 0.06 + 1.2 / short
        if whole and short >= max(2 * SMALLEST, FLATTEST * long) and long <= 2 * LARGEST:
            found.append(ellipse)
    return found


def circles_round(grey: np.ndarray, ellipse: Ellipse) -> np.ndarray:
    """(RADII, ANGLES) float32 light on circles round a disc, as if seen from above; outside of the picture that of its border."""
    (x, y), axes, degrees = ellipse
    angles, turn = np.linspace(0, 2 * np.pi, ANGLES, endpoint=False), np.radians(degrees)
    across = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]]) * np.array(axes) / 2
    at = (RADII[:, None, None] * (np.stack([np.cos(angles), np.sin(angles)], 1) @ across.T) + [x, y]).astype(np.float32)
    return np.asarray(cv2.remap(grey, at[..., 0], at[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE), np.float32)


def is_coded(circles: np.ndarray) -> bool:
    """Whether circles (RADII, ANGLES) are those of a target: of a disc, plain, with arcs that differ in length, and plain again."""
    gap = int(np.searchsorted(RADII, 1.25))
    ink, paper = float(np.median(circles[: gap - 5])), float(np.median(circles[gap : gap + 3]))
    if abs(ink - paper) < CONTRAST:
        return False
    light = (circles - paper) / (ink - paper)
    inked = light > 0.5
    plain = inked.mean(1) <= PLAIN
    begin = _until(~plain, gap)
    end = _until(plain, begin)
    wide = GAP[0] <= begin - gap <= GAP[1] and ARCS[0] <= end - begin <= ARCS[1] and end + MARGIN < len(RADII)
    if not (wide and inked[: gap - 4].mean(1).min() >= 1 - PLAIN and plain[end : end + MARGIN].all()):
        return False
    if max(np.abs(light[gap : begin - 1]).mean(), np.abs(light[end + 1 : end + 1 + MARGIN]).mean()) > MAX_UNEVENNESS:
        return False
    ring, code = light[begin + 1 : end - 1], inked[begin + 1 : end - 1]
    sharp = (np.minimum(np.abs(ring), np.abs(ring - 1)) < 0.35).mean()
    steady = (code[1:] == code[:-1]).mean()  # arcs end where rays from the middle do; of two rings, but for where they meet
    lengths = [_arcs(code[len(code) * k // 4]) for k in (1, 3)]
    some = any(len(each) >= FEWEST and each.min() >= SHORTEST and each.max() > UNEVEN * each.min() for each in lengths)
    return bool(some and sharp > SHARP and steady > STEADY)


def _until(some: np.ndarray, start: int) -> int:
    """The first index from a start on at which something is so; the number of them where there is none."""
    at = np.flatnonzero(some[start:])
    return start + int(at[0]) if len(at) else len(some)


def _arcs(code: np.ndarray) -> np.ndarray:
    """Lengths of arcs and of spaces of a code (ANGLES,), steps."""
    ends = np.flatnonzero(code != np.roll(code, 1))
    return np.diff(np.append(ends, ends[:1] + len(code)))
