"""Rendering of rays through trees of nearest lookup on the CPU (numba, all cores). The torch reference is `efficientnerf.asset.rendering.render_reference`.

R rays, K harmonics.
"""

from __future__ import annotations

import numpy as np

from efficientnerf.asset.tree import NerfTree
from efficientnerf.backends.numba.runtime import numba
from efficientnerf.backends.numba.simd import pointer
from efficientnerf.backends.numba.tree.march import EARLY_STOP
from efficientnerf.backends.numba.tree.queries import normal_at
from efficientnerf.backends.numba.tree.walk import SampleBuffer, tree_grid, walk_on, walk_pointers
from efficientnerf.backends.pieces import pieces
from efficientnerf.rendering.harmonics import basis_numpy

BLOCK = 64  # rays per task
CAPACITY = 256  # samples of a ray that are composited at once


@numba.njit(cache=True, error_model="numpy")
def _shade(sh, basis, rgb):  # type: ignore[no-untyped-def]
    """Sigmoid of the sum of one voxel's harmonics (K, 3) into `rgb`."""
    for c in range(3):
        logit = 0.0
        for k in range(len(basis)):
            logit += basis[k] * sh[k, c]
        rgb[c] = 1 / (1 + np.exp(-logit))


@numba.njit(cache=True, error_model="numpy")
def _composite(count, buffer, tree, basis, sh, rgb, colour):  # type: ignore[no-untyped-def]
    """Adds the colour of a ray's samples to `colour`; returns the distance at which the transmittance falls to one half, voxels, or infinity."""
    half, shaded = np.inf, np.int32(-1)
    for n in range(count):
        voxel, before = buffer.index[8 * n], buffer.transmittance[n]
        if voxel != shaded:
            _shade(sh[voxel], basis, rgb)
            shaded = voxel
        weight = before * buffer.alpha[n]
        for c in range(3):
            colour[c] += weight * rgb[c]
        if before - weight <= 0.5 < before:
            step = tree.step * (buffer.length[n] / tree.step_length)  # of the cascade, voxels of cascade 0
            half = buffer.distance[n] - 0.5 * step + np.log(2 * before) / (tree.density[voxel] * buffer.length[n]) * step
    return half


@numba.njit(cache=True, parallel=True, error_model="numpy")
def _render(grid, density, sh, origins, directions, bases, colour, opacity, half_distance):  # type: ignore[no-untyped-def]
    rays = len(origins)
    for block in numba.prange((rays + BLOCK - 1) // BLOCK):
        index, fraction = np.full((CAPACITY, 8), -1, np.int32), np.zeros((CAPACITY, 3), np.float32)
        alpha, transmittance, distance, length, rgb = np.empty(CAPACITY), np.empty(CAPACITY), np.empty(CAPACITY), np.empty(CAPACITY), np.empty(3)
        buffer = SampleBuffer(CAPACITY, pointer(index), pointer(fraction), pointer(alpha), pointer(transmittance), pointer(distance), pointer(length))
        tree = walk_pointers(grid, density)
        for ray in range(block * BLOCK, min(rays, block * BLOCK + BLOCK)):
            k, left = 0, 1.0
            while k >= 0:
                count, left, k = walk_on(origins[ray], directions[ray], tree, EARLY_STOP, buffer, k, left)
                half_distance[ray] = min(half_distance[ray], _composite(count, buffer, tree, bases[ray], sh, rgb, colour[ray]))
            opacity[ray] = 1 - left


def render_rays(
    tree: NerfTree, origins: np.ndarray, directions: np.ndarray, sh_directions: np.ndarray | None = None
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Colour (R, 3) premultiplied, opacity (R,), distance (R,), normal (R, 3) of rays, float32; see `backends.numba.tree.rendering.render_rays`."""
    origins, directions = np.asarray(origins, np.float64), np.ascontiguousarray(directions, np.float64)
    starts = np.ascontiguousarray((origins - tree.bounds_min) / tree.voxel)
    bases = np.ascontiguousarray(basis_numpy(np.asarray(directions if sh_directions is None else sh_directions, np.float32), tree.degree))
    colour, opacity, half_distance = np.zeros((len(starts), 3)), np.zeros(len(starts)), np.full(len(starts), np.inf)
    grid = tree_grid(tree)
    for part in pieces(len(starts)):
        given = (starts[part], directions[part], bases[part], colour[part], opacity[part], half_distance[part])
        _render(grid, tree.density_values, tree.sh, *given)
    depth = half_distance * tree.voxel
    normal, hit = np.zeros((len(starts), 3), np.float32), np.isfinite(half_distance)
    if hit.any():
        normal[hit] = normal_at(tree, origins[hit] + depth[hit, None] * directions[hit])
    return colour.astype(np.float32), opacity.astype(np.float32), depth.astype(np.float32), normal
