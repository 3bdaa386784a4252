"""Renders of the field at some pixels of every photograph, for the refinement of the cameras. C views, N pixels of a view, R = C N rays."""

import numpy as np
import torch
from torch import Tensor

from efficientnerf.model import Model, RayOutputs, render_rays
from efficientnerf.rendering.compositing import ray_of_sample
from efficientnerf.training.camera_refinement import FAR, Alignment, CameraCorrections, add_round, solve
from efficientnerf.training.device_pixels import DevicePixels
from efficientnerf.training.exposure.model import Exposure, exposed, places
from efficientnerf.training.pixels import Pixels

# docs/experiments/photographs.md
PIXELS = 16384  # of a round, all photographs together
MIN_PIXELS, MAX_PIXELS = 64, 512  # of a photograph in a round
EVERY = 100  # steps between rounds
BEGIN, END = 0.15, 0.9  # of the schedule
RAYS_AT_A_TIME = 4096
SAMPLES_AT_A_TIME = 2**19  # where nothing is pruned
TRIES = 4  # pixels that are drawn for one that is wanted, where masks forbid some


def is_due(number: int, fraction: float) -> bool:
    """Whether the cameras are refined after a step."""
    return number % EVERY == 0 and BEGIN <= fraction <= END


def refine_cameras(m: Model, pixels: Pixels, source: Pixels | DevicePixels, c: CameraCorrections, rng: np.random.Generator, exposure: Exposure | None) -> float:
    """A round of refinement; the pixels' rays are those of the corrected cameras afterwards. Returns the largest motion, in pixels.

    exposure  what is learned of it, without gradients, see `efficientnerf.training.exposure.model`; None: nothing is
    """
    count = int(np.clip(PIXELS // len(c.given), MIN_PIXELS, MAX_PIXELS))
    chosen = [_choose(pixels, view, count, rng) for view in range(len(c.given))]
    if not any(len(index) for index in chosen):
        return 0.0
    colour, points = _rendered(m, source, np.concatenate(chosen), exposure)
    ends = np.cumsum([len(index) for index in chosen])[:-1]
    seen = [
        _alignment(pixels, view, index, shown, at) if len(index) else None
        for view, (index, shown, at) in enumerate(zip(chosen, np.split(colour, ends), np.split(points, ends), strict=True))
    ]
    add_round(c, seen)
    moved = solve(c)
    source.set_cameras(c.cameras)
    return moved


def _choose(pixels: Pixels, view: int, count: int, rng: np.random.Generator) -> np.ndarray:
    """Indices of at most `count` pixels of a view that may be used, with their neighbours; none of them at its border."""
    width, height = int(pixels.width[view]), int(pixels.height[view])
    if min(width, height) < 3:
        return np.empty(0, np.int64)
    x, y = rng.integers(1, width - 1, TRIES * count), rng.integers(1, height - 1, TRIES * count)
    index = pixels.offsets[view] + y * width + x
    good = np.ones(len(index), bool)
    for neighbour in (0, -1, 1, -width, width):
        good &= pixels.usable_at(index + neighbour)
        if pixels.images.shape[1] == 4:
            good &= pixels.images[index + neighbour][:, 3] == 255
    return index[good][:count]


def _alignment(pixels: Pixels, view: int, index: np.ndarray, shown: np.ndarray, points: np.ndarray) -> Alignment:
    width = int(pixels.width[view])
    y, x = np.divmod(index - pixels.offsets[view], width)
    at = {step: pixels.images[index + step][:, :3].astype(np.float64) / 255 for step in (0, -1, 1, -width, width)}
    gradient = np.stack([(at[1] - at[-1]) / 2, (at[width] - at[-width]) / 2], axis=-1)
    return Alignment(np.stack([x, y], axis=-1) + 0.5, at[0] - shown, gradient, points)


@torch.no_grad()
def _rendered(m: Model, source: Pixels | DevicePixels, index: np.ndarray, exposure: Exposure | None) -> tuple[np.ndarray, np.ndarray]:
    """Colours (R, 3) and points (R, 3) in the world that the field shows at pixels, float64."""
    colours, points = [], []
    # Without pruning a ray has all samples.
    block = RAYS_AT_A_TIME if m.prunes else max(64, SAMPLES_AT_A_TIME // (m.num_coarse_samples + m.settings.num_importance_samples))
    for begin in range(0, len(index), block):
        part = index[begin : begin + block]
        origins, directions, near, far = (torch.as_tensor(a, device=m.device) for a in source.bundle(part)[:4])
        outputs = render_rays(m, origins, directions, near, far, torch.full_like(near, 0.5), m.behind(directions))
        colour = outputs.fine_colour
        if exposure is not None:
            pixels = source.pixels if isinstance(source, DevicePixels) else source
            colour = exposed(colour, *places(pixels, part, m.device), exposure)
        colours.append(colour.double().cpu().numpy())
        points.append((origins + surface_distance(outputs)[:, None] * directions).double().cpu().numpy())
    return np.concatenate(colours), np.concatenate(points)


def surface_distance(outputs: RayOutputs) -> Tensor:
    """(R,) distance in the world at which half of a ray's light is gone; FAR where less is."""
    first = outputs.fine.first
    ray = ray_of_sample(first, len(outputs.fine.start))
    gone = torch.cumsum(outputs.fine_weight.double(), dim=0)
    gone = gone - torch.cat([gone.new_zeros(1), gone])[first[:-1]][ray]
    middle = outputs.rays.world_distance(outputs.fine.start + outputs.fine.extent / 2, ray)
    distance = torch.where(gone >= 0.5, middle, FAR)
    return torch.full_like(outputs.fine_opacity, FAR).scatter_reduce(0, ray, distance, reduce="amin")
