"""The next coarse interval of sixteen rays at once, one per SIMD lane (numba): its sample, and whether the density voxel there is valid."""

import numpy as np

from efficientnerf.backends.numba.runtime import numba
from efficientnerf.backends.numba.vector.maths import absolute, bits_of, broadcast, maximum, minimum, select, to_int32
from efficientnerf.backends.numba.vector.memory import gather, load, store

LANES = 16
# Rows of the state, (ROWS, LANES) float32: origin and direction in unit coordinates; distance along the ray, and where the ray leaves the space; offset of a
# sample in its interval; threshold of the density voxels; number of intervals visited; start of the last of them.
UX, UY, UZ, VX, VY, VZ, T, T_EXIT, OFFSET, THRESHOLD, VISITED, START, ROWS = range(13)
_NONE, _QUARTER, _HALF, _ONE, _TWO = np.float32(0), np.float32(0.25), np.float32(0.5), np.float32(1), np.float32(2)


@numba.njit(cache=True, inline="always", error_model="numpy")
def _row(state, n):
    return load(state, n * LANES, LANES)


@numba.njit(cache=True, inline="always", error_model="numpy")
def _point_at(state, t):
    """Points at distances along the rays, unit coordinates."""
    return _row(state, UX) + t * _row(state, VX), _row(state, UY) + t * _row(state, VY), _row(state, UZ) + t * _row(state, VZ)


@numba.njit(cache=True, inline="always", error_model="numpy")
def _norm(x, y, z):
    """Maximum norm, at least 1."""
    return maximum(maximum(absolute(x), absolute(y)), maximum(absolute(z), _ONE))


@numba.njit(cache=True, inline="always", error_model="numpy")
def _along(x, side):
    """Number of the voxel at a grid coordinate along an axis; 0 for NaN."""
    return to_int32(minimum(maximum(x * np.float32(side), _NONE), np.float32(side - 1)))


@numba.njit(cache=True, inline="always", error_model="numpy")
def next_intervals(state, voxels, side, step, farthest, contracted):
    """Advance each ray by one interval: bit n of the result is set where ray n had not left the space, bit LANES + n where the interval is valid.

    state, voxels  pointers to the rows above and to (side, side, side) float32
    contracted     a literal. In the box an interval is `step` long, and a ray ends at T_EXIT; in contracted space it grows beyond the box with the square of
                   the norm, and a ray ends where 1 / norm is below `farthest`, too
    """
    t, visited = _row(state, T), _row(state, VISITED)
    active, length = t < _row(state, T_EXIT), broadcast(step, LANES)
    if contracted:
        x, y, z = _point_at(state, t)
        norm = _norm(x, y, z)
        active, length = active & (norm * farthest <= _ONE), length * (norm * norm)
    x, y, z = _point_at(state, t + _row(state, OFFSET) * minimum(length, _row(state, T_EXIT) - t))
    shift, scale = _ONE, _HALF
    if contracted:
        norm = _norm(x, y, z)
        factor = (_TWO - _ONE / norm) / norm
        x, y, z = x * factor, y * factor, z * factor
        shift, scale = _TWO, _QUARTER
    i, j, k = _along((x + shift) * scale, side), _along((y + shift) * scale, side), _along((z + shift) * scale, side)
    valid = active & (gather(voxels, (i * side + j) * side + k) > _row(state, THRESHOLD))
    store(state, START * LANES, t)
    store(state, T * LANES, select(active, t + length, t))
    store(state, VISITED * LANES, select(active, visited + _ONE, visited))
    return bits_of(active) | bits_of(valid) << LANES
