"""sRGB and linear light (IEC 61966-2-1), and premultiplication: images are sRGB unless their name says linear."""

import numpy as np

_LARGEST_EXPONENT = {4: 88.0, 8: 709.0}  # of exp, by the bytes of a number


def linear_from_srgb(srgb: np.ndarray) -> np.ndarray:
    """Light of sRGB values, any shape; float32 stays float32, else float64. Values below 0 and above 1 continue the curve."""
    srgb = _floating(srgb)
    return np.where(srgb <= 0.04045, srgb / 12.92, ((np.maximum(srgb, 0.0) + 0.055) / 1.055) ** 2.4).astype(srgb.dtype)


def srgb_from_linear(linear: np.ndarray) -> np.ndarray:
    """The inverse of linear_from_srgb."""
    linear = _floating(linear)
    return np.where(linear <= 0.0031308, linear * 12.92, 1.055 * np.maximum(linear, 0.0) ** (1.0 / 2.4) - 0.055).astype(linear.dtype)


def sigmoid(values: np.ndarray) -> np.ndarray:
    """1 / (1 + exp(-x)) in the type of the values, floating point; where exp would overflow it is as good as 0."""
    return np.asarray(1 / (1 + np.exp(np.minimum(-values, _LARGEST_EXPONENT[values.dtype.itemsize]))), values.dtype)


def straight_from_premultiplied(colour: np.ndarray, opacity: np.ndarray) -> np.ndarray:
    """(..., 3) colour premultiplied by opacity (...) -> straight; black where the opacity is zero."""
    opacity = opacity[..., None]
    return np.divide(colour, opacity, out=np.zeros_like(colour), where=opacity > 1e-6)


def linear_premultiplied(colour: np.ndarray, opacity: np.ndarray) -> np.ndarray:
    """sRGB colour (..., 3) premultiplied by opacity (...) -> linear light premultiplied by it.

    The curve bends, so it has to be taken of the straight colour: lin(c / a) a, not lin(c).
    """
    return linear_from_srgb(straight_from_premultiplied(colour, opacity)) * opacity[..., None]


def _floating(values: np.ndarray) -> np.ndarray:
    values = np.asarray(values)
    return values if np.issubdtype(values.dtype, np.floating) else values.astype(np.float64)
