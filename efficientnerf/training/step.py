"""One step of training: what the host draws for it, and what follows from that on the model's device. R rays, A rays to sparse points."""

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from efficientnerf.model import Model, RayOutputs, render_rays
from efficientnerf.sampling.samples import SampleCapacity, complete_rays
from efficientnerf.training.device_pixels import DevicePixels, on_host
from efficientnerf.training.exposure.model import Exposure, exposure_loss, places
from efficientnerf.training.losses import colour_losses, crosses_box, mean_over, scale_gradients_by_distance
from efficientnerf.training.occupancy_update import update_on_rays
from efficientnerf.training.optimiser import Adam, StepSize
from efficientnerf.training.pixels import Pixels
from efficientnerf.training.plain_regions import RAYS_PER_TRIPLE, PlainDiscs, PlainTriples, drawn_triples, plain_loss
from efficientnerf.training.settings import TrainSettings
from efficientnerf.training.sparse_depth import RAYS_PER_RAY, AimedRays, SparseDepthRays, aimed_rays, sparse_depth_loss

MIN_RAYS = 64  # of a step


class DrawnRays(NamedTuple):
    """What the rays of a step are made from: arrays of the host, or tensors of a device."""

    pixel: Any  # (R,) int64 indices
    offset: Any  # (R,) float32 of samples in their intervals
    behind: Any = None  # (R, 3) float32 random colours behind the scene, where there are
    colour: Any = None  # (R, 3 or 4) uint8, where images are not on the device


class StepInputs(NamedTuple):
    """What is drawn for a step: arrays of the host, or tensors of a device."""

    rays: DrawnRays
    place: Any = None  # photograph (R,) and r^2 (R,) of each ray, `efficientnerf.training.exposure.model.places`, where exposures are known
    aimed: AimedRays | None = None
    plain: PlainTriples | None = None
    explored: Tensor | None = None  # see `efficientnerf.sampling.strategies.SamplingRequest`


class StepNumbers(NamedTuple):
    """Numbers that change from step to step: floats, or tensors () on a device."""

    size: StepSize
    # weights of losses
    distortion: Any
    sparse_depth: Any
    plain: Any


class StepPlan(NamedTuple):
    """What a step does besides; the steps of a training have few different ones."""

    prune: bool
    samples_per_pivot: int
    capacity: SampleCapacity | None  # None: samples are counted
    learns_exposure: bool
    spares_highlights: bool


@dataclass(frozen=True, eq=False)
class Learner:
    """What steps read and change."""

    model: Model
    adam: Adam
    pixels: Pixels | DevicePixels
    exposure: Exposure | None


def ray_count(settings: TrainSettings, samples_per_ray: float) -> int:
    """Rays of a step: as many as have about `train.sample_batch_size` samples."""
    if settings.sample_batch_size == "off":
        return settings.max_rays_per_batch
    return int(min(settings.max_rays_per_batch, max(MIN_RAYS, settings.sample_batch_size / samples_per_ray)))


def drawn_rays(
    m: Model, pixels: Pixels | DevicePixels, count: int, rng: np.random.Generator, *, crop: bool, plain: PlainDiscs | None = None
) -> tuple[DrawnRays, PlainTriples | None]:
    """`count` random pixels, with `crop` of the middle of the images; the first of them are triples of plain regions, where there are some."""
    host, behind, triples = on_host(pixels), None, None
    pixel, offset = host.choose(count, rng, middle=crop), rng.random(count, np.float32)
    if plain is not None:
        first, triples = drawn_triples(plain, host, count // RAYS_PER_TRIPLE, rng)
        pixel = np.concatenate([first, pixel[len(first) :]])
    if m.space.reaches_infinity and m.background is None:
        # Behind a space that reaches to infinity nothing lies: a random colour for each ray keeps the field from staying half transparent.
        behind = rng.random((count, 3), np.float32)
    if host.images.shape[1] == 4 and (m.settings.background_color == "random" or m.background is None):
        # Behind an object with alpha anything may lie: a random colour for each ray keeps the field from learning one.
        behind = rng.random((count, 3), np.float32)
    return DrawnRays(pixel, offset, behind, pixels.colours_to_send(pixel) if isinstance(pixels, DevicePixels) else None), triples


def drawn_step(
    learner: Learner, sparse_depth: SparseDepthRays | None, plain: PlainDiscs | None, count: int, rng: np.random.Generator, *, crop: bool
) -> StepInputs:
    """Rays through `count` pixels, as `drawn_rays`, and rays to sparse points, where there are some."""
    rays, triples = drawn_rays(learner.model, learner.pixels, count, rng, crop=crop, plain=plain)
    aimed = None if sparse_depth is None else aimed_rays(sparse_depth, max(1, count // RAYS_PER_RAY), rng)
    return StepInputs(rays, None if learner.exposure is None else places(on_host(learner.pixels), rays.pixel), aimed, triples)


def build_rays(m: Model, pixels: Pixels | DevicePixels, drawn: DrawnRays) -> tuple[tuple[Tensor, ...], Tensor]:
    """Of `drawn`, which is on the model's device: origins (R, 3), directions (R, 3), near (R,), far (R,), offset (R,) and the colours behind (R, 3) for
    `render_rays`; and the colours (R, 3) of the photographs, over the latter where they have alpha."""
    if isinstance(pixels, DevicePixels):
        origins, directions, near, far, colour = pixels.bundle_at(drawn.pixel, drawn.colour)
    else:
        origins, directions, near, far, colour = (torch.as_tensor(a, device=m.device) for a in pixels.bundle(drawn.pixel.cpu().numpy()))
    behind = m.behind(directions) if drawn.behind is None else drawn.behind
    if colour.shape[1] == 4:
        colour = colour[:, :3] * colour[:, 3:] + behind * (1 - colour[:, 3:])
    return (origins, directions, near, far, drawn.offset, behind), colour


def step_on_rays(learner: Learner, plan: StepPlan, inputs: StepInputs, numbers: StepNumbers, rng: np.random.Generator) -> tuple[Tensor, RayOutputs]:
    """The step, but for `efficientnerf.training.occupancy_update.update_in_turn`: the first of `colour_losses`, and the rays before the step.

    inputs  tensors on the model's device
    rng     of strategies that draw as they sample
    """
    m = learner.model
    bundle, colour = build_rays(m, learner.pixels, inputs.rays)
    origins, aimed = bundle[0], inputs.aimed
    count = len(origins)
    bundle = bundle if aimed is None else tuple(torch.cat(pair) for pair in zip(bundle, aimed.bundle, strict=True))
    outputs = render_rays(m, *bundle, prune=plan.prune, rng=rng, capacity=plan.capacity, samples_per_pivot=plan.samples_per_pivot, explored=inputs.explored)
    fitting = complete_rays(outputs.coarse, outputs.fine)
    complete = None if fitting is None else fitting[:count]
    exposure = learner.exposure if learner.exposure is None or plan.learns_exposure else learner.exposure.detached
    highlights = (crosses_box(m, origins, bundle[1][:count]), m.settings.highlight_loss_weight) if plan.spares_highlights else None
    fine_loss, coarse_loss = colour_losses(outputs, colour, complete, inputs.place, exposure, highlights)
    loss = fine_loss if coarse_loss is None else fine_loss + coarse_loss  # weighted equally, as in the authors' release
    if exposure is not None:
        loss = loss + exposure_loss(exposure)
    if m.space.unbounded:
        loss = loss + numbers.distortion * mean_over(outputs.distortion[:count], complete)
    if m.space.contracted:
        scale_gradients_by_distance(m, origins, outputs)
    if inputs.plain is not None:
        loss = loss + numbers.plain * plain_loss(m, outputs, origins, bundle[1], inputs.plain, complete)
    if aimed is not None:
        loss = loss + numbers.sparse_depth * sparse_depth_loss(outputs, aimed.distance, aimed.on_support, plan.samples_per_pivot, fitting)
    loss.backward()
    learner.adam.step(numbers.size)
    update_on_rays(m, outputs, padded=plan.capacity is not None)
    return fine_loss.detach(), outputs
