"""Which samples of a bundle the two fields are evaluated at: one class for each sampling strategy.

    Efficient     valid samples through the coarse field, pivotal ones through the fine field (EfficientNeRF)
    Valid         valid samples, then importance samples of the fine field
    Hierarchical  stratified samples, then importance samples of the fine field (NeRF)
    Uniform       stratified samples of the fine field alone

`prunes` says whether a strategy uses the density voxels; `coarse` gives the coarse samples, and `fine`, by the weights (N,) of these without gradient, which
of them are pivotal (N,) bool, and the fine samples. `Uniform` has `samples` alone.

R rays, N coarse samples.
"""

import math
from dataclasses import dataclass
from typing import ClassVar, NamedTuple

import numpy as np
import torch
from torch import Tensor

from efficientnerf.backends import dispatch
from efficientnerf.backends.transfer import to_device
from efficientnerf.geometry.spaces import RayBundle, Space
from efficientnerf.rendering.compositing import ray_of_sample
from efficientnerf.sampling.hierarchical import importance_samples, stratified_samples
from efficientnerf.sampling.occupancy import DensityVoxels
from efficientnerf.sampling.samples import SampleCapacity, Samples


class SamplingRequest(NamedTuple):
    """A bundle of rays to be sampled."""

    rays: RayBundle  # in the frame of the space
    offset: Tensor  # (R,) in [0, 1): where in its interval a sample lies
    samples_per_pivot: int  # N_s
    prune: bool = True  # whether the density voxels are used (not in the warm-up)
    rng: np.random.Generator | None = None  # in training: for jitter, exploration and rays that are not pruned; None: nothing is random
    capacity: SampleCapacity | None = None  # on CUDA: samples are padded to this many, and their number is not waited for; None: no padding
    explored: Tensor | None = None  # (capacity.coarse,) bool, see `Efficient.explored`


class CoarseStage(NamedTuple):
    """Coarse samples, and their distances along the rays (N,) where these are not at the bundle's offsets."""

    samples: Samples
    distance: Tensor | None = None


@dataclass(frozen=True)
class Intervals:
    """How rays are cut into coarse intervals."""

    space: Space
    voxels: DensityVoxels
    step: float  # length of an interval in the box, units of the frame
    max_intervals: int  # intervals on a ray at most
    count: int  # N_c
    within_planes: bool  # whether they run from near to far plane instead of through the box
    keep_outside: bool  # whether samples outside of the space are kept: a network can be evaluated there, a hash grid cannot

    def valid(self, request: SamplingRequest, unpruned_fraction: float) -> Samples:
        """Coarse samples in valid voxels; in training, all samples of a fraction of the rays: the first ones, which are as random as any."""
        threshold = self.voxels.threshold if request.prune else -math.inf
        unpruned = math.ceil(unpruned_fraction * len(request.offset)) if request.rng is not None else 0
        capacity = None if request.capacity is None else request.capacity.coarse
        bundle = (*request.rays[:4], request.offset)
        return dispatch.valid_samples(self.space, *bundle, self.step, self.max_intervals, self.voxels.values, threshold, capacity, unpruned=unpruned)

    def stratified(self, request: SamplingRequest, count: int, capacity: int | None) -> CoarseStage:
        """`count` samples between near and far, or between where the ray enters the box and leaves it, whatever the density voxels hold."""
        origins, directions, near, far = request.rays[:4]
        if self.space.contracted:  # intervals that grow with the distance, all of them
            step, max_intervals = self.step * self.count / count, math.ceil(self.max_intervals * count / self.count)
            bundle = (origins, directions, near, far, request.offset)
            samples = dispatch.valid_samples(self.space, *bundle, step, max_intervals, self.voxels.values, -math.inf, capacity)
            return CoarseStage(samples, distances_at(samples, request.offset))
        if not self.within_planes:
            near, far = self.space.clip(origins, directions, near, far)
        jitter = request.offset[:, None].expand(-1, count)
        if request.rng is not None:
            jitter = to_device(torch.from_numpy(request.rng.random((len(origins), count), np.float32)), request.offset.device)
        return CoarseStage(*stratified_samples(self.space, origins, directions, near, far, jitter, outside=self.keep_outside, capacity=capacity))


@dataclass(frozen=True)
class Efficient:
    """Valid, then pivotal samples (EfficientNeRF, sections 3.3 and 3.4)."""

    prunes: ClassVar[bool] = True
    intervals: Intervals
    pivotal_threshold: float
    max_pivots: int
    # in training: of the valid intervals without a pivot, these get fine samples too. Otherwise the fine field would be free to place density where this ray
    # has no pivot and another has one, and the baked asset, which has no coarse field, would show it.
    exploration_fraction: float
    unpruned_fraction: float  # in training: of the rays, these are sampled in invalid voxels too

    def explored(self, capacity: SampleCapacity | None, rng: np.random.Generator, device: torch.device) -> Tensor | None:
        """Which coarse samples are explored, drawn before the step where their number is known; else None, and they are drawn in it."""
        return None if capacity is None or self.exploration_fraction == 0 else _random_mask(capacity.coarse, self.exploration_fraction, rng, device)

    def coarse(self, request: SamplingRequest) -> CoarseStage:
        return CoarseStage(self.intervals.valid(request, self.unpruned_fraction))

    def fine(self, request: SamplingRequest, coarse: CoarseStage, weight: Tensor) -> tuple[Tensor, Samples]:
        pivotal = dispatch.select_pivots(weight, coarse.samples.first, self.pivotal_threshold, self.max_pivots)
        if request.explored is not None:
            pivotal = pivotal | request.explored
        elif request.rng is not None and self.exploration_fraction > 0:
            pivotal = pivotal | _random_mask(len(pivotal), self.exploration_fraction, request.rng, pivotal.device)
        capacity = None if request.capacity is None else request.capacity.fine
        bundle = (request.rays.origins, request.rays.directions, request.offset)
        return pivotal, dispatch.pivotal_samples(self.intervals.space, *bundle, coarse.samples, pivotal, request.samples_per_pivot, capacity)


@dataclass(frozen=True)
class _ImportanceSampled:
    """Importance samples of the fine field; pivots are counted only."""

    intervals: Intervals
    pivotal_threshold: float
    max_pivots: int
    num_importance_samples: int

    def fine(self, request: SamplingRequest, coarse: CoarseStage, weight: Tensor) -> tuple[Tensor, Samples]:
        pivotal = dispatch.select_pivots(weight, coarse.samples.first, self.pivotal_threshold, self.max_pivots)
        shape = len(request.offset), self.num_importance_samples
        within = torch.full(shape, 0.5) if request.rng is None else torch.from_numpy(request.rng.random(shape, np.float32))
        # One in each of as many equal parts of [0, 1]: random in training, the middles in rendering.
        quantile = to_device((torch.arange(shape[1]) + within) / shape[1], request.offset.device)
        distance = distances_at(coarse.samples, request.offset) if coarse.distance is None else coarse.distance
        capacity = None if request.capacity is None else request.capacity.fine
        rays = (request.rays.origins, request.rays.directions)
        return pivotal, importance_samples(self.intervals.space, *rays, coarse.samples, distance, weight, quantile, capacity)


@dataclass(frozen=True)
class Valid(_ImportanceSampled):
    """Valid samples, then importance samples; `unpruned_fraction` as for `Efficient`."""

    prunes: ClassVar[bool] = True
    unpruned_fraction: float

    def coarse(self, request: SamplingRequest) -> CoarseStage:
        return CoarseStage(self.intervals.valid(request, self.unpruned_fraction))


class Hierarchical(_ImportanceSampled):
    """Stratified samples, then importance samples (NeRF, section 5.2)."""

    prunes: ClassVar[bool] = False

    def coarse(self, request: SamplingRequest) -> CoarseStage:
        return self.intervals.stratified(request, self.intervals.count, None if request.capacity is None else request.capacity.coarse)


@dataclass(frozen=True)
class Uniform:
    """N_c and num_importance_samples stratified samples of the fine field, and no coarse stage."""

    prunes: ClassVar[bool] = False
    intervals: Intervals
    num_importance_samples: int

    def samples(self, request: SamplingRequest) -> Samples:
        capacity = None if request.capacity is None else request.capacity.fine
        return self.intervals.stratified(request, self.intervals.count + self.num_importance_samples, capacity).samples


Strategy = Efficient | Valid | Hierarchical | Uniform


def distances_at(samples: Samples, offset: Tensor) -> Tensor:
    """(N,) distances of samples that lie at `offset` (R,) in their intervals."""
    return samples.start + offset[ray_of_sample(samples.first, len(samples.start))] * samples.extent


def _random_mask(count: int, fraction: float, rng: np.random.Generator, device: torch.device) -> Tensor:
    """(count,) bool, about `fraction` of them; drawn on the device where there is one, since sending them takes longer."""
    if device.type == "cuda":
        generator = torch.Generator(device).manual_seed(int(rng.integers(2**62)))
        return torch.rand(count, generator=generator, device=device) < fraction
    return torch.from_numpy(rng.random(count, np.float32) < fraction)
