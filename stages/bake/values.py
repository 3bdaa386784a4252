"""Density and harmonics of the voxels of an asset, from the field; blocks are kept in the scratch folder.

N voxels, K harmonics.
"""

from dataclasses import replace
from typing import Any

import numpy as np

from efficientnerf.asset import bake
from efficientnerf.asset.cascades import nested
from efficientnerf.asset.field_samples import density_as_seen
from efficientnerf.asset.tree import NerfTree, tree_from_voxels
from efficientnerf.geometry.spaces import Space
from efficientnerf.model import Model
from pipeline.stage import Job
from stages.bake.plan import Bake
from stages.bake.scratch import read_arrays, write_arrays
from stages.bake.settings import BakeSettings
from stages.bake.voxels import Voxels
from stages.io.scene import Scene
from stages.scratch import once, unusable


def baked_values(
    job: Job, m: Model, indices: np.ndarray, voxel: float, low: np.ndarray, points: int, space: Space, name: str
) -> tuple[np.ndarray, np.ndarray]:
    """Density (N,) and harmonics (N, K, 3) of voxels (N, 3); blocks of an earlier attempt are read.

    name  of the blocks in the scratch folder
    """
    blocks, harmonics = bake.blocks_of(len(indices), points), (m.fine.degree + 1) ** 2
    density, sh = np.empty(len(indices), np.float32), np.empty((len(indices), harmonics, 3), np.float32)
    done = rows = 0

    def append(part: np.ndarray) -> None:
        nonlocal done, rows
        density[rows : rows + len(part)] = part[:, 0]
        sh[rows : rows + len(part)] = part[:, 1:].reshape(len(part), harmonics, 3)
        done, rows = done + 1, rows + len(part)

    warn = once(job.warn)
    while done < blocks and (stored := read_arrays(job.work / f"{name}_{done:06d}", {"values": ("float32", 2)}, warn)) is not None:
        expected = min(max(1, bake.POINTS_PER_BLOCK // max(1, points)), len(indices) - rows), 1 + 3 * harmonics
        if stored["values"].shape != expected:
            warn(unusable(job.work / f"{name}_{done:06d}", f"{stored['values'].shape} values, expected {expected}"))
            break
        append(stored["values"])
    for some, colours in bake.voxel_values(m, indices, voxel, low, points, job.settings.seed, first=done, space=space):
        part = np.concatenate([some[:, None], colours.reshape(len(some), -1)], axis=1)
        write_arrays({"values": part}, job.work / f"{name}_{done:06d}")
        append(part)
        job.progress(done, blocks, "baking voxels")
        job.safe_point()
    return density, sh


def baked_tree(job: Job, m: Model, s: Scene, plan: Bake, voxels: Voxels, metadata: dict[str, Any]) -> NerfTree:
    """The tree with the field's values."""
    settings: BakeSettings = job.settings
    trees, around = [], voxels.surroundings
    for n, ((shape, voxel, low), indices) in enumerate(zip(voxels.grids, voxels.indices, strict=True)):
        samples = 0 if plan.at_centres and not n else settings.samples_per_voxel
        density, sh = baked_values(job, m, indices, voxel, low, samples, plan.space, "block" if around is None else f"cascade{n}")
        if around is not None:
            density = density_as_seen(density, around.seen[n], voxel)
        one = tree_from_voxels(
            shape, voxel, low, indices, density, sh,
            brick=settings.brick_size, background=s.background, metadata=metadata, ndc=plan.space.ndc, lookup=settings.lookup, step_size=settings.step_size,
        )  # fmt: skip
        trees.append(one)
    return trees[0] if around is None else replace(nested(trees, around.environment), region=around.region)
