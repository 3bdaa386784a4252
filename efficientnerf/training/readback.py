"""Training without waiting for the device: the counts of a step are read back some steps later, and the capacity for its samples is estimated.

A host that asks a device for a number waits until all that it has launched is done, and the device then idles until the host has launched more. The
number of samples of a bundle is such a number. So once the averages are known a step has a capacity of MARGIN times as many samples as rays had in the
steps before (those of unpruned rays among them, `train.occupancy_update_ray_fraction`, which come first and so always fit). Rays whose samples do not fit
are left out of the loss and counted, which is rare. The counts and losses of a step are read LAG steps after it.
"""

from collections import deque
from typing import Any, NamedTuple

import torch
from torch import Tensor

from efficientnerf.backends.transfer import to_host_async
from efficientnerf.model import RayOutputs
from efficientnerf.sampling.occupancy import DensityVoxels
from efficientnerf.sampling.samples import SampleCapacity, complete_rays

LAG = 8  # steps; the device is hardly ever further behind
EXACT_STEPS = 64  # steps at the beginning, and when pruning begins, that are counted exactly, which the host waits for
MARGIN = 1.3
MIN_HELD, MAX_HELD = 1.2, 1.5  # a capacity of so many times as many stays, so that steps have few different ones
GRANULARITY = 4096  # samples: the allocator finds arrays of few different sizes again


class StepCounts(NamedTuple):
    """Statistics of a step: mean squared error; coarse intervals tried, valid and pivotal samples, fine samples; rays left out of the loss."""

    loss: float
    tried: int
    valid: int
    pivotal: int
    fine: int
    left_out: int = 0


def counts_of(loss: Tensor, outputs: RayOutputs) -> Tensor:
    """(8,) float64, on the device: the numbers of StepCounts, and how many rays have all of their samples."""
    coarse, fine = outputs.coarse, outputs.fine
    # Numbers that the host has are filled in on the device: sending one makes it wait.
    tried, every = (x if isinstance(x, Tensor) else torch.full((), x, device=loss.device) for x in (coarse.tried, len(outputs.fine_opacity)))
    real = torch.arange(len(outputs.pivotal), device=loss.device) < coarse.first[-1]  # exploration may have chosen padding
    masks = coarse.complete, complete_rays(coarse, fine)
    complete = [every if mask is None else mask.sum() for mask in masks]
    return torch.stack([x.double() for x in (loss, tried, coarse.first[-1], (outputs.pivotal & real).sum(), fine.first[-1], every, *complete)])


class AsyncReadback:
    """The counts of the last steps, on their way to the host; arguments: see the module."""

    def __init__(self, *, lag: int = LAG, exact_steps: int = EXACT_STEPS, granularity: int = GRANULARITY) -> None:
        self.lag, self.exact_steps, self.granularity = lag, exact_steps, granularity
        self.steps = 0
        self.pending: deque[tuple[Tensor, Any]] = deque()
        self.known = StepCounts(0.0, 0, 0, 0, 0)
        self.valid_per_ray = self.fine_per_ray = 0.0
        self.held = SampleCapacity(0, 0)

    def capacity(self, rays: int) -> SampleCapacity | None:
        """Of the next step; None while the averages are not known: then samples are counted, and waited for."""
        if self.steps < self.exact_steps:
            return None
        means, size = (self.valid_per_ray, self.fine_per_ray), self.granularity
        if not all(MIN_HELD * mean * rays <= held <= size + MAX_HELD * mean * rays for mean, held in zip(means, self.held, strict=True)):
            self.held = SampleCapacity(*(max(size, -(-int(MARGIN * mean * rays) // size) * size) for mean in means))
        return self.held

    def restart(self) -> None:
        """Count exactly again: the number of samples on a ray changes."""
        self.steps, self.valid_per_ray, self.fine_per_ray = 0, 0.0, 0.0

    def record(self, numbers: Tensor) -> StepCounts:
        """Start the transfer of a step's `counts_of`; returns the latest that have arrived: the step's own at first, later those of `lag` steps ago."""
        self.pending.append(to_host_async(numbers))
        self.steps += 1
        while len(self.pending) > (0 if self.steps < self.exact_steps else self.lag):
            arrived_numbers, arrived = self.pending.popleft()
            if arrived is not None:
                arrived.synchronize()
            loss, *counts = arrived_numbers.tolist()
            *counts, rays, coarse_complete, complete = (int(n) for n in counts)
            self.known = StepCounts._make([loss, *counts, rays - complete])
            share = 1.0 if self.valid_per_ray == self.fine_per_ray == 0 else 0.1
            # Samples that did not fit are not counted: these are means over the rays whose samples did.
            self.valid_per_ray += share * (self.known.valid / max(coarse_complete, 1) - self.valid_per_ray)
            self.fine_per_ray += share * (self.known.fine / max(complete, 1) - self.fine_per_ray)
        return self.known


class AsyncOccupancy:
    """The fraction of valid voxels, for a log: on a device, as it was at the last call (at the first call, as it is)."""

    def __init__(self, voxels: DensityVoxels) -> None:
        self.voxels = voxels
        self.pending: tuple[Tensor, Any] | None = None

    def __call__(self) -> float:
        started = to_host_async(self.voxels.count_occupied())
        number, arrived = started if self.pending is None or started[1] is None else self.pending
        self.pending = started
        if arrived is not None:
            arrived.synchronize()
        return int(number) / self.voxels.values.numel()
