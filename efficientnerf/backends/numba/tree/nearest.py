"""Rendering of rays through trees of nearest lookup on the CPU (numba, all cores). The torch reference is `tests.efficientnerf.tree_reference`.

R rays, K harmonics.
"""

import numpy as np

from efficientnerf.asset.tree import NerfTree
from efficientnerf.backends.layout import EARLY_STOP
from efficientnerf.backends.numba.runtime import PRANGE, numba
from efficientnerf.backends.numba.tree.cells import cells_of, stored_voxel
from efficientnerf.backends.numba.tree.march import march_with
from efficientnerf.backends.numba.tree.queries import normal_at
from efficientnerf.backends.numba.vector.memory import advanced, pointer, pointers
from efficientnerf.backends.pieces import pieces
from efficientnerf.rendering.harmonics import basis_numpy

BLOCK = 64  # rays per task


@numba.njit(cache=True, error_model="numpy")
def _shade(sh, basis, terms, rgb):
    """Sigmoid of the sum of one voxel's harmonics (K, 3) into `rgb`; all are pointers."""
    for c in range(3):
        logit = 0.0
        for k in range(terms):
            logit += basis[k] * sh[3 * k + c]
        rgb[c] = 1 / (1 + np.exp(-logit))


@numba.njit(cache=True, forceinline=True, error_model="numpy")
def _composite(point, cell, t, cascade, tree, scene, state):
    """Adds a sample to the colour of a ray.

    scene  pointers to harmonics (N, 3 K), those of the direction (K,), the colour of the voxel that was shaded last, and that of the ray; and K
    state  transmittance; distance at which it falls to one half, voxels, or infinity; the voxel that was shaded last
    """
    (sh, basis, rgb, colour, terms), (u, v, w), (transmittance, half, shaded) = scene, point, state
    voxel = stored_voxel(int(u), int(v), int(w), cascade, tree)
    sigma = np.float64(tree.density[voxel]) if voxel >= 0 else 0.0
    if sigma > 0:
        scale = tree.scale[cascade]
        length = tree.step_length * scale
        alpha = 1 - np.exp(-sigma * length)
        if voxel != shaded:
            _shade(advanced(sh, 3 * terms * np.int64(voxel)), basis, terms, rgb)
            shaded = voxel
        weight = transmittance * alpha
        for c in range(3):
            colour[c] += weight * rgb[c]
        if transmittance - weight <= 0.5 < transmittance:
            step = tree.step * (length / tree.step_length)  # of the cascade, voxels of cascade 0
            half = t * scale - 0.5 * step + np.log(2 * transmittance) / (tree.density[voxel] * length) * step
        transmittance *= 1 - alpha
    return transmittance, half, shaded


_march = march_with(_composite)


@numba.njit(cache=True, parallel=PRANGE, error_model="numpy")
def _render(cells, sh, origins, directions, bases, colour, opacity, half_distance):
    rays, terms = len(origins), bases.shape[1]
    for block in numba.prange((rays + BLOCK - 1) // BLOCK):
        rgb, tree = np.empty(3), pointers(cells)
        for ray in range(block * BLOCK, min(rays, block * BLOCK + BLOCK)):
            scene = pointer(sh), advanced(pointer(bases), terms * ray), pointer(rgb), advanced(pointer(colour), 3 * ray), terms
            left, half, _ = _march(origins[ray], directions[ray], 0.0, tree, EARLY_STOP, scene, (1.0, np.inf, np.int32(-1)))
            half_distance[ray] = half
            opacity[ray] = 1 - left


def render_rays(
    tree: NerfTree, origins: np.ndarray, directions: np.ndarray, sh_directions: np.ndarray | None = None
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Colour (R, 3) premultiplied, opacity (R,), distance (R,), normal (R, 3) of rays, float32; see `backends.numba.tree.rendering.render_rays`."""
    origins, directions = np.asarray(origins, np.float64), np.ascontiguousarray(directions, np.float64)
    starts = np.ascontiguousarray((origins - tree.bounds_min) / tree.voxel)
    bases = np.ascontiguousarray(basis_numpy(np.asarray(directions if sh_directions is None else sh_directions, np.float32), tree.degree))
    colour, opacity, half_distance = np.zeros((len(starts), 3)), np.zeros(len(starts)), np.full(len(starts), np.inf)
    cells = cells_of(tree).having(tree.density_values)
    for part in pieces(len(starts)):
        given = (starts[part], directions[part], bases[part], colour[part], opacity[part], half_distance[part])
        _render(cells, tree.sh, *given)
    depth = half_distance * tree.voxel
    normal, hit = np.zeros((len(starts), 3), np.float32), np.isfinite(half_distance)
    if hit.any():
        normal[hit] = normal_at(tree, origins[hit] + depth[hit, None] * directions[hit])
    return colour.astype(np.float32), opacity.astype(np.float32), depth.astype(np.float32), normal
