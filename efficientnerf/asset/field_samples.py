"""The samples of a trained field along training rays. They give the foreground region, the visible voxels of each grid, the environment map
beyond all grids, and which rays should be opaque. The field is rendered once; the rest are passes over some tens of megabytes.

P rays, M samples, C views, L cascades.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
import torch

from efficientnerf.asset.bake import Visibility, spread_pixels
from efficientnerf.asset.cascades import Grid
from efficientnerf.backends.numba.bricks import boxes_of_samples, greatest_around, weigh_voxels
from efficientnerf.backends.pieces import pieces
from efficientnerf.geometry.cameras import Camera
from efficientnerf.geometry.cameras import rays as camera_rays
from efficientnerf.model import Model, render_rays
from efficientnerf.rendering import environment
from efficientnerf.rendering.compositing import activate, ray_of_sample
from efficientnerf.training.pixels import Pixels

RAYS_PER_BLOCK = 8192  # that are rendered at once
RAYS_PER_PASS = 2**15  # whose samples a kernel is given at once
PAST_BORDERS = 0.2  # of the sides of an image. docs/experiments/whole-scene.md


@dataclass(frozen=True, eq=False)
class FieldSamples:
    """Fine samples of a field along training rays, and along others that pass the borders of their images: those that weigh more than a threshold."""

    # pixel, view: (P,) int64 and int32: which training pixel of which view; of rays past borders, which come last, -1 less the view
    pixel: np.ndarray
    view: np.ndarray
    origin: np.ndarray  # (C, 3) float32 centres of the views
    direction: np.ndarray  # (P, 3) float32 unit directions
    opacity: np.ndarray  # (P,) float32 of all samples, those left out too
    behind: np.ndarray  # (P, 3) float16 the field's colour beyond all samples
    first: np.ndarray  # (P + 1,) int64: ray r owns samples first[r] to first[r + 1]
    # start, extent: (M,) float32 along the ray, world units
    start: np.ndarray
    extent: np.ndarray
    # weight, thickness: (M,) float32: contribution to the ray's colour, and optical thickness
    weight: np.ndarray
    thickness: np.ndarray
    colour: np.ndarray  # (M, 3) uint8

    @property
    def training(self) -> FieldSamples:
        """Those of training pixels."""
        return self.part(0, int(np.count_nonzero(self.pixel >= 0)))

    @property
    def past_borders(self) -> FieldSamples:
        """Those of rays that pass the borders of images."""
        return self.part(int(np.count_nonzero(self.pixel >= 0)), len(self.pixel))

    def part(self, begin: int, end: int) -> FieldSamples:
        """Those of some rays; the arrays are shared."""
        of_rays = {name: getattr(self, name)[begin:end] for name in ("pixel", "view", "direction", "opacity", "behind")}
        part = slice(int(self.first[begin]), int(self.first[end]))
        of_samples = {name: getattr(self, name)[part] for name in ("start", "extent", "weight", "thickness", "colour")}
        return FieldSamples(origin=self.origin, first=self.first[begin : end + 1] - part.start, **of_rays, **of_samples)

    def colours(self) -> np.ndarray:
        """(P, 3) float32 what the samples composite to, without what is behind them."""
        out = np.zeros((len(self.pixel), 3), np.float32)
        for rays, part in self.blocks():
            ray = np.repeat(np.arange(rays.stop - rays.start), np.diff(self.first[rays.start : rays.stop + 1]))
            for channel in range(3):
                out[rays, channel] = np.bincount(ray, weights=self.weight[part] * self.colour[part, channel] / 255.0, minlength=rays.stop - rays.start)
        return out

    def points(self, samples: np.ndarray, ray: np.ndarray) -> np.ndarray:
        """World points (n, 3) in the middle of some samples, of which the rays are given."""
        along = self.start[samples] + self.extent[samples] / 2
        return self.origin[self.view[ray]] + along[:, None] * self.direction[ray]

    def rays(self, rays: slice, part: slice) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Of a block of `blocks` the origins and directions (n, 3) of its rays, and the first of their samples in `part` (n + 1,)."""
        return self.origin[self.view[rays]], self.direction[rays], self.first[rays.start : rays.stop + 1] - part.start

    def blocks(self) -> Iterator[tuple[slice, slice]]:
        """Rays and their samples, some of them at a time."""
        for begin in range(0, len(self.pixel), RAYS_PER_PASS):
            end = min(len(self.pixel), begin + RAYS_PER_PASS)
            yield slice(begin, end), slice(int(self.first[begin]), int(self.first[end]))


@torch.no_grad()
def field_samples(
    m: Model, pixels: Pixels, count: int, threshold: float, done: Callable[[int, int], None], cameras: Sequence[Camera] = (), past: int = 0
) -> FieldSamples:
    """The samples of about `count` training pixels, evenly spread, that weigh more than `threshold`; then of about `past` rays from the `cameras` of the
    training images that pass the borders of these by up to PAST_BORDERS of their sides."""
    chosen = spread_pixels(pixels, count)
    within = (pixels.bundle(chosen[begin : begin + RAYS_PER_BLOCK])[:4] for begin in range(0, len(chosen), RAYS_PER_BLOCK))
    view, beyond = rays_past_borders(pixels, cameras, past)
    total = len(chosen) + len(view)
    shown: list[tuple[np.ndarray, ...]] = []
    samples: list[tuple[np.ndarray, ...]] = []
    rendered = 0
    for bundle in itertools.chain(within, beyond):
        origins, directions, near, far = (torch.from_numpy(np.ascontiguousarray(a)).to(m.device) for a in bundle)
        behind = m.behind(directions)
        outputs = render_rays(m, origins, directions, near, far, torch.full_like(near, 0.5), behind)
        fine = outputs.fine
        keep = outputs.fine_weight > threshold
        counts = torch.bincount(ray_of_sample(fine.first, len(fine.start))[keep], minlength=len(near))
        shown.append((bundle[1], outputs.fine_opacity.cpu().numpy(), behind.cpu().numpy().astype(np.float16), counts.cpu().numpy()))
        thickness = activate(outputs.fine_raw[:, 0], m.fine.activation) * fine.length
        colour = (outputs.fine_rgb[keep].clamp(0, 1) * 255).round().to(torch.uint8).cpu().numpy()
        samples.append((*(part[keep].cpu().numpy() for part in (fine.start, fine.extent, outputs.fine_weight, thickness)), colour))
        rendered += len(near)
        done(rendered, total)
    direction, opacity, sky, counts_of = (np.concatenate(part) for part in zip(*shown, strict=True))
    first = np.concatenate([[0], np.cumsum(counts_of)]).astype(np.int64)
    pixel, of = np.concatenate([chosen, -1 - view]), np.concatenate([pixels.view_of(chosen), view]).astype(np.int32)
    return FieldSamples(pixel, of, pixels.centre, direction, opacity, sky, first, *(np.concatenate(part) for part in zip(*samples, strict=True)))


def rays_past_borders(pixels: Pixels, cameras: Sequence[Camera], count: int) -> tuple[np.ndarray, Iterator[tuple[np.ndarray, ...]]]:
    """The views (n,) int64 of about `count` rays beyond the borders of their images, evenly spread, view by view and row by row, and blocks of their origins,
    directions, near and far."""
    rng = np.random.Generator(np.random.Philox(key=0, counter=[0, 0, 1, 0]))
    side = 1 + 2 * PAST_BORDERS
    drawn = round(count * side**2 / (side**2 - 1) / max(len(cameras), 1))
    places = []
    for camera in cameras:
        place = rng.random((drawn, 2)) * side - PAST_BORDERS
        place = place[((place < 0) | (place > 1)).any(axis=1)]
        places.append(place[np.argsort(place[:, 1], kind="stable")] * (camera.width, camera.height))
    view = np.repeat(np.arange(len(cameras)), [len(place) for place in places])

    def blocks() -> Iterator[tuple[np.ndarray, ...]]:
        for number, (camera, place) in enumerate(zip(cameras, places, strict=True)):
            for begin in range(0, len(place), RAYS_PER_BLOCK):
                origins, directions = camera_rays(camera, place[begin : begin + RAYS_PER_BLOCK])
                slant = np.maximum(directions @ camera.forward, 1e-3)  # near and far are measured along the view axis
                planes = pixels.near[number] / slant, pixels.far[number] / slant
                yield tuple(np.asarray(part, np.float32) for part in (origins, directions, *planes))

    return view, blocks()


def surface_points(samples: FieldSamples) -> np.ndarray:
    """World points (P, 3) where half of each ray's light is gone; infinity where less than half ever is."""
    out = np.full((len(samples.pixel), 3), np.inf)
    for rays, part in samples.blocks():
        first = samples.first[rays.start : rays.stop + 1] - part.start
        gone = np.concatenate([[0.0], np.cumsum(samples.weight[part], dtype=np.float64)])
        ray = np.repeat(np.arange(len(first) - 1), np.diff(first))
        passed = gone[1:] - gone[first[:-1]][ray] >= 0.5
        at = np.flatnonzero(passed)
        hit, where = np.unique(ray[at], return_index=True)
        out[rays.start + hit] = samples.points(part.start + at[where], rays.start + hit)
    return out


def picture_places(samples: FieldSamples, pixels: Pixels, rays: slice) -> np.ndarray:
    """(n, 2) x, y of some of the rays in their images, from -1 to 1."""
    view = samples.view[rays]
    row, column = np.divmod(samples.pixel[rays] - pixels.offsets[view], pixels.width[view])
    return np.stack([(2 * column + 1) / pixels.width[view] - 1, (2 * row + 1) / pixels.height[view] - 1], axis=-1)


def weight_by_box(samples: FieldSamples, boxes: Sequence[np.ndarray]) -> np.ndarray:
    """(L + 1,) total weight of the samples in each of nested boxes (2, 3), that of the boxes inside of it left out, and of what lies beyond the last."""
    out = np.zeros(len(boxes) + 1)
    for _, box, weight in _boxes_of(samples, boxes):
        out += np.bincount(box, weights=weight, minlength=len(out))
    return out


def _boxes_of(samples: FieldSamples, boxes: Sequence[np.ndarray]) -> Iterator[tuple[slice, np.ndarray, np.ndarray]]:
    """Rays, and the number of the first box that holds the middle of each of their samples, with its weight, block by block."""
    every = np.stack([np.asarray(box, np.float64) for box in boxes])  # (L, 2, 3)
    for rays, part in samples.blocks():
        box = np.empty(part.stop - part.start, np.int64)
        boxes_of_samples(*samples.rays(rays, part), samples.start[part], samples.extent[part], every, box)
        yield rays, box, samples.weight[part]


def cascade_visibility(samples: FieldSamples, grids: Sequence[Grid], brick: int, threshold: float) -> list[Visibility]:
    """The greatest weight of each voxel of nested grids; a sample counts in the innermost one whose box holds it, and along all of its extent: the density
    is taken to be the same throughout. Weights that do not exceed `threshold` are left out. The grids are filled by a thread each."""
    holes = [np.zeros((2, 3)), *(grid.bounds(brick) for grid in grids[:-1])]
    with ThreadPoolExecutor(torch.get_num_threads()) as threads:
        return list(threads.map(lambda grid, hole: _grid_visibility(samples, grid, hole, brick, threshold), grids, holes))


def _grid_visibility(samples: FieldSamples, grid: Grid, hole: np.ndarray, brick: int, threshold: float) -> Visibility:
    """`cascade_visibility` of one grid, without what lies in the box `hole` (2, 3)."""
    shape, voxel, low = grid
    row_of = np.full(math.prod(shape), -1, np.int32)
    greatest, rows = np.zeros((0, brick**3), np.float32), 0
    for _ in range(2):  # rows are counted, then filled
        for rays, part in samples.blocks():
            values = (samples.start[part], samples.extent[part], samples.weight[part], samples.thickness[part])
            place = shape, float(voxel), np.asarray(low, np.float64), hole, brick
            rows = weigh_voxels(*samples.rays(rays, part), *values, float(threshold), *place, row_of, greatest, rows)
        if not len(greatest):
            greatest = np.zeros((rows, brick**3), np.float32)
    cells = np.flatnonzero(row_of >= 0)
    return Visibility(cells, greatest[row_of[cells]])


def seen_weights(visibility: Visibility, indices: np.ndarray, shape: tuple[int, int, int], brick: int) -> np.ndarray:
    """(N, 2) float32: the greatest weight that voxels (N, 3) have on any ray, and that they or those next to them have."""
    row_of = np.full(math.prod(shape), -1, np.int32)
    row_of[visibility.cells] = np.arange(len(visibility.cells))
    out = np.empty((len(indices), 2), np.float32)
    for part in pieces(len(indices), 2**16):
        greatest_around(indices[part], visibility.greatest, shape, brick, row_of, out[part])
    return out


LEAST_SHARE, MOST_SHARE, MAX_OPACITY = 0.7, 3.0, 0.9999  # of the weights seen; an optical thickness of 9


def density_as_seen(density: np.ndarray, seen: np.ndarray, voxel: float) -> np.ndarray:
    """Densities (N,) of voxels within what rays saw of them, `seen` (N, 2) of `seen_weights`.

    The coarse stage hides some of the field's density. A voxel absorbs about as much light as rays lost in it; a voxel in full view
    absorbs no more than rays lost in it or next to it.
    """
    least, most = (-np.log1p(-np.minimum(share * seen[:, k], MAX_OPACITY)) / np.float32(voxel) for k, share in enumerate((LEAST_SHARE, MOST_SHARE)))
    most = np.where(MOST_SHARE * seen[:, 1] >= MAX_OPACITY, np.inf, most)
    return np.asarray(np.clip(density, least, most), np.float32)


def environment_beyond(samples: FieldSamples, boxes: Sequence[np.ndarray], height: int, mean: np.ndarray) -> np.ndarray:
    """An environment map (H, 2 H, 3) of the field beyond the last of nested boxes (2, 3).

    mean  (3,) colour if no direction is known
    """
    total, weight = np.zeros((height * 2 * height, 3)), np.zeros(height * 2 * height)
    for rays, box, share in _boxes_of(samples, boxes):
        count = rays.stop - rays.start
        first = samples.first[rays.start : rays.stop + 1]
        ray = np.repeat(np.arange(count), np.diff(first))
        beyond = box == len(boxes)
        colour = np.zeros((count, 3))
        for channel in range(3):
            colour[:, channel] = np.bincount(
                ray[beyond], weights=share[beyond] * samples.colour[first[0] : first[-1], channel][beyond] / 255.0, minlength=count
            )
        after = np.bincount(ray[beyond], weights=share[beyond], minlength=count)
        rest = np.clip(1 - samples.opacity[rays].astype(np.float64), 0, 1)
        colour += rest[:, None] * samples.behind[rays]
        texel = environment.texels_of(samples.direction[rays], height)
        weight += np.bincount(texel, weights=after + rest, minlength=len(weight))
        for channel in range(3):
            total[:, channel] += np.bincount(texel, weights=colour[:, channel], minlength=len(weight))
    return environment.filled(total.reshape(height, 2 * height, 3), weight.reshape(height, 2 * height), mean)
