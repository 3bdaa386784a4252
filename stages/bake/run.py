"""The bake stage: a trained field in, the asset out, and what `stages.artifacts.BakeOutputs` lists.

The scratch folder keeps what takes long: the visibility of the voxels or the field's samples, each block of baked values, and the state of the refinement.
"""

import json
from dataclasses import replace
from typing import Any

import numpy as np

from efficientnerf.asset import format
from efficientnerf.asset.cascades import voxel_cascades
from efficientnerf.asset.components import foreground_bricks
from efficientnerf.asset.refinement.targets import Targets
from efficientnerf.asset.tree import NerfTree
from pipeline.stage import Job
from stages.artifacts import BakeOutputs
from stages.bake.economy import packed_tree
from stages.bake.memory import refuse_more_than_fits, rows_for_baking
from stages.bake.metadata import metadata_of, sources_of
from stages.bake.plan import Bake, bake_plan, unused_settings
from stages.bake.refine.refinement import refined
from stages.bake.refine.timing import Stopwatch
from stages.bake.settings import refuse_nerf
from stages.bake.values import baked_tree
from stages.bake.voxels import Voxels, choose_voxels
from stages.compiling import running_kernels
from stages.cores import count_cores, use_all_cores
from stages.io import scene
from stages.io.field_file import load_renderer
from stages.io.refined_cameras import load_scene
from stages.reports import bounds_are_given
from stages.scratch import note, noted
from stages.train.data import pixels_of

SIZE_NOTE = "size_limit.json"
PSNR_BYTES = 16  # by which a header grows at most, once the PSNR of what is written is known


@running_kernels
def run(job: Job) -> None:
    stopwatch, settings, poses, train = Stopwatch(), job.settings, job.inputs["poses"], job.inputs["train"]
    use_all_cores()
    m = load_renderer(train, job.device).model
    refuse_nerf(m.settings)
    s = load_scene(poses, train)
    views = scene.views_of(s, "train")
    plan = with_noted_size(job, bake_plan(settings, m, s, job.device, count_cores()))
    for text in unused_settings(settings, m, plan):
        job.warn(text)

    pixels = pixels_of(poses, views, rows_for_baking(job, plan, m, views), train)
    voxels = choose_voxels(job, plan, m, s, pixels)
    refuse_more_than_fits(job, plan, m, views, pixels, voxels)
    metadata, around = metadata_of(s, settings, m), voxels.surroundings
    targets = Targets(pixels, plan.background, None if around is None else around.environment, reaches_infinity=plan.space.reaches_infinity)
    # The raw values have no name here: they are large, and not needed once the refinement has its own.
    tree, report = refined(job, s, plan, voxels, baked_tree(job, m, s, plan, voxels, metadata), targets, stopwatch)
    if tree.region is not None and not bounds_are_given(poses):
        tree = replace(tree, region=replace(tree.region, bricks=foreground_bricks(tree)))

    metrics = {"training_psnr": report["psnr_after"]}
    tree = tree.with_metadata(provenance={**metadata["provenance"], "sources": sources_of(job), "metrics": metrics})
    if plan.layout == "packed":
        tree, psnr = packed_tree(job, tree, targets, int(plan.max_mib * 2**20) - PSNR_BYTES)
        metrics["training_psnr"] = report["psnr_written"] = round(psnr, 3)
    outputs = BakeOutputs(job.out)
    format.save(tree, outputs.asset, plan.layout)
    write_report(outputs, plan, voxels, tree, report)


def with_noted_size(job: Job, plan: Bake) -> Bake:
    """The plan with the size of an earlier attempt, which may have had other cores, where it follows from bake.time_budget."""
    if not plan.timed:
        return plan
    found = noted(job.work / SIZE_NOTE, float, job.warn)
    if found is not None:
        return replace(plan, mib=found, max_mib=found)
    if plan.mib < plan.usual_mib:
        job.say(f"about {plan.mib:.3g} of the usual {plan.usual_mib:g} MiB can be refined in {plan.seconds:g} s")
    note(job.work / SIZE_NOTE, plan.mib)
    return plan


def write_report(outputs: BakeOutputs, plan: Bake, voxels: Voxels, tree: NerfTree, refinement: dict[str, Any]) -> None:
    """report.json, of an asset that is written."""
    found: dict[str, Any] = {"resolution": list(tree.resolution), "voxels": len(tree.density_values), "bricks": len(tree.voxel_index)}
    found |= {"bytes": outputs.asset.stat().st_size, "optimisation": refinement}
    found |= {"voxels_along_longest_side": voxels.choice.resolution, "resolution_decided_by": voxels.choice.why, "max_mib": plan.max_mib}
    if plan.kind == "scene":
        found |= {"cascades": np.bincount(voxel_cascades(tree), minlength=len(voxels.grids)).tolist(), "voxel": tree.voxel}
    outputs.report.write_text(json.dumps(found, indent=1, sort_keys=True) + "\n", encoding="utf-8")
