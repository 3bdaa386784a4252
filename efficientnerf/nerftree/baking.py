"""From a trained model to a NerfTree (EfficientNeRF, section 3.5; the choice and averaging of voxels after PlenOctree).

1. `visible_voxels`: every voxel's greatest fine weight over the training pixels, both stages run as in training.
2. `chosen_voxels`: those above a threshold, dilated by one voxel so that linear interpolation has all its corners.
3. `voxel_values`: density and harmonics averaged over several jittered points of each voxel, in blocks.

M pixels, N voxels.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator

import numpy as np
import torch

from efficientnerf.compositing import activate
from efficientnerf.density import cell_of
from efficientnerf.model import Model, look
from efficientnerf.pixels import Pixels

RAYS_PER_BLOCK = 8192
POINTS_PER_BLOCK = 2**17


def grid_of(bounds: np.ndarray, resolution: int, brick: int) -> tuple[tuple[int, int, int], float]:
    """Coarse cells along x, y, z and the side of a voxel, so that `resolution` voxels span the longest side of the box and cells cover it."""
    extent = np.asarray(bounds[1], np.float64) - np.asarray(bounds[0], np.float64)
    voxel = float(extent.max()) / resolution
    x, y, z = (max(1, math.ceil(round(side / (voxel * brick), 6))) for side in extent)
    return (x, y, z), voxel


@torch.no_grad()
def visible_voxels(
    m: Model, pixels: Pixels, shape: tuple[int, int, int], voxel: float, bounds_min: np.ndarray, brick: int, count: int, done: Callable[[int, int], None]
) -> np.ndarray:
    """Greatest weight of each voxel over about `count` training pixels, evenly spread: flat float32 (x slowest).

    done  called with pixels looked at and their number
    """
    size = np.asarray(shape, np.int64) * brick
    greatest = torch.zeros(int(size.prod()))
    low = torch.as_tensor(bounds_min, dtype=torch.float32)
    total = len(pixels)
    # One pixel of each stretch of `stride`, at random: always the same one would visit a few columns alone where the stride divides the width.
    stride = max(1, total // max(count, 1))
    stretches = np.arange(0, total, stride)
    chosen = np.minimum(stretches + np.random.Generator(np.random.Philox(key=0)).integers(stride, size=len(stretches)), total - 1)
    if pixels.usable is not None:
        chosen = chosen[pixels.usable[chosen]]
    for begin in range(0, len(chosen), RAYS_PER_BLOCK):
        bundle = pixels.bundle(chosen[begin : begin + RAYS_PER_BLOCK])
        origins, directions, near, far = (torch.from_numpy(np.ascontiguousarray(a)).to(m.device) for a in bundle[:4])
        seen = look(m, origins, directions, near, far, torch.full_like(near, 0.5), m.behind(directions))
        point = m.space.world(seen.fine.point).cpu()
        cell = torch.floor((point - low) / voxel).long()
        inside = ((cell >= 0) & (cell < torch.from_numpy(size))).all(dim=1)
        flat = (cell[:, 0] * int(size[1]) + cell[:, 1]) * int(size[2]) + cell[:, 2]
        greatest.scatter_reduce_(0, flat[inside], seen.fine_weight.cpu()[inside], reduce="amax")
        done(min(len(chosen), begin + RAYS_PER_BLOCK), len(chosen))
    return greatest.numpy()


def chosen_voxels(greatest: np.ndarray, shape: tuple[int, int, int], brick: int, threshold: float, dilate: int) -> np.ndarray:
    """Coordinates (N, 3) of the voxels whose greatest weight exceeds `threshold`, and of those around them."""
    from scipy.ndimage import binary_dilation

    kept = (greatest > threshold).reshape([n * brick for n in shape])
    if dilate:
        kept = binary_dilation(kept, np.ones((3, 3, 3), bool), iterations=dilate)
    return np.argwhere(kept).astype(np.int32)


@torch.no_grad()
def voxel_values(
    m: Model, indices: np.ndarray, voxel: float, bounds_min: np.ndarray, points: int, seed: int, first: int = 0
) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Density (n,) and harmonics (n, K, 3) of the voxels, block by block from the `first`-th block on.

    points  jittered points to a voxel: one in each of so many slices along a diagonal permutation, averaged; densities as they are,
            harmonics weighted by density

    Where the density voxels say that space is empty the density is zero: the fine field was never asked there and may say anything.
    """
    low = torch.as_tensor(bounds_min, dtype=torch.float32)
    per_block = max(1, POINTS_PER_BLOCK // points)
    for number in range(first, math.ceil(len(indices) / per_block)):
        block = torch.from_numpy(indices[number * per_block : (number + 1) * per_block])
        rng = np.random.Generator(np.random.Philox(key=seed, counter=[0, 0, 1, number]))
        jitter = torch.from_numpy(rng.random((len(block), points, 3), np.float32))
        world = (block[:, None] + jitter) * voxel + low
        point = m.space.grid(world.reshape(-1, 3)).to(m.device)
        raw = m.fine(point).cpu()
        valid = (m.voxels.values.view(-1)[cell_of(point, m.voxels.side)] > m.voxels.threshold).cpu()
        density = (activate(raw[:, 0], m.fine.activation) * valid).reshape(len(block), points)
        share = density / density.sum(dim=1, keepdim=True).clamp(min=1e-12)
        sh = (raw[:, 1:].reshape(len(block), points, -1) * share[..., None]).sum(dim=1)
        yield density.mean(dim=1).numpy(), sh.reshape(len(block), 3, -1).transpose(1, 2).contiguous().numpy()


def blocks_of(count: int, points: int) -> int:
    """How many blocks `voxel_values` yields for so many voxels."""
    return math.ceil(count / max(1, POINTS_PER_BLOCK // points))
