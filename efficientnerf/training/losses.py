"""The losses of a step. R rays, N samples."""

import torch
from torch import Tensor

from efficientnerf.backends import dispatch
from efficientnerf.backends.transfer import constant
from efficientnerf.model import Model, RayOutputs
from efficientnerf.training.exposure.model import Exposure, exposed, squared_error

NEARBY = 1e-12  # a distance from which gradients are not scaled


def mean_over(values: Tensor, rays: Tensor | None) -> Tensor:
    """Mean of values (R, ...) over some rays (R,) bool, or over all."""
    if rays is None:
        return values.mean()
    per_ray = values.reshape(len(values), -1).mean(dim=1)
    # A product would let through what is no number.
    return torch.where(rays, per_ray, 0).sum() / rays.sum().clamp(min=1)


def colour_losses(
    outputs: RayOutputs, colour: Tensor, complete: Tensor | None, at: tuple[Tensor, Tensor] | None = None, exposure: Exposure | None = None
) -> tuple[Tensor, Tensor | None]:
    """Mean squared error of the fine colours, and of the coarse ones (None where there is no coarse stage).

    outputs   of these rays, and of others after them, which have no colour
    colour    (R, 3) of the photographs
    complete  (R,) bool, rays that count; None: all
    at        photograph (R,) int64 of each ray and r^2 (R,) in it, where exposure is learned, see `efficientnerf.training.exposure.model`
    """
    rays, seen = len(colour), [outputs.fine_colour] if outputs.coarse_colour is None else [outputs.fine_colour, outputs.coarse_colour]
    shown = torch.cat([each[:rays] for each in seen])  # of both stages in one pass
    colour = torch.cat([colour] * len(seen))
    if exposure is None or at is None:
        errors = (shown - colour) ** 2
    else:
        view, radius = (torch.cat([each] * len(seen)) for each in at)
        errors = squared_error(exposed(shown, view, radius, exposure), colour)
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
