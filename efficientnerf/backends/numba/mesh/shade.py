"""Colours of what a rasterised mesh shows: from a texture, or from its vertices (numba)."""

import numpy as np

from efficientnerf.backends.numba.runtime import PRANGE, numba


@numba.njit(cache=True, error_model="numpy")
def _weights(pixels, depth, corners, u, v, weight):
    """Weights (3,) of a triangle's corners at the pixel place u, v, with perspective; returns twice its area in pixels."""
    a, b, c = corners[0], corners[1], corners[2]
    area = (pixels[b, 0] - pixels[a, 0]) * (pixels[c, 1] - pixels[a, 1]) - (pixels[c, 0] - pixels[a, 0]) * (pixels[b, 1] - pixels[a, 1])
    first = ((pixels[b, 0] - u) * (pixels[c, 1] - v) - (pixels[c, 0] - u) * (pixels[b, 1] - v)) / area
    second = ((pixels[c, 0] - u) * (pixels[a, 1] - v) - (pixels[a, 0] - u) * (pixels[c, 1] - v)) / area
    weight[0], weight[1], weight[2] = first / depth[a], second / depth[b], (1.0 - first - second) / depth[c]
    total = weight[0] + weight[1] + weight[2]
    for corner in range(3):
        weight[corner] /= total
    return abs(area)


@numba.njit(cache=True, error_model="numpy")
def _texel(texels, first, width, height, u, v, out):
    """Adds the bilinear value at u, v (v up) of a level of a texture to `out` (3,)."""
    x, y = u * width - 0.5, (1.0 - v) * height - 0.5
    x = min(x, width - 1.0) if x > 0.0 else 0.0  # also where it is no number
    y = min(y, height - 1.0) if y > 0.0 else 0.0
    left, top = np.int64(x), np.int64(y)
    right, bottom = min(left + 1, width - 1), min(top + 1, height - 1)
    across, down = x - left, y - top
    for channel in range(3):
        upper = (1.0 - across) * texels[first + top * width + left, channel] + across * texels[first + top * width + right, channel]
        lower = (1.0 - across) * texels[first + bottom * width + left, channel] + across * texels[first + bottom * width + right, channel]
        out[channel] += (1.0 - down) * upper + down * lower


@numba.njit(cache=True, inline="always", error_model="numpy")
def _add_texture(place, area, weight, texels, levels, out):
    """Adds the texture's colour at a sample to `out` (3,): `place` (3, 2) of its face's corners, `area` of the face twice, in pixels."""
    spread = (place[1, 0] - place[0, 0]) * (place[2, 1] - place[0, 1]) - (place[2, 0] - place[0, 0]) * (place[1, 1] - place[0, 1])
    ratio = abs(spread) * levels[0, 1] * levels[0, 2] / area  # texels to a sample
    level = 0
    while ratio >= 4.0 and level + 1 < len(levels):
        ratio /= 4.0
        level += 1
    u = weight[0] * place[0, 0] + weight[1] * place[1, 0] + weight[2] * place[2, 0]
    v = weight[0] * place[0, 1] + weight[1] * place[1, 1] + weight[2] * place[2, 1]
    _texel(texels, levels[level, 0], levels[level, 1], levels[level, 2], u, v, out)


@numba.njit(cache=True, parallel=PRANGE, error_model="numpy")
def shade(pixels, depth, faces, coordinates, texels, levels, colours, shown, begin, end, colour):
    """Rows `begin` to `end` of the image of a mesh: sums over the samples of each pixel, as many as are covered.

    pixels, depth  of the vertices, in samples, as `rasterise` takes them
    coordinates    (F, 3, 2) float64, v up; (0, 3, 2): the mesh has no texture but colours of its vertices
    texels         (T, 3) uint8 of all levels, row by row
    levels         (L, 3) int64: first texel, width, height of each; a level has half the sides of the one before
    colours        (V, 3) float32 of the vertices, where there is no texture, in the unit of `colour`
    shown          (H s, W s) int32 face of each sample, -1: none
    colour         (H, W, 3) float32, 0-255 of a texture, written
    """
    height, width = colour.shape[:2]
    samples = shown.shape[0] // height
    for row in numba.prange(begin, end):
        weight, out = np.empty(3), np.empty(3)
        for column in range(width):
            out[:] = 0.0
            for n in range(samples * samples):
                y, x = row * samples + n // samples, column * samples + n % samples
                face = shown[y, x]
                if face < 0:
                    continue
                area = _weights(pixels, depth, faces[face], x + 0.5, y + 0.5, weight)
                if len(coordinates) > 0:
                    _add_texture(coordinates[face], area, weight, texels, levels, out)
                    continue
                for corner in range(3):
                    for channel in range(3):
                        out[channel] += weight[corner] * colours[faces[face, corner], channel]
            for channel in range(3):
                colour[row, column, channel] = out[channel]
