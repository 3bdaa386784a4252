"""The kernel that draws a NerfTree on CUDA (Triton): one program a block of rays, one launch a picture. See `tree_walk`.

All lanes of a block stay in one loop until the last ray has ended, so the rays of a block are a small tile of the picture, and a block is one warp.
A sample's coefficients are a row of halves that neighbouring lanes read together; sums over the corners come first, the harmonics once after them.
"""

from __future__ import annotations

import triton
import triton.language as tl

from efficientnerf.backends.triton.tree_walk import STEP, STOP, coefficients, density_at, entry, goes_on, harmonics_along, interpolated, sample, shade, vectors

FAINT = tl.constexpr(1e-4)  # weight under which a sample's colour is not looked up; the next one that is looked up stands for it


@triton.jit
def _pixels(width, height, ox, oy, oz, r00, r01, r02, r10, r11, r12, r20, r21, r22, fx, fy, cx, cy, WIDE: tl.constexpr, HIGH: tl.constexpr):  # type: ignore[no-untyped-def]
    """This program's tile of a pinhole camera's picture: pixels, which of them there are, rays, and the cosines of their angles to the view axis."""
    lane = tl.arange(0, WIDE * HIGH)
    across = (width + WIDE - 1) // WIDE
    px = (tl.program_id(0) % across) * WIDE + lane % WIDE
    py = (tl.program_id(0) // across) * HIGH + lane // WIDE
    lx = (px.to(tl.float32) + 0.5 - cx) / fx
    ly = (py.to(tl.float32) + 0.5 - cy) / fy
    slant = 1 / tl.sqrt(lx * lx + ly * ly + 1)
    dx, dy, dz = (r00 * lx + r01 * ly + r02) * slant, (r10 * lx + r11 * ly + r12) * slant, (r20 * lx + r21 * ly + r22) * slant
    return py.to(tl.int64) * width + px, (px < width) & (py < height), ox + 0 * dx, oy + 0 * dx, oz + 0 * dx, dx, dy, dz, slant


@triton.jit
def _normal(u, v, w, lit, grid, density, nx, ny, nz, BRICK: tl.constexpr, NEAREST: tl.constexpr):  # type: ignore[no-untyped-def]
    """Down the density's gradient, by differences of one voxel to each side; zero where it is flat."""
    gx = density_at(u - 1, v, w, lit, grid, density, nx, ny, nz, BRICK, NEAREST) - density_at(u + 1, v, w, lit, grid, density, nx, ny, nz, BRICK, NEAREST)
    gy = density_at(u, v - 1, w, lit, grid, density, nx, ny, nz, BRICK, NEAREST) - density_at(u, v + 1, w, lit, grid, density, nx, ny, nz, BRICK, NEAREST)
    gz = density_at(u, v, w - 1, lit, grid, density, nx, ny, nz, BRICK, NEAREST) - density_at(u, v, w + 1, lit, grid, density, nx, ny, nz, BRICK, NEAREST)
    length = tl.sqrt(gx * gx + gy * gy + gz * gz)
    length = tl.where(length > 0, length, 1.0)
    return gx / length, gy / length, gz / length


@triton.jit
def march(  # type: ignore[no-untyped-def]
    origins, directions, looking, grid, density, index, sh, colour, opacity, depth, normal,
    rays, width, height, nx, ny, nz, units, ox, oy, oz, r00, r01, r02, r10, r11, r12, r20, r21, r22, fx, fy, cx, cy, red, green, blue,
    PINHOLE: tl.constexpr, OVER: tl.constexpr, NEAREST: tl.constexpr, BRICK: tl.constexpr, K: tl.constexpr, ROW: tl.constexpr,
    WIDE: tl.constexpr, HIGH: tl.constexpr,
):  # fmt: skip
    """PINHOLE: pixels of a camera at (ox, oy, oz), voxel coordinates, with the rotation r, camera to world; depth along the view axis, infinity
    where less than half of the light is absorbed. Else: rays of the buffers, voxel coordinates, harmonics along `looking`; depth along the ray.

    OVER composites over (red, green, blue). WIDE x HIGH pixels make a program.
    """
    BLOCK: tl.constexpr = WIDE * HIGH
    column = tl.arange(0, ROW)
    if PINHOLE:
        r, live, x0, y0, z0, dx, dy, dz, slant = _pixels(
            width, height, ox, oy, oz, r00, r01, r02, r10, r11, r12, r20, r21, r22, fx, fy, cx, cy, WIDE, HIGH
        )  # fmt: skip
        basis = harmonics_along(dx, dy, dz, column % K, K)
    else:
        r = tl.program_id(0).to(tl.int64) * BLOCK + tl.arange(0, BLOCK)
        live = r < rays
        dx, dy, dz = vectors(directions, r, live)
        x0, y0, z0 = vectors(origins, r, live)
        sx, sy, sz = vectors(looking, r, live)
        slant = tl.full((BLOCK,), 1.0, tl.float32)
        basis = harmonics_along(sx, sy, sz, column % K, K)
    ix, iy, iz, begin, end = entry(x0, y0, z0, dx, dy, dz, nx, ny, nz, BRICK)

    light = tl.full((BLOCK,), 1.0, tl.float32)
    owed = tl.zeros((BLOCK,), tl.float32)
    cr, cg, cb = tl.zeros((BLOCK,), tl.float32), tl.zeros((BLOCK,), tl.float32), tl.zeros((BLOCK,), tl.float32)
    hit = tl.full((BLOCK,), float("inf"), tl.float32)
    k = tl.zeros((BLOCK,), tl.int32)
    alive = live & goes_on(k, begin, end)
    while tl.max(alive.to(tl.int32), 0) > 0:
        t, inside, base, gx, gy, gz, k = sample(grid, k, begin, end, x0, y0, z0, dx, dy, dz, ix, iy, iz, nx, ny, nz, alive, BRICK, NEAREST)
        if tl.max(inside.to(tl.int32), 0) > 0:
            sigma = interpolated(density, base, gx, gy, gz, inside, BRICK, NEAREST)
            alpha = 1 - tl.exp(-sigma * (STEP * units))
            owed += light * alpha
            seen = inside & (owed > FAINT) & (sigma > 0)
            if tl.max(seen.to(tl.int32), 0) > 0:
                mixed, total = coefficients(index, sh, base, gx, gy, gz, seen, column, ROW, BRICK, NEAREST)
                sr, sg, sb = shade(mixed, total, basis, column // K)
                weight = tl.where(seen, owed, 0.0)
                cr += weight * sr
                cg += weight * sg
                cb += weight * sb
                owed = tl.where(seen, 0.0, owed)
            left = light * (1 - alpha)
            crossing = inside & (light > 0.5) & (left <= 0.5)
            hit = tl.where(crossing, t - 0.5 * STEP + tl.log(2 * tl.maximum(light, 0.5)) / (tl.maximum(sigma, 1e-20) * units), hit)
            light = left
        alive = alive & (light >= STOP) & goes_on(k, begin, end)

    lit = live & (light <= 0.5)
    at = tl.where(lit, hit, 0.0)
    gx, gy, gz = _normal(x0 + at * dx, y0 + at * dy, z0 + at * dz, lit, grid, density, nx, ny, nz, BRICK, NEAREST)
    if OVER:
        cr += light * red
        cg += light * green
        cb += light * blue
    tl.store(colour + r * 3, cr, live)
    tl.store(colour + r * 3 + 1, cg, live)
    tl.store(colour + r * 3 + 2, cb, live)
    tl.store(opacity + r, 1 - light, live)
    tl.store(depth + r, tl.where(lit, hit * units * slant, float("inf")), live)
    tl.store(normal + r * 3, gx, live)
    tl.store(normal + r * 3 + 1, gy, live)
    tl.store(normal + r * 3 + 2, gz, live)
