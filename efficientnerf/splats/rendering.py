"""Images of Gaussians, for any camera of the project."""

from typing import NamedTuple

import numpy as np

from efficientnerf.backends.dispatch import splats_on
from efficientnerf.backends.splat_layout import Lens
from efficientnerf.geometry.cameras import Camera, fold_radius, rays
from efficientnerf.rendering.colour import sigmoid
from efficientnerf.splats.gaussians import Gaussians

NEAR = 0.05  # depth in front of which nothing is rendered, units of the training frame
OVERSCAN = 0.15  # of the picture's width and height, outside of it, up to where derivatives of the projection follow the means; as 3DGS
LOG_SCALES = (-30.0, 20.0)  # values beyond are rendered as these: float32 holds their squares


class SplatImage(NamedTuple):
    """The image of Gaussians that a camera takes."""

    colour: np.ndarray  # (H, W, 3) float32, sRGB, over a background; without one, premultiplied by the opacity
    opacity: np.ndarray  # (H, W) float32, 0 to 1


def render(gaussians: Gaussians, camera: Camera, background: tuple[float, float, float] | None = None, device: str = "cpu") -> SplatImage:
    """The image that a camera takes, as 3DGS renders it; lenses that distort included (`efficientnerf.backends.numba.splats.projection`)."""
    colour, light = splats_on(device).splat_image(values_of(gaussians), gaussians.degree, lens_of(camera), device)
    if background is not None:
        colour += light[..., None] * np.asarray(background, np.float32)
    return SplatImage(colour, 1 - light)


def lens_of(camera: Camera, whole: Camera | None = None) -> Lens:
    """The camera as kernels take it; of a part of a picture with the limits of the full one."""
    k, fisheye = camera.intrinsics, camera.model == "OPENCV_FISHEYE"
    top, bottom = ("k1", "k2", "k3", "k4" if fisheye else ""), ("", "", "") if fisheye else ("k4", "k5", "k6")
    lens = [k.get(name, 0.0) for name in ("fx", "fy", "cx", "cy", *top, *bottom, "p1", "p2")]
    turn = camera.world_from_camera[:3, :3]
    reach = min(fold_radius(camera), 1e9)
    numbers = np.asarray([*lens, NEAR, reach**2, 0.0], np.float32)
    limits = np.zeros(4) if fisheye else _limits(whole or camera)
    return Lens(
        np.ascontiguousarray(turn.T.reshape(9), np.float32), camera.centre.astype(np.float32), numbers, limits.astype(np.float32), fisheye, camera.width,
        camera.height,
    )  # fmt: skip


def _limits(camera: Camera) -> np.ndarray:
    """Least and greatest u, least and greatest v of the picture on the plane at distance one, and a margin."""
    share = np.linspace(0, 1, 17)[:, None]
    corners = np.array([[0, 0], [camera.width, 0], [camera.width, camera.height], [0, camera.height]], np.float64)
    border = np.concatenate([(1 - share) * one + share * other for one, other in zip(corners, np.roll(corners, -1, axis=0), strict=True)])
    local = rays(camera, border)[1] @ camera.world_from_camera[:3, :3]
    plane = local[:, :2] / np.maximum(local[:, 2:], 1e-3)
    low, high = plane.min(axis=0), plane.max(axis=0)
    margin = OVERSCAN * (high - low)
    return np.stack([low - margin, high + margin], axis=-1).reshape(4)


def values_of(gaussians: Gaussians) -> np.ndarray:
    """(N, 11 + 3 K) float32, columns as `efficientnerf.backends.splat_layout` names them."""
    count = len(gaussians)
    logits = np.log(gaussians.opacities) - np.log1p(-gaussians.opacities)
    parts = gaussians.means, np.log(gaussians.scales).clip(*LOG_SCALES), gaussians.rotations, logits[:, None], gaussians.harmonics.reshape(count, -1)
    return np.concatenate(parts, axis=1, dtype=np.float32)


def gaussians_from(values: np.ndarray) -> Gaussians:
    """See `values_of`."""
    rows = values.astype(np.float64)
    rotations = rows[:, 6:10] / np.linalg.norm(rows[:, 6:10], axis=1, keepdims=True)
    opacities = np.clip(sigmoid(rows[:, 10]), 1e-4, 1 - 1e-4)
    parts = rows[:, :3], np.exp(rows[:, 3:6]), rotations, opacities, rows[:, 11:].reshape(len(rows), -1, 3)
    return Gaussians(*(np.ascontiguousarray(part, np.float32) for part in parts))
