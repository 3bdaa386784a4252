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

from efficientnerf.asset.refinement.error_map import INTERVAL, ErrorMap
from efficientnerf.asset.refinement.state import RefinementState
from efficientnerf.asset.refinement.targets import Bundle, Targets, step_rng
from efficientnerf.asset.refinement.tiles import tiles_met
from efficientnerf.asset.tree import NerfTree
from efficientnerf.backends.dispatch import fitting
from efficientnerf.backends.layout import SSIM_WINDOW, Hyperparameters
from efficientnerf.training.patches import Patches, PatchGrid

MAX_PACKET_ANGLE = 0.02  # radians across patches whose rays share harmonics; docs/experiments/tree-training-kernels.md
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
    state.fetch()  # where steps were taken on a device before
    patches = PatchGrid(targets.host_pixels, patch_side)
    errors = ErrorMap(patches, tiles_met(state.tree, patches), state.errors, share=error_map)
    state.errors = errors.errors
    steps = fitting(targets.backend).Steps(state, targets.device, errors, smooth=total_variation > 0)
    while state.step < until:
        if state.step % INTERVAL == 0:
            steps.record()
            errors.set_chances()
        number = state.step + 1
        drawn, factor = errors.draw(rays, step_rng(seed, number)), fall(number)
        rates = Hyperparameters(density_lr * factor, sh_lr * factor, view_dependent_lr_ratio, total_variation=total_variation)
        origins, directions, wanted = targets.of(drawn.patches.pixels)
        if patch_side != SSIM_WINDOW:
            wanted = wanted._replace(structure=0.0)
        found = steps.take(number, (origins, directions, wanted), drawn, rates, packets=_packets(patches, drawn.patches))
        state.step = number
        yield found


def _packets(grid: PatchGrid, patches: Patches) -> np.ndarray | None:
    """(P + 1,) first ray of each patch, and the end, where its rays share harmonics; None: each ray has its own."""
    return patches.first if grid.angle <= MAX_PACKET_ANGLE else None


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

    losses = fitting(targets.backend).losses_of(tree, targets)
    total = sum(losses(targets.of(part.pixels, constant_background=True), _packets(grid, part)) for part in patches())
    return float(total) / (3 * drawn)


def max_weights(tree: NerfTree, targets: Targets, count: int, seed: int, progress: Callable[[int, int], None] | None = None) -> np.ndarray:
    """(N,) the greatest contribution of each voxel to one of `count` random training pixels. They are rendered in the order of the images, where neighbours
    meet the same voxels; each is drawn by itself, for patches would leave voxels out that single views show.
    """
    rng = np.random.Generator(np.random.Philox(key=seed, counter=[0, 0, 4, 0]))
    chosen = np.sort(targets.host_pixels.choose(count, rng))

    def bundles() -> Iterator[Bundle]:
        for begin in range(0, count, WEIGHT_RAYS):
            part = chosen[begin : begin + WEIGHT_RAYS]
            yield targets.of(part)
            if progress is not None:
                progress(begin + len(part), count)

    weights: np.ndarray = fitting(targets.backend).max_weights(tree, targets, bundles())
    return weights
