"""Whether a run learns anything, early: after a tenth of its steps a few held-out views are rendered small, and their error is compared with that of two
pictures that know nothing of the scene's shape: each view's mean colour, and its photograph blurred until only large patches are left.

    progress = (e_mean - e) / (e_mean - e_blurred)        e: mean squared error

0 is no better than the mean colour, 1 as good as the blurred photograph. A held-out view has an exposure of its own, which nothing has learned: the gain of
each colour channel that fits the photograph best is taken of each render. On a constant background the subject's pixels alone count, with a margin by which
its silhouette shows: the rest is right from the first step on. docs/experiments/early-check.md
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from efficientnerf.geometry.cameras import Camera
from stages.evaluate.trivial import blurred
from stages.evaluate.views import evenly_spaced, ground_truth, stride_to, subsample_camera
from stages.io.scene import Scene, View, views_of

FRACTION = 0.1  # of the steps
MIN_STEP = 256  # nothing is expected before the warm-up of the density voxels ends
VIEWS = 5  # that are rendered
SIDE = 48  # px, their longest side
MARGIN = 3  # px round the subject
BLUR = 0.04  # standard deviation of the blurred photograph, of its longest side: what the verdict calls failed (stages/verdict/result.py)
MIN_PIXELS = 16  # of a view that are compared
MIN_KEPT = 0.1  # of a subject, that masks have to keep to be believed
# docs/experiments/early-check.md
MIN_PROGRESS = 0.5
MAX_GAIN = 2.0  # that a render is fitted by, or its inverse: one stop
GOOD_PSNR = 25.0  # dB: from here on what is better than one colour is no failure, for photographs of plain things are hardly better themselves
PLAIN_PSNR = 30.0  # dB: from here on nothing is


@dataclass(frozen=True, eq=False)
class HeldOutView:
    """A small view to compare with."""

    camera: Camera
    colour: np.ndarray  # (H, W, 3) float32 of the photograph
    counted: np.ndarray  # (H, W) bool, the pixels that are compared


@dataclass(frozen=True)
class EarlyResult:
    """Medians over the views that were compared."""

    step: int  # after which
    views: int
    # psnr, mean_colour_psnr, blurred_psnr: dB of the renders, and of the two pictures that know nothing
    psnr: float
    mean_colour_psnr: float
    blurred_psnr: float
    progress: float  # see the module

    @property
    def learning(self) -> bool:
        """Whether anything has been learned."""
        return self.progress >= MIN_PROGRESS or self.psnr >= PLAIN_PSNR or (self.psnr >= GOOD_PSNR and self.progress > 0)


def check_step(iterations: int) -> int | None:
    """The step after which the check runs; None: the run is too short for a check before its second half."""
    step = max(MIN_STEP, math.ceil(FRACTION * iterations))
    return step if 2 * step <= iterations else None


def held_out_views(folder: Path, s: Scene) -> list[HeldOutView]:
    """Small views of the scene in `folder`: validation views, else test views, else training views, evenly spaced in their order."""
    views = views_of(s, "val") or views_of(s, "test") or views_of(s, "train")
    return [_small(folder, s, views[index]) for index in evenly_spaced(len(views), VIEWS)]


def _small(folder: Path, s: Scene, view: View) -> HeldOutView:
    stride = stride_to(view.camera, SIDE)
    truth = ground_truth(folder, view, s.background, stride)
    subject = np.ones(truth.colour.shape[:2], bool) if truth.inside is None else truth.inside
    counted = cv2.dilate(subject.astype(np.uint8), np.ones((2 * MARGIN + 1,) * 2, np.uint8)).astype(bool)
    if truth.mask is not None and (subject & truth.mask).sum() >= MIN_KEPT * subject.sum():
        counted &= truth.mask
    return HeldOutView(subsample_camera(view.camera, stride), truth.colour, counted)


def judge(views: Sequence[HeldOutView], render: Callable[[Camera], np.ndarray], step: int) -> EarlyResult | None:
    """Compare renders with the photographs; None where no view has pixels to compare.

    render  colours (H, W, 3) that a camera sees
    """
    found = [_errors(view, np.clip(np.nan_to_num(render(view.camera)), 0, 1)) for view in views if view.counted.sum() >= MIN_PIXELS]
    if not found:
        return None
    error, mean, blurred = np.array(found).T
    progress = (mean - error) / np.maximum(mean - blurred, 1e-6)
    return EarlyResult(step, len(found), _decibels(error), _decibels(mean), _decibels(blurred), round(float(np.median(progress)), 3))


def _decibels(error: np.ndarray) -> float:
    return round(float(np.median(-10 * np.log10(np.maximum(error, 1e-10)))), 2)


def _errors(view: HeldOutView, render: np.ndarray) -> tuple[float, float, float]:
    """Mean squared errors of the render, the mean colour and the blurred photograph."""
    truth, at = view.colour, view.counted
    gain = (render[at] * truth[at]).sum(axis=0) / np.maximum((render[at] ** 2).sum(axis=0), 1e-9)
    render = np.clip(render * np.clip(gain, 1 / MAX_GAIN, MAX_GAIN), 0, 1)
    plain = np.broadcast_to(truth[at].mean(axis=0), truth.shape)
    error, mean, patches = (float(((picture[at] - truth[at]) ** 2).mean()) for picture in (render, plain, blurred(truth, BLUR * max(truth.shape[:2]), at)))
    return error, mean, patches
