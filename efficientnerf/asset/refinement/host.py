"""Steps of refinement on the CPU (numba). The kernels sum in a fixed order, so that the bytes do not depend on the number of threads.

N voxels, K harmonics, R rays.
"""

from collections.abc import Callable, Iterable
from typing import Any

import numpy as np
import torch

from efficientnerf.asset.refinement.error_map import Drawn, ErrorMap
from efficientnerf.asset.refinement.state import RefinementState
from efficientnerf.asset.refinement.targets import Bundle, Targets
from efficientnerf.asset.tree import NerfTree
from efficientnerf.backends.layout import Hyperparameters, Moments
from efficientnerf.backends.numba.tree import contributions
from efficientnerf.backends.numba.tree.cells import Cells, cells_of, dense_densities, voxel_places
from efficientnerf.backends.numba.tree_training import gradients
from efficientnerf.backends.numba.tree_training.gradients import RecordBuffer, Records, packets_of
from efficientnerf.backends.numba.tree_training.neighbours import NO_NEIGHBOURS, neighbours_of
from efficientnerf.backends.numba.tree_training.steps import step, values_of
from efficientnerf.rendering.harmonics import basis_numpy


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


def _losses(
    tree: NerfTree, cells: Cells, dense: np.ndarray, sh: np.ndarray, bundle: Bundle, packets: np.ndarray | None, buffer: RecordBuffer
) -> tuple[np.ndarray, Records]:
    """`gradients.forward_backward` of the rays of a bundle, in packets of which the first rays are (P + 1,), or one by one."""
    origins, directions, wanted = bundle
    start, along, bases = in_voxels(tree, origins, directions)
    first = packets_of(len(start)) if packets is None else packets
    return gradients.forward_backward(cells, first, start, along, packet_bases(bases, first), dense, sh, wanted, buffer)


class Steps:
    """Steps that change a state; see `efficientnerf.asset.refinement.fit.optimise`."""

    def __init__(self, state: RefinementState, device: torch.device, error_map: ErrorMap, *, smooth: bool) -> None:
        self.tree, self.cells, self.buffer, self.error_map = state.tree, cells_of(state.tree), RecordBuffer(), error_map
        self.values = values_of(self.cells, state.density, state.sh)
        self.moments = Moments(state.square_density, state.square_sh, state.visits)
        self.neighbours = neighbours_of(self.cells) if smooth else NO_NEIGHBOURS

    def record(self) -> None:
        """All losses are recorded as steps are taken."""

    def take(self, number: int, bundle: Bundle, drawn: Drawn, rates: Hyperparameters, *, packets: np.ndarray | None) -> float:
        """Mean squared error of a channel before the step."""
        loss, records = _losses(self.tree, self.cells, self.values.dense, self.values.sh, bundle, packets, self.buffer)
        step(records, self.values, self.moments, rates, self.neighbours)
        return self.error_map.record(drawn, loss) / 3


def losses_of(tree: NerfTree, targets: Targets) -> Callable[[Bundle, np.ndarray | None], Any]:
    """The sum of the losses of the rays of a bundle, in packets or one by one, see `_losses`."""
    cells, buffer, sh = cells_of(tree), RecordBuffer(), tree.sh.reshape(len(tree.sh), tree.harmonics_count * 3)
    dense = dense_densities(cells, voxel_places(cells, len(sh)), tree.density_values)
    return lambda bundle, packets: _losses(tree, cells, dense, sh, bundle, packets, buffer)[0].sum()


def max_weights(tree: NerfTree, targets: Targets, bundles: Iterable[Bundle]) -> np.ndarray:
    """(N,) the greatest contribution of each voxel to a ray of the bundles."""
    grid, greatest = cells_of(tree), np.zeros((contributions.contribution_shares(), len(tree.density_values)), np.float32)
    for origins, directions, wanted in bundles:
        start, along, _ = in_voxels(tree, origins, directions)
        contributions.max_contributions(grid, start, along, tree.density_values, wanted.transmittance, greatest)
    return greatest.max(axis=0)
