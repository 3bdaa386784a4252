"""The cascades of an unbounded scene and their voxels, its foreground region, and its environment map.

The field is rendered along training rays once (`efficientnerf.asset.field_samples`), and along rays past the borders of their images. The training rays' end
points give the foreground region, which the innermost cascade covers; the cascades around it hold nearly all that the photographs show, and the rest goes to
the environment map.

N voxels, P rays.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from efficientnerf.asset.bake import Visibility, chosen_voxels
from efficientnerf.asset.cascades import Grid
from efficientnerf.asset.field_samples import (
    FieldSamples,
    cascade_visibility,
    environment_beyond,
    field_samples,
    picture_places,
    seen_weights,
    surface_points,
    weight_by_box,
)
from efficientnerf.asset.tree import Region
from efficientnerf.capture.foreground import find_subject
from efficientnerf.capture.supports import Plane
from efficientnerf.model import Model
from efficientnerf.rendering.environment import lookup
from efficientnerf.training.pixels import Pixels
from pipeline.stage import Job
from stages.bake.holes import END_WEIGHT
from stages.bake.plan import Bake, nested_grids
from stages.bake.resolution import MAX_BEYOND, finest_of_cascades
from stages.bake.scratch import rendered_once
from stages.framing.view_coverage import MAX_CONTRADICTED, close_to_path, kept_pixels, poorly_seen
from stages.io import scene
from stages.io.scene import Scene
from stages.reports import bounds_are_given
from stages.train import support
from stages.train.priors import filled_points

# Of the near plane's distance: how far from the cameras' path nothing is baked. Less than in training, which masks whole density voxels alone: what it learned
# in those that are partly as close, such as a wall behind the cameras, is baked. docs/experiments/near-cameras.md
BAKED_CLEARANCE = 0.5
MAX_RATIO = 0.6  # scene bounds, of the foreground region's longest side. docs/experiments/whole-scene.md
# Where no training image looks, but the next view, which lies between no two of them, may: what the field shows there is baked too. Rays past the borders of
# training images, of those within. docs/experiments/whole-scene.md
PAST_SHARE = 0.3
CLEAR = 0.5  # share of a training ray's light that is left, from which the environment map gets it from the photograph
FOREGROUND_RAYS = 2**18  # that the foreground region is found from
CENTRES_PER_BLOCK = 2**20
KINDS = {
    "pixel": ("int64", 1), "view": ("int32", 1), "origin": ("float32", 2), "direction": ("float32", 2), "opacity": ("float32", 1), "behind": ("float16", 2),
    "first": ("int64", 1), "start": ("float32", 1), "extent": ("float32", 1), "weight": ("float32", 1), "thickness": ("float32", 1), "colour": ("uint8", 2),
}  # fmt: skip


def boxes_of(grids: Sequence[Grid], brick: int) -> list[np.ndarray]:
    """The boxes (2, 3) of nested grids."""
    return [np.stack([low, low + np.asarray(shape) * brick * voxel]) for shape, voxel, low in grids]


@dataclass(frozen=True, eq=False)
class Surroundings:
    """What only the asset of an unbounded scene has."""

    samples: FieldSamples  # what the field shows along training rays and past the borders of their images
    region: Region  # the foreground
    seen: list[np.ndarray]  # for each grid (N, 2) what rays saw of its voxels (`efficientnerf.asset.field_samples.seen_weights`)
    environment: np.ndarray  # (H, 2 H, 3) what lies beyond all grids


class Cascades:
    """The nested grids around the foreground region, and what the field's samples show of their voxels."""

    def __init__(self, job: Job, plan: Bake, m: Model, s: Scene, pixels: Pixels) -> None:
        self.job, self.plan, self.s, self.pixels = job, plan, s, pixels
        own = job.settings
        self.samples = rendered_once(
            job, "samples", FieldSamples, KINDS, lambda found: fits(found, pixels),
            lambda progress: field_samples(
                m, pixels, own.visibility_rays, own.weight_threshold, progress,
                [view.camera for view in scene.views_of(s, "train")], int(PAST_SHARE * min(own.visibility_rays, pixels.usable_count)),
            ),
        )  # fmt: skip
        job.safe_point()
        self.region = region_of(self.samples.training, pixels, s, job.inputs["poses"], support.load(job.inputs["train"]))
        self.bounds = innermost_box(self.region, s.bounds) if plan.box is None else plan.box
        self.count = cascades_needed(self.samples.training, self.bounds, *plan.cascades)
        self.finest = plan.resolution if plan.fixed else finest_of_cascades(s, self.bounds, self.count, plan.brick_size, plan.max_resolution)

    def grids(self, resolution: int) -> list[Grid]:
        return nested_grids(self.bounds, resolution, self.plan.brick_size, self.count, None if self.plan.box is None else self.plan.box[0])

    def visibility(self, grids: list[Grid]) -> list[Visibility]:
        return cascade_visibility(self.samples.training, grids, self.plan.brick_size, self.job.settings.weight_threshold)

    def with_surfaces_past_borders(self, grids: list[Grid], indices: list[np.ndarray], most: int) -> tuple[list[Visibility], list[np.ndarray]]:
        """What all rays show of the voxels of these grids, and `indices` with the voxels in which rays past the borders of images end: those of greatest
        weight, so that there are about `most` in all."""
        brick, threshold = self.plan.brick_size, END_WEIGHT
        past = cascade_visibility(self.samples.past_borders, grids, brick, END_WEIGHT)
        weights = np.sort(np.concatenate([one.greatest[one.greatest > END_WEIGHT] for one in past]))
        left = max(0, most - sum(map(len, indices)))
        if len(weights) > left:
            threshold = float(weights[-left - 1])
        ends = [chosen_voxels(one, shape, brick, threshold, 0) for one, (shape, _, _) in zip(past, grids, strict=True)]
        both = [_union(one, other, shape, brick) for one, other, (shape, _, _) in zip(indices, ends, grids, strict=True)]
        return cascade_visibility(self.samples, grids, brick, self.job.settings.weight_threshold), both

    def kept(self, indices: np.ndarray, grid: Grid) -> np.ndarray:
        """The voxels that are not close to the path of the training cameras, and that are not poorly seen."""
        views, poses = scene.views_of(self.s, "train"), self.job.inputs["poses"]
        masks, filled = kept_pixels(poses, views), filled_points(poses, len(views))
        cameras, near = [view.camera for view in views], [view.near for view in views]
        refuted = filled is not None and len(filled) > 0 and close_to_path(filled, cameras, near, BAKED_CLEARANCE, filled).mean() > MAX_CONTRADICTED

        def keep(centres: np.ndarray) -> np.ndarray:
            self.job.safe_point()
            kept = np.ones(len(centres), bool) if refuted else ~close_to_path(centres, cameras, near, BAKED_CLEARANCE, filled)
            if self.plan.min_views:
                kept[kept] = ~poorly_seen(centres[kept], self.plan.space.bounds, cameras, self.plan.min_views, masks)
            return kept

        return kept_by(keep, indices, grid)

    def surroundings(self, grids: list[Grid], seen: list[Visibility], indices: list[np.ndarray]) -> Surroundings:
        """What is baked besides these voxels."""
        samples, brick = self.samples, self.plan.brick_size
        some = samples.training.pixel
        mean = self.pixels.images[some[:: max(1, len(some) // 4096)]][:, :3].mean(axis=0) / 255.0
        environment = self._environment(boxes_of(grids, brick), mean)
        weights = [seen_weights(one, part, shape, brick) for one, part, (shape, _, _) in zip(seen, indices, grids, strict=True)]
        return Surroundings(samples, self.region, weights, environment)

    def _environment(self, boxes: Sequence[np.ndarray], mean: np.ndarray) -> np.ndarray:
        """(H, 2 H, 3) what lies beyond nested boxes (2, 3): behind what is mostly transparent, as the photographs show it, for the field's own sky is a smooth
        function; the same behind rays past their borders."""
        samples, size, behind = self.samples, self.plan.environment_size, self.samples.behind.astype(np.float32)
        shown = samples.training.colours()
        rest = 1 - samples.opacity[: len(shown)]
        clear = rest > CLEAR
        taken = self.pixels.images[samples.pixel[: len(shown)][clear]][:, :3] / np.float32(255)
        behind[: len(shown)][clear] = ((taken - shown[clear]) / rest[clear, None]).clip(0, 1)
        map_of_training = environment_beyond(replace(samples.training, behind=behind[: len(shown)]), boxes, size, mean)
        behind[len(shown) :] = lookup(map_of_training, samples.direction[len(shown) :])
        return environment_beyond(replace(samples, behind=behind), boxes, size, mean)


def kept_by(keep: Callable[[np.ndarray], np.ndarray], indices: np.ndarray, grid: Grid) -> np.ndarray:
    """The voxels (N, 3) of a grid whose centres (n, 3), some at a time, are kept."""
    _, voxel, low = grid
    parts = (indices[at : at + CENTRES_PER_BLOCK] for at in range(0, len(indices), CENTRES_PER_BLOCK))
    kept = [part[keep((part + 0.5) * voxel + low)] for part in parts]
    return np.concatenate(kept) if kept else indices


def _union(one: np.ndarray, other: np.ndarray, shape: tuple[int, int, int], brick: int) -> np.ndarray:
    """Coordinates (N, 3) int32 of the voxels of either, which are in the order of the grid, in that order."""
    size = tuple(side * brick for side in shape)
    flat = np.concatenate([np.ravel_multi_index(tuple(part.T.astype(np.int64)), size) for part in (one, other)])
    flat.sort(kind="stable")  # merges the two; `np.unique`, which hashes, takes a hundred times as long
    flat = flat[np.diff(flat, prepend=-1) > 0]
    return np.stack(np.unravel_index(flat, size), axis=-1).astype(np.int32)


def innermost_box(region: Region, scene_bounds: np.ndarray) -> np.ndarray:
    """The box (2, 3) in which voxels are finest: the foreground region's; the scene bounds, what most photographs have in view, where these are far smaller.

    A region that takes in a table and the floor round it would have voxels many pixels wide on the subject. Nothing is removed: the region goes on into the
    next cascades.
    """
    bounds, wide = np.asarray(scene_bounds, np.float64), np.asarray(region.bounds, np.float64)
    inside = np.stack([np.maximum(bounds[0], wide[0]), np.minimum(bounds[1], wide[1])])
    sides, most = inside[1] - inside[0], float((wide[1] - wide[0]).max())
    return inside if sides.min() > 0 and sides.max() < MAX_RATIO * most else wide


def cascades_needed(samples: FieldSamples, bounds: np.ndarray, least: int, most: int) -> int:
    """How many cascades around `bounds` (2, 3) hold what the photographs show, but for a share of MAX_BEYOND; from `least` to `most`."""
    if least == most:
        return most
    centre, half = bounds.mean(axis=0), (bounds[1] - bounds[0]) / 2
    weight = weight_by_box(samples, [np.stack([centre - half * 2**n, centre + half * 2**n]) for n in range(most)])
    beyond = np.cumsum(weight[::-1])[::-1][1:]  # [n]: beyond cascade n
    return int(np.argmax(np.append(beyond[:-1] <= MAX_BEYOND * max(weight.sum(), 1e-9), True))) + 1


def region_of(samples: FieldSamples, pixels: Pixels, s: Scene, poses: Path, known: Sequence[Plane] = ()) -> Region:
    """The foreground region; the scene bounds where they were given by hand (poses.crop_box), and where the field says too little.

    known  planes that support the subject, which training found
    """
    if bounds_are_given(poses):
        return Region(np.asarray(s.bounds, np.float64))
    every = slice(None, None, max(1, len(samples.pixel) // FOREGROUND_RAYS))
    cameras = [one.camera for one in scene.views_of(s, "train")]
    place = picture_places(samples, pixels, every)
    found = find_subject(surface_points(samples)[every], samples.view[every], place, cameras, weights=samples.opacity[every], known=known)
    return Region(np.asarray(s.bounds, np.float64)) if found is None else found.region


def fits(samples: FieldSamples, pixels: Pixels) -> bool:
    """Whether samples are of these pixels, and complete."""
    rays, count = len(samples.pixel), len(samples.start)
    shapes = {
        "view": (rays,), "origin": pixels.centre.shape, "direction": (rays, 3), "opacity": (rays,), "behind": (rays, 3), "first": (rays + 1,),
        "extent": (count,), "weight": (count,), "thickness": (count,), "colour": (count, 3),
    }  # fmt: skip
    if any(getattr(samples, name).shape != shape for name, shape in shapes.items()):
        return False
    ordered = samples.first[0] == 0 and samples.first[-1] == count and (np.diff(samples.first) >= 0).all()
    known = np.clip(samples.pixel, 0, len(pixels) - 1)
    views = np.where(samples.pixel < 0, -1 - samples.pixel, pixels.view_of(known))
    inside = (samples.pixel < len(pixels)).all() and (views < len(pixels.centre)).all() and (np.diff(samples.pixel < 0) >= 0).all()
    return bool(ordered and inside and np.array_equal(samples.view, views))
