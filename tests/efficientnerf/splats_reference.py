"""The rasteriser as plain torch, one Gaussian after the other over all pixels: the kernels' reference. Pinhole cameras."""

import numpy as np
import torch
from torch import Tensor

from efficientnerf.geometry.cameras import Camera
from efficientnerf.rendering.harmonics import basis
from efficientnerf.splats.gaussians import Gaussians, rotation_matrices
from efficientnerf.splats.rendering import NEAR


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
