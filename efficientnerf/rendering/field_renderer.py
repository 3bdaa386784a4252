"""Images of trained fields: cameras to rays to pixels. R rays, H, W height and width of an image."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import astuple, dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from efficientnerf.geometry.cameras import Camera, rays
from efficientnerf.geometry.spaces import Box
from efficientnerf.model import Model, RayOutputs, render_rays
from efficientnerf.rendering.compositing import activate

RAYS_PER_BLOCK = 8192
Limits = Callable[[np.ndarray, np.ndarray, np.ndarray], np.ndarray]  # origins (R, 3), directions (R, 3), distances (R,) -> distances (R,)


@dataclass(frozen=True)
class SampleCounts:
    """Samples of some rays; intervals: rays x N_c, between near and far (in contracted space, those that a ray passes); valid: see `valid_count`."""

    rays: int = 0
    intervals: float = 0.0
    valid: int = 0
    pivotal: int = 0
    fine: int = 0

    def __add__(self, other: SampleCounts) -> SampleCounts:
        return SampleCounts(*(a + b for a, b in zip(astuple(self), astuple(other), strict=True)))

    @property
    def valid_share(self) -> float:
        """V of equation 5: valid samples over rays x N_c."""
        return self.valid / max(self.intervals, 1e-9)

    @property
    def pivotal_share(self) -> float:
        """P of equation 12: pivotal samples over rays x N_c."""
        return self.pivotal / max(self.intervals, 1e-9)


@dataclass(frozen=True)
class FieldRendering:
    """The image that a camera takes of a field, split by where the density lies: before, in or behind the box."""

    colour: np.ndarray  # (H, W, 3) sRGB with all that lies behind
    opacity: np.ndarray  # (H, W) of all samples
    depth: np.ndarray  # (H, W) along the view axis, world units; infinity where the opacity stays below one half
    before: np.ndarray  # (H, W, 4) premultiplied colour and opacity of what lies between the camera and the box
    behind: np.ndarray  # (H, W, 3) colour of what lies beyond the box, as if the box were empty
    inside_opacity: np.ndarray  # (H, W) of what lies in the box, of the light that reaches it
    counts: SampleCounts  # of the samples that it took
    within: np.ndarray  # (H, W) opacity of all that lies before the ray leaves the box `reach` of the render; 0 where it misses that
    nearer: np.ndarray | None = None  # (H, W) opacity of what lies nearer than the limits that the render was given; None without


def valid_count(m: Model, outputs: RayOutputs) -> int:
    """How many coarse samples were valid: those that the density voxels left, or, where nothing is pruned, those whose density the voxels would call
    valid. That is how section 3.3 of EfficientNeRF counts on a trained NeRF (equation 5)."""
    if m.prunes:
        return len(outputs.coarse.start)
    density = outputs.coarse_raw[:, 0]
    if m.voxels.rule == "maximum":
        density = activate(density, m.coarse.activation)
    return int((density > m.voxels.threshold).sum())


@dataclass(frozen=True)
class FieldRenderer:
    """Renders a trained model; near and far along the view axis, world units."""

    model: Model
    near: float
    far: float

    @torch.no_grad()
    def colour(self, camera: Camera, progress: Callable[..., Any] | None = None) -> np.ndarray:
        """(H, W, 3) the colour of `render` alone, in less time."""
        parts = [outputs.fine_colour.cpu().numpy() for *_, outputs in self._blocks(camera, progress)]
        return np.concatenate(parts).reshape(camera.height, camera.width, 3)

    @torch.no_grad()
    def render(
        self,
        camera: Camera,
        progress: Callable[..., Any] | None = None,
        *,
        box: np.ndarray | None = None,
        reach: np.ndarray | None = None,
        limits: Limits | None = None,
    ) -> FieldRendering:
        """The image that a camera in the training frame takes of the field.

        box     (2, 3) by which it is split; None: that of the field's space. The space's frame has to be the world, here and below
        reach   (2, 3) a box around it, for `within`; None: the same
        limits  for `nearer`: from where the light is half gone (infinity: nowhere) on rays to where on them to look; distances of the world
        """
        m = self.model
        split = m.space if box is None else Box(box)
        around = split if reach is None else Box(reach)
        parts, counts = [], SampleCounts()
        for origins, directions, slant, beyond, outputs in self._blocks(camera, progress):
            intervals = outputs.coarse.tried if m.space.contracted else len(origins) * (self.far - self.near) / m.step
            counts += SampleCounts(len(origins), intervals, valid_count(m, outputs), int(outputs.pivotal.sum()), len(outputs.fine.start))
            ray, middle = outputs.fine_ray, outputs.fine_middle
            found = [*split_by_box(slant, outputs, beyond, split), outputs.opacity_of(middle <= crossings(outputs, around)[1][ray], ray)]
            if limits is not None:
                stated = limits(*(a.double().cpu().numpy() for a in (origins, directions, found[2] / slant)))
                nearest = torch.as_tensor(stated, dtype=torch.float32, device=m.device)
                found.append(outputs.opacity_of(outputs.rays.world_distance(middle, ray) < nearest[ray], ray))
            parts.append([part.cpu().numpy() for part in found])
        shape = (camera.height, camera.width)
        columns = [np.concatenate(column) for column in zip(*parts, strict=True)]
        colour, opacity, depth, before, behind, inside, within, *nearer = (column.reshape(*shape, *column.shape[1:]) for column in columns)
        return FieldRendering(colour, opacity, depth, before, behind, inside, counts, within, nearer[0] if nearer else None)

    def _blocks(self, camera: Camera, progress: Callable[..., Any] | None) -> Iterator[tuple[Tensor, Tensor, Tensor, Tensor, RayOutputs]]:
        """Rays of an image, some at a time: origins, directions, their cosine to the view axis, the colour behind all samples, and what they meet."""
        m, count = self.model, camera.width * camera.height
        block = m.rays_at_once(RAYS_PER_BLOCK)
        for begin in range(0, count, block):
            index = np.arange(begin, min(count, begin + block))
            pixels = np.stack([index % camera.width + 0.5, index // camera.width + 0.5], axis=-1)
            origins, directions = (torch.as_tensor(a, dtype=torch.float32, device=m.device) for a in rays(camera, pixels))
            slant = (directions @ torch.as_tensor(camera.forward, dtype=torch.float32, device=m.device)).clamp(min=1e-3)
            beyond = m.behind(directions)
            outputs = render_rays(m, origins, directions, self.near / slant, self.far / slant, torch.full_like(slant, 0.5), beyond)
            yield origins, directions, slant, beyond, outputs
            if progress is not None:
                progress(begin + len(index), count)


def crossings(outputs: RayOutputs, box: Box) -> tuple[Tensor, Tensor]:
    """Distances (R,) at which rays enter and leave a box; minus infinity both where they miss it."""
    enter, leave = box.intersect(outputs.rays.origins, outputs.rays.directions)
    misses = leave <= torch.clamp(enter, min=0)
    return torch.where(misses, -torch.inf, enter), torch.where(misses, -torch.inf, leave)


def split_by_box(slant: Tensor, outputs: RayOutputs, behind: Tensor, box: Box) -> tuple[Tensor, ...]:
    """Colour, opacity, depth, before, behind and inside_opacity of a FieldRendering for rays (R, ...): each fine sample belongs in front of the box, in it or
    beyond it. A ray that misses the box sees only what lies beyond."""
    ray, middle = outputs.fine_ray, outputs.fine_middle
    enter, leave = crossings(outputs, box)

    def colour_of(chosen: Tensor) -> Tensor:
        weight = outputs.fine_weight * chosen
        return weight.new_zeros(len(slant), 3).index_add(0, ray, weight[:, None] * outputs.fine_rgb)

    in_front, beyond = middle < enter[ray], middle > leave[ray]
    before_opacity, after_opacity = outputs.opacity_of(in_front, ray), outputs.opacity_of(beyond, ray)
    inside_opacity = outputs.opacity_of(~in_front & ~beyond, ray)
    reaching_box = (1 - before_opacity).clamp(min=0)
    passing_box = (reaching_box - inside_opacity).clamp(min=0)
    rest = (passing_box - after_opacity).clamp(min=0)
    # The colour beyond the box is unknown, and does not matter, where hardly any light passes the box.
    after = (colour_of(beyond) + rest[:, None] * behind) / passing_box.clamp(min=1e-4)[:, None]
    beyond_colour = torch.where((passing_box > 1e-4)[:, None], after, behind)
    inside = torch.where(reaching_box > 1e-4, inside_opacity / reaching_box.clamp(min=1e-4), 0)
    before = torch.cat([colour_of(in_front), before_opacity[:, None]], dim=1)
    return outputs.fine_colour, outputs.fine_opacity, outputs.surface_distance(ray) * slant, before, beyond_colour, inside.clamp(max=1)
