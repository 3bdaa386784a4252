"""OpenEXR: linear colour premultiplied by alpha, depth, normals and positions, float32, as compositors read them.

Channels: R G B A (linear light, Rec. 709 primaries), depth.Z (along the view axis, in the capture's units; infinity where nothing is hit),
normal.X normal.Y normal.Z (unit, in the capture's frame; zero where nothing is hit), position.X position.Y position.Z (of what is hit, in the
capture's frame; zero where nothing is).

Attributes of the header: unit, "metre" or "unknown"; where it is known metersPerUnit, as USD has it, of depths and positions.
"""

import errno
import io
import os
from pathlib import Path

import numpy as np
import OpenEXR

from efficientnerf.geometry.cameras import Camera, Similarity, rays
from efficientnerf.rendering.colour import linear_premultiplied
from pipeline.files import atomic
from stages.formats.exporters.writing import CAPTURE_IS_Z_UP, SourceFrame

PIXELS_AT_ONCE = 2**20  # whose rays are made


def write_exr(
    path: Path, *, colour: np.ndarray, opacity: np.ndarray, depth: np.ndarray, normal: np.ndarray, camera: Camera,
    frame: SourceFrame = CAPTURE_IS_Z_UP,
) -> None:  # fmt: skip
    """Write one rendering.

    colour   (H, W, 3)  sRGB, premultiplied by the opacity, over no background
    opacity  (H, W)
    depth    (H, W)     along the view axis, world units
    normal   (H, W, 3)  unit, world frame
    camera   that took it, in the world frame, H x W
    frame    the capture's, to which depth, normals and positions are taken back

    The file appears whole or not at all.
    """
    similarity = frame.world_from_capture
    scale, rotation = similarity.scale, similarity.rotation
    rgba = np.concatenate([linear_premultiplied(colour, opacity), opacity[..., None]], axis=-1)
    in_capture = normal @ rotation  # rows times R: the transpose of R applied to each
    # OpenEXR silently writes wrong data for arrays that are not contiguous, and refuses float64.
    channels = {"RGBA": _plane(rgba), "depth.Z": _plane(depth / scale)}
    place = positions(depth, camera, similarity)
    channels |= {f"{name}.{axis}": _plane(values[..., k]) for name, values in (("normal", in_capture), ("position", place)) for k, axis in enumerate("XYZ")}
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage, "unit": frame.unit} | ({"metersPerUnit": 1.0} if frame.metric else {})
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


def positions(depth: np.ndarray, camera: Camera, world_from_capture: Similarity) -> np.ndarray:
    """(H, W, 3) float32 places of what a camera sees at depths (H, W) along its view axis, in the capture's frame; zero where nothing is hit."""
    height, width = depth.shape
    out = np.zeros((height, width, 3), np.float32)
    back = world_from_capture.inverse()
    for first in range(0, height, max(1, PIXELS_AT_ONCE // width)):
        rows = slice(first, first + max(1, PIXELS_AT_ONCE // width))
        hit = np.isfinite(depth[rows])
        y, x = np.nonzero(hit)
        origins, directions = rays(camera, np.stack([x, y + first], axis=1) + 0.5)
        along = depth[rows][hit].astype(np.float64) / (directions @ camera.forward)
        out[rows][hit] = back.points(origins + along[:, None] * directions)
    return out


def _plane(values: np.ndarray) -> np.ndarray:
    return np.ascontiguousarray(values, np.float32)
