"""Which voxels of one grid are baked: the resolution, and the voxels that training images show. Of unbounded scenes: `stages.bake.whole_scene`.

N voxels.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from efficientnerf.asset import bake
from efficientnerf.asset.bake import Visibility
from efficientnerf.asset.file import serialisation
from efficientnerf.geometry.ndc import Ndc
from efficientnerf.geometry.spaces import NdcSpace, Space
from efficientnerf.model import Model
from efficientnerf.settings import resolved
from efficientnerf.training.pixels import Pixels
from efficientnerf.training.settings import TrainSettings
from pipeline.stage import Job
from stages.bake.resolution import MIN_RESOLUTION, Choice, affordable_resolution, finest_resolution, refuse_without_room
from stages.bake.scratch import read_arrays, write_arrays
from stages.bake.settings import BakeSettings
from stages.framing.view_coverage import count_views, has_min_views, kept_pixels
from stages.io import scene
from stages.io.scene import Scene
from stages.scratch import unusable

MAX_OVERSHOOT = 2  # voxels baked over voxels that fit into the asset, at most: of which the refinement keeps the heaviest
OVERSHOOT = 1.7  # the same where the resolution is chosen: few of the dilated voxels show. docs/experiments/bake-resolution.md
# In normalised device coordinates a voxel that fewer training images have in view counts so many times as much: what shows there at the borders of other views
# is faint in the field. docs/experiments/bake-resolution.md
WELL_SEEN_VIEWS, FEW_VIEWS_RATIO = 4, 30.0  # of fewer than 7 training images half of them: else all voxels would be seen by few


def well_seen_views(count: int) -> int:
    """How many of so many training images see a voxel well."""
    return min(WELL_SEEN_VIEWS, -(-count // 2))



def voxel_space(job: Job, m: Model) -> Space:
    """The field's space, in a frame where voxels are cubes."""
    depth, discretise, space = resolved(job.settings.ndc_voxel_depth), resolved(m.settings.discretise), m.space
    if not isinstance(space, NdcSpace):
        if depth is not None:
            job.warn("bake.ndc_voxel_depth is for scenes in normalised device coordinates, which this is none of: voxels are cubes")
        return m.space
    if depth is None:
        depth = 1.0 if discretise else space.voxel_depth
    elif discretise and depth != 1:
        job.warn(f"bake.ndc_voxel_depth={depth:g}, but the field was trained on train.discretise={discretise}: on other voxels than are baked")
    return space if depth == 1 else space.with_voxel_depth(depth)


def choose_voxels(job: Job, m: Model, s: Scene, pixels: Pixels, space: Space, mib: float) -> tuple[Choice, Visibility, np.ndarray]:
    """The asset's resolution; the visibility of the voxels to bake, and their coordinates (N, 3)."""
    settings: BakeSettings = job.settings
    bounds, brick = space.bounds, settings.brick_size

    def room(resolution: int) -> int:
        shape, _ = bake.grid_of(bounds, resolution, brick)
        return serialisation.most_voxels(int(mib * 2**20), settings.layout, m.fine.degree, shape, brick)

    finest = choice = finest_choice(settings, m.settings, s)
    fixed = (resolved(settings.resolution) or resolved(m.settings.discretise)) is not None
    least = finest.resolution if fixed else MIN_RESOLUTION
    refuse_without_room(settings, mib, least, room(least), environment=False)
    if fixed:
        shape, voxel = bake.grid_of(bounds, choice.resolution, brick)
        visibility = _visibility(job, m, pixels, shape, voxel, np.asarray(bounds[0], np.float64), space)
        visibility = by_views(job, s, visibility, shape, voxel, space)
        return choice, visibility, _heaviest_voxels(job, visibility, shape, MAX_OVERSHOOT * room(choice.resolution))

    top_shape, top_voxel = bake.grid_of(bounds, finest.resolution, brick)
    visibility = _visibility(job, m, pixels, top_shape, top_voxel, np.asarray(bounds[0], np.float64), space)
    last: tuple[int, Visibility, np.ndarray] | None = None

    def at_resolution(resolution: int) -> tuple[int, Visibility, np.ndarray]:
        nonlocal last
        if last is None or last[0] != resolution:
            last = None
            job.safe_point()
            shape, voxel = bake.grid_of(bounds, resolution, brick)
            coarse = visibility
            if resolution != finest.resolution:
                coarse = bake.coarsened(visibility, top_shape, top_voxel, shape, voxel, brick, settings.weight_threshold)
            coarse = by_views(job, s, coarse, shape, voxel, space)
            last = resolution, coarse, bake.chosen_voxels(coarse, shape, brick, settings.weight_threshold, settings.dilate)
        return last

    choice = affordable_resolution(finest, lambda at: len(at_resolution(at)[2]), lambda at: int(OVERSHOOT * room(at)))
    _, coarse, indices = at_resolution(choice.resolution)
    most = MAX_OVERSHOOT * room(choice.resolution)
    if len(indices) > most:
        indices = _heaviest_voxels(job, coarse, bake.grid_of(bounds, choice.resolution, brick)[0], most)
    return choice, coarse, indices


def by_views(job: Job, s: Scene, visibility: Visibility, shape: tuple[int, int, int], voxel: float, space: Space) -> Visibility:
    """The visibility, in normalised device coordinates with smaller weights where many training images have voxels in view.

    The refinement drops what the field shows faintly behind and before its surfaces: finer voxels use the space better.
    """
    if space.ndc is None:
        return visibility
    brick = job.settings.brick_size
    cells = np.stack(np.unravel_index(visibility.cells, shape), axis=-1)
    few = seen_by_few(job, s, space.ndc, (cells + 0.5) * (voxel * brick) + np.asarray(space.bounds[0], np.float64))
    return replace(visibility, greatest=visibility.greatest * np.where(few, 1, 1 / FEW_VIEWS_RATIO).astype(np.float32)[:, None])


def seen_by_few(job: Job, s: Scene, ndc: Ndc, points: np.ndarray) -> np.ndarray:
    """(N,) bool: which points (N, 3) in normalised device coordinates fewer training images have in view than `well_seen_views`, by pixels that are kept."""
    views = scene.views_of(s, "train")
    return count_views(ndc.world(points), [view.camera for view in views], kept_pixels(job.inputs["poses"], views)) < well_seen_views(len(views))


def finest_choice(settings: BakeSettings, trained: TrainSettings, s: Scene) -> Choice:
    """The resolution that is stated, or else the finest in question."""
    stated: int | None = resolved(settings.resolution)
    discretise: int | None = resolved(trained.discretise)
    if (fixed := stated or discretise) is not None:
        return Choice(fixed, "bake.resolution" if stated else "train.discretise")
    return finest_resolution(s, resolved(settings.max_resolution))


def _visibility(job: Job, m: Model, pixels: Pixels, shape: tuple[int, int, int], voxel: float, low: np.ndarray, space: Space) -> Visibility:
    """The visibility of voxels, computed or from an earlier attempt."""
    settings: BakeSettings = job.settings
    kinds = {"cells": ("int64", 1), "greatest": ("float32", 2)}
    stored = read_arrays(job.work / "visibility", kinds, job.warn)
    if stored is not None:
        found = bake.Visibility(**{name: np.array(part) for name, part in stored.items()})
        if _fits(found, int(np.prod(shape)), settings.brick_size**3):
            return found
        job.warn(unusable(job.work / "visibility", "of another grid"))

    def progress(done: int, total: int) -> None:
        job.progress(done, total, "rendering for visible voxels")
        job.safe_point()

    visibility = bake.visible_voxels(m, pixels, shape, voxel, low, settings.brick_size, settings.visibility_rays, progress, space)
    write_arrays({name: getattr(visibility, name) for name in kinds}, job.work / "visibility")
    return visibility


def _fits(found: Visibility, cells: int, per_cell: int) -> bool:
    """Whether a visibility is of so many coarse cells with so many voxels each."""
    ascending = not len(found.cells) or (found.cells[0] >= 0 and found.cells[-1] < cells and (np.diff(found.cells) > 0).all())
    return bool(ascending and found.greatest.shape == (len(found.cells), per_cell))


def _heaviest_voxels(job: Job, visibility: Visibility, shape: tuple[int, int, int], most: int) -> np.ndarray:
    """Coordinates (N, 3) of the visible voxels: about `most` at most, and then those of greatest weight."""
    settings: BakeSettings = job.settings
    threshold = settings.weight_threshold
    indices = bake.chosen_voxels(visibility, shape, settings.brick_size, threshold, settings.dilate)
    weights = np.sort(visibility.greatest[visibility.greatest > threshold])
    while len(indices) > most and len(weights) > 1:
        job.safe_point()
        # Dilated voxels are about in proportion to the visible ones; a little less, so that this ends soon.
        weights = weights[-max(1, int(0.95 * len(weights) * most / len(indices))) :]
        indices = bake.chosen_voxels(visibility, shape, settings.brick_size, float(weights[0]), settings.dilate)
    if not len(indices) and len(weights):  # of equals all, where none is heavier
        indices = bake.chosen_voxels(visibility, shape, settings.brick_size, just_below(weights[0]), settings.dilate)
    return indices


def just_below(weight: np.float32) -> float:
    """The next smaller weight, as a threshold that a weight has to exceed."""
    return float(np.nextafter(weight, np.float32(-1)))


CENTRES_PER_BLOCK = 2**20


def with_min_views(m: Model, s: Scene, indices: np.ndarray, resolution: int) -> np.ndarray:
    """The voxels that at least train.min_views training images have in view, in contracted scenes. The density voxels, which training masked
    elsewhere (`stages.framing.view_coverage`), are larger, and what they hold would stick out as a rim."""
    if not m.space.contracted or m.settings.min_views == "off":
        return indices
    cameras = [view.camera for view in scene.views_of(s, "train")]
    low, high = np.asarray(m.space.bounds, np.float64)
    voxel = float((high - low).max()) / resolution
    parts = (indices[at : at + CENTRES_PER_BLOCK] for at in range(0, len(indices), CENTRES_PER_BLOCK))
    keep = [has_min_views((part + 0.5) * voxel + low, cameras, m.settings.min_views) for part in parts]
    return indices[np.concatenate(keep)] if keep else indices
