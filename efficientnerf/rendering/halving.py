"""Pictures at half their size."""

from dataclasses import replace

import cv2
import numpy as np

from efficientnerf.geometry.cameras import Camera, resized


def halved(camera: Camera, pixels: np.ndarray, mask: np.ndarray | None) -> tuple[Camera, np.ndarray, np.ndarray | None]:
    """Camera, pixels and mask of a picture at half its size: each pixel the mean of four, by their alpha; it counts where all four do.

    pixels  (H, W, 3) or (H, W, 4) uint8 sRGB, alpha straight; of odd sizes the last row or column is left out
    mask    (H, W) bool, pixels that count; None: all
    """
    height, width = pixels.shape[0] // 2 * 2, pixels.shape[1] // 2 * 2
    pixels, size = np.ascontiguousarray(pixels[:height, :width]), (width // 2, height // 2)
    if pixels.shape[2] == 4:
        alpha = pixels[..., 3:].astype(np.float32)
        mean = cv2.resize(np.concatenate([pixels[..., :3] * alpha, alpha], axis=2), size, interpolation=cv2.INTER_AREA)
        mean[..., :3] /= np.maximum(mean[..., 3:], 1e-6)
        pixels = np.rint(mean).astype(np.uint8)
    else:
        pixels = np.asarray(cv2.resize(pixels, size, interpolation=cv2.INTER_AREA), np.uint8)
    if mask is not None:
        mask = np.asarray(mask[:height, :width].reshape(size[1], 2, size[0], 2).all((1, 3)))
    return resized(replace(camera, width=width, height=height), *size), pixels, mask
