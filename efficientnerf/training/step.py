"""One step of training: what the host draws for it, and what follows from that on the model's device. R rays, A rays to sparse points."""

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from efficientnerf.model import Model, RayOutputs, render_rays
from efficientnerf.sampling.samples import SampleCapacity, complete_rays
from efficientnerf.training.batch import DrawnRays, drawn_rays, ray_batch
from efficientnerf.training.device_pixels import DevicePixels, on_host
from efficientnerf.training.exposure.model import Exposure, exposure_loss, places
from efficientnerf.training.losses import colour_losses, mean_over, scale_gradients_by_distance
from efficientnerf.training.occupancy_update import update_on_rays
from efficientnerf.training.optimiser import Adam, StepSize
from efficientnerf.training.pixels import Pixels
from efficientnerf.training.sparse_depth import RAYS_PER_RAY, AimedRays, SparseDepthRays, aimed_rays, sparse_depth_loss


class StepInputs(NamedTuple):
    """What is drawn for a step: arrays of the host, or tensors of a device."""

    rays: DrawnRays
    place: Any = None  # photograph (R,) and r^2 (R,) of each ray, `efficientnerf.training.exposure.model.places`, where exposures are known
    aimed: AimedRays | None = None
    explored: Tensor | None = None  # see `efficientnerf.sampling.strategies.SamplingRequest`


class StepNumbers(NamedTuple):
    """Numbers that change from step to step: floats, or tensors () on a device."""

    size: StepSize
    # weights of losses
    distortion: Any
    sparse_depth: Any


class StepPlan(NamedTuple):
    """What a step does besides; the steps of a training have few different ones."""

    prune: bool
    samples_per_pivot: int
    capacity: SampleCapacity | None  # None: samples are counted
    learns_exposure: bool


@dataclass(frozen=True, eq=False)
class Learner:
    """What steps read and change."""

    model: Model
    adam: Adam
    pixels: Pixels | DevicePixels
    exposure: Exposure | None


def drawn_step(learner: Learner, sparse_depth: SparseDepthRays | None, count: int, rng: np.random.Generator, *, crop: bool) -> StepInputs:
    """Rays through `count` pixels, with `crop` of the middle of the images, and rays to sparse points, where there are some."""
    rays = drawn_rays(learner.model, learner.pixels, count, rng, crop=crop)
    aimed = None if sparse_depth is None else aimed_rays(sparse_depth, max(1, count // RAYS_PER_RAY), rng)
    return StepInputs(rays, None if learner.exposure is None else places(on_host(learner.pixels), rays.pixel), aimed)


def step_on_rays(learner: Learner, plan: StepPlan, inputs: StepInputs, numbers: StepNumbers, rng: np.random.Generator) -> tuple[Tensor, RayOutputs]:
    """The step, but for `efficientnerf.training.occupancy_update.update_in_turn`: mean squared error of the fine colours, and the rays before the step.

    inputs  tensors on the model's device
    rng     of strategies that draw as they sample
    """
    m = learner.model
    batch = ray_batch(m, learner.pixels, inputs.rays)
    count, aimed = len(batch.origins), inputs.aimed
    bundle = batch[:6] if aimed is None else tuple(torch.cat(pair) for pair in zip(batch[:6], aimed.bundle, strict=True))
    outputs = render_rays(m, *bundle, prune=plan.prune, rng=rng, capacity=plan.capacity, samples_per_pivot=plan.samples_per_pivot, explored=inputs.explored)
    fitting = complete_rays(outputs.coarse, outputs.fine)
    complete = None if fitting is None else fitting[:count]
    exposure = learner.exposure if learner.exposure is None or plan.learns_exposure else learner.exposure.detached
    fine_loss, coarse_loss = colour_losses(outputs, batch.colour, complete, inputs.place, exposure)
    loss = fine_loss if coarse_loss is None else fine_loss + coarse_loss  # weighted equally, as in the authors' release
    if exposure is not None:
        loss = loss + exposure_loss(exposure)
    if m.space.unbounded:
        loss = loss + numbers.distortion * mean_over(outputs.distortion[:count], complete)
    if m.space.contracted:
        scale_gradients_by_distance(m, batch.origins, outputs)
    if aimed is not None:
        loss = loss + numbers.sparse_depth * sparse_depth_loss(outputs, aimed.distance, aimed.on_support, plan.samples_per_pivot, fitting)
    loss.backward()
    learner.adam.step(numbers.size)
    update_on_rays(m, outputs, padded=plan.capacity is not None)
    return fine_loss.detach(), outputs
