"""The bake stage: a trained field in, the asset out.

    asset.nerftree  see efficientnerf/asset/FORMAT.md
    report.json     resolution and what decided it, voxels, bytes; PSNR of a sample of the training pixels before and after the refinement, and of a packed
                    asset as it is written; of a scene without a constant background, which is baked whole (`stages.bake.whole_scene`): its cascades, and
                    the share of the rays that end in holes
    log.jsonl       a line every few steps of the refinement
    curve.png       PSNR over these steps
    previews/       renders of a validation view

The scratch folder keeps what takes long: the visibility of the voxels or the field's samples, each block of baked values, and the state of the refinement.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import partial
from typing import TYPE_CHECKING, Annotated, Any, Literal

import numpy as np
from msgspec import Meta

from efficientnerf.settings import LEAST_RESOLUTION, Auto, Count, Fraction, NonNegative, Off, Seconds, Seed, given, setting
from pipeline.errors import StageFailed, UsageError
from pipeline.stage import Job, Stage
from stages.artifacts import BakeInputs, BakeOutputs, needs_of
from stages.bake.metadata import metadata_of, sources_of
from stages.compiling import compiling_kernels
from stages.cores import use_all_cores

SIZE_NOTE = "size_limit.json"
PSNR_BYTES = 16  # by which a header grows at most, once the PSNR of what is written is known

if TYPE_CHECKING:
    from efficientnerf.asset.refinement.targets import Targets
    from efficientnerf.training.pixels import Pixels
    from efficientnerf.training.settings import TrainSettings
    from stages.bake.plan import Plan
    from stages.io.scene import Scene


@dataclass(frozen=True)
class BakeSettings:
    """How finely the field is baked."""

    resolution: Annotated[int, Meta(ge=LEAST_RESOLUTION, le=4096)] | Auto = setting(
        "auto", "Voxels along the longest side of the box, of a whole scene of its innermost cascade; auto: train.discretise, or as many as max_mib holds and"
        " images resolve.",
    )
    lookup: Literal["trilinear", "nearest"] = setting(
        "trilinear", "Value of a point in the asset: interpolated from the voxels around it (trilinear), or that of its own voxel (nearest).", advanced=True
    )
    step_size: Annotated[float, Meta(ge=0.25, le=1.0)] = setting(1.0, "Distance between the samples of a ray through the asset, voxels.", advanced=True)
    max_resolution: Annotated[int, Meta(ge=32, le=4096)] | Auto = setting(
        "auto", "Most voxels along the longest side where resolution is auto; auto: 1024, or as many as 2^24 coarse cells of all cascades allow.", advanced=True
    )
    cascades: Annotated[int, Meta(ge=1, le=16)] | Auto = setting(
        "auto",
        "Nested grids of a scene without a constant background, each twice as wide as the one before; auto: as many as hold 99 % of what the field shows, at"
        " most 8; what lies beyond is in the environment map.",
        advanced=True,
    )
    environment_size: Annotated[int, Meta(ge=4, le=1024)] = setting(
        128, "Rows of the environment map of a scene without a constant background; it has twice as many columns.", advanced=True
    )
    ndc_voxel_depth: Annotated[float, Meta(ge=1.0, le=8.0)] | Auto = setting(
        "auto", "Depth of a voxel over its width, in normalised device coordinates; auto: 2, or 1 with train.discretise.", advanced=True
    )
    brick_size: Annotated[int, Meta(ge=1, le=16)] = setting(4, "Voxels D_f along a side of a coarse cell of the NerfTree.", advanced=True)
    visibility_rays: Annotated[int, Meta(ge=1000, le=10**9)] = setting(
        1_000_000, "Training pixels that the field is rendered for, to find the visible voxels.", advanced=True
    )
    weight_threshold: Annotated[float, Meta(ge=0.0, le=0.1)] = setting(
        1e-3,
        "A voxel is kept where its weight in some pixel exceeds this; in forward-facing scenes those that 4 or more training images (half of fewer than 7) have"
        " in view are baked where it exceeds 30 times this.",
        advanced=True,
    )
    max_mib: Annotated[float, Meta(ge=0.03, le=65536.0)] | Auto = setting(  # header and palette of 9 harmonics: 28 kB
        "auto",
        "Largest size of the asset: resolution auto follows from it, and voxels of least weight are dropped to keep to it; auto: 38;"
        " 34 bytes for each pixel of a forward-facing capture, from 24 to 56; a third of that with layout packed, whose codes"
        " become finer with more, not its voxels; less where voxels as fine as pixels resolve are fewer, or where time_budget is too short for as many.",
        unit="MiB",
    )
    layout: Literal["compact", "packed", "small", "sparse"] = setting(
        "compact",
        "How voxels are stored: codes of 8 bits (compact), the same entropy-coded (packed), a coarser palette of half the bytes (small), or 16-bit floats"
        " (sparse).",
    )
    dilate: Annotated[int, Meta(ge=0, le=8)] = setting(1, "Voxels by which the visible ones are dilated.", advanced=True)
    min_component: Fraction = setting(
        0.02,
        "Size below which connected components that the box cuts off are dropped in unbounded scenes, as a fraction of the largest one's voxels; a hundredth"
        " of this applies to all components.",
        advanced=True,
    )
    samples_per_voxel: Annotated[int, Meta(ge=1, le=256)] = setting(
        2, "Jittered points averaged in a voxel; its centre alone where train.discretise has the same voxels.", advanced=True
    )
    seed: Seed = setting(0, "Seed of the jitter and of the rays of the refinement.", advanced=True)
    refine_steps: Count | Auto = setting(
        "auto",
        "Steps in which the baked values are refined on the training images; auto: 15 rays for each voxel, 6 in unbounded scenes; at least 320 steps.",
        advanced=True,
    )
    time_budget: Seconds | Off = setting(
        "off", "Time of the stage, in place of a number of steps: steps of the refinement are timed, and as many are taken as fit; off: refine_steps.",
        unit="seconds",
        advanced=True,
    )
    refine_rays_per_batch: Annotated[int, Meta(ge=1, le=1 << 22)] = setting(32768, "Rays in a step of the refinement.", advanced=True)
    density_lr: NonNegative = setting(0.3, "Learning rate of the refinement for the logarithm of a voxel's optical thickness.", advanced=True)
    sh_lr: NonNegative = setting(0.1, "Learning rate of the refinement for the spherical harmonics.", advanced=True)
    view_dependent_lr_ratio: Fraction | Auto = setting(
        "auto", "Ratio of the learning rate of view-dependent harmonics to sh_lr; auto: 1 for objects with alpha, 0.2 in unbounded scenes.", advanced=True
    )
    total_variation: NonNegative = setting(
        0.01, "Weight of the total variation of the logarithm of the optical thickness between a voxel and those beside it.", advanced=True
    )
    error_map: Annotated[float, Meta(ge=0.0, lt=1.0)] | Auto = setting(
        "auto",
        "Share of the refinement's rays that are drawn where earlier errors were large; auto: 0.9, 0 in forward-facing scenes.",
        advanced=True,
    )
    lr_final_ratio: Fraction = setting(0.1, "Ratio to which the learning rates of the refinement fall exponentially.", advanced=True)
    licence: str = setting("", "Licence text to write into the asset.")


@compiling_kernels
def run(job: Job) -> None:
    from stages.bake.refine.timing import Stopwatch

    stopwatch = Stopwatch()
    from efficientnerf.asset import format
    from efficientnerf.asset.cascades import voxel_cascades
    from efficientnerf.asset.components import foreground_bricks
    from efficientnerf.asset.refinement import schedule
    from stages.bake.economy import packed_tree
    from stages.bake.memory import refuse_more_than_fits, rows_for_baking
    from stages.bake.refine.refinement import refined
    from stages.bake.values import baked_tree
    from stages.bake.whole_scene import bounds_are_given
    from stages.evaluate.views import constant_background
    from stages.io import scene
    from stages.io.field_file import load_renderer
    from stages.io.refined_cameras import load_scene
    from stages.train.data import pixels_of

    settings: BakeSettings = job.settings
    use_all_cores()
    m = load_renderer(job.inputs["train"], job.device).model
    _refuse_nerf(m.settings)
    s = load_scene(job.inputs["poses"], job.inputs["train"])
    whole = constant_background(s) is None
    mib, views = _size_limit(job, s, whole=whole, discretise=given(m.settings.discretise)), scene.views_of(s, "train")
    most = given(settings.max_mib) or mib  # of the file
    phases = schedule.PHASES
    splits = schedule.count_splits(phases)
    pixels = pixels_of(job.inputs["poses"], views, rows_for_baking(job, m, s, views, mib, splits=splits, whole=whole), job.inputs["train"])
    plan = _plan(job, m, s, pixels, mib, splits, whole=whole)
    room = partial(_room, settings, m, plan, mib)
    _check(job, m, plan)
    refuse_more_than_fits(job, m, views, pixels, plan, mib, splits, room)
    metadata = metadata_of(s, settings, m)
    # The raw values have no name here: they are large, and not needed once the refinement has its own.
    targets = _targets(s, pixels, plan)
    tree, report = refined(job, s, baked_tree(job, m, s, plan, metadata), targets, phases, room, stopwatch, plan.samples)
    if tree.region is not None and not bounds_are_given(job.inputs["poses"]):
        tree = replace(tree, region=replace(tree.region, bricks=foreground_bricks(tree)))
    metrics = {"training_psnr": report["psnr_after"]}
    provenance = {**metadata["provenance"], "sources": sources_of(job), "metrics": metrics}
    outputs = BakeOutputs(job.out)
    tree = tree.with_metadata(provenance=provenance)
    if settings.layout == "packed":
        tree, psnr = packed_tree(job, tree, targets, int(most * 2**20) - PSNR_BYTES)
        metrics["training_psnr"] = report["psnr_written"] = round(psnr, 3)
    format.save(tree, outputs.asset, settings.layout)
    found: dict[str, Any] = {"resolution": list(tree.resolution), "voxels": len(tree.density_values), "bricks": len(tree.voxel_index)}
    found |= {"bytes": outputs.asset.stat().st_size, "optimisation": report}
    found |= {"voxels_along_longest_side": plan.choice.resolution, "resolution_decided_by": plan.choice.why, "max_mib": most}
    if whole:
        found |= {"cascades": np.bincount(voxel_cascades(tree), minlength=len(plan.grids)).tolist(), "voxel": tree.voxel}
    outputs.report.write_text(json.dumps(found, indent=1, sort_keys=True) + "\n", encoding="utf-8")


def _refuse_nerf(trained: TrainSettings) -> None:
    if trained.field == "nerf":
        raise UsageError("train.field=nerf: its colours depend on the direction inside the network, which can't be baked. Use mlp or hash, or --until train.")


def check(settings: Mapping[str, Any]) -> None:
    """UsageError where the field is to be trained before, and can't be baked then."""
    if "train" in settings:
        _refuse_nerf(settings["train"])


def _size_limit(job: Job, s: Scene, *, whole: bool, discretise: int | None) -> float:
    """MiB that voxels are chosen by; where the size is left to us, no more than can be refined in bake.time_budget. Noted, for another attempt may have other
    cores."""
    from stages.bake.resolution import size_limits
    from stages.cores import count_cores
    from stages.scratch import note, noted

    settings: BakeSettings = job.settings
    seconds = given(settings.time_budget)
    mib, timed = size_limits(settings, s, job.device, count_cores(), whole=whole, discretise=discretise)
    if seconds is None or settings.max_mib != "auto" or job.device != "cpu":
        return timed
    found = noted(job.work / SIZE_NOTE, float, job.warn)
    if found is not None:
        return found
    if timed < mib:
        job.say(f"of {mib:g} MiB, about {timed:.3g} can be refined in {seconds:g} s")
    note(job.work / SIZE_NOTE, timed)
    return timed


def _room(settings: BakeSettings, m: Any, plan: Plan, mib: float, splits: int) -> int:
    """How many voxels the asset holds on the plan's grids once they were split so often."""
    from stages.bake.whole_scene import room_of

    finer = 2**splits
    grids = [((x * finer, y * finer, z * finer), voxel / finer, low) for (x, y, z), voxel, low in plan.grids]
    return room_of(settings, m, grids, mib, environment=plan.samples is not None)


def _plan(job: Job, m: Any, s: Scene, pixels: Pixels, mib: float, splits: int, *, whole: bool) -> Plan:
    """The voxels to bake, which will be split so often: cascades of a whole scene, or else one grid of what lies in the field's box."""
    from efficientnerf.asset.bake import grid_of
    from stages.bake.plan import Plan
    from stages.bake.resolution import baked_resolution
    from stages.bake.voxels import choose_voxels, voxel_space, with_min_views
    from stages.bake.whole_scene import choose_scene_voxels

    space = voxel_space(job, m)
    if whole:
        return choose_scene_voxels(job, m, s, pixels, space, mib, splits)
    choice, visibility, indices = choose_voxels(job, m, s, pixels, space, mib, splits)
    resolution = baked_resolution(choice.resolution, splits)
    indices = with_min_views(m, s, indices, resolution)
    shape, voxel = grid_of(space.bounds, resolution, job.settings.brick_size)
    return Plan(choice, space, [(shape, voxel, np.asarray(space.bounds[0], np.float64))], [indices], len(visibility.cells))


def _check(job: Job, m: Any, plan: Plan) -> None:
    """Say what is baked; StageFailed where nothing is."""
    resolution = plan.choice.resolution
    if job.settings.lookup == "nearest" and m.settings.discretise not in ("off", resolution):
        trained = f"the field was trained on train.discretise={m.settings.discretise}"
        job.warn(f"bake.resolution={resolution}, but {trained}: on other voxels than are baked")
    if not plan.voxels:
        found = "no voxel of the box contributes to any training image"
        raise StageFailed(f"bake: the trained field is empty: {found}. Train longer, or check the box (poses.crop_box).")
    of = f" of {len(plan.grids)} cascades" if plan.samples is not None else ""
    job.say(f"{resolution} voxels along the longest side ({plan.choice.why}); {plan.voxels:,} voxels{of} are baked")


def _targets(s: Scene, pixels: Pixels, plan: Plan) -> Targets:
    """What the tree is fitted to."""
    from efficientnerf.asset.refinement.targets import Targets
    from stages.evaluate.views import constant_background

    return Targets(pixels, constant_background(s), plan.environment, reaches_infinity=plan.space.reaches_infinity)


STAGE = Stage(
    name="bake",
    version=20,
    settings=BakeSettings,
    needs=needs_of(BakeInputs),
    run=run,
    uses_device=True,
    check=check,
    volatile=(BakeOutputs.log, BakeOutputs.curve, f"{BakeOutputs.previews}/*"),
)
