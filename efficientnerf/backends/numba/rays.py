"""Directions of pixels' rays on the CPU (numba, all cores)."""

from __future__ import annotations

import numpy as np

from efficientnerf.backends.numba.runtime import numba


@numba.njit(cache=True, parallel=True, error_model="numpy")
def ray_directions(lookup, begin, knots, stride, pixel, width, rotation, view, out):  # type: ignore[no-untyped-def]
    """World directions of pixels of several views into out (N, 3): rotation[view] of a direction interpolated in the view's lens table.

    lookup               (., 3) camera-frame directions at knots `stride` pixels apart, the tables of all lenses end to end
    begin, knots, width  of each view: start of its table, knots per row, and pixels per row
    pixel, view          (N,) row-major pixel and its view
    rotation             (V, 3, 3) world from camera
    """
    one = np.float32(1)
    for n in numba.prange(len(view)):
        v = view[n]
        row, column = pixel[n] // width[v], pixel[n] % width[v]
        at = begin[v] + row // stride * knots[v] + column // stride
        x, y, z = lookup[at, 0], lookup[at, 1], lookup[at, 2]
        if stride > 1:
            f, g = np.float32(column % stride) / np.float32(stride), np.float32(row % stride) / np.float32(stride)
            right, below = at + (1 if f > 0 else 0), knots[v] if g > 0 else 0
            a, b, c, d = (one - g) * (one - f), (one - g) * f, g * (one - f), g * f
            x = a * x + b * lookup[right, 0] + c * lookup[at + below, 0] + d * lookup[right + below, 0]
            y = a * y + b * lookup[right, 1] + c * lookup[at + below, 1] + d * lookup[right + below, 1]
            z = a * z + b * lookup[right, 2] + c * lookup[at + below, 2] + d * lookup[right + below, 2]
            length = np.sqrt(x * x + y * y + z * z)
            x, y, z = x / length, y / length, z / length
        for axis in range(3):
            out[n, axis] = rotation[v, axis, 0] * x + rotation[v, axis, 1] * y + rotation[v, axis, 2] * z
