"""Pictures from trees: cameras to rays to pixels.

`render_tree` is what users call. `render_tree_reference` is the plain torch statement of the same sums, slow, for tests and for devices that the
kernels do not reach.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import astuple, dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import Tensor

from efficientnerf.backends import dispatch
from efficientnerf.geometry.cameras import Camera, rays
from efficientnerf.model import Model, RayOutputs, render_rays
from efficientnerf.rendering.compositing import activate, ray_of_sample
from efficientnerf.rendering.harmonics import basis

if TYPE_CHECKING:
    from efficientnerf.asset.tree import NerfTree, Rendering

RAYS_PER_BAND = 2**20  # of supersampled pictures at once
FIELD_RAYS_PER_BLOCK = 8192


def render_tree(tree: NerfTree, camera: Camera, *, background: tuple[float, float, float] | None = None, supersample: int = 1) -> Rendering:
    """See `NerfTree.render`."""
    from efficientnerf.asset.tree import Rendering
    from efficientnerf.backends.numba.tree.rendering import render_image

    if supersample < 1:
        raise ValueError(f"supersample {supersample}: expected at least 1")
    behind = np.zeros(3, np.float32) if background is None else np.asarray(background, np.float32)
    if behind.shape != (3,):
        raise ValueError(f"background {background}: expected three numbers, red, green and blue")
    if tree.ndc is None and tree.device != "cpu" and dispatch.triton_usable():
        from efficientnerf.backends.triton import tree as cuda_tree

        return Rendering(*(part.cpu().numpy() for part in cuda_tree.render_image(tree.on_device, camera, background=background, supersample=supersample)))
    if tree.ndc is not None or tree.lookup == "nearest":
        return _render_by_rays(tree, camera, behind, supersample)
    return Rendering(*render_image(tree, camera, supersample, behind, normals=True, rays_per_band=RAYS_PER_BAND))


def _rays_as_they_are(tree: NerfTree, camera: Camera, behind: np.ndarray) -> Rendering:
    """`_render_by_rays` of one ray to a pixel, where nothing has to be merged."""
    from efficientnerf.asset.tree import Rendering

    height, width = camera.height, camera.width
    colour, opacity = np.empty((height, width, 3), np.float32), np.empty((height, width), np.float32)
    depth, normal = np.empty_like(opacity), np.empty_like(colour)
    step = max(1, RAYS_PER_BAND // 2 // width)
    for top in range(0, height, step):
        y, x = np.mgrid[top : min(height, top + step), 0:width]
        origins, directions = rays(camera, np.stack([x.ravel(), y.ravel()], axis=-1) + 0.5)
        part = tree.render_rays(origins, directions, eye=camera.centre, columns=width)
        to, hit = slice(top, top + len(y)), part.opacity >= 0.5
        depth[to] = np.where(hit, part.depth * (directions @ camera.forward), np.inf).reshape(y.shape)
        normal[to] = (part.normal * hit[:, None]).reshape(*y.shape, 3)
        opacity[to] = part.opacity.reshape(y.shape)
        colour[to] = (part.colour + (1 - part.opacity[:, None]) * behind).reshape(*y.shape, 3)
    return Rendering(colour, opacity, depth, normal)


def _render_by_rays(tree: NerfTree, camera: Camera, behind: np.ndarray, supersample: int) -> Rendering:
    """A picture band by band of `NerfTree.render_rays`: of a tree whose frame is not the world, where rays of one camera part, or that is not interpolated."""
    from efficientnerf.asset.tree import Rendering

    height, width, n = camera.height, camera.width, supersample
    if n == 1:
        return _rays_as_they_are(tree, camera, behind)
    bands = []
    step = max(1, RAYS_PER_BAND // 2 // (width * n**2))
    for top in range(0, height, step):
        y, x = np.mgrid[top * n : min(height, top + step) * n, 0 : width * n]
        origins, directions = rays(camera, (np.stack([x.ravel(), y.ravel()], axis=-1) + 0.5) / n)
        part = tree.render_rays(origins, directions, eye=camera.centre, columns=width * n)
        along = (part.depth * (directions @ camera.forward)).astype(np.float32)
        values = np.concatenate([part.colour, part.opacity[:, None], along[:, None], part.normal], axis=1, dtype=np.float32)
        rows = len(y) // n
        bands.append(values.reshape(rows, n, width, n, 8).swapaxes(1, 2).reshape(rows, width, n * n, 8))
    samples = np.concatenate(bands)  # (H, W, n^2, 8)
    colour, opacity = samples[..., :3].mean(axis=2), samples[..., 3].mean(axis=2)
    # The nearest half of the samples decides; the mean of a near and a far surface would lie on neither.
    near = np.sort(samples[..., 4], axis=2)
    middle = np.clip(np.isfinite(near).sum(axis=2, keepdims=True) - 1, 0, (n * n - 1) // 2)  # less than half may do, where others are half transparent
    depth = np.take_along_axis(near, middle, axis=2)[..., 0]
    facing = samples[..., 5:].sum(axis=2)
    normal = facing / np.maximum(np.linalg.norm(facing, axis=-1, keepdims=True), 1e-12)
    depth[opacity < 0.5] = np.inf
    normal[opacity < 0.5] = 0
    return Rendering(colour + (1 - opacity[..., None]) * behind, opacity, depth, normal)


@dataclass(frozen=True)
class SampleCounts:
    """Samples of some rays; intervals: rays x N_c, between near and far (in contracted space, those that a ray passes); valid: see `valid_count`."""

    rays: int = 0
    intervals: float = 0.0
    valid: int = 0
    pivotal: int = 0
    fine: int = 0

    def __add__(self, other: SampleCounts) -> SampleCounts:
        return SampleCounts(*(a + b for a, b in zip(astuple(self), astuple(other), strict=True)))

    @property
    def valid_share(self) -> float:
        """V of equation 5: valid samples over rays x N_c."""
        return self.valid / max(self.intervals, 1e-9)

    @property
    def pivotal_share(self) -> float:
        """P of equation 12: pivotal samples over rays x N_c."""
        return self.pivotal / max(self.intervals, 1e-9)


@dataclass(frozen=True)
class FieldRendering:
    """What a camera sees of a field, and how much of it lies in the box.

    colour          (H, W, 3) sRGB with all that lies behind
    opacity         (H, W) of all samples
    depth           (H, W) along the view axis, world units; infinity where less than half of the light is absorbed
    before          (H, W, 4) premultiplied colour and opacity of what lies between the camera and the box
    behind          (H, W, 3) colour of what lies beyond the box, as if the box were empty
    inside_opacity  (H, W) of what lies in the box
    counts          of the samples that it took
    """

    colour: np.ndarray
    opacity: np.ndarray
    depth: np.ndarray
    before: np.ndarray
    behind: np.ndarray
    inside_opacity: np.ndarray
    counts: SampleCounts = SampleCounts()


def valid_count(m: Model, seen: RayOutputs) -> int:
    """How many coarse samples were valid: those that the density voxels left, or, where nothing is pruned, those whose density the voxels would call
    valid. That is how section 3.3 of EfficientNeRF counts on a trained NeRF (equation 5)."""
    if m.prunes:
        return len(seen.coarse.start)
    density = seen.coarse_raw[:, 0]
    if m.voxels.rule == "maximum":
        density = activate(density, m.proposal_field.activation)
    return int((density > m.voxels.threshold).sum())


@dataclass(frozen=True)
class FieldRenderer:
    """Draws a trained model; near and far along the view axis, world units."""

    model: Model
    near: float
    far: float

    @torch.no_grad()
    def render(self, camera: Camera, progress: Callable[..., Any] | None = None) -> FieldRendering:
        """The picture that a camera in the training frame takes of the field."""
        m = self.model
        count = camera.width * camera.height
        parts, counts = [], SampleCounts()
        # Where nothing is pruned a ray has as many samples as there are.
        block = FIELD_RAYS_PER_BLOCK if m.prunes else min(FIELD_RAYS_PER_BLOCK, max(64, 2**19 // (m.num_coarse_samples + m.settings.num_importance_samples)))
        for begin in range(0, count, block):
            index = np.arange(begin, min(count, begin + block))
            pixels = np.stack([index % camera.width + 0.5, index // camera.width + 0.5], axis=-1)
            origins, directions = (torch.as_tensor(a, dtype=torch.float32, device=m.device) for a in rays(camera, pixels))
            slant = (directions @ torch.as_tensor(camera.forward, dtype=torch.float32, device=m.device)).clamp(min=1e-3)
            beyond = m.behind(directions)
            seen = render_rays(m, origins, directions, self.near / slant, self.far / slant, torch.full_like(slant, 0.5), beyond)
            intervals = seen.coarse.tried if m.space.contracted else len(index) * (self.far - self.near) / m.step
            counts += SampleCounts(len(index), intervals, valid_count(m, seen), int(seen.pivotal.sum()), len(seen.fine.start))
            parts.append([part.cpu().numpy() for part in split_by_box(m, origins, directions, slant, seen, beyond)])
            if progress is not None:
                progress(begin + len(index), count)
        shape = (camera.height, camera.width)
        columns = [np.concatenate(column) for column in zip(*parts, strict=True)]
        colour, opacity, depth, before, behind, inside = (column.reshape(*shape, *column.shape[1:]) for column in columns)
        return FieldRendering(colour, opacity, depth, before, behind, inside, counts)


def split_by_box(m: Model, origins: Tensor, directions: Tensor, slant: Tensor, seen: RayOutputs, behind: Tensor) -> tuple[Tensor, ...]:
    """The fields of a FieldRendering for rays (R, ...): each fine sample belongs in front of the box, in it or beyond it."""
    count = len(origins)
    ray = ray_of_sample(seen.fine.first, len(seen.fine.start))
    middle = seen.fine.start + seen.fine.extent / 2
    origins, directions = seen.rays.origins, seen.rays.directions
    enter, leave = m.space.intersect(origins, directions)
    misses = leave <= torch.clamp(enter, min=0)  # such a ray sees nothing but what lies beyond
    enter = torch.where(misses, -torch.inf, enter)
    leave = torch.where(misses, -torch.inf, leave)

    def gathered(chosen: Tensor) -> tuple[Tensor, Tensor]:
        weight = seen.fine_weight * chosen
        colour = weight.new_zeros(count, 3).index_add(0, ray, weight[:, None] * seen.fine_rgb)
        return colour, weight.new_zeros(count).index_add(0, ray, weight)

    in_front, beyond = middle < enter[ray], middle > leave[ray]
    before, before_opacity = gathered(in_front)
    _, inside_opacity = gathered(~in_front & ~beyond)
    after, after_opacity = gathered(beyond)
    reaching_box = (1 - before_opacity).clamp(min=0)
    passing_box = (reaching_box - inside_opacity).clamp(min=0)
    rest = (passing_box - after_opacity).clamp(min=0)
    # Where next to no light passes the box nothing is known of what lies beyond it, and nothing depends on it.
    beyond_colour = torch.where((passing_box > 1e-4)[:, None], (after + rest[:, None] * behind) / passing_box.clamp(min=1e-4)[:, None], behind)
    inside = torch.where(reaching_box > 1e-4, inside_opacity / reaching_box.clamp(min=1e-4), torch.zeros_like(inside_opacity))
    # Depth: the first sample at which half of the light is gone.
    gone = torch.cumsum(seen.fine_weight.double(), dim=0)
    gone = gone - torch.cat([gone.new_zeros(1), gone])[seen.fine.first[:-1]][ray]
    depth = torch.full_like(slant, torch.inf).scatter_reduce(0, ray, torch.where(gone >= 0.5, seen.rays.world_distance(middle, ray), torch.inf), reduce="amin")
    return seen.fine_colour, seen.fine_opacity, depth * slant, torch.cat([before, before_opacity[:, None]], dim=1), beyond_colour, inside.clamp(max=1)


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


def render_tree_reference(
    tree: NerfTree, origins: Tensor, directions: Tensor, density: Tensor | None = None, sh: Tensor | None = None
) -> tuple[Tensor, Tensor]:
    """Colour (R, 3), premultiplied, and opacity (R,) of rays by plain sums over every step; differentiable in `density` and `sh`.

    origins, directions  (R, 3) world frame, unit directions
    density, sh          values to use in place of the tree's own
    """
    device, dtype = origins.device, origins.dtype
    density = torch.as_tensor(tree.density_values, device=device, dtype=dtype) if density is None else density
    sh = torch.as_tensor(tree.sh, device=device, dtype=dtype) if sh is None else sh
    looking = directions
    origins, directions, *_ = tree.frame_rays(origins, directions)
    start = (origins - torch.as_tensor(tree.bounds_min, device=device, dtype=dtype)) / tree.voxel
    size = torch.tensor(tree.resolution, device=device, dtype=dtype)
    to_low, to_high = -start / directions, (size - start) / directions
    enter = torch.minimum(to_low, to_high).nan_to_num(-1e30).amax(dim=-1).clamp(min=0)  # (R,)
    leave = torch.maximum(to_low, to_high).nan_to_num(1e30).amin(dim=-1)
    step = 0.5
    count = max(0, int(torch.ceil((leave - enter).clamp(min=0).max() / step).item()) + 1) if len(enter) else 0
    light = torch.ones_like(enter)
    colour = torch.zeros(len(enter), 3, device=device, dtype=dtype)
    harmonics = basis(looking, tree.degree)
    for k in range(count):
        t = enter + (k + 0.5) * step
        sigma, index, weight = tree_density(tree, start + t[:, None] * directions, density)
        alpha = 1 - torch.exp(-sigma * step * tree.voxel)
        alpha = torch.where(t < leave, alpha, 0)
        stored = torch.where(index >= 0, weight, 0)
        share = stored / stored.sum(dim=-1, keepdim=True).clamp(min=1e-12)
        mixed = torch.zeros(len(t), harmonics.shape[1], 3, device=device, dtype=dtype)
        if len(sh):
            mixed = (share[..., None, None] * sh[index.clamp(min=0)]).sum(dim=1)
        rgb = torch.sigmoid((harmonics[:, :, None] * mixed).sum(dim=1))  # (R, 3)
        colour = colour + (light * alpha)[:, None] * rgb
        light = light * (1 - alpha)
    return colour, 1 - light
