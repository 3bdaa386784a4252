"""Exposure, white balance, vignetting and response of photographs: learned together with the field and left out of it.

    light      l   = f^-1(c)                     c: sRGB colour of the scene, f: response of the cameras on average
    exposed    l_v = l exp(g_v + d_k(r))         photograph v of camera k, at distance r from the middle of the image
    shown      c_v = f_k(l_v)

    g_v    (3,) logarithms of exposure and white balance; their mean over the photographs is taken off, so that the scene is as exposed on average
    d_k    a (r^2 - 1/3) + b (r^4 - 1/9), vignetting; r = 1 in the corners. The mean of r^2 over an image is 1/3: images stay as bright as they are
    f_k    a shoulder, an offset, then sRGB's curve

A camera's response sets how a change of exposure affects light and dark colours; without a difference from the average it has no effect.
The four parts are those of Deutsch et al. 2026, "PPISP"; theirs have a homography of chromaticities and curves of each channel. docs/experiments/exposure.md

Later stages that use photographs show the scene as exposed on average, too: `averaged` undoes `exposed`.

R rays, C photographs, K cameras.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import torch
from torch import Tensor, nn

from efficientnerf.geometry.cameras import Camera
from efficientnerf.training.pixels import Pixels

SCALE = 0.1  # of what is learned: with the field's learning rate a logarithm changes by at most a few thousandths in a step
OFFSET_SCALE = 0.01  # the same of the offset, which is of light itself
WEIGHT = 1e-3  # of the mean square of all logarithms in the loss: without a reason they stay as they are. docs/experiments/exposure.md
BEGIN = 0.1  # of the schedule, before which nothing is learned: an early field is grey, and gains would be those of what each photograph shows
CLIPPED = 253  # level from which a photograph says no more than that the scene is as bright or brighter
OVEREXPOSED = 0.1  # logarithm of a gain from which clipped pixels of a photograph are left out
FOCAL_STEP = 1.2  # focal lengths, over the longer side, of one camera are within this factor
VIGNETTING, SHOULDER, OFFSET = slice(0, 2), 2, 3  # of a camera's numbers
# Light of photographs is within these, which are floats with such numbers in their order; bits of a float that a cell of `_levels_of_light` leaves out
DARKEST, DARKEST_NUMBER, BRIGHTEST_NUMBER, CELL_BITS = -0.25, -0x3E800000, 0x7F7FFFFF, 12
CELLS = 2 ** (31 - CELL_BITS)


@dataclass(frozen=True, eq=False)
class Exposure:
    """Learned parameters; zero is no difference."""

    photographs: Tensor  # (C, 3) logarithms of gains over SCALE, before their mean is taken off
    cameras: Tensor  # (K, 4) a, b and shoulder over SCALE, offset over OFFSET_SCALE
    camera_of: Tensor  # (C,) int64 camera of each photograph

    @property
    def parameters(self) -> dict[str, nn.Parameter]:
        """The parameters, by name."""
        assert isinstance(self.photographs, nn.Parameter)
        assert isinstance(self.cameras, nn.Parameter)
        return {"exposure.photographs": self.photographs, "exposure.cameras": self.cameras}

    @property
    def detached(self) -> Exposure:
        """The same without gradients."""
        return Exposure(self.photographs.detach(), self.cameras.detach(), self.camera_of)

    def log_gains(self) -> Tensor:
        """(C, 3) g, of mean zero."""
        return SCALE * (self.photographs - self.photographs.mean(dim=0))


def is_learned(fraction: float) -> bool:
    """Whether it is learned at this fraction of the schedule."""
    return fraction >= BEGIN


def exposure_of(
    cameras: Sequence[Camera], gains: np.ndarray | None = None, vignetting: np.ndarray | None = None, device: torch.device | str = "cpu"
) -> Exposure:
    """The parameters before training.

    cameras     of the photographs
    gains       (C, 3) g and vignetting (K, 2) a and b to begin with; None: zero
    """
    camera_of = camera_numbers(cameras)
    per_camera = np.zeros((int(camera_of.max()) + 1, 4), np.float32)
    if vignetting is not None:
        per_camera[:, VIGNETTING] = vignetting / SCALE
    per_photograph = np.zeros((len(cameras), 3), np.float32) if gains is None else (gains / SCALE).astype(np.float32)
    photographs, of_cameras = (nn.Parameter(torch.from_numpy(values).to(device)) for values in (per_photograph, per_camera))
    return Exposure(photographs, of_cameras, torch.from_numpy(camera_of).to(device))


def camera_numbers(cameras: Sequence[Camera]) -> np.ndarray:
    """(C,) int64 which of the cameras each photograph was taken with: those of equal sides, upright or not, and about the same focal length, are one."""
    keys = []
    for camera in cameras:
        sides = sorted((camera.width, camera.height))
        keys.append((*sides, round(math.log(camera.intrinsics["fx"] / sides[1]) / math.log(FOCAL_STEP))))
    numbers = {key: number for number, key in enumerate(sorted(set(keys)))}
    return np.array([numbers[key] for key in keys], np.int64)


def places(pixels: Pixels, index: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The photograph (R,) of each pixel, and r^2 (R,) in it."""
    view = pixels.view_of(index)
    y, x = np.divmod(index - pixels.offsets[view], pixels.width[view])
    return view, squared_radius(x, y, pixels.width[view], pixels.height[view])


def squared_radius(x: np.ndarray, y: np.ndarray, width: np.ndarray | int, height: np.ndarray | int) -> np.ndarray:
    """r^2 of the pixels in columns x and rows y, float32."""
    return np.asarray(((2 * x + 1 - width) ** 2 + (2 * y + 1 - height) ** 2) / (np.square(width) + np.square(height)), np.float32)


def exposed(colour: Tensor, view: Tensor, radius: Tensor, e: Exposure) -> Tensor:
    """Colours (R, 3) of the scene as photographs `view` (R,) show them at r^2 = `radius` (R,), not clipped."""
    of, average, gain = _response_and_gain(view, radius, e)
    return _seen(_light(colour, average) * gain, of)


def averaged(colour: Tensor, view: Tensor, radius: Tensor, e: Exposure) -> Tensor:
    """Colours (R, 3) of photographs as those of the scene, not clipped: the inverse of `exposed`."""
    of, average, gain = _response_and_gain(view, radius, e)
    return _seen(_light(colour, of) / gain, average)


def averaged_image(image: np.ndarray, mask: np.ndarray | None, number: int, e: Exposure) -> tuple[np.ndarray, np.ndarray | None]:
    """Photograph `number` as if all had been exposed alike: (H, W, 3 or 4) uint8, alpha as it was, and the mask (H, W) bool of what is to be used of it:
    clipped pixels of a photograph exposed more do not show how bright the scene is.

    The bytes of `averaged`, by tables: light of a level depends on the camera alone, and the level of averaged light on nothing.
    """
    height, width = image.shape[:2]
    with torch.no_grad():
        light = _light_of_levels(e)[int(e.camera_of[number])]
        radius = _places_of_image(number, width, height)[1]
        gain = torch.exp(e.log_gains()[number] + _falloff(_numbers(e)[e.camera_of[number]], radius)[:, None])
        shown = light.index_select(0, torch.from_numpy(image[..., :3].astype(np.int32).reshape(-1))).view(-1, 3)
        levels = _levels_of_light(e)(shown / gain)
        more = gain > math.exp(OVEREXPOSED)
    out = image.copy()
    out[..., :3] = levels.numpy().reshape(height, width, 3)
    lost = more.numpy().reshape(height, width, 3) & (image[..., :3] >= CLIPPED)
    blind = lost[..., 0] | lost[..., 1] | lost[..., 2]
    if not blind.any():
        return out, mask
    return out, ~blind if mask is None else mask & ~blind


@lru_cache(maxsize=1)
def _light_of_levels(e: Exposure) -> Tensor:
    """(K, 256) float32 light that levels of each camera's photographs show."""
    level = torch.arange(256, dtype=torch.float32) / 255
    return _light(level[:, None], _numbers(e)[:, None, SHOULDER:])[..., 0]


@lru_cache(maxsize=1)
def _levels_of_light(e: Exposure) -> Callable[[Tensor], Tensor]:
    """The levels (R, 3) uint8 that the average response shows light (R, 3) as: how many of the 255 least lights of a level it reaches. These lie in cells of
    floats, of which a table says how many come before."""
    ends = _least_light_of_levels(_numbers(e).mean(dim=0)[SHOULDER:])
    of_ends = _cells_of_light(ends)
    before = torch.bucketize(torch.arange(CELLS), of_ends.long()).to(torch.uint8)
    most, beyond = int(torch.bincount(of_ends).max()), torch.cat([ends, torch.tensor([math.inf])])

    def levels(light: Tensor) -> Tensor:
        found = before.index_select(0, _cells_of_light(light).view(-1)).view_as(light)
        for _ in range(most):  # once, but where a response is steep
            found += light >= beyond.index_select(0, found.int().view(-1)).view_as(light)
        return found

    return levels


def _cells_of_light(light: Tensor) -> Tensor:
    """(...) int32 number of a cell, in the order of the light."""
    return (light - DARKEST).clamp(min=0).view(torch.int32) >> CELL_BITS


def _least_light_of_levels(response: Tensor) -> Tensor:
    """(255,) float32 least light that a response (2,) shows as level 1, 2, ... 255, by bisection of all floats in their order."""
    low, high = torch.full((255,), DARKEST_NUMBER), torch.full((255,), BRIGHTEST_NUMBER)
    while (high - low > 1).any():
        middle = (low + high) // 2
        shown = torch.round(255 * _seen(_ordered_floats(middle)[:, None], response).clamp(0, 1))[:, 0]
        reached = shown >= torch.arange(1, 256)
        low, high = torch.where(reached, low, middle), torch.where(reached, middle, high)
    return _ordered_floats(high)


def _ordered_floats(number: Tensor) -> Tensor:
    """The float32 of these numbers (int64) in their order, 0 being 0."""
    return torch.where(number < 0, -1.0, 1.0) * number.abs().to(torch.int32).view(torch.float32)


def image_as_taken(image: np.ndarray, number: int, e: Exposure, gains: np.ndarray, size: tuple[int, int], stride: int = 1) -> np.ndarray:
    """A render (H, W, 3) float32, 0-1, of every stride-th pixel of an image of size (width, height), the first in the middle of the first stride, as the camera
    of photograph `number` would show it with the logarithms of gains (3,)."""
    with torch.no_grad():
        of, average, gain = _response_and_gain(*_places_of_image(number, *size, stride), e, torch.tensor(gains, dtype=torch.float32))
        seen = _seen(_light(torch.from_numpy(image.reshape(-1, 3)), average) * gain, of)
    return np.asarray(seen.clamp(0, 1).numpy().reshape(image.shape))


def squared_error(shown: Tensor, colour: Tensor) -> Tensor:
    """(R, 3) of colours as photographs show them, and of the photographs: where these are clipped, only too dark a colour is wrong."""
    return torch.where((colour >= CLIPPED / 255) & (shown > colour), 0, (shown - colour) ** 2)


def exposure_loss(e: Exposure) -> Tensor:
    """The weighted mean squares of the gains' logarithms, and of the cameras' numbers."""
    return WEIGHT * ((e.log_gains() ** 2).mean() + ((SCALE * e.cameras) ** 2).mean())


def _places_of_image(number: int, width: int, height: int, stride: int = 1) -> tuple[Tensor, Tensor]:
    """`places` of every stride-th pixel of an image of photograph `number`."""
    first = (stride - 1) // 2
    y, x = np.mgrid[first:height:stride, first:width:stride]
    return torch.full((x.size,), number), torch.from_numpy(squared_radius(x.ravel(), y.ravel(), width, height))


def _response_and_gain(view: Tensor, radius: Tensor, e: Exposure, gains: Tensor | None = None) -> tuple[Tensor, Tensor, Tensor]:
    """Response (R, 2) of the rays' cameras, that (2,) of all on average, and gains (R, 3); with logarithms (3,) in place of the photographs' own."""
    cameras = _numbers(e)
    of = cameras[e.camera_of[view]]  # (R, 4)
    own = e.log_gains()[view] if gains is None else gains
    return of[:, SHOULDER:], cameras.mean(dim=0)[SHOULDER:], torch.exp(own + _falloff(of, radius)[:, None])


def _numbers(e: Exposure) -> Tensor:
    """(K, 4) a, b, shoulder and offset of each camera."""
    return torch.cat([SCALE * e.cameras[:, :OFFSET], OFFSET_SCALE * e.cameras[:, OFFSET:]], dim=1)


def _falloff(numbers: Tensor, radius: Tensor) -> Tensor:
    """(R,) d of cameras' numbers (..., 4) at r^2 = `radius` (R,)."""
    return numbers[..., 0] * (radius - 1 / 3) + numbers[..., 1] * (radius**2 - 1 / 9)


def _light(colour: Tensor, response: Tensor) -> Tensor:
    """f^-1; response (..., 2)."""
    offset = response[..., 1:]
    return _shoulder((_linear(colour) - offset) / (1 - offset), -response[..., :1])


def _seen(light: Tensor, response: Tensor) -> Tensor:
    """f; response (..., 2)."""
    offset = response[..., 1:]
    return _encoded(offset + (1 - offset) * _shoulder(light, response[..., :1]))


def _shoulder(x: Tensor, s: Tensor) -> Tensor:
    """0 and 1 stay, light in between is raised by s > 0: x e^s / (1 + (e^s - 1) x), and beyond 1 a straight line. The inverse is that of -s."""
    rise = torch.expm1(s)
    low = x.clamp(max=1)
    return (1 + rise) * low / (1 + rise * low) + (x - low) / (1 + rise)


def _linear(colour: Tensor) -> Tensor:
    """`efficientnerf.rendering.colour.linear_from_srgb`, with gradients."""
    return torch.where(colour <= 0.04045, colour / 12.92, ((colour.clamp(min=0.04) + 0.055) / 1.055) ** 2.4)


def _encoded(light: Tensor) -> Tensor:
    """The inverse of `_linear`."""
    return torch.where(light <= 0.0031308, light * 12.92, 1.055 * light.clamp(min=0.003) ** (1 / 2.4) - 0.055)
