"""The cascades of an unbounded scene and their voxels, its foreground region, and its environment map.

The field is rendered along training rays once (`efficientnerf.asset.field_samples`). Their end points give the foreground region, which the innermost
cascade covers; the cascades around it hold nearly all that the photographs show, and the rest goes to the environment map. All voxels compete
for the asset's size by the weight that they have in some pixel, wherever they are.

N voxels, P rays.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import fields
from pathlib import Path

import numpy as np

from efficientnerf.asset.bake import Visibility, chosen_voxels
from efficientnerf.asset.cascades import cascade_grids
from efficientnerf.asset.field_samples import (
    FieldSamples,
    Grid,
    cascade_visibility,
    environment_beyond,
    field_samples,
    picture_places,
    seen_weights,
    surface_points,
    weight_by_box,
)
from efficientnerf.asset.file.serialisation import most_voxels
from efficientnerf.asset.tree import Region
from efficientnerf.capture.foreground import find_foreground
from efficientnerf.geometry.spaces import Space
from efficientnerf.model import Model
from efficientnerf.settings import resolved
from efficientnerf.training.pixels import Pixels
from pipeline.stage import Job
from stages.bake.plan import Plan
from stages.bake.resolution import (
    MAX_BEYOND,
    MAX_CASCADES,
    MIN_RESOLUTION,
    Choice,
    affordable_resolution,
    finest_of_cascades,
    refuse_without_room,
)
from stages.bake.scratch import read_arrays, write_arrays
from stages.bake.settings import BakeSettings
from stages.bake.voxels import MAX_OVERSHOOT, OVERSHOOT, just_below
from stages.framing.view_coverage import MAX_CONTRADICTED, close_to_path, kept_pixels, poorly_seen
from stages.io import scene
from stages.io.scene import Scene
from stages.reports import bounds_are_given
from stages.scratch import unusable
from stages.train.priors import filled_points

# Of the near plane's distance: how far from the cameras' path nothing is baked. Less than in training, which masks whole density voxels alone: what it learned
# in those that are partly as close, such as a wall behind the cameras, is baked. docs/experiments/near-cameras.md
BAKED_CLEARANCE = 0.5
FOREGROUND_RAYS = 2**18  # that the foreground region is found from
CENTRES_PER_BLOCK = 2**20
KINDS = {
    "pixel": ("int64", 1), "view": ("int32", 1), "origin": ("float32", 2), "direction": ("float32", 2), "opacity": ("float32", 1), "behind": ("float16", 2),
    "first": ("int64", 1), "start": ("float32", 1), "extent": ("float32", 1), "weight": ("float32", 1), "thickness": ("float32", 1), "colour": ("uint8", 2),
}  # fmt: skip


def boxes_of(grids: Sequence[Grid], brick: int) -> list[np.ndarray]:
    """The boxes (2, 3) of nested grids."""
    return [np.stack([low, low + np.asarray(shape) * brick * voxel]) for shape, voxel, low in grids]


def choose_scene_voxels(job: Job, m: Model, s: Scene, pixels: Pixels, space: Space, mib: float) -> Plan:
    """The cascades, their voxels, the region and the environment."""
    settings: BakeSettings = job.settings
    stated, discretise = resolved(settings.resolution), resolved(m.settings.discretise)
    fixed = stated or discretise
    least = fixed or MIN_RESOLUTION
    # The region is not known before the field is rendered: only that its longest side has so many voxels.
    line: Grid = ((-(-least // settings.brick_size), 1, 1), 1.0, np.zeros(3))
    refuse_without_room(settings, mib, least, room_of(settings, m, [line], mib), environment=True)
    samples = _samples(job, m, pixels)
    job.safe_point()
    region = region_of(samples, pixels, s, job.inputs["poses"])
    # A field that was trained on the voxels of its box is baked on these.
    bounds = np.asarray(m.space.bounds if discretise else region.bounds, np.float64)
    count = cascades_needed(samples, bounds, resolved(settings.cascades))
    last: tuple[int, list[Grid], list[Visibility], list[np.ndarray]] | None = None

    def grids_at(resolution: int) -> list[Grid]:
        return grids_of(bounds, resolution, settings.brick_size, count, m.space.bounds[0] if discretise else None)

    def room(resolution: int) -> int:
        return room_of(settings, m, grids_at(resolution), mib)

    def at_resolution(resolution: int) -> tuple[int, list[Grid], list[Visibility], list[np.ndarray]]:
        nonlocal last
        if last is None or last[0] != resolution:
            last = None
            job.safe_point()
            grids = grids_at(resolution)
            seen = cascade_visibility(samples, grids, settings.brick_size, settings.weight_threshold)
            last = resolution, grids, seen, chosen_of(seen, grids, settings, settings.weight_threshold)
        return last

    refuse_without_room(settings, mib, least, room(least), environment=True)
    if fixed is not None:
        choice = Choice(fixed, "bake.resolution" if stated else "train.discretise")
    else:
        finest = finest_of_cascades(s, bounds, count, settings.brick_size, resolved(settings.max_resolution))
        choice = affordable_resolution(finest, lambda at: sum(map(len, at_resolution(at)[3])), lambda at: int(OVERSHOOT * room(at)))
    _, grids, seen, indices = at_resolution(choice.resolution)
    indices = heaviest_of(job, seen, grids, indices, MAX_OVERSHOOT * room(choice.resolution))
    indices = [keep_clear(job, m, s, part, grid) for part, grid in zip(indices, grids, strict=True)]
    mean = pixels.images[samples.pixel[:: max(1, len(samples.pixel) // 4096)]][:, :3].mean(axis=0) / 255.0
    environment = environment_beyond(samples, boxes_of(grids, settings.brick_size), settings.environment_size, mean)
    weights = [seen_weights(one, part, shape, settings.brick_size) for one, part, (shape, _, _) in zip(seen, indices, grids, strict=True)]
    return Plan(choice, space, grids, indices, sum(len(one.cells) for one in seen), weights, samples, region, environment)


def room_of(settings: BakeSettings, m: Model, grids: Sequence[Grid], mib: float, *, environment: bool = True) -> int:
    """How many voxels an asset of so many MiB holds, besides the cells of these grids and an environment map."""
    cells = sum(math.prod(shape) for shape, _, _ in grids)
    rows = settings.environment_size if environment else 0
    return most_voxels(int(mib * 2**20), settings.layout, m.fine.degree, (cells, 1, 1), settings.brick_size, environment=rows)


def grids_of(bounds: np.ndarray, resolution: int, brick: int, count: int, lattice: np.ndarray | None) -> list[Grid]:
    """Nested grids of which the innermost covers `bounds` with `resolution` voxels along its longest side.

    lattice  (3,) a corner of some voxel of that grid; None: they lie about the centre
    """
    voxel = float((bounds[1] - bounds[0]).max()) / resolution
    if lattice is None:
        return cascade_grids(bounds, voxel, brick, count)
    grids = cascade_grids(np.stack([bounds[0] - voxel / 2, bounds[1] + voxel / 2]), voxel, brick, count)
    offset = (grids[0][2] - lattice) / voxel
    return [(shape, side, low + (np.round(offset) - offset) * voxel) for shape, side, low in grids]


def cascades_needed(samples: FieldSamples, bounds: np.ndarray, stated: int | None) -> int:
    """How many cascades around `bounds` (2, 3) hold what the photographs show, but for a share of MAX_BEYOND."""
    if stated is not None:
        return stated
    centre, half = bounds.mean(axis=0), (bounds[1] - bounds[0]) / 2
    weight = weight_by_box(samples, [np.stack([centre - half * 2**n, centre + half * 2**n]) for n in range(MAX_CASCADES)])
    beyond = np.cumsum(weight[::-1])[::-1][1:]  # [n]: beyond cascade n
    return int(np.argmax(np.append(beyond[:-1] <= MAX_BEYOND * max(weight.sum(), 1e-9), True))) + 1


def region_of(samples: FieldSamples, pixels: Pixels, s: Scene, poses: Path) -> Region:
    """The foreground region; the scene bounds where they were given by hand (poses.crop_box), and where the field says too little."""
    if bounds_are_given(poses):
        return Region(np.asarray(s.bounds, np.float64))
    every = slice(None, None, max(1, len(samples.pixel) // FOREGROUND_RAYS))
    cameras = [one.camera for one in scene.views_of(s, "train")]
    place = picture_places(samples, pixels, every)
    found = find_foreground(surface_points(samples)[every], samples.view[every], place, cameras, weights=samples.opacity[every])
    return Region(np.asarray(s.bounds, np.float64)) if found is None else found


def chosen_of(seen: Sequence[Visibility], grids: Sequence[Grid], settings: BakeSettings, threshold: float) -> list[np.ndarray]:
    """Coordinates (N, 3) of the visible voxels of each cascade, dilated. Into the box of the cascade before they reach by one voxel, from which values just
    outside of it are interpolated."""
    chosen = []
    boxes = boxes_of(grids, settings.brick_size)
    for n, (visibility, (shape, voxel, low)) in enumerate(zip(seen, grids, strict=True)):
        indices = chosen_voxels(visibility, shape, settings.brick_size, threshold, settings.dilate)
        if n:
            inner = np.round((boxes[n - 1] - low) / voxel)
            indices = indices[((indices < inner[0] + 1) | (indices >= inner[1] - 1)).any(axis=1)]
        chosen.append(indices)
    return chosen


def heaviest_of(job: Job, seen: Sequence[Visibility], grids: Sequence[Grid], indices: list[np.ndarray], most: int) -> list[np.ndarray]:
    """The voxels of all cascades, or where these are more than about `most` those of greatest weight."""
    settings: BakeSettings = job.settings
    weights = np.sort(np.concatenate([one.greatest[one.greatest > settings.weight_threshold] for one in seen]))
    while (count := sum(map(len, indices))) > most and len(weights) > 1:
        job.safe_point()
        # Dilated voxels are about in proportion to the visible ones; a little less, so that this ends soon.
        weights = weights[-max(1, int(0.95 * len(weights) * most / count)) :]
        indices = chosen_of(seen, grids, settings, float(weights[0]))
    if not any(map(len, indices)) and len(weights):  # of equals all, where none is heavier
        indices = chosen_of(seen, grids, settings, just_below(weights[0]))
    return indices


def keep_clear(job: Job, m: Model, s: Scene, indices: np.ndarray, grid: Grid) -> np.ndarray:
    """The voxels that are not close to the path of the training cameras, and that are not poorly seen."""
    views = scene.views_of(s, "train")
    masks, filled = kept_pixels(job.inputs["poses"], views), filled_points(job.inputs["poses"], len(views))
    cameras, near = [view.camera for view in views], [view.near for view in views]
    refuted = filled is not None and len(filled) > 0 and close_to_path(filled, cameras, near, BAKED_CLEARANCE, filled).mean() > MAX_CONTRADICTED
    _, voxel, low = grid
    min_views = resolved(m.settings.min_views) if m.space.contracted else None
    kept = []
    for at in range(0, len(indices), CENTRES_PER_BLOCK):
        job.safe_point()
        centre = (indices[at : at + CENTRES_PER_BLOCK] + 0.5) * voxel + low
        keep = np.ones(len(centre), bool) if refuted else ~close_to_path(centre, cameras, near, BAKED_CLEARANCE, filled)
        if min_views is not None:
            keep[keep] = ~poorly_seen(centre[keep], m.space.bounds, cameras, min_views, masks)
        kept.append(keep)
    return indices[np.concatenate(kept)] if kept else indices


def _samples(job: Job, m: Model, pixels: Pixels) -> FieldSamples:
    """The field's samples, taken or from an earlier attempt."""
    settings: BakeSettings = job.settings
    stored = read_arrays(job.work / "samples", KINDS, job.warn)
    if stored is not None:
        found = FieldSamples(**{name: np.array(part) for name, part in stored.items()})
        if fits(found, pixels):
            return found
        job.warn(unusable(job.work / "samples", "of other images, or not in order"))

    def progress(done: int, total: int) -> None:
        job.progress(done, total, "rendering for visible voxels")
        job.safe_point()

    samples = field_samples(m, pixels, settings.visibility_rays, settings.weight_threshold, progress)
    write_arrays({field.name: getattr(samples, field.name) for field in fields(samples)}, job.work / "samples")
    return samples


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
    inside = not rays or (samples.pixel.min() >= 0 and samples.pixel.max() < len(pixels))
    return bool(ordered and inside and np.array_equal(samples.view, pixels.view_of(samples.pixel)))
