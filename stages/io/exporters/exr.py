"""OpenEXR: linear colour premultiplied by alpha, depth and normals, float32, as compositors read them.

Channels: R G B A (linear light, Rec. 709 primaries), depth.Z (along the view axis, in the capture's units; infinity where nothing is hit),
normal.X normal.Y normal.Z (unit, in the capture's frame; zero where nothing is hit).
"""

from __future__ import annotations

import errno
import io
import os
from pathlib import Path

import numpy as np

from efficientnerf.geometry.cameras import Similarity
from pipeline.files import atomic


def write_exr(
    path: Path, *, colour: np.ndarray, opacity: np.ndarray, depth: np.ndarray, normal: np.ndarray, world_from_capture: Similarity | None = None
) -> None:
    """Write one rendering.

    colour   (H, W, 3)  sRGB, premultiplied by the opacity, over no background
    opacity  (H, W)
    depth    (H, W)     along the view axis, world units
    normal   (H, W, 3)  unit, world frame
    world_from_capture  what takes depth and normals back to the capture's frame; None: they are in it

    The file appears whole or not at all.
    """
    import OpenEXR

    from efficientnerf.rendering.colour import linear_premultiplied

    scale, rotation = (1.0, np.eye(3)) if world_from_capture is None else (world_from_capture.scale, world_from_capture.rotation)
    rgba = np.concatenate([linear_premultiplied(colour, opacity), opacity[..., None]], axis=-1)
    in_capture = normal @ rotation  # rows times R: the transpose of R applied to each
    # OpenEXR silently writes wrong data for arrays that are not contiguous, and refuses float64.
    channels = {"RGBA": _plane(rgba), "depth.Z": _plane(depth / scale)}
    channels |= {f"normal.{axis}": _plane(in_capture[..., k]) for k, axis in enumerate("XYZ")}
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    with atomic(path) as temporary:
        try:
            image = OpenEXR.File(header, channels)
            # In memory: to a file the library writes without looking at what became of it, and leaves a damaged one after an error.
            memory = io.BytesIO()
            try:
                image.write(memory)
            except TypeError:  # versions that write to files alone
                image.write(str(temporary))
            else:
                temporary.write_bytes(memory.getvalue())
        except RuntimeError as error:
            # The library has one exception for everything; a full disk is a case of its own.
            for number in (errno.ENOSPC, errno.EDQUOT):
                if os.strerror(number) in str(error):
                    raise OSError(number, os.strerror(number), str(path)) from error
            raise


def _plane(values: np.ndarray) -> np.ndarray:
    return np.ascontiguousarray(values, np.float32)
