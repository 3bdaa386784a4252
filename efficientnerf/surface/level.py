"""The density at which a surface has the silhouettes of its asset. docs/experiments/surface.md

`isosurface` draws where the opacity f = 1 - 2^(-sigma / level), interpolated between voxels, is one half. A ray meets that where the highest f along it is
more. So the pixels that a surface would cover are known without making it.

R rays, S samples, L levels.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace

import numpy as np
import torch
from scipy.ndimage import binary_dilation

from efficientnerf.asset.rendering import ray_parts
from efficientnerf.asset.tree import NerfTree
from efficientnerf.backends.numba.tree.queries import density_at
from efficientnerf.geometry.cameras import rays
from efficientnerf.surface.agreement import OPAQUE, AssetView
from efficientnerf.surface.volume import volume_of

LEVELS = 2.0 ** (-np.arange(9) / 2)  # of the highest level
EDGE = 2  # pixels on either side of the silhouettes' edges that are looked at
RAYS = 800  # of a view, at most
SAMPLES_AT_ONCE = 2**20


def silhouette_level(tree: NerfTree, views: Sequence[AssetView], highest: float, tick: Callable[[], None]) -> float:
    """The level, at most `highest`, at which the fewest pixels near the edges of the silhouettes are missed or added; of equally good ones the highest.
    `highest` where the views show no edge.

    tree  of one grid
    tick  called before each view; an exception from it stops the work
    """
    found = []
    for view in views:
        tick()
        opaque, pixels = _near_edges(view)
        found.append((opaque, *rays(view.camera, pixels)))
    if not found:
        return highest
    opaque, origins, directions = (np.concatenate(parts) for parts in zip(*found, strict=True))
    wrong = (surfaces_met(tree, origins, directions, highest * LEVELS) != opaque[:, None]).sum(0)
    return float(highest * LEVELS[np.argmin(wrong)])


def _near_edges(view: AssetView) -> tuple[np.ndarray, np.ndarray]:
    """Pixels near the edges of a view's silhouette: whether they are opaque (R,), and their centres (R, 2)."""
    opaque = view.opacity >= OPAQUE
    near = binary_dilation(opaque, iterations=EDGE) & binary_dilation(~opaque, iterations=EDGE)
    row, column = np.nonzero(near)
    chosen = np.unique(np.linspace(0, len(row) - 1, min(RAYS, len(row))).round().astype(np.int64)) if len(row) else np.zeros(0, np.int64)
    return opaque[row[chosen], column[chosen]], np.stack([column[chosen], row[chosen]], -1) + 0.5


def surfaces_met(tree: NerfTree, origins: np.ndarray, directions: np.ndarray, levels: np.ndarray) -> np.ndarray:
    """(R, L) bool: which rays of the world meet the surfaces at levels (L,) of a tree of one grid, by samples a voxel apart at most."""
    plain = volume_of(tree).tree
    # A tree's density is interpolated, so that with opacities in its place these are.
    opaque = [replace(plain, density_values=(1 - np.exp2(-plain.density_values.astype(np.float64) / level)).astype(np.float32)) for level in levels]
    out = np.zeros((len(origins), len(levels)), bool)
    for ray, points in _samples(plain, origins, directions):
        for number in np.argsort(levels):  # what is not met at a level is not met at a higher one
            met = density_at(opaque[number], points) >= 0.5
            ray, points = ray[met], points[met]
            out[ray, number] = True
    return out


def _samples(tree: NerfTree, origins: np.ndarray, directions: np.ndarray) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Samples along rays, some rays at a time: their rays (S,) and points of the tree's frame (S, 3)."""
    warped = tree.frame.rays(origins, directions)
    (_, begin, end), *_ = ray_parts(tree, torch.from_numpy(warped.origins), torch.from_numpy(warped.directions))
    first, length = begin.numpy(), np.maximum((end - begin).numpy(), 0.0)
    steps = np.ceil(length * np.linalg.norm(warped.directions, axis=1) / float(tree.voxel)).astype(np.int64)
    at_once = max(1, SAMPLES_AT_ONCE // max(int(steps.max(initial=0)), 1))
    for start in range(0, len(origins), at_once):
        part = slice(start, start + at_once)
        ray = np.repeat(np.arange(len(origins))[part], steps[part])
        number = np.arange(len(ray)) - np.repeat(np.cumsum(steps[part]) - steps[part], steps[part])
        along = first[ray] + (number + 0.5) * (length / np.maximum(steps, 1))[ray]
        yield ray, warped.origins[ray] + along[:, None] * warped.directions[ray]
