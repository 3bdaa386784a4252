"""Images of Gaussians, for any camera of the project."""

from typing import NamedTuple

import numpy as np

from efficientnerf.backends.numba.splats import raster
from efficientnerf.backends.numba.splats.pairs import pairs_of
from efficientnerf.backends.numba.splats.projection import RECORD, Lens, project
from efficientnerf.backends.pieces import pieces
from efficientnerf.geometry.cameras import Camera, fold_radius, rays
from efficientnerf.rendering.colour import sigmoid
from efficientnerf.splats.gaussians import Gaussians

NEAR = 0.05  # depth in front of which nothing is rendered, units of the training frame
OVERSCAN = 0.15  # of the picture's width and height, outside of it, up to where derivatives of the projection follow the means; as 3DGS
LOG_SCALES = (-30.0, 20.0)  # values beyond are rendered as these: float32 holds their squares
LANES = 16


class SplatImage(NamedTuple):
    """The image of Gaussians that a camera takes."""

    colour: np.ndarray  # (H, W, 3) float32, sRGB, over a background; without one, premultiplied by the opacity
    opacity: np.ndarray  # (H, W) float32, 0 to 1


def render(gaussians: Gaussians, camera: Camera, background: tuple[float, float, float] | None = None) -> SplatImage:
    """The image that a camera takes, as 3DGS renders it; lenses that distort included (`efficientnerf.backends.numba.splats.projection`)."""
    return render_values(values_of(gaussians), gaussians.degree, camera, background)


def render_values(values: np.ndarray, degree: int, camera: Camera, background: tuple[float, float, float] | None = None) -> SplatImage:
    """`render` of Gaussians in groups of sixteen, see `values_of`."""
    records = np.zeros((len(values) * LANES, RECORD), np.float32)
    project(values, lens_of(camera), degree, records)
    pairs = pairs_of(records, camera.width, camera.height)
    colour, light = np.empty((camera.height, camera.width, 3), np.float32), np.empty((camera.height, camera.width), np.float32)
    for tiles in pieces(len(pairs.begin) - 1):
        raster.render_tiles(tiles, records, pairs, colour, light)
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
    """(G, 11 + 3 K, 16) float32, rows as `efficientnerf.backends.numba.splats.projection` names them; the last group's padding cannot be seen."""
    count = len(gaussians)
    logits = np.log(gaussians.opacities) - np.log1p(-gaussians.opacities)
    parts = gaussians.means, np.log(gaussians.scales).clip(*LOG_SCALES), gaussians.rotations, logits[:, None], gaussians.harmonics.reshape(count, -1)
    return grouped(np.concatenate(parts, axis=1))


def grouped(rows: np.ndarray, unseen: bool = True) -> np.ndarray:
    """Groups (G, width, 16) of rows (N, width) float32, the last filled with Gaussians that cannot be seen, or with zeros."""
    count, width = rows.shape
    out = np.zeros((-(-count // LANES) * LANES, width), np.float32)
    out[:count] = rows
    if unseen:
        out[count:, 6], out[count:, 10] = 1, -30
    return np.ascontiguousarray(out.reshape(-1, LANES, width).transpose(0, 2, 1))


def ungrouped(groups: np.ndarray, count: int) -> np.ndarray:
    """The first `count` rows of groups, see `grouped`."""
    return np.ascontiguousarray(groups.transpose(0, 2, 1)).reshape(-1, groups.shape[1])[:count]


def gaussians_from(values: np.ndarray, count: int) -> Gaussians:
    """The first `count` Gaussians of groups, see `values_of`."""
    rows = ungrouped(values, count).astype(np.float64)
    rotations = rows[:, 6:10] / np.linalg.norm(rows[:, 6:10], axis=1, keepdims=True)
    opacities = np.clip(sigmoid(rows[:, 10]), 1e-4, 1 - 1e-4)
    parts = rows[:, :3], np.exp(rows[:, 3:6]), rotations, opacities, rows[:, 11:].reshape(count, -1, 3)
    return Gaussians(*(np.ascontiguousarray(part, np.float32) for part in parts))
