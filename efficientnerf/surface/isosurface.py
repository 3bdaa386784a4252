"""From densities to a surface: its level, enclosed space, marching cubes.

Letters: sigma density per world unit, tau the level of the surface, s the voxel's side; V vertices, F faces, R rays, S samples.
Everything is in the frame of the volume (`efficientnerf.surface.volume`).
"""

from collections.abc import Callable

import numpy as np
from scipy.ndimage import binary_dilation, label
from skimage.measure import marching_cubes

from efficientnerf.asset.region import inside_distance
from efficientnerf.surface.fusion import EMPTY, MARGIN, Fusion, fused_opacity
from efficientnerf.surface.mesh import compact
from efficientnerf.surface.volume import Volume

Progress = Callable[[int, int, str], None]
LARGEST_SIDE = 4096  # voxels along a side of a grid that is baked
CLIP = 2.0  # voxels on either side of the border of a region, in which clipped surfaces come in and fade
BLOCK = 64  # voxels a side that are in memory at a time


class NoSurface(ValueError):
    """The density nowhere reaches the given level. The message names the level and the highest density."""


def silent(done: int, total: int, text: str) -> None:
    pass


def pool_of(volume: Volume) -> int:
    """Voxels along a side of the cells in which enclosed space is found: two; more where that were over 256 cells a side, for the memory.

    Of grids beyond the sides that are baked, which may be a line of cells, the least that makes no more than 256^3 cells.
    """
    grid = np.asarray(volume.tree.resolution)
    pool = 2 * max(1, -(-int(grid.max()) // 512))
    if grid.max() > LARGEST_SIDE:
        pool = next(each for each in range(2, pool + 1, 2) if each == pool or np.prod(-(-grid // each)) <= 256**3)
    return pool


def automatic_threshold(volume: Volume) -> float:
    """The default density of the surface: that which light from outside meets.

        tau = min( ln 2 / s,  lower quartile over rays of max_{j <= h} sigma_j ),   h: the voxel where the ray's transmittance falls to 1/2

    Rays run along the axes, both ways, through up to 24 x 24 columns of bricks per axis; those that stay half transparent are
    left out. A surface at tau lies at or in front of the depth at which a ray has lost half its light if tau <= the highest density up to
    there; the lower quartile makes that true for three rays in four, so that soft, half-trained densities give a closed surface where a
    fixed level would leave holes or nothing. Where densities are hard, one voxel that swallows half the light is enough (the first term):
    a higher level would eat thin parts.

    Raises NoSurface where no ray loses half its light.
    """
    grid, brick, voxel = np.asarray(volume.tree.resolution), volume.tree.brick, volume.tree.voxel
    found, highest = [], 0.0
    for axis in range(3):
        first, second = (other for other in range(3) if other != axis)
        for i in _evenly_spaced(grid[first] // brick, 24):
            for j in _evenly_spaced(grid[second] // brick, 24):
                low, high = np.zeros(3, np.int64), grid.copy()
                low[first], low[second] = i * brick, j * brick
                high[first], high[second] = low[first] + brick, low[second] + brick
                blocks = [volume.density_block(*part) for part in volume.filled_parts(axis, low, high)]
                if not blocks:
                    continue
                block = np.concatenate(blocks, axis)
                sigma = np.moveaxis(block, axis, -1).reshape(-1, block.shape[axis]).astype(np.float64)  # (R, S)
                highest = max(highest, float(sigma.max()))
                found += [_densities_on_entry(ray, voxel) for ray in (sigma, sigma[:, ::-1])]
    levels = np.concatenate(found) if found else np.zeros(0)
    if not len(levels):
        raise NoSurface(f"no ray through the volume loses half its light; the highest density found is {highest:.3g} per unit and a voxel is {voxel:.3g} wide")
    return float(min(np.log(2) / voxel, np.quantile(levels, 0.25)))


def _evenly_spaced(count: int, most: int) -> np.ndarray:
    """At most `most` of the numbers 0..count-1, evenly spread."""
    return np.unique((np.arange(min(count, most)) + 0.5) * count // min(count, most)).astype(np.int64)


def _densities_on_entry(sigma: np.ndarray, voxel: float) -> np.ndarray:
    """(R, S) densities along rays -> the highest up to the depth of half transmittance, of the rays that have one."""
    depth = np.cumsum(sigma, 1) * voxel  # (R, S) optical depth
    opaque = depth[:, -1] >= np.log(2)
    half = (depth[opaque] < np.log(2)).sum(1)  # (R,) first voxel behind which less than half is left
    return np.maximum.accumulate(sigma[opaque], 1)[np.arange(len(half)), half]


def enclosed_cells(volume: Volume, threshold: float, viewpoints: np.ndarray) -> np.ndarray:
    """Empty space that cannot be seen from outside, because everything around it is dense: bool, one value per cell of `pool_of`^3 voxels.

    viewpoints  (N, 3) places that are outside by definition, besides the boundary of the volume: a camera may stand in a closed room

    A cell counts as dense if one of its voxels is, so that light does not creep in through pinholes of the size of a voxel.
    """
    grid, pool = np.asarray(volume.tree.resolution), pool_of(volume)
    cells = -(-grid // pool)
    dense = np.zeros(cells + 2, bool)  # an empty cell all around: the outside
    for voxels in volume.dense_voxels(threshold):
        dense[tuple((voxels // pool + 1).T)] = True
    region = np.empty(dense.shape, np.int32)
    label(~dense, output=region)
    outside = {int(region[0, 0, 0])}
    at = np.floor((viewpoints - volume.tree.bounds_min) / (volume.tree.voxel * pool)).astype(np.int64)  # (N, 3)
    at = at[((at >= 0) & (at < cells)).all(1)] + 1
    outside |= set(region[tuple(at.T)].tolist())
    return (~dense & ~np.isin(region, list(outside)))[1:-1, 1:-1, 1:-1]


def _filled_block(volume: Volume, low: np.ndarray, high: np.ndarray, threshold: float, enclosed: np.ndarray | None) -> np.ndarray:
    """`volume.density_block` with infinite density in enclosed space.

    Enclosed space grows by a few voxels, as far as nothing dense is in the way: into the corners that its coarse cells left out, and
    into pinholes, which it fills. The margin that is read makes the result the same for both blocks that share a plane.
    """
    if enclosed is None:
        return volume.density_block(low, high)
    margin = pool_of(volume) + 1
    axes = [np.arange(a - margin, b + margin) // pool_of(volume) for a, b in zip(low, high)]
    known = [(axis >= 0) & (axis < count) for axis, count in zip(axes, enclosed.shape)]
    seed = enclosed[np.ix_(*(np.clip(axis, 0, count - 1) for axis, count in zip(axes, enclosed.shape)))]
    seed &= known[0][:, None, None] & known[1][:, None] & known[2]
    if not seed.any():
        return volume.density_block(low, high)
    sigma = volume.density_block(low - margin, high + margin)
    filled = binary_dilation(seed, iterations=margin, mask=sigma < threshold)
    return np.where(filled, np.float32(np.inf), sigma)[margin:-margin, margin:-margin, margin:-margin]


def isosurface(
    volume: Volume, threshold: float, progress: Progress = silent, *, enclosed: np.ndarray | None = None, block: int = BLOCK, fusion: Fusion | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """The closed surface where the density passes `threshold` -> vertices (V, 3) float64, faces (F, 3) int64.

    Blocks of `block` voxels share the samples of the plane between them, and so its vertices; those are joined by the grid edge that they
    lie on, not by their coordinates. Beyond the volume the density is zero, so the surface closes at its boundary. Cells that are `enclosed`
    (of `enclosed_cells`) count as solid.

    Marching cubes (Lewiner's, by scikit-image) runs on the opacity f = 1 - 2^(-sigma / threshold) at level 1/2 instead of on sigma: densities
    jump from nothing to hundreds within a voxel, and vertices interpolated on them would all sit at the same end of their edges.
    """
    grid = np.asarray(volume.tree.resolution)
    starts = [np.arange(-1, grid[axis], block) for axis in range(3)]
    blocks = volume.filled_blocks([len(each) for each in starts], block)
    positions, faces, seams, joined, count = [], [], [], [], 0
    for done, number in enumerate(blocks):
        progress(done + 1, len(blocks), "marching cubes")
        low = number * block - 1
        high = np.minimum(low + block, grid)  # the last sample, included
        margin = 0 if fusion is None else MARGIN
        sigma = _filled_block(volume, low - margin, high + 1 + margin, threshold, enclosed).astype(np.float64)
        opacity = (1 - np.exp2(-sigma / threshold)).astype(np.float32)  # of a layer that is half opaque at the threshold
        if opacity.max() <= EMPTY:  # nothing is fused there
            continue
        if fusion is not None:
            opacity = fused_opacity(fusion, opacity, low - margin, volume.tree.bounds_min, volume.tree.voxel)[margin:-margin, margin:-margin, margin:-margin]
        opacity = _dithered(_clipped(volume, opacity, low), low)
        if opacity.min() > 0.5 or opacity.max() < 0.5:
            continue
        local, triangles, _, _ = marching_cubes(opacity, 0.5, gradient_direction="ascent")  # "ascent" is the one that winds outward here
        local = local.astype(np.float64)  # (V, 3) in voxels from `low`
        rows, keys = _on_seams(local, low, high, grid)
        positions.append(local + low)
        faces.append(triangles.astype(np.int64) + count)
        seams.append(rows + count)
        joined.append(keys)
        count += len(local)
    if not faces:
        return np.zeros((0, 3)), np.zeros((0, 3), np.int64)
    target = np.arange(count)
    rows, keys = np.concatenate(seams), np.concatenate(joined)
    _, first, index = np.unique(keys, return_index=True, return_inverse=True)
    target[rows] = rows[first][index]
    grid_points, triangles = compact(np.concatenate(positions), target[np.concatenate(faces)])
    # Sample i lies at the middle of voxel i. The lids at the boundary must not stand out of the box.
    grid_points = np.clip(grid_points + 0.5, 0, grid)
    return volume.tree.bounds_min + grid_points * volume.tree.voxel, triangles


def _clipped(volume: Volume, opacity: np.ndarray, low: np.ndarray) -> np.ndarray:
    """Opacities of voxels from `low` on without those outside of the volume's region."""
    region, voxel = volume.region, volume.tree.voxel
    if region is None:
        return opacity

    # The region is a column: distances are the lesser of those in plan and in height, each taken where the other is greatest.
    middle = np.asarray(region.bounds, np.float64).mean(axis=0)
    x, y, z = (start + (first + np.arange(side) + 0.5) * voxel for start, first, side in zip(volume.tree.bounds_min, low, opacity.shape))
    plan = inside_distance(region, np.stack([*np.broadcast_arrays(x[:, None], y, middle[2])], -1).reshape(-1, 3)).reshape(*opacity.shape[:2], 1)
    height = inside_distance(region, np.stack(np.broadcast_arrays(middle[0], middle[1], z), -1))
    if min(plan.min(), height.min()) > region.fade / 2 + CLIP * voxel:
        return opacity
    beyond = (region.fade / 2 - np.minimum(plan, height)) / voxel
    return np.minimum(opacity, np.clip(0.5 - beyond / (2 * CLIP), 0, 1).astype(np.float32))


def _dithered(opacity: np.ndarray, low: np.ndarray) -> np.ndarray:
    """Opacities of voxels from `low` on, of which none is at the level.

    A dither of 0.001, a hash of the voxel's index, is laid over it. Saturated opacities (0 and 1 only) put the same value on all four
    corners of a checkered face, whose ambiguity Lewiner's test then decides differently in different cells: edges with four faces. And no
    value may be the level itself: every vertex must lie inside one grid edge, strictly.
    """
    first = [np.arange(start, start + count) + 1 for start, count in zip(low, opacity.shape)]
    index = [each.astype(np.uint32) * np.uint32(prime) for each, prime in zip(first, (73856093, 19349663, 83492791))]
    mixed = index[0][:, None, None] ^ index[1][None, :, None] ^ index[2][None, None, :]
    mixed = (mixed ^ (mixed >> np.uint32(15))) * np.uint32(2246822519)
    opacity = opacity + (mixed >> np.uint32(16)).astype(np.float32) * np.float32(1e-3 / 65536)
    return np.where(np.abs(opacity - 0.5) < 1e-4, np.float32(0.4999), opacity).astype(np.float32)


def _on_seams(local: np.ndarray, low: np.ndarray, high: np.ndarray, grid: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The vertices on a block's sides: their rows, and a number for the grid edge that each lies on."""
    whole = local == np.floor(local)  # (V, 3)
    side = (whole & ((local == 0) | (local == high - low))).any(1)
    rows = np.flatnonzero(side & (whole.sum(1) == 2))
    axis = np.argmin(whole[rows], 1)
    corner = np.floor(local[rows]).astype(np.int64) + low + 1  # >= 0
    return rows, ((corner[:, 0] * (grid[1] + 3) + corner[:, 1]) * (grid[2] + 3) + corner[:, 2]) * 3 + axis
