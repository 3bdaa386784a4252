"""What voxels contribute to rays at most (numba, all cores). R rays, N voxels."""

from __future__ import annotations

import numpy as np

from efficientnerf.backends.layout import EARLY_STOP
from efficientnerf.backends.numba.runtime import numba
from efficientnerf.backends.numba.tree.walk import SampleBuffer, TreeGrid, corner_weight, walk, walk_pointers
from efficientnerf.backends.numba.vector.memory import pointer


@numba.njit(cache=True, parallel=True, error_model="numpy")
def _max_contributions(grid, origins, directions, density, stop, max_samples, transmittance, visibility):  # type: ignore[no-untyped-def]
    """Share p of the rays raises visibility[p]: no races, and a maximum does not depend on the order."""
    shares, rays = len(visibility), len(origins)
    for share in numba.prange(shares):
        index, fraction = np.full((max_samples, 8), -1, np.int32), np.zeros((max_samples, 3), density.dtype)
        alpha, light, distance, length = np.empty(max_samples), np.empty(max_samples), np.empty(max_samples), np.empty(max_samples)
        tree = walk_pointers(grid, density)
        buffer = SampleBuffer(max_samples, pointer(index), pointer(fraction), pointer(alpha), pointer(light), pointer(distance), pointer(length))
        into = visibility[share]
        for ray in range(rays * share // shares, rays * (share + 1) // shares):
            count, _ = walk(origins[ray], directions[ray], tree, stop, buffer)
            for m in range(count):
                weight = transmittance[ray] * light[m] * alpha[m]
                for n in range(8):
                    v = index[m, n]
                    if v >= 0:
                        into[v] = max(into[v], into.dtype.type(weight * corner_weight(n, fraction[m, 0], fraction[m, 1], fraction[m, 2])))


def contribution_shares() -> int:
    """Tasks that the rays of `max_contributions` are split into; each has a copy of the result."""
    return min(16, numba.get_num_threads())


def max_contributions(
    grid: TreeGrid, origins: np.ndarray, directions: np.ndarray, density: np.ndarray, transmittance: np.ndarray, visibility: np.ndarray, *,
    stop: float = EARLY_STOP,
) -> None:  # fmt: skip
    """Raise the visibility of voxels to their greatest weight, times that of interpolation, on rays in voxel coordinates.

    origins, directions  (R, 3) float64
    density              (N,)
    transmittance        (R,) of what lies in front of the box
    visibility           (P, N) float32: for each share of the rays; P from 1 to the number of threads
    """
    _max_contributions(grid, origins, directions, density, stop, grid.max_samples, transmittance, visibility)
