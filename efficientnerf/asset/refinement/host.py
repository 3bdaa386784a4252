"""Steps of refinement on the CPU (numba). The kernels sum in a fixed order, so that the bytes do not depend on the number of threads.

N voxels, K harmonics, R rays.
"""

from collections.abc import Callable, Iterable, Iterator

import numpy as np

from efficientnerf.asset.refinement.error_map import INTERVAL, ErrorMap
from efficientnerf.asset.refinement.state import RefinementState
from efficientnerf.asset.refinement.targets import Bundle, Targets, step_rng
from efficientnerf.asset.refinement.tiles import tiles_met
from efficientnerf.asset.tree import NerfTree
from efficientnerf.backends.layout import SSIM_WINDOW, Hyperparameters, Moments
from efficientnerf.backends.numba.tree import contributions
from efficientnerf.backends.numba.tree.cells import cells_of, dense_densities, voxel_places
from efficientnerf.backends.numba.tree_training import gradients
from efficientnerf.backends.numba.tree_training.gradients import RecordBuffer, packets_of
from efficientnerf.backends.numba.tree_training.neighbours import NO_NEIGHBOURS, neighbours_of
from efficientnerf.backends.numba.tree_training.steps import step, values_of
from efficientnerf.rendering.harmonics import basis_numpy
from efficientnerf.training.patches import Patches, PatchGrid

MAX_PACKET_ANGLE = 0.02  # radians across patches whose rays share harmonics; docs/experiments/tree-training-kernels.md


def in_voxels(tree: NerfTree, origins: np.ndarray, directions: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Rays of the world in voxel coordinates of cascade 0, and the harmonics along them (R, K)."""
    rays = tree.frame.rays(np.asarray(origins, np.float64), np.asarray(directions, np.float64))
    start = np.ascontiguousarray((rays.origins - tree.bounds_min) / tree.voxel)
    bases = np.ascontiguousarray(basis_numpy(np.asarray(directions, np.float32), tree.degree))
    return start, np.ascontiguousarray(rays.directions, np.float64), bases


def packet_bases(bases: np.ndarray, first: np.ndarray) -> np.ndarray:
    """(P, K) mean harmonics of packets of rays, whose own are (R, K); none of the packets is empty."""
    mean = np.add.reduceat(bases, first[:-1], axis=0) / np.diff(first).astype(np.float32)[:, None]
    return np.ascontiguousarray(mean, bases.dtype)


def optimise(
    state: RefinementState, targets: Targets, *, until: int, rays: int, density_lr: float, sh_lr: float, fall: Callable[[int], float], seed: int,
    view_dependent_lr_ratio: float, patch_side: int, total_variation: float, error_map: float,
) -> Iterator[float]:  # fmt: skip
    """See `efficientnerf.asset.refinement.fit.optimise`."""
    cells, buffer = cells_of(state.tree), RecordBuffer()
    values = values_of(cells, state.density, state.sh)
    patches = PatchGrid(targets.host_pixels, patch_side)
    errors = ErrorMap(patches, tiles_met(state.tree, patches), state.errors, share=error_map)
    state.errors = errors.errors
    moments = Moments(state.square_density, state.square_sh, state.visits)
    neighbours = neighbours_of(cells) if total_variation > 0 else NO_NEIGHBOURS
    while state.step < until:
        number = state.step + 1
        if state.step % INTERVAL == 0:
            errors.set_chances()
        drawn = errors.draw(rays, step_rng(seed, number))
        origins, directions, wanted = targets.of(drawn.patches.pixels)
        if patch_side != SSIM_WINDOW:
            wanted = wanted._replace(structure=0.0)
        start, along, bases = in_voxels(state.tree, origins, directions)
        first = drawn.patches.first if patches.angle <= MAX_PACKET_ANGLE else packets_of(len(start))
        loss, records = gradients.forward_backward(cells, first, start, along, packet_bases(bases, first), values.dense, values.sh, wanted, buffer)
        factor = fall(number)
        rates = Hyperparameters(density_lr * factor, sh_lr * factor, view_dependent_lr_ratio, total_variation=total_variation)
        step(records, values, moments, rates, neighbours)
        state.step = number
        yield errors.record(drawn, loss) / 3


def total_loss(tree: NerfTree, targets: Targets, patches: Iterable[Patches], angle: float) -> float:
    """Sum of the losses of the rays of patches, across which `angle` is that of `PatchGrid`; objects over the background of the scene."""
    cells, buffer, sh = cells_of(tree), RecordBuffer(), tree.sh.reshape(len(tree.sh), tree.harmonics_count * 3)
    dense, total = dense_densities(cells, voxel_places(cells, len(sh)), tree.density_values), 0.0
    for part in patches:
        origins, directions, wanted = targets.of(part.pixels, constant_background=True)
        start, along, bases = in_voxels(tree, origins, directions)
        first = part.first if angle <= MAX_PACKET_ANGLE else packets_of(len(start))
        loss, _ = gradients.forward_backward(cells, first, start, along, packet_bases(bases, first), dense, sh, wanted, buffer)
        total += float(loss.sum())
    return total


def max_weights(tree: NerfTree, targets: Targets, bundles: Iterable[Bundle]) -> np.ndarray:
    """(N,) the greatest contribution of each voxel to a ray of the bundles."""
    grid, greatest = cells_of(tree), np.zeros((contributions.contribution_shares(), len(tree.density_values)), np.float32)
    for origins, directions, wanted in bundles:
        start, along, _ = in_voxels(tree, origins, directions)
        contributions.max_contributions(grid, start, along, tree.density_values, wanted.transmittance, greatest)
    return greatest.max(axis=0)
