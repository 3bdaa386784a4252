"""Density, normal and colour of a tree at points (numba, all cores), from the tree's own arrays."""

from collections.abc import Callable, Iterator
from dataclasses import replace

import numpy as np

from efficientnerf.asset.cascades import cascades_of, point_cascades
from efficientnerf.asset.tree import Cascade, NerfTree
from efficientnerf.backends.numba.runtime import PRANGE, numba
from efficientnerf.backends.numba.tree.cells import Cells, cascade_cells, corner_voxels
from efficientnerf.backends.numba.vector.memory import pointers
from efficientnerf.rendering.harmonics import basis_numpy

BLOCK = 1024  # points per task
STEP_BACK = 0.5  # voxels


@numba.njit(cache=True, error_model="numpy")
def _corners(u, v, w, tree, index, weight):
    """The eight stored voxels around a point, voxel coordinates, and their trilinear weights."""
    x, y, z = u - np.float32(0.5), v - np.float32(0.5), w - np.float32(0.5)
    i, j, k = int(np.floor(x)), int(np.floor(y)), int(np.floor(z))
    fx, fy, fz = x - np.float32(i), y - np.float32(j), z - np.float32(k)
    one = np.float32(1)
    corner_voxels(i, j, k, 0, tree, index)
    for n in range(8):
        weight[n] = (fx if n & 4 else one - fx) * (fy if n & 2 else one - fy) * (fz if n & 1 else one - fz)


@numba.njit(cache=True, error_model="numpy")
def _density(u, v, w, tree, index, weight):
    """Density at a point, voxel coordinates; zero in an empty coarse cell. Leaves the corners in `index` and `weight`."""
    # Compared before conversion to integers: NaN and what is too large must not become an index.
    brick = tree.brick
    nx, ny, nz = tree.shape[0], tree.shape[1], tree.shape[2]
    if not (0 <= u < nx * brick and 0 <= v < ny * brick and 0 <= w < nz * brick):
        return np.float32(0)
    if tree.brick_index[(int(u) // brick * ny + int(v) // brick) * nz + int(w) // brick] < 0:
        return np.float32(0)
    _corners(u, v, w, tree, index, weight)
    total = np.float32(0)
    for n in range(8):
        if index[n] >= 0:
            total += weight[n] * tree.density[index[n]]
    return total


@numba.njit(cache=True, error_model="numpy")
def _normal(u, v, w, tree, index, weight, out):
    """Unit normal, down the density's gradient by central differences of one voxel, into `out`; zero where the density is flat."""
    h = np.float32(1)
    gx = _density(u + h, v, w, tree, index, weight)
    gx -= _density(u - h, v, w, tree, index, weight)
    gy = _density(u, v + h, w, tree, index, weight)
    gy -= _density(u, v - h, w, tree, index, weight)
    gz = _density(u, v, w + h, tree, index, weight)
    gz -= _density(u, v, w - h, tree, index, weight)
    length = np.sqrt(gx * gx + gy * gy + gz * gz)
    if length > 0:
        out[0], out[1], out[2] = -gx / length, -gy / length, -gz / length
    else:
        out[0] = out[1] = out[2] = np.float32(0)


@numba.njit(cache=True, error_model="numpy")
def _colour(index, weight, sh, basis, out):
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


@numba.njit(cache=True, parallel=PRANGE, error_model="numpy")
def _densities(points, grid, out):
    for block in numba.prange((points.shape[0] + BLOCK - 1) // BLOCK):
        index, weight = np.empty(8, np.int32), np.empty(8, np.float32)
        tree = pointers(grid)
        for n in range(block * BLOCK, min(points.shape[0], block * BLOCK + BLOCK)):
            out[n] = _density(points[n, 0], points[n, 1], points[n, 2], tree, index, weight)


@numba.njit(cache=True, parallel=PRANGE, error_model="numpy")
def _distances_back(points, directions, optical, step, most, grid, out):
    for block in numba.prange((points.shape[0] + BLOCK - 1) // BLOCK):
        index, weight = np.empty(8, np.int32), np.empty(8, np.float32)
        tree = pointers(grid)
        for n in range(block * BLOCK, min(points.shape[0], block * BLOCK + BLOCK)):
            x, y, z = points[n, 0], points[n, 1], points[n, 2]
            after = np.float64(_density(x, y, z, tree, index, weight))
            passed, out[n] = 0.0, most * step
            for number in range(1, most + 1):
                back = np.float32(number * step)
                before = np.float64(_density(x - back * directions[n, 0], y - back * directions[n, 1], z - back * directions[n, 2], tree, index, weight))
                more = 0.5 * (before + after) * step
                if passed + more >= optical:
                    out[n] = (number - 1 + (optical - passed) / more) * step
                    break
                passed, after = passed + more, before


@numba.njit(cache=True, parallel=PRANGE, error_model="numpy")
def _normals(points, grid, out):
    for block in numba.prange((points.shape[0] + BLOCK - 1) // BLOCK):
        index, weight = np.empty(8, np.int32), np.empty(8, np.float32)
        tree = pointers(grid)
        for n in range(block * BLOCK, min(points.shape[0], block * BLOCK + BLOCK)):
            _normal(points[n, 0], points[n, 1], points[n, 2], tree, index, weight, out[n])


@numba.njit(cache=True, parallel=PRANGE, error_model="numpy")
def _colours(points, bases, grid, sh, out):
    for block in numba.prange((points.shape[0] + BLOCK - 1) // BLOCK):
        index, weight = np.empty(8, np.int32), np.empty(8, np.float32)
        tree = pointers(grid)
        for n in range(block * BLOCK, min(points.shape[0], block * BLOCK + BLOCK)):
            _corners(points[n, 0], points[n, 1], points[n, 2], tree, index, weight)
            _colour(index, weight, sh, bases[n], out[n])


def _voxel_coordinates(tree: NerfTree, cascade: Cascade, points: np.ndarray) -> np.ndarray:
    """Voxel coordinates of points of the tree's frame, float32; for nearest lookup those of voxel centres, where interpolation gives the voxel's own values."""
    at = np.ascontiguousarray((points - cascade.bounds_min) / cascade.voxel, np.float32)
    return np.floor(at) + np.float32(0.5) if tree.lookup == "nearest" else at


def _grids(tree: NerfTree, points: np.ndarray) -> Iterator[tuple[np.ndarray | slice, np.ndarray, Cells]]:
    """Which points belong to a cascade, their voxel coordinates in it, and it without its leaps, which points do not need; those beyond all boxes are of the
    first."""
    points, cascades = np.asarray(points, np.float64), cascades_of(tree)
    owner = point_cascades(tree, points).clip(0) if tree.outer else None
    for n, cascade in enumerate(cascades):
        chosen = slice(None) if owner is None else np.flatnonzero(owner == n)
        grid = cascade_cells(tree, cascade).having(tree.density_values)
        yield chosen, _voxel_coordinates(tree, cascade, points[chosen]), grid


def _by_cascade(tree: NerfTree, points: np.ndarray, out: np.ndarray, write: Callable[..., None]) -> np.ndarray:
    """`out` (N, ...), of which `write` (voxel coordinates, cascade, which points, part) writes the part of each cascade."""
    for chosen, at, grid in _grids(tree, points):
        part = np.empty((len(at), *out.shape[1:]), np.float32)
        write(at, grid, chosen, part)
        out[chosen] = part
    return out


def density_at(tree: NerfTree, points: np.ndarray) -> np.ndarray:
    """(N,) float32 at points (N, 3) of the tree's frame."""
    out = np.empty(len(points), np.float32)
    return _by_cascade(tree, points, out, lambda at, grid, _, part: _densities(at, grid, part))


def distance_back(tree: NerfTree, points: np.ndarray, directions: np.ndarray, optical_depth: float, longest: float) -> np.ndarray:
    """(N,) float32 how far back along unit directions (N, 3) from points (N, 3) of the tree's frame, of its inmost cascade, so much optical depth lies; at most
    `longest`, units of the frame, where there is less in this."""
    voxel = float(tree.voxel)
    _, at, grid = next(_grids(replace(tree, outer=()) if tree.outer else tree, points))
    out = np.empty(len(at), np.float32)
    towards, most = np.ascontiguousarray(directions, np.float32), round(longest / voxel / STEP_BACK)
    _distances_back(at, towards, optical_depth / voxel, STEP_BACK, most, grid, out)
    return out * np.float32(voxel)


def normal_at(tree: NerfTree, points: np.ndarray) -> np.ndarray:
    """(N, 3) float32 unit normals at points (N, 3) of the tree's frame, from the cascade that a point belongs to; zero where the density is flat."""
    out = np.empty((len(points), 3), np.float32)
    return _by_cascade(tree, points, out, lambda at, grid, _, part: _normals(at, grid, part))


def colour_at(tree: NerfTree, points: np.ndarray, directions: np.ndarray | None) -> np.ndarray:
    """(N, 3) float32 sRGB at points (N, 3) of the tree's frame along directions (N, 3), or the part that does not depend on the direction."""
    if directions is None:
        bases = np.zeros((len(points), tree.harmonics_count), np.float32)
        bases[:, 0] = basis_numpy(np.array([0, 0, 1], np.float32), 0)[0]
    else:
        bases = basis_numpy(np.ascontiguousarray(directions, np.float32), tree.degree)
    out = np.empty((len(points), 3), np.float32)

    def write(at: np.ndarray, grid: Cells, chosen: np.ndarray | slice, part: np.ndarray) -> None:
        _colours(at, np.ascontiguousarray(bases[chosen]), grid, tree.sh, part)

    return _by_cascade(tree, points, out, write)
