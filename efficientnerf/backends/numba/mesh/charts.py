"""Charts of a mesh: growing them over neighbouring faces, finding where a flat chart lies over itself, and packing charts into a square (numba)."""

import numpy as np

from efficientnerf.backends.numba.runtime import PRANGE, numba
from efficientnerf.backends.numba.tasks import interleaved

INSIDE = 1e-3  # barycentric coordinate from which a sample is inside a face, not on an edge that two faces share


@numba.njit(cache=True, error_model="numpy")
def grow(order, beside, normals, smooth, areas, least, limit, first, charts):
    """Grows charts from seeds over neighbouring faces, the nearest faces first.

    order    (N,) int64 faces that may be seeds, in this order; those that have a chart are passed by
    beside   (F, 3) int64 the face across each edge, -1: none
    normals  (F, 3) float64 unit, of the faces; zero where a face has no area
    smooth   (F, 3) float64 unit, smoothed
    areas    (F,) float64
    least    cosine of a face's normal to the axis of its chart, at least
    limit    cosine of its smoothed normal
    first    number of the first chart
    charts   (F,) int64 the chart of each face: -1 where it has none, others are left alone
    returns  one more than the last chart's number

    A chart's axis is the mean, by area, of the smoothed normals of its faces so far.
    """
    queue = np.empty(len(charts), np.int64)
    number = first
    for seed in order:
        if charts[seed] >= 0:
            continue
        charts[seed] = number
        queue[0] = seed
        begin, end = 0, 1
        axis = smooth[seed].copy()
        total = axis * areas[seed]
        while begin < end:
            face = queue[begin]
            begin += 1
            for side in range(3):
                other = beside[face, side]
                if other < 0 or charts[other] != -1:
                    continue
                along = normals[other, 0] * axis[0] + normals[other, 1] * axis[1] + normals[other, 2] * axis[2]
                near = smooth[other, 0] * axis[0] + smooth[other, 1] * axis[1] + smooth[other, 2] * axis[2]
                if along < least or near < limit:
                    continue
                charts[other] = number
                queue[end] = other
                end += 1
                total += smooth[other] * areas[other]
                length = np.sqrt(total[0] * total[0] + total[1] * total[1] + total[2] * total[2])
                if length > 0.0:
                    axis = total / length
        number += 1
    return number


@numba.njit(cache=True, error_model="numpy")
def best_turns(places, begin, turns):
    """(C,) of `turns` rotations of a quarter circle that one in which each chart's box is smallest.

    places  (N, 2) float64 of the charts' corners, chart after chart
    begin   (C + 1,) int64 first row of each chart
    """
    out = np.zeros(len(begin) - 1, np.int64)
    for chart in range(len(begin) - 1):
        smallest = np.inf
        for turn in range(turns):
            angle = 0.5 * np.pi * turn / turns
            c, s = np.cos(angle), np.sin(angle)
            left, right, low, high = np.inf, -np.inf, np.inf, -np.inf
            for row in range(begin[chart], begin[chart + 1]):
                x, y = c * places[row, 0] - s * places[row, 1], s * places[row, 0] + c * places[row, 1]
                left, right, low, high = min(left, x), max(right, x), min(low, y), max(high, y)
            area = (right - left) * (high - low)
            if area < smallest * (1.0 - 1e-9):
                smallest = area
                out[chart] = turn
    return out


@numba.njit(cache=True, parallel=PRANGE, error_model="numpy")
def overlapping(corners, begin, sizes, out):
    """Marks faces of charts that lie over a face before them in the same chart, at the centres of a grid of unit squares.

    corners  (N, 3, 2) float64 of the faces, chart after chart; each chart's lie within its size
    begin    (C + 1,) int64 first row of each chart
    sizes    (C, 2) int64 width and height of each chart
    out      (N,) bool
    """
    charts = len(begin) - 1
    for task in numba.prange(charts):
        chart = interleaved(task, charts)
        width, height = sizes[chart]
        taken = np.zeros((height, width), np.bool_)
        for row in range(begin[chart], begin[chart + 1]):
            x, y = corners[row, :, 0], corners[row, :, 1]
            area = (x[1] - x[0]) * (y[2] - y[0]) - (x[2] - x[0]) * (y[1] - y[0])
            if not area > 0.0:
                continue
            left, right = max(0, int(np.floor(x.min() - 0.5))), min(width, int(np.ceil(x.max())) + 1)
            low, high = max(0, int(np.floor(y.min() - 0.5))), min(height, int(np.ceil(y.max())) + 1)
            least = INSIDE * area
            for again in range(2):
                for v in range(low, high):
                    for u in range(left, right):
                        a = (x[1] - u - 0.5) * (y[2] - v - 0.5) - (x[2] - u - 0.5) * (y[1] - v - 0.5)
                        b = (x[2] - u - 0.5) * (y[0] - v - 0.5) - (x[0] - u - 0.5) * (y[2] - v - 0.5)
                        if a > least and b > least and area - a - b > least:
                            if again:
                                taken[v, u] = True
                            elif taken[v, u]:
                                out[row] = True
                if out[row]:
                    break


@numba.njit(cache=True, error_model="numpy")
def profiles(corners, begin, first, gap, bottom, top):
    """Lower and upper ends of charts over columns of texels, with a gap around them.

    corners      (N, 3, 2) float64 texels, of the faces chart after chart, from (gap, gap) on
    begin        (C + 1,) int64 first row of each chart
    first        (C + 1,) int64 first of each chart's columns in `bottom` and `top`
    bottom, top  (M,) int64, of which the first is filled with what is beyond any, the second with zero
    """
    for chart in range(len(begin) - 1):
        columns = first[chart + 1] - first[chart]
        for row in range(begin[chart], begin[chart + 1]):
            x, y = corners[row, :, 0], corners[row, :, 1]
            low, high = int(np.floor(y.min())) - gap, int(np.ceil(y.max())) + gap
            for column in range(max(0, int(np.floor(x.min())) - gap), min(columns, int(np.ceil(x.max())) + gap)):
                at = first[chart] + column
                bottom[at], top[at] = min(bottom[at], low), max(top[at], high)


@numba.njit(cache=True, error_model="numpy")
def pack(order, first, bottom, top, step, horizon, places):
    """Puts charts into a square from below, each where its upper end is lowest; True if all fit.

    order        (N,) int64 in which they are placed
    first, bottom, top  of `profiles`; a column that no face reaches has bottom > top
    step         texels between places that are tried
    horizon      (S,) int64 how high each column of the square is filled
    places       (C, 2) int64 left and lower corner of each

    Levy et al., "Least squares conformal maps for automatic texture atlas generation", SIGGRAPH 2002, section 4.
    """
    size = len(horizon)
    for chart in order:
        begin, columns = first[chart], first[chart + 1] - first[chart]
        height = 0
        for column in range(columns):
            height = max(height, top[begin + column])
        best, left = np.int64(size - height) + 1, np.int64(-1)
        for x in range(0, size - columns + 1, step):
            low = np.int64(0)
            for column in range(columns):
                if bottom[begin + column] <= top[begin + column]:
                    low = max(low, horizon[x + column] - bottom[begin + column])
                    if low >= best:
                        break
            if low < best:
                best, left = low, np.int64(x)
        if left < 0:
            return False
        places[chart, 0], places[chart, 1] = left, best
        for column in range(columns):
            if bottom[begin + column] <= top[begin + column]:
                horizon[left + column] = best + top[begin + column]
    return True


@numba.njit(cache=True, error_model="numpy")
def lay_faces(corners, begin, end, owner):
    """Which of the faces `begin` to `end` each texel's centre lies in, the first of several.

    corners  (F, 3, 2) float64 texels, y down, counter-clockwise or not
    owner    (S, S) int32, -1 at first
    """
    size = len(owner)
    for face in range(begin, end):
        x, y = corners[face, :, 0], corners[face, :, 1]
        area = (x[1] - x[0]) * (y[2] - y[0]) - (x[2] - x[0]) * (y[1] - y[0])
        if not abs(area) > 0.0:
            continue
        for v in range(max(0, int(np.floor(y.min() - 0.5))), min(size, int(np.ceil(y.max())) + 1)):
            for u in range(max(0, int(np.floor(x.min() - 0.5))), min(size, int(np.ceil(x.max())) + 1)):
                if owner[v, u] >= 0:
                    continue
                a = ((x[1] - u - 0.5) * (y[2] - v - 0.5) - (x[2] - u - 0.5) * (y[1] - v - 0.5)) / area
                b = ((x[2] - u - 0.5) * (y[0] - v - 0.5) - (x[0] - u - 0.5) * (y[2] - v - 0.5)) / area
                if a >= 0.0 and b >= 0.0 and 1.0 - a - b >= 0.0:
                    owner[v, u] = face


@numba.njit(cache=True, error_model="numpy")
def spread(begin, end, step, source, distance):
    """Carries the nearest source on over rows `begin` to `end`, in the direction of `step`: downwards and to the right (1), or back (-1).

    source    (S, S) int32 a texel that each texel is to be like, -1 where there is none yet
    distance  (S, S) float32 from it, infinite where there is none; chamfer distance with steps of 1 and 1.4
    """
    size = len(source)
    for at in range(begin, end):
        row = at if step > 0 else size - 1 - at
        above = row - step
        for along in range(size):
            column = along if step > 0 else size - 1 - along
            found, least = source[row, column], distance[row, column]
            before, after = column - step, column + step
            if 0 <= before < size and distance[row, before] + np.float32(1.0) < least:
                found, least = source[row, before], distance[row, before] + np.float32(1.0)
            if 0 <= above < size:
                if distance[above, column] + np.float32(1.0) < least:
                    found, least = source[above, column], distance[above, column] + np.float32(1.0)
                if 0 <= before < size and distance[above, before] + np.float32(1.4) < least:
                    found, least = source[above, before], distance[above, before] + np.float32(1.4)
                if 0 <= after < size and distance[above, after] + np.float32(1.4) < least:
                    found, least = source[above, after], distance[above, after] + np.float32(1.4)
            source[row, column], distance[row, column] = found, least
