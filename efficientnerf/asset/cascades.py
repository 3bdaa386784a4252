"""The nested grids of a tree that holds an unbounded scene (instant-ngp's cascades).

Cascade 0 is the tree's own grid. Each one after it has voxels twice as large and encloses the one before, which is cut out of it: a point belongs to the
first cascade whose box holds it. Rays are straight throughout. The faces of each box lie on faces of the next cascade's coarse cells. The tree's
environment map shows what lies beyond the last box.

Voxels of a cascade may be stored inside of the box before: values just outside of that box are interpolated from them.

B bricks, N stored voxels of all cascades, R rays, L cascades.
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from efficientnerf.asset.palettes import PaletteHarmonics
from efficientnerf.asset.tree import Cascade, NerfTree

MAX_CASCADES = 16
ALIGNED_CELLS = 4  # coarse cells of cascade 0 along an axis are a multiple of this, so that a box of twice the size has its cells on this one's faces


class Grid(NamedTuple):
    """Where the voxels of a cascade lie."""

    shape: tuple[int, int, int]  # coarse cells along x, y, z
    voxel: float  # side of a voxel
    bounds_min: np.ndarray  # (3,) float64 corner

    def bounds(self, brick: int) -> np.ndarray:
        """(2, 3) corners, for so many voxels along a coarse cell."""
        return np.stack([self.bounds_min, self.bounds_min + np.asarray(self.shape) * brick * self.voxel])


def cascade_grids(bounds: np.ndarray, voxel: float, brick: int, count: int) -> list[Grid]:
    """`count` cascades of which the innermost covers `bounds` (2, 3), with a margin where that does not fit its cells; each box has twice the sides of the one
    before, about the same centre."""
    bounds = np.asarray(bounds, np.float64)
    if count == 1:
        cells = np.ceil(np.round((bounds[1] - bounds[0]) / (voxel * brick), 6)).astype(int).clip(1)
        return [Grid((int(cells[0]), int(cells[1]), int(cells[2])), float(voxel), bounds[0].copy())]
    cells = ALIGNED_CELLS * np.ceil(np.round((bounds[1] - bounds[0]) / (voxel * brick * ALIGNED_CELLS), 6)).astype(int).clip(1)
    centre = bounds.mean(axis=0)
    shape = (int(cells[0]), int(cells[1]), int(cells[2]))
    return [Grid(shape, voxel * 2.0**n, centre - cells * (brick * voxel * 2.0**n / 2)) for n in range(count)]


def cascades_of(tree: NerfTree) -> tuple[Cascade, ...]:
    """All grids of a tree, the innermost first."""
    return Cascade(tree.shape, tree.voxel, tree.bounds_min, tree.brick_index), *tree.outer


def check_cascades(tree: NerfTree) -> None:
    """Raises ValueError unless the cascades nest as the module says."""
    cascades = cascades_of(tree)
    if len(cascades) > 1 and tree.ndc is not None:
        raise ValueError("cascades around normalised device coordinates, which reach to infinity themselves")
    check_nesting([Grid(cascade.shape, cascade.voxel, cascade.bounds_min) for cascade in cascades], tree.brick)


def check_nesting(grids: Sequence[Grid], brick: int) -> None:
    """Raises ValueError unless grids nest as the module says."""
    if len(grids) > MAX_CASCADES:
        raise ValueError(f"{len(grids)} cascades; expected at most {MAX_CASCADES}")
    for n in range(1, len(grids)):
        shape, voxel, low = grids[n]
        if voxel != grids[0][1] * 2.0**n:
            raise ValueError(f"cascade {n} has voxels of {voxel:g}; expected {grids[0][1] * 2.0**n:g}")
        cells = (grids[n - 1].bounds(brick) - low) / (voxel * brick)  # (2, 3)
        if np.abs(cells - np.round(cells)).max() > 1e-3:
            raise ValueError(f"the box of cascade {n - 1} does not lie on faces of the coarse cells of cascade {n}")
        if (np.round(cells[0]) < 0).any() or (np.round(cells[1]) > shape).any():
            raise ValueError(f"cascade {n} does not enclose cascade {n - 1}")


def brick_ranges(tree: NerfTree) -> list[tuple[int, int]]:
    """First brick and end of each cascade; ValueError where the bricks of a cascade do not follow those of the one before."""
    ranges, first = [], 0
    for cascade in cascades_of(tree):
        owned = cascade.brick_index[cascade.brick_index >= 0]
        if len(owned) and (owned.min() != first or owned.max() != first + len(owned) - 1):
            raise ValueError("the bricks of the cascades are not one after the other")
        ranges.append((first, first + len(owned)))
        first += len(owned)
    return ranges


def bricks_of(tree: NerfTree) -> np.ndarray:
    """(B,) numbers of the bricks in the order of files: cascade by cascade, in each in the order of their cells."""
    owner = np.concatenate([cascade.brick_index.reshape(-1) for cascade in cascades_of(tree)])
    return owner[owner >= 0]


def order_of(tree: NerfTree) -> np.ndarray:
    """Stored voxels in the order of files: brick by brick, in a brick by number."""
    order = tree.voxel_index[bricks_of(tree)]
    return order[order >= 0]


def voxel_cascades(tree: NerfTree) -> np.ndarray:
    """(N,) uint8: the cascade of each stored voxel."""
    out = np.zeros(len(tree.density_values), np.uint8)
    for n, (first, end) in enumerate(brick_ranges(tree)):
        rows = tree.voxel_index[first:end]
        out[rows[rows >= 0]] = n
    return out


def cascade_sides(tree: NerfTree) -> np.ndarray:
    """(L,) float64: side of a voxel of each cascade."""
    return np.asarray([cascade.voxel for cascade in cascades_of(tree)], np.float64)


def voxel_sides(tree: NerfTree) -> np.ndarray:
    """(N,) float32: side of each stored voxel."""
    return cascade_sides(tree).astype(np.float32)[voxel_cascades(tree)]


def point_cascades(tree: NerfTree, points: np.ndarray) -> np.ndarray:
    """(R,) int8: the cascade that points (R, 3) of the tree's frame belong to; -1 beyond all boxes."""
    points = np.asarray(points, np.float64)
    out = np.full(len(points), -1, np.int8)
    for n, cascade in reversed(list(enumerate(cascades_of(tree)))):
        low, high = cascade.bounds(tree.brick)
        out[((points >= low) & (points < high)).all(axis=1)] = n
    return out


def voxels_around(tree: NerfTree, points: np.ndarray) -> np.ndarray:
    """(n, 8) int32: the stored voxels that values at points (n, 3) of the tree's frame are interpolated from, -1 where none is stored."""
    out = np.full((len(points), 8), -1, np.int32)
    which = point_cascades(tree, points)
    corner = np.stack(np.meshgrid(*[np.arange(2)] * 3, indexing="ij"), axis=-1).reshape(8, 3)
    for n, cascade in enumerate(cascades_of(tree)):
        here = np.flatnonzero(which == n)
        at = np.floor((points[here] - cascade.bounds_min) / cascade.voxel - 0.5).astype(np.int64)[:, None] + corner  # (n, 8, 3)
        out[here] = voxels_at(tree, cascade, at)
    return out


def voxels_at(tree: NerfTree, cascade: Cascade, at: np.ndarray) -> np.ndarray:
    """(...,) int32: the stored voxels of a cascade at voxel coordinates (..., 3), -1 where none is."""
    size = np.asarray(cascade.shape) * tree.brick
    inside = ((at >= 0) & (at < size)).all(axis=-1)
    cell, local = np.divmod(np.clip(at, 0, size - 1), tree.brick)
    owner = cascade.brick_index[cell[..., 0], cell[..., 1], cell[..., 2]]
    slot = (local[..., 0] * tree.brick + local[..., 1]) * tree.brick + local[..., 2]
    stored = inside & (owner >= 0)
    found = np.full(stored.shape, -1, np.int32)
    found[stored] = tree.voxel_index[owner[stored], slot[stored]]
    return found


def cascade_tree(tree: NerfTree, number: int) -> NerfTree:
    """One cascade as a tree of its own, without the environment."""
    cascade, (first, end) = cascades_of(tree)[number], brick_ranges(tree)[number]
    rows = tree.voxel_index[first:end]
    voxels = rows[rows >= 0]
    index = np.full(rows.shape, -1, np.int32)
    index[rows >= 0] = np.arange(len(voxels), dtype=np.int32)
    harmonics = tree.harmonics.subset(voxels) if isinstance(tree.harmonics, PaletteHarmonics) else tree.harmonics[voxels]
    return replace(
        tree, shape=cascade.shape, voxel=cascade.voxel, bounds_min=cascade.bounds_min,
        brick_index=np.where(cascade.brick_index >= 0, cascade.brick_index - first, -1).astype(np.int32),
        voxel_index=index, density_values=tree.density_values[voxels], harmonics=harmonics, outer=(), environment=None, region=None,
    )  # fmt: skip


def nested(trees: Sequence[NerfTree], environment: np.ndarray | None = None) -> NerfTree:
    """One tree of several, the innermost first, each of which becomes a cascade; metadata and background are those of the first. Harmonics must be plain.

    Raises ValueError, see `check_cascades`.
    """
    bricks = voxels = 0
    cascades, rows = [], []
    for tree in trees:
        if tree.outer or isinstance(tree.harmonics, PaletteHarmonics):
            raise ValueError("a cascade is one grid of voxels with plain harmonics")
        cascades.append(Cascade(tree.shape, tree.voxel, tree.bounds_min, np.where(tree.brick_index >= 0, tree.brick_index + bricks, -1).astype(np.int32)))
        rows.append(np.where(tree.voxel_index >= 0, tree.voxel_index + voxels, -1).astype(np.int32))
        bricks, voxels = bricks + len(tree.voxel_index), voxels + len(tree.density_values)
    joined = replace(
        trees[0], brick_index=cascades[0].brick_index, voxel_index=np.concatenate(rows), density_values=np.concatenate([tree.density_values for tree in trees]),
        harmonics=np.concatenate([tree.sh for tree in trees]), outer=tuple(cascades[1:]), environment=environment,
    )  # fmt: skip
    check_cascades(joined)
    return joined


def subset(tree: NerfTree, keep: np.ndarray) -> NerfTree:
    """The tree with some of its voxels, (N,) bool, alone, in their order; bricks without any are dropped."""
    keep = np.asarray(keep, bool)
    new = np.where(keep, np.cumsum(keep) - 1, -1).astype(np.int32)
    rows = np.where(tree.voxel_index >= 0, new[tree.voxel_index], -1).astype(np.int32) if len(new) else tree.voxel_index
    used = (rows >= 0).any(axis=1)
    number = np.where(used, np.cumsum(used) - 1, -1).astype(np.int32)

    def renumbered(index: np.ndarray) -> np.ndarray:
        return np.where(index >= 0, number[index], -1).astype(np.int32) if len(number) else index

    harmonics = tree.harmonics.subset(np.flatnonzero(keep)) if isinstance(tree.harmonics, PaletteHarmonics) else tree.harmonics[keep]
    region = tree.region
    if region is not None and region.bricks is not None:
        region = replace(region, bricks=region.bricks[used])
    return replace(
        tree, brick_index=renumbered(tree.brick_index), voxel_index=rows[used], density_values=tree.density_values[keep], harmonics=harmonics,
        outer=tuple(replace(cascade, brick_index=renumbered(cascade.brick_index)) for cascade in tree.outer), region=region,
    )  # fmt: skip


def voxel_coordinates(tree: NerfTree) -> np.ndarray:
    """Coordinates (N, 3) int32 of the stored voxels in their own cascade, in their order."""
    out = np.empty((len(tree.density_values), 3), np.int32)
    for cascade, (first, end) in zip(cascades_of(tree), brick_ranges(tree) if tree.outer else [(0, len(tree.voxel_index))], strict=True):
        owner = np.zeros(end - first, np.int64)
        cells = np.flatnonzero(cascade.brick_index.reshape(-1) >= 0)
        owner[cascade.brick_index.reshape(-1)[cells] - first] = cells
        rows = tree.voxel_index[first:end]
        brick, local = np.nonzero(rows >= 0)
        cell = np.stack(np.unravel_index(owner[brick], cascade.shape), axis=-1)
        out[rows[brick, local]] = cell * tree.brick + np.stack(np.unravel_index(local, (tree.brick,) * 3), axis=-1)
    return out
