"""Density and harmonics of the voxels of an asset, from the field; blocks are kept in the scratch folder.

N voxels, K harmonics.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from pipeline.stage import Job
from stages.baking.scratch import read_arrays, write_arrays
from stages.scratch import once, unusable

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

    warn = once(job.warn)
    while done < blocks and (stored := read_arrays(job.work / f"block_{done:06d}", {"values": ("float32", 2)}, warn)) is not None:
        expected = min(max(1, bake.POINTS_PER_BLOCK // max(1, points)), len(indices) - rows), 1 + 3 * harmonics
        if stored["values"].shape != expected:
            warn(unusable(job.work / f"block_{done:06d}", f"{stored['values'].shape} values, expected {expected}"))
            break
        append(stored["values"])
    for some, colours in bake.voxel_values(m, indices, voxel, low, points, job.settings.seed, first=done, space=space):
        part = np.concatenate([some[:, None], colours.reshape(len(some), -1)], axis=1)
        write_arrays({"values": part}, job.work / f"block_{done:06d}")
        append(part)
        job.progress(done, blocks, "baking voxels")
        job.safe_point()
    return density, sh
