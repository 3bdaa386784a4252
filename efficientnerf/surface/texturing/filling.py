"""From colours of texels to a texture: those that show no point of the surface carry the colours of the charts on, so that interpolation and smaller levels
of the texture have no seams."""

from __future__ import annotations

import numpy as np

from efficientnerf.backends.pieces import pieces
from efficientnerf.surface.texturing.atlas import Atlas

EMPTY = 128  # what a texture holds that has no texel at all


def texture_from(atlas: Atlas, colours: np.ndarray) -> np.ndarray:
    """(S, S, 3) uint8 from the colours (T, 3) uint8 of an atlas's texels."""
    from efficientnerf.backends.numba.mesh.charts import spread

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
