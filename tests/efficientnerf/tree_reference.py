"""Rays of trees by plain sums over every step, in torch: slow, differentiable, and what the kernels are measured against. N points, R rays."""

from dataclasses import replace

import torch
from torch import Tensor

from efficientnerf.asset.cascades import cascades_of
from efficientnerf.asset.rendering import ray_parts
from efficientnerf.asset.tree import NerfTree
from efficientnerf.rendering import environment
from efficientnerf.rendering.harmonics import basis


def tree_density(tree: NerfTree, points: Tensor, values: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Density at points in voxel coordinates, and the corners that made it.

    points  (N, 3) voxel coordinates
    values  (V,) density of the stored voxels
    returns density (N,), corner index (N, 8) with -1 where nothing is stored, trilinear weight (N, 8)

    Where the tree's lookup is nearest the point is taken to the centre of its voxel, whose weight there is 1.
    """
    if tree.lookup == "nearest":
        points = torch.floor(points) + 0.5
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


def render_reference(tree: NerfTree, origins: Tensor, directions: Tensor, density: Tensor | None = None, sh: Tensor | None = None) -> tuple[Tensor, Tensor]:
    """Colour (R, 3), premultiplied or over the tree's environment, and opacity (R,) of rays by plain sums over every step; differentiable in `density` and
    `sh`.

    origins, directions  (R, 3) world frame, unit directions
    density, sh          values to use in place of the tree's own
    """
    device, dtype = origins.device, origins.dtype
    density = torch.as_tensor(tree.density_values, device=device, dtype=dtype) if density is None else density
    sh = torch.as_tensor(tree.sh, device=device, dtype=dtype) if sh is None else sh
    view_directions = directions
    origins, directions, *_ = tree.frame.rays(origins, directions)
    transmittance, colour = torch.ones_like(origins[:, 0]), torch.zeros_like(origins)
    harmonics = basis(view_directions, tree.degree)
    cascades = cascades_of(tree)
    for n, begin, end in ray_parts(tree, origins, directions):
        cascade = cascades[n]
        grid = replace(tree, shape=cascade.shape, voxel=cascade.voxel, bounds_min=cascade.bounds_min, brick_index=cascade.brick_index, outer=())
        start = (origins - torch.as_tensor(cascade.bounds_min, device=device, dtype=dtype)) / cascade.voxel
        met = begin < end
        enter, leave = torch.where(met, begin, 0) / cascade.voxel, torch.where(met, end, 0) / cascade.voxel
        step = tree.step_size
        most = 2 * sum(grid.resolution) + 4  # samples of a ray through the grid; distances far beyond it are rounded to more
        count = max(0, int(torch.ceil((leave - enter).clamp(min=0).max() / step).clamp(max=most).item()) + 1) if len(enter) else 0
        for k in range(count):
            t = enter + (k + 0.5) * step
            sigma, index, weight = tree_density(grid, start + t[:, None] * directions, density)
            alpha = 1 - torch.exp(-sigma * step * cascade.voxel)
            alpha = torch.where(t < leave, alpha, 0)
            stored = torch.where(index >= 0, weight, 0)
            share = stored / stored.sum(dim=-1, keepdim=True).clamp(min=1e-12)
            mixed = torch.zeros(len(t), harmonics.shape[1], 3, device=device, dtype=dtype)
            if len(sh):
                mixed = (share[..., None, None] * sh[index.clamp(min=0)]).sum(dim=1)
            rgb = torch.sigmoid((harmonics[:, :, None] * mixed).sum(dim=1))  # (R, 3)
            colour = colour + (transmittance * alpha)[:, None] * rgb
            transmittance = transmittance * (1 - alpha)
    if tree.environment is not None:
        behind = environment.lookup(tree.environment, view_directions.detach().cpu().numpy())
        colour = colour + transmittance[:, None] * torch.as_tensor(behind, device=device, dtype=dtype)
    return colour, 1 - transmittance
