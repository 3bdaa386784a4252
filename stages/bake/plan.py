"""What is decided before an asset is baked: `bake_plan` resolves settings, field and scene to numbers, of one of three kinds.

    object  one grid over the field's box, before a constant background
    scene   nested grids around a foreground region, and an environment map: an unbounded scene
    ndc     one grid in normalised device coordinates: a forward-facing scene

What comes after takes this plan, and compares no setting with "auto".
"""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from efficientnerf.asset.bake import grid_of
from efficientnerf.asset.cascades import Grid, cascade_grids
from efficientnerf.asset.file import serialisation
from efficientnerf.geometry.spaces import NdcSpace, Space
from efficientnerf.model import Model
from efficientnerf.settings import resolved
from stages.bake.resolution import MAX_CELLS, MAX_OVERSHOOT, MAX_RESOLUTION, MIN_RESOLUTION, Choice, finest_resolution, mib_for_voxels, timed_mib, usual_mib
from stages.bake.settings import BakeSettings
from stages.evaluate.views import constant_background
from stages.io.scene import Scene, views_of

MAX_CASCADES = 8
ERROR_MAP = 0.9  # bake.error_map but for forward-facing scenes; docs/experiments/tree-training.md
# bake.view_dependent_lr_ratio without a constant background: for each training view, at least and at most. Of a voxel that few views see, view dependence is
# overfitted. docs/experiments/tree-training.md
VIEW_LR_RATIO, MIN_VIEW_DEPENDENT_LR_RATIO, MAX_VIEW_DEPENDENT_LR_RATIO = 0.0025, 0.2, 0.6
TOTAL_VARIATION, SCENE_TOTAL_VARIATION = 0.01, 0.03  # bake.total_variation, and of unbounded scenes


def coarse_cells(grids: Sequence[Grid]) -> int:
    """Coarse cells of nested grids."""
    return sum(math.prod(shape) for shape, _, _ in grids)


@dataclass(frozen=True, eq=False)
class Bake:
    kind: Literal["object", "scene", "ndc"]  # see the module
    space: Space  # the field's, in the frame that the voxels are cubes of
    background: tuple[float, float, float] | None  # constant sRGB colour that the asset is composited with; None: its environment map
    resolution: Choice  # voxels along the longest side: those stated, or the most in question; of a scene an estimate until its foreground region is known
    fixed: bool  # whether they are stated
    least_cells: int  # coarse cells of all grids, at the least resolution in question
    most_cells: int  # and at the greatest
    at_centres: bool  # whether the field was trained on the centres of the innermost grid's voxels
    min_views: int  # training images that have a voxel in view at least, in contracted space; 0: any number
    max_mib: float  # of the file
    mib: float  # that voxels are chosen by
    usual_mib: float  # of both without bake.time_budget
    timed: bool  # whether they follow from bake.time_budget
    degree: int  # of the harmonics
    layout: str
    brick_size: int
    environment_size: int  # rows; 0 without an environment map
    min_component: float  # size below which components are dropped, over that of the largest one
    refine_steps: int | None  # stated; None: as many as usual for the voxels that there will be
    seconds: float | None  # of the stage, in place of steps; None: it may take any time
    # of the refinement
    view_dependent_lr_ratio: float
    total_variation: float
    error_map: float
    # of a scene: (2, 3) that the innermost grid covers where the field was trained on voxels, whose corner is one of theirs; None: the foreground region's
    box: np.ndarray | None
    cascades: tuple[int, int]  # of a scene: how many nested grids there are, at least and at most
    max_resolution: int | None  # stated; None: as many as MAX_CELLS of all grids allow

    @property
    def least(self) -> int:
        """The least resolution in question."""
        return self.resolution.resolution if self.fixed else MIN_RESOLUTION

    def capacity(self, cells: int) -> int:
        """Voxels that the asset holds besides so many coarse cells."""
        size = int(self.mib * 2**20)
        return serialisation.most_voxels(size, self.layout, self.degree, cells, self.brick_size, environment=self.environment_size)

    @property
    def most_voxels(self) -> int:
        """Voxels that are baked at most."""
        return min(MAX_OVERSHOOT * self.capacity(1), self.most_cells * self.brick_size**3)


def bake_plan(settings: BakeSettings, m: Model, s: Scene, device: str, cores: int) -> Bake:
    """What is to be baked of a model of a scene.

    device, cores  that it is refined on: they count where the size follows from bake.time_budget
    """
    background, packed, space, brick = constant_background(s), settings.layout == "packed", _space(settings, m), settings.brick_size
    whole, max_resolution = background is None, resolved(settings.max_resolution)
    stated, trained = resolved(settings.resolution), resolved(m.settings.discretise)
    side = stated or trained
    if side:
        resolution = Choice(side, "bake.resolution" if stated else "train.discretise")
    else:
        resolution = finest_resolution(s, max_resolution or MAX_RESOLUTION)
    cascades = (1, MAX_CASCADES) if (count := resolved(settings.cascades)) is None else (count, count)
    if whole:  # of the region no more is known than that its longest side has so many voxels
        least_cells = -(-(side or MIN_RESOLUTION) // brick)
        most_cells = coarse_cells(nested_grids(space.bounds, resolution.resolution, brick, cascades[1], None))
        if not side and not max_resolution:
            most_cells = min(most_cells, 2 * MAX_CELLS)  # more by those that make grids fit each other
    else:
        least_cells, most_cells = (coarse_cells([grid_over(space, at, brick)]) for at in (side or MIN_RESOLUTION, resolution.resolution))

    mib, usual, seconds = resolved(settings.max_mib), usual_mib(s, packed=packed), resolved(settings.time_budget)
    timed = mib is None and seconds is not None and device == "cpu"
    if mib is None:
        mib = timed_mib(usual, seconds, cores, whole=whole, packed=packed) if seconds is not None and timed else usual
    ratio, smoothness, error_map = (resolved(value) for value in (settings.view_dependent_lr_ratio, settings.total_variation, settings.error_map))
    if ratio is None:
        of_views = float(np.clip(VIEW_LR_RATIO * len(views_of(s, "train")), MIN_VIEW_DEPENDENT_LR_RATIO, MAX_VIEW_DEPENDENT_LR_RATIO))
        ratio = of_views if s.background is None else 1.0
    if smoothness is None:
        smoothness = SCENE_TOTAL_VARIATION if whole else TOTAL_VARIATION
    if error_map is None:
        error_map = ERROR_MAP if s.forward is None else 0.0
    return Bake(
        kind="scene" if whole else "object" if s.forward is None else "ndc",
        space=space, background=background, resolution=resolution, fixed=bool(side), least_cells=least_cells, most_cells=most_cells,
        at_centres=trained is not None and trained == side and space is m.space,
        min_views=resolved(m.settings.min_views) or 0 if m.space.contracted else 0,
        max_mib=mib, mib=mib_for_voxels(mib, usual, packed=packed, fixed=bool(side)), usual_mib=usual, timed=timed,
        degree=m.fine.degree, layout=settings.layout, brick_size=brick, environment_size=settings.environment_size if whole else 0,
        min_component=settings.min_component if s.background is None else 0.0,
        refine_steps=resolved(settings.refine_steps) if seconds is None else None, seconds=seconds,
        view_dependent_lr_ratio=ratio, total_variation=smoothness, error_map=error_map,
        box=np.asarray(m.space.bounds, np.float64) if trained else None, cascades=cascades, max_resolution=max_resolution,
    )  # fmt: skip


def _space(settings: BakeSettings, m: Model) -> Space:
    """The field's space, in a frame where voxels are cubes."""
    space, depth = m.space, resolved(settings.ndc_voxel_depth)
    if not isinstance(space, NdcSpace):
        return space
    if depth is None:
        depth = 1.0 if resolved(m.settings.discretise) else space.voxel_depth
    return space if depth == 1 else space.with_voxel_depth(depth)


def unused_settings(settings: BakeSettings, m: Model, plan: Bake) -> Iterator[str]:
    """Warnings about settings that have no use, or that bake other voxels than the field was trained on."""
    depth, trained = resolved(settings.ndc_voxel_depth), resolved(m.settings.discretise)
    other = f"but the field was trained on train.discretise={trained}: on other voxels than are baked"
    if depth is not None and not isinstance(m.space, NdcSpace):
        yield "bake.ndc_voxel_depth is for scenes in normalised device coordinates, which this is none of: voxels are cubes"
    elif depth is not None and depth != 1 and trained:
        yield f"bake.ndc_voxel_depth={depth:g}, {other}"
    if settings.lookup == "nearest" and trained and trained != plan.resolution.resolution:
        yield f"bake.resolution={plan.resolution.resolution}, {other}"


def grid_over(space: Space, resolution: int, brick: int) -> Grid:
    """The grid over a space's box, with so many voxels along its longest side."""
    shape, voxel = grid_of(space.bounds, resolution, brick)
    return Grid(shape, voxel, np.asarray(space.bounds[0], np.float64))


def nested_grids(bounds: np.ndarray, resolution: int, brick: int, count: int, lattice: np.ndarray | None) -> list[Grid]:
    """Nested grids of which the innermost covers `bounds` with `resolution` voxels along its longest side.

    lattice  (3,) a corner of some voxel of that grid; None: they lie about the centre
    """
    voxel = float((bounds[1] - bounds[0]).max()) / resolution
    if lattice is None:
        return cascade_grids(bounds, voxel, brick, count)
    grids = cascade_grids(np.stack([bounds[0] - voxel / 2, bounds[1] + voxel / 2]), voxel, brick, count)
    offset = (grids[0][2] - lattice) / voxel
    return [grid._replace(bounds_min=grid.bounds_min + (np.round(offset) - offset) * voxel) for grid in grids]
