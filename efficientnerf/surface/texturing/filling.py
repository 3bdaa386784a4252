"""From colours of texels to a texture: those that show no point of the surface carry the colours of the charts on, so that interpolation and smaller levels
of the texture have no seams."""

from collections.abc import Callable

import numpy as np
from scipy.sparse import csr_matrix
from scipy.spatial import cKDTree

from efficientnerf.backends.numba.mesh.charts import spread
from efficientnerf.backends.pieces import pieces
from efficientnerf.surface.mesh import Mesh
from efficientnerf.surface.texturing.atlas import Atlas

RINGS = 6  # of vertices, over which the colours that photographs show are carried on to where none shows anything. docs/experiments/textures.md
NEAREST = 8  # vertices whose mean, by the squared distance, those further away get
SEEN = 0.5  # texels' worth of photographs, from which the colour of a vertex is known
EMPTY = 128  # value of a texture without texels


def texture_from(atlas: Atlas, colours: np.ndarray) -> np.ndarray:
    """(S, S, 3) uint8 from the colours (T, 3) uint8 of an atlas's texels."""
    place, shape = atlas.texels.place, (atlas.size, atlas.size)
    if not len(place):
        return np.full((*shape, 3), EMPTY, np.uint8)
    source, distance = np.full(shape, -1, np.int32), np.full(shape, np.inf, np.float32)
    source.reshape(-1)[place] = np.arange(len(place))
    distance.reshape(-1)[place] = 0
    for step in (1, -1):
        for part in pieces(atlas.size, first=64):
            spread(part.start, part.stop, step, source, distance)
    return np.asarray(colours[source])


def carried_on(
    mesh: Mesh, atlas: Atlas, colours: np.ndarray, known: np.ndarray, expected: np.ndarray, tick: Callable[[], None] = lambda: None
) -> np.ndarray:
    """(V, 3) float32 colours of a mesh's vertices, 0-1: what photographs show round each; where they show nothing, the mean of the vertices next to it that are
    known, ring by ring; further away that of the nearest in space, as on the back of a wall. An asset has no colours of its own where no photograph looks:
    those of `mesh` stay where photographs show none of it at all.

    colours  (T, 3) uint8 of the texels
    known    (T,) share of each that is from photographs; the rest is from
    expected (T, 3) uint8
    """
    faces, count, texels = mesh.faces, len(mesh.vertices), atlas.texels
    sums, total = np.zeros((count, 3)), np.zeros(count)
    for corner in range(3):
        at, share = faces[texels.face, corner], texels.share[:, corner]
        total += np.bincount(at, share * known, minlength=count)
        for channel in range(3):
            tick()
            shown = np.where(known > 0, colours[:, channel] - (1 - known) * expected[:, channel], 0)
            sums[:, channel] += np.bincount(at, share * shown, minlength=count)
    reached = total >= SEEN
    out = np.where(reached[:, None], np.clip(sums / np.maximum(total, SEEN)[:, None] / 255, 0, 1), 0.0)
    tail, head = faces.ravel(), faces[:, [1, 2, 0]].ravel()
    beside = csr_matrix((np.ones(2 * len(tail)), (np.concatenate([tail, head]), np.concatenate([head, tail]))), shape=(count, count))
    for _ in range(RINGS):
        weight, mean = beside @ reached.astype(np.float64), beside @ out
        new = ~reached & (weight > 0)
        out[new] = mean[new] / weight[new, None]
        reached |= new
    tick()
    if not reached.any():
        return np.asarray(mesh.colours, np.float32)
    if not reached.all():
        near = min(NEAREST, int(reached.sum()))
        distance, which = cKDTree(mesh.vertices[reached]).query(mesh.vertices[~reached], k=near)
        share = 1 / np.maximum(distance.reshape(-1, near), 1e-12) ** 2
        share /= share.sum(axis=1, keepdims=True)
        out[~reached] = np.einsum("vk,vkc->vc", share, out[reached][which.reshape(-1, near)])
    return out.astype(np.float32)
