"""What voxels contribute to rays at most (numba, all cores). R rays, N voxels."""

import numpy as np

from efficientnerf.backends.layout import EARLY_STOP
from efficientnerf.backends.numba.runtime import PRANGE, numba
from efficientnerf.backends.numba.tree.cells import Cells, corner_voxels, corner_weight, stored_voxel
from efficientnerf.backends.numba.tree.march import march_with
from efficientnerf.backends.numba.tree_training.scalars import cast_like
from efficientnerf.backends.numba.vector.memory import pointer, pointers


@numba.njit(cache=True, forceinline=True, error_model="numpy")
def _raise(point, cell, t, cascade, tree, scene, state):
    """Raises the voxels around a sample to its weight.

    scene  pointers to what is raised (N,), of its type `zero`, and to scratch (8,); transmittance at which the ray arrives
    state  (transmittance,)
    """
    (into, zero, index, arriving), (u, v, w), transmittance, sigma = scene, point, state[0], 0.0
    fx, fy, fz = 0.0, 0.0, 0.0
    if tree.nearest:
        for n in range(8):
            index[n] = np.int32(-1)
        voxel = stored_voxel(int(u), int(v), int(w), cascade, tree)
        index[0], sigma = voxel, np.float64(tree.density[voxel]) if voxel >= 0 else 0.0
    else:
        x, y, z = np.floor(u - 0.5), np.floor(v - 0.5), np.floor(w - 0.5)
        fx, fy, fz = u - 0.5 - x, v - 0.5 - y, w - 0.5 - z
        corner_voxels(int(x), int(y), int(z), cascade, tree, index)
        for n in range(8):
            if index[n] >= 0:
                sigma += corner_weight(n, fx, fy, fz) * tree.density[index[n]]
    if sigma > 0:
        alpha = 1 - np.exp(-sigma * (tree.step_length * tree.scale[cascade]))
        weight, gx, gy, gz = arriving * transmittance * alpha, cast_like(fx, tree.one), cast_like(fy, tree.one), cast_like(fz, tree.one)
        for n in range(8):
            voxel = index[n]
            if voxel >= 0:
                into[voxel] = max(into[voxel], cast_like(weight * corner_weight(n, gx, gy, gz), zero))
        transmittance *= 1 - alpha
    return (transmittance,)


_march = march_with(_raise)


@numba.njit(cache=True, parallel=PRANGE, error_model="numpy")
def _max_contributions(cells, origins, directions, stop, transmittance, visibility):
    """Share p of the rays raises visibility[p]: no races, and a maximum does not depend on the order."""
    shares, rays = len(visibility), len(origins)
    for share in numba.prange(shares):
        index, into, tree = np.empty(8, np.int32), visibility[share], pointers(cells)
        for ray in range(rays * share // shares, rays * (share + 1) // shares):
            scene = pointer(into), visibility.dtype.type(0), pointer(index), transmittance[ray]
            _march(origins[ray], directions[ray], 0.0, tree, stop, scene, (1.0,))


def contribution_shares() -> int:
    """Tasks that the rays of `max_contributions` are split into; each has a copy of the result."""
    return min(16, numba.get_num_threads())


def max_contributions(
    cells: Cells, origins: np.ndarray, directions: np.ndarray, density: np.ndarray, transmittance: np.ndarray, visibility: np.ndarray, *,
    stop: float = EARLY_STOP,
) -> None:  # fmt: skip
    """Raise the visibility of voxels to their greatest weight, times that of interpolation, on rays in voxel coordinates.

    origins, directions  (R, 3) float64
    density              (N,)
    transmittance        (R,) of what lies in front of the box
    visibility           (P, N) float32: for each share of the rays; P from 1 to the number of threads
    """
    _max_contributions(cells.having(density), origins, directions, float(stop), transmittance, visibility)
