"""Training: one flat loop.

Every random choice of step n is drawn from a generator seeded by (seed, n), so that a resumed run makes the choices of an uninterrupted one without
any state to restore. What is restored: parameters, Adam's moments, density voxels, the running average that sets the number of rays.

On a CPU the same seed gives the same bytes with the same number of threads of torch. Our own kernels, the hash field's network among them, do not
depend on the number; matrix products of the paper's networks (oneDNN, MKL) may sum in another order with another one. Either are in bfloat16 only where the
processor supports it, so that another machine's result differs, at the same quality.

R rays, A rays to sparse points, C views.
"""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from efficientnerf import model as models
from efficientnerf.backends import dispatch
from efficientnerf.geometry.cameras import Camera
from efficientnerf.model import Model, RayOutputs, render_rays
from efficientnerf.sampling.samples import complete_rays
from efficientnerf.training.batch import ray_batch, ray_count
from efficientnerf.training.device_pixels import DevicePixels
from efficientnerf.training.exposure.model import Exposure, exposure_loss, is_learned, places
from efficientnerf.training.losses import colour_losses, distortion_loss, scale_gradients_by_distance
from efficientnerf.training.occupancy_update import update_occupancy
from efficientnerf.training.optimiser import Adam, ParameterGroup, parameter_groups
from efficientnerf.training.pixels import Pixels
from efficientnerf.training.readback import AsyncReadback, StepCounts
from efficientnerf.training.schedule import Schedule, schedule_of
from efficientnerf.training.sparse_depth import RAYS_PER_RAY, SparseDepthRays, aimed_rays, sparse_depth_loss, sparse_depth_weight
from efficientnerf.training.view_checks.checks import ViewChecks, follow_checks

MAX_STEPS = 2**40  # of a run: beyond any practical one


@dataclass
class Progress:
    """Statistics of one step."""

    step: int  # from 1
    loss: float  # mean squared error of the fine colours; this and the counts are those of some steps before on CUDA (`efficientnerf.training.readback`)
    rays: int  # in the step
    tried: int  # coarse intervals, valid or not
    # valid, pivotal, fine: how many samples of each kind
    valid: int
    pivotal: int
    fine: int
    left_out: int = 0  # rays whose samples did not fit, and that the loss leaves out; on CUDA alone

    @property
    def psnr(self) -> float:
        return -10 * math.log10(max(self.loss, 1e-10))


@dataclass
class Trainer:
    """The state of a training run."""

    model: Model
    adam: Adam
    schedule: Schedule  # the one that the next step follows; another may take its place between steps
    step: int = 0
    samples_per_ray: float = 0.0  # the running average that sets the number of rays
    exposure: Exposure | None = None  # of the photographs (`efficientnerf.training.exposure.model`), where it is learned, or None
    checks: ViewChecks | None = None  # of the training views (`efficientnerf.training.view_checks.checks`), or None


def trainer(m: Model, exposure: Exposure | None = None, schedule: Schedule | None = None, cameras: Sequence[Camera] = ()) -> Trainer:
    """A trainer at its beginning.

    exposure  of the training images, that is learned; None: none is
    schedule  None: that of the model's settings
    cameras   of the training images, needed where they are checked
    """
    schedule = schedule or schedule_of(m.settings)
    groups = parameter_groups(m)
    if exposure is not None:
        groups.append(ParameterGroup(exposure.parameters))
    # At first every interval counts as sampled, with as many pivots as allowed.
    samples = float(m.max_intervals + m.settings.max_pivots * schedule.samples_per_pivot_at(0))
    checks = ViewChecks.none(cameras) if m.settings.wrong_views == "auto" and cameras else None
    return Trainer(m, Adam(groups, m.settings.adam_beta2, m.settings.adam_epsilon), schedule, 0, samples, exposure, checks)


def state_of(t: Trainer) -> dict[str, Tensor]:
    """All that a resumed run needs besides its schedule, by name."""
    moments = {f"adam.{k}.{name}": pair[k] for name, pair in t.adam.moments.items() for k in (0, 1)}
    progress = torch.tensor([float(t.step), t.samples_per_ray], dtype=torch.float64)
    exposure = {} if t.exposure is None else {name: values.detach() for name, values in t.exposure.parameters.items()}
    checks = {} if t.checks is None else {f"checks.{name}": torch.from_numpy(values) for name, values in t.checks.state.items()}
    return models.state_of(t.model) | moments | exposure | checks | {"progress": progress}


def restore(t: Trainer, state: dict[str, Tensor]) -> None:
    """Put `state_of`'s tensors back; ValueError names what does not fit, and then nothing has changed."""
    step, samples_per_ray = _check(t, state)
    models.restore(t.model, state)
    if t.exposure is not None:
        for name, learned in t.exposure.parameters.items():
            learned.data.copy_(state[name])
    if t.checks is not None:
        for name, values in t.checks.state.items():
            values[...] = state[f"checks.{name}"].numpy()
    for name, pair in t.adam.moments.items():
        for k in (0, 1):
            pair[k].copy_(state[f"adam.{k}.{name}"])
    t.step, t.samples_per_ray = step, samples_per_ray


def _check(t: Trainer, state: dict[str, Tensor]) -> tuple[int, float]:
    """The step and the samples on a ray of a state; ValueError where a tensor is missing, unknown or of another type or shape, or a number impossible."""
    wanted = state_of(t)
    for name, tensor in wanted.items():
        if name not in state:
            raise ValueError(f"tensor '{name}' is missing")
        if state[name].shape != tensor.shape or state[name].dtype != tensor.dtype:
            raise ValueError(f"tensor '{name}' is {state[name].dtype} {tuple(state[name].shape)}; expected {tensor.dtype} {tuple(tensor.shape)}")
    if unknown := sorted(state.keys() - wanted.keys()):
        raise ValueError(f"tensor '{unknown[0]}' is of no part of the model")
    step, samples_per_ray = (float(number) for number in state["progress"])
    if not (1 <= step <= MAX_STEPS and step == int(step)):
        raise ValueError(f"step {step:g} is not from 1 to {MAX_STEPS}")
    if not (math.isfinite(samples_per_ray) and samples_per_ray > 0):
        raise ValueError(f"{samples_per_ray:g} samples on a ray")
    return int(step), samples_per_ray


def train(t: Trainer, pixels: Pixels, sparse_depth: SparseDepthRays | None = None, *, readback: AsyncReadback | None = None) -> Iterator[Progress]:
    """Train until the schedule's last step, yielding after each; `t.schedule` may be replaced between steps.

    readback  reads the counts of steps without waiting for the device; None: one is made where there is a device
    """
    m, settings = t.model, t.model.settings
    if readback is None and dispatch.on_device(m.voxels.values):
        readback = AsyncReadback()
    if t.checks is not None and t.checks.changed:
        follow_checks(t.checks, pixels)
    source = DevicePixels(pixels, m.device) if m.device.type == "cuda" else pixels
    samples_per_pivot = 0
    while t.step < t.schedule.iterations:
        number = t.step + 1
        rng = np.random.Generator(np.random.Philox(key=settings.seed, counter=[0, 0, 0, number]))
        fraction, prune = t.schedule.fraction(number), number > settings.occupancy_warmup_steps
        before, samples_per_pivot = samples_per_pivot, t.schedule.samples_per_pivot_at(number)
        if readback is not None and (number == settings.occupancy_warmup_steps + 1 or samples_per_pivot != before):
            readback.restart()  # rays will have other numbers of samples from now on

        count = ray_count(settings, t.samples_per_ray)
        batch = ray_batch(m, source, count, rng, crop=number <= settings.precrop_steps)
        weight = sparse_depth_weight(settings.sparse_depth_loss_weight, fraction) if m.space.unbounded else 0.0
        aimed = aimed_rays(m, sparse_depth, max(1, count // RAYS_PER_RAY), rng) if sparse_depth is not None and weight > 0 else None
        bundle = batch[:6] if aimed is None else tuple(torch.cat(pair) for pair in zip(batch[:6], aimed.bundle, strict=True))
        rays = len(bundle[0])
        # Aimed rays begin closer to the camera, and end farther away.
        capacity = None if readback is None else readback.capacity(count + 2 * (rays - count))
        outputs = render_rays(m, *bundle, prune=prune, rng=rng, capacity=capacity, samples_per_pivot=samples_per_pivot)

        fitting = complete_rays(outputs.coarse, outputs.fine)
        complete = None if fitting is None else fitting[:count]
        exposure = t.exposure if t.exposure is None or is_learned(fraction) else t.exposure.detached
        at = None if exposure is None else places(pixels, batch.pixel, m.device)
        fine_loss, coarse_loss = colour_losses(outputs, batch.colour, complete, at, exposure)
        loss = fine_loss if coarse_loss is None else fine_loss + coarse_loss  # weighted equally, as in the authors' release
        if exposure is not None:
            loss = loss + exposure_loss(exposure)
        if m.space.unbounded:
            loss = loss + distortion_loss(m, outputs.distortion[:count], fraction, complete)
        if m.space.scales_near_gradients:
            scale_gradients_by_distance(m, batch.origins, outputs)
        if aimed is not None:
            loss = loss + weight * sparse_depth_loss(outputs, aimed.distance, aimed.on_support, samples_per_pivot, fitting)
        loss.backward()
        t.adam.step(number, t.schedule.learning_rate_at(number))
        update_occupancy(m, outputs, number, rng, padded=capacity is not None, may_wait=readback is None)

        t.step = number
        yield _progress(t, rays, fine_loss, outputs, readback)


def _progress(t: Trainer, rays: int, fine_loss: Tensor, outputs: RayOutputs, readback: AsyncReadback | None) -> Progress:
    """The step's statistics; updates the running average of samples."""
    if readback is not None:
        counts = readback.record(rays, fine_loss, outputs.coarse, outputs.pivotal, outputs.fine)
        t.samples_per_ray = max(readback.fine_per_ray + readback.valid_per_ray, 1.0)
    else:
        coarse, fine = outputs.coarse, outputs.fine
        counts = StepCounts(float(fine_loss.detach()), coarse.tried, len(coarse.start), int(outputs.pivotal.sum()), len(fine.start))
        t.samples_per_ray = 0.9 * t.samples_per_ray + 0.1 * max((counts.fine + counts.valid) / rays, 1.0)
    return Progress(t.step, counts.loss, rays, *counts[1:])
