"""Which voxels are baked: the resolution, and the voxels that training images show.

All voxels compete for the asset's size by the weight that they have in some pixel, wherever they are. N voxels.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from efficientnerf.asset import bake
from efficientnerf.asset.bake import Visibility
from efficientnerf.asset.cascades import Grid
from efficientnerf.geometry.ndc import Ndc
from efficientnerf.geometry.spaces import Space
from efficientnerf.model import Model
from efficientnerf.training.pixels import Pixels
from pipeline.errors import StageFailed, UsageError
from pipeline.stage import Job
from stages.bake.plan import Bake, coarse_cells, grid_over
from stages.bake.resolution import MAX_OVERSHOOT, MIN_RESOLUTION, OVERSHOOT, Choice, affordable_resolution
from stages.bake.scratch import rendered_once
from stages.bake.settings import BakeSettings
from stages.bake.whole_scene import Cascades, Surroundings, boxes_of, kept_by
from stages.framing.view_coverage import count_views, has_min_views, kept_pixels
from stages.io import scene
from stages.io.scene import Scene

# In normalised device coordinates a voxel that fewer training images have in view counts so many times as much: what shows there at the borders of other views
# is faint in the field. docs/experiments/bake-resolution.md
WELL_SEEN_VIEWS, FEW_VIEWS_RATIO = 4, 30.0  # of fewer than 7 training images half of them: else all voxels would be seen by few


@dataclass(frozen=True, eq=False)
class Voxels:
    """Voxels that are baked."""

    choice: Choice
    grids: list[Grid]  # nested, the innermost first; one unless the scene is unbounded
    indices: list[np.ndarray]  # coordinates (N, 3) of the voxels in each of them
    bricks: int  # coarse cells that hold a sample, of all grids
    surroundings: Surroundings | None = None  # of unbounded scenes alone

    @property
    def count(self) -> int:
        return sum(map(len, self.indices))


def choose_voxels(job: Job, plan: Bake, m: Model, s: Scene, pixels: Pixels) -> Voxels:
    """The resolution, and the voxels that training images show: the heaviest where these are more than the asset holds. StageFailed where there are none."""
    settings: BakeSettings = job.settings
    refuse_without_capacity(plan, plan.least_cells)
    shown = Cascades(job, plan, m, s, pixels) if plan.kind == "scene" else OneGrid(job, plan, m, s, pixels)
    refuse_without_capacity(plan, coarse_cells(shown.grids(plan.least)))
    last: tuple[int, list[Grid], list[Visibility], list[np.ndarray]] | None = None

    def at_resolution(resolution: int) -> tuple[int, list[Grid], list[Visibility], list[np.ndarray]]:
        nonlocal last
        if last is None or last[0] != resolution:
            last = None
            job.safe_point()
            grids = shown.grids(resolution)
            seen = shown.visibility(grids)
            last = resolution, grids, seen, chosen_of(seen, grids, settings, settings.weight_threshold)
        return last

    def capacity(resolution: int) -> int:
        return plan.capacity(coarse_cells(shown.grids(resolution)))

    choice = shown.finest
    if not plan.fixed:
        choice = affordable_resolution(choice, lambda at: sum(map(len, at_resolution(at)[3])), lambda at: int(OVERSHOOT * capacity(at)))
    _, grids, seen, indices = at_resolution(choice.resolution)
    indices = heaviest_of(job, seen, grids, indices, MAX_OVERSHOOT * capacity(choice.resolution))
    if isinstance(shown, Cascades):
        seen, indices = shown.with_surfaces_past_borders(grids, indices, int(MAX_OVERSHOOT * capacity(choice.resolution)))
    indices = [shown.kept(part, grid) for part, grid in zip(indices, grids, strict=True)]
    voxels = Voxels(choice, grids, indices, sum(len(one.cells) for one in seen), shown.surroundings(grids, seen, indices))
    if not voxels.count:
        found = "no voxel of the box contributes to any training image"
        raise StageFailed(f"bake: the trained field is empty: {found}. Train longer, or check the box (poses.crop_box).")
    of = f" of {len(grids)} cascades" if plan.kind == "scene" else ""
    job.say(f"{choice.resolution} voxels along the longest side ({choice.why}); {voxels.count:,} voxels{of} are baked")
    return voxels


def refuse_without_capacity(plan: Bake, cells: int) -> None:
    """UsageError where the asset cannot hold one voxel besides so many coarse cells, those at the least resolution in question, and an environment map.
    Otherwise all voxels would be dropped, and the field would seem empty."""
    if plan.capacity(cells) > 0:
        return
    besides, lower = f"the coarse cells of {plan.least} voxels along the longest side", [] if plan.least <= MIN_RESOLUTION else [plan.resolution.why]
    if plan.environment_size:
        besides += f" and an environment map of {plan.environment_size} rows"
        lower.append(f"bake.environment_size ({plan.environment_size})")
    remedy = "Raise bake.max_mib (--target-mib)" + (f", or lower {' or '.join(lower)}" if lower else "")
    raise UsageError(f"bake.max_mib={plan.mib:.3g}: has no space for voxels besides {besides}. {remedy}.")


class OneGrid:
    """The grid over the field's box. What training images show of its voxels is measured once, at the finest resolution in question."""

    def __init__(self, job: Job, plan: Bake, m: Model, s: Scene, pixels: Pixels) -> None:
        self.job, self.plan, self.s, self.finest = job, plan, s, plan.resolution
        self.top = grid_over(plan.space, self.finest.resolution, plan.brick_size)
        settings: BakeSettings = job.settings

        def fits(found: Visibility) -> bool:
            ascending = not len(found.cells) or (found.cells[0] >= 0 and found.cells[-1] < coarse_cells([self.top]) and (np.diff(found.cells) > 0).all())
            return bool(ascending and found.greatest.shape == (len(found.cells), settings.brick_size**3))

        def measured(progress: Callable[[int, int], None]) -> Visibility:
            return bake.visible_voxels(m, pixels, *self.top, settings.brick_size, settings.visibility_rays, progress, plan.space)

        self.measured = rendered_once(job, "visibility", Visibility, {"cells": ("int64", 1), "greatest": ("float32", 2)}, fits, measured)

    def grids(self, resolution: int) -> list[Grid]:
        return [grid_over(self.plan.space, resolution, self.plan.brick_size)]

    def visibility(self, grids: list[Grid]) -> list[Visibility]:
        [(shape, voxel, _)], found = grids, self.measured
        if voxel != self.top[1]:
            found = bake.coarsened(found, self.top[0], self.top[1], shape, voxel, self.plan.brick_size, self.job.settings.weight_threshold)
        return [by_views(self.job, self.s, found, shape, voxel, self.plan.space)]

    def kept(self, indices: np.ndarray, grid: Grid) -> np.ndarray:
        """The voxels that enough training images have in view. The density voxels, which training masked elsewhere (`stages.framing.view_coverage`), are
        larger, and what they hold would stick out as a rim."""
        if not self.plan.min_views:
            return indices
        cameras = [view.camera for view in scene.views_of(self.s, "train")]
        return kept_by(lambda centres: has_min_views(centres, cameras, self.plan.min_views), indices, grid)

    def surroundings(self, grids: list[Grid], seen: list[Visibility], indices: list[np.ndarray]) -> None:
        """None: nothing lies around the box."""


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
    """(N,) bool: which points (N, 3) in normalised device coordinates fewer training images have in view than see a voxel well, by pixels that are kept."""
    views = scene.views_of(s, "train")
    well = min(WELL_SEEN_VIEWS, -(-len(views) // 2))
    return count_views(ndc.world(points), [view.camera for view in views], kept_pixels(job.inputs["poses"], views)) < well


def chosen_of(seen: Sequence[Visibility], grids: Sequence[Grid], settings: BakeSettings, threshold: float) -> list[np.ndarray]:
    """Coordinates (N, 3) of the visible voxels of each grid, dilated. Into the box of the grid before they reach by one voxel, from which values just
    outside of it are interpolated."""
    chosen = []
    boxes = boxes_of(grids, settings.brick_size)
    for n, (visibility, (shape, voxel, low)) in enumerate(zip(seen, grids, strict=True)):
        indices = bake.chosen_voxels(visibility, shape, settings.brick_size, threshold, settings.dilate)
        if n:
            inner = np.round((boxes[n - 1] - low) / voxel)
            indices = indices[((indices < inner[0] + 1) | (indices >= inner[1] - 1)).any(axis=1)]
        chosen.append(indices)
    return chosen


def heaviest_of(job: Job, seen: Sequence[Visibility], grids: Sequence[Grid], indices: list[np.ndarray], most: int) -> list[np.ndarray]:
    """The voxels of all grids, or where these are more than about `most` those of greatest weight."""
    settings: BakeSettings = job.settings
    weights = np.sort(np.concatenate([one.greatest[one.greatest > settings.weight_threshold] for one in seen]))
    while (count := sum(map(len, indices))) > most and len(weights) > 1:
        job.safe_point()
        # Dilated voxels are about in proportion to the visible ones; a little less, so that this ends soon.
        weights = weights[-max(1, int(0.95 * len(weights) * most / count)) :]
        indices = chosen_of(seen, grids, settings, float(weights[0]))
    if not any(map(len, indices)) and len(weights):  # of equals all, where none is heavier than the threshold
        indices = chosen_of(seen, grids, settings, float(np.nextafter(weights[0], np.float32(-1))))
    return indices
