"""Colours of surface points, as seen from outside. S samples."""

import numpy as np

from efficientnerf.surface.isosurface import Progress, silent
from efficientnerf.surface.volume import Volume

CHUNK = 1 << 16  # points whose colours are looked up at a time


def surface_colours(volume: Volume, positions: np.ndarray, normals: np.ndarray, progress: Progress = silent) -> np.ndarray:
    """(N, 3) float32 sRGB of surface points, as seen from outside.

    Along the inward normal, from one voxel in front of the point to two behind it, colours are weighted as a ray would weigh them: a single
    sample on the surface mixes with the colour of empty voxels. Each is the median over the volume's view directions.
    """
    colours = np.empty((len(positions), 3), np.float32)
    steps = np.linspace(-1.0, 2.0, 7) * float(volume.tree.voxel)  # (S,)
    for start in range(0, len(positions), CHUNK):
        part = slice(start, start + CHUNK)
        progress(start, len(positions), "colours")
        point, normal = positions[part], normals[part]
        samples = point[:, None] - steps[:, None] * normal[:, None]  # (N, S, 3)
        sigma = np.asarray(volume.density(samples.reshape(-1, 3)), np.float64).reshape(-1, len(steps))
        depth = np.cumsum(sigma, 1) * (steps[1] - steps[0])
        weight = np.exp(-np.pad(depth, ((0, 0), (1, 0)))[:, :-1]) - np.exp(-depth) + 1e-12 * (sigma + 1e-9)  # (N, S)
        weight /= weight.sum(1, keepdims=True)
        best = np.argsort(-weight, 1, kind="stable")[:, :3]  # three samples carry nearly all
        share = np.take_along_axis(weight, best, 1)
        chosen = np.take_along_axis(samples, best[..., None], 1).reshape(-1, 3)
        views = []
        for direction in volume.view_directions(point, normal):
            along = np.repeat(direction, best.shape[1], 0)
            found = np.asarray(volume.colour(chosen, along), np.float64).reshape(-1, best.shape[1], 3)
            views.append((found * share[..., None]).sum(1) / share.sum(1, keepdims=True))
        colours[part] = np.clip(np.median(views, 0), 0, 1)
    progress(len(positions), len(positions), "colours")
    return colours
