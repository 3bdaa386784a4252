"""`efficientnerf.asset.refinement` on a CUDA device: pixels, rays, values and steps stay there, and nothing waits for it but who asks for the state.

Kernels: `efficientnerf.backends.triton.tree_gradients`. N voxels, K harmonics, R rays.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Iterator
from dataclasses import replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from efficientnerf.asset.refinement import DECAY, EPSILON, STATE, Bundle, Optimiser, Targets, randomness
from efficientnerf.asset.tree import NerfTree
from efficientnerf.backends.transfer import constant, to_host_async
from efficientnerf.backends.triton import tree_gradients
from efficientnerf.backends.triton.tree_gradients import DeviceGrid, Rays, device_grid
from efficientnerf.training.device_pixels import DevicePixels
from efficientnerf.training.pixels import Pixels
from efficientnerf.training.readback import LAG


def sent_targets(targets: Targets, device: str | torch.device) -> Targets:
    """The targets on a device."""
    assert isinstance(targets.pixels, Pixels)
    before, behind = (None if part is None else torch.from_numpy(np.ascontiguousarray(part)).to(device) for part in (targets.before, targets.behind))
    return replace(targets, pixels=DevicePixels(targets.pixels, device), before=before, behind=behind)


class DeviceFit:
    """An optimiser's arrays on a device, by the names they have there (`efficientnerf.asset.refinement.STATE`), and the gradients' sums."""

    def __init__(self, o: Optimiser, device: torch.device) -> None:
        self.values: dict[str, Tensor] = {name: torch.from_numpy(np.ascontiguousarray(getattr(o, name))).to(device) for name in STATE}
        self.grid = device_grid(o.tree, device)
        count, width = o.sh.shape
        self.by_thickness = torch.zeros(count, dtype=torch.int64, device=device)
        self.by_sh = torch.zeros(count, width, dtype=torch.int64, device=device)
        self.stamp = torch.zeros(count, dtype=torch.int32, device=device)

    def to_host_async(self) -> dict[str, np.ndarray]:
        """The arrays on the host."""
        return {name: values.cpu().numpy() for name, values in self.values.items()}

    def step(self, number: int, rays: Rays, seen: Any, density_rate: float, colour_rate: float, view_share: float = 1.0) -> Tensor:
        """Losses (R,) of the rays before the step."""
        v, sums = self.values, (self.by_thickness, self.by_sh)
        outputs = tree_gradients.forward(self.grid, rays, v["density"], v["sh"])
        loss, *by = tree_gradients.loss_and_gradients(*outputs, seen)
        tree_gradients.backward(self.grid, rays, v["density"], v["sh"], outputs, (by[0], by[1]), sums, self.stamp, number)
        tree_gradients.rmsprop_step(
            self.grid, (v["density"], v["sh"]), sums, (v["square_density"], v["square_sh"]), v["visits"], self.stamp,
            number=number, rays=len(loss), density_rate=density_rate, sh_rate=colour_rate, view_share=view_share, decay=DECAY, epsilon=EPSILON,
        )  # fmt: skip
        return loss


def rays_in_voxels(tree: NerfTree, origins: Tensor, directions: Tensor) -> Rays:
    """Rays of the world (R, 3), unit directions, in voxel coordinates."""
    rays = tree.frame.rays(origins.double(), directions.double())
    start = (rays.origins - constant(tree.bounds_min, rays.origins)) / tree.voxel
    return Rays(start.float().contiguous(), rays.directions.float().contiguous(), directions.float().contiguous())


def optimise(
    o: Optimiser,
    targets: Targets,
    *,
    until: int,
    steps: int,
    rays: int,
    density_rate: float,
    colour_rate: float,
    final: float,
    seed: int,
    view_share: float = 1.0,
) -> Iterator[float]:
    """See `efficientnerf.asset.refinement.optimise`. Steps are counted as soon as they are launched; the error is that of LAG steps before."""
    assert isinstance(targets.pixels, DevicePixels)
    o.fetch()
    o.away = fit = DeviceFit(o, targets.pixels.device)
    pending: deque[tuple[Tensor, Any]] = deque()
    error = None
    while o.step < until:
        number = o.step + 1
        origins, directions, seen = targets.draw(rays, randomness(seed, number))
        fall = final ** (number / steps)
        loss = fit.step(number, rays_in_voxels(o.tree, origins, directions), seen, density_rate * fall, colour_rate * fall, view_share)
        pending.append(to_host_async(loss.mean() / 3))
        o.step = number
        if error is None or len(pending) > LAG:
            value, arrived = pending.popleft()
            if arrived is not None:
                arrived.synchronize()
            error = float(value)
        yield error


def values_of(tree: NerfTree, device: torch.device) -> tuple[DeviceGrid, Tensor, Tensor]:
    """Where a tree's voxels lie, their density (N,) and harmonics (N, 3 K)."""
    density, sh = (np.array(values, np.float32) for values in (tree.density_values, tree.sh.reshape(len(tree.sh), 3 * tree.harmonics_count)))
    return device_grid(tree, device), torch.from_numpy(density).to(device), torch.from_numpy(sh).to(device)


def total_loss(tree: NerfTree, targets: Targets, bundles: Iterable[Bundle]) -> float:
    """Sum over the rays of the bundles."""
    assert isinstance(targets.pixels, DevicePixels)
    grid, density, sh = values_of(tree, targets.pixels.device)
    total = torch.zeros((), dtype=torch.float64, device=density.device)
    for origins, directions, seen in bundles:
        loss, _, _ = tree_gradients.loss_and_gradients(*tree_gradients.forward(grid, rays_in_voxels(tree, origins, directions), density, sh), seen)
        total += loss.double().sum()
    return float(total)


def greatest_weights(tree: NerfTree, targets: Targets, bundles: Iterable[Bundle]) -> np.ndarray:
    """(N,) over the rays of the bundles."""
    assert isinstance(targets.pixels, DevicePixels)
    grid, density, _ = values_of(tree, targets.pixels.device)
    greatest = torch.zeros_like(density)
    for origins, directions, seen in bundles:
        tree_gradients.max_contributions(grid, rays_in_voxels(tree, origins, directions), density, seen.transmittance.contiguous(), greatest)
    return greatest.cpu().numpy()
