"""PSNR and SSIM of an image against the ground truth, as published in the NeRF literature.

Images are floating point, sRGB, 0 to 1, not rounded to 8 bits; callers clip values outside 0 to 1.
"""

import math
from collections import deque
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import torch
from skimage.metrics import structural_similarity

WINDOW = 11  # pixels a side of SSIM's Gaussian window
BAND = 256  # rows of an image that are compared at a time
SSIM_BAND, SSIM_THREADS = 64, 16  # that a thread compares at a time, and threads at most: each takes about 100 bytes a pixel of its band


def mean_squared_error(image: np.ndarray, truth: np.ndarray, mask: np.ndarray | None = None) -> float:
    """Mean over pixels and channels of the squared difference.

    image, truth  (H, W, 3) or (H, W)  floating point
    mask          (H, W) bool, True where a pixel counts; None: all
    Raises ValueError on different shapes, on integers and where no pixel counts.
    """
    image, truth, mask = _checked(image, truth, mask)
    squared = (image - truth) ** 2
    return float(squared.mean() if mask is None else squared[mask].mean())


def psnr(image: np.ndarray, truth: np.ndarray, mask: np.ndarray | None = None) -> float:
    """Peak signal to noise ratio in decibels for a peak of 1; infinite where the images are equal. Arguments as for mean_squared_error."""
    error = mean_squared_error(image, truth, mask)
    return math.inf if error == 0.0 else -10.0 * math.log10(error)


def colour_fitted(image: np.ndarray, truth: np.ndarray, mask: np.ndarray | None = None) -> np.ndarray:
    """The image with the affine change of its colours, c -> A c + b with A (3, 3), that brings it nearest to the ground truth by least squares over the pixels
    that count: differences in exposure and white balance are taken out of a figure. Clipped to 0-1.

    Arguments as for mean_squared_error, with three channels. Returns (H, W, 3) float64.
    """
    image, truth, mask = _checked(image, truth, mask)
    square, mixed = np.zeros((4, 4)), np.zeros((4, 3))
    for top in range(0, len(image), BAND):
        band = slice(top, top + BAND)
        used = np.ones(image[band].shape[:2], bool) if mask is None else mask[band]
        rows = np.concatenate([image[band][used], np.ones((int(used.sum()), 1))], axis=-1)  # (N, 4)
        # not by BLAS, whose sums depend on its threads
        square += np.einsum("ni,nj->ij", rows, rows)
        mixed += np.einsum("ni,nj->ij", rows, truth[band][used])
    change = np.linalg.lstsq(square, mixed, rcond=None)[0]
    return np.clip(np.einsum("hwi,ij->hwj", image, change[:3]) + change[3], 0.0, 1.0)


def ssim(image: np.ndarray, truth: np.ndarray, mask: np.ndarray | None = None) -> float:
    """Structural similarity, 1 where the images are equal: the mean of ssim_map over channels and over the windows that lie inside the image.

    With a mask, a window counts where its middle pixel does, and pixels that do not count are taken to be equal in both images, so that nothing
    outside the mask can lower the figure.

    Arguments as for mean_squared_error. Raises ValueError as that does, and for images smaller than a window.
    """
    image, truth, mask = _checked(image, truth, mask)
    if mask is None:
        return float(ssim_map(image, truth).mean())
    outside = ~mask
    image = image.copy()
    image[outside] = truth[outside]
    border = WINDOW // 2
    middle = mask[border:-border, border:-border]
    similarity = ssim_map(image, truth)
    if not middle.any():
        raise ValueError("ssim: the mask leaves no pixel that is the middle of a whole window")
    return float(similarity[middle].mean())


def ssim_map(image: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """Similarity of the window around each pixel that has a whole one.

    image, truth  (H, W, 3) or (H, W)  floating point, data range 1
    returns       (H - 10, W - 10, 3) or (H - 10, W - 10)

    Wang, Bovik, Sheikh and Simoncelli 2004, equation 13, with an 11 x 11 Gaussian of sigma 1.5, K1 = 0.01, K2 = 0.03 and population (not sample)
    covariances, as in the NeRF literature.
    """
    image, truth, _ = _checked(image, truth, None)
    if min(image.shape[:2]) < WINDOW:
        raise ValueError(f"ssim: an image of {image.shape[1]} x {image.shape[0]} pixels is smaller than the window of {WINDOW} x {WINDOW}")
    border = WINDOW // 2  # where scikit-image mirrors the image
    similarity = np.zeros(image.shape)

    def compare(top: int) -> None:
        rows = slice(top - border, min(top + SSIM_BAND, len(image) - border) + border)
        _, part = structural_similarity(
            truth[rows], image[rows], data_range=1.0, channel_axis=2 if image.ndim == 3 else None, gaussian_weights=True, sigma=1.5,
            use_sample_covariance=False, full=True,
        )  # fmt: skip
        similarity[rows][border:-border] = part[border:-border]

    with ThreadPoolExecutor(min(SSIM_THREADS, torch.get_num_threads())) as threads:  # SciPy's filters let Python go on
        deque(threads.map(compare, range(border, len(image) - border, SSIM_BAND)), maxlen=0)
    return similarity[border:-border, border:-border]


def _checked(image: np.ndarray, truth: np.ndarray, mask: np.ndarray | None) -> tuple[np.ndarray, np.ndarray, np.ndarray | None]:
    image, truth = np.asarray(image), np.asarray(truth)
    if image.shape != truth.shape or image.ndim not in (2, 3):
        raise ValueError(f"metrics: images of shapes {image.shape} and {truth.shape} cannot be compared")
    for array in (image, truth):
        if not np.issubdtype(array.dtype, np.floating):
            raise ValueError(f"metrics: found {array.dtype} values, expected floating point from 0 to 1; divide 8-bit images by 255")
    if mask is not None:
        mask = np.asarray(mask, bool)
        if mask.shape != image.shape[:2]:
            raise ValueError(f"metrics: a mask of shape {mask.shape} for images of shape {image.shape}")
        if not mask.any():
            raise ValueError("metrics: the mask leaves no pixel to compare")
    return image.astype(np.float64, copy=False), truth.astype(np.float64, copy=False), mask
