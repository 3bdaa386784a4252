"""Normals of faces, smoothed (numba)."""

import numpy as np

from efficientnerf.backends.numba.runtime import PRANGE, numba


@numba.njit(cache=True, parallel=PRANGE, error_model="numpy")
def smooth_face_normals(normals, areas, neighbours, sharpness, out):
    """Of each face the mean of its own normal and those next to it, by area and exp(-difference^2 / (2 sharpness^2)).

    normals     (F, 3) float64 unit
    areas       (F,) float64
    neighbours  (F, 3) int64 the face across each edge, -1: none
    out         (F, 3) float64 unit
    """
    for face in numba.prange(len(normals)):
        x, y, z = areas[face] * normals[face, 0], areas[face] * normals[face, 1], areas[face] * normals[face, 2]
        for side in range(3):
            other = neighbours[face, side]
            if other < 0:
                continue
            apart = 0.0
            for axis in range(3):
                apart += (normals[face, axis] - normals[other, axis]) ** 2
            weight = areas[other] * np.exp(-apart / (2.0 * sharpness * sharpness))
            x, y, z = x + weight * normals[other, 0], y + weight * normals[other, 1], z + weight * normals[other, 2]
        length = max(np.sqrt(x * x + y * y + z * z), 1e-300)
        out[face, 0], out[face, 1], out[face, 2] = x / length, y / length, z / length
