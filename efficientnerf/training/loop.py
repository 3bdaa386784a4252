"""Training: one flat loop.

Every random choice of step n is drawn from a generator seeded by (seed, n), so a resumed run makes the choices of an uninterrupted one without
any state to restore. What is restored: parameters, Adam's moments, density voxels, the running average that sets the number of rays.

On a CPU the same seed gives the same bytes again with the same number of threads of torch. Our own kernels, the hash field's network among them, do not
depend on the number; matrix products of the paper's networks (oneDNN, MKL) may sum in another order with another one. Either are in bfloat16 only where the
processor has it, so that another machine's result is another one of the same quality.

R rays, C views.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from efficientnerf.backends import dispatch
from efficientnerf.backends.transfer import to_device
from efficientnerf.model import Model, RayOutputs, render_rays
from efficientnerf.rendering.compositing import activate, ray_of_sample
from efficientnerf.sampling.occupancy import apply_decay, cell_of, refresh_cells, reset_cells, sweep_cells, update
from efficientnerf.settings import given
from efficientnerf.training.device_pixels import DevicePixels
from efficientnerf.training.exposure import exposed, exposure_loss
from efficientnerf.training.pixels import Pixels
from efficientnerf.training.readback import AsyncReadback, SampleCapacity, StepCounts, mean_over, whole_rays
from efficientnerf.training.settings import TrainSettings

RATE_WARM_UP = 100  # steps in which the rate rises, or the first tenth of a shorter run
BETA1 = 0.9
FEWEST_RAYS = 64
ANCHOR_SHARE = 8  # one ray to a sparse point for so many rays of pixels
ANCHOR_WIDTH = 2.0  # coarse intervals on either side of a sparse point that count as at the point
SWEEP_PARTS = 8  # refreshes of the warm-up that together ask about every voxel


@dataclass(frozen=True)
class SparseDepthRays:
    """Rays from training cameras to sparse points that structure from motion saw there.

    origins, directions  (A, 3) float32, unit directions
    distance             (A,) float32, to the point
    """

    origins: np.ndarray
    directions: np.ndarray
    distance: np.ndarray

    def __len__(self) -> int:
        return len(self.distance)


class Adam:
    """Kingma and Ba's Adam over named parameters. A hash table's entries without a gradient are left alone (as Mueller et al. do)."""

    def __init__(self, parameters: list[tuple[str, torch.nn.Parameter]], beta2: float = 0.99, epsilon: float = 1e-15) -> None:
        self.parameters, self.beta2, self.epsilon = parameters, beta2, epsilon
        self.moments = {name: (torch.zeros_like(p), torch.zeros_like(p)) for name, p in parameters}

    def step(self, number: int, rate: float) -> None:
        """The `number`-th step, from 1; clears the gradients."""
        correction1, correction2 = 1 - BETA1**number, 1 - self.beta2**number
        for name, p in self.parameters:
            if p.grad is None:
                continue
            first, second = self.moments[name]
            sparse = name.endswith("table")
            if p.device.type == "cpu":
                from efficientnerf.backends.numba import adam as cpu_adam

                flat = [t.detach().view(-1).numpy() for t in (p, p.grad.contiguous(), first, second)]
                cpu_adam.adam(*flat, *(np.float32(x) for x in (rate, BETA1, self.beta2, correction1, correction2, self.epsilon)), sparse)
            elif dispatch.on_device(p, p.grad):
                from efficientnerf.backends.triton.adam import adam

                moments = (first, second, rate, BETA1, self.beta2, correction1, correction2, self.epsilon)
                adam(p, p.grad, *moments, skip_zeros=sparse)
            else:
                with torch.no_grad():
                    touched = (p.grad != 0) if sparse else torch.ones_like(p.grad, dtype=torch.bool)
                    first.copy_(torch.where(touched, first.lerp(p.grad, 1 - BETA1), first))
                    second.copy_(torch.where(touched, second.lerp(p.grad**2, 1 - self.beta2), second))
                    p.sub_(touched * rate * (first / correction1) / ((second / correction2).sqrt() + self.epsilon))
            if sparse and p.device.type == "cpu" and p.grad.is_contiguous():
                p.cleared_grad = p.grad  # type: ignore[attr-defined]  # for the next step: a new one would have to be cleared again
            p.grad = None


@dataclass
class Progress:
    """What one step did.

    step        from 1
    loss        mean squared error of the fine colours; this and the counts are those of some steps before on CUDA (`efficientnerf.training.readback`)
    rays        in the step
    tried       coarse intervals, valid or not
    valid, pivotal, fine   how many samples of each kind
    left_out    rays that found no room for their samples, and taught nothing; on CUDA alone
    """

    step: int
    loss: float
    rays: int
    tried: int
    valid: int
    pivotal: int
    fine: int
    left_out: int = 0

    @property
    def psnr(self) -> float:
        return -10 * math.log10(max(self.loss, 1e-10))


@dataclass
class Trainer:
    """The state of a training run.

    samples_per_ray  the running average that sets the number of rays
    exposure         (C, 3) what is learned about each photograph's exposure (`efficientnerf.training.exposure`), or None
    """

    model: Model
    adam: Adam
    step: int = 0
    samples_per_ray: float = 0.0
    exposure: torch.nn.Parameter | None = None


def trainer(m: Model, views: int = 0) -> Trainer:
    """A trainer at its beginning; `views` is the number of training images, needed where their exposure is learned."""
    exposure = torch.nn.Parameter(torch.zeros(views, 3, device=m.device)) if m.settings.exposure == "gain" and m.background is None and views else None
    parameters = m.parameters() + ([] if exposure is None else [("exposure", exposure)])
    # Until it is known better, every interval is sampled, and as many pivots as there may be.
    samples = float(m.slots + m.settings.max_pivots * fine_samples_at(m.settings, 0))
    return Trainer(m, Adam(parameters, m.settings.adam_beta2, m.settings.adam_epsilon), 0, samples, exposure)


def state_of(t: Trainer) -> dict[str, Tensor]:
    """All that a resumed run needs, by name."""
    from efficientnerf.model import state_of as model_state

    moments = {f"adam.{k}.{name}": pair[k] for name, pair in t.adam.moments.items() for k in (0, 1)}
    progress = torch.tensor([float(t.step), t.samples_per_ray], dtype=torch.float64)
    exposure = {} if t.exposure is None else {"exposure": t.exposure.detach()}
    return model_state(t.model) | moments | exposure | {"progress": progress}


def restore(t: Trainer, state: dict[str, Tensor]) -> None:
    """Put `state_of`'s tensors back."""
    from efficientnerf.model import restore as restore_model

    restore_model(t.model, state)
    if t.exposure is not None:
        t.exposure.data.copy_(state["exposure"])
    for name, pair in t.adam.moments.items():
        for k in (0, 1):
            pair[k].copy_(state[f"adam.{k}.{name}"])
    t.step, t.samples_per_ray = int(state["progress"][0]), float(state["progress"][1])


def share_of_fall(step: int, iterations: int, hold: int = 0, aims: tuple[int, ...] = ()) -> float:
    """How much of the way from the end of the hold to the last step is gone: 0 to 1.

    aims  pairs (n, s) where the number of steps was not always known: up to step s the way was one to step n
    """
    share, begin = 0.0, hold
    for aim, until in [*zip(aims[::2], aims[1::2], strict=True), (iterations, iterations)]:
        share += (1 - share) * min(1.0, max(0, min(step, until) - begin) / max(1, aim - begin))
        begin = max(begin, until)
    return share


def learning_rate(step: int, settings_rate: float, final: float, iterations: int, fall: int = 0, hold: int = 0, aims: tuple[int, ...] = ()) -> float:
    """Rises over the first steps, is held up to step `hold`, then falls exponentially, to `final` of itself in every `fall` steps (0: by the last).

    With a hold, the rate up to its end does not depend on the number of iterations. aims: see `share_of_fall`.
    """
    rise = max(1, min(RATE_WARM_UP, hold or iterations // 10))
    share = max(0, step - hold) / fall if fall else share_of_fall(step, iterations, hold, aims)
    return settings_rate * min(1.0, step / rise) * final**share


def train(t: Trainer, pixels: Pixels, anchors: SparseDepthRays | None = None) -> Iterator[Progress]:
    """Train until the settings' last step, yielding after each. The model's settings may change on the way: the number of steps, while the rate is held."""
    m = t.model
    device = m.device
    transparent = pixels.images.shape[1] == 4
    late = AsyncReadback() if dispatch.on_device(m.voxels.values) else None  # then nothing waits for the device
    there = DevicePixels(pixels, device) if device.type == "cuda" else pixels
    sampled = 0  # N_s of the step before
    while t.step < m.settings.iterations:
        number, settings = t.step + 1, m.settings
        way = share_of_fall(number, settings.iterations, settings.rate_hold, settings.rate_aims)
        rng = np.random.Generator(np.random.Philox(key=settings.seed, counter=[0, 0, 0, number]))
        fine_samples = fine_samples_at(settings, way)

        # A bundle of rays of about as many samples as the settings ask for.
        count = (
            int(min(settings.max_rays_per_batch, max(FEWEST_RAYS, settings.sample_batch_size / t.samples_per_ray)))
            if settings.sample_batch_size != "off"
            else settings.max_rays_per_batch
        )
        chosen = pixels.choose(count, rng, middle=number <= settings.precrop_steps)
        origins, directions, near, far, colour = (torch.as_tensor(a, device=device) for a in there.bundle(chosen))
        offset = to_device(torch.from_numpy(rng.random(count, np.float32)), device)
        behind = m.behind(directions)
        if m.space.reaches_infinity and m.background is None:
            # Behind a space that reaches to infinity nothing lies: a new colour for each ray keeps the field from leaving it half transparent.
            behind = to_device(torch.from_numpy(rng.random((count, 3), np.float32)), device)
        if transparent:
            if settings.background_color == "random" or m.background is None:
                # Behind an object cut out of its background anything may lie: a new colour for each ray keeps the field from learning one.
                behind = to_device(torch.from_numpy(rng.random((count, 3), np.float32)), device)
            colour = colour[:, :3] * colour[:, 3:] + behind * (1 - colour[:, 3:])

        # Both stages, both losses (weighted equally, as in the authors' release).
        if late is not None and (number == settings.occupancy_warmup_steps + 1 or fine_samples != sampled):
            late.forget()
        sampled = fine_samples
        room = None if late is None else late.room(count)
        seen = render_rays(
            m, origins, directions, near, far, offset, behind, prune=number > settings.occupancy_warmup_steps, rng=rng, room=room, fine_samples=fine_samples
        )
        whole = whole_rays(seen.coarse, seen.fine)
        fine_colour, coarse_colour = seen.fine_colour, seen.coarse_colour
        if t.exposure is not None:
            view = to_device(torch.from_numpy(pixels.view_of(chosen)), device)
            fine_colour = exposed(fine_colour, view, t.exposure)
            coarse_colour = None if coarse_colour is None else exposed(coarse_colour, view, t.exposure)
        fine_loss = mean_over((fine_colour - colour) ** 2, whole)
        loss = fine_loss if coarse_colour is None else fine_loss + mean_over((coarse_colour - colour) ** 2, whole)
        if t.exposure is not None:
            loss = loss + exposure_loss(t.exposure)
        if m.space.unbounded:
            loss = loss + m.space.distortion_schedule(way) * m.distortion * mean_over(seen.distortion, whole)
            if m.space.scales_near_gradients:
                _quieten_near_cameras(m, origins, seen)
            strength = settings.sparse_depth_loss_weight * max(0.0, 1 - 2 * way)
            if anchors is not None and strength > 0:
                few = max(1, count // ANCHOR_SHARE)
                loss = loss + strength * anchor_loss(m, anchors, few, rng, late, prune=number > settings.occupancy_warmup_steps, fine_samples=fine_samples)
        loss.backward()
        ends = (settings.iterations, given(settings.lr_decay_steps) or 0, settings.rate_hold, settings.rate_aims)
        rate = learning_rate(number, settings.learning_rate, settings.lr_final_ratio, *ends)
        t.adam.step(number, rate)

        _tell_voxels(m, seen, number, rng, room, waits=late is None)

        t.step = number
        if late is not None:
            counted = late.note(count, fine_loss, seen.coarse, seen.pivotal, seen.fine)
            t.samples_per_ray = max(late.fine_per_ray + (0.0 if m.coarse is None else late.valid_per_ray), 1.0)
        else:
            counted = StepCounts(float(fine_loss.detach()), seen.coarse.tried, len(seen.coarse.start), int(seen.pivotal.sum()), len(seen.fine.start))
            asked = counted.fine if m.coarse is None else counted.fine + counted.valid  # of a network
            t.samples_per_ray = 0.9 * t.samples_per_ray + 0.1 * max(asked / count, 1.0)
        yield Progress(number, counted.loss, count, *counted[1:])


def _tell_voxels(m: Model, seen: RayOutputs, number: int, rng: np.random.Generator, room: SampleCapacity | None, *, waits: bool) -> None:
    """The voxels remember what the coarse field said on the rays of a step, and are refreshed at random.

    room   what samples were padded to
    waits  whether the device may be asked for numbers
    """
    if not m.prunes:
        return
    with torch.no_grad():
        told, raw = (seen.fine, seen.fine_raw) if m.coarse is None else (seen.coarse, seen.coarse_raw)
        remember(m, told.point, raw[:, 0].detach(), count=None if room is None else told.first[-1])
        due = number % m.settings.occupancy_update_interval == 0
        if due:
            refresh(m, number, rng)
        # Where nothing is sampled nothing has a gradient: an empty scene could never come back by itself.
        if not waits and due:
            reset_cells(m.voxels, ~(m.voxels.values > m.voxels.threshold).any())
        elif waits and len(seen.coarse.start) == 0 and not bool((m.voxels.values > m.voxels.threshold).any()):
            reset_cells(m.voxels)


def fine_samples_at(settings: TrainSettings, way: float) -> int:
    """N_s when this share of the schedule is gone (`share_of_fall`).

    With the same samples in a step, few on each ray make many rays, which a young field learns more from; fine ones then find surfaces where they are.
    *chair* at 800x800 after 2500 steps: 29.52 dB with 2, 30.00 dB with 4, but 28.7 dB both after 900 steps, and at 200x200 30.8 and 30.2 dB after 700,
    30.8 with 2 and then 4.
    """
    return settings.early_samples_per_pivot if settings.early_samples_per_pivot != "off" and way < 0.5 else settings.samples_per_pivot


def anchor_loss(
    m: Model, anchors: SparseDepthRays, count: int, rng: np.random.Generator, late: AsyncReadback | None = None, *, prune: bool, fine_samples: int = 0
) -> Tensor:
    """How much of the light on some rays is not absorbed close to the point that was seen there, for both stages: 0 to 2.

        1 - sum_i w_i max(0, 1 - |t_i - d| / (ANCHOR_WIDTH e_i))

    with t_i the middle of interval i, e_i its extent (of a coarse interval for both stages) and d the distance of the point. What is before the
    point is cleared away by it, which photographs alone take long to do: they look as well explained by fog of the right colour. fine_samples: see
    `render_rays`.
    """
    fine_samples = fine_samples or m.settings.samples_per_pivot
    pick = rng.integers(len(anchors), size=count)
    origins, directions, distance = (to_device(torch.from_numpy(a[pick]), m.device) for a in (anchors.origins, anchors.directions, anchors.distance))
    offset = to_device(torch.from_numpy(rng.random(count, np.float32)), m.device)
    near, far = 0.1 * distance, 4 * distance
    room = None if late is None else late.room(2 * count)  # they begin closer to the camera, and end farther away
    seen = render_rays(m, origins, directions, near, far, offset, m.behind(directions).detach(), prune=prune, rng=rng, room=room, fine_samples=fine_samples)
    whole = whole_rays(seen.coarse, seen.fine)
    distance = seen.rays.frame_distance(distance)
    loss = origins.new_zeros(())
    for samples, weight, share in ((seen.coarse, seen.coarse_weight, 1), (seen.fine, seen.fine_weight, fine_samples)):
        ray = ray_of_sample(samples.first, len(samples.start))
        off = (samples.start + samples.extent / 2 - distance[ray]).abs() / (ANCHOR_WIDTH * share * samples.extent).clamp(min=1e-12)
        held = weight * (1 - off).clamp(min=0)
        if whole is None:
            loss = loss + 1 - held.sum() / count
        else:
            loss = loss + mean_over(1 - held.new_zeros(count).index_add(0, ray, held), whole)
    return loss


def _quieten_near_cameras(m: Model, origins: Tensor, seen: RayOutputs) -> None:
    """Scale gradients by the square of the distance to the camera, up to the distance of the box's centre.

    Close to a camera rays crowd together, so that samples there are pulled far more often than those on the subject, and matter hangs before
    the lens. Philip and Deschaintre 2023, "Floaters no more: radiance field gradient scaling for improved near-camera training".
    """
    subject = (origins - to_device(torch.as_tensor(m.space.centre, dtype=origins.dtype), origins.device)).norm(dim=-1)
    for samples, raw in ((seen.coarse, seen.coarse_raw), (seen.fine, seen.fine_raw)):
        if not raw.requires_grad:  # uniform sampling has no coarse stage
            continue
        ray = ray_of_sample(samples.first, len(samples.start))
        scale = (samples.start / subject[ray]).clamp(max=1) ** 2
        raw.register_hook(lambda grad, scale=scale: grad * scale[:, None])


def refresh(m: Model, number: int, rng: np.random.Generator) -> None:
    """Let the voxels forget a little, and ask the coarse field about a share of them: all of them in turn in the warm-up, then random ones."""
    generator = torch.Generator().manual_seed(int(rng.integers(2**62)))
    apply_decay(m.voxels)
    if m.settings.occupancy_update_fraction == 0:
        return
    if number <= m.settings.occupancy_warmup_steps:
        cell, point = sweep_cells(m.voxels, number // m.settings.occupancy_update_interval, SWEEP_PARTS, generator)
    else:
        cell, point = refresh_cells(m.voxels, int(m.settings.occupancy_update_fraction * m.voxels.side**3), generator)
    for part in range(0, len(cell), 2**17):
        remember(m, point[part : part + 2**17], m.proposal_field.density(m.snapped_points(point[part : part + 2**17])), cell[part : part + 2**17])


def remember(m: Model, point: Tensor, raw: Tensor, cell: Tensor | None = None, count: Tensor | None = None) -> None:
    """Update the density voxels with what the coarse field said, before its activation, at points in grid coordinates; `count` as for `update`."""
    if (
        cell is None
        and count is None
        and m.voxels.rule == "maximum"
        and dispatch.update_occupancy_maximum(m.voxels.values, point, raw, m.proposal_field.activation)
    ):
        return
    cell = cell_of(point, m.voxels.side) if cell is None else cell
    update(m.voxels, cell, raw if m.voxels.rule == "momentum" else activate(raw, m.proposal_field.activation), count)
