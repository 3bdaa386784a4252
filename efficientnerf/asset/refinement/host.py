"""Steps of refinement on the CPU (numba). The kernels sum in a fixed order, so that the bytes do not depend on the number of threads.

N voxels, K harmonics, R rays.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator

import numpy as np

from efficientnerf.asset.cascades import cascade_sides, voxel_cascades
from efficientnerf.asset.refinement.state import RefinementState
from efficientnerf.asset.refinement.targets import Bundle, Targets, step_rng
from efficientnerf.asset.tree import NerfTree
from efficientnerf.backends.numba.tree import gradients
from efficientnerf.backends.numba.tree.gradients import SampleRecords
from efficientnerf.backends.numba.tree.rmsprop import Hyperparameters, rmsprop_step
from efficientnerf.backends.numba.tree.walk import tree_grid
from efficientnerf.rendering.harmonics import basis_numpy

DECAY, EPSILON = 0.99, 1e-10  # of RMSprop


def in_voxels(tree: NerfTree, origins: np.ndarray, directions: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Rays of the world in voxel coordinates of cascade 0, and the harmonics along them (R, K)."""
    rays = tree.frame.rays(np.asarray(origins, np.float64), np.asarray(directions, np.float64))
    start = np.ascontiguousarray((rays.origins - tree.bounds_min) / tree.voxel)
    bases = np.ascontiguousarray(basis_numpy(np.asarray(directions, np.float32), tree.degree))
    return start, np.ascontiguousarray(rays.directions, np.float64), bases


def optimise(
    state: RefinementState, targets: Targets, *, until: int, rays: int, density_lr: float, sh_lr: float, fall: Callable[[int], float], seed: int,
    view_dependent_lr_ratio: float,
) -> Iterator[float]:  # fmt: skip
    """See `efficientnerf.asset.refinement.fit.optimise`."""
    grid, records = tree_grid(state.tree), SampleRecords()
    by_density, by_sh = np.zeros_like(state.density), np.zeros_like(state.sh)
    stamp = np.zeros(len(state.density), np.int32)
    sides, cascades = cascade_sides(state.tree), voxel_cascades(state.tree)
    rates = np.full(state.sh.shape[1], sh_lr, np.float32)
    rates[3:] *= view_dependent_lr_ratio
    while state.step < until:
        number = state.step + 1
        origins, directions, wanted = targets.draw(rays, step_rng(seed, number))
        start, along, bases = in_voxels(state.tree, origins, directions)
        loss, counts = gradients.forward_backward(grid, start, along, bases, state.density, state.sh, wanted, records)
        factor = fall(number)
        rmsprop_step(
            records, counts, bases, (state.density, state.sh), (by_density, by_sh), (state.square_density, state.square_sh), state.visits, stamp, number,
            Hyperparameters(sides, cascades, density_lr * factor, rates * np.float32(factor), DECAY, EPSILON),
        )  # fmt: skip
        state.step = number
        yield float(loss.mean()) / 3


def total_loss(tree: NerfTree, bundles: Iterable[Bundle]) -> float:
    """Sum of the losses of the rays of the bundles."""
    grid, records, sh = tree_grid(tree), SampleRecords(), tree.sh.reshape(len(tree.sh), tree.harmonics_count * 3)
    total = 0.0
    for origins, directions, wanted in bundles:
        loss, _ = gradients.forward_backward(grid, *in_voxels(tree, origins, directions), tree.density_values, sh, wanted, records)
        total += float(loss.sum())
    return total


def max_weights(tree: NerfTree, bundles: Iterable[Bundle]) -> np.ndarray:
    """(N,) the greatest contribution of each voxel to a ray of the bundles."""
    grid, greatest = tree_grid(tree), np.zeros((gradients.contribution_shares(), len(tree.density_values)), np.float32)
    for origins, directions, wanted in bundles:
        start, along, _ = in_voxels(tree, origins, directions)
        gradients.max_contributions(grid, start, along, tree.density_values, wanted.transmittance, greatest)
    return greatest.max(axis=0)
