"""Triangles into images: which of them a pixel shows, and at what depth (numba)."""

import numpy as np

from efficientnerf.backends.numba.runtime import PRANGE, numba

CHUNK = 1024  # triangles that a thread takes at a time


@numba.njit(cache=True, inline="always", error_model="numpy")
def _pixels_between(low, high, size):
    """First and last + 1 of the pixels whose centres lie between two coordinates, in an image; coordinates may be far outside of it."""
    first = np.int64(max(0.0, np.ceil(min(low, np.float64(size)) - 0.5)))
    last = np.int64(max(-1.0, np.floor(min(high, np.float64(size)) - 0.5)))
    return first, min(last + 1, size)


@numba.njit(cache=True, error_model="numpy")
def _triangle(x, y, inverse, number, top, bottom, width, near, shown):
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


@numba.njit(cache=True, parallel=PRANGE, error_model="numpy")
def row_spans(pixels, depth, faces, begin, end, height, width, rows):
    """First and last + 1 of the rows of an image in which triangles `begin` to `end` may hold a pixel's centre, to `rows` (F, 2) int32; both zero for those
    that cannot, most of those smaller than a pixel. The other arguments are those of `rasterise`."""
    for chunk in numba.prange((end - begin + CHUNK - 1) // CHUNK):
        for face in range(begin + chunk * CHUNK, min(end, begin + (chunk + 1) * CHUNK)):
            rows[face, 0] = rows[face, 1] = 0
            one, two, three = faces[face, 0], faces[face, 1], faces[face, 2]
            x, y = (pixels[one, 0], pixels[two, 0], pixels[three, 0]), (pixels[one, 1], pixels[two, 1], pixels[three, 1])
            if not (depth[one] > 0.0 and depth[two] > 0.0 and depth[three] > 0.0 and np.isfinite(x[0] + x[1] + x[2]) and np.isfinite(y[0] + y[1] + y[2])):
                continue
            left, right = _pixels_between(min(x[0], x[1], x[2]), max(x[0], x[1], x[2]), width)
            top, bottom = _pixels_between(min(y[0], y[1], y[2]), max(y[0], y[1], y[2]), height)
            if left < right and top < bottom:
                rows[face, 0], rows[face, 1] = top, bottom


@numba.njit(cache=True, parallel=PRANGE, error_model="numpy")
def rasterise(pixels, depth, faces, rows, begin, end, bands, near, shown):
    """Lays triangles `begin` to `end` over an image; of those that a pixel's centre meets the nearest stays, of equally near ones the first.

    pixels  (V, 2) float64 of the vertices; nan: not in view
    depth   (V,) float64 along the view axis; faces with a vertex at zero or behind are left out
    faces   (F, 3) int64
    rows    (F, 2) int32 of `row_spans`
    bands   of rows, one to a thread at a time
    near    (H, W) float32 inverse depth of what is shown, zero at first
    shown   (H, W) int32 its face, -1 at first
    """
    height, width = near.shape
    for band in numba.prange(bands):
        top, bottom = height * band // bands, height * (band + 1) // bands
        x, y, inverse = np.empty(3), np.empty(3), np.empty(3)
        for face in range(begin, end):
            if rows[face, 0] >= bottom or rows[face, 1] <= top:
                continue
            for corner in range(3):
                vertex = faces[face, corner]
                x[corner], y[corner], inverse[corner] = pixels[vertex, 0], pixels[vertex, 1], 1.0 / depth[vertex]
            _triangle(x, y, inverse, face, top, bottom, width, near, shown)
