"""Brown's lens model as photogrammetry programs state it, and the camera model that describes the same lens here.

    x' = x (1 + k1 r^2 + k2 r^4 + k3 r^6 + k4 r^8) + p2 (r^2 + 2 x^2) + 2 p1 x y          p1, p2 in OpenCV's order
    u  = fx x' + s y' + cx                                                               s: skew, pixels

Our models have neither k4 of r^8 nor a skew. A radial polynomial with k4 becomes the quotient of two cubics in r^2 (FULL_OPENCV) that is the same to
`MAX_ERROR` pixels as far as the image reaches; a skew that moves no pixel by more than `MAX_SKEW` is left out. Any other lens is refused.
"""

from collections.abc import Sequence

import numpy as np
from numpy.polynomial import polynomial

from efficientnerf.geometry.cameras import Camera
from pipeline.errors import BadInput

MAX_ERROR = 0.25  # pixels; half of what structure from motion leaves
MAX_SKEW = 0.5  # pixels, at the border of the image
_RADII = 400  # places on a radius at which models are compared
_FARTHEST = 3.0  # tangent of the widest angle to the axis that is compared: 143 degrees across
_LEAST = 0.1  # of the denominator
_REMEDY = "Export undistorted images and their cameras instead."


def brown_camera(
    name: str, size: tuple[int, int], focal: tuple[float, float], centre: tuple[float, float], pose: np.ndarray, where: str,
    radial: Sequence[float] = (), tangential: tuple[float, float] = (0, 0),
) -> Camera:
    """
    focal       fx, fy, pixels
    centre      cx, cy, pixels, the centre of the first pixel being at 0.5, 0.5
    radial      k1 to k4 at most
    tangential  p1, p2 in OpenCV's order
    Raises BadInput for a lens that no camera model describes.
    """
    k1, k2, k3, k4 = (*map(float, radial), 0.0, 0.0, 0.0, 0.0)[:4]
    fx, fy, cx, cy, p1, p2 = map(float, (*focal, *centre, *tangential))
    params: tuple[float, ...]
    if k4:
        top, bottom = quotient_of_cubics(np.array([1.0, k1, k2, k3, k4]), max(fx, fy), _reach(size, (fx, fy), (cx, cy)), where)
        model, params = "FULL_OPENCV", tuple(map(float, (fx, fy, cx, cy, top[1], top[2], p1, p2, top[3], *bottom[1:])))
    elif k3:
        model, params = "FULL_OPENCV", (fx, fy, cx, cy, k1, k2, p1, p2, k3, 0.0, 0.0, 0.0)
    elif k1 or k2 or p1 or p2:
        model, params = "OPENCV", (fx, fy, cx, cy, k1, k2, p1, p2)
    else:
        model, params = ("SIMPLE_PINHOLE", (fx, cx, cy)) if fx == fy else ("PINHOLE", (fx, fy, cx, cy))
    return Camera(name, *size, model, params, pose)


def _reach(size: tuple[int, int], focal: tuple[float, float], centre: tuple[float, float]) -> float:
    """Distorted radius, on the plane z = 1, of the corner that lies farthest out."""
    across = max(abs(centre[0]), abs(size[0] - centre[0])) / max(focal[0], 1e-6)
    along = max(abs(centre[1]), abs(size[1] - centre[1])) / max(focal[1], 1e-6)
    return float(np.hypot(across, along))


def quotient_of_cubics(factor: np.ndarray, focal: float, reach: float, where: str) -> tuple[np.ndarray, np.ndarray]:
    """(top, bottom), coefficients of s = r^2 from the constant 1 up to s^3, whose quotient is the radial factor, a polynomial of s, to `MAX_ERROR` pixels.

    reach  the distorted radius up to which it has to be. Raises BadInput where there is none.
    """
    r = np.linspace(0, _FARTHEST, _RADII)
    distorted = r * polynomial.polyval(r * r, factor)
    beyond = np.flatnonzero((distorted >= reach) | (np.diff(distorted, append=np.inf) <= 0))  # the image ends, or the model folds over
    r_max = r[beyond[0]] if len(beyond) else _FARTHEST
    r = np.linspace(0, max(r_max, r[1]), _RADII)
    s, d = r * r, polynomial.polyval(r * r, factor)
    unit = s / s[-1]  # for the conditioning
    columns = np.stack([unit, unit**2, unit**3, -d * unit, -d * unit**2, -d * unit**3], -1) * r[:, None]
    scale = s[-1] ** -np.arange(1.0, 4.0)
    for terms in (6, 5, 4, 3):  # with fewer in the denominator, where more give it a root
        found = np.zeros(6)
        found[:terms] = np.linalg.lstsq(columns[:, :terms], (d - 1) * r, rcond=None)[0]
        top, bottom = np.array([1.0, *found[:3] * scale]), np.array([1.0, *found[3:] * scale])
        below = polynomial.polyval(s, bottom)
        error = np.abs(polynomial.polyval(s, top) / np.where(below > _LEAST, below, np.inf) - d) * r * focal
        if below.min() > _LEAST and error.max() <= MAX_ERROR:
            return top, bottom
    raise BadInput(f"{where}: the radial distortion (k4 = {factor[4]:.4g}) is in no camera model that is supported. {_REMEDY}")


def without_skew(skew: float, focal: float, size: tuple[int, int], centre: float, what: str, where: str) -> str | None:
    """A sentence about a skew that is left out; None: there is none. Raises BadInput for one that shows.

    skew    pixels that x moves by for a y' of 1
    focal   fy
    centre  cy
    """
    farthest = abs(skew) * max(abs(centre), abs(size[1] - centre)) / max(focal, 1e-6)
    if not farthest <= MAX_SKEW:
        raise BadInput(f"{where}: {what} {skew:g} moves pixels by up to {farthest:.2g}; no camera model that is supported has a skew. {_REMEDY}")
    return f"{what} is left out (at most {farthest:.2g} pixels)" if farthest > 0.01 else None
