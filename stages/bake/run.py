"""The bake stage: a trained field in, the asset out.

    asset.nerftree  see efficientnerf/asset/FORMAT.md
    report.json     resolution and what decided it, voxels, bytes; PSNR of a sample of the training pixels before and after the refinement, and of a packed
                    asset as it is written; of a scene without a constant background, baked as unbounded (`stages.bake.whole_scene`): its cascades, and
                    the share of the rays that end in holes
    log.jsonl       a line every few steps of the refinement
    curve.png       PSNR over these steps
    previews/       renders of a validation view

The scratch folder keeps what takes long: the visibility of the voxels or the field's samples, each block of baked values, and the state of the refinement.
"""

from __future__ import annotations

import json
from dataclasses import replace
from typing import Any

import numpy as np

from efficientnerf.asset import format
from efficientnerf.asset.bake import grid_of
from efficientnerf.asset.cascades import voxel_cascades
from efficientnerf.asset.components import foreground_bricks
from efficientnerf.asset.refinement.targets import Targets
from efficientnerf.model import Model
from efficientnerf.settings import resolved
from efficientnerf.training.pixels import Pixels
from pipeline.errors import StageFailed
from pipeline.stage import Job
from stages.artifacts import BakeOutputs
from stages.bake.economy import packed_tree
from stages.bake.memory import refuse_more_than_fits, rows_for_baking
from stages.bake.metadata import metadata_of, sources_of
from stages.bake.plan import Plan
from stages.bake.refine.refinement import refined
from stages.bake.refine.timing import Stopwatch
from stages.bake.resolution import size_limits
from stages.bake.settings import BakeSettings, refuse_nerf
from stages.bake.values import baked_tree
from stages.bake.voxels import choose_voxels, voxel_space, with_min_views
from stages.bake.whole_scene import choose_scene_voxels, room_of
from stages.compiling import compiling_kernels
from stages.cores import count_cores, use_all_cores
from stages.evaluate.views import constant_background
from stages.io import scene
from stages.io.field_file import load_renderer
from stages.io.refined_cameras import load_scene
from stages.io.scene import Scene
from stages.reports import bounds_are_given
from stages.scratch import note, noted
from stages.train.data import pixels_of

SIZE_NOTE = "size_limit.json"
PSNR_BYTES = 16  # by which a header grows at most, once the PSNR of what is written is known


@compiling_kernels
def run(job: Job) -> None:
    stopwatch = Stopwatch()

    settings: BakeSettings = job.settings
    use_all_cores()
    m = load_renderer(job.inputs["train"], job.device).model
    refuse_nerf(m.settings)
    s = load_scene(job.inputs["poses"], job.inputs["train"])
    whole = constant_background(s) is None
    mib, views = _size_limit(job, s, whole=whole, discretise=resolved(m.settings.discretise)), scene.views_of(s, "train")
    most = resolved(settings.max_mib) or mib  # of the file
    pixels = pixels_of(job.inputs["poses"], views, rows_for_baking(job, m, s, views, mib, whole=whole), job.inputs["train"])
    plan = _plan(job, m, s, pixels, mib, whole=whole)
    capacity = room_of(settings, m, plan.grids, mib, environment=whole)
    _check(job, m, plan)
    refuse_more_than_fits(job, m, views, pixels, plan, mib)
    metadata = metadata_of(s, settings, m)
    # The raw values have no name here: they are large, and not needed once the refinement has its own.
    targets = _targets(s, pixels, plan)
    tree, report = refined(job, s, baked_tree(job, m, s, plan, metadata), targets, capacity, stopwatch, plan.samples)
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


def _size_limit(job: Job, s: Scene, *, whole: bool, discretise: int | None) -> float:
    """MiB that voxels are chosen by; where the size is left to us, no more than can be refined in bake.time_budget. Noted: another attempt may have other
    cores."""
    settings: BakeSettings = job.settings
    seconds = resolved(settings.time_budget)
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


def _plan(job: Job, m: Model, s: Scene, pixels: Pixels, mib: float, *, whole: bool) -> Plan:
    """The voxels to bake: cascades of an unbounded scene, or else one grid of what lies in the field's box."""
    space = voxel_space(job, m)
    if whole:
        return choose_scene_voxels(job, m, s, pixels, space, mib)
    choice, visibility, indices = choose_voxels(job, m, s, pixels, space, mib)
    indices = with_min_views(m, s, indices, choice.resolution)
    shape, voxel = grid_of(space.bounds, choice.resolution, job.settings.brick_size)
    return Plan(choice, space, [(shape, voxel, np.asarray(space.bounds[0], np.float64))], [indices], len(visibility.cells))


def _check(job: Job, m: Model, plan: Plan) -> None:
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
    return Targets(pixels, constant_background(s), plan.environment, reaches_infinity=plan.space.reaches_infinity)
