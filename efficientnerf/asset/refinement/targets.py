"""The targets of a fit: training pixels, and the background that a tree is composited with. R rays, H rows."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np
import torch

from efficientnerf.backends import dispatch
from efficientnerf.backends.layout import RayTargets
from efficientnerf.rendering import environment
from efficientnerf.training.device_pixels import DevicePixels, on_host
from efficientnerf.training.pixels import Pixels

STRUCTURE = 0.005  # weight of 1 - SSIM; docs/experiments/tree-training.md
MEAN, VARIANCE = 0.5, 0.25  # of a random background: mean of a channel, and the three channels' variances summed; see `Targets`

Bundle = tuple[Any, Any, RayTargets]  # see `Targets.of`


@dataclass(frozen=True)
class Targets:
    """Training pixels, and what the tree is composited with.

    Objects with alpha, and boxes that reach to infinity, are compared over a random background, each channel uniform over 0 to 1. The expected error is
    that over its mean plus the channels' summed variance, 3 / 12, times the squared error of the opacity: taken in closed form, without noise.
    """

    pixels: Pixels | DevicePixels  # of the training views
    background: tuple[float, float, float] | None  # constant sRGB colour behind the scene; None: an unbounded scene, which is laid over its environment map
    environment: Any = None  # (H, 2 H, 3) float32 sRGB colours by direction (`efficientnerf.rendering.environment`), of unbounded scenes
    reaches_infinity: bool = False  # whether the box reaches to infinity, so that the tree should be opaque

    def __post_init__(self) -> None:
        if self.background is None and self.environment is None:
            raise ValueError("targets of an unbounded scene need its environment map")

    @property
    def on_device(self) -> bool:
        """Whether they were sent to a device, where trees are then fitted to them."""
        return not isinstance(self.pixels, Pixels)

    @property
    def backend(self) -> Literal["numba", "triton"]:
        """That which fits trees to them."""
        return "triton" if self.on_device else "numba"

    @property
    def device(self) -> torch.device:
        """Where they are."""
        return self.pixels.device if isinstance(self.pixels, DevicePixels) else torch.device("cpu")

    @property
    def host_pixels(self) -> Pixels:
        """The pixels where they are chosen."""
        return on_host(self.pixels)

    def to(self, device: str) -> Targets:
        """These targets on "cpu" or "cuda", the latter where its kernels can be built."""
        if device == "cpu" or not dispatch.triton_usable():
            return self
        return self.sent(device)

    def sent(self, device: Any) -> Targets:
        """These targets on a torch device."""
        assert isinstance(self.pixels, Pixels)
        sent = None if self.environment is None else torch.from_numpy(np.ascontiguousarray(self.environment)).to(device)
        return replace(self, pixels=DevicePixels(self.pixels, device), environment=sent)

    def of(self, index: np.ndarray, *, constant_background: bool = False) -> tuple[Any, Any, RayTargets]:
        """Origins (R, 3) and unit directions (R, 3) of pixels `index`, world frame, and their targets; arrays, or tensors of the device.

        constant_background  objects are compared over the background of the scene, not over a random one
        """
        bundle: tuple[Any, ...] = self.pixels.bundle(index)
        origins, directions, _, _, colour = bundle
        ones = colour[:, 0] * 0 + 1
        truth = colour[:, :3]
        if self.background is None:
            lookup = environment.lookup_on if self.on_device else environment.lookup
            behind = lookup(self.environment, directions)
            return origins, directions, RayTargets(truth * 1, behind, ones, ones * 1, 0.0, STRUCTURE)
        has_alpha = colour.shape[1] == 4
        random_background = (has_alpha or self.reaches_infinity) and not constant_background
        behind = colour[:, :3] * 0
        ground = (MEAN,) * 3 if random_background else self.background
        for channel, value in enumerate(ground):
            behind[:, channel] += value
        opacity = ones
        if has_alpha:
            opacity = colour[:, 3] * 1
            truth = truth * opacity[:, None] + behind * (1 - opacity[:, None])
        return origins, directions, RayTargets(truth * 1, behind, ones, opacity, VARIANCE if random_background else 0.0, STRUCTURE)


def step_rng(seed: int, step: int) -> np.random.Generator:
    """The generator that draws a step's pixels."""
    return np.random.Generator(np.random.Philox(key=seed, counter=[0, 0, 2, step]))
