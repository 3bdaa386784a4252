"""A NerfTree on a CUDA device, and images of it: the kernel is `efficientnerf.backends.triton.tree_rendering`.

The tree is laid out anew for a device, whose memory is large and whose caches are small. A brick gets a border one voxel wide, copied from its
neighbours, so that the eight corners of any point in its cell lie together, at places that the point alone decides; coefficients of a voxel are a row of
halves (the type in files) whose length is a power of two.

B bricks, N voxels, K harmonics, E = brick + 2.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
import triton
from torch import Tensor

from efficientnerf.asset.cascades import brick_ranges, cascades_of
from efficientnerf.asset.tree import NerfTree
from efficientnerf.backends.transfer import constant, to_device
from efficientnerf.backends.triton.launch import INTERPRETED
from efficientnerf.backends.triton.tree_march import Cascades, Rays, Voxels
from efficientnerf.backends.triton.tree_rendering import DeviceCamera, render
from efficientnerf.backends.triton.vectors import Vec3
from efficientnerf.geometry.cameras import Camera, rays
from efficientnerf.rendering import environment

TILE = (32, 16) if INTERPRETED else (8, 4)  # pixels of a program
BRICKS_PER_BLOCK = 2**14
# A program's warps by the length of a voxel's row of coefficients: as few as keep the row and the basis in registers; twice as many for nested trees.
WARPS = {4: 1, 16: 1, 32: 1, 64: 4, 128: 4}
PINHOLES = ("SIMPLE_PINHOLE", "PINHOLE")
NO_CAMERA = DeviceCamera(*[Vec3(0.0, 0.0, 0.0)] * 4, *[0.0] * 4)


def device_cascades(tree: NerfTree, owner: Tensor) -> Cascades:
    """The grids of a tree, sent to the device of `owner`, the first result of `brick_arrays`."""
    device = owner.device
    cascades = cascades_of(tree)
    sizes = [cascade.brick_index.size for cascade in cascades]
    place = [(*((cascade.bounds_min - tree.bounds_min) / tree.voxel), cascade.voxel / tree.voxel) for cascade in cascades]
    shapes = torch.tensor([cascade.shape for cascade in cascades], dtype=torch.int32, device=device)
    first = torch.tensor(np.cumsum([0, *sizes[:-1]]), dtype=torch.int64, device=device)
    return Cascades(owner, shapes, first, torch.tensor(np.asarray(place), dtype=torch.float32, device=device), Vec3(*tree.shape), float(tree.step_size))


@dataclass(frozen=True, eq=False)
class DeviceTree:
    """What the kernel reads."""

    # grids; their `owner` is (X, Y, Z) int32: the brick that a coarse cell owns, or the negative of the cells that a ray may skip; of a nested tree those of
    # all cascades one after the other
    cascades: Cascades
    density: Tensor  # (B, E^3) float16, voxels of a brick with its border, z fastest; 0 where nothing is stored
    index: Tensor  # (B, E^3) int32: which voxel's coefficients, -1 where nothing is stored
    sh: Tensor  # (N, row) float16: K coefficients for red, green and blue each, then zeros
    brick: int
    terms: int
    voxel: float
    low: np.ndarray  # (3,) corner of cascade 0 in the tree's frame; `voxel` its unit there
    nearest: bool = False  # whether voxels are not interpolated
    environment: Tensor | None = None  # (H, 2 H, 3) float32 or None, see `NerfTree`

    @property
    def bytes(self) -> int:
        tensors = (self.cascades.owner, self.density, self.index, self.sh, *(() if self.environment is None else (self.environment,)))
        return sum(t.numel() * t.element_size() for t in tensors)


class DeviceRendering(NamedTuple):
    """`efficientnerf.asset.rendering.Rendering` on the device: colour (..., 3), opacity (...), depth (...), normal (..., 3), float32."""

    colour: Tensor
    opacity: Tensor
    depth: Tensor
    normal: Tensor


def brick_arrays(tree: NerfTree, device: str | torch.device) -> tuple[Tensor, Tensor]:
    """`cascades.owner` and `index` of a DeviceTree, on the device; bricks are taken in blocks, so that little more than the result is needed."""
    voxel_index = torch.from_numpy(np.ascontiguousarray(tree.voxel_index, np.int32)).to(device)
    index = torch.empty(len(voxel_index), (tree.brick + 2) ** 3, dtype=torch.int32, device=device)
    grids = []
    for n, (cascade, (first, end)) in enumerate(zip(cascades_of(tree), brick_ranges(tree), strict=True)):
        brick_index = torch.from_numpy(np.ascontiguousarray(cascade.brick_index)).to(device)
        leap = torch.from_numpy((cascade.leap if n else tree.leap).astype(np.int32)).to(device)
        _bordered(brick_index, voxel_index, tree.brick, index[first:end])
        grids.append(torch.where(brick_index >= 0, brick_index, -leap))
    return torch.cat([grid.reshape(-1) for grid in grids]) if tree.outer else grids[0].contiguous(), index


def _bordered(brick_index: Tensor, voxel_index: Tensor, d: int, index: Tensor) -> None:
    """The voxels of a cascade's bricks into `index` (b, E^3), with a border of their neighbours in it."""
    reach = torch.arange(-1, d + 1, device=index.device)
    border = torch.stack(torch.meshgrid(reach, reach, reach, indexing="ij"), dim=-1).reshape(-1, 3)  # (E^3, 3)
    cells = torch.nonzero(brick_index >= 0)  # (b, 3), in the order of the cells
    cells = cells[torch.argsort(brick_index[tuple(cells.unbind(1))])]
    size = torch.tensor(brick_index.shape, device=index.device) * d
    for begin in range(0, len(index), BRICKS_PER_BLOCK):
        at = cells[begin : begin + BRICKS_PER_BLOCK, None] * d + border  # (b, E^3, 3)
        there = ((at >= 0) & (at < size)).all(dim=-1)
        at = at.clamp(min=0).minimum(size - 1)
        cell = at // d
        owner = brick_index[cell[..., 0], cell[..., 1], cell[..., 2]].long()
        local = at - cell * d
        slot = (local[..., 0] * d + local[..., 1]) * d + local[..., 2]
        index[begin : begin + BRICKS_PER_BLOCK] = torch.where(there & (owner >= 0), voxel_index[owner.clamp(min=0), slot], -1)


def device_tree_of(tree: NerfTree) -> DeviceTree:
    """The tree on the device that it is rendered on, sent once."""
    if "device_tree" not in tree.derived:
        tree.derived["device_tree"] = device_tree(tree, tree.device)
    return tree.derived["device_tree"]


def device_tree(tree: NerfTree, device: str | torch.device = "cuda") -> DeviceTree:
    """Send a tree to the device; in blocks, so that little more than the result is needed."""
    owner, index = brick_arrays(tree, device)
    values = torch.from_numpy(np.ascontiguousarray(tree.density_values, np.float32)).to(device)
    density = torch.empty(index.shape, dtype=torch.float16, device=device)
    for begin in range(0, len(index), BRICKS_PER_BLOCK):
        found = index[begin : begin + BRICKS_PER_BLOCK].long()
        density[begin : begin + BRICKS_PER_BLOCK] = torch.where(found >= 0, values[found.clamp(min=0)], 0).clamp(max=65504).half()
    terms, row = tree.harmonics_count, triton.next_power_of_2(3 * tree.harmonics_count)
    sh = torch.zeros(len(values), row, dtype=torch.float16, device=device)
    step = 2**18
    for begin in range(0, len(values), step):
        part = torch.from_numpy(np.ascontiguousarray(tree.coefficients(slice(begin, begin + step)))).to(device)
        sh[begin : begin + step, : 3 * terms] = part.transpose(1, 2).reshape(len(part), 3 * terms).clamp(-65504, 65504).half()
    surroundings = None if tree.environment is None else torch.from_numpy(np.ascontiguousarray(tree.environment, np.float32)).to(device)
    cascades, nearest = device_cascades(tree, owner), tree.lookup == "nearest"
    return DeviceTree(cascades, density, index, sh, tree.brick, terms, tree.voxel, tree.bounds_min, nearest, surroundings)


def _launch(
    t: DeviceTree, count: int, rays: Rays | None, camera: DeviceCamera, size: tuple[int, int], background: tuple[float, float, float] | None
) -> DeviceRendering:
    out = DeviceRendering(*(torch.empty(count, *tail, device=t.density.device) for tail in ((3,), (), (), (3,))))
    if count == 0:
        return out
    wide, high = TILE
    programs = triton.cdiv(count, wide * high) if rays else triton.cdiv(size[0], wide) * triton.cdiv(size[1], high)
    # Without voxels there is nothing that the kernel would read, but it must have something to point at.
    density, index, sh = (x if len(x) else x.new_zeros(1, x.shape[1]) for x in (t.density, t.index, t.sh))
    render[(programs,)](
        rays or Rays(*[out.colour] * 3), t.cascades, Voxels(index, density, sh, float(t.voxel)), out, count, *size, camera,
        Vec3(*(float(x) for x in background or (0, 0, 0))),
        PINHOLE=rays is None, OVER=background is not None, NEAREST=t.nearest, CASCADES=len(t.cascades.first), BRICK=t.brick, K=t.terms,
        ROW=t.sh.shape[1], WIDE=wide, HIGH=high, num_warps=WARPS[t.sh.shape[1]] * min(2, len(t.cascades.first)),
    )  # fmt: skip
    return out


def render_rays(t: DeviceTree, origins: Tensor, directions: Tensor, views: Tensor | None = None) -> DeviceRendering:
    """Rays of the tree's frame on the device: origins (R, 3), unit directions (R, 3), and those in the world where the frame is another; colours are
    premultiplied, without the environment.

    Depth is the distance along the ray, normals are of the frame; nothing waits for the device.
    """
    start = ((origins.double() - constant(t.low, origins.double())) / t.voxel).float().contiguous()
    along = directions.float().contiguous()
    view_directions = along if views is None else views.float().contiguous()
    return _launch(t, len(start), Rays(start, along, view_directions), NO_CAMERA, (0, 0), None)


def tree_rays(
    tree: NerfTree, origins: np.ndarray, directions: np.ndarray, views: np.ndarray | None, eye: np.ndarray | None, columns: int | None
) -> tuple[np.ndarray, ...]:
    """`render_rays` from and to the host; waits for the device."""
    given = (origins, directions) if views is None else (origins, directions, views)
    on_device = [torch.from_numpy(np.ascontiguousarray(a, np.float64)).to(tree.device) for a in given]
    return tuple(part.cpu().numpy() for part in render_rays(device_tree_of(tree), *on_device))


@functools.lru_cache(maxsize=4)
def _camera_directions(width: int, height: int, model: str, params: tuple[float, ...], supersample: int, device: torch.device) -> Tensor:
    """Unit directions (rays, 3) in the camera, of all samples row by row; kept, because distortion is inverted on the host."""
    still = Camera("lens", width, height, model, params, np.eye(4))
    y, x = np.mgrid[0 : height * supersample, 0 : width * supersample]
    pixels = (np.stack([x.ravel(), y.ravel()], -1) + 0.5) / supersample
    return torch.from_numpy(rays(still, pixels)[1].astype(np.float32)).to(device)


def render_image(t: DeviceTree, camera: Camera, *, background: tuple[float, float, float] | None = None, supersample: int = 1) -> DeviceRendering:
    """The image of a camera in the tree's frame, (H, W, ...), on the device; nothing waits for it.

    One launch where the camera is a pinhole and `supersample` is 1; else rays are made, samples averaged, or the environment looked up, by some more. See
    `efficientnerf.asset.rendering.render`.
    """
    if supersample < 1:
        raise ValueError(f"supersample {supersample}: expected at least 1")
    height, width = camera.height * supersample, camera.width * supersample
    over = background if supersample == 1 else None
    rotation = to_device(torch.from_numpy(camera.world_from_camera[:3, :3].T.astype(np.float32)), t.density.device)
    if camera.model in PINHOLES:
        k = camera.intrinsics
        centre, rows = ((camera.centre - t.low) / t.voxel).tolist(), camera.world_from_camera[:3, :3].astype(np.float64).tolist()
        lens = (float(k[name] * supersample) for name in ("fx", "fy", "cx", "cy"))
        flat = _launch(t, height * width, None, DeviceCamera(Vec3(*centre), *(Vec3(*row) for row in rows), *lens), (width, height), over)
    else:
        local = _camera_directions(camera.width, camera.height, camera.model, camera.params, supersample, t.density.device)
        place = tuple(float(x) for x in (camera.centre - t.low) / t.voxel)
        start = torch.stack([torch.full_like(local[:, 0], x) for x in place], dim=1)
        along = local @ rotation
        flat = _launch(t, len(start), Rays(start, along, along), NO_CAMERA, (0, 0), over)
        flat = flat._replace(depth=flat.depth * local[:, 2])
    if background is None and t.environment is not None:
        local = _camera_directions(camera.width, camera.height, camera.model, camera.params, supersample, t.density.device)
        flat = flat._replace(colour=flat.colour + (1 - flat.opacity[:, None]) * environment.lookup_on(t.environment, local @ rotation))
    shape = (camera.height, supersample, camera.width, supersample)
    if supersample == 1:
        return DeviceRendering(*(x.reshape(camera.height, camera.width, *x.shape[1:]) for x in flat))
    return _averaged(DeviceRendering(*(x.reshape(*shape, *x.shape[1:]) for x in flat)), background)


def _averaged(samples: DeviceRendering, background: tuple[float, float, float] | None) -> DeviceRendering:
    """Pixels from samples (H, s, W, s, ...), as `efficientnerf.asset.rendering.render` makes them."""
    height, s, width, _ = samples.opacity.shape
    colour, opacity = samples.colour.mean(dim=(1, 3)), samples.opacity.mean(dim=(1, 3))
    along = samples.depth.permute(0, 2, 1, 3).reshape(height, width, s * s).sort(dim=-1).values
    hits = along.isfinite().sum(dim=-1, keepdim=True)
    middle = (hits - 1).clamp(0, (s * s - 1) // 2)
    solid = opacity >= 0.5
    depth = torch.where(solid, along.gather(-1, middle)[..., 0], torch.inf)
    facing = samples.normal.sum(dim=(1, 3))
    normal = facing / facing.norm(dim=-1, keepdim=True).clamp(min=1e-12) * solid[..., None]
    if background is not None:
        for channel, value in enumerate(background):
            colour[..., channel] += (1 - opacity) * value
    return DeviceRendering(colour, opacity, depth, normal)
