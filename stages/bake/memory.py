"""What baking takes: at most, before it begins; and once its voxels are known. docs/experiments/memory.md"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Protocol

from pipeline.executors.memory import size_text
from pipeline.stage import Job
from stages.cores import count_cores
from stages.memory.need import Need, has_room, libraries, refuse_what_does_not_fit
from stages.train.data import channels_of, count_pixels
from stages.train.memory import DENSITY_VOXEL, PIXELS, parameters, pixels_needed, place_pixels
from stages.train.pixel_file import PixelFile

if TYPE_CHECKING:
    from efficientnerf.geometry.spaces import Space
    from efficientnerf.training.pixels import PixelRows
    from efficientnerf.training.settings import TrainSettings
    from stages.bake.plan import Plan
    from stages.bake.run import BakeSettings
    from stages.io.scene import Scene, View

COPIES = 3  # of every voxel's values at the same time: as baked, in the tree, and in the refinement
PACKED_COPIES = 1  # and while codes are chosen and fitted: the tree's own, those in the order of the file or decoded, two in the refinement
# Bytes. Of a voxel besides its values: coordinates and keys while it is sorted into the tree; of a coarse cell: its brick, its row while voxels are chosen,
# its distance to the next one; of a brick's voxel: greatest weight, three times while they grow, and its number; of a training pixel that visibility is
# measured on: its number, or of whole scenes the field's samples along its ray, twice while they are joined; of a ray of a refinement step: its records.
VOXEL, CELL, BRICK_VOXEL, VISIBILITY_RAY, SCENE_RAY, REFINEMENT_RAY = 130, 20, 16, 64, 400, 5000
ERROR_CELL = 48  # bytes of a cell of the error map: two errors, chances, factors and numbers of tiles, and what is made of these
MAX_SHARES = 16  # of the rays, each with the greatest weights of all voxels: efficientnerf.backends.numba.tree.contributions


class AtMost(Protocol):
    def __call__(self, count: int, *, stored: bool) -> Need:
        """What baking so many voxels takes; `stored` as for `needed`."""


@dataclass(frozen=True)
class Trained:
    """What of a field decides how much is baked: its settings, with numbers for what is "auto", its space, and the degree of its harmonics."""

    settings: TrainSettings
    space: Space
    degree: int


def voxels_needed(voxels: int, harmonics: int, *, packed: bool = False) -> int:
    """Bytes that density and K harmonics of so many voxels take while they are baked and refined, and `packed`, in float32."""
    return ((COPIES + PACKED_COPIES * packed) * 4 * (1 + 3 * harmonics) + VOXEL + 4 * min(MAX_SHARES, count_cores())) * voxels


def needed_on_device(voxels: int, harmonics: int, bricks: int, cells: int, brick: int, *, smooth: bool) -> int:
    """Bytes that such a tree takes on a device while it is refined there (`efficientnerf.asset.refinement.device`): values and means of squares in
    float32, visits and stamps, sums of gradients in 64 bits; where there is a total variation (`smooth`) the six voxels beside each, and densities before a
    step; of bricks their voxels with a border; of the grid's cells three numbers while it is sent."""
    return (28 + 36 * harmonics + 28 * smooth) * voxels + 4 * (brick + 2) ** 3 * bricks + 12 * cells


def free_on_device(device: str) -> int:
    """Bytes available on a CUDA device: free ones, and those that this process has reserved but not allocated."""
    import torch

    return torch.cuda.mem_get_info(device)[0] + torch.cuda.memory_reserved(device) - torch.cuda.memory_allocated(device)


def needed(
    settings: BakeSettings, trained: Any, views: Sequence[View], channels: int, *, cells: int, bricks: int, voxels: int, degree: int, stored: bool,
    whole: bool, device: str,
) -> Need:  # fmt: skip
    """What baking takes.

    trained   settings of the field
    channels  of the pixels
    cells     coarse cells of the finest grids in question
    bricks    that are reached by samples, at most
    voxels    that are baked
    stored    whether the pixels are in a file
    whole     whether a whole scene is baked
    """
    from efficientnerf.asset.refinement.error_map import MAX_CELLS
    from efficientnerf.asset.refinement.fit import PATCH_SIDE
    from efficientnerf.settings import given

    pixels = pixels_needed(views, channels, stored=stored)
    rays = min(settings.visibility_rays, count_pixels(tuple(views)))
    return Need({
        PIXELS: pixels[PIXELS],
        "voxels": max(voxels_needed(voxels, (degree + 1) ** 2, packed=settings.layout == "packed"), pixels["reading images"] + pixels["directions of pixels"]),
        "the grid": CELL * cells + BRICK_VOXEL * settings.brick_size**3 * bricks,
        "rays": (SCENE_RAY if whole else VISIBILITY_RAY) * rays + REFINEMENT_RAY * settings.refine_rays_per_batch,
        "the error map": ERROR_CELL * min(MAX_CELLS, count_pixels(tuple(views)) // PATCH_SIDE),
        "the field": 3 * 4 * parameters(trained) + DENSITY_VOXEL * (given(trained.occupancy_resolution) or 192) ** 3 // 4,
        "libraries": libraries(device),
    })  # fmt: skip


def rows_for_baking(job: Job, m: Any, s: Scene, views: tuple[View, ...], mib: float, *, splits: int, whole: bool) -> PixelRows | None:
    """Where the pixels are put, before anything else is done: None for memory, or a file in the scratch folder where they might not fit beside the voxels.

    How many voxels there are is not known yet: refused is what would not fit without any, and the rest by `refuse_more_than_fits`, before voxels are baked.
    """
    settings, channels = job.settings, channels_of(job.inputs["poses"], views)
    finest, voxels, at_most = most_needed(settings, Trained(m.settings, m.space, m.fine.degree), s, views, channels, mib, splits, whole, job.device)
    stored = not has_room(job, at_most(voxels, stored=False))
    remedy = f"Lower bake.max_resolution ({finest} voxels), bake.visibility_rays ({settings.visibility_rays}) or poses.max_image_size."
    rows = place_pixels(job, at_most(0, stored=stored), views, channels, remedy, stored=stored)
    if job.memory is not None and (most := at_most(voxels, stored=stored).total) > job.memory.bytes:
        job.warn(f"an asset of {mib:g} MiB may need {size_text(most)} of memory; {size_text(job.memory.bytes)} may be taken. Should it not fit, that is said"
                 " once its voxels are counted, before they are baked; with a lower bake.max_mib it surely fits.")  # fmt: skip
    return rows


def most_needed(
    settings: BakeSettings, trained: Trained, s: Scene, views: Sequence[View], channels: int, mib: float, splits: int, whole: bool, device: str
) -> tuple[int, int, AtMost]:
    """What baking takes at most, before its voxels are counted.

    mib      that the asset may have
    splits   how often voxels will be split
    returns  voxels along the finest grid in question; how many are baked at most; and a function from a number of voxels to what it takes
    """
    from efficientnerf.asset.file.serialisation import most_voxels
    from stages.bake.pruning import most_children
    from stages.bake.voxels import MAX_OVERSHOOT

    finest, cells = _finest_cells(settings, trained, s, whole=whole)
    room = most_voxels(int(mib * 2**20), settings.layout, trained.degree, (1, 1, 1), settings.brick_size)
    voxels = min(max(MAX_OVERSHOOT * room, most_children(room) if splits else 0), cells * settings.brick_size**3)

    def at_most(count: int, *, stored: bool) -> Need:
        about: dict[str, Any] = {"cells": cells, "bricks": min(cells, count // 8), "voxels": count, "degree": trained.degree, "whole": whole, "device": device}
        return needed(settings, trained.settings, views, channels, **about, stored=stored)

    return finest, voxels, at_most


def _finest_cells(settings: BakeSettings, trained: Trained, s: Scene, *, whole: bool) -> tuple[int, int]:
    """Voxels along the longest side of the finest grid in question, and coarse cells of it and of those around it, before the foreground region is known."""
    from efficientnerf.asset.bake import grid_of
    from efficientnerf.settings import given
    from stages.bake.resolution import MAX_CASCADES, MAX_CELLS
    from stages.bake.voxels import finest_choice
    from stages.bake.whole_scene import grids_of

    bounds, discretise = trained.space.bounds, given(trained.settings.discretise)
    finest = finest_choice(settings, trained, s).resolution
    if not whole:
        return finest, math.prod(grid_of(bounds, finest, settings.brick_size)[0])
    count = given(settings.cascades) or MAX_CASCADES
    cells = sum(math.prod(shape) for shape, _, _ in grids_of(bounds, finest, settings.brick_size, count, None))
    stated = given(settings.resolution) or given(settings.max_resolution) or discretise
    return finest, cells if stated else min(cells, 2 * MAX_CELLS)  # coarse cells are more by those that make grids fit each other


def refuse_more_than_fits(job: Job, m: Any, views: tuple[View, ...], pixels: Any, plan: Plan, mib: float, splits: int, room: Callable[[int], int]) -> None:
    """UsageError where the voxels would take more memory than the job may.

    pixels        as they were placed
    splits, room  how often voxels will be split, and how many there is room for then
    """
    from stages.bake.pruning import most_children

    whole, voxels = plan.samples is not None, plan.voxels
    if splits:
        voxels = max(voxels, min(voxels * 8**splits, most_children(room(splits))))
    bricks = -(-plan.bricks * voxels // max(plan.voxels, 1))
    about: dict[str, Any] = {"cells": plan.cells * 8**splits, "bricks": bricks, "voxels": voxels, "degree": m.fine.degree, "whole": whole, "device": job.device}
    need = needed(job.settings, m.settings, views, pixels.images.shape[1], **about, stored=isinstance(pixels.images, PixelFile))
    harmonics = (m.fine.degree + 1) ** 2
    remedy = f"Lower bake.max_mib ({mib:g}) or bake.resolution ({plan.choice.resolution}): {voxels:,} voxels with {harmonics} harmonics are too many."
    refuse_what_does_not_fit(job, need, remedy)
