"""What a tree is fitted to: training pixels, and the background that it is composited with.

R rays, P pixels.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from efficientnerf.backends.numba.tree.gradients import RayTargets
from efficientnerf.training.pixels import Pixels

if TYPE_CHECKING:
    from efficientnerf.training.device_pixels import DevicePixels

MEAN, VARIANCE = 0.5, 0.25  # of a random background: mean of a channel, and the three channels' variances summed; see `Targets`

Bundle = tuple[Any, Any, RayTargets]  # see `Targets.draw`


@dataclass(frozen=True)
class Targets:
    """Training pixels, and what the tree is composited with.

    pixels            of the training views
    background        constant sRGB colour behind the scene; None: an unbounded scene, of which the next three hold what lies outside of the box
    chosen            (P,) indices of the pixels that may be drawn
    before            (P, 4) premultiplied colour and opacity of what lies between the camera and the box
    behind            (P, 3) colour of what lies beyond the box
    reaches_infinity  whether the box reaches to infinity, so that the tree should be opaque

    Objects with alpha, and boxes that reach to infinity, are compared over a random background, each channel uniform over 0 to 1. The expected error is
    that over its mean plus the channels' summed variance, 3 / 12, times the squared error of the opacity: taken in closed form, without noise.
    """

    pixels: Pixels | DevicePixels
    background: tuple[float, float, float] | None
    chosen: np.ndarray | None = None
    before: Any = None
    behind: Any = None
    reaches_infinity: bool = False

    def __post_init__(self) -> None:
        if self.background is None and (self.chosen is None or self.before is None or self.behind is None):
            raise ValueError("targets of an unbounded scene need what lies before and behind the box")

    @property
    def on_device(self) -> bool:
        """Whether they were sent to a device, where trees are then fitted to them."""
        return not isinstance(self.pixels, Pixels)

    def to(self, device: str) -> Targets:
        """These targets on "cpu" or "cuda", the latter where its kernels can be built."""
        from efficientnerf.backends import dispatch

        if device == "cpu" or not dispatch.triton_usable():
            return self
        return self.sent(device)

    def sent(self, device: Any) -> Targets:
        """These targets on a torch device."""
        import torch

        from efficientnerf.training.device_pixels import DevicePixels

        assert isinstance(self.pixels, Pixels)
        before, behind = (None if part is None else torch.from_numpy(np.ascontiguousarray(part)).to(device) for part in (self.before, self.behind))
        return replace(self, pixels=DevicePixels(self.pixels, device), before=before, behind=behind)

    def draw(self, count: int, rng: np.random.Generator, *, constant_background: bool = False) -> tuple[Any, Any, RayTargets]:
        """Origins (R, 3) and unit directions (R, 3) of `count` random pixels, world frame, and their targets; arrays, or tensors of the device.

        constant_background  objects are compared over the background of the scene, not over a random one
        """
        if self.chosen is None:
            return self.of(self.pixels.choose(count, rng), None, constant_background=constant_background)
        at = rng.integers(len(self.chosen), size=count)
        return self.of(self.chosen[at], at, constant_background=constant_background)

    def of(self, index: np.ndarray, at: np.ndarray | None, *, constant_background: bool = False) -> tuple[Any, Any, RayTargets]:
        """`draw` for pixels `index`; `at` are their places in `chosen`."""
        bundle: tuple[Any, ...] = self.pixels.bundle(index)
        origins, directions, _, _, colour = bundle
        ones = colour[:, 0] * 0 + 1
        truth = colour[:, :3]
        if self.background is None:
            assert at is not None
            before, behind = self._rows(self.before, at), self._rows(self.behind, at)
            return origins, directions, RayTargets(truth - before[:, :3], behind, 1 - before[:, 3], ones, 0.0)
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
        return origins, directions, RayTargets(truth * 1, behind, ones, opacity, VARIANCE if random_background else 0.0)

    def _rows(self, part: Any, at: np.ndarray) -> Any:
        """Rows `at` of an array, or of a tensor on the pixels' device, in float32."""
        if isinstance(self.pixels, Pixels):
            return part[at].astype(np.float32)
        return part[self.pixels.to_device(at)].float()


def step_rng(seed: int, step: int) -> np.random.Generator:
    """The generator that draws a step's pixels."""
    return np.random.Generator(np.random.Philox(key=seed, counter=[0, 0, 2, step]))
