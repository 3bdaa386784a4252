"""Training: one flat loop.

Every random choice of step n is drawn from a generator seeded by (seed, n), so that a resumed run makes the choices of an uninterrupted one without
any state to restore. What is restored: parameters, Adam's moments, density voxels, the running average that sets the number of rays.

On a CPU the same seed gives the same bytes with the same number of threads of torch. Our own kernels, the hash field's network among them, do not
depend on the number; matrix products of the paper's networks (oneDNN, MKL) may sum in another order with another one. Either are in bfloat16 only where the
processor supports it, so that another machine's result differs, at the same quality.

A step itself is in `efficientnerf.training.step`. R rays, A rays to sparse points, C views.
"""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from efficientnerf import model as models
from efficientnerf.backends import dispatch
from efficientnerf.backends.transfer import sent
from efficientnerf.geometry.cameras import Camera
from efficientnerf.model import Model, RayOutputs
from efficientnerf.sampling.occupancy import mask_cells, open_cells
from efficientnerf.sampling.strategies import Efficient
from efficientnerf.training.device_pixels import DevicePixels
from efficientnerf.training.exposure.model import Exposure, is_learned
from efficientnerf.training.losses import spares_highlights
from efficientnerf.training.occupancy_update import update_in_turn
from efficientnerf.training.optimiser import Adam, ParameterGroup, parameter_groups
from efficientnerf.training.pixels import Pixels
from efficientnerf.training.plain_regions import plain_discs, plain_weight
from efficientnerf.training.readback import AsyncReadback, StepCounts, counts_of
from efficientnerf.training.schedule import Schedule, schedule_of
from efficientnerf.training.sparse_depth import SparseDepthRays, sparse_depth_weight
from efficientnerf.training.step import Learner, StepInputs, StepNumbers, StepPlan, drawn_step, ray_count, step_on_rays
from efficientnerf.training.step_graphs import StepGraphs
from efficientnerf.training.view_checks.checks import ViewChecks, follow_checks

OPENS_AT = 0.25  # of the steps, at which voxels that are closed at first open. docs/experiments/near-cameras.md
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
    closed: Tensor | None = None  # (D, D, D) bool: density voxels that are masked until OPENS_AT of the steps


def trainer(
    m: Model, exposure: Exposure | None = None, schedule: Schedule | None = None, cameras: Sequence[Camera] = (), closed: Tensor | None = None
) -> Trainer:
    """A trainer at its beginning.

    exposure  of the training images, that is learned; None: none is
    schedule  None: that of the model's settings
    cameras   of the training images, needed where they are checked
    closed    (D, D, D) bool: density voxels that are masked until OPENS_AT of the steps
    """
    schedule = schedule or schedule_of(m.settings)
    groups = parameter_groups(m)
    if exposure is not None:
        groups.append(ParameterGroup(exposure.parameters))
    # At first every interval counts as sampled, with as many pivots as allowed.
    samples = float(m.max_intervals + m.settings.max_pivots * schedule.samples_per_pivot_at(0))
    if closed is not None:
        closed = closed & ~torch.isneginf(m.voxels.values.cpu())  # those that are masked for good stay
        mask_cells(m.voxels, closed)
    checks = ViewChecks.none(cameras) if m.settings.wrong_views == "auto" and cameras else None
    return Trainer(m, Adam(groups, m.settings.adam_beta2, m.settings.adam_epsilon), schedule, 0, samples, exposure, checks, closed)


def state_of(t: Trainer) -> dict[str, Tensor]:
    """All that a resumed run needs besides its schedule, by name; in the memory of what is trained, but for "progress"."""
    moments = {f"adam.{k}.{name}": pair[k] for name, pair in t.adam.moments.items() for k in (0, 1)}
    progress = torch.tensor([float(t.step), t.samples_per_ray], dtype=torch.float64)
    exposure = {} if t.exposure is None else {name: values.detach() for name, values in t.exposure.parameters.items()}
    checks = {} if t.checks is None else {f"checks.{name}": torch.from_numpy(values) for name, values in t.checks.state.items()}
    return models.state_of(t.model) | moments | exposure | checks | {"progress": progress}


def restore(t: Trainer, state: dict[str, Tensor]) -> None:
    """Put `state_of`'s tensors back; ValueError names what does not fit, and then nothing has changed."""
    own = state_of(t)
    models.check_tensors(state, own)
    if unknown := sorted(state.keys() - own.keys()):
        raise ValueError(f"tensor '{unknown[0]}' is of no part of the model")
    step, samples_per_ray = (float(number) for number in state["progress"])
    if not (1 <= step <= MAX_STEPS and step == int(step)):
        raise ValueError(f"step {step:g} is not from 1 to {MAX_STEPS}")
    if not (math.isfinite(samples_per_ray) and samples_per_ray > 0):
        raise ValueError(f"{samples_per_ray:g} samples on a ray")
    for name, tensor in own.items():
        tensor.copy_(state[name])  # in the memory of what is trained
    t.step, t.samples_per_ray = int(step), samples_per_ray


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
    plain = plain_discs(pixels) if m.space.contracted and settings.plain_loss_weight > 0 else None
    learner, graphs = Learner(m, t.adam, source, t.exposure), StepGraphs(m.device, t.adam.parameters)
    samples_per_pivot = 0
    while t.step < t.schedule.iterations:
        number = t.step + 1
        rng = np.random.Generator(np.random.Philox(key=settings.seed, counter=[0, 0, 0, number]))
        fraction, prune = t.schedule.fraction(number), number > settings.occupancy_warmup_steps
        before, samples_per_pivot = samples_per_pivot, t.schedule.samples_per_pivot_at(number)
        if readback is not None and (number == settings.occupancy_warmup_steps + 1 or samples_per_pivot != before):
            readback.restart()  # rays will have other numbers of samples from now on

        weight = sparse_depth_weight(settings.sparse_depth_loss_weight, fraction) if m.space.unbounded else 0.0
        rate = t.schedule.learning_rate_at(number)
        numbers = StepNumbers(t.adam.step_size(number, rate), m.distortion_weight(fraction), weight, plain_weight(settings.plain_loss_weight, fraction))
        count = ray_count(settings, t.samples_per_ray)
        with graphs.ordered():
            if t.closed is not None and fraction >= OPENS_AT:
                open_cells(m.voxels, t.closed)
                t.closed = None
            count = count if readback is None else graphs.rays(count)
            inputs = drawn_step(learner, sparse_depth if weight > 0 else None, plain, count, rng, crop=number <= settings.precrop_steps)
            aimed = 0 if inputs.aimed is None else len(inputs.aimed.distance)
            rays = len(inputs.rays.pixel) + aimed
            # Aimed rays begin closer to the camera, and end farther away.
            capacity = None if readback is None else readback.capacity(rays + aimed)
            plan = StepPlan(prune, samples_per_pivot, capacity, is_learned(fraction), spares_highlights(m, fraction))
            if readback is None:
                fine_loss, outputs = step_on_rays(learner, plan, sent(inputs, m.device), numbers, rng)
                counts, empty = _counted(t, rays, fine_loss, outputs, samples_per_pivot), len(outputs.coarse.start) == 0
                del outputs
            else:
                counts, empty = _not_waited_for(learner, graphs, readback, plan, inputs, numbers, rng), None
                t.samples_per_ray = max(readback.fine_per_ray + readback.valid_per_ray, 1.0)
            update_in_turn(m, number, rng, empty=empty)
        t.step = number
        yield Progress(t.step, counts.loss, rays, *counts[1:])


def _counted(t: Trainer, rays: int, fine_loss: Tensor, outputs: RayOutputs, samples_per_pivot: int) -> StepCounts:
    """The step's statistics; updates the running average of samples."""
    coarse, fine = outputs.coarse, outputs.fine
    counts = StepCounts(float(fine_loss), coarse.tried, len(coarse.start), int(outputs.pivotal.sum()), len(fine.start))
    # With the fine samples that are left out because they are hidden: a step has as many rays as on a device, where none are.
    drawn = samples_per_pivot * counts.pivotal if isinstance(t.model.strategy, Efficient) else counts.fine
    t.samples_per_ray = 0.9 * t.samples_per_ray + 0.1 * max((drawn + counts.valid) / rays, 1.0)
    return counts


def _not_waited_for(
    learner: Learner, graphs: StepGraphs, readback: AsyncReadback, plan: StepPlan, inputs: StepInputs, numbers: StepNumbers, rng: np.random.Generator
) -> StepCounts:
    """A step on a device; statistics of some steps before."""
    m = learner.model
    if isinstance(m.strategy, Efficient):
        inputs = inputs._replace(explored=m.strategy.explored(plan.capacity, rng, m.device))

    def body(inputs: StepInputs, numbers: StepNumbers) -> Tensor:
        return counts_of(*step_on_rays(learner, plan, inputs, numbers, rng))

    # Strategies that draw as they sample, and samples that are counted, cannot be replayed.
    if plan.capacity is None or not isinstance(m.strategy, Efficient):
        return readback.record(graphs.launch(inputs, numbers, body))
    return readback.record(graphs.take(plan, inputs, numbers, body))
