"""Normals of faces, smoothed, and those of a dense mesh where lines through points of a coarser one meet it (numba)."""

import numpy as np

from efficientnerf.backends.numba.runtime import numba


@numba.njit(cache=True, error_model="numpy")
def _cells_of(vertices, faces, face, low, cell, shape):  # type: ignore[no-untyped-def]
    """Numbers of the cells that the box of a face reaches into, as a generator."""
    begin, end = np.empty(3, np.int64), np.empty(3, np.int64)
    for axis in range(3):
        a, b, c = vertices[faces[face, 0], axis], vertices[faces[face, 1], axis], vertices[faces[face, 2], axis]
        begin[axis] = min(max(np.int64(np.floor((min(a, b, c) - low[axis]) / cell)), 0), shape[axis] - 1)
        end[axis] = min(max(np.int64(np.floor((max(a, b, c) - low[axis]) / cell)), 0), shape[axis] - 1) + 1
    for i in range(begin[0], end[0]):
        for j in range(begin[1], end[1]):
            for k in range(begin[2], end[2]):
                yield (i * shape[1] + j) * shape[2] + k


@numba.njit(cache=True, error_model="numpy")
def count_in_cells(vertices, faces, begin, end, low, cell, shape, first):  # type: ignore[no-untyped-def]
    """Adds to `first` (cells + 2,) int64, two places behind each cell, how many boxes of the faces `begin` to `end` reach into it.

    vertices (V, 3) float64, faces (F, 3) int64, low (3,) corner of the grid, cell its side, shape (3,) int64
    """
    for face in range(begin, end):
        for number in _cells_of(vertices, faces, face, low, cell, shape):
            first[number + 2] += 1


@numba.njit(cache=True, error_model="numpy")
def put_in_cells(vertices, faces, begin, end, low, cell, shape, first, held):  # type: ignore[no-untyped-def]
    """Puts the faces `begin` to `end` into `held` (N,) int32, at the place that `first` has one behind their cells, which goes up."""
    for face in range(begin, end):
        for number in _cells_of(vertices, faces, face, low, cell, shape):
            held[first[number + 1]] = face
            first[number + 1] += 1


@numba.njit(cache=True, error_model="numpy")
def _met(vertices, faces, face, point, direction, weight):  # type: ignore[no-untyped-def]
    """Where along a line it meets a face, and the weights (3,) of the corners there; infinite where it does not, or from the face's back."""
    a, b, c = faces[face, 0], faces[face, 1], faces[face, 2]
    e0, e1, e2 = vertices[b, 0] - vertices[a, 0], vertices[b, 1] - vertices[a, 1], vertices[b, 2] - vertices[a, 2]
    f0, f1, f2 = vertices[c, 0] - vertices[a, 0], vertices[c, 1] - vertices[a, 1], vertices[c, 2] - vertices[a, 2]
    n0, n1, n2 = e1 * f2 - e2 * f1, e2 * f0 - e0 * f2, e0 * f1 - e1 * f0
    facing = n0 * direction[0] + n1 * direction[1] + n2 * direction[2]
    if not facing > 0.0:
        return np.inf
    s0, s1, s2 = vertices[a, 0] - point[0], vertices[a, 1] - point[1], vertices[a, 2] - point[2]
    q0, q1, q2 = s1 * direction[2] - s2 * direction[1], s2 * direction[0] - s0 * direction[2], s0 * direction[1] - s1 * direction[0]
    second, third = (q0 * f0 + q1 * f1 + q2 * f2) / facing, -(q0 * e0 + q1 * e1 + q2 * e2) / facing
    if second < -1e-5 or third < -1e-5 or second + third > 1.0 + 1e-5:
        return np.inf
    weight[0], weight[1], weight[2] = 1.0 - second - third, second, third
    return (n0 * s0 + n1 * s1 + n2 * s2) / facing


@numba.njit(cache=True, parallel=True, error_model="numpy")
def normals_met(points, directions, reach, vertices, faces, normals, low, cell, shape, first, held, out):  # type: ignore[no-untyped-def]
    """The dense mesh's normals where lines through points meet it nearest to them, within `reach` to either side, from its front.

    points, directions  (N, 3) float64, unit
    vertices, faces     of the dense mesh; normals (V, 3) at its vertices
    first, held         of `put_in_cells`: cell n holds the faces held[first[n]] to held[first[n + 1]]
    out                 (N, 3) float64 unit, zero where no line meets it
    """
    for row in numba.prange(len(points)):
        point, direction = points[row], directions[row]
        at, step, next_, each = np.empty(3, np.int64), np.empty(3, np.int64), np.empty(3), np.empty(3)
        weight = np.empty(3)
        for axis in range(3):
            begin = (point[axis] - reach * direction[axis] - low[axis]) / cell
            along = direction[axis] / cell
            at[axis] = np.int64(np.floor(begin))
            step[axis] = 1 if along > 0.0 else -1
            each[axis] = abs(1.0 / along) if along != 0.0 else np.inf
            next_[axis] = (at[axis] + 1 - begin if along > 0.0 else begin - at[axis]) * each[axis] if along != 0.0 else np.inf
        nearest = np.inf
        out[row, 0] = out[row, 1] = out[row, 2] = 0.0
        while True:
            if 0 <= at[0] < shape[0] and 0 <= at[1] < shape[1] and 0 <= at[2] < shape[2]:
                number = (at[0] * shape[1] + at[1]) * shape[2] + at[2]
                for place in range(first[number], first[number + 1]):
                    face = held[place]
                    distance = abs(_met(vertices, faces, face, point, direction, weight))
                    if distance <= reach and distance < nearest:
                        nearest = distance
                        for axis in range(3):
                            out[row, axis] = 0.0
                            for corner in range(3):
                                out[row, axis] += weight[corner] * normals[faces[face, corner], axis]
            axis = 0 if next_[0] <= next_[1] and next_[0] <= next_[2] else 1 if next_[1] <= next_[2] else 2
            if next_[axis] > 2.0 * reach:
                break
            at[axis] += step[axis]
            next_[axis] += each[axis]
        length = np.sqrt(out[row, 0] ** 2 + out[row, 1] ** 2 + out[row, 2] ** 2)
        for axis in range(3):
            out[row, axis] = out[row, axis] / length if length > 1e-6 else 0.0


@numba.njit(cache=True, parallel=True, error_model="numpy")
def smooth_face_normals(normals, areas, beside, sharpness, begin, end, out):  # type: ignore[no-untyped-def]
    """Of the faces `begin` to `end` the mean of their own normal and those beside, by area and exp(-difference^2 / (2 sharpness^2)).

    normals  (F, 3) float64 unit
    areas    (F,) float64
    beside   (F, 3) int64 the face across each edge, -1: none
    out      (F, 3) float64 unit
    """
    for face in numba.prange(begin, end):
        x, y, z = areas[face] * normals[face, 0], areas[face] * normals[face, 1], areas[face] * normals[face, 2]
        for side in range(3):
            other = beside[face, side]
            if other < 0:
                continue
            apart = 0.0
            for axis in range(3):
                apart += (normals[face, axis] - normals[other, axis]) ** 2
            weight = areas[other] * np.exp(-apart / (2.0 * sharpness * sharpness))
            x, y, z = x + weight * normals[other, 0], y + weight * normals[other, 1], z + weight * normals[other, 2]
        length = max(np.sqrt(x * x + y * y + z * z), 1e-300)
        out[face, 0], out[face, 1], out[face, 2] = x / length, y / length, z / length
