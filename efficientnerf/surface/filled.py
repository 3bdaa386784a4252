"""Where a volume has density: the parts of a grid, which may be vast and nearly empty, that may hold a surface.

These are the bricks of a tree; all of any other `Volume`.
"""

import math
from collections.abc import Iterator

import numpy as np

from efficientnerf.surface.volume import Volume, WorldVolume

SLAB = 64  # layers of voxels that are in memory at a time, of a volume without bricks


def filled_parts(volume: Volume, axis: int, low: np.ndarray, high: np.ndarray) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Corners of the parts of a column of bricks along `axis` that may have density; gaps do not count in its rays' depth."""
    if not isinstance(volume, WorldVolume):
        yield low, high
        return
    others, brick = [other for other in range(3) if other != axis], volume.brick
    at = np.unique(volume.cells[(volume.cells[:, others] == low[others] // brick).all(axis=1), axis])
    for run in np.split(at, np.flatnonzero(np.diff(at) > 1) + 1) if len(at) else ():
        begin, end = low.copy(), high.copy()
        begin[axis], end[axis] = run[0] * brick, (run[-1] + 1) * brick
        yield begin, end


def dense_voxels(volume: Volume, threshold: float) -> Iterator[np.ndarray]:
    """(M, 3) voxels of at least this density, above zero, some at a time."""
    if isinstance(volume, WorldVolume):
        yield from volume.dense_voxels(threshold)
        return
    grid = np.asarray(volume.shape, np.int64) * int(volume.brick)
    for start in range(0, int(grid[0]), SLAB):
        sigma = np.asarray(volume.density_block((start, 0, 0), (min(start + SLAB, int(grid[0])), *grid[1:].tolist())))
        yield np.argwhere(sigma >= threshold) + np.array([start, 0, 0])


def filled_blocks(volume: Volume, counts: list[int], block: int) -> np.ndarray:
    """(n, 3) numbers of the blocks that may hold a part of the surface, in order: those with a brick, and those next to them, where enclosed space may end."""
    if not isinstance(volume, WorldVolume):
        return np.stack(np.unravel_index(np.arange(math.prod(counts)), counts), axis=1)
    at = np.unique(volume.cells * volume.brick // block, axis=0)
    flat = np.zeros(0, np.int64)
    for offset in np.argwhere(np.ones((3, 3, 3), bool)) - 1:
        beside = at + offset
        beside = beside[((beside >= 0) & (beside < counts)).all(axis=1)]
        flat = np.union1d(flat, np.ravel_multi_index(tuple(beside.T), counts))
    return np.stack(np.unravel_index(flat, counts), axis=1)
