"""Colour keys: the screen of one colour in a photograph.

The screen's colour is followed across the photograph by a polynomial, for no lamp lights it evenly; a pixel's distance from it, in CIELAB, says how much of the
pixel is object. Shadows on a coloured screen change its lightness more than its hue, so lightness counts little there. (h, w) of a photograph.
"""

from dataclasses import dataclass

import cv2
import numpy as np

LEAST_SCREEN = 0.05  # of the pixels, that are like the screen
LOWEST, RAMP, NOISE = 4.0, 12.0, 4.0  # CIELAB: distance up to which all is screen, at least; to where all is object; in deviations of the screen's own
SPECK, HOLE = 1e-3, 5e-5  # shares of the largest part, and of the picture, below which parts and holes go
SHADOWED = 0.15  # weight of lightness before coloured screens
EDGE = 2  # px that soft edges are wide to each side
BORDER = 0.02  # of the longer side: the strip in which a white screen begins
ROUNDS, FITTED = 4, 20_000  # of the fit; pixels of it


@dataclass(frozen=True)
class Key:
    """A colour to key by."""

    lightness: float  # weight of differences in lightness
    from_border: bool = False  # the screen is what the border touches: white parts of an object are no screen
    colour: tuple[float, float, float] | None = None  # (L, a, b), or None: `chroma` decides
    chroma: str = ""  # "green": any screen green as lamps and cloth make it; "white": any bright grey


def key_of(name: str) -> Key:
    """green, white, or a colour as #rrggbb. Raises ValueError."""
    if name in ("green", "white"):
        return Key(SHADOWED if name == "green" else 0.6, from_border=name == "white", chroma=name)
    if len(name) != 7 or name[0] != "#":
        raise ValueError(f"{name}: expected green, white or a colour as #rrggbb")
    red, green, blue = bytes.fromhex(name[1:])
    lab = _lab(np.array([[[red, green, blue]]], np.uint8))[0, 0]
    grey = float(np.hypot(lab[1], lab[2])) < 12
    return Key(1.0 if grey else SHADOWED, colour=(float(lab[0]), float(lab[1]), float(lab[2])))


def keyed(rgb: np.ndarray, key: Key) -> np.ndarray | None:
    """(h, w) uint8: how much of each pixel of an sRGB image (h, w, 3) uint8 is object, 0 to 255; None where too little of it is screen."""
    lab = _lab(cv2.GaussianBlur(rgb, (3, 3), 0))
    like = _candidates(lab, key)
    if key.from_border:
        like = _touching_border(like)
    if like.mean() < LEAST_SCREEN:
        return None
    distance = _distance(lab, _screen(lab, like, key), key)
    own = distance[like]
    low = max(LOWEST, float(np.median(own)) + NOISE * 1.4826 * float(np.median(np.abs(own - np.median(own)))))
    share = _mixed(distance, low)
    if key.from_border:
        share[~_touching_border(share < 0.5) & (share < 0.5)] = 1
    return without_specks(np.round(share * 255).astype(np.uint8))


def _distance(lab: np.ndarray, screen: np.ndarray, key: Key) -> np.ndarray:
    """(h, w) float32 between pixels and the screen's colour there. A shadow takes a colour's a and b down with its lightness: L + 16, a and b are all cube
    roots of light."""
    dimmed = screen[..., 1:] * np.clip((lab[..., :1] + 16) / (screen[..., :1] + 16), 0, 1)
    away = np.concatenate([key.lightness * (lab - screen)[..., :1], lab[..., 1:] - dimmed], -1)
    return np.asarray(np.sqrt((away**2).sum(-1)), np.float32)


def _mixed(distance: np.ndarray, low: float) -> np.ndarray:
    """(h, w) from 0 to 1: how much of each pixel is object. Next to the screen, a pixel as far from it as the object nearby is object alone; mixed ones lie
    between. Elsewhere whatever differs is object."""
    near = cv2.dilate((distance < low).astype(np.uint8), np.ones((2 * EDGE + 1,) * 2, np.uint8)) > 0
    whole = np.where(near, np.maximum(cv2.dilate(distance, np.ones((2 * EDGE + 1,) * 2, np.uint8)) - low, RAMP), RAMP)
    return np.asarray(np.clip((distance - low) / whole, 0, 1))


def _lab(rgb: np.ndarray) -> np.ndarray:
    """(h, w, 3) float32 CIELAB."""
    return np.asarray(cv2.cvtColor(rgb.astype(np.float32) / 255, cv2.COLOR_RGB2LAB), np.float32)


def _candidates(lab: np.ndarray, key: Key) -> np.ndarray:
    """(h, w) bool: what may be screen."""
    lightness, a, b = np.moveaxis(lab, -1, 0)
    if key.colour is not None:
        weights = np.array([key.lightness, 1, 1], np.float32)
        return np.asarray((((lab - np.array(key.colour, np.float32)) * weights) ** 2).sum(-1) < 30**2)
    if key.chroma == "white":
        return np.asarray((lightness > 70) & (np.hypot(a, b) < 12))
    hue = np.degrees(np.arctan2(b, a))
    return np.asarray((np.hypot(a, b) > 25) & (hue > 105) & (hue < 170))


def _screen(lab: np.ndarray, like: np.ndarray, key: Key) -> np.ndarray:
    """(h, w, 3) float32: the screen's colour at each pixel, a polynomial of degree 2 through those that are like it; outliers are left out."""
    h, w = like.shape
    rows, columns = np.nonzero(like)
    step = max(1, len(rows) // FITTED)
    rows, columns = rows[::step], columns[::step]
    terms, values = _terms(rows / h, columns / w), lab[rows, columns].astype(np.float64)
    weights = np.array([key.lightness, 1, 1])
    kept = np.ones(len(rows), bool)
    for _ in range(ROUNDS):
        found = np.linalg.lstsq(terms[kept], values[kept], rcond=None)[0]
        away = np.sqrt((((values - terms @ found) * weights) ** 2).sum(-1))
        kept = away <= 3 * max(float(np.median(away[kept])), 0.5)
    y, x = np.mgrid[:h, :w]
    return np.asarray((_terms(y.ravel() / h, x.ravel() / w) @ found).reshape(h, w, 3), np.float32)


def _terms(y: np.ndarray, x: np.ndarray) -> np.ndarray:
    return np.stack([np.ones_like(x), x, y, x * x, x * y, y * y], -1)


def _touching_border(region: np.ndarray) -> np.ndarray:
    """(h, w) bool: the parts of a region that reach into the border."""
    _, labels = cv2.connectedComponents(region.astype(np.uint8), connectivity=4)
    strip = np.zeros_like(region)
    wide = max(1, round(BORDER * max(region.shape)))
    strip[:wide], strip[-wide:], strip[:, :wide], strip[:, -wide:] = True, True, True, True
    return np.asarray(np.isin(labels, np.unique(labels[strip & region])) & region)


def without_specks(mask: np.ndarray) -> np.ndarray:
    """A mask (h, w) uint8 without parts much smaller than the largest, and without pinholes."""
    inside = mask > 127
    mask = np.where(_small_parts(inside, SPECK * inside.sum()), np.uint8(0), mask)
    return np.where(_small_parts(mask <= 127, HOLE * mask.size), np.uint8(255), mask)


def large_parts(region: np.ndarray, share: float) -> np.ndarray:
    """(h, w) bool: the connected parts of a region that have at least this share of the pixels of the largest one."""
    _, labels, stats, _ = cv2.connectedComponentsWithStats(region.astype(np.uint8), connectivity=8)
    areas = stats[1:, cv2.CC_STAT_AREA]
    return np.asarray(np.concatenate([[False], areas >= share * areas.max(initial=0)])[labels])


def _small_parts(region: np.ndarray, area: float) -> np.ndarray:
    """(h, w) bool: the connected parts of a region of fewer pixels than `area`, but the largest one."""
    _, labels, stats, _ = cv2.connectedComponentsWithStats(region.astype(np.uint8), connectivity=8)
    areas = stats[1:, cv2.CC_STAT_AREA]
    small = areas < area
    if len(areas):
        small[np.argmax(areas)] = False
    return np.asarray(np.concatenate([[False], small])[labels])
