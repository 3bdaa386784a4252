"""The kernel that draws a NerfTree on CUDA (Triton): one program a block of rays, one launch a picture.

Rays are sampled as `efficientnerf/nerftree/FORMAT.md` says, section 6: every half voxel, trilinear, nothing in empty coarse cells, to the end at a
transmittance of 1/1000. A ray in an empty cell leaps to the end of the empty cube around it. What the arrays hold: `efficientnerf.kernels.cuda_tree`.

All lanes of a block stay in one loop until the last ray has ended, so the rays of a block are a small tile of the picture, and a block is one warp.
A sample's coefficients are a row of halves that neighbouring lanes read together; sums over the corners come first, the harmonics once after them.
"""

from __future__ import annotations

import triton
import triton.language as tl

from efficientnerf import harmonics

STEP = tl.constexpr(0.5)  # of a voxel
STOP = tl.constexpr(1e-3)  # transmittance at which a ray ends
FAINT = tl.constexpr(1e-4)  # weight under which a sample's colour is not looked up; the next one that is looked up stands for it
FACTORS = tl.constexpr((harmonics.C0, -harmonics.C1, harmonics.C1, -harmonics.C1, *harmonics.C2, *harmonics.C3, *harmonics.C4))


@triton.jit
def _harmonic(x, y, z, TERM: tl.constexpr):  # type: ignore[no-untyped-def]
    """One of `efficientnerf.harmonics`."""
    xx, yy, zz = x * x, y * y, z * z
    if TERM == 0:
        value = 0.0 * x + 1.0
    elif TERM == 1:
        value = y
    elif TERM == 2:
        value = z
    elif TERM == 3:
        value = x
    elif TERM == 4:
        value = x * y
    elif TERM == 5:
        value = y * z
    elif TERM == 6:
        value = 2 * zz - xx - yy
    elif TERM == 7:
        value = x * z
    elif TERM == 8:
        value = xx - yy
    elif TERM == 9:
        value = y * (3 * xx - yy)
    elif TERM == 10:
        value = x * y * z
    elif TERM == 11:
        value = y * (4 * zz - xx - yy)
    elif TERM == 12:
        value = z * (2 * zz - 3 * xx - 3 * yy)
    elif TERM == 13:
        value = x * (4 * zz - xx - yy)
    elif TERM == 14:
        value = z * (xx - yy)
    elif TERM == 15:
        value = x * (xx - 3 * yy)
    elif TERM == 16:
        value = x * y * (xx - yy)
    elif TERM == 17:
        value = y * z * (3 * xx - yy)
    elif TERM == 18:
        value = x * y * (7 * zz - 1)
    elif TERM == 19:
        value = y * z * (7 * zz - 3)
    elif TERM == 20:
        value = zz * (35 * zz - 30) + 3
    elif TERM == 21:
        value = x * z * (7 * zz - 3)
    elif TERM == 22:
        value = (xx - yy) * (7 * zz - 1)
    elif TERM == 23:
        value = x * z * (xx - 3 * yy)
    else:
        value = xx * (xx - 3 * yy) - yy * (3 * xx - yy)
    return value * FACTORS[TERM]


@triton.jit
def _sigmoid(x):  # type: ignore[no-untyped-def]
    e = tl.exp(-tl.abs(x))
    return tl.where(x >= 0, 1.0, e) / (1 + e)


@triton.jit
def _cell_of(u, cells, BRICK: tl.constexpr):  # type: ignore[no-untyped-def]
    """Coarse cell of a voxel coordinate, held inside the grid."""
    return (tl.minimum(tl.maximum(u, 0.0), cells * BRICK - 0.5) / BRICK).to(tl.int32)


@triton.jit
def _in_brick(u, v, w, a, b, c, brick, BRICK: tl.constexpr):  # type: ignore[no-untyped-def]
    """Where the lowest of a point's eight corners lies in its brick with border, and the fractions along the axes."""
    EDGE: tl.constexpr = BRICK + 2
    x, y, z = u - a * BRICK - 0.5, v - b * BRICK - 0.5, w - c * BRICK - 0.5
    i = tl.minimum(tl.maximum(tl.floor(x), -1.0), BRICK - 1.0)
    j = tl.minimum(tl.maximum(tl.floor(y), -1.0), BRICK - 1.0)
    k = tl.minimum(tl.maximum(tl.floor(z), -1.0), BRICK - 1.0)
    local = ((i.to(tl.int32) + 1) * EDGE + (j.to(tl.int32) + 1)) * EDGE + (k.to(tl.int32) + 1)
    return brick.to(tl.int64) * (EDGE * EDGE * EDGE) + local, x - i, y - j, z - k


@triton.jit
def _corner(fx, fy, fz, CORNER: tl.constexpr):  # type: ignore[no-untyped-def]
    p: tl.constexpr = CORNER // 4
    q: tl.constexpr = CORNER // 2 % 2
    s: tl.constexpr = CORNER % 2
    return (fx if p else 1 - fx) * (fy if q else 1 - fy) * (fz if s else 1 - fz)


@triton.jit
def _interpolated(density, base, fx, fy, fz, live, BRICK: tl.constexpr):  # type: ignore[no-untyped-def]
    EDGE: tl.constexpr = BRICK + 2
    total = tl.zeros_like(fx)
    for corner in tl.static_range(8):
        place = density + base + (((corner // 4) * EDGE + corner // 2 % 2) * EDGE + corner % 2)
        total += _corner(fx, fy, fz, corner) * tl.load(place, live, other=0.0).to(tl.float32)
    return total


@triton.jit
def _density_at(u, v, w, live, grid, density, nx, ny, nz, BRICK: tl.constexpr):  # type: ignore[no-untyped-def]
    """Density anywhere: zero outside of the grid and in empty coarse cells."""
    inside = live & (u >= 0) & (v >= 0) & (w >= 0) & (u < nx * BRICK) & (v < ny * BRICK) & (w < nz * BRICK)
    a, b, c = _cell_of(u, nx, BRICK), _cell_of(v, ny, BRICK), _cell_of(w, nz, BRICK)
    cell = tl.load(grid + (a * ny + b) * nz + c, inside, other=-1)
    base, fx, fy, fz = _in_brick(u, v, w, a, b, c, tl.maximum(cell, 0), BRICK)
    return _interpolated(density, base, fx, fy, fz, cell >= 0, BRICK)


@triton.jit
def _slab(o, d, high):  # type: ignore[no-untyped-def]
    """Along one axis: 1 / d, and the distances at which a ray enters and leaves 0 to `high`; never, where it runs beside it."""
    still = d == 0
    inverse = tl.where(still, 1e30, 1 / tl.where(still, 1.0, d))
    one, other = -o * inverse, (high - o) * inverse
    beside = still & ((o < 0) | (o > high))
    return inverse, tl.where(beside, 1e30, tl.minimum(one, other)), tl.where(beside, -1e30, tl.maximum(one, other))


@triton.jit
def _leap(o, d, inverse, cell, far, BRICK: tl.constexpr):  # type: ignore[no-untyped-def]
    """Distance at which a ray leaves the empty cube of `far` cells around its own, along one axis."""
    face = tl.where(d > 0, cell + far, cell - far + 1) * BRICK
    return tl.where(d == 0, 1e30, (face - o) * inverse)


@triton.jit
def march(  # type: ignore[no-untyped-def]
    origins, directions, looking, grid, density, index, sh, colour, opacity, depth, normal,
    rays, width, height, nx, ny, nz, units, ox, oy, oz, r00, r01, r02, r10, r11, r12, r20, r21, r22, fx, fy, cx, cy, red, green, blue,
    PINHOLE: tl.constexpr, OVER: tl.constexpr, BRICK: tl.constexpr, K: tl.constexpr, ROW: tl.constexpr, WIDE: tl.constexpr, HIGH: tl.constexpr,
):  # fmt: skip
    """PINHOLE: pixels of a camera at (ox, oy, oz), voxel coordinates, with the rotation r, camera to world; depth along the view axis, infinity
    where less than half of the light is absorbed. Else: rays of the buffers, voxel coordinates, harmonics along `looking`; depth along the ray.

    OVER composites over (red, green, blue). WIDE x HIGH pixels make a program.
    """
    BLOCK: tl.constexpr = WIDE * HIGH
    EDGE: tl.constexpr = BRICK + 2
    lane = tl.arange(0, BLOCK)
    if PINHOLE:
        across = (width + WIDE - 1) // WIDE
        px = (tl.program_id(0) % across) * WIDE + lane % WIDE
        py = (tl.program_id(0) // across) * HIGH + lane // WIDE
        live = (px < width) & (py < height)
        r = py * width + px
        lx = (px.to(tl.float32) + 0.5 - cx) / fx
        ly = (py.to(tl.float32) + 0.5 - cy) / fy
        slant = 1 / tl.sqrt(lx * lx + ly * ly + 1)  # cosine of the angle to the view axis
        dx, dy, dz = (r00 * lx + r01 * ly + r02) * slant, (r10 * lx + r11 * ly + r12) * slant, (r20 * lx + r21 * ly + r22) * slant
        sx, sy, sz = dx, dy, dz
        x0, y0, z0 = ox + 0 * dx, oy + 0 * dx, oz + 0 * dx
    else:
        r = tl.program_id(0) * BLOCK + lane
        live = r < rays
        dx = tl.load(directions + r * 3, live, other=1.0)
        dy = tl.load(directions + r * 3 + 1, live, other=0.0)
        dz = tl.load(directions + r * 3 + 2, live, other=0.0)
        sx = tl.load(looking + r * 3, live, other=1.0)
        sy = tl.load(looking + r * 3 + 1, live, other=0.0)
        sz = tl.load(looking + r * 3 + 2, live, other=0.0)
        x0 = tl.load(origins + r * 3, live, other=0.0)
        y0 = tl.load(origins + r * 3 + 1, live, other=0.0)
        z0 = tl.load(origins + r * 3 + 2, live, other=0.0)
        slant = tl.full((BLOCK,), 1.0, tl.float32)

    column = tl.arange(0, ROW)
    basis = tl.zeros((BLOCK, ROW), tl.float32)
    for term in tl.static_range(K):
        basis = tl.where((column % K == term)[None, :], _harmonic(sx, sy, sz, term)[:, None], basis)

    ix, ax, bx = _slab(x0, dx, nx * BRICK)
    iy, ay, by = _slab(y0, dy, ny * BRICK)
    iz, az, bz = _slab(z0, dz, nz * BRICK)
    begin = tl.maximum(tl.maximum(ax, ay), tl.maximum(az, 0.0))
    end = tl.minimum(tl.minimum(bx, by), bz)

    light = tl.full((BLOCK,), 1.0, tl.float32)
    owed = tl.zeros((BLOCK,), tl.float32)
    cr = tl.zeros((BLOCK,), tl.float32)
    cg = tl.zeros((BLOCK,), tl.float32)
    cb = tl.zeros((BLOCK,), tl.float32)
    hit = tl.full((BLOCK,), float("inf"), tl.float32)
    k = tl.zeros((BLOCK,), tl.int32)
    alive = live & (begin + 0.5 * STEP < end)
    while tl.max(alive.to(tl.int32), 0) > 0:
        t = begin + (k.to(tl.float32) + 0.5) * STEP
        u, v, w = x0 + t * dx, y0 + t * dy, z0 + t * dz
        a, b, c = _cell_of(u, nx, BRICK), _cell_of(v, ny, BRICK), _cell_of(w, nz, BRICK)
        cell = tl.load(grid + (a * ny + b) * nz + c, alive, other=-1)
        # An empty cell holds the negative of the cells to leap.
        far = -tl.minimum(cell, 0)
        reach = tl.minimum(_leap(x0, dx, ix, a, far, BRICK), tl.minimum(_leap(y0, dy, iy, b, far, BRICK), _leap(z0, dz, iz, c, far, BRICK)))
        landing = tl.minimum(tl.maximum(tl.ceil((tl.minimum(reach, end) - begin) / STEP - 0.5), 0.0), 1e9).to(tl.int32)
        inside = alive & (cell >= 0)
        if tl.max(inside.to(tl.int32), 0) > 0:
            base, gx, gy, gz = _in_brick(u, v, w, a, b, c, tl.maximum(cell, 0), BRICK)
            sigma = _interpolated(density, base, gx, gy, gz, inside, BRICK)
            alpha = 1 - tl.exp(-sigma * (STEP * units))
            owed += light * alpha
            seen = inside & (owed > FAINT) & (sigma > 0)
            if tl.max(seen.to(tl.int32), 0) > 0:
                mixed = tl.zeros((BLOCK, ROW), tl.float32)
                total = tl.zeros((BLOCK,), tl.float32)
                for corner in tl.static_range(8):
                    voxel = tl.load(index + base + (((corner // 4) * EDGE + corner // 2 % 2) * EDGE + corner % 2), seen, other=-1)
                    share = tl.where(voxel >= 0, _corner(gx, gy, gz, corner), 0.0)
                    total += share
                    row = tl.load(sh + voxel.to(tl.int64)[:, None] * ROW + column[None, :], (voxel >= 0)[:, None], other=0.0)
                    mixed += share[:, None] * row.to(tl.float32)
                mixed = mixed * basis
                total = tl.maximum(total, 1e-20)
                weight = tl.where(seen, owed, 0.0)
                cr += weight * _sigmoid(tl.sum(tl.where((column < K)[None, :], mixed, 0.0), 1) / total)
                cg += weight * _sigmoid(tl.sum(tl.where(((column >= K) & (column < 2 * K))[None, :], mixed, 0.0), 1) / total)
                cb += weight * _sigmoid(tl.sum(tl.where((column >= 2 * K)[None, :], mixed, 0.0), 1) / total)
                owed = tl.where(seen, 0.0, owed)
            left = light * (1 - alpha)
            crossing = inside & (light > 0.5) & (left <= 0.5)
            hit = tl.where(crossing, t - 0.5 * STEP + tl.log(2 * tl.maximum(light, 0.5)) / (tl.maximum(sigma, 1e-20) * units), hit)
            light = left
        k = tl.where(cell < 0, tl.maximum(k + 1, landing), k + 1)
        alive = alive & (light >= STOP) & (begin + (k.to(tl.float32) + 0.5) * STEP < end)

    lit = live & (light <= 0.5)
    at = tl.where(lit, hit, 0.0)
    u, v, w = x0 + at * dx, y0 + at * dy, z0 + at * dz
    gx = _density_at(u - 1, v, w, lit, grid, density, nx, ny, nz, BRICK) - _density_at(u + 1, v, w, lit, grid, density, nx, ny, nz, BRICK)
    gy = _density_at(u, v - 1, w, lit, grid, density, nx, ny, nz, BRICK) - _density_at(u, v + 1, w, lit, grid, density, nx, ny, nz, BRICK)
    gz = _density_at(u, v, w - 1, lit, grid, density, nx, ny, nz, BRICK) - _density_at(u, v, w + 1, lit, grid, density, nx, ny, nz, BRICK)
    length = tl.sqrt(gx * gx + gy * gy + gz * gz)
    length = tl.where(length > 0, length, 1.0)
    if OVER:
        cr += light * red
        cg += light * green
        cb += light * blue
    tl.store(colour + r * 3, cr, live)
    tl.store(colour + r * 3 + 1, cg, live)
    tl.store(colour + r * 3 + 2, cb, live)
    tl.store(opacity + r, 1 - light, live)
    tl.store(depth + r, tl.where(lit, hit * units * slant, float("inf")), live)
    tl.store(normal + r * 3, gx / length, live)
    tl.store(normal + r * 3 + 1, gy / length, live)
    tl.store(normal + r * 3 + 2, gz / length, live)
