"""The views that are measured: which, at which pixels, and the images that renders are compared with."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np

from efficientnerf.evaluation.metrics import psnr, ssim
from efficientnerf.geometry.cameras import MODELS, Camera
from efficientnerf.model import UNSEEN
from stages.io.scene import Scene, View, read_image, read_mask, views_of

MAX_PSNR = 100.0  # decibels, of equal images: JSON has no infinity


@dataclass(frozen=True, eq=False)
class GroundTruth:
    """The image that a render is compared with."""

    colour: np.ndarray  # (H, W, 3) float32, on the scene's background
    mask: np.ndarray | None  # (H, W) bool, pixels that are compared; None: all
    inside: np.ndarray | None  # (H, W) bool, pixels that the image's alpha covers; None without alpha

    @property
    def used(self) -> np.ndarray:
        """(H, W) bool: pixels that are compared."""
        return np.ones(self.colour.shape[:2], bool) if self.mask is None else self.mask

    def psnr(self, image: np.ndarray, among: np.ndarray | None = None) -> float | None:
        """Over the pixels that are compared, of those `among` (H, W): at most MAX_PSNR; None where there are none."""
        used = self.used if among is None else self.used & among
        return min(MAX_PSNR, psnr(image, self.colour, used)) if used.any() else None

    def ssim(self, image: np.ndarray) -> float | None:
        """None where no whole window can be compared."""
        return ssim(image, self.colour, self.mask) if self.used[5:-5, 5:-5].any() else None

    def subsampled(self, stride: int) -> GroundTruth:
        """That of the pixels that `subsample` keeps."""
        return GroundTruth(subsample(self.colour, stride), *(None if part is None else subsample(part, stride) for part in (self.mask, self.inside)))


def evaluation_views(scene: Scene) -> tuple[tuple[View, ...], str]:
    """The views to report on and their split: test, else val, else train. Raises ValueError where the scene has no views."""
    for split in ("test", "val", "train"):
        views = views_of(scene, split)
        if views:
            return views, split
    raise ValueError("the scene holds no views")


def evenly_spaced(count: int, wanted: int | None) -> list[int]:
    """`wanted` of the indices below `count`; None: all."""
    if wanted is None or wanted >= count:
        return list(range(count))
    return [int((k + 0.5) * count / wanted) for k in range(wanted)]


def stride_for(views: Sequence[View], rays: int) -> int:
    """The stride at which the views together have at most about this many rays."""
    total = sum(view.camera.width * view.camera.height for view in views)
    return bounded_stride(views, max(1, math.ceil(math.sqrt(total / rays))))


def stride_to(camera: Camera, longest: int) -> int:
    """The stride that leaves at most so many pixels along the longest side."""
    return max(1, math.ceil(max(camera.width, camera.height) / longest))


def bounded_stride(views: Sequence[View], stride: int) -> int:
    """The stride, or the largest one that leaves a pixel of each view."""
    return min([stride, *(min(view.camera.width, view.camera.height) for view in views)])


def ground_truth(folder: Path, view: View, background: tuple[float, float, float] | None, stride: int = 1) -> GroundTruth:
    """The image of a view at working size, of the pixels that `subsample` keeps.

    background  what images with alpha are composited on; None: alpha below one half masks
    """
    pixels = subsample(read_image(folder, view), stride).astype(np.float32) / 255.0
    mask = read_mask(folder, view)
    mask = None if mask is None else subsample(mask, stride)
    if pixels.shape[2] == 3:
        return GroundTruth(pixels, mask, None)
    alpha = pixels[..., 3]
    if background is None:
        covered = alpha >= 0.5
        return GroundTruth(pixels[..., :3], covered if mask is None else mask & covered, None)
    colour = pixels[..., :3] * alpha[..., None] + (1.0 - alpha[..., None]) * np.asarray(background, np.float32)
    return GroundTruth(colour, mask, alpha > 0)


def subsample_camera(camera: Camera, stride: int) -> Camera:
    """The camera whose pixel centres are those of the pixels that `subsample` keeps."""
    first = (stride - 1) // 2
    params = []
    for name, value in zip(MODELS[camera.model], camera.params, strict=True):
        if name in ("cx", "cy"):
            value = (value - first - 0.5) / stride + 0.5
        elif name in ("f", "fx", "fy"):
            value = value / stride
        params.append(value)
    width, height = (len(range(first, size, stride)) for size in (camera.width, camera.height))
    return replace(camera, width=width, height=height, params=tuple(params))


def subsample(values: np.ndarray, stride: int) -> np.ndarray:
    """Every stride-th row and column, beginning in the middle of the first stride; (H, W, ...) -> (H', W', ...)."""
    first = (stride - 1) // 2
    return values[first::stride, first::stride]


def upsample(values: np.ndarray, stride: int, width: int, height: int) -> np.ndarray:
    """The inverse of `subsample`: bilinear, clamped at the border; (H', W', ...) -> (height, width, ...)."""
    values = np.ascontiguousarray(values, np.float32)
    if stride == 1:
        return values
    first = (stride - 1) // 2
    x, y = np.meshgrid((np.arange(width, dtype=np.float32) - first) / stride, (np.arange(height, dtype=np.float32) - first) / stride)
    return np.asarray(cv2.remap(values, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE))


def constant_background(scene: Scene) -> tuple[float, float, float] | None:
    """The colour behind the asset in bounded and forward-facing scenes; None in unbounded ones."""
    return scene.background if scene.background is not None or scene.forward is None else (UNSEEN, UNSEEN, UNSEEN)
