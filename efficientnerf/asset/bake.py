"""From a trained model to a NerfTree (EfficientNeRF, section 3.5; the choice and averaging of voxels after PlenOctree).

1. `visible_voxels`: the greatest fine weight of each voxel over training pixels, both stages run as in training. In unbounded scenes the field's samples
   are kept instead, and weigh the voxels of nested grids (`efficientnerf.asset.field_samples`).
2. `chosen_voxels`: those above a threshold, dilated by one voxel so that linear interpolation has all its corners.
3. `voxel_values`: density and harmonics averaged over several jittered points of each voxel, in blocks.
4. `efficientnerf.asset.refinement` fits this tree to the training images; voxels that do not show are dropped.

B coarse cells, N voxels.
"""

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

import numpy as np
import torch

from efficientnerf.backends.numba.bricks import coordinates_of, flat_indices, resample_weights, threshold_and_dilate
from efficientnerf.geometry.spaces import Space
from efficientnerf.model import Model, render_rays
from efficientnerf.rendering.compositing import activate
from efficientnerf.sampling.occupancy import cell_of
from efficientnerf.training.pixels import Pixels

RAYS_PER_BLOCK = 8192
POINTS_PER_BLOCK = 2**17


def grid_of(bounds: np.ndarray, resolution: int, brick: int) -> tuple[tuple[int, int, int], float]:
    """Coarse cells along x, y, z and the side of a voxel, so that `resolution` voxels span the longest side of the box and cells cover it."""
    extent = np.asarray(bounds[1], np.float64) - np.asarray(bounds[0], np.float64)
    voxel = float(extent.max()) / resolution
    x, y, z = (max(1, math.ceil(round(side / (voxel * brick), 6))) for side in extent)
    return (x, y, z), voxel


@dataclass(frozen=True, eq=False)
class Visibility:
    """The greatest weight of each voxel in training pixels."""

    cells: np.ndarray  # (B,) int64 flat coarse cells (x slowest) that hold any sample, ascending
    greatest: np.ndarray  # (B, brick^3) float32, each voxel's greatest weight


@torch.no_grad()
def visible_voxels(
    m: Model, pixels: Pixels, shape: tuple[int, int, int], voxel: float, bounds_min: np.ndarray, brick: int, count: int, done: Callable[[int, int], None],
    space: Space | None = None,
) -> Visibility:  # fmt: skip
    """Greatest weight of each voxel over about `count` training pixels, evenly spread. Memory grows with the occupied cells, not with the grid.

    done   called with the number of pixels done and of all
    space  the network's, in the frame that the voxels are cubes of: see `NdcSpace.with_voxel_depth`; None: the network's own
    """
    space = space or m.space
    size = torch.tensor(shape) * brick
    row_of = torch.full((math.prod(shape),), -1, dtype=torch.int32)
    greatest = torch.zeros(1024, brick**3)
    rows = 0
    low = torch.as_tensor(bounds_min, dtype=torch.float32)
    chosen = spread_pixels(pixels, count)
    for begin in range(0, len(chosen), RAYS_PER_BLOCK):
        bundle = pixels.bundle(chosen[begin : begin + RAYS_PER_BLOCK])
        origins, directions, near, far = (torch.from_numpy(np.ascontiguousarray(a)).to(m.device) for a in bundle[:4])
        behind = m.behind(directions)
        outputs = render_rays(m, origins, directions, near, far, torch.full_like(near, 0.5), behind)
        at = torch.floor((space.world(outputs.fine.point).cpu() - low) / voxel).long()
        inside = ((at >= 0) & (at < size)).all(dim=1)
        at, weight = at[inside], outputs.fine_weight.cpu()[inside]
        cell = at // brick
        local, flat = at - cell * brick, (cell[:, 0] * shape[1] + cell[:, 1]) * shape[2] + cell[:, 2]
        new = torch.unique(flat[row_of[flat] < 0])
        row_of[new] = torch.arange(rows, rows + len(new), dtype=torch.int32)
        rows += len(new)
        if rows > len(greatest):
            greatest = torch.cat([greatest, greatest.new_zeros(2 * rows - len(greatest), brick**3)])
        slot = row_of[flat].long() * brick**3 + (local[:, 0] * brick + local[:, 1]) * brick + local[:, 2]
        greatest.view(-1).scatter_reduce_(0, slot, weight, reduce="amax")
        done(min(len(chosen), begin + RAYS_PER_BLOCK), len(chosen))
    cells = torch.nonzero(row_of >= 0).squeeze(1)
    return Visibility(cells.numpy(), greatest[row_of[cells].long()].numpy())


def spread_pixels(pixels: Pixels, count: int) -> np.ndarray:
    """About `count` usable pixels: one at random of each run of `len(pixels) / count`. A fixed one would hit a few columns alone where the run
    divides the width."""
    total = pixels.usable_count
    stride = max(1, total // max(count, 1))
    starts = np.arange(0, total, stride)
    chosen = np.minimum(starts + np.random.Generator(np.random.Philox(key=0)).integers(stride, size=len(starts)), total - 1)
    return pixels.usable_pixels(chosen)


def coarsened(
    visibility: Visibility, shape: tuple[int, int, int], voxel: float, to_shape: tuple[int, int, int], to_voxel: float, brick: int, threshold: float
) -> Visibility:
    """The visibility of a grid of larger voxels with the same corner: each has the greatest weight of the voxels whose centres lie in it.
    Weights that do not exceed `threshold` are left out."""
    row_of = np.full(math.prod(to_shape), -1, np.int32)
    given = visibility.cells, visibility.greatest, float(np.float32(threshold)), shape, to_shape, voxel / to_voxel, brick, row_of
    rows = resample_weights(*given, np.zeros((0, brick**3), np.float32), 0)
    greatest = np.zeros((rows, brick**3), np.float32)
    resample_weights(*given, greatest, rows)
    cells = np.flatnonzero(row_of >= 0)
    return replace(visibility, cells=cells, greatest=greatest[row_of[cells]])


def chosen_voxels(visibility: Visibility, shape: tuple[int, int, int], brick: int, threshold: float, dilate: int) -> np.ndarray:
    """Coordinates (N, 3) int32 of the voxels whose greatest weight exceeds `threshold`, and of those around them, in the order of the grid.

    They are marked in the cells that they reach, so that memory grows with the result, and neither with the grid nor with the number of neighbours.
    """
    threshold = float(np.float32(threshold))
    reached = np.zeros(shape, bool)
    reached.reshape(-1)[visibility.cells[(visibility.greatest > threshold).any(axis=1)]] = True
    for axis in range(3):
        for _ in range(math.ceil(dilate / brick)):
            low, high = reached.copy().swapaxes(0, axis), reached.swapaxes(0, axis)
            high[1:] |= low[:-1]
            high[:-1] |= low[1:]
    cells = np.flatnonzero(reached)
    row_of = np.full(reached.size, -1, np.int32)
    row_of[cells] = np.arange(len(cells))
    into = np.zeros((len(cells), brick**3), bool)
    threshold_and_dilate(visibility.cells, visibility.greatest, threshold, shape, brick, dilate, row_of, into)
    flat = np.empty(np.count_nonzero(into), np.int64)
    flat_indices(into, cells, shape, brick, flat)
    flat.sort()
    index = np.empty((len(flat), 3), np.int32)
    coordinates_of(flat, shape[1] * brick, shape[2] * brick, index)
    return index


@torch.no_grad()
def voxel_values(
    m: Model, indices: np.ndarray, voxel: float, bounds_min: np.ndarray, points: int, seed: int, first: int = 0, space: Space | None = None
) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Density (n,) and harmonics (n, K, 3) of the voxels, block by block from the `first`-th block on.

    points  jittered points to a voxel: one in each of so many slices along a diagonal permutation, averaged; densities as they are,
            harmonics weighted by density; 0: the centre of the voxel alone, for fields trained on these (`train.discretise`)
    space   as in `visible_voxels`

    The density is per unit of the frame: in the shell of a contracted space the field's own is per contracted unit. It is zero where the density voxels or
    the coarse field have space empty: the fine field is hardly evaluated there in training.
    """
    space = space or m.space
    low = torch.as_tensor(bounds_min, dtype=torch.float32)
    jittered, points = points > 0, max(1, points)
    per_block = POINTS_PER_BLOCK // points or 1
    for number in range(first, math.ceil(len(indices) / per_block)):
        block = torch.from_numpy(indices[number * per_block : (number + 1) * per_block])
        rng = np.random.Generator(np.random.Philox(key=seed, counter=[0, 0, 1, number]))
        jitter = torch.from_numpy(rng.random((len(block), points, 3), np.float32)) if jittered else torch.full((len(block), 1, 3), 0.5)
        world = (block[:, None] + jitter) * voxel + low
        point = space.grid(world.reshape(-1, 3)).to(m.device)
        raw = m.fine(m.snapped_points(point))
        valid = m.voxels.values.view(-1)[cell_of(point, m.voxels.side)] > m.voxels.threshold
        every = activate(raw[:, 0], m.fine.activation)
        density = (every * valid).reshape(len(block), points)
        density = density * _has_pivots(m, space.grid((block + 0.5) * voxel + low))[:, None]
        heavy = density
        if space.contracted:
            # In an unbounded scene a voxel where rays end may get density although the coarse field is empty there: it has the colour of what was hidden.
            heavy = torch.where(density.sum(dim=1, keepdim=True) > 0, density, every.reshape(len(block), points))
            density = density / space.unit(world).abs().amax(dim=-1).clamp(min=1).square().to(density)
        share = heavy / heavy.sum(dim=1, keepdim=True).clamp(min=1e-12)
        sh = (raw[:, 1:].reshape(len(block), points, -1) * share[..., None]).sum(dim=1)
        yield density.mean(dim=1).cpu().numpy(), sh.reshape(len(block), 3, -1).transpose(1, 2).contiguous().cpu().numpy()


def _has_pivots(m: Model, grid: torch.Tensor) -> torch.Tensor:
    """(n,) bool on the model's device: whether the coarse field at grid coordinates (n, 3) absorbs as much over an interval as a valid density voxel.

    Where it absorbs less, a sample is among the lightest of its ray: it is no pivot on rays that meet the subject, and the fine field is hidden
    there. The asset, without a coarse stage, would show it.
    """
    if m.settings.sampling != "efficient" or m.voxels.rule != "maximum":  # no pivots to drop, or no density that voxels have to reach
        return torch.ones(len(grid), dtype=torch.bool, device=m.device)
    raw = m.coarse(m.snapped_points(grid.float().to(m.device)))[:, 0]
    return activate(raw, m.coarse.activation) > m.voxels.threshold


def blocks_of(count: int, points: int) -> int:
    """How many blocks `voxel_values` yields for so many voxels."""
    return math.ceil(count / max(1, POINTS_PER_BLOCK // max(1, points)))
