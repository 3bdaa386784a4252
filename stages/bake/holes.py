"""Holes of an unbounded scene: rays of training pixels on which the field is opaque and the tree is not; and the voxels there that were dropped wrongly.

N voxels, P rays.
"""

import numpy as np

from efficientnerf.asset.cascades import voxels_around
from efficientnerf.asset.field_samples import FieldSamples
from efficientnerf.asset.rendering import render_rays
from efficientnerf.asset.tree import NerfTree
from pipeline.stage import Job

FIELD_OPACITY, TREE_OPACITY = 0.95, 0.5  # of a hole: the field's at least, the tree's at most
RAYS = 2**19  # that are checked, at most
RAYS_PER_BLOCK = 2**15
END_WEIGHT = 0.02  # of a sample that is part of the surface where a ray ends


def find_holes(job: Job, tree: NerfTree, samples: FieldSamples) -> tuple[np.ndarray, float]:
    """The rays, as places in `samples`, that end in holes; and their share of those that were checked."""
    every = np.arange(0, len(samples.pixel), max(1, -(-len(samples.pixel) // RAYS)))
    opaque = every[samples.opacity[every] > FIELD_OPACITY]
    found = []
    for begin in range(0, len(opaque), RAYS_PER_BLOCK):
        part = opaque[begin : begin + RAYS_PER_BLOCK]
        seen = render_rays(tree, samples.origin[samples.view[part]].astype(np.float64), samples.direction[part].astype(np.float64))
        found.append(part[seen.opacity < TREE_OPACITY])
        job.progress(begin + len(part), len(opaque), "looking for holes")
        job.safe_point()
    holes = np.concatenate(found) if found else opaque
    return holes, len(holes) / max(len(every), 1)


def voxels_of_holes(tree: NerfTree, samples: FieldSamples, holes: np.ndarray) -> np.ndarray:
    """(N,) bool: the stored voxels around the points at which the field's light ends on the rays `holes`."""
    out = np.zeros(len(tree.density_values), bool)
    for begin in range(0, len(holes), RAYS_PER_BLOCK):
        part = holes[begin : begin + RAYS_PER_BLOCK]
        counts = samples.first[part + 1] - samples.first[part]
        ray = np.repeat(part, counts)
        at = np.repeat(samples.first[part] - np.cumsum(counts) + counts, counts) + np.arange(counts.sum())
        ends = samples.weight[at] > END_WEIGHT
        around = voxels_around(tree, samples.points(at[ends], ray[ends]))
        out[around[around >= 0]] = True
    return out
