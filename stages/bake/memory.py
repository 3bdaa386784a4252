"""Memory of baking: at most, before it begins; and once its voxels are known. docs/experiments/memory.md"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import torch

from efficientnerf.asset.bake import grid_of
from efficientnerf.asset.file.serialisation import bytes_per_voxel, most_voxels
from efficientnerf.asset.refinement.error_map import MAX_CELLS
from efficientnerf.asset.refinement.fit import PATCH_SIDE
from efficientnerf.model import Model
from efficientnerf.settings import resolved
from efficientnerf.training.pixels import PixelRows, Pixels
from pipeline.executors.memory import size_text
from pipeline.stage import Job
from stages.artifacts import BakeInputs
from stages.bake.plan import Plan
from stages.bake.resolution import MAX_CASCADES, size_limits
from stages.bake.resolution import MAX_CELLS as MAX_COARSE_CELLS
from stages.bake.settings import BakeSettings
from stages.bake.voxels import MAX_OVERSHOOT, finest_choice
from stages.bake.whole_scene import grids_of
from stages.cores import count_cores
from stages.evaluate.views import constant_background
from stages.io.field_file import load_renderer
from stages.io.refined_cameras import load_scene
from stages.io.scene import Scene, View, views_of
from stages.memory.forecast import Known
from stages.memory.need import MIB, Need, has_room, libraries, refuse_what_does_not_fit
from stages.train.data import channels_of, count_pixels
from stages.train.memory import DENSITY_VOXEL, PIXELS, parameters, pixels_needed, place_pixels
from stages.train.pixel_file import PixelFile

COPIES = 3  # of every voxel's values at the same time: as baked, in the tree, and in the refinement
PACKED_COPIES = 1  # and while codes are chosen and fitted: the tree's own, those in the order of the file or decoded, two in the refinement
# Bytes. Of a voxel besides its values: coordinates and keys while it is sorted into the tree; of a coarse cell: its brick, its row while voxels are chosen,
# its distance to the next one; of a brick's voxel: greatest weight, three times while they grow, and its number; of a training pixel that visibility is
# measured on: its number, or of unbounded scenes the field's samples of its ray, twice while they are joined; of a ray of a refinement step: its records.
VOXEL, CELL, BRICK_VOXEL, VISIBILITY_RAY, SCENE_RAY, REFINEMENT_RAY = 130, 20, 16, 64, 400, 5000
ERROR_CELL = 48  # bytes of a cell of the error map: two errors, chances, factors and numbers of tiles, and what is made of these
# Bytes written: of a voxel in a checkpoint besides its values; of a ray, the field's samples of an unbounded scene. Voxels that a visibility ray shows:
# 4 to 6 were measured. Rays that are refined before a first checkpoint is written.
WRITTEN, WRITTEN_RAY, SHOWN, SHORT = 24, 700, 8, 20 * 32768
MAX_SHARES = 16  # of the rays, each with the greatest weights of all voxels: efficientnerf.backends.numba.tree.contributions


def voxels_needed(voxels: int, harmonics: int, *, packed: bool = False) -> int:
    """Bytes that density and K harmonics of so many voxels take while they are baked and refined, and `packed`, in float32."""
    return ((COPIES + PACKED_COPIES * packed) * 4 * (1 + 3 * harmonics) + VOXEL + 4 * min(MAX_SHARES, count_cores())) * voxels


def needed_on_device(voxels: int, harmonics: int, bricks: int, cells: int, brick: int, *, smooth: bool) -> int:
    """Bytes that such a tree takes on a device while it is refined there (`efficientnerf.asset.refinement.device`): values and means of squares in
    float32, visits and stamps, sums of gradients in 64 bits; where there is a total variation (`smooth`) the six voxels next to each, and densities before a
    step; of bricks their voxels with a border; of the grid's cells three numbers while it is sent."""
    return (28 + 36 * harmonics + 28 * smooth) * voxels + 4 * (brick + 2) ** 3 * bricks + 12 * cells


def free_on_device(device: str) -> int:
    """Bytes available on a CUDA device: free ones, and those that this process has reserved but not allocated."""
    return torch.cuda.mem_get_info(device)[0] + torch.cuda.memory_reserved(device) - torch.cuda.memory_allocated(device)


def needed(
    settings: BakeSettings, m: Model, views: Sequence[View], channels: int, *, voxels: int, cells: int, bricks: int, stored: bool, whole: bool, device: str
) -> Need:
    """Memory to bake a model.

    channels  of the pixels
    voxels    that are baked
    cells     coarse cells of the finest grids in question
    bricks    that are reached by samples, at most
    stored    whether the pixels are in a file
    whole     whether the scene is unbounded
    """
    pixels, harmonics = pixels_needed(views, channels, stored=stored), (m.fine.degree + 1) ** 2
    rays = min(settings.visibility_rays, count_pixels(tuple(views)))
    return Need({
        PIXELS: pixels[PIXELS],
        "voxels": max(voxels_needed(voxels, harmonics, packed=settings.layout == "packed"), pixels["reading images"] + pixels["directions of pixels"]),
        "the grid": CELL * cells + BRICK_VOXEL * settings.brick_size**3 * bricks,
        "rays": (SCENE_RAY if whole else VISIBILITY_RAY) * rays + REFINEMENT_RAY * settings.refine_rays_per_batch,
        "the error map": ERROR_CELL * min(MAX_CELLS, count_pixels(tuple(views)) // PATCH_SIDE),
        "the field": 3 * 4 * parameters(m.settings) + DENSITY_VOXEL * (resolved(m.settings.occupancy_resolution) or 192) ** 3 // 4,
        "libraries": libraries(device),
    })  # fmt: skip


def rows_for_baking(job: Job, m: Model, s: Scene, views: tuple[View, ...], mib: float, *, whole: bool) -> PixelRows | None:
    """Where the pixels are put, before anything else is done: None for memory, or a file in the scratch folder where they might not fit with the voxels.

    The number of voxels is not known yet: what would not fit without any is refused here, and the rest by `refuse_more_than_fits`, before voxels are baked.
    """
    settings, channels = job.settings, channels_of(job.inputs["poses"], views)
    finest, voxels, at_most = most_needed(settings, m, s, views, channels, mib, whole, job.device)
    stored = not has_room(job, at_most(voxels, stored=False))
    remedy = f"Lower bake.max_resolution ({finest} voxels), bake.visibility_rays ({settings.visibility_rays}) or poses.max_image_size."
    rows = place_pixels(job, at_most(0, stored=stored), views, channels, remedy, stored=stored)
    if job.memory is not None and (most := at_most(voxels, stored=stored).total) > job.memory.bytes:
        job.warn(f"an asset of {mib:g} MiB may need {size_text(most)} of memory; {size_text(job.memory.bytes)} may be taken. It is refused"
                 " once its voxels are counted, before they are baked, if it does not fit; with a lower bake.max_mib it surely fits.")  # fmt: skip
    return rows


def most_needed(
    settings: BakeSettings, m: Model, s: Scene, views: Sequence[View], channels: int, mib: float, whole: bool, device: str
) -> tuple[int, int, Callable[..., Need]]:
    """Most memory to bake a model, before its voxels are counted.

    mib      that the asset may have
    returns  voxels along the finest grid in question; how many are baked at most; and `needed` as a function of (voxels, stored=)
    """
    finest, cells = _finest_cells(settings, m, s, whole=whole)
    room = most_voxels(int(mib * MIB), settings.layout, m.fine.degree, (1, 1, 1), settings.brick_size)

    def at_most(voxels: int, *, stored: bool) -> Need:
        bricks = min(cells, voxels // 8)
        return needed(settings, m, views, channels, voxels=voxels, cells=cells, bricks=bricks, stored=stored, whole=whole, device=device)

    return finest, min(MAX_OVERSHOOT * room, cells * settings.brick_size**3), at_most


def _finest_cells(settings: BakeSettings, m: Model, s: Scene, *, whole: bool) -> tuple[int, int]:
    """Voxels along the longest side of the finest grid in question, and coarse cells of it and of those around it, before the foreground region is known."""
    bounds, discretise = m.space.bounds, resolved(m.settings.discretise)
    finest = finest_choice(settings, m.settings, s).resolution
    if not whole:
        return finest, math.prod(grid_of(bounds, finest, settings.brick_size)[0])
    count = resolved(settings.cascades) or MAX_CASCADES
    cells = sum(math.prod(shape) for shape, _, _ in grids_of(bounds, finest, settings.brick_size, count, None))
    stated = resolved(settings.resolution) or resolved(settings.max_resolution) or discretise
    return finest, cells if stated else min(cells, 2 * MAX_COARSE_CELLS)  # coarse cells are more by those that make grids fit each other


def refuse_more_than_fits(job: Job, m: Model, views: tuple[View, ...], pixels: Pixels, plan: Plan, mib: float) -> None:
    """UsageError where the voxels would take more memory than the job may.

    pixels  as they were placed
    """
    whole, voxels = plan.samples is not None, plan.voxels
    grid = {"voxels": voxels, "cells": plan.cells, "bricks": plan.bricks}
    stored = isinstance(pixels.images, PixelFile)
    need = needed(job.settings, m, views, pixels.images.shape[1], **grid, stored=stored, whole=whole, device=job.device)
    harmonics = (m.fine.degree + 1) ** 2
    remedy = f"Lower bake.max_mib ({mib:g}) or bake.resolution ({plan.choice.resolution}): {voxels:,} voxels with {harmonics} harmonics are too many."
    refuse_what_does_not_fit(job, need, remedy)


def memory_needed(known: Known) -> Need:
    """Most memory of the stage bake, before its voxels are counted."""
    return _before(known)[-1]


def space_needed(known: Known) -> int:
    """The field's samples, the values of the voxels as they are baked, a checkpoint of their refinement, two while it is replaced, and the asset."""
    own, (degree, whole, mib, rays, voxels, _) = known.settings["bake"], _before(known)
    values, voxels = 4 * (1 + 3 * (degree + 1) ** 2), min(voxels, SHOWN * rays)
    checkpoints = 1 if own.refine_steps != "auto" and own.refine_steps * own.refine_rays_per_batch < SHORT else 2
    asset = min(int(mib * MIB), 2 * bytes_per_voxel(own.layout, degree) * voxels)
    return (values + checkpoints * (values + WRITTEN)) * voxels + asset + whole * WRITTEN_RAY * rays + known.pictures()


def _before(known: Known) -> tuple[int, bool, float, int, int, Need]:
    """(degree of the harmonics, whether the scene is unbounded, MiB of the asset, visibility rays, voxels, what these take of memory), each at most."""
    own, inputs = known.settings["bake"], known.inputs(BakeInputs)
    m, s = load_renderer(inputs.train.folder).model, load_scene(inputs.poses.folder, inputs.train.folder)
    views, whole = views_of(s, "train"), constant_background(s) is None
    mib = size_limits(own, s, known.device, count_cores(), whole=whole, discretise=resolved(m.settings.discretise))[1]
    _, voxels, at_most = most_needed(own, m, s, views, channels_of(inputs.poses.folder, views), mib, whole, known.device)
    return m.fine.degree, whole, mib, min(own.visibility_rays, count_pixels(views)), voxels, at_most(voxels, stored=False)
