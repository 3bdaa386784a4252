"""Steps of refinement on CUDA: pixels, rays, values and steps stay on the device, and the host waits only when the state is fetched.

Kernels: `efficientnerf.backends.triton.tree_gradients` and `tree_steps`. N voxels, K harmonics, R rays.
"""

from collections import deque
from collections.abc import Callable, Iterable
from typing import Any

import numpy as np
import torch
from torch import Tensor

from efficientnerf.asset.refinement.error_map import Drawn, ErrorMap
from efficientnerf.asset.refinement.state import MOMENTS, STATE, RefinementState
from efficientnerf.asset.refinement.targets import Bundle, Targets
from efficientnerf.asset.tree import NerfTree
from efficientnerf.backends.layout import SSIM_WINDOW, Hyperparameters, Moments
from efficientnerf.backends.numba.tree.cells import cells_of
from efficientnerf.backends.numba.tree_training.neighbours import neighbours_of
from efficientnerf.backends.transfer import constant, to_device, to_host_async
from efficientnerf.backends.triton import tree_gradients
from efficientnerf.backends.triton.tree_gradients import DeviceGrid, Rays, device_grid
from efficientnerf.backends.triton.tree_steps import Neighbours, step
from efficientnerf.training.readback import LAG


class Steps:
    """Steps that change a state, on its arrays on a device, by name (`efficientnerf.asset.refinement.state.STATE`), and the sums of the gradients.

    error_map  takes in the losses of steps, some steps after these
    smooth     whether steps have a total variation
    """

    def __init__(self, state: RefinementState, device: torch.device, error_map: ErrorMap, *, smooth: bool = False) -> None:
        self.tree, self.begin, self.device, self.error_map, self.error = state.tree, state.step, device, error_map, 0.0
        self.pending: deque[tuple[Drawn, Tensor, Any]] = deque()
        self.values: dict[str, Tensor] = {name: torch.from_numpy(np.ascontiguousarray(getattr(state, name))).to(device) for name in STATE}
        self.grid = device_grid(state.tree, device)
        count, width = state.sh.shape
        self.by_thickness = torch.zeros(count, dtype=torch.int64, device=device)
        self.by_sh = torch.zeros(count, width, dtype=torch.int64, device=device)
        self.stamp = torch.zeros(count, dtype=torch.int32, device=device)
        beside = torch.from_numpy(voxels_beside(state.tree) if smooth else np.zeros((0, 6), np.int32)).to(device)
        self.neighbours = Neighbours(torch.zeros(len(beside), device=device), beside)
        self.moments = Moments(*(self.values[name] for name in MOMENTS))
        state.device_state = self

    def to_host(self) -> dict[str, np.ndarray]:
        """The arrays on the host; all losses are recorded then."""
        self.record()
        return {name: values.cpu().numpy() for name, values in self.values.items()}

    def record(self, left: int = 0) -> None:
        """Take in the losses of all steps but so many of the last; `error` is the mean of a channel, of the last of them."""
        while len(self.pending) > left:
            drawn, loss, arrived = self.pending.popleft()
            if arrived is not None:
                arrived.synchronize()
            self.error = self.error_map.record(drawn, loss.numpy()) / 3

    def take(self, number: int, bundle: Bundle, drawn: Drawn, rates: Hyperparameters, *, packets: np.ndarray | None) -> float:
        """Launch a step; mean squared error of a channel before it, or before that of LAG steps ago."""
        origins, directions, wanted = bundle
        windows = windows_of(packets, self.device) if packets is not None and wanted.structure > 0 else None
        rays, values, sums = rays_in_voxels(self.tree, origins, directions), (self.values["density"], self.values["sh"]), (self.by_thickness, self.by_sh)
        outputs = tree_gradients.forward(self.grid, rays, *values)
        loss, *by = tree_gradients.loss_and_gradients(*outputs, wanted, windows)
        tree_gradients.backward(self.grid, rays, *values, outputs, (by[0], by[1]), sums, self.stamp, number)
        step(self.grid, values, sums, self.moments, self.stamp, rates, self.neighbours, number=number, rays=len(loss))
        self.pending.append((drawn, *to_host_async(loss)))
        self.record(0 if number == self.begin + 1 else LAG)
        return self.error


def voxels_beside(tree: NerfTree) -> np.ndarray:
    """(N, 6) int32: the voxels beyond the faces -x, x, -y, y, -z, z of each, -1 where none is stored. Voxels of different cascades are not neighbours."""
    around, b = neighbours_of(cells_of(tree)).around, tree.brick
    index = tree.voxel_index.reshape(-1, b, b, b)
    found = np.full((len(tree.density_values), 6), -1, np.int32)
    for face in range(6):
        axis, upper = 1 + face // 2, face % 2
        other = np.where((around[:, face] >= 0)[:, None, None, None], index[around[:, face]], -1)
        joined = np.concatenate([index, other] if upper else [other, index], axis=axis)
        beyond = np.take(joined, np.arange(b) + (1 if upper else b - 1), axis=axis)
        found[index[index >= 0], face] = beyond[index >= 0]
    return found


def windows_of(first: np.ndarray, device: torch.device) -> Tensor:
    """(W,) first rays of the patches of which no ray is missing; first: as in `Patches`."""
    return to_device(torch.from_numpy(first[:-1][np.diff(first) == SSIM_WINDOW**2]), device)


def rays_in_voxels(tree: NerfTree, origins: Tensor, directions: Tensor) -> Rays:
    """Rays of the world (R, 3), unit directions, in voxel coordinates."""
    rays = tree.frame.rays(origins.double(), directions.double())
    start = (rays.origins - constant(tree.bounds_min, rays.origins)) / tree.voxel
    return Rays(start.float().contiguous(), rays.directions.float().contiguous(), directions.float().contiguous())


def values_of(tree: NerfTree, device: torch.device) -> tuple[DeviceGrid, Tensor, Tensor]:
    """Where a tree's voxels lie, their density (N,) and harmonics (N, 3 K)."""
    density, sh = (np.array(values, np.float32) for values in (tree.density_values, tree.sh.reshape(len(tree.sh), 3 * tree.harmonics_count)))
    return device_grid(tree, device), torch.from_numpy(density).to(device), torch.from_numpy(sh).to(device)


def losses_of(tree: NerfTree, targets: Targets) -> Callable[[Bundle, np.ndarray | None], Any]:
    """The sum of the losses of the rays of a bundle, which are rendered one by one."""
    grid, density, sh = values_of(tree, targets.device)

    def losses(bundle: Bundle, packets: np.ndarray | None) -> Tensor:
        origins, directions, wanted = bundle
        outputs = tree_gradients.forward(grid, rays_in_voxels(tree, origins, directions), density, sh)
        return tree_gradients.loss_and_gradients(*outputs, wanted)[0].double().sum()

    return losses


def max_weights(tree: NerfTree, targets: Targets, bundles: Iterable[Bundle]) -> np.ndarray:
    """(N,) over the rays of the bundles."""
    grid, density, _ = values_of(tree, targets.device)
    greatest = torch.zeros_like(density)
    for origins, directions, wanted in bundles:
        tree_gradients.max_contributions(grid, rays_in_voxels(tree, origins, directions), density, wanted.transmittance.contiguous(), greatest)
    return greatest.cpu().numpy()
