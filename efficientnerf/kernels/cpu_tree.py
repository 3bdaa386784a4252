"""Rendering and querying a NerfTree on the CPU (numba, all cores).

Every ray samples at t = t_enter + (k + 1/2) * step, step = half a voxel, whatever it skips, so that skipping empty space changes no value.
A ray in an empty coarse cell leaps to the end of the empty cube around it (`NerfTree.leap`). A ray stops when less than 1e-3 of the
light is left. The torch reference is `efficientnerf.render.render_tree_reference`.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numba
import numpy as np

from efficientnerf.harmonics import basis_numpy

if TYPE_CHECKING:
    from efficientnerf.nerftree.tree import NerfTree

STEP = 0.5  # of a voxel
STOP = 1e-3  # transmittance at which a ray ends
FAINT = 1e-4  # weight under which a sample's colour is not looked up; the next one that is looked up stands for it


@numba.njit(cache=True, inline="always", error_model="numpy")
def _corner(i, j, k, brick, brick_index, voxel_index):  # type: ignore[no-untyped-def]
    """Index of the stored voxel (i, j, k), or -1."""
    if i < 0 or j < 0 or k < 0:
        return -1
    a, b, c = i // brick, j // brick, k // brick
    if a >= brick_index.shape[0] or b >= brick_index.shape[1] or c >= brick_index.shape[2]:
        return -1
    owner = brick_index[a, b, c]
    if owner < 0:
        return -1
    return voxel_index[owner, ((i - a * brick) * brick + (j - b * brick)) * brick + (k - c * brick)]


@numba.njit(cache=True, error_model="numpy")
def _corners(u, v, w, brick, brick_index, voxel_index, index, weight):  # type: ignore[no-untyped-def]
    """The eight stored voxels round a point in voxel coordinates, and their trilinear weights."""
    x, y, z = u - np.float32(0.5), v - np.float32(0.5), w - np.float32(0.5)
    i, j, k = int(np.floor(x)), int(np.floor(y)), int(np.floor(z))
    fx, fy, fz = x - np.float32(i), y - np.float32(j), z - np.float32(k)
    one = np.float32(1)
    li, lj, lk = i % brick, j % brick, k % brick
    if i >= 0 and j >= 0 and k >= 0 and li < brick - 1 and lj < brick - 1 and lk < brick - 1:
        # All eight lie in one brick, as they do for nearly half of the points: one look at the coarse level.
        a, b, c = i // brick, j // brick, k // brick
        owner = np.int32(-1)
        if a < brick_index.shape[0] and b < brick_index.shape[1] and c < brick_index.shape[2]:
            owner = brick_index[a, b, c]
        first = (li * brick + lj) * brick + lk
        for n in range(8):
            dx, dy, dz = n >> 2, (n >> 1) & 1, n & 1
            index[n] = voxel_index[owner, first + (dx * brick + dy) * brick + dz] if owner >= 0 else -1
            weight[n] = (fx if dx else one - fx) * (fy if dy else one - fy) * (fz if dz else one - fz)
        return
    for n in range(8):
        dx, dy, dz = n >> 2, (n >> 1) & 1, n & 1
        index[n] = _corner(i + dx, j + dy, k + dz, brick, brick_index, voxel_index)
        weight[n] = (fx if dx else one - fx) * (fy if dy else one - fy) * (fz if dz else one - fz)


@numba.njit(cache=True, error_model="numpy")
def _density(u, v, w, brick, brick_index, voxel_index, density, index, weight):  # type: ignore[no-untyped-def]
    """Density at a point in voxel coordinates; zero in an empty coarse cell. Leaves the corners in `index` and `weight`."""
    # Compared before they become integers: what is no number, or too large for one, must not become an index.
    if not (0 <= u < brick_index.shape[0] * brick and 0 <= v < brick_index.shape[1] * brick and 0 <= w < brick_index.shape[2] * brick):
        return np.float32(0)
    if brick_index[int(u) // brick, int(v) // brick, int(w) // brick] < 0:
        return np.float32(0)
    _corners(u, v, w, brick, brick_index, voxel_index, index, weight)
    total = np.float32(0)
    for n in range(8):
        if index[n] >= 0:
            total += weight[n] * density[index[n]]
    return total


@numba.njit(cache=True, error_model="numpy")
def _gradient(u, v, w, brick, brick_index, voxel_index, density, index, weight, out):  # type: ignore[no-untyped-def]
    """Unit normal (down the gradient, central differences of one voxel) into `out`."""
    h = np.float32(1)
    gx = _density(u + h, v, w, brick, brick_index, voxel_index, density, index, weight)
    gx -= _density(u - h, v, w, brick, brick_index, voxel_index, density, index, weight)
    gy = _density(u, v + h, w, brick, brick_index, voxel_index, density, index, weight)
    gy -= _density(u, v - h, w, brick, brick_index, voxel_index, density, index, weight)
    gz = _density(u, v, w + h, brick, brick_index, voxel_index, density, index, weight)
    gz -= _density(u, v, w - h, brick, brick_index, voxel_index, density, index, weight)
    length = np.sqrt(gx * gx + gy * gy + gz * gz)
    if length > 0:
        out[0], out[1], out[2] = -gx / length, -gy / length, -gz / length
    else:
        out[0] = out[1] = out[2] = np.float32(0)


@numba.njit(cache=True, error_model="numpy")
def _colour(index, weight, sh, basis, out):  # type: ignore[no-untyped-def]
    """Sigmoid of the harmonics' sum, coefficients interpolated over the corners that are stored."""
    r = g = b = total = np.float32(0)
    for n in range(8):
        voxel = index[n]
        if voxel < 0:
            continue
        share = weight[n]
        total += share
        vr = vg = vb = np.float32(0)
        for k in range(basis.shape[0]):
            y = basis[k]
            vr += y * sh[voxel, k, 0]
            vg += y * sh[voxel, k, 1]
            vb += y * sh[voxel, k, 2]
        r += share * vr
        g += share * vg
        b += share * vb
    if total > 0:
        r, g, b = r / total, g / total, b / total
    one = np.float32(1)
    out[0] = one / (one + np.exp(-r))
    out[1] = one / (one + np.exp(-g))
    out[2] = one / (one + np.exp(-b))


@numba.njit(cache=True, parallel=True, error_model="numpy")
def _render(origins, directions, bases, brick, brick_index, voxel_index, density, sh, leap, step, stop, faint, units, colour, opacity, depth, normal):  # type: ignore[no-untyped-def]
    """Rays in voxel coordinates; `units` world units per voxel; densities per world unit."""
    nx, ny, nz = brick_index.shape[0] * brick, brick_index.shape[1] * brick, brick_index.shape[2] * brick
    rays = origins.shape[0]
    blocks = (rays + 255) // 256
    for block in numba.prange(blocks):
        index = np.empty(8, np.int32)
        weight = np.empty(8, np.float32)
        rgb = np.empty(3, np.float32)
        for ray in range(block * 256, min(rays, block * 256 + 256)):
            ox, oy, oz = origins[ray, 0], origins[ray, 1], origins[ray, 2]
            dx, dy, dz = directions[ray, 0], directions[ray, 1], directions[ray, 2]
            ix = 1 / dx if dx != 0 else 1e30
            iy = 1 / dy if dy != 0 else 1e30
            iz = 1 / dz if dz != 0 else 1e30
            t0 = max(min(-ox * ix, (nx - ox) * ix), min(-oy * iy, (ny - oy) * iy), min(-oz * iz, (nz - oz) * iz), 0.0)
            t1 = min(max(-ox * ix, (nx - ox) * ix), max(-oy * iy, (ny - oy) * iy), max(-oz * iz, (nz - oz) * iz))
            # A ray that runs along a face of the box and outside of it never enters.
            if (dx == 0 and (ox < 0 or ox > nx)) or (dy == 0 and (oy < 0 or oy > ny)) or (dz == 0 and (oz < 0 or oz > nz)):
                t1 = -1.0
            light = np.float32(1)
            hit = np.inf
            r = g = b = owed = np.float32(0)
            k = 0
            last = int(np.floor((t1 - t0) / step)) + 1 if t1 > t0 else 0
            while k < last:
                t = t0 + (k + 0.5) * step
                if t >= t1:
                    break
                u, v, w = ox + t * dx, oy + t * dy, oz + t * dz
                a = min(max(int(u) // brick, 0), brick_index.shape[0] - 1)
                e = min(max(int(v) // brick, 0), brick_index.shape[1] - 1)
                c = min(max(int(w) // brick, 0), brick_index.shape[2] - 1)
                far = int(leap[a, e, c])
                if far > 0:
                    # To the end of the empty cube: the nearest of its three far faces.
                    fx = ((a + far) * brick - ox) * ix if dx > 0 else ((a - far + 1) * brick - ox) * ix
                    fy = ((e + far) * brick - oy) * iy if dy > 0 else ((e - far + 1) * brick - oy) * iy
                    fz = ((c + far) * brick - oz) * iz if dz > 0 else ((c - far + 1) * brick - oz) * iz
                    if dx == 0:
                        fx = 1e30
                    if dy == 0:
                        fy = 1e30
                    if dz == 0:
                        fz = 1e30
                    k = max(k + 1, int(np.ceil((min(fx, fy, fz) - t0) / step - 0.5)))
                    continue
                sigma = _density(np.float32(u), np.float32(v), np.float32(w), brick, brick_index, voxel_index, density, index, weight)
                if sigma > 0:
                    reach = sigma * np.float32(step * units)
                    alpha = np.float32(1) - np.exp(-reach)
                    owed += light * alpha
                    if owed > faint:
                        _colour(index, weight, sh, bases[ray], rgb)
                        r += owed * rgb[0]
                        g += owed * rgb[1]
                        b += owed * rgb[2]
                        owed = np.float32(0)
                    left = light * (np.float32(1) - alpha)
                    if hit == np.inf and left <= 0.5:
                        hit = t - 0.5 * step + np.log(2 * light) / (sigma * units)
                        at = np.float32(hit)
                        _gradient(
                            np.float32(ox + at * dx), np.float32(oy + at * dy), np.float32(oz + at * dz),
                            brick, brick_index, voxel_index, density, index, weight, normal[ray],
                        )  # fmt: skip
                    light = left
                    if light < stop:
                        break
                k += 1
            colour[ray, 0], colour[ray, 1], colour[ray, 2] = r, g, b
            opacity[ray] = np.float32(1) - light
            depth[ray] = hit * units


@numba.njit(cache=True, parallel=True, error_model="numpy")
def _density_at(points, brick, brick_index, voxel_index, density, out):  # type: ignore[no-untyped-def]
    blocks = (points.shape[0] + 1023) // 1024
    for block in numba.prange(blocks):
        index = np.empty(8, np.int32)
        weight = np.empty(8, np.float32)
        for n in range(block * 1024, min(points.shape[0], block * 1024 + 1024)):
            out[n] = _density(points[n, 0], points[n, 1], points[n, 2], brick, brick_index, voxel_index, density, index, weight)


@numba.njit(cache=True, parallel=True, error_model="numpy")
def _normal_at(points, brick, brick_index, voxel_index, density, out):  # type: ignore[no-untyped-def]
    blocks = (points.shape[0] + 1023) // 1024
    for block in numba.prange(blocks):
        index = np.empty(8, np.int32)
        weight = np.empty(8, np.float32)
        for n in range(block * 1024, min(points.shape[0], block * 1024 + 1024)):
            _gradient(points[n, 0], points[n, 1], points[n, 2], brick, brick_index, voxel_index, density, index, weight, out[n])


@numba.njit(cache=True, parallel=True, error_model="numpy")
def _colour_at(points, bases, brick, brick_index, voxel_index, sh, out):  # type: ignore[no-untyped-def]
    blocks = (points.shape[0] + 1023) // 1024
    for block in numba.prange(blocks):
        index = np.empty(8, np.int32)
        weight = np.empty(8, np.float32)
        for n in range(block * 1024, min(points.shape[0], block * 1024 + 1024)):
            _corners(points[n, 0], points[n, 1], points[n, 2], brick, brick_index, voxel_index, index, weight)
            _colour(index, weight, sh, bases[n], out[n])


def _grid_points(tree: NerfTree, points: np.ndarray) -> np.ndarray:
    """World points to voxel coordinates, float32."""
    return np.ascontiguousarray((np.asarray(points, np.float64) - tree.bounds_min) / tree.voxel, np.float32)


def render_rays(tree: NerfTree, origins: np.ndarray, directions: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Colour (R, 3) premultiplied, opacity (R,), distance (R,), normal (R, 3) of rays of the world; see `Rendering`."""
    start = np.ascontiguousarray((np.asarray(origins, np.float64) - tree.bounds_min) / tree.voxel)
    along = np.ascontiguousarray(directions, np.float64)
    rays = len(start)
    bases = np.ascontiguousarray(basis_numpy(along.astype(np.float32), tree.degree))
    colour, opacity = np.empty((rays, 3), np.float32), np.empty(rays, np.float32)
    depth, normal = np.empty(rays, np.float32), np.zeros((rays, 3), np.float32)
    _render(
        start, along, bases, tree.brick, tree.brick_index, tree.voxel_index, tree.density_values, tree.sh, tree.leap,
        STEP, np.float32(STOP), np.float32(FAINT), np.float32(tree.voxel), colour, opacity, depth, normal,
    )  # fmt: skip
    return colour, opacity, depth, normal


def density_at(tree: NerfTree, points: np.ndarray) -> np.ndarray:
    out = np.empty(len(points), np.float32)
    _density_at(_grid_points(tree, points), tree.brick, tree.brick_index, tree.voxel_index, tree.density_values, out)
    return out


def normal_at(tree: NerfTree, points: np.ndarray) -> np.ndarray:
    out = np.empty((len(points), 3), np.float32)
    _normal_at(_grid_points(tree, points), tree.brick, tree.brick_index, tree.voxel_index, tree.density_values, out)
    return out


def colour_at(tree: NerfTree, points: np.ndarray, directions: np.ndarray | None) -> np.ndarray:
    if directions is None:
        bases = np.zeros((len(points), tree.harmonics_count), np.float32)
        bases[:, 0] = basis_numpy(np.array([0, 0, 1], np.float32), 0)[0]
    else:
        bases = basis_numpy(np.ascontiguousarray(directions, np.float32), tree.degree)
    out = np.empty((len(points), 3), np.float32)
    _colour_at(_grid_points(tree, points), np.ascontiguousarray(bases), tree.brick, tree.brick_index, tree.voxel_index, tree.sh, out)
    return out
