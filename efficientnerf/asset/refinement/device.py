"""Steps of refinement on CUDA: pixels, rays, values and steps stay on the device, and the host waits only when the state is fetched.

Kernels: `efficientnerf.backends.triton.tree_gradients` and `tree_steps`. N voxels, K harmonics, R rays.
"""

from collections import deque
from collections.abc import Callable, Iterable, Iterator
from typing import Any

import numpy as np
import torch
from torch import Tensor

from efficientnerf.asset.refinement.error_map import INTERVAL, Drawn, ErrorMap
from efficientnerf.asset.refinement.host import MAX_PACKET_ANGLE
from efficientnerf.asset.refinement.state import MOMENTS, STATE, RefinementState
from efficientnerf.asset.refinement.targets import Bundle, Targets, step_rng
from efficientnerf.asset.refinement.tiles import tiles_met
from efficientnerf.asset.tree import NerfTree
from efficientnerf.backends.layout import SSIM_WINDOW, Hyperparameters, Moments
from efficientnerf.backends.numba.tree.cells import cells_of
from efficientnerf.backends.numba.tree_training.neighbours import neighbours_of
from efficientnerf.backends.transfer import constant, to_device, to_host_async
from efficientnerf.backends.triton import tree_gradients
from efficientnerf.backends.triton.tree_gradients import DeviceGrid, Rays, device_grid
from efficientnerf.backends.triton.tree_steps import Neighbours, step
from efficientnerf.training.device_pixels import DevicePixels
from efficientnerf.training.patches import Patches, PatchGrid
from efficientnerf.training.readback import LAG


class DeviceArrays:
    """A state's arrays on a device, by name (`efficientnerf.asset.refinement.state.STATE`), and the sums of the gradients.

    error_map  takes in the losses of steps, some steps after these
    smooth     whether steps have a total variation
    """

    def __init__(self, state: RefinementState, device: torch.device, error_map: ErrorMap, *, smooth: bool = False) -> None:
        self.error_map, self.error = error_map, 0.0
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

    def to_host(self) -> dict[str, np.ndarray]:
        """The arrays on the host; all losses are recorded then."""
        self.record(0)
        return {name: values.cpu().numpy() for name, values in self.values.items()}

    def record(self, left: int) -> None:
        """Take in the losses of all steps but so many of the last; `error` is the mean of a channel, of the last of them."""
        while len(self.pending) > left:
            drawn, loss, arrived = self.pending.popleft()
            if arrived is not None:
                arrived.synchronize()
            self.error = self.error_map.record(drawn, loss.numpy()) / 3

    def step(self, number: int, rays: Rays, wanted: Any, windows: Tensor | None, hyperparameters: Hyperparameters) -> Tensor:
        """Losses (R,) of the rays before the step; windows: see `loss_and_gradients`."""
        values, sums = (self.values["density"], self.values["sh"]), (self.by_thickness, self.by_sh)
        outputs = tree_gradients.forward(self.grid, rays, *values)
        loss, *by = tree_gradients.loss_and_gradients(*outputs, wanted, windows)
        tree_gradients.backward(self.grid, rays, *values, outputs, (by[0], by[1]), sums, self.stamp, number)
        step(self.grid, values, sums, self.moments, self.stamp, hyperparameters, self.neighbours, number=number, rays=len(loss))
        return loss


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


def optimise(
    state: RefinementState, targets: Targets, *, until: int, rays: int, density_lr: float, sh_lr: float, fall: Callable[[int], float], seed: int,
    view_dependent_lr_ratio: float, patch_side: int, total_variation: float, error_map: float,
) -> Iterator[float]:  # fmt: skip
    """See `efficientnerf.asset.refinement.fit.optimise`. Steps are counted as soon as they are launched; the error is that of LAG steps before."""
    assert isinstance(targets.pixels, DevicePixels)
    state.fetch()
    patches = PatchGrid(targets.host_pixels, patch_side)
    errors = ErrorMap(patches, tiles_met(state.tree, patches), state.errors, share=error_map)
    state.errors = errors.errors
    state.device_state = arrays = DeviceArrays(state, targets.pixels.device, errors, smooth=total_variation > 0)
    begin = state.step
    while state.step < until:
        number = state.step + 1
        if state.step % INTERVAL == 0:
            arrays.record(0)
            errors.set_chances()
        drawn = errors.draw(rays, step_rng(seed, number))
        origins, directions, wanted = targets.of(drawn.patches.pixels)
        factor = fall(number)
        hyperparameters = Hyperparameters(density_lr * factor, sh_lr * factor, view_dependent_lr_ratio, total_variation=total_variation)
        windows = windows_of(drawn.patches.first, origins.device) if patch_side == SSIM_WINDOW and patches.angle <= MAX_PACKET_ANGLE else None
        loss = arrays.step(number, rays_in_voxels(state.tree, origins, directions), wanted, windows, hyperparameters)
        arrays.pending.append((drawn, *to_host_async(loss)))
        state.step = number
        arrays.record(0 if number == begin + 1 else LAG)
        yield arrays.error


def values_of(tree: NerfTree, device: torch.device) -> tuple[DeviceGrid, Tensor, Tensor]:
    """Where a tree's voxels lie, their density (N,) and harmonics (N, 3 K)."""
    density, sh = (np.array(values, np.float32) for values in (tree.density_values, tree.sh.reshape(len(tree.sh), 3 * tree.harmonics_count)))
    return device_grid(tree, device), torch.from_numpy(density).to(device), torch.from_numpy(sh).to(device)


def total_loss(tree: NerfTree, targets: Targets, patches: Iterable[Patches], angle: float) -> float:
    """Sum of the losses of the rays of patches, which are rendered one by one, whatever the `angle`; objects over the background of the scene."""
    assert isinstance(targets.pixels, DevicePixels)
    grid, density, sh = values_of(tree, targets.pixels.device)
    total = torch.zeros((), dtype=torch.float64, device=density.device)
    for part in patches:
        origins, directions, wanted = targets.of(part.pixels, constant_background=True)
        loss, _, _ = tree_gradients.loss_and_gradients(*tree_gradients.forward(grid, rays_in_voxels(tree, origins, directions), density, sh), wanted)
        total += loss.double().sum()
    return float(total)


def max_weights(tree: NerfTree, targets: Targets, bundles: Iterable[Bundle]) -> np.ndarray:
    """(N,) over the rays of the bundles."""
    assert isinstance(targets.pixels, DevicePixels)
    grid, density, _ = values_of(tree, targets.pixels.device)
    greatest = torch.zeros_like(density)
    for origins, directions, wanted in bundles:
        tree_gradients.max_contributions(grid, rays_in_voxels(tree, origins, directions), density, wanted.transmittance.contiguous(), greatest)
    return greatest.cpu().numpy()
