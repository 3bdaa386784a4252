"""Triangles into images: which of them a pixel shows, and at what depth (numba)."""

from __future__ import annotations

import numpy as np

from efficientnerf.backends.numba.runtime import numba


@numba.njit(cache=True, inline="always", error_model="numpy")
def _pixels_between(low, high, size):  # type: ignore[no-untyped-def]
    """First and last + 1 of the pixels whose centres lie between two coordinates, in an image; coordinates may be far outside of it."""
    first = np.int64(max(0.0, np.ceil(min(low, np.float64(size)) - 0.5)))
    last = np.int64(max(-1.0, np.floor(min(high, np.float64(size)) - 0.5)))
    return first, min(last + 1, size)


@numba.njit(cache=True, error_model="numpy")
def _triangle(x, y, inverse, number, top, bottom, width, near, shown):  # type: ignore[no-untyped-def]
    """Lays a triangle over the rows `top` <= row < `bottom` of an image: pixels x, y (3,), inverse depth (3,) of its corners."""
    area = (x[1] - x[0]) * (y[2] - y[0]) - (x[2] - x[0]) * (y[1] - y[0])
    if not abs(area) > 0.0:
        return
    first_row, last_row = _pixels_between(min(y[0], y[1], y[2]), max(y[0], y[1], y[2]), bottom)
    first, last = _pixels_between(min(x[0], x[1], x[2]), max(x[0], x[1], x[2]), width)
    for row in range(max(first_row, top), last_row):
        v = row + 0.5
        for column in range(first, last):
            u = column + 0.5
            a = ((x[1] - u) * (y[2] - v) - (x[2] - u) * (y[1] - v)) / area
            b = ((x[2] - u) * (y[0] - v) - (x[0] - u) * (y[2] - v)) / area
            c = 1.0 - a - b
            if a >= 0.0 and b >= 0.0 and c >= 0.0:
                at = np.float32(a * inverse[0] + b * inverse[1] + c * inverse[2])
                if at > near[row, column]:
                    near[row, column] = at
                    shown[row, column] = number


@numba.njit(cache=True, parallel=True, error_model="numpy")
def rasterise(pixels, depth, faces, begin, end, bands, near, shown):  # type: ignore[no-untyped-def]
    """Lays triangles `begin` to `end` over an image; of those that a pixel's centre meets the nearest stays, of equally near ones the first.

    pixels  (V, 2) float64 of the vertices; nan: not in view
    depth   (V,) float64 along the view axis; faces with a vertex at zero or behind are left out
    faces   (F, 3) int64
    bands   of rows, one to a thread at a time
    near    (H, W) float32 inverse depth of what is shown, zero at first
    shown   (H, W) int32 its face, -1 at first
    """
    height, width = near.shape
    for band in numba.prange(bands):
        top, bottom = height * band // bands, height * (band + 1) // bands
        x, y, inverse = np.empty(3), np.empty(3), np.empty(3)
        for face in range(begin, end):
            whole, low, high = True, np.inf, -np.inf
            for corner in range(3):
                vertex = faces[face, corner]
                x[corner], y[corner] = pixels[vertex, 0], pixels[vertex, 1]
                whole &= depth[vertex] > 0.0 and np.isfinite(x[corner]) and np.isfinite(y[corner])
                inverse[corner] = 1.0 / depth[vertex]
                low, high = min(low, y[corner]), max(high, y[corner])
            if whole and high >= top and low <= bottom:
                _triangle(x, y, inverse, face, top, bottom, width, near, shown)
