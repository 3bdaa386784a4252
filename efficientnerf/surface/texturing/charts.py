"""Charts: pieces of a mesh that are nearly flat, and lie flat in a texture without lying over themselves.

Each is the projection of neighbouring faces along the mean of their normals. xatlas, which finds charts by a cost and unfolds them by least squares, takes
40 s for the 100 k faces of a mesh from an asset, where this takes one. docs/experiments/textures.md
"""

from dataclasses import dataclass

import numpy as np
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import connected_components

from efficientnerf.backends.numba.mesh.charts import best_turns, grow, overlapping
from efficientnerf.geometry.directions import across
from efficientnerf.surface.mesh import face_neighbours, face_vectors

SMOOTHING = 4  # rounds over neighbouring faces, of the normals that charts are grown by
LIMIT = float(np.cos(np.radians(50)))  # of a smoothed normal to a chart's axis
MIN_COSINE = float(np.cos(np.radians(80)))  # of a face's own normal: there a texel is stretched nearly sixfold
ROUNDS = 6  # of taking out faces that lie over their own chart
TURNS = 12  # rotations tried
SMALL = 40  # faces under which a chart joins one next to it, where it fits


@dataclass(frozen=True, eq=False)
class Charts:
    """Faces laid flat."""

    chart: np.ndarray  # (F,) int64 number of each face's chart, 0..C-1; faces of one chart are connected
    corners: np.ndarray  # (F, 3, 2) float64 in the plane of the chart, the mesh's units; each chart begins at the origin

    @property
    def count(self) -> int:
        return int(self.chart.max(initial=-1)) + 1


def charts_of(vertices: np.ndarray, faces: np.ndarray, texel: float) -> Charts:
    """The charts of a mesh.

    texel  side of a texel, about, in the mesh's units: faces of a chart nowhere lie over each other, as far as half of that resolves
    """
    neighbours, vectors = face_neighbours(faces, len(vertices)), face_vectors(vertices, faces)
    areas = np.linalg.norm(vectors, axis=1)
    normals = np.divide(vectors, areas[:, None], out=np.zeros_like(vectors), where=areas[:, None] > 0)
    smooth, order = _smoothed(normals, areas, neighbours)
    chart = np.full(len(faces), -1, np.int64)
    count = grow(order, neighbours, normals, smooth, areas, MIN_COSINE, LIMIT, 0, chart)
    chart = _joined(chart, neighbours, normals, areas)
    changed = np.arange(len(faces))  # faces of charts that are not those of the round before
    for round_ in range(ROUNDS):
        found = flattened(vertices, faces, chart)
        out = _misplaced(found, changed, normals, vectors, texel / 2)
        if not out.any():
            return found
        changed = np.flatnonzero(np.isin(found.chart, found.chart[out]))
        chart[out] = -1
        if round_ == ROUNDS - 1:
            chart[out] = chart.max(initial=-1) + 1 + np.arange(int(out.sum()))
        else:
            count = int(chart.max(initial=-1)) + 1
            count = grow(order[out[order]], neighbours, normals, smooth, areas, MIN_COSINE, LIMIT, count, chart)
        chart = _connected(chart, neighbours)
    return flattened(vertices, faces, chart)


def _smoothed(normals: np.ndarray, areas: np.ndarray, neighbours: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Normals (F, 3) smoothed over neighbours, and the faces in order of how flat their surroundings are (F,), the flattest first."""
    vectors = normals * areas[:, None]
    known = (neighbours >= 0)[..., None]
    for _ in range(SMOOTHING):
        vectors = vectors + np.where(known, vectors[neighbours], 0.0).sum(1)
        vectors /= 4.0
    sizes = areas.copy()
    for _ in range(SMOOTHING):
        sizes = (sizes + np.where(known[..., 0], sizes[neighbours], 0.0).sum(1)) / 4.0
    length = np.linalg.norm(vectors, axis=1)
    smooth = np.where(length[:, None] > 0, vectors / np.maximum(length, 1e-300)[:, None], normals)
    flatness = length / np.maximum(sizes, 1e-300)
    return smooth, np.argsort(-np.round(flatness, 3), kind="stable")


def flattened(vertices: np.ndarray, faces: np.ndarray, chart: np.ndarray) -> Charts:
    """The charts in their planes; numbers without faces are closed up."""
    used, chart = np.unique(chart, return_inverse=True)
    chart, count = chart.reshape(-1).astype(np.int64), len(used)
    vectors = face_vectors(vertices, faces)
    axes = np.stack([np.bincount(chart, vectors[:, k], minlength=count) for k in range(3)], 1)
    length = np.linalg.norm(axes, axis=1, keepdims=True)
    axes = np.where(length > 0, axes / np.where(length > 0, length, 1), [0.0, 0.0, 1.0])
    right, up = across(axes)
    at = vertices[faces]  # (F, 3, 3)
    places = np.stack([np.einsum("fci,fi->fc", at, right[chart]), np.einsum("fci,fi->fc", at, up[chart])], -1)  # (F, 3, 2)
    order = np.argsort(chart, kind="stable")
    begin = np.searchsorted(chart[order], np.arange(count + 1))
    angle = (0.5 * np.pi / TURNS * best_turns(places[order].reshape(-1, 2), 3 * begin, TURNS))[chart]
    c, s = np.cos(angle)[:, None], np.sin(angle)[:, None]
    places = np.stack([c * places[..., 0] - s * places[..., 1], s * places[..., 0] + c * places[..., 1]], -1)
    low = np.full((count, 2), np.inf)
    np.minimum.at(low, chart, places.min(1))
    return Charts(chart, places - low[chart][:, None])


def _misplaced(charts: Charts, looked_at: np.ndarray, normals: np.ndarray, vectors: np.ndarray, grid: float) -> np.ndarray:
    """(F,) bool: faces that are folded over in their chart, or lie over another one of those `looked_at` (N,), which are those of whole charts."""
    order = looked_at[np.argsort(charts.chart[looked_at], kind="stable")]
    begin = np.searchsorted(charts.chart[order], np.arange(charts.count + 1))
    edge = np.diff(charts.corners, axis=1)
    area = edge[:, 0, 0] * edge[:, 1, 1] - edge[:, 0, 1] * edge[:, 1, 0]
    alone = np.bincount(charts.chart)[charts.chart] == 1
    out = (area <= 0.25 * MIN_COSINE * np.linalg.norm(vectors, axis=1)) & ~alone & (normals != 0).any(1)
    far = np.zeros((charts.count, 2))
    np.maximum.at(far, charts.chart[order], charts.corners[order].max(1))
    marked = np.zeros(len(order), bool)
    overlapping(np.ascontiguousarray(charts.corners[order] / grid), begin, np.ceil(far / grid).astype(np.int64) + 1, marked)
    out[order[marked]] = True
    return out


def _joined(chart: np.ndarray, neighbours: np.ndarray, normals: np.ndarray, areas: np.ndarray) -> np.ndarray:
    """Small charts as part of the neighbour that they have the most edges in common with, where all their normals fit its axis."""
    for _ in range(3):
        count = int(chart.max(initial=-1)) + 1
        sizes = np.bincount(chart, minlength=count)
        axes = np.stack([np.bincount(chart, normals[:, k] * areas, minlength=count) for k in range(3)], 1)
        axes = axes / np.maximum(np.linalg.norm(axes, axis=1, keepdims=True), 1e-300)
        face, side = np.nonzero((neighbours >= 0) & (sizes[chart] < SMALL)[:, None])
        own, other = chart[face], chart[neighbours[face, side]]
        larger = (sizes[other] > sizes[own]) | ((sizes[other] == sizes[own]) & (other < own))
        own, other = own[larger], other[larger]
        if not len(own):
            break
        pairs, edges = np.unique(own * count + other, return_counts=True)
        own, other = pairs // count, pairs % count
        # How well the least fitting face of a chart fits the axis of each chart next to it.
        members = np.argsort(chart, kind="stable")
        begin = np.searchsorted(chart[members], np.arange(count + 1))
        rows = np.concatenate([np.arange(begin[a], begin[a + 1]) for a in own]) if len(own) else np.zeros(0, np.int64)
        which = np.repeat(np.arange(len(own)), sizes[own])
        fit = np.full(len(own), np.inf)
        np.minimum.at(fit, which, (normals[members[rows]] * axes[other[which]]).sum(1))
        good = fit >= MIN_COSINE
        own, other, edges = own[good], other[good], edges[good]
        if not len(own):
            break
        best = np.lexsort((other, -edges, own))
        first = best[np.unique(own[best], return_index=True)[1]]
        target = np.arange(count)
        target[own[first]] = other[first]
        # A chart that takes others in stays: no chains.
        takes = np.zeros(count, bool)
        takes[target[target != np.arange(count)]] = True
        target = np.where(takes, np.arange(count), target)
        chart = target[chart]
        chart = np.unique(chart, return_inverse=True)[1].reshape(-1).astype(np.int64)
    return chart


def _connected(chart: np.ndarray, neighbours: np.ndarray) -> np.ndarray:
    """Charts that fell apart as several."""
    face, side = np.nonzero(neighbours >= 0)
    other = neighbours[face, side]
    same = chart[face] == chart[other]
    graph = csr_matrix((np.ones(int(same.sum()), np.int8), (face[same], other[same])), shape=(len(chart),) * 2)
    return connected_components(graph, directed=False)[1].astype(np.int64)
