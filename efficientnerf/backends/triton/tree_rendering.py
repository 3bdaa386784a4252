"""The kernel that renders a NerfTree on CUDA (Triton): one program a block of rays, one launch an image.

All lanes of a block stay in the loop until the last ray has ended, so the rays of a block are a small tile of the image, and a block is one warp.
A sample's coefficients are a row of halves that neighbouring lanes read together; sums over the corners come first, the harmonics once after them.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import triton
import triton.language as tl

from efficientnerf.backends.triton.harmonics import basis_columns
from efficientnerf.backends.triton.tree_march import (
    Grid,
    Scene,
    cascade_grid,
    colour_of,
    density_at,
    in_cascade,
    interpolate_density,
    interpolate_harmonics,
    march_cascades,
)
from efficientnerf.backends.triton.vectors import Vec3, add_scaled, along, load_vec3, store_vec3, zeros_vec3

MIN_WEIGHT = tl.constexpr(1e-4)  # below it a sample's colour is not looked up, and its weight is added to that of the next one


class DeviceCamera(NamedTuple):
    """centre Vec3, voxel coordinates; x, y, z Vec3, rows of the rotation, camera to world; focal lengths and principal point, pixels."""

    centre: Any
    x: Any
    y: Any
    z: Any
    focal_x: Any
    focal_y: Any
    principal_x: Any
    principal_y: Any


class State(NamedTuple):
    """transmittance; pending_weight of samples without a colour; colour (Vec3, premultiplied); depth along the ray where the transmittance is a half,
    voxels of cascade 0."""

    transmittance: Any
    pending_weight: Any
    colour: Any
    depth: Any


@triton.jit
def _pixel_rays(camera, width, height, WIDE: tl.constexpr, HIGH: tl.constexpr):
    """This program's tile of a pinhole camera's image: pixels, which of them exist, origins, directions, and the cosines of their angles to the axis."""
    lane = tl.arange(0, WIDE * HIGH)
    across = (width + WIDE - 1) // WIDE
    px = (tl.program_id(0) % across) * WIDE + lane % WIDE
    py = (tl.program_id(0) // across) * HIGH + lane // WIDE
    u = (px.to(tl.float32) + 0.5 - camera.principal_x) / camera.focal_x
    v = (py.to(tl.float32) + 0.5 - camera.principal_y) / camera.focal_y
    cosine = 1 / tl.sqrt(u * u + v * v + 1)
    rx, ry, rz = camera.x, camera.y, camera.z
    direction = Vec3((rx.x * u + rx.y * v + rx.z) * cosine, (ry.x * u + ry.y * v + ry.z) * cosine, (rz.x * u + rz.y * v + rz.z) * cosine)
    origin = Vec3(camera.centre.x + 0 * direction.x, camera.centre.y + 0 * direction.x, camera.centre.z + 0 * direction.x)
    return py.to(tl.int64) * width + px, (px < width) & (py < height), origin, direction, cosine


@triton.jit
def _composite(scene, sample, state, BRICK: tl.constexpr, NEAREST: tl.constexpr, K: tl.constexpr, COLUMNS: tl.constexpr):
    """Add a sample to the State of its rays."""
    voxels = scene.voxels
    sigma = interpolate_density(voxels.density, sample.corner, sample.fraction, sample.inside, BRICK, NEAREST)
    alpha = 1 - tl.exp(-sigma * (sample.step * voxels.voxel * sample.unit))
    pending = state.pending_weight + state.transmittance * alpha
    visible = sample.inside & (pending > MIN_WEIGHT) & (sigma > 0)
    colour = state.colour
    if tl.max(visible.to(tl.int32), 0) > 0:
        mixed, total = interpolate_harmonics(voxels.index, voxels.sh, sample, visible, scene.column, COLUMNS, BRICK, NEAREST)
        rgb = colour_of(mixed, total, scene.basis, scene.column // K)
        colour = add_scaled(colour, tl.where(visible, pending, 0.0), rgb)
        pending = tl.where(visible, 0.0, pending)
    after = state.transmittance * (1 - alpha)
    crossing = sample.inside & (state.transmittance > 0.5) & (after <= 0.5)
    at_half = (sample.distance - 0.5 * sample.step) * sample.unit + tl.log(2 * tl.maximum(state.transmittance, 0.5)) / (tl.maximum(sigma, 1e-20) * voxels.voxel)
    return State(after, pending, colour, tl.where(crossing, at_half, state.depth))


@triton.jit
def _normal(grid, density, p, live, BRICK: tl.constexpr, NEAREST: tl.constexpr):
    """Unit vectors down the density's gradient at points, by central differences of one voxel; zero where it is flat."""
    gx, gy, gz = tl.zeros_like(p.x), tl.zeros_like(p.x), tl.zeros_like(p.x)
    for face in range(6):  # in a loop: six copies of it take the compiler seconds
        side = 1 - 2 * (face % 2)
        x, y, z = tl.where(face // 2 == 0, side, 0), tl.where(face // 2 == 1, side, 0), tl.where(face // 2 == 2, side, 0)
        value = density_at(grid, density, Vec3(p.x - x, p.y - y, p.z - z), live, BRICK, NEAREST)
        gx, gy, gz = gx + x * value, gy + y * value, gz + z * value
    length = tl.sqrt(gx * gx + gy * gy + gz * gz)
    length = tl.where(length > 0, length, 1.0)
    return Vec3(gx / length, gy / length, gz / length)


@triton.jit
def _surface_normal(cascades, density, p, live, CASCADES: tl.constexpr, BRICK: tl.constexpr, NEAREST: tl.constexpr):
    """`_normal` in the cascades that points belong to."""
    if CASCADES == 1:
        facing = _normal(Grid(cascades.owner, cascades.shape), density, p, live, BRICK, NEAREST)
    else:
        facing = Vec3(0 * p.x, 0 * p.y, 0 * p.z)
        for n in range(CASCADES):
            grid, corner, unit = cascade_grid(cascades, n)
            q, size = in_cascade(p, corner, unit), grid.shape
            here = live & (q.x >= 0) & (q.y >= 0) & (q.z >= 0) & (q.x < size.x * BRICK) & (q.y < size.y * BRICK) & (q.z < size.z * BRICK)
            found = _normal(grid, density, q, here, BRICK, NEAREST)
            facing = Vec3(tl.where(here, found.x, facing.x), tl.where(here, found.y, facing.y), tl.where(here, found.z, facing.z))
            live = live & (here == 0)
    return facing


@triton.jit(do_not_specialize=["count", "width", "height"])
def render(
    rays, cascades, voxels, out, count, width, height, camera, background,
    PINHOLE: tl.constexpr, OVER: tl.constexpr, NEAREST: tl.constexpr, CASCADES: tl.constexpr, BRICK: tl.constexpr, K: tl.constexpr,
    ROW: tl.constexpr, WIDE: tl.constexpr, HIGH: tl.constexpr,
):  # fmt: skip
    """PINHOLE: pixels of a camera; depth along the view axis, infinity where the opacity is below a half. Else: `count` rays; depth along the ray.

    OVER composites over the background, Vec3. WIDE x HIGH pixels make a program. out: `efficientnerf.backends.triton.tree.DeviceRendering`.
    """
    BLOCK: tl.constexpr = WIDE * HIGH
    column = tl.arange(0, ROW)
    if PINHOLE:
        r, live, origin, direction, cosine = _pixel_rays(camera, width, height, WIDE, HIGH)
        basis = basis_columns(direction, column % K, K)
    else:
        r = tl.program_id(0).to(tl.int64) * BLOCK + tl.arange(0, BLOCK)
        live = r < count
        direction = load_vec3(rays.directions, r, live)
        origin = load_vec3(rays.origins, r, live)
        cosine = tl.full((BLOCK,), 1.0, tl.float32)
        basis = basis_columns(load_vec3(rays.views, r, live), column % K, K)
    start = State(tl.full((BLOCK,), 1.0, tl.float32), tl.zeros((BLOCK,), tl.float32), zeros_vec3(BLOCK), tl.full((BLOCK,), float("inf"), tl.float32))
    scene = Scene(voxels, basis, column)
    end = march_cascades(cascades, origin, direction, live, scene, start, _composite, CASCADES, BRICK, NEAREST, K, ROW)

    opaque = live & (end.transmittance <= 0.5)
    surface = along(origin, direction, tl.where(opaque, end.depth, 0.0))
    facing = _surface_normal(cascades, voxels.density, surface, opaque, CASCADES, BRICK, NEAREST)
    rgb = end.colour
    if OVER:
        rgb = add_scaled(rgb, end.transmittance, background)
    store_vec3(out.colour, r, rgb, live)
    tl.store(out.opacity + r, 1 - end.transmittance, live)
    tl.store(out.depth + r, tl.where(opaque, end.depth * voxels.voxel * cosine, float("inf")), live)
    store_vec3(out.normal, r, facing, live)
