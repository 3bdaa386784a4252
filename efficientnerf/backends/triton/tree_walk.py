"""What every CUDA kernel (Triton) that walks along rays through a NerfTree has in common: where rays enter, which sample is the next, which voxels are
round it, and what colour these have along a direction.

Rays are sampled as `efficientnerf/asset/FORMAT.md` says, sections 6 and 9: every half voxel, nothing in empty coarse cells, and a ray in such a cell
leaps to the end of the empty cube around it. Coordinates are of voxels. What `grid` and `index` hold: `efficientnerf.backends.triton.tree`.
Offsets that grow with the tree are of 64 bits: 1536^3 cells are more than 2^31.

NEAREST: the only voxel of a sample is the one that holds it, of share 1. It stands for the corner 0, and the others are left out.
"""

from __future__ import annotations

import triton
import triton.language as tl

from efficientnerf.rendering import harmonics

STEP = tl.constexpr(0.5)  # of a voxel
STOP = tl.constexpr(1e-3)  # transmittance at which a ray ends
FACTORS = tl.constexpr((harmonics.C0, -harmonics.C1, harmonics.C1, -harmonics.C1, *harmonics.C2, *harmonics.C3, *harmonics.C4))


@triton.jit
def _harmonic(x, y, z, TERM: tl.constexpr):  # type: ignore[no-untyped-def]
    """One of `efficientnerf.rendering.harmonics`."""
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
def harmonics_along(x, y, z, term, K: tl.constexpr):  # type: ignore[no-untyped-def]
    """For rays looking along (x, y, z) (R,) and columns that belong to harmonics `term` (C,): (R, C), 0 in columns of no harmonic."""
    basis = tl.zeros_like(x)[:, None] + tl.zeros_like(term)[None, :].to(tl.float32)
    for n in tl.static_range(K):
        basis = tl.where((term == n)[None, :], _harmonic(x, y, z, n)[:, None], basis)
    return basis


@triton.jit
def sigmoid(x):  # type: ignore[no-untyped-def]
    e = tl.exp(-tl.abs(x))
    return tl.where(x >= 0, 1.0, e) / (1 + e)


@triton.jit
def _slab(o, d, high):  # type: ignore[no-untyped-def]
    """Along one axis: 1 / d, and the distances at which a ray enters and leaves 0 to `high`; never, where it runs beside it."""
    still = d == 0
    inverse = tl.where(still, 1e30, 1 / tl.where(still, 1.0, d))
    one, other = -o * inverse, (high - o) * inverse
    beside = still & ((o < 0) | (o > high))
    return inverse, tl.where(beside, 1e30, tl.minimum(one, other)), tl.where(beside, -1e30, tl.maximum(one, other))


@triton.jit
def entry(x0, y0, z0, dx, dy, dz, nx, ny, nz, BRICK: tl.constexpr):  # type: ignore[no-untyped-def]
    """1 / direction, and the distances at which rays enter the grid, not before their origins, and leave it."""
    ix, ax, bx = _slab(x0, dx, nx * BRICK)
    iy, ay, by = _slab(y0, dy, ny * BRICK)
    iz, az, bz = _slab(z0, dz, nz * BRICK)
    return ix, iy, iz, tl.maximum(tl.maximum(ax, ay), tl.maximum(az, 0.0)), tl.minimum(tl.minimum(bx, by), bz)


@triton.jit
def _cell_of(u, cells, BRICK: tl.constexpr):  # type: ignore[no-untyped-def]
    """Coarse cell of a voxel coordinate, held inside the grid."""
    return (tl.minimum(tl.maximum(u, 0.0), cells * BRICK - 0.5) / BRICK).to(tl.int32)


@triton.jit
def _owner(grid, a, b, c, ny, nz, live):  # type: ignore[no-untyped-def]
    return tl.load(grid + (a.to(tl.int64) * ny + b) * nz + c, live, other=-1)


@triton.jit
def _leap(o, d, inverse, cell, far, BRICK: tl.constexpr):  # type: ignore[no-untyped-def]
    """Distance at which a ray leaves the empty cube of `far` cells around its own, along one axis."""
    face = tl.where(d > 0, cell + far, cell - far + 1) * BRICK
    return tl.where(d == 0, 1e30, (face - o) * inverse)


@triton.jit
def _first_corner(u, cell, BRICK: tl.constexpr, NEAREST: tl.constexpr):  # type: ignore[no-untyped-def]
    """Along one axis: the lower of a point's corners within the brick of `cell`, from -1 on, and how far the point lies from it to the next."""
    if NEAREST:
        i = tl.minimum(tl.maximum(tl.floor(u) - cell * BRICK, 0.0), BRICK - 1.0)
        fraction = tl.zeros_like(u)
    else:
        x = u - cell * BRICK - 0.5
        i = tl.minimum(tl.maximum(tl.floor(x), -1.0), BRICK - 1.0)
        fraction = x - i
    return i.to(tl.int32) + 1, fraction


@triton.jit
def _in_brick(u, v, w, a, b, c, brick, BRICK: tl.constexpr, NEAREST: tl.constexpr):  # type: ignore[no-untyped-def]
    """Where the lowest of a point's corners lies in the arrays of bricks with border, and the fractions along the axes."""
    EDGE: tl.constexpr = BRICK + 2
    i, fx = _first_corner(u, a, BRICK, NEAREST)
    j, fy = _first_corner(v, b, BRICK, NEAREST)
    k, fz = _first_corner(w, c, BRICK, NEAREST)
    return brick.to(tl.int64) * (EDGE * EDGE * EDGE) + (i * EDGE + j) * EDGE + k, fx, fy, fz


@triton.jit
def sample(grid, k, begin, end, x0, y0, z0, dx, dy, dz, ix, iy, iz, nx, ny, nz, alive, BRICK: tl.constexpr, NEAREST: tl.constexpr):  # type: ignore[no-untyped-def]
    """The `k`-th sample: its distance, whether it lies in a brick, where its lowest corner is and the fractions, and which sample comes next."""
    t = begin + (k.to(tl.float32) + 0.5) * STEP
    u, v, w = x0 + t * dx, y0 + t * dy, z0 + t * dz
    a, b, c = _cell_of(u, nx, BRICK), _cell_of(v, ny, BRICK), _cell_of(w, nz, BRICK)
    cell = _owner(grid, a, b, c, ny, nz, alive)
    # An empty cell holds the negative of the cells to leap.
    far = -tl.minimum(cell, 0)
    reach = tl.minimum(_leap(x0, dx, ix, a, far, BRICK), tl.minimum(_leap(y0, dy, iy, b, far, BRICK), _leap(z0, dz, iz, c, far, BRICK)))
    landing = tl.minimum(tl.maximum(tl.ceil((tl.minimum(reach, end) - begin) / STEP - 0.5), 0.0), 1e9).to(tl.int32)
    base, fx, fy, fz = _in_brick(u, v, w, a, b, c, tl.maximum(cell, 0), BRICK, NEAREST)
    return t, alive & (cell >= 0), base, fx, fy, fz, tl.where(cell < 0, tl.maximum(k + 1, landing), k + 1)


@triton.jit
def goes_on(k, begin, end):  # type: ignore[no-untyped-def]
    """Whether sample `k` lies in the grid."""
    return begin + (k.to(tl.float32) + 0.5) * STEP < end


@triton.jit
def share(fx, fy, fz, CORNER: tl.constexpr):  # type: ignore[no-untyped-def]
    """Trilinear weight of a corner, numbered with z fastest."""
    p: tl.constexpr = CORNER // 4
    q: tl.constexpr = CORNER // 2 % 2
    s: tl.constexpr = CORNER % 2
    return (fx if p else 1 - fx) * (fy if q else 1 - fy) * (fz if s else 1 - fz)


@triton.jit
def at_corner(base, CORNER: tl.constexpr, BRICK: tl.constexpr):  # type: ignore[no-untyped-def]
    """Where a corner lies in the arrays of bricks with border."""
    EDGE: tl.constexpr = BRICK + 2
    return base + (((CORNER // 4) * EDGE + CORNER // 2 % 2) * EDGE + CORNER % 2)


@triton.jit
def density_at(u, v, w, live, grid, density, nx, ny, nz, BRICK: tl.constexpr, NEAREST: tl.constexpr):  # type: ignore[no-untyped-def]
    """Density anywhere: zero outside of the grid and in empty coarse cells."""
    inside = live & (u >= 0) & (v >= 0) & (w >= 0) & (u < nx * BRICK) & (v < ny * BRICK) & (w < nz * BRICK)
    a, b, c = _cell_of(u, nx, BRICK), _cell_of(v, ny, BRICK), _cell_of(w, nz, BRICK)
    cell = _owner(grid, a, b, c, ny, nz, inside)
    base, fx, fy, fz = _in_brick(u, v, w, a, b, c, tl.maximum(cell, 0), BRICK, NEAREST)
    return interpolated(density, base, fx, fy, fz, cell >= 0, BRICK, NEAREST)


@triton.jit
def interpolated(density, base, fx, fy, fz, live, BRICK: tl.constexpr, NEAREST: tl.constexpr):  # type: ignore[no-untyped-def]
    """Density from values laid out like the corners."""
    total = tl.zeros_like(fx)
    for corner in tl.static_range(1 if NEAREST else 8):
        total += share(fx, fy, fz, corner) * tl.load(density + at_corner(base, corner, BRICK), live, other=0.0).to(tl.float32)
    return total


@triton.jit
def coefficients(index, sh, base, fx, fy, fz, live, column, WIDTH: tl.constexpr, BRICK: tl.constexpr, NEAREST: tl.constexpr):  # type: ignore[no-untyped-def]
    """Coefficients (R, C) of samples summed over the corners that are stored, by their shares, and the sum of these shares.

    sh  rows of WIDTH coefficients; columns beyond it are zero
    """
    mixed = tl.zeros_like(fx)[:, None] + tl.zeros_like(column)[None, :].to(tl.float32)
    total = tl.zeros_like(fx)
    for corner in tl.static_range(1 if NEAREST else 8):
        voxel = tl.load(index + at_corner(base, corner, BRICK), live, other=-1)
        part = tl.where(voxel >= 0, share(fx, fy, fz, corner), 0.0)
        total += part
        row = tl.load(sh + voxel.to(tl.int64)[:, None] * WIDTH + column[None, :], (voxel >= 0)[:, None] & (column < WIDTH)[None, :], other=0.0)
        mixed += part[:, None] * row.to(tl.float32)
    return mixed, tl.maximum(total, 1e-20)


@triton.jit
def shade(mixed, total, basis, channel):  # type: ignore[no-untyped-def]
    """Red, green and blue of samples from what `coefficients` says; `channel` (C,) of each column, 0 to 2."""
    lit = mixed * basis
    red = sigmoid(tl.sum(tl.where((channel == 0)[None, :], lit, 0.0), 1) / total)
    green = sigmoid(tl.sum(tl.where((channel == 1)[None, :], lit, 0.0), 1) / total)
    blue = sigmoid(tl.sum(tl.where((channel == 2)[None, :], lit, 0.0), 1) / total)
    return red, green, blue


@triton.jit
def vectors(buffer, r, live):  # type: ignore[no-untyped-def]
    """Three components of rows `r` of a buffer (R, 3); (1, 0, 0) where there is none."""
    return tl.load(buffer + r * 3, live, other=1.0), tl.load(buffer + r * 3 + 1, live, other=0.0), tl.load(buffer + r * 3 + 2, live, other=0.0)
