"""The losses of a step. R rays, N samples."""

import torch
from torch import Tensor

from efficientnerf.backends import dispatch
from efficientnerf.backends.transfer import constant
from efficientnerf.model import Model, RayOutputs
from efficientnerf.training.exposure.model import Exposure, exposed, squared_error

NEARBY = 1e-12  # a distance from which gradients are not scaled
# docs/experiments/surface.md, hollows
BRIGHT = 0.5, 0.85  # colours of the field: up to the first highlights are spared in full, from the second on not at all
SPARED_UNTIL = 0.4  # of the schedule: surfaces stay where they are by then


def mean_over(values: Tensor, rays: Tensor | None) -> Tensor:
    """Mean of values (R, ...) over some rays (R,) bool, or over all."""
    if rays is None:
        return values.mean()
    per_ray = values.reshape(len(values), -1).mean(dim=1)
    # A product would let through what is no number.
    return torch.where(rays, per_ray, 0).sum() / rays.sum().clamp(min=1)


def spares_highlights(m: Model, fraction: float) -> bool:
    """Whether errors of highlights count less, at that fraction of the schedule."""
    return m.space.contracted and m.settings.highlight_loss_weight < 1 and fraction < SPARED_UNTIL


def crosses_box(m: Model, origins: Tensor, directions: Tensor) -> Tensor:
    """(R,) bool, rays (R, 3) in the world that cross the box."""
    near, far = m.space.intersect(origins, directions)
    return far > near.clamp(min=0)


def highlight_weights(shown: Tensor, colour: Tensor, crossing: Tensor, weight: float) -> Tensor:
    """(R, 3) weights of errors: `weight` where a photograph is brighter than what the field shows, unless that is bright, else 1.

    What is mirrored lies behind the surface. A field whose colours change less with the direction than highlights do moves the surface there: dark glossy
    things become hollow. On bright surfaces highlights are faint, and shadows are not.

    shown     (R, 3) colours of the field
    colour    (R, 3) of the photographs
    crossing  (R,) bool, rays that cross the box; the others' errors count in full
    """
    dark = ((BRIGHT[1] - shown.detach()) / (BRIGHT[1] - BRIGHT[0])).clamp(0, 1)
    return torch.where((colour > shown) & crossing[:, None], 1 - (1 - weight) * dark, 1.0)


def colour_losses(
    outputs: RayOutputs,
    colour: Tensor,
    complete: Tensor | None,
    at: tuple[Tensor, Tensor] | None = None,
    exposure: Exposure | None = None,
    highlights: tuple[Tensor, float] | None = None,
) -> tuple[Tensor, Tensor | None]:
    """Mean squared error of the fine colours, and of the coarse ones (None where there is no coarse stage), with `highlights` weighted.

    outputs     of these rays, and of others after them, which have no colour
    colour      (R, 3) of the photographs
    complete    (R,) bool, rays that count; None: all
    at          photograph (R,) int64 of each ray and r^2 (R,) in it, where exposure is learned, see `efficientnerf.training.exposure.model`
    highlights  (R,) bool, rays that cross the box, and the weight of highlights there: `highlight_weights`; None: all errors count alike
    """
    rays, seen = len(colour), [outputs.fine_colour] if outputs.coarse_colour is None else [outputs.fine_colour, outputs.coarse_colour]
    shown = torch.cat([each[:rays] for each in seen])  # of both stages in one pass
    colour = torch.cat([colour] * len(seen))
    if exposure is None or at is None:
        errors = (shown - colour) ** 2
    else:
        view, radius = (torch.cat([each] * len(seen)) for each in at)
        shown = exposed(shown, view, radius, exposure)
        errors = squared_error(shown, colour)
    if highlights is not None:
        errors = errors * highlight_weights(shown, colour, torch.cat([highlights[0]] * len(seen)), highlights[1])
    losses = [mean_over(errors[rays * k : rays * (k + 1)], complete) for k in range(len(seen))]
    return losses[0], losses[1] if len(losses) > 1 else None


def scale_gradients_by_distance(m: Model, origins: Tensor, outputs: RayOutputs) -> None:
    """Scale gradients by the square of the distance to the camera, up to the distance of the box's centre: those of the first rays of the outputs, with
    `origins` (R, 3), and not those of rays after them.

    Rays are dense close to a camera: samples there get gradients far more often than those on the subject, and floaters grow before the camera.
    Philip and Deschaintre 2023, "Floaters no more: radiance field gradient scaling for improved near-camera training".
    """
    subject = (origins - constant(m.space.centre, origins)).norm(dim=-1)
    subject = torch.nn.functional.pad(subject, (0, len(outputs.fine_opacity) - len(origins)), value=NEARBY)
    for samples, raw in ((outputs.coarse, outputs.coarse_raw), (outputs.fine, outputs.fine_raw)):
        if not raw.requires_grad:  # uniform sampling has no coarse stage
            continue
        raw.register_hook(lambda grad, samples=samples: dispatch.scaled_by_distance(grad, samples.start, samples.first, subject))
