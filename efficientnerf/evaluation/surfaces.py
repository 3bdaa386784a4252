"""How much of an asset's density lies away from the surfaces of its network: floaters.

The surface of the network on a ray is where half of the light is absorbed. The limit lies before it by a margin: MARGIN_DEPTH of its distance, or MARGIN_VOXELS
of the cascade that holds the surface, whichever is more. Density before the limit is a floater; so is all density on a ray on which the
network absorbs less than half.

R rays.
"""

from dataclasses import replace

import numpy as np
import torch

from efficientnerf.asset.cascades import cascades_of
from efficientnerf.asset.queries import density_at
from efficientnerf.asset.rendering import ray_parts
from efficientnerf.asset.tree import NerfTree
from efficientnerf.geometry.ndc import ndc_distance, world_distance

MARGIN_DEPTH = 0.02
MARGIN_VOXELS = 3.0
POINTS_AT_ONCE = 2**20  # changes memory alone


def surface_limits(tree: NerfTree, origins: np.ndarray, directions: np.ndarray, distance: np.ndarray) -> np.ndarray:
    """Where the margin before a surface begins.

    origins, directions  (R, 3) of the world, unit directions
    distance             (R,) of the surface along the ray, world units; infinity: there is none
    returns              (R,) distances, at least 0; infinity where there is no surface
    """
    warped = tree.frame.rays(np.asarray(origins, np.float64), np.asarray(directions, np.float64))
    there = np.isfinite(distance)
    known = np.where(there, distance, 0.0)
    along = ndc_distance(known, *warped[2:])
    point = warped.origins + along[:, None] * warped.directions
    voxel = np.zeros(len(known))
    for cascade in reversed(cascades_of(tree)):
        low, high = cascade.bounds(tree.brick)
        voxel = np.where((voxel == 0) | ((point >= low) & (point <= high)).all(axis=-1), cascade.voxel, voxel)
    before = world_distance(np.maximum(along - MARGIN_VOXELS * voxel, 0.0), *warped[2:])
    return np.where(there, np.clip(np.minimum(before, (1 - MARGIN_DEPTH) * known), 0.0, None), np.inf)


def opacity_nearer(tree: NerfTree, origins: np.ndarray, directions: np.ndarray, limits: np.ndarray) -> np.ndarray:
    """Opacity (R,) of the parts of a tree nearer than the limits (R,), distances of the world, on rays (R, 3); by sums over steps of a voxel at most."""
    warped = tree.frame.rays(np.asarray(origins, np.float64), np.asarray(directions, np.float64))
    ends = ndc_distance(np.where(np.isfinite(limits), limits, 1e9), *warped[2:])
    thickness = np.zeros(len(ends))
    cascades = cascades_of(tree)
    for n, *span in ray_parts(tree, torch.from_numpy(warped.origins), torch.from_numpy(warped.directions)):
        cascade, (begin, end) = cascades[n], (part.numpy() for part in span)
        grid = replace(tree, shape=cascade.shape, voxel=cascade.voxel, bounds_min=cascade.bounds_min, brick_index=cascade.brick_index, outer=(), ndc=None)
        length = np.maximum(np.minimum(end, ends) - begin, 0.0)
        steps = np.ceil(length / cascade.voxel).astype(np.int64)
        block = max(1, POINTS_AT_ONCE // int(steps.max(initial=1)))
        for first in range(0, len(steps), block):
            chosen = slice(first, first + block)
            ray = np.repeat(np.arange(len(steps))[chosen], steps[chosen])
            number = np.arange(len(ray)) - np.repeat(np.cumsum(steps[chosen]) - steps[chosen], steps[chosen])
            extent = (length / np.maximum(steps, 1))[ray]
            points = warped.origins[ray] + (begin[ray] + (number + 0.5) * extent)[:, None] * warped.directions[ray]
            thickness[chosen] += np.bincount(ray - first, density_at(grid, points) * extent, minlength=len(steps[chosen]))
    return 1.0 - np.exp(-thickness)
