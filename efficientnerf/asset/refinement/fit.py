"""From a baked tree to one that looks like the training images: gradient descent on its values.

The structure of the tree stays. The optical thickness of each voxel (its logarithm, so that it stays positive) and its harmonics are fitted. The loss
of a ray is that of `RayTargets`: in unbounded scenes the training images are compared through what the field shows before and behind the box; objects
with alpha over all backgrounds at once.

Every random choice of step n is drawn from a generator seeded by (seed, n), as in training. On the CPU the same steps give the same bytes, on any
number of threads and whether or not they were interrupted. On CUDA sums do not depend on their order, and values differ by rounding.

PlenOctrees (Yu et al. 2021, section 4.3) and Plenoxels (Fridovich-Keil et al. 2022) optimise trees and grids this way. N voxels, R rays.
"""

import math
from collections.abc import Callable, Iterator

import numpy as np

from efficientnerf.asset.refinement.state import RefinementState
from efficientnerf.asset.refinement.targets import Bundle, Targets
from efficientnerf.asset.tree import NerfTree
from efficientnerf.backends.dispatch import fitting
from efficientnerf.training.patches import Patches, PatchGrid

PATCH_SIDE = 4  # docs/experiments/tree-training-kernels.md
WEIGHT_RAYS = 2**16  # of a bundle
ERROR_PATCHES = 2**10  # of a bundle; the rays leave records


def optimise(
    state: RefinementState, targets: Targets, *, until: int, rays: int, density_lr: float, sh_lr: float, fall: Callable[[int], float], seed: int,
    view_dependent_lr_ratio: float = 1.0, patch_side: int = PATCH_SIDE, total_variation: float = 0.0, error_map: float = 0.9,
) -> Iterator[float]:  # fmt: skip
    """Take steps up to `until`, yielding the mean squared error of a channel after each step; on a device, that of some steps before.

    rays                     of a step, about
    density_lr               learning rate of the logarithm of the optical thickness
    sh_lr                    learning rate of the harmonics
    fall                     factor of the learning rates by a step's number (`efficientnerf.asset.refinement.schedule`)
    view_dependent_lr_ratio  factor of that for harmonics of degree 1 and above
    patch_side               pixels along a side of the patches that rays are drawn in
    total_variation          share, of the density's learning rate, of the differences between the logarithms of a voxel's and its neighbours' optical thickness
    error_map                share of the rays that are drawn by the errors of earlier ones, below 1
    """
    yield from fitting(targets.backend).optimise(
        state, targets, until=until, rays=rays, density_lr=density_lr, sh_lr=sh_lr, fall=fall, seed=seed, view_dependent_lr_ratio=view_dependent_lr_ratio,
        patch_side=patch_side, total_variation=total_variation, error_map=error_map,
    )  # fmt: skip


def error(tree: NerfTree, targets: Targets, count: int, seed: int) -> float:
    """Mean squared error of a channel over patches of training pixels, about `count` in all, drawn by `seed`; objects over the background of the scene.

    Rays of a patch meet the same voxels: in unbounded scenes they take a tenth of the time of as many single rays.
    """
    rng = np.random.Generator(np.random.Philox(key=seed, counter=[0, 0, 3, 0]))
    grid = PatchGrid(targets.host_pixels, PATCH_SIDE)
    few = 1.0 if grid.usable_tiles is None else len(grid) / int(grid.usable_tiles.sum())  # tiles to one that has pixels
    number, at_once, drawn = math.ceil(few * count / grid.mean_pixels), math.ceil(few * ERROR_PATCHES), 0

    def patches() -> Iterator[Patches]:
        nonlocal drawn
        while not drawn:  # where pixels are masked, patches may have none
            for begin in range(0, number, at_once):
                tile = rng.integers(len(grid), size=min(at_once, number - begin))
                part = grid.drawn_from(tile if grid.usable_tiles is None else tile[grid.usable_tiles[tile]], rng)
                drawn += len(part.pixels)
                if len(part.pixels):
                    yield part

    total = fitting(targets.backend).total_loss(tree, targets, patches(), grid.angle)
    return float(total) / (3 * drawn)


def max_weights(tree: NerfTree, targets: Targets, count: int, seed: int, progress: Callable[[int, int], None] | None = None) -> np.ndarray:
    """(N,) the greatest contribution of each voxel to one of `count` random training pixels. They are rendered in the order of the images, where neighbours
    meet the same voxels; each is drawn by itself, for patches would leave voxels out that single views show.
    """
    rng = np.random.Generator(np.random.Philox(key=seed, counter=[0, 0, 4, 0]))
    chosen = np.sort(targets.host_pixels.choose(count, rng))
    bundles = _reported((targets.of(chosen[begin : begin + WEIGHT_RAYS]) for begin in range(0, count, WEIGHT_RAYS)), count, progress)
    weights: np.ndarray = fitting(targets.backend).max_weights(tree, targets, bundles)
    return weights


def _reported(bundles: Iterator[Bundle], count: int, progress: Callable[[int, int], None] | None) -> Iterator[Bundle]:
    """The bundles, reporting the rays done after each."""
    done = 0
    for bundle in bundles:
        yield bundle
        done += len(bundle[0])
        if progress is not None:
            progress(done, count)
