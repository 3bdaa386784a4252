"""How well photographs agree on where a vertex lies along its normal (numba).

V vertices, K places for photographs of each, S offsets along the normal. A patch is SIDE x SIDE points of the plane across the normal.
"""

import numpy as np

from efficientnerf.backends.numba.runtime import PRANGE, numba
from efficientnerf.backends.numba.tasks import interleaved

SIDE = 7
AREA = SIDE * SIDE


@numba.njit(cache=True, parallel=PRANGE, error_model="numpy")
def choose(vertices, centres, grades, apart, widest, out):
    """The photographs that a vertex is compared in: the one that shows it best, then one after the other that which shows it well from elsewhere.

    vertices  (V, 3) float64
    centres   (C, 3) float64 of the cameras
    grades    (C, V) float32, zero where a photograph does not show it
    apart     angle between views from which a photograph counts in full, radians; widest: to the best one, up to which it counts
    out       (V, K) int32 numbers of photographs, -1 where there are no more
    """
    count, places = len(grades), out.shape[1]
    for vertex in numba.prange(len(out)):
        away = np.empty((places, 3))
        for place in range(places):
            best, found = 0.0, -1
            for c in range(count):
                grade = np.float64(grades[c, vertex])
                if grade <= best:
                    continue
                x, y, z = centres[c, 0] - vertices[vertex, 0], centres[c, 1] - vertices[vertex, 1], centres[c, 2] - vertices[vertex, 2]
                length = np.sqrt(x * x + y * y + z * z)
                for other in range(place):
                    cosine = (x * away[other, 0] + y * away[other, 1] + z * away[other, 2]) / length
                    angle = np.arccos(min(max(cosine, -1.0), 1.0))
                    grade *= min(angle / apart, 1.0)
                    if other == 0:
                        grade *= max(1.0 - angle / widest, 0.0)
                if grade > best:
                    best, found = grade, c
            out[vertex, place] = found
            if found < 0:
                break
            for axis in range(3):
                away[place, axis] = centres[found, axis] - vertices[vertex, axis]
            length = np.sqrt(away[place, 0] ** 2 + away[place, 1] ** 2 + away[place, 2] ** 2)
            for axis in range(3):
                away[place, axis] /= length


@numba.njit(cache=True, inline="always", error_model="numpy")
def _patch(pixels, start, width, height, x, y, along, across, size, out, row):
    """Samples of a patch with zero mean and unit length into `out`[row]; its standard deviation, negative where it leaves the photograph."""
    half = SIDE // 2
    reach_x = half * size * (abs(along[0]) + abs(across[0])) + np.float32(1.0)
    reach_y = half * size * (abs(along[1]) + abs(across[1])) + np.float32(1.0)
    if not (x - reach_x >= 0.0 and y - reach_y >= 0.0 and x + reach_x < width - 1.0 and y + reach_y < height - 1.0):
        return np.float32(-1.0)
    total, squares, n = np.float32(0.0), np.float32(0.0), 0
    for b in range(-half, half + 1):
        for a in range(-half, half + 1):
            u = x + size * (a * along[0] + b * across[0])
            v = y + size * (a * along[1] + b * across[1])
            i, j = int(v), int(u)
            s, t = np.float32(u - j), np.float32(v - i)
            at = start + i * width + j
            upper = np.float32(pixels[at]) * (1 - s) + np.float32(pixels[at + 1]) * s
            lower = np.float32(pixels[at + width]) * (1 - s) + np.float32(pixels[at + width + 1]) * s
            value = upper * (1 - t) + lower * t
            out[row, n] = value
            total += value
            squares += value * value
            n += 1
    mean = total / AREA
    spread = max(squares - total * mean, np.float32(0.0))
    scale = np.float32(1.0) / np.sqrt(spread + np.float32(1e-6))
    for n in range(AREA):
        out[row, n] = (out[row, n] - mean) * scale
    return np.sqrt(spread / AREA)


@numba.njit(cache=True, parallel=PRANGE, error_model="numpy")
def agreement(begin, end, chosen, places, size, step, pixels, starts, shapes, noise, score, texture):
    """How well the photographs of each of the vertices `begin` to `end` agree at offsets along its normal.

    chosen   (V, K) int32 numbers of photographs, of `choose`
    places   (V, K, 8) float32 in each: column and row of the vertex (centres of pixels are whole numbers), and their change with a unit along the normal, and
             along two axes across it
    size     (V,) float32 side of a pixel of the first photograph at the vertex, units
    step     (V,) float32 units between offsets
    pixels   (P,) uint8 grey values of all photographs; starts (C,) int64, shapes (C, 2) int64 height and width
    noise    standard deviation of a patch, 0-255, up to which it shows nothing
    score    (V, S) float32 mean of the better half of normalised cross-correlations with the first photograph; zero where fewer than two others show it
    texture  (V,) float32 standard deviation of the patch in the first photograph
    """
    offsets, count = score.shape[1], chosen.shape[1]
    for task in numba.prange(end - begin):
        vertex = begin + interleaved(task, end - begin)
        patches = np.empty((2, AREA), np.float32)
        found = np.empty(count, np.float32)
        texture[vertex] = 0.0
        if chosen[vertex, min(2, count - 1)] < 0:
            for s in range(offsets):
                score[vertex, s] = 0.0
            continue
        for s in range(offsets):
            offset = np.float32(s - offsets // 2) * step[vertex]
            n = 0
            for place in range(count):
                k = chosen[vertex, place]
                if k < 0:
                    break
                p = places[vertex, place]
                spread = _patch(
                    pixels, starts[k], shapes[k, 1], shapes[k, 0], p[0] + offset * p[2], p[1] + offset * p[3], p[4:6], p[6:8], size[vertex], patches,
                    min(place, 1),
                )  # fmt: skip
                if place == 0:
                    if spread < 0.0:
                        break
                    if s == offsets // 2:
                        texture[vertex] = spread
                    continue
                if spread < noise:
                    continue
                total = np.float32(0.0)
                for i in range(AREA):
                    total += patches[0, i] * patches[1, i]
                found[n] = total
                n += 1
            if n < 2:
                score[vertex, s] = 0.0
                continue
            ordered = np.sort(found[:n])
            kept = max(2, (n + 1) // 2)
            total = np.float32(0.0)
            for i in range(n - kept, n):
                total += ordered[i]
            score[vertex, s] = total / kept
