"""Loss gradients of a tree's values on CUDA (Triton); `efficientnerf.backends.numba.tree_training` is the same on the CPU.

A ray is marched twice (`efficientnerf.backends.triton.tree_march`): first for its colour and final transmittance, then, with the gradients of its loss by
these known, once more from the front; what lies behind a sample is its ray's colour less what was composited so far. Samples are not stored.

Many rays add to the gradients of one voxel, in whatever order the device runs them. They are added as fixed-point integers, which no order changes:
the same steps give the same bytes, on one kind of device and one version of Triton. `fixed_point_scale` says of how many bits.

R rays, N voxels, K harmonics. Harmonics lie as in `NerfTree.sh`: coefficient k of channel c at 3 k + c of a voxel's row.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import torch
import triton
import triton.language as tl
from torch import Tensor

from efficientnerf.asset.cascades import voxel_cascades
from efficientnerf.asset.tree import NerfTree
from efficientnerf.backends.layout import SSIM_C1, SSIM_C2, SSIM_WINDOW, RayTargets
from efficientnerf.backends.structure import structure_change
from efficientnerf.backends.triton.harmonics import basis_columns
from efficientnerf.backends.triton.launch import INTERPRETED, blocks
from efficientnerf.backends.triton.tree import brick_arrays, device_cascades
from efficientnerf.backends.triton.tree_march import (
    Cascades,
    Rays,
    Scene,
    Voxels,
    colour_of,
    corner_place,
    corner_weight,
    interpolate_harmonics,
    march_cascades,
)
from efficientnerf.backends.triton.vectors import Vec3, add_scaled, load_vec3, store_vec3, zeros_vec3

# Rays and warps of a program by the length of a row of coefficients: so few that what a sample needs stays in registers. Rays of a bundle come from
# anywhere, and a program lasts as long as its longest.
SHAPES = {4: (32, 1), 16: (16, 1), 32: (8, 1), 64: (8, 2), 128: (8, 4)}
RAYS_PER_PROGRAM = 256 if INTERPRETED else 32  # where no coefficients are read
# A sample's gradients are below 25 (four for each channel's colour, through the colour behind and against the background, and the opacity's), and a voxel
# is a corner of at most 7 samples of a ray: the sums stay below 2^8 a ray.
BITS_PER_RAY = 8


@dataclass(frozen=True, eq=False)
class DeviceGrid:
    """Where the voxels of a tree lie; `cascades` and `index` as in `efficientnerf.backends.triton.tree.DeviceTree`."""

    cascades: Cascades
    index: Tensor
    brick: int
    terms: int
    voxel: float
    nearest: bool
    cascade_of: Tensor  # (N,) uint8 the cascade of each voxel; (1,) where there is one

    @property
    def row(self) -> int:
        """Columns of a program: the coefficients of a voxel, up to a power of two."""
        return triton.next_power_of_2(3 * self.terms)

    @property
    def rays(self) -> int:
        """Rays of a program."""
        return RAYS_PER_PROGRAM if INTERPRETED else SHAPES[self.row][0]


def device_grid(tree: NerfTree, device: str | torch.device) -> DeviceGrid:
    owner, index = brick_arrays(tree, device)
    if not len(index):
        index = index.new_full((1, index.shape[1]), -1)  # nothing is read, but kernels need a pointer
    cascade_of = torch.from_numpy(voxel_cascades(tree) if tree.outer else np.zeros(1, np.uint8)).to(device)
    return DeviceGrid(device_cascades(tree, owner), index, tree.brick, tree.harmonics_count, tree.voxel, tree.lookup == "nearest", cascade_of)


class Sums(NamedTuple):
    """Where gradients are added, `scale` to a one: thickness (N,), sh (N, 3 K); stamp (N,), set to `number`."""

    thickness: Any
    sh: Any
    stamp: Any
    number: Any
    scale: Any


class Upstream(NamedTuple):
    """Gradients of the loss: colour, by the rays' colour (Vec3); end, by the final transmittance, negated, times it."""

    colour: Any
    end: Any


class Forward(NamedTuple):
    """transmittance; colour (Vec3), premultiplied."""

    transmittance: Any
    colour: Any


class Backward(NamedTuple):
    """transmittance; behind (Vec3): colour of the samples still to come."""

    transmittance: Any
    behind: Any


class Absorption(NamedTuple):
    """transmittance."""

    transmittance: Any


@triton.jit
def _thickness(index, density, sample, voxel, BRICK: tl.constexpr, NEAREST: tl.constexpr):
    """Optical thickness of samples over a step."""
    sigma = tl.zeros_like(sample.fraction.x)
    for n in tl.static_range(1 if NEAREST else 8):
        place = tl.load(index + corner_place(sample.corner, n, BRICK), sample.inside, other=-1)
        sigma += corner_weight(sample.fraction, n) * tl.load(density + place, place >= 0, other=0.0)
    return sigma * (sample.step * voxel * sample.unit)


@triton.jit
def _shaded(scene, sample, transmittance, BRICK: tl.constexpr, NEAREST: tl.constexpr, K: tl.constexpr):
    """Of samples: whether they show, weight where they do, colour (Vec3), transmittance behind them, and the sum of the corners' weights."""
    voxels = scene.voxels
    thickness = _thickness(voxels.index, voxels.density, sample, voxels.voxel, BRICK, NEAREST)
    after = transmittance * tl.exp(-thickness)
    weight = transmittance - after
    visible = thickness > 0
    mixed, total = interpolate_harmonics(voxels.index, voxels.sh, sample, visible, scene.column, 3 * K, BRICK, NEAREST)
    return visible, weight * visible.to(tl.float32), colour_of(mixed, total, scene.basis, scene.column % 3), after, total


@triton.jit
def _rays(rays, count, K: tl.constexpr, ROW: tl.constexpr, BLOCK: tl.constexpr):
    """This program's rays: numbers, which of them exist, origins, directions, and harmonics of each column of a row (BLOCK, ROW)."""
    r = tl.program_id(0).to(tl.int64) * BLOCK + tl.arange(0, BLOCK)
    live = r < count
    origin, direction = load_vec3(rays.origins, r, live), load_vec3(rays.directions, r, live)
    return r, live, origin, direction, basis_columns(load_vec3(rays.views, r, live), tl.arange(0, ROW) // 3, K)


@triton.jit
def _composite(scene, sample, state, BRICK: tl.constexpr, NEAREST: tl.constexpr, K: tl.constexpr, COLUMNS: tl.constexpr):
    _, weight, rgb, after, _ = _shaded(scene, sample, state.transmittance, BRICK, NEAREST, K)
    return Forward(after, add_scaled(state.colour, weight, rgb))


@triton.jit(do_not_specialize=["count"])
def _forward(
    rays, cascades, voxels, colour, transmittance, count,
    NEAREST: tl.constexpr, CASCADES: tl.constexpr, BRICK: tl.constexpr, K: tl.constexpr, ROW: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """Premultiplied colour (R, 3) and final transmittance (R,) of rays."""
    r, live, origin, direction, basis = _rays(rays, count, K, ROW, BLOCK)
    scene = Scene(voxels, basis, tl.arange(0, ROW))
    start = Forward(tl.full((BLOCK,), 1.0, tl.float32), zeros_vec3(BLOCK))
    end = march_cascades(cascades, origin, direction, live, scene, start, _composite, CASCADES, BRICK, NEAREST, K, ROW)
    store_vec3(colour, r, end.colour, live)
    tl.store(transmittance + r, end.transmittance, live)


@triton.jit
def by_sample(by, behind, weight, rgb, after):
    """Of samples, front to back: colour behind them (Vec3), gradients by their optical thickness, and by the arguments of the sigmoids (Vec3)."""
    rest = Vec3(behind.x - weight * rgb.x, behind.y - weight * rgb.y, behind.z - weight * rgb.z)
    g = by.colour
    by_depth = by.end + g.x * (after * rgb.x - rest.x) + g.y * (after * rgb.y - rest.y) + g.z * (after * rgb.z - rest.z)
    return rest, by_depth, Vec3(g.x * weight * rgb.x * (1 - rgb.x), g.y * weight * rgb.y * (1 - rgb.y), g.z * weight * rgb.z * (1 - rgb.z))


@triton.jit
def _add_gradients(given, sample, state, BRICK: tl.constexpr, NEAREST: tl.constexpr, K: tl.constexpr, COLUMNS: tl.constexpr):
    """given  Scene, Upstream and Sums"""
    scene, by, sums = given[0], given[1], given[2]
    column, channel = scene.column, scene.column % 3
    visible, weight, rgb, after, total = _shaded(scene, sample, state.transmittance, BRICK, NEAREST, K)
    behind, by_depth, by_rgb = by_sample(by, state.behind, weight, rgb, after)
    by_logit = tl.where((channel == 0)[None, :], by_rgb.x[:, None], tl.where((channel == 1)[None, :], by_rgb.y[:, None], by_rgb.z[:, None]))
    by_column = scene.basis * by_logit / total[:, None]
    for n in tl.static_range(1 if NEAREST else 8):
        voxel = tl.load(scene.voxels.index + corner_place(sample.corner, n, BRICK), visible, other=-1).to(tl.int64)
        stored = voxel >= 0
        scaled = tl.where(stored, corner_weight(sample.fraction, n), 0.0) * sums.scale  # by the sum of the stored ones, the others' may be beyond any integer
        tl.store(sums.stamp + voxel, sums.number, stored)
        tl.atomic_add(sums.thickness + voxel, (scaled * by_depth * sample.step).to(tl.int64), stored, sem="relaxed")
        row = sums.sh + voxel[:, None] * (3 * K) + column[None, :]
        tl.atomic_add(row, (scaled[:, None] * by_column).to(tl.int64), stored[:, None] & (column < 3 * K)[None, :], sem="relaxed")
    return Backward(after, behind)


@triton.jit(do_not_specialize=["count", "number"])
def _backward(
    rays, cascades, voxels, outputs, gradients, sums, stamp, count, number, scale,
    NEAREST: tl.constexpr, CASCADES: tl.constexpr, BRICK: tl.constexpr, K: tl.constexpr, ROW: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """Adds `scale` times the gradients by the voxels' optical thickness (N,) and harmonics (N, 3 K), as integers; stamps the voxels that rays meet.

    outputs    colour and transmittance, of `_forward`
    gradients  of the loss by colour, and by opacity
    sums       by optical thickness, and by harmonics
    """
    r, live, origin, direction, basis = _rays(rays, count, K, ROW, BLOCK)
    scene = Scene(voxels, basis, tl.arange(0, ROW))
    behind = load_vec3(outputs[0], r, live)
    by_colour = load_vec3(gradients[0], r, live)
    by_end = tl.load(outputs[1] + r, live, other=1.0) * tl.load(gradients[1] + r, live, other=0.0)
    given = (scene, Upstream(by_colour, by_end), Sums(sums[0], sums[1], stamp, number, scale))
    start = Backward(tl.full((BLOCK,), 1.0, tl.float32), behind)
    march_cascades(cascades, origin, direction, live, given, start, _add_gradients, CASCADES, BRICK, NEAREST, K, ROW)


@triton.jit
def _raise_maximum(given, sample, state, BRICK: tl.constexpr, NEAREST: tl.constexpr, K: tl.constexpr, COLUMNS: tl.constexpr):
    """given  index, density, voxel as in Voxels; transmittance at which rays reach the grid; the buffer that is raised (N,)"""
    index, density, voxel, arriving, maximum = given[0], given[1], given[2], given[3], given[4]
    after = state.transmittance * tl.exp(-_thickness(index, density, sample, voxel, BRICK, NEAREST))
    weight = arriving * (state.transmittance - after)
    for n in tl.static_range(1 if NEAREST else 8):
        place = tl.load(index + corner_place(sample.corner, n, BRICK), sample.inside, other=-1)
        tl.atomic_max(maximum + place, weight * corner_weight(sample.fraction, n), (place >= 0) & (weight > 0), sem="relaxed")
    return Absorption(after)


@triton.jit(do_not_specialize=["count"])
def _max_contributions(
    rays, cascades, index, density, transmittance, maximum, count, voxel,
    NEAREST: tl.constexpr, CASCADES: tl.constexpr, BRICK: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """Raises `maximum` (N,) to what voxels contribute to rays."""
    r = tl.program_id(0).to(tl.int64) * BLOCK + tl.arange(0, BLOCK)
    live = r < count
    origin, direction = load_vec3(rays.origins, r, live), load_vec3(rays.directions, r, live)
    given = (index, density, voxel, tl.load(transmittance + r, live, other=0.0), maximum)
    march_cascades(cascades, origin, direction, live, given, Absorption(tl.full((BLOCK,), 1.0, tl.float32)), _raise_maximum, CASCADES, BRICK, NEAREST, 0, 0)


def fixed_point_scale(rays: int) -> float:
    """2^k, the integer that stands for a gradient of one: the sums over so many rays stay below 2^62."""
    return 2.0 ** (62 - BITS_PER_RAY - math.ceil(math.log2(max(rays, 1))))


def forward(g: DeviceGrid, rays: Rays, density: Tensor, sh: Tensor) -> tuple[Tensor, Tensor]:
    """Premultiplied colour (R, 3) and final transmittance (R,) of rays through voxels of density (N,) and harmonics (N, 3 K)."""
    count = len(rays.origins)
    colour, transmittance = torch.empty(count, 3, device=density.device), torch.empty(count, device=density.device)
    _forward[(blocks(count, g.rays),)](
        rays, g.cascades, Voxels(g.index, density, sh, float(g.voxel)), colour, transmittance, count,
        NEAREST=g.nearest, CASCADES=len(g.cascades.first), BRICK=g.brick, K=g.terms, ROW=g.row, BLOCK=g.rays, num_warps=SHAPES[g.row][1],
    )  # fmt: skip
    return colour, transmittance


def loss_and_gradients(colour: Tensor, transmittance: Tensor, targets: RayTargets, windows: Tensor | None = None) -> tuple[Tensor, Tensor, Tensor]:
    """Loss (R,) of rays, see `RayTargets`, and its gradients by their colour (R, 3) and opacity (R,), with those of the structure of windows whose first rays
    are (W,)."""
    error = targets.transmittance[:, None] * (colour + transmittance[:, None] * targets.background) - targets.colour
    missing = 1 - transmittance - targets.opacity
    slope = error if windows is None else error + targets.structure * _structure_slopes(error, targets.colour, windows)
    by_colour = 2 * slope * targets.transmittance[:, None]
    by_opacity = 2 * targets.opacity_weight * missing - (by_colour * targets.background).sum(dim=1)
    return (error * error).sum(dim=1) + targets.opacity_weight * missing * missing, by_colour, by_opacity


def _structure_slopes(error: Tensor, wanted: Tensor, windows: Tensor) -> Tensor:
    """(R, 3) half of the derivatives of 1 - SSIM, summed over the rays of the windows, by their colours."""
    rays = windows[:, None] + torch.arange(SSIM_WINDOW * SSIM_WINDOW, device=windows.device)
    y = wanted[rays]
    x = y + error[rays]
    of_x, of_y = x.mean(1, keepdim=True), y.mean(1, keepdim=True)
    x, y = x - of_x, y - of_y
    squares, products = (x * x + y * y).mean(1, keepdim=True), (x * y).mean(1, keepdim=True)
    change = structure_change(x, y, of_x, of_y, squares, products, SSIM_C1, SSIM_C2, 2)
    slopes = torch.zeros_like(error)
    slopes[rays.reshape(-1)] = -change.reshape(-1, 3)
    return slopes


def backward(
    g: DeviceGrid, rays: Rays, density: Tensor, sh: Tensor, outputs: tuple[Tensor, Tensor], by: tuple[Tensor, Tensor], sums: tuple[Tensor, Tensor],
    stamp: Tensor, number: int,
) -> None:  # fmt: skip
    """Add the gradients by optical thickness and by harmonics to `sums`, (N,) and (N, 3 K) int64, `fixed_point_scale(R)` to a one.

    outputs  of `forward`
    by       gradients by colour (R, 3) and opacity (R,)
    stamp    (N,) int32: set to `number` where a ray meets a voxel
    """
    count = len(rays.origins)
    _backward[(blocks(count, g.rays),)](
        rays, g.cascades, Voxels(g.index, density, sh, float(g.voxel)), outputs, tuple(part.contiguous() for part in by), sums, stamp,
        count, number, fixed_point_scale(count),
        NEAREST=g.nearest, CASCADES=len(g.cascades.first), BRICK=g.brick, K=g.terms, ROW=g.row, BLOCK=g.rays, num_warps=SHAPES[g.row][1],
    )  # fmt: skip


def max_contributions(g: DeviceGrid, rays: Rays, density: Tensor, transmittance: Tensor, maximum: Tensor) -> None:
    """Raise `maximum` (N,) to the greatest contributions of voxels to rays, which reach the box with `transmittance` (R,)."""
    count = len(rays.origins)
    _max_contributions[(blocks(count, RAYS_PER_PROGRAM),)](
        rays, g.cascades, g.index, density, transmittance, maximum, count, float(g.voxel),
        NEAREST=g.nearest, CASCADES=len(g.cascades.first), BRICK=g.brick, BLOCK=RAYS_PER_PROGRAM, num_warps=1,
    )  # fmt: skip
