"""Pictures from trees: cameras to rays to pixels.

`render_tree` is what users call. `render_tree_reference` is the plain torch statement of the same sums, slow, for tests and for devices that the
kernels do not reach.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor

from efficientnerf.cameras import Camera, rays
from efficientnerf.harmonics import basis

if TYPE_CHECKING:
    from efficientnerf.nerftree.tree import NerfTree, Rendering

ROWS_PER_BLOCK = 2**18


def subpixels(camera: Camera, rows: range, supersample: int) -> np.ndarray:
    """Where the rays of some rows of pixels pass: (rows * width * supersample^2, 2), the samples of a pixel together."""
    offsets = (np.arange(supersample) + 0.5) / supersample
    y, x, sy, sx = np.meshgrid(np.arange(rows.start, rows.stop), np.arange(camera.width), offsets, offsets, indexing="ij")
    return np.stack([(x + sx).reshape(-1), (y + sy).reshape(-1)], axis=-1)


def render_tree(tree: NerfTree, camera: Camera, *, background: tuple[float, float, float] | None = None, supersample: int = 1) -> Rendering:
    """See `NerfTree.render`."""
    from efficientnerf.nerftree.tree import Rendering

    if supersample < 1:
        raise ValueError(f"supersample {supersample}: expected at least 1")
    height, width = camera.height, camera.width
    colour, opacity = np.empty((height, width, 3), np.float32), np.empty((height, width), np.float32)
    depth, normal = np.empty((height, width), np.float32), np.empty((height, width, 3), np.float32)
    step = max(1, ROWS_PER_BLOCK // (width * supersample**2))
    for top in range(0, height, step):
        span = range(top, min(height, top + step))
        origins, directions = rays(camera, subpixels(camera, span, supersample))
        part = tree.render_rays(origins, directions)
        shape = (len(span), width, supersample**2)
        colour[span.start : span.stop] = part.colour.reshape(*shape, 3).mean(axis=2)
        opacity[span.start : span.stop] = part.opacity.reshape(shape).mean(axis=2)
        along = (part.depth * (directions @ camera.forward)).astype(np.float32).reshape(shape)
        # The nearest half of the samples decides; the mean of a near and a far surface would lie on neither.
        depth[span.start : span.stop] = np.sort(along, axis=2)[:, :, (supersample**2 - 1) // 2]
        facing = part.normal.reshape(*shape, 3).sum(axis=2)
        normal[span.start : span.stop] = facing / np.maximum(np.linalg.norm(facing, axis=-1, keepdims=True), 1e-12)
    depth[opacity < 0.5] = np.inf
    normal[opacity < 0.5] = 0
    if background is not None:
        colour += (1 - opacity[..., None]) * np.asarray(background, np.float32)
    return Rendering(colour, opacity, depth, normal)


def tree_density(tree: NerfTree, points: Tensor, values: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Density at points in voxel coordinates, and the corners that made it.

    points  (N, 3) voxel coordinates
    values  (V,) density of the stored voxels
    returns density (N,), corner index (N, 8) with -1 where nothing is stored, trilinear weight (N, 8)
    """
    device = points.device
    brick_index = torch.as_tensor(tree.brick_index, device=device).long()
    voxel_index = torch.as_tensor(tree.voxel_index, device=device).long()
    size = torch.tensor(tree.resolution, device=device)
    low = torch.floor(points - 0.5).long()
    frac = points - 0.5 - low
    corner = torch.stack(torch.meshgrid(*[torch.arange(2, device=device)] * 3, indexing="ij"), dim=-1).reshape(8, 3)
    at = low[:, None] + corner  # (N, 8, 3)
    weight = torch.where(corner.bool(), frac[:, None], 1 - frac[:, None]).prod(dim=-1)  # (N, 8)
    inside = ((at >= 0) & (at < size)).all(dim=-1)
    at = at.clamp(min=0).minimum(size - 1)
    cell = at // tree.brick
    owner = brick_index[cell[..., 0], cell[..., 1], cell[..., 2]]
    local = at - cell * tree.brick
    slot = (local[..., 0] * tree.brick + local[..., 1]) * tree.brick + local[..., 2]
    index = torch.where(inside & (owner >= 0), voxel_index[owner.clamp(min=0), slot], -1) if len(voxel_index) else torch.full_like(slot, -1)
    here = (points.floor().long().clamp(min=0).minimum(size - 1)) // tree.brick
    own = (points >= 0).all(dim=-1) & (points < size).all(dim=-1) & (brick_index[here[:, 0], here[:, 1], here[:, 2]] >= 0)
    sigma = torch.where(index >= 0, weight * values[index.clamp(min=0)], 0).sum(dim=-1) * own if len(values) else torch.zeros_like(weight[:, 0])
    return sigma, index, weight


def render_tree_reference(tree: NerfTree, origins: Tensor, directions: Tensor, density: Tensor | None = None, sh: Tensor | None = None) -> tuple[Tensor, Tensor]:
    """Colour (R, 3), premultiplied, and opacity (R,) of rays by plain sums over every step; differentiable in `density` and `sh`.

    origins, directions  (R, 3) world frame, unit directions
    density, sh          values to use in place of the tree's own
    """
    device, dtype = origins.device, origins.dtype
    density = torch.as_tensor(tree.density_values, device=device, dtype=dtype) if density is None else density
    sh = torch.as_tensor(tree.sh, device=device, dtype=dtype) if sh is None else sh
    start = (origins - torch.as_tensor(tree.bounds_min, device=device, dtype=dtype)) / tree.voxel
    size = torch.tensor(tree.resolution, device=device, dtype=dtype)
    to_low, to_high = -start / directions, (size - start) / directions
    enter = torch.minimum(to_low, to_high).nan_to_num(-1e30).amax(dim=-1).clamp(min=0)  # (R,)
    leave = torch.maximum(to_low, to_high).nan_to_num(1e30).amin(dim=-1)
    step = 0.5
    count = max(0, int(torch.ceil((leave - enter).clamp(min=0).max() / step).item()) + 1) if len(enter) else 0
    light = torch.ones_like(enter)
    colour = torch.zeros(len(enter), 3, device=device, dtype=dtype)
    harmonics = basis(directions, tree.degree)
    for k in range(count):
        t = enter + (k + 0.5) * step
        sigma, index, weight = tree_density(tree, start + t[:, None] * directions, density)
        alpha = 1 - torch.exp(-sigma * step * tree.voxel)
        alpha = torch.where(t < leave, alpha, 0)
        stored = torch.where(index >= 0, weight, 0)
        share = stored / stored.sum(dim=-1, keepdim=True).clamp(min=1e-12)
        mixed = (share[..., None, None] * sh[index.clamp(min=0)]).sum(dim=1) if len(sh) else torch.zeros(len(t), harmonics.shape[1], 3, device=device, dtype=dtype)
        rgb = torch.sigmoid((harmonics[:, :, None] * mixed).sum(dim=1))  # (R, 3)
        colour = colour + (light * alpha)[:, None] * rgb
        light = light * (1 - alpha)
    return colour, 1 - light
