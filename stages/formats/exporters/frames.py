"""Frames of a render: 8 bits, sRGB, straight alpha, over a background."""

import numpy as np

from efficientnerf.rendering.colour import straight_from_premultiplied
from pipeline.errors import UsageError
from stages.figures.plots import to_uint8

NAMED = {"white": (1.0, 1.0, 1.0), "black": (0.0, 0.0, 0.0)}


def frame_background(text: str) -> tuple[float, float, float] | None:
    """The sRGB colour (0-1) of "white", "black", "#rrggbb" or "auto": white, unless the asset's environment takes its place. None for "transparent".
    UsageError for anything else."""
    if text == "transparent":
        return None
    if text in ("auto", *NAMED):
        return NAMED["white" if text == "auto" else text]
    digits = text.removeprefix("#")
    if text.startswith("#") and len(digits) == 6 and all(digit in "0123456789abcdefABCDEF" for digit in digits):
        red, green, blue = (int(digits[k : k + 2], 16) / 255.0 for k in (0, 2, 4))
        return red, green, blue
    raise UsageError(f"background: found {text!r}, expected white, black, transparent or #rrggbb")


def frame_from_rendering(colour: np.ndarray, opacity: np.ndarray, background: tuple[float, float, float] | None) -> np.ndarray:
    """The 8-bit frame of a rendering.

    colour      (H, W, 3) sRGB premultiplied by opacity (H, W)
    background  sRGB colour below it; None keeps the alpha
    returns     (H, W, 3) or, without a background, (H, W, 4) uint8
    """
    if background is not None:
        return to_uint8(colour + (1.0 - opacity[..., None]) * np.asarray(background, np.float32))
    straight = straight_from_premultiplied(colour, opacity)
    return to_uint8(np.concatenate([straight, opacity[..., None]], axis=-1))


def over_background(frame: np.ndarray, background: tuple[float, float, float]) -> np.ndarray:
    """(H, W, 4) uint8 over a colour -> (H, W, 3) uint8; RGB passes through."""
    if frame.shape[2] == 3:
        return frame

    values = frame.astype(np.float32) / 255.0
    alpha = values[..., 3:]
    return to_uint8(values[..., :3] * alpha + (1.0 - alpha) * np.asarray(background, np.float32))
