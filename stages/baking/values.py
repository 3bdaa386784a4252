"""Density and harmonics of the voxels of an asset, from the field; blocks are kept in the scratch folder.

N voxels, K harmonics.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from pipeline.stage import Job
from stages.baking.scratch import read_npy, write_npy

if TYPE_CHECKING:
    from efficientnerf.geometry.spaces import Space


def baked_values(job: Job, m: Any, indices: np.ndarray, voxel: float, low: np.ndarray, points: int, space: Space) -> tuple[np.ndarray, np.ndarray]:
    """Density (N,) and harmonics (N, K, 3) of voxels (N, 3); blocks of an earlier attempt are read."""
    from efficientnerf.asset import bake

    blocks, harmonics = bake.blocks_of(len(indices), points), (m.fine.degree + 1) ** 2
    density, sh = np.empty(len(indices), np.float32), np.empty((len(indices), harmonics, 3), np.float32)
    done = rows = 0

    def append(part: np.ndarray) -> None:
        nonlocal done, rows
        density[rows : rows + len(part)] = part[:, 0]
        sh[rows : rows + len(part)] = part[:, 1:].reshape(len(part), harmonics, 3)
        done, rows = done + 1, rows + len(part)

    while done < blocks and (stored := read_npy(job.work / f"block_{done:06d}.npy")) is not None:
        append(stored)
    for some, colours in bake.voxel_values(m, indices, voxel, low, points, job.settings.seed, first=done, space=space):
        part = np.concatenate([some[:, None], colours.reshape(len(some), -1)], axis=1)
        write_npy(part, job.work / f"block_{done:06d}.npy")
        append(part)
        job.progress(done, blocks, "baking voxels")
        job.safe_point()
    return density, sh
