"""What the sky of an unbounded scene begins with: the plain regions that photographs show above the horizon.

Before a sky of another colour a field learns the sky of the photographs as a shell round the subject, which costs nothing and stays: nothing in it shows how
far away it is. Before the right one there is nothing to learn. It only begins so: where photographs show a plain wall above the horizon, what differs from
direction to direction is learned by the field as before. docs/experiments/whole-scene.md

P pixels, K harmonics.
"""

import numpy as np

from efficientnerf.model import SKY_DEGREE, SKY_LEAST
from efficientnerf.rendering.harmonics import C0, basis_numpy, harmonics_count
from efficientnerf.training.pixels import Pixels
from efficientnerf.training.plain_regions import plain_discs

LEAST_RADIUS = 0.015  # of plain discs, over the longer side of their picture: smaller ones are anything
HORIZON = 0.05  # height of a direction from which it counts
LEAST_VIEWS, MOST_VIEWS = 3, 32  # that have to show such pixels; that they are looked for in
MOST_PIXELS = 2**16  # that are taken
BINS = 6.0  # of directions along an axis of a unit cube: each photograph that shows one counts alike, however many pixels it has there
SCALE = 0.05  # of the differences of colours that count less and less
MOST_OFF = 0.08  # median of them, from which what is plain there is no function of the direction
ROUNDS = 10  # of weighted least squares
GREY = 800  # random directions, of which those below the horizon are drawn to grey, as they were


def sky_of_colour(colour: np.ndarray) -> np.ndarray:
    """(K, 3) harmonics of a sky of one colour (3,), 0-1."""
    out = np.zeros((harmonics_count(SKY_DEGREE), 3))
    out[0] = _logit(colour) / C0
    return out


def sky_of(pixels: Pixels) -> np.ndarray | None:
    """(K, 3) harmonics of `efficientnerf.model.Sky` that plain regions above the horizon have; None: too few photographs show any, or they do not agree."""
    discs = plain_discs(pixels, MOST_VIEWS)
    if discs is None:
        return None
    view = pixels.view_of(discs.pixel)
    pixel = discs.pixel[discs.radius >= LEAST_RADIUS * np.maximum(pixels.width, pixels.height)[view]]
    pixel = pixel[:: -(-len(pixel) // MOST_PIXELS) or 1]
    if not len(pixel):
        return None
    _, directions, _, _, colours = pixels.bundle(pixel)
    above = directions[:, 2] > HORIZON
    view = pixels.view_of(pixel[above])
    if len(np.unique(view)) < LEAST_VIEWS:
        return None
    harmonics, off = _fitted(directions[above].astype(np.float64), colours[above].astype(np.float64), view)
    return harmonics if off <= MOST_OFF else None


def _fitted(directions: np.ndarray, colours: np.ndarray, view: np.ndarray) -> tuple[np.ndarray, float]:
    """Harmonics (K, 3) of colours (P, 3) in directions (P, 3) that photographs (P,) show, some of which may show others, and the median difference, of the
    channel where it is greatest."""
    bins = np.column_stack([np.floor(BINS * directions).astype(np.int64), view])
    _, of, count = np.unique(bins, axis=0, return_inverse=True, return_counts=True)
    each = 1 / count[of.ravel()]
    shown = basis_numpy(directions, SKY_DEGREE)
    below = np.random.Generator(np.random.Philox(0)).normal(size=(GREY, 3))
    below /= np.linalg.norm(below, axis=1, keepdims=True)
    grey = basis_numpy(below[below[:, 2] < -2 * HORIZON], SKY_DEGREE)
    grey = grey.T @ grey / len(grey)
    wanted = _logit(colours)
    weight, off = each, np.zeros(len(colours))
    for _ in range(ROUNDS):
        weighted = (weight / weight.sum())[:, None] * shown
        harmonics = np.linalg.solve(weighted.T @ shown + grey, weighted.T @ wanted)
        off = np.abs(1 / (1 + np.exp(-shown @ harmonics)) - colours).max(axis=1)
        weight = each / (1 + (off / SCALE) ** 2)
    order = np.argsort(off)
    return harmonics, float(off[order[np.searchsorted(np.cumsum(each[order]), each.sum() / 2)]])


def _logit(colours: np.ndarray) -> np.ndarray:
    """What the sky's sigmoid makes colours of."""
    bounded = colours.clip(SKY_LEAST, 1 - SKY_LEAST)
    return np.asarray(np.log(bounded / (1 - bounded)))
