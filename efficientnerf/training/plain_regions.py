"""Plain regions of the training photographs: nothing in them shows how far away a surface is, so that a field may put a wall anywhere, or leave it to the sky.

A triple is three pixels of a photograph on a line, in a disc without an edge, the middle one as far from one end as from the other. Unless photographs
contradict, they see a plane, whose inverse depth is linear along a line of pixels, and the middle is opaque where both ends are.

D discs, K triples, R rays.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, NamedTuple

import cv2
import numpy as np
import torch
from torch import Tensor

from efficientnerf.backends import transfer
from efficientnerf.backends.transfer import constant
from efficientnerf.model import Model, RayOutputs
from efficientnerf.rendering.compositing import ray_of_sample
from efficientnerf.sampling.samples import Samples
from efficientnerf.training.losses import mean_over
from efficientnerf.training.pixels import Pixels

# docs/experiments/losses.md
RAYS_PER_TRIPLE = 16
BLUR, EDGE = 1.0, 2.5  # pixels; of 255 a pixel, the slope of a blurred channel that is an edge
LEAST_RADIUS, MOST_RADIUS = 4.0, 0.1  # of discs: pixels; of the picture's longer side
MOST_DISCS, LONGEST = 2**20, 1280  # in all; longer side, in pixels, of the pictures that they are looked for in
OPAQUE = 0.9  # opacity of both ends from which the middle is taken to be opaque too
FARTHEST = 2.0  # distance of ends at most, over that of the farthest corner of the box: beyond it a plain region may be sky
BEND = 0.02  # bend of the inverse depth, over its sum, from which it counts linearly
RAMP = 0.1  # of the schedule, in which the loss rises
LEAST_OPACITY = 1e-6


@dataclass(frozen=True)
class PlainDiscs:
    """Discs without an edge. pixel: (D,) int64 of their centres, as `Pixels` counts them; radius: (D,) float32, pixels."""

    pixel: np.ndarray
    radius: np.ndarray


class PlainTriples(NamedTuple):
    """Triples whose rays are the first of a step, one end each, then the middles, then the other ends."""

    forward: Any  # (3 K, 3) float32, view axes of their cameras: array of the host, or tensor of a device


def plain_weight(weight: float, fraction: float) -> float:
    """The loss's weight at a fraction of the schedule: it rises over the first tenth, before which the field shows nothing."""
    return weight * min(1.0, fraction / RAMP)


def plain_discs(pixels: Pixels, most_views: int | None = None) -> PlainDiscs | None:
    """Discs of the usable pixels, about MOST_DISCS at most, as many of each view; None: there are none, or the images have alpha.

    most_views  that they are looked for in, evenly spread; None: all
    """
    if pixels.images.shape[1] != 3:
        return None
    count = len(pixels.width)
    found = list(_discs_of(pixels, np.unique(np.linspace(0, count - 1, min(count, most_views or count)).round().astype(int)).tolist()))
    return PlainDiscs(*map(np.concatenate, zip(*found, strict=True))) if any(len(centres) for centres, _ in found) else None


def _discs_of(pixels: Pixels, views: list[int]) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Centres and radii of each view's discs; a large picture is searched at 1 / n of its size."""
    for view in views:
        begin, width, height = int(pixels.offsets[view]), int(pixels.width[view]), int(pixels.height[view])
        n = -(-max(width, height) // LONGEST)
        rows, columns = height // n, width // n
        usable = pixels.usable_of(view)[: n * rows, : n * columns].reshape(rows, n, columns, n).all(axis=(1, 3))
        image = np.asarray(pixels.images[begin : begin + width * height]).reshape(height, width, 3)[: n * rows, : n * columns]
        image = cv2.GaussianBlur(cv2.resize(image, (columns, rows), interpolation=cv2.INTER_AREA).astype(np.float32), (0, 0), BLUR)
        across, down = (cv2.Sobel(image, cv2.CV_32F, right, 1 - right, ksize=3) / 8 for right in (1, 0))
        plain = usable & (np.hypot(across, down).max(axis=2) < EDGE)
        clear = cv2.distanceTransform(np.pad(plain.astype(np.uint8), 1), cv2.DIST_L2, cv2.DIST_MASK_5)[1:-1, 1:-1] - 1  # the frame is an edge
        y, x = np.nonzero(n * clear >= LEAST_RADIUS)
        every = -(-len(y) // (MOST_DISCS // len(views) + 1)) or 1
        y, x = y[::every], x[::every]
        yield begin + (n * y + n // 2) * width + n * x + n // 2, np.minimum(n * clear[y, x], np.float32(MOST_RADIUS * max(width, height)))


def drawn_triples(discs: PlainDiscs, pixels: Pixels, count: int, rng: np.random.Generator) -> tuple[np.ndarray, PlainTriples]:
    """`count` random triples: their pixels (3 K,), in the order of `PlainTriples`."""
    pick = rng.integers(len(discs.pixel), size=count)
    middle, far, turn = discs.pixel[pick], discs.radius[pick] * (0.5 + 0.5 * rng.random(count)), 2 * np.pi * rng.random(count)
    view = pixels.view_of(middle)
    step = np.rint(far * np.sin(turn)).astype(np.int64) * pixels.width[view] + np.rint(far * np.cos(turn)).astype(np.int64)
    return np.concatenate([middle + step, middle, middle - step]), PlainTriples(np.tile(pixels.rotation[view][:, :, 2], (3, 1)))


def plain_loss(m: Model, outputs: RayOutputs, origins: Tensor, directions: Tensor, triples: PlainTriples, complete: Tensor | None) -> Tensor:
    """The loss of the first rays of a rendered bundle, mean over their triples, for both stages.

    With o the opacities of a triple a, b, c and d their inverse depths, means over the light that ends,

        o_a o_b o_c rho((d_a - 2 d_b + d_c) / (d_a + 2 d_b + d_c)) + [min(o_a, o_c) > OPAQUE] max(0, min(o_a, o_c) - o_b)

    where rho(x) = sqrt(x^2 + BEND^2) - BEND, and gradients reach opacities through the last o_b alone. Ends beyond FARTHEST do not count.

    m                    in contracted space
    origins, directions  (R, 3) in the world
    complete             (R,) bool, rays that count; None: all
    """
    rays = len(triples.forward)
    cosine = (directions[:rays] * triples.forward).sum(dim=1)
    box = constant(m.space.centre, origins), float(np.linalg.norm(m.space.bounds[1] - m.space.bounds[0])) / 2
    reach = FARTHEST * ((origins[:rays] - box[0]).norm(dim=1) + box[1])
    whole = None if complete is None else complete[:rays].view(3, -1).all(dim=0)
    loss = cosine.new_zeros(())
    for samples, weight in ((outputs.coarse, outputs.coarse_weight), (outputs.fine, outputs.fine_weight)):
        (oa, ob, oc), (a, b, c) = (part.view(3, -1) for part in _opacity_and_inverse_depth(samples, weight, cosine))
        ends = torch.minimum(oa, oc).detach()
        near = (torch.minimum(a, c) * reach[: len(a)]).detach() > 1
        bend = (a - 2 * b + c) / (a + 2 * b + c + LEAST_OPACITY)
        each = (oa * ob * oc).detach() * ((bend * bend + BEND * BEND).sqrt() - BEND) + (ends > OPAQUE) * (ends - ob).clamp(min=0)
        loss = loss + mean_over(near * each, whole)
    return loss


def _opacity_and_inverse_depth(samples: Samples, weight: Tensor, cosine: Tensor) -> tuple[Tensor, Tensor]:
    """(R,) of the first rays, whose directions have these cosines (R,) with the view axis."""
    rays, first = len(cosine), samples.first
    if transfer.is_on_device(first):  # their number is not known on the host
        count, ray = len(weight), ray_of_sample(first, len(weight))
    else:
        count = int(first[rays])
        ray = ray_of_sample(first[: rays + 1], count)
    among = ray.clamp(max=rays - 1)
    weight = weight[:count] * (ray < rays)
    depth = (samples.start + samples.extent / 2)[:count] * cosine[among]
    opacity = torch.zeros_like(cosine).index_add(0, among, weight)
    inverse = torch.zeros_like(cosine).index_add(0, among, weight / depth.clamp(min=LEAST_OPACITY))
    return opacity, inverse / (opacity + LEAST_OPACITY)
