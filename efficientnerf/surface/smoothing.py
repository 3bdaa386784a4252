"""Smoothing of meshes: Taubin's, and of the faces' normals, which keeps edges. Arrays in, arrays out.

V vertices, F faces (counter-clockwise seen from outside).
"""

from collections.abc import Callable
from typing import Any

import numpy as np
from scipy.sparse import csr_matrix

from efficientnerf.backends.numba.mesh.normals import smooth_face_normals
from efficientnerf.surface.mesh import face_neighbours, face_vectors, vertex_normals

# Rounds of smoothing normals for each of smoothing, at most, and how sharp the edges are that stay: of surfaces of densities alone, of fused ones, and of
# those that were fitted to photographs. docs/experiments/surface.md
NORMALS, FUSED_NORMALS, FITTED_NORMALS = (1, 6, 0.6), (8, 80, 0.2), (4, 40, 0.2)
REACH, LEAST_ROUNDS = 0.04, 6  # of the diagonal of the surface's bounds, how far normals are smoothed at most; but so many rounds may be
FITS, DRIFT_ROUNDS = 40, 24  # of vertices to normals at most, and of averaging what all vertices of a place have in common. docs/experiments/surface.md


def smooth(vertices: np.ndarray, faces: np.ndarray, rounds: int) -> np.ndarray:
    """(V, 3) vertices after `rounds` of Taubin's smoothing: a step towards the mean of the neighbours, then a slightly longer one back.

    Waves as short as a few edges (the terraces of marching cubes) vanish; the volume stays. Taubin, "A signal processing approach to fair
    surface design", SIGGRAPH 1995, with lambda = 0.5 and a pass band of 0.1.
    """
    if rounds <= 0 or not len(faces):
        return vertices
    shrink, grow = 0.5, -1 / (1 / 0.5 - 0.1)
    neighbours, degree = vertex_neighbours(faces, len(vertices))
    for _ in range(rounds):
        for step in (shrink, grow):
            vertices = vertices + step * (neighbours @ vertices / degree - vertices)
    return vertices


def smooth_normals(vertices: np.ndarray, faces: np.ndarray, rounds: int, sharpness: float = 0.6) -> np.ndarray:
    """(V, 3) vertices after `rounds` of bilateral smoothing of the faces' normals, which keeps edges and, over a few edges, the volume.

    sharpness  difference of two unit normals beyond which faces hardly count for each other. docs/experiments/surface.md

    Each normal becomes the mean of its own and those of the three faces next to it, weighted by area and by exp(-difference^2 / (2 sharpness^2)); then vertices
    go as far along the normals around them as makes the faces fit these. The common motion of nearby vertices along their normals is taken back:
    thin parts would shrink to nothing. Zheng et al., "Bilateral normal filtering for mesh denoising", TVCG 2011; Sun et al., "Fast and effective
    feature-preserving mesh denoising", TVCG 2007.
    """
    if rounds <= 0 or not len(faces):
        return vertices
    normals = smoothed_face_normals(vertices, faces, rounds, sharpness)
    around = csr_matrix((np.ones(faces.size), (faces.ravel(), np.repeat(np.arange(len(faces)), 3))), shape=(len(vertices), len(faces)))
    count = np.maximum(np.diff(around.indptr), 1)[:, None]
    outer = np.stack([around @ (normals * normals[:, axis, None]) for axis in range(3)], 1)  # (V, 3, 3) sums of n n^T
    fitted = vertices
    for _ in range(min(rounds, FITS)):
        middle = fitted[faces].mean(1)
        target = around @ (normals * (normals * middle).sum(1, keepdims=True))
        fitted = fitted + (target - np.einsum("vij,vj->vi", outer, fitted)) / count
    outward = vertex_normals(vertices, faces)
    drift = ((fitted - vertices) * outward).sum(1, keepdims=True)
    neighbours, degree = vertex_neighbours(faces, len(vertices))
    for _ in range(DRIFT_ROUNDS):
        drift = 0.5 * drift + 0.5 * (neighbours @ drift) / degree
    return fitted - drift * outward


def rounds_of(kind: tuple[int, int, float], rounds: int, vertices: np.ndarray, faces: np.ndarray) -> tuple[int, float]:
    """Rounds and sharpness of `smooth_normals` for a kind, one of NORMALS and the others, and so many rounds of `smooth`."""
    times, most, sharpness = kind
    reach = REACH * float(np.linalg.norm(np.ptp(vertices, axis=0)))
    edge = float(np.linalg.norm(vertices[faces] - vertices[np.roll(faces, 1, axis=1)], axis=-1).mean())
    within = int(min((reach / max(edge, 1e-300)) ** 2, 1e6))  # a round spreads over an edge, n rounds over the root of n edges
    return min(times * rounds, most, max(LEAST_ROUNDS, within)), sharpness


def smoothed_face_normals(vertices: np.ndarray, faces: np.ndarray, rounds: int, sharpness: float) -> np.ndarray:
    """(F, 3) unit normals of faces after `rounds` of bilateral smoothing (`smooth_normals`)."""
    vectors, neighbours = face_vectors(vertices, faces), face_neighbours(faces, len(vertices))
    area = np.linalg.norm(vectors, axis=1)
    normals = vectors / np.maximum(area, 1e-300)[:, None]
    other = np.empty_like(normals)
    for _ in range(rounds):
        smooth_face_normals(normals, area, neighbours, sharpness, other)
        normals, other = other, normals
    return normals


def settled(
    values: np.ndarray, sums: np.ndarray, weights: np.ndarray, edges: tuple[Any, np.ndarray], stiff: float, stay: float, sweeps: int,
    tick: Callable[[], None] = lambda: None,
) -> np.ndarray:  # fmt: skip
    """(V,) values after sweeps of Jacobi's method towards what each vertex is asked for, its neighbours', and zero.

    values        (V,) to begin with
    sums, weights (V,) of what is asked for, times its weight, and the weights
    edges         of `vertex_neighbours`
    stiff, stay   weights of each neighbour's value, and of zero
    """
    neighbours, degree = edges
    for _ in range(sweeps):
        tick()
        values = (sums + stiff * (neighbours @ values)) / (weights + stiff * degree[:, 0] + stay)
    return values


def vertex_neighbours(faces: np.ndarray, count: int) -> tuple[Any, np.ndarray]:
    """Which vertices share an edge, a sparse matrix (V, V) of ones, and how many there are of each (V, 1), at least one."""
    tail, head = faces[:, [0, 1, 2]].ravel(), faces[:, [1, 2, 0]].ravel()
    rows, columns = np.concatenate([tail, head]), np.concatenate([head, tail])
    neighbours = csr_matrix((np.ones(len(rows)), (rows, columns)), shape=(count, count))
    neighbours.data[:] = 1.0  # an edge is met once per face and direction; every neighbour counts alike
    return neighbours, np.maximum(np.diff(neighbours.indptr), 1)[:, None]
