"""Priors: rules that mask density voxels before the first step, and the evidence that refutes them.

    min_views    what fewer than `train.min_views` views show could be at any depth
    near_planes  what lies before the near planes, and close to the cameras, is empty
    masks        what no view shows in a pixel that its mask keeps is left out

And `among_cameras`, which masks voxels until a quarter of the steps alone: all round a subject, what opposite views alone see is background.

Reliable sparse points (`stages.framing.near_planes`) are evidence that space is filled. The first two are dropped where they contradict more than
MAX_CONTRADICTED of them; masks are given by the user, or by a stage that has checked them. All rules of the program: docs/priors.md.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

from efficientnerf.capture.coverage import meeting_point
from efficientnerf.geometry.cameras import Camera
from efficientnerf.model import Model
from efficientnerf.sampling.occupancy import mask_cells
from efficientnerf.settings import resolved
from pipeline.stage import Job
from stages.artifacts import PosesOutputs
from stages.framing.near_planes import reliable_points
from stages.framing.view_coverage import (
    MAX_CONTRADICTED,
    Masks,
    cells_among_cameras,
    cells_before_near,
    cells_below_min_views,
    cells_without_view,
    contradicted,
    kept_pixels,
)
from stages.io import scene
from stages.io.scene import View


@dataclass(frozen=True)
class Prior:
    """The effect of a prior."""

    name: str
    masked: float  # share of the density voxels
    contradicted: float  # share of the reliable sparse points that lie in them
    applied: bool  # whether it was


def mask_uncovered_cells(m: Model, views: tuple[View, ...], job: Job) -> tuple[Prior, ...]:
    """Mask the density voxels of a scene's model by the priors that hold; a warning says which the sparse points refute."""
    if not m.space.contracted and all(view.mask is None for view in views):
        return ()
    job.progress(0, m.settings.iterations, "computing view coverage")
    folder = job.inputs["poses"]
    near, cameras = [view.near for view in views], [view.camera for view in views]
    found = mask_cells_by(m, cameras, near, kept_pixels(folder, views), filled_points(folder, len(views)))
    for prior in found:
        if prior.contradicted > MAX_CONTRADICTED:
            job.warn(
                f"the prior {prior.name} is not used: it would keep {100 * prior.masked:.0f} % of the scene empty, but {100 * prior.contradicted:.0f} % "
                "of the reliable sparse points lie there. Some cameras may be wrong. Check their picture in the report."
            )
    return found


def mask_cells_by(
    m: Model, cameras: Sequence[Camera], near: Sequence[float], masks: Masks | None, filled: np.ndarray | None
) -> tuple[Prior, ...]:
    """The same by the views' cameras and near planes, what their masks keep, and the reliable sparse points (F, 3)."""
    found = []
    for name, cells in _cells_of_priors(m, cameras, near, masks, filled):
        against = 0.0 if name == "masks" or filled is None else contradicted(cells, m.space, filled)
        found.append(Prior(name, float(cells.mean()), against, against <= MAX_CONTRADICTED))
        if found[-1].applied:
            mask_cells(m.voxels, torch.from_numpy(cells))
    return tuple(found)


def _cells_of_priors(
    m: Model, cameras: Sequence[Camera], near: Sequence[float], masks: Masks | None, filled: np.ndarray | None
) -> Iterator[tuple[str, np.ndarray]]:
    """The names of the priors that a scene calls for, and the density voxels (D, D, D) bool that each masks."""
    few, side = resolved(m.settings.min_views) if m.space.contracted else None, m.voxels.side
    if few is not None:
        yield "min_views", cells_below_min_views(m.space, cameras, few, side, masks)
    if m.space.contracted:
        yield "near_planes", cells_before_near(m.space, cameras, near, side, filled)
    if masks is not None:
        yield "masks", cells_without_view(m.space, cameras, side, masks)


def cells_closed_at_first(m: Model, views: tuple[View, ...], folder: Path) -> torch.Tensor | None:
    """(D, D, D) bool: the density voxels among the cameras of a scene, which open later (`efficientnerf.training.loop.Trainer.closed`); None where the cameras
    do not stand round a subject."""
    cameras = [view.camera for view in views]
    if not m.space.contracted or not meeting_point(cameras)[1]:
        return None
    return torch.from_numpy(cells_among_cameras(m.space, cameras, m.voxels.side, filled_points(folder, len(views))))


def filled_points(folder: Path, views: int) -> np.ndarray | None:
    """(F, 3) the reliable sparse points of a scene, training frame; None where it has no points.

    views  number of photographs
    """
    if not PosesOutputs(folder).points.exists():
        return None
    points = scene.read_points(folder)
    return points.xyz[reliable_points(points, views)]
