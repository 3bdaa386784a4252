"""Training without waiting for the device: what a step counted there is learned some steps later, and room for its samples is made by experience.

A host that asks a device for a number waits until all that it has launched is done, and the device then idles until the host has launched more. How
many samples a bundle has is such a number. So once the averages have settled a step makes room for MARGIN times as many samples as rays had of late;
rays that find no room are left out of the loss, which is rare, and the counts and losses of a step are read LAG steps after it.
"""

from __future__ import annotations

from collections import deque
from typing import Any, NamedTuple

import torch
from torch import Tensor

from efficientnerf.sampling import Samples
from efficientnerf.transfer import fetched

LAG = 8  # steps; the device is hardly ever further behind
SETTLED = 64  # steps at the beginning of a run that are counted exactly, at the price of waiting
MARGIN = 1.3
GRAIN = 4096  # samples: arrays of few different sizes are found again by the allocator


class Room(NamedTuple):
    """For how many samples there is room in each stage."""

    coarse: int
    fine: int


class Counted(NamedTuple):
    """What a step said: mean squared error; coarse intervals tried, valid and pivotal samples, fine samples."""

    loss: float
    tried: int
    valid: int
    pivotal: int
    fine: int


class Late:
    """The counts of the last steps, on their way to the host."""

    def __init__(self) -> None:
        self.steps = 0
        self.pending: deque[tuple[Tensor, int, Any]] = deque()
        self.known = Counted(0.0, 0, 0, 0, 0)
        self.valid_per_ray = self.fine_per_ray = 0.0

    def room(self, rays: int) -> Room | None:
        """For the next step's samples; None while nothing is known: then they are counted, and waited for."""
        if self.steps < SETTLED:
            return None
        coarse, fine = (max(GRAIN, -(-int(MARGIN * mean * rays) // GRAIN) * GRAIN) for mean in (self.valid_per_ray, self.fine_per_ray))
        return Room(coarse, fine)

    def note(self, rays: int, loss: Tensor, coarse: Samples, pivotal: Tensor, fine: Samples) -> Counted:
        """Send a step's counts on their way; returns the latest that have arrived: the step's own at first, later those of LAG steps ago."""
        tried = torch.as_tensor(coarse.tried, device=loss.device)
        real = torch.arange(len(pivotal), device=loss.device) < coarse.first[-1]  # padding may have been chosen by chance
        numbers = torch.stack([x.detach().double() for x in (loss, tried, coarse.first[-1], (pivotal & real).sum(), fine.first[-1])])
        numbers, arrived = fetched(numbers)
        self.pending.append((numbers, rays, arrived))
        self.steps += 1
        while len(self.pending) > (0 if self.steps < SETTLED else LAG):
            self._take(*self.pending.popleft())
        return self.known

    def _take(self, numbers: Tensor, rays: int, arrived: Any) -> None:
        if arrived is not None:
            arrived.synchronize()
        loss, *counts = numbers.tolist()
        self.known = Counted(loss, *(int(n) for n in counts))
        share = 1.0 if self.valid_per_ray == 0 else 0.1
        self.valid_per_ray += share * (self.known.valid / rays - self.valid_per_ray)
        self.fine_per_ray += share * (self.known.fine / rays - self.fine_per_ray)


def whole_rays(coarse: Samples, fine: Samples, room: Room) -> Tensor:
    """(R,) bool: rays that found room for all of their samples."""
    return (coarse.first[1:] < room.coarse) & (fine.first[1:] < room.fine)


def mean_over(values: Tensor, rays: Tensor | None) -> Tensor:
    """Mean of values (R, ...) over some rays (R,) bool, or over all."""
    if rays is None:
        return values.mean()
    per_ray = values.reshape(len(values), -1).mean(dim=1)
    # A product would let through what is no number.
    return torch.where(rays, per_ray, 0).sum() / rays.sum().clamp(min=1)
