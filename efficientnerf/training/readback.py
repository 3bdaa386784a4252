"""Training without waiting for the device: what a step counted there is learned some steps later, and room for its samples is made by experience.

A host that asks a device for a number waits until all that it has launched is done, and the device then idles until the host has launched more. How
many samples a bundle has is such a number. So once the averages have settled a step makes room for MARGIN times as many samples as rays had of late
(those that are looked at whole among them, `train.occupancy_update_ray_fraction`, which come first and so find room first); rays that find no room
are left out of the
loss and counted, which is rare, and the counts and losses of a step are read LAG steps after it.
"""

from __future__ import annotations

from collections import deque
from typing import Any, NamedTuple

import torch
from torch import Tensor

from efficientnerf.backends.transfer import to_host_async
from efficientnerf.sampling.occupancy import DensityVoxels
from efficientnerf.sampling.samples import Samples

LAG = 8  # steps; the device is hardly ever further behind
SETTLED = 64  # steps at the beginning, and when pruning begins, that are counted exactly, at the price of waiting
MARGIN = 1.3
GRAIN = 4096  # samples: arrays of few different sizes are found again by the allocator


class SampleCapacity(NamedTuple):
    """For how many samples there is room in each stage."""

    coarse: int
    fine: int


class StepCounts(NamedTuple):
    """What a step said: mean squared error; coarse intervals tried, valid and pivotal samples, fine samples; rays left out of the loss."""

    loss: float
    tried: int
    valid: int
    pivotal: int
    fine: int
    left_out: int = 0


class AsyncReadback:
    """The counts of the last steps, on their way to the host."""

    def __init__(self) -> None:
        self.steps = 0
        self.pending: deque[tuple[Tensor, Any]] = deque()
        self.known = StepCounts(0.0, 0, 0, 0, 0)
        self.valid_per_ray = self.fine_per_ray = 0.0

    def room(self, rays: int) -> SampleCapacity | None:
        """For the next step's samples; None while nothing is known: then they are counted, and waited for."""
        if self.steps < SETTLED:
            return None
        coarse, fine = (max(GRAIN, -(-int(MARGIN * mean * rays) // GRAIN) * GRAIN) for mean in (self.valid_per_ray, self.fine_per_ray))
        return SampleCapacity(coarse, fine)

    def forget(self) -> None:
        """Count anew: rays will need other numbers of samples than so far."""
        self.steps, self.valid_per_ray, self.fine_per_ray = 0, 0.0, 0.0

    def note(self, rays: int, loss: Tensor, coarse: Samples, pivotal: Tensor, fine: Samples) -> StepCounts:
        """Send a step's counts on their way; returns the latest that have arrived: the step's own at first, later those of LAG steps ago."""
        # Numbers that the host has are filled in on the device: sending one makes it wait.
        tried, every = (x if isinstance(x, Tensor) else torch.full((), x, device=loss.device) for x in (coarse.tried, rays))
        real = torch.arange(len(pivotal), device=loss.device) < coarse.first[-1]  # padding may have been chosen by chance
        served, whole = coarse.complete, whole_rays(coarse, fine)
        found_room = [every if some is None else some.sum() for some in (served, whole)]
        numbers = torch.stack([x.detach().double() for x in (loss, tried, coarse.first[-1], (pivotal & real).sum(), fine.first[-1], every, *found_room)])
        self.pending.append(to_host_async(numbers))
        self.steps += 1
        while len(self.pending) > (0 if self.steps < SETTLED else LAG):
            self._take(*self.pending.popleft())
        return self.known

    def _take(self, numbers: Tensor, arrived: Any) -> None:
        if arrived is not None:
            arrived.synchronize()
        loss, *counts = numbers.tolist()
        *counts, rays, served, whole = (int(n) for n in counts)
        self.known = StepCounts._make([loss, *counts, rays - whole])
        share = 1.0 if self.valid_per_ray == self.fine_per_ray == 0 else 0.1
        # Samples that found no room are not counted: what is known is how many each of those rays has that were served.
        self.valid_per_ray += share * (self.known.valid / max(served, 1) - self.valid_per_ray)
        self.fine_per_ray += share * (self.known.fine / max(whole, 1) - self.fine_per_ray)


class AsyncOccupancy:
    """The share of valid voxels for those who show it now and then: on a device, as it was when it was last asked for (the first time, as it is)."""

    def __init__(self, voxels: DensityVoxels) -> None:
        self.voxels = voxels
        self.pending: tuple[Tensor, Any] | None = None

    def __call__(self) -> float:
        asked = to_host_async(self.voxels.count_occupied())
        number, arrived = asked if self.pending is None or asked[1] is None else self.pending
        self.pending = asked
        if arrived is not None:
            arrived.synchronize()
        return int(number) / self.voxels.values.numel()


def whole_rays(coarse: Samples, fine: Samples) -> Tensor | None:
    """(R,) bool: rays that found room for all of their samples; None: all did."""
    if coarse.complete is None or fine.complete is None:
        return fine.complete if coarse.complete is None else coarse.complete
    return coarse.complete & fine.complete


def mean_over(values: Tensor, rays: Tensor | None) -> Tensor:
    """Mean of values (R, ...) over some rays (R,) bool, or over all."""
    if rays is None:
        return values.mean()
    per_ray = values.reshape(len(values), -1).mean(dim=1)
    # A product would let through what is no number.
    return torch.where(rays, per_ray, 0).sum() / rays.sum().clamp(min=1)
