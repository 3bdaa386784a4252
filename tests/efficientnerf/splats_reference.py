"""The rasteriser as plain torch, one Gaussian after the other over all pixels: the kernels' reference, of pinhole cameras; and what it is given."""

import numpy as np
import torch
from torch import Tensor

from efficientnerf.backends.splat_layout import Picture
from efficientnerf.geometry.cameras import Camera
from efficientnerf.rendering.harmonics import basis
from efficientnerf.splats.gaussians import Gaussians, rotation_matrices
from efficientnerf.splats.rendering import NEAR
from tests.efficientnerf.balls import pose

WIDTH, HEIGHT = 37, 27  # neither a multiple of a tile or block
LENSES = [
    ("OPENCV", (-0.2, 0.05, 0.01, -0.02)), ("FULL_OPENCV", (-0.2, 0.05, 0.01, -0.02, 0.02, 0.05, 0.01, 0.0)), ("OPENCV_FISHEYE", (-0.05, 0.02, 0.01, -0.01)),
]  # fmt: skip


def some_gaussians(count: int = 60, degree: int = 3, seed: int = 0, size: float = 0.2) -> Gaussians:
    """Around the origin, some behind the camera, some thin, some opaque."""
    rng = np.random.default_rng(seed)
    rotations = rng.normal(size=(count, 4))
    rotations /= np.linalg.norm(rotations, axis=1, keepdims=True)
    means = rng.normal(size=(count, 3)) * 0.5
    means[::17] *= 30
    harmonics = rng.normal(size=(count, (degree + 1) ** 2, 3)) * 0.4
    parts = means, size * np.exp(rng.normal(size=(count, 3)) - 1), rotations, rng.uniform(0.02, 0.999, count), harmonics
    return Gaussians(*(part.astype(np.float32) for part in parts))


def camera(model: str = "PINHOLE", extra: tuple[float, ...] = ()) -> Camera:
    return Camera("view", WIDTH, HEIGHT, model, (33.0, 35.0, 18.0, 13.0, *extra), pose(0.7, 0.4))


def tensors(gaussians: Gaussians) -> list[Tensor]:
    logits = np.log(gaussians.opacities.astype(np.float64) / (1 - gaussians.opacities))
    parts = gaussians.means, np.log(gaussians.scales.astype(np.float64)), gaussians.rotations, logits, gaussians.harmonics
    return [torch.tensor(part, dtype=torch.float64, requires_grad=True) for part in parts]


def picture_of(seed: int, over_all: bool, structure: float = 0.0, huber_delta: float = np.inf) -> Picture:
    rng = np.random.default_rng(seed)
    mask = (rng.random((HEIGHT, WIDTH)) < 0.97).astype(np.uint8)
    pixels, background = rng.integers(0, 256, (HEIGHT, WIDTH, 4), dtype=np.uint8), np.array([0.2, 0.5, 0.9], np.float32)
    return Picture(pixels, mask, over_all, background, np.float32(structure), np.float32(huber_delta))


def reference_loss(image: Tensor, light: Tensor, picture: Picture) -> Tensor:
    """Half of the squared error, or the pseudo-Huber loss of it, and half of the structural dissimilarity."""
    pixels, mask = torch.tensor(picture.pixels / 255.0), torch.tensor(picture.mask != 0)
    if not picture.over_all:
        background = torch.tensor(picture.background, dtype=image.dtype)
        off, wanted = image + light[..., None] * background - pixels[..., :3], pixels[..., :3]
        squares = off.square()
    else:
        alpha = pixels[..., 3:]
        more = light[..., None] - (1 - alpha)
        off, wanted = image - pixels[..., :3] * alpha + 0.5 * more, pixels[..., :3] * alpha + 0.5 * (1 - alpha)
        squares = off.square() + more.square() / 12
    error, delta = squares.sum(-1), float(picture.huber_delta)
    losses = error if np.isinf(delta) else 2 * delta**2 * ((1 + error / delta**2).sqrt() - 1)
    return 0.5 * ((losses * mask).sum() + float(picture.structure) * structural_dissimilarity(wanted + off, wanted, mask))


def structural_dissimilarity(image: Tensor, wanted: Tensor, mask: Tensor) -> Tensor:
    """Sum of 1 - SSIM over pixels and channels, of windows of 4 x 4 pixels next to each other that all count."""
    total = image.new_zeros(())
    for i in range(0, image.shape[0] - 3, 4):
        for j in range(0, image.shape[1] - 3, 4):
            if mask[i : i + 4, j : j + 4].all():
                x, y = (part[i : i + 4, j : j + 4].reshape(16, 3) for part in (image, wanted))
                covariance = ((x - x.mean(0)) * (y - y.mean(0))).mean(0)
                means = (2 * x.mean(0) * y.mean(0) + 0.01**2) / (x.mean(0) ** 2 + y.mean(0) ** 2 + 0.01**2)
                total = total + 16 * (1 - means * (2 * covariance + 0.03**2) / (x.var(0, False) + y.var(0, False) + 0.03**2)).sum()
    return total


def rotations_of(quaternions: Tensor) -> Tensor:
    """(N, 3, 3) of quaternions (N, 4) w x y z."""
    w, x, y, z = torch.nn.functional.normalize(quaternions, dim=1).unbind(1)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return torch.stack([torch.stack(row, dim=1) for row in rows], dim=1)


def render_reference(means: Tensor, log_scales: Tensor, quaternions: Tensor, logits: Tensor, harmonics: Tensor, camera: Camera) -> tuple[Tensor, Tensor]:
    """Colour (H, W, 3), premultiplied, and transmittance (H, W); differentiable, the derivative of the projection and view directions taken as constants."""
    kind = means.dtype
    turn = torch.as_tensor(camera.world_from_camera[:3, :3].T.copy(), dtype=kind)
    away = means - torch.as_tensor(camera.centre, dtype=kind)
    k, (x, y, z) = camera.intrinsics, (away @ turn.T).unbind(1)
    centre = torch.stack([k["fx"] * x / z + k["cx"], k["fy"] * y / z + k["cy"]], dim=1)
    zero = torch.zeros_like(z)
    slope = torch.stack([torch.stack([k["fx"] / z, zero, -k["fx"] * x / z**2], dim=1), torch.stack([zero, k["fy"] / z, -k["fy"] * y / z**2], dim=1)], dim=1)
    root = slope.detach() @ turn @ rotations_of(quaternions) * log_scales.exp()[:, None]  # (N, 2, 3)
    conic = torch.linalg.inv(root @ root.transpose(1, 2) + 0.3 * torch.eye(2, dtype=kind))
    directions = torch.nn.functional.normalize(away, dim=1).detach()
    colours = (0.5 + (basis(directions, round(harmonics.shape[1] ** 0.5) - 1)[:, :, None] * harmonics).sum(1)).clamp(min=0)
    v, u = torch.meshgrid(torch.arange(camera.height, dtype=kind) + 0.5, torch.arange(camera.width, dtype=kind) + 0.5, indexing="ij")
    image, light, open_ = torch.zeros(camera.height, camera.width, 3, dtype=kind), torch.ones_like(u), torch.ones_like(u, dtype=torch.bool)
    for n in z.argsort(stable=True).tolist():
        if z[n] <= NEAR:
            continue
        off = torch.stack([u, v], dim=-1) - centre[n]
        alpha = (torch.sigmoid(logits[n]) * torch.exp(-0.5 * (off @ conic[n] * off).sum(-1))).clamp(max=0.99)
        counts = open_ & (alpha >= 1 / 255)
        ends = counts & (light * (1 - alpha) < 1e-4)
        open_, alpha = open_ & ~ends, torch.where(counts & ~ends, alpha, 0)
        image = image + (light * alpha)[..., None] * colours[n]
        light = light * (1 - alpha)
    return image, light


def covariances(gaussians: Gaussians) -> np.ndarray:
    """(N, 3, 3) float64."""
    axes = rotation_matrices(gaussians.rotations) * gaussians.scales[:, None, :].astype(np.float64)
    return np.asarray(np.einsum("nij,nkj->nik", axes, axes))
