"""Rays through a tree forward and backward on CUDA (Triton), for the optimisation of its values; `cpu_tree_grad` is the same on the CPU.

A ray is walked twice (`efficientnerf.backends.triton.tree_walk`): first for its colour and the light left, then, with the gradients of its loss by these known,
once more from the front; what lies behind a sample is its ray's colour less what was met so far. Nothing is kept of the samples.

Many rays add to the gradients of one voxel, in whatever order the device runs them. They are added as whole numbers, 2^-k each, which no order changes:
the same steps give the same bytes, on one kind of device and one version of Triton. k is chosen so that the sums cannot overflow (`resolution`).

R rays, N voxels, K harmonics. Harmonics lie as in `NerfTree.sh`: coefficient k of channel c at 3 k + c of a voxel's row.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

import torch
import triton
import triton.language as tl
from torch import Tensor

from efficientnerf.backends.numba.tree.gradients import MAX_THICKNESS, MIN_THICKNESS, RayTargets
from efficientnerf.backends.triton.hash_grid import INTERPRETED
from efficientnerf.backends.triton.tree import laid_out
from efficientnerf.backends.triton.tree_walk import STEP, STOP, at_corner, coefficients, entry, goes_on, harmonics_along, sample, shade, share, vectors

if TYPE_CHECKING:
    from efficientnerf.asset.tree import NerfTree

# Rays and warps of a program by the length of a row of coefficients: so few that what a sample needs stays in registers. Rays of a bundle come from
# anywhere, and a program lasts as long as its longest.
SHAPES = {4: (32, 1), 16: (16, 1), 32: (8, 1), 64: (8, 2), 128: (8, 4)}
RAYS_AT_ONCE = 256 if INTERPRETED else 32  # of a program that looks at no coefficients
VOXELS = 256 if INTERPRETED else 32  # of a program that takes a step
# A sample's gradients are below 25 (four for each channel's colour, through the light behind and against the background, and the opacity's), and a voxel
# is a corner of at most 7 samples of a ray: the sums stay below 2^8 a ray.
BITS_A_RAY = 8
MOST_VISITS = 60000  # from there on they no longer show


class Rays(NamedTuple):
    """Of a bundle, on the device, contiguous: origins, directions (R, 3) float32 in voxel coordinates, directions in the world `looking` (R, 3)."""

    origins: Tensor
    directions: Tensor
    looking: Tensor


@dataclass(frozen=True, eq=False)
class DeviceGrid:
    """Where the voxels of a tree lie; `grid` and `index` as in `efficientnerf.backends.triton.tree.DeviceTree`."""

    grid: Tensor
    index: Tensor
    brick: int
    terms: int
    voxel: float
    nearest: bool

    @property
    def row(self) -> int:
        return triton.next_power_of_2(3 * self.terms)

    @property
    def rays(self) -> int:
        """Rays of a program."""
        return RAYS_AT_ONCE if INTERPRETED else SHAPES[self.row][0]


def device_grid(tree: NerfTree, device: str | torch.device) -> DeviceGrid:
    grid, index = laid_out(tree, device)
    if not len(index):
        index = index.new_full((1, index.shape[1]), -1)  # nothing is read, but there must be something to point at
    return DeviceGrid(grid, index, tree.brick, tree.harmonics_count, tree.voxel, tree.lookup == "nearest")


@triton.jit
def _thickness(index, density, base, fx, fy, fz, live, units, BRICK: tl.constexpr, NEAREST: tl.constexpr):  # type: ignore[no-untyped-def]
    """Optical thickness of samples a step long."""
    sigma = tl.zeros_like(fx)
    for corner in tl.static_range(1 if NEAREST else 8):
        voxel = tl.load(index + at_corner(base, corner, BRICK), live, other=-1)
        sigma += share(fx, fy, fz, corner) * tl.load(density + voxel, voxel >= 0, other=0.0)
    return sigma * (STEP * units)


@triton.jit
def _rays(origins, directions, looking, rays, nx, ny, nz, BRICK: tl.constexpr, K: tl.constexpr, ROW: tl.constexpr, BLOCK: tl.constexpr):  # type: ignore[no-untyped-def]
    """This program's rays: numbers, which of them there are, origins, directions, harmonics of each column of a row (BLOCK, ROW); and `entry`."""
    r = tl.program_id(0).to(tl.int64) * BLOCK + tl.arange(0, BLOCK)
    live = r < rays
    x0, y0, z0 = vectors(origins, r, live)
    dx, dy, dz = vectors(directions, r, live)
    sx, sy, sz = vectors(looking, r, live)
    basis = harmonics_along(sx, sy, sz, tl.arange(0, ROW) // 3, K)
    ix, iy, iz, begin, end = entry(x0, y0, z0, dx, dy, dz, nx, ny, nz, BRICK)
    return r, live, x0, y0, z0, dx, dy, dz, basis, ix, iy, iz, begin, end


@triton.jit
def _see(  # type: ignore[no-untyped-def]
    origins, directions, looking, grid, index, density, sh, colour, rest, rays, nx, ny, nz, units,
    NEAREST: tl.constexpr, BRICK: tl.constexpr, K: tl.constexpr, ROW: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """Premultiplied colour (R, 3) of rays, and the light left (R,)."""
    column = tl.arange(0, ROW)
    r, live, x0, y0, z0, dx, dy, dz, basis, ix, iy, iz, begin, end = _rays(origins, directions, looking, rays, nx, ny, nz, BRICK, K, ROW, BLOCK)
    light = tl.full((BLOCK,), 1.0, tl.float32)
    cr, cg, cb = tl.zeros((BLOCK,), tl.float32), tl.zeros((BLOCK,), tl.float32), tl.zeros((BLOCK,), tl.float32)
    k = tl.zeros((BLOCK,), tl.int32)
    alive = live & goes_on(k, begin, end)
    while tl.max(alive.to(tl.int32), 0) > 0:
        _, inside, base, fx, fy, fz, k = sample(grid, k, begin, end, x0, y0, z0, dx, dy, dz, ix, iy, iz, nx, ny, nz, alive, BRICK, NEAREST)
        if tl.max(inside.to(tl.int32), 0) > 0:
            thickness = _thickness(index, density, base, fx, fy, fz, inside, units, BRICK, NEAREST)
            left = light * tl.exp(-thickness)
            weight = light - left
            seen = thickness > 0
            mixed, total = coefficients(index, sh, base, fx, fy, fz, seen, column, 3 * K, BRICK, NEAREST)
            sr, sg, sb = shade(mixed, total, basis, column % 3)
            cr += weight * sr
            cg += weight * sg
            cb += weight * sb
            light = left
        alive = alive & (light >= STOP) & goes_on(k, begin, end)
    tl.store(colour + r * 3, cr, live)
    tl.store(colour + r * 3 + 1, cg, live)
    tl.store(colour + r * 3 + 2, cb, live)
    tl.store(rest + r, light, live)


@triton.jit(do_not_specialize=["number"])
def _pull(  # type: ignore[no-untyped-def]
    origins, directions, looking, grid, index, density, sh, colour, rest, by_colour, by_opacity, by_thickness, by_sh, stamp,
    rays, nx, ny, nz, units, number, ones,
    NEAREST: tl.constexpr, BRICK: tl.constexpr, K: tl.constexpr, ROW: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """Adds `ones` times the gradients by the voxels' optical thickness (N,) and harmonics (N, 3 K), as whole numbers; `stamp` of voxels that were met."""
    column = tl.arange(0, ROW)
    channel = column % 3
    r, live, x0, y0, z0, dx, dy, dz, basis, ix, iy, iz, begin, end = _rays(origins, directions, looking, rays, nx, ny, nz, BRICK, K, ROW, BLOCK)
    # The colour that is still to come.
    cr, cg, cb = vectors(colour, r, live)
    pr, pg, pb = vectors(by_colour, r, live)
    at_end = tl.load(rest + r, live, other=1.0) * tl.load(by_opacity + r, live, other=0.0)
    light = tl.full((BLOCK,), 1.0, tl.float32)
    k = tl.zeros((BLOCK,), tl.int32)
    alive = live & goes_on(k, begin, end)
    while tl.max(alive.to(tl.int32), 0) > 0:
        _, inside, base, fx, fy, fz, k = sample(grid, k, begin, end, x0, y0, z0, dx, dy, dz, ix, iy, iz, nx, ny, nz, alive, BRICK, NEAREST)
        if tl.max(inside.to(tl.int32), 0) > 0:
            thickness = _thickness(index, density, base, fx, fy, fz, inside, units, BRICK, NEAREST)
            left = light * tl.exp(-thickness)
            weight = light - left
            seen = thickness > 0
            mixed, total = coefficients(index, sh, base, fx, fy, fz, seen, column, 3 * K, BRICK, NEAREST)
            sr, sg, sb = shade(mixed, total, basis, channel)
            cr -= weight * sr
            cg -= weight * sg
            cb -= weight * sb
            by_depth = at_end + pr * (left * sr - cr) + pg * (left * sg - cg) + pb * (left * sb - cb)
            by_red, by_green, by_blue = pr * weight * sr * (1 - sr), pg * weight * sg * (1 - sg), pb * weight * sb * (1 - sb)
            pulled = tl.where((channel == 0)[None, :], by_red[:, None], tl.where((channel == 1)[None, :], by_green[:, None], by_blue[:, None]))
            spread = basis * pulled / total[:, None]
            for corner in tl.static_range(1 if NEAREST else 8):
                voxel = tl.load(index + at_corner(base, corner, BRICK), seen, other=-1).to(tl.int64)
                met = voxel >= 0
                part = share(fx, fy, fz, corner) * ones
                tl.store(stamp + voxel, number, met)
                tl.atomic_add(by_thickness + voxel, (part * by_depth * STEP).to(tl.int64), met, sem="relaxed")
                row = by_sh + voxel[:, None] * (3 * K) + column[None, :]
                tl.atomic_add(row, (part[:, None] * spread).to(tl.int64), met[:, None] & (column < 3 * K)[None, :], sem="relaxed")
            light = left
        alive = alive & (light >= STOP) & goes_on(k, begin, end)


@triton.jit
def _weigh(  # type: ignore[no-untyped-def]
    origins, directions, grid, index, density, gain, greatest, rays, nx, ny, nz, units, NEAREST: tl.constexpr, BRICK: tl.constexpr, BLOCK: tl.constexpr
):
    """Raises `greatest` (N,) to what voxels contribute to rays, through what interpolation leaves them."""
    r = tl.program_id(0).to(tl.int64) * BLOCK + tl.arange(0, BLOCK)
    live = r < rays
    x0, y0, z0 = vectors(origins, r, live)
    dx, dy, dz = vectors(directions, r, live)
    ix, iy, iz, begin, end = entry(x0, y0, z0, dx, dy, dz, nx, ny, nz, BRICK)
    light = tl.full((BLOCK,), 1.0, tl.float32)
    arriving = tl.load(gain + r, live, other=0.0)
    k = tl.zeros((BLOCK,), tl.int32)
    alive = live & goes_on(k, begin, end)
    while tl.max(alive.to(tl.int32), 0) > 0:
        _, inside, base, fx, fy, fz, k = sample(grid, k, begin, end, x0, y0, z0, dx, dy, dz, ix, iy, iz, nx, ny, nz, alive, BRICK, NEAREST)
        if tl.max(inside.to(tl.int32), 0) > 0:
            left = light * tl.exp(-_thickness(index, density, base, fx, fy, fz, inside, units, BRICK, NEAREST))
            weight = arriving * (light - left)
            for corner in tl.static_range(1 if NEAREST else 8):
                voxel = tl.load(index + at_corner(base, corner, BRICK), inside, other=-1)
                tl.atomic_max(greatest + voxel, weight * share(fx, fy, fz, corner), (voxel >= 0) & (weight > 0), sem="relaxed")
            light = left
        alive = alive & (light >= STOP) & goes_on(k, begin, end)


@triton.jit(do_not_specialize=["number"])
def _descend(  # type: ignore[no-untyped-def]
    density, sh, by_thickness, by_sh, square_density, square_sh, visits, stamp,
    voxels, number, a_one, voxel, density_rate, colour_rate, view_share, decay, log_decay, epsilon, least, greatest, most_visits,
    WIDTH: tl.constexpr, ROW: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """`efficientnerf.backends.numba.tree.gradients.rmsprop_step` from gradients in whole numbers, `a_one` each."""
    v = tl.program_id(0).to(tl.int64) * BLOCK + tl.arange(0, BLOCK)
    met = tl.load(stamp + v, v < voxels, other=-1) == number
    if tl.max(met.to(tl.int32), 0) > 0:
        visited = tl.minimum(tl.load(visits + v, met, other=0) + 1, most_visits)
        tl.store(visits + v, visited, met)
        right = 1 / (1 - tl.exp(visited.to(tl.float32) * log_decay))
        # Of the logarithm of the optical thickness; where there is none a little is taken, so that matter may come.
        depth = tl.maximum(tl.load(density + v, met, other=0.0) * voxel, least)
        slope = tl.load(by_thickness + v, met, other=0).to(tl.float32) * a_one * depth
        square = decay * tl.load(square_density + v, met, other=0.0) + (1 - decay) * slope * slope
        change = density_rate * slope / (tl.sqrt(square * right) + epsilon)
        tl.store(density + v, tl.minimum(tl.maximum(depth * tl.exp(-change), least), greatest) / voxel, met)
        tl.store(square_density + v, square, met)
        tl.store(by_thickness + v, tl.zeros_like(v), met)
        column = tl.arange(0, ROW)
        at = v[:, None] * WIDTH + column[None, :]
        there = met[:, None] & (column < WIDTH)[None, :]
        grown = tl.load(by_sh + at, there, other=0).to(tl.float32) * a_one
        square = decay * tl.load(square_sh + v, met, other=0.0) + (1 - decay) * tl.sum(grown * grown, 1) / WIDTH
        tl.store(square_sh + v, square, met)
        scale = colour_rate / (tl.sqrt(square * right) + epsilon)
        of_column = tl.where(column < 3, 1.0, view_share)
        tl.store(sh + at, tl.load(sh + at, there, other=0.0) - scale[:, None] * of_column[None, :] * grown, there)
        tl.store(by_sh + at, tl.zeros_like(at), there)


def resolution(rays: int) -> float:
    """2^k, how many whole numbers a gradient of one is, so that the sums over so many rays stay below 2^62."""
    return 2.0 ** (62 - BITS_A_RAY - math.ceil(math.log2(max(rays, 1))))


def look(g: DeviceGrid, rays: Rays, density: Tensor, sh: Tensor) -> tuple[Tensor, Tensor]:
    """Premultiplied colour (R, 3) of rays through voxels of density (N,) and harmonics (N, 3 K), and the light left (R,)."""
    count = len(rays.origins)
    colour, rest = torch.empty(count, 3, device=density.device), torch.empty(count, device=density.device)
    _see[(max(1, triton.cdiv(count, g.rays)),)](
        *rays, g.grid, g.index, density, sh, colour, rest, count, *g.grid.shape, float(g.voxel),
        NEAREST=g.nearest, BRICK=g.brick, K=g.terms, ROW=g.row, BLOCK=g.rays, num_warps=SHAPES[g.row][1],
    )  # fmt: skip
    return colour, rest


def loss_of(colour: Tensor, rest: Tensor, seen: RayTargets) -> tuple[Tensor, Tensor, Tensor]:
    """Loss (R,) of rays, see `RayTargets`, and its gradients by their colour (R, 3) and opacity (R,)."""
    error = seen.transmittance[:, None] * (colour + rest[:, None] * seen.background) - seen.colour
    missing = 1 - rest - seen.opacity
    by_colour = 2 * error * seen.transmittance[:, None]
    by_opacity = 2 * seen.opacity_weight * missing - (by_colour * seen.background).sum(dim=1)
    return (error * error).sum(dim=1) + seen.opacity_weight * missing * missing, by_colour, by_opacity


def pull(
    g: DeviceGrid, rays: Rays, density: Tensor, sh: Tensor, seen_as: tuple[Tensor, Tensor], by: tuple[Tensor, Tensor], sums: tuple[Tensor, Tensor],
    stamp: Tensor, number: int,
) -> None:  # fmt: skip
    """Add the gradients by optical thickness and harmonics to `sums`, (N,) and (N, 3 K) int64, `resolution(R)` to a one.

    seen_as  what `look` said of the rays
    by       gradients by their colour (R, 3) and opacity (R,)
    stamp    (N,) int32: `number` where a voxel was met
    """
    count = len(rays.origins)
    _pull[(max(1, triton.cdiv(count, g.rays)),)](
        *rays, g.grid, g.index, density, sh, *seen_as, *(part.contiguous() for part in by), *sums, stamp,
        count, *g.grid.shape, float(g.voxel), number, resolution(count),
        NEAREST=g.nearest, BRICK=g.brick, K=g.terms, ROW=g.row, BLOCK=g.rays, num_warps=SHAPES[g.row][1],
    )  # fmt: skip


def weigh(g: DeviceGrid, rays: Rays, density: Tensor, gain: Tensor, greatest: Tensor) -> None:
    """Raise `greatest` (N,) to the greatest contributions of voxels to the rays, of which `gain` (R,) of the light reaches the box."""
    count = len(rays.origins)
    _weigh[(max(1, triton.cdiv(count, RAYS_AT_ONCE)),)](
        rays.origins, rays.directions, g.grid, g.index, density, gain, greatest, count, *g.grid.shape, float(g.voxel),
        NEAREST=g.nearest, BRICK=g.brick, BLOCK=RAYS_AT_ONCE, num_warps=1,
    )  # fmt: skip


def descend(
    g: DeviceGrid, values: tuple[Tensor, Tensor], sums: tuple[Tensor, Tensor], squares: tuple[Tensor, Tensor], visits: Tensor, stamp: Tensor, *,
    number: int, rays: int, density_rate: float, colour_rate: float, view_share: float, decay: float, epsilon: float,
) -> None:  # fmt: skip
    """A step of RMSprop for the voxels that the last `pull`, of so many rays, met; see `efficientnerf.backends.numba.tree.gradients.rmsprop_step`."""
    voxels = len(visits)
    _descend[(max(1, triton.cdiv(voxels, VOXELS)),)](
        *values, *sums, *squares, visits, stamp, voxels, number, 1 / resolution(rays), float(g.voxel), density_rate, colour_rate, float(view_share),
        decay, math.log(decay),
        epsilon, MIN_THICKNESS, MAX_THICKNESS, MOST_VISITS, WIDTH=3 * g.terms, ROW=g.row, BLOCK=VOXELS, num_warps=4,
    )  # fmt: skip
