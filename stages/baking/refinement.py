"""Refinement in the bake stage: the baked values are fitted to the training images, in phases (`efficientnerf.asset.refinement.schedule`).

After the first half of the steps, which is taken with all voxels that were baked, the tree is rendered along many training rays and voxels are dropped
(`stages.baking.pruning`): floaters have faded by then. The other half of the steps corrects for what is missing. An interrupted refinement goes on from its
checkpoint (`stages.baking.checkpoint`).
"""

from __future__ import annotations

import math
import time
from dataclasses import replace
from typing import TYPE_CHECKING, Any

from efficientnerf.asset.refinement.schedule import PHASES, phase_ends
from efficientnerf.settings import given
from pipeline.stage import Job
from stages.baking import checkpoint
from stages.baking.checkpoint import Point
from stages.baking.holes import find_holes
from stages.baking.pruning import Pruned, prune

if TYPE_CHECKING:
    from efficientnerf.asset.field_samples import FieldSamples
    from efficientnerf.asset.refinement.targets import Targets
    from efficientnerf.asset.tree import NerfTree
    from stages.bake import BakeSettings

CHECKPOINT_SECONDS = 30.0
ERROR_RAYS = 2**16  # training pixels that the report's PSNR is measured on
# docs/experiments/refinement.md
MIN_STEPS, STEP_RAYS_PER_VOXEL, UNBOUNDED_STEPS = 320, 5, 160  # see `refinement_steps`
UNBOUNDED_VIEW_DEPENDENT_LR_RATIO = 0.2  # bake.view_dependent_lr_ratio without a constant background


def refined(job: Job, tree: NerfTree, targets: Targets, most: int, samples: FieldSamples | None = None) -> tuple[NerfTree, dict[str, Any]]:
    """The refined tree with at most `most` voxels, and the entries of the report.

    samples  of the field, for whole scenes: what was dropped wrongly is restored by them
    """
    from efficientnerf.asset.refinement import fit
    from efficientnerf.asset.refinement.state import MAX_INITIAL_THICKNESS, initial_state

    settings = job.settings
    steps = refinement_steps(settings, min(len(tree.density_values), most), tree.background is not None)
    report: dict[str, Any] = {"steps": steps, "psnr_before": None, "psnr_after": None, "voxels_baked": len(tree.density_values)}
    sample = min(ERROR_RAYS, 4 * len(targets.pixels))
    targets = targets_on_device(job, tree, targets)
    before = fit.error(tree, targets, sample, settings.seed)
    most_thick = MAX_INITIAL_THICKNESS if steps else math.inf
    point = checkpoint.restored(job, tree, PHASES, steps) or Point(initial_state(tree, most_thick))
    baked = None if samples is None or point.pruned is not None else initial_state(replace(tree, harmonics=tree.sh[:, :0]), most_thick).density
    del tree  # the state has values of its own
    for phase, end in list(zip(PHASES, phase_ends(PHASES, steps), strict=True))[point.phase :]:
        _take_steps(job, point, targets, steps, end)
        if phase.after == "prune":
            point.state, point.pruned = prune(job, point.state, targets, most, samples, baked)
        point.phase += 1
        if phase.after != "none":
            checkpoint.save(job, point)
    point.state.to_host()
    tree = point.state.tree
    report["psnr_before"], report["psnr_after"] = _psnr(before), _psnr(fit.error(tree, targets, sample, settings.seed))
    if samples is not None:
        report["holes"] = _holes(job, tree, samples, point.pruned or Pruned())
    return tree, report


def _holes(job: Job, tree: NerfTree, samples: FieldSamples, pruned: Pruned) -> dict[str, Any]:
    """The entry of the report about holes, which is said too."""
    holes = {**pruned.report(), "refined": round(find_holes(job, tree, samples)[1], 6)}
    job.say(f"holes, where the field is opaque and the asset is not: {holes['pruned']:.2%} of the rays after the first half of the refinement,"
            f" {holes['restored']:.2%} with {pruned.voxels:,} voxels restored, {holes['refined']:.2%} at the end")  # fmt: skip
    return holes


def targets_on_device(job: Job, tree: NerfTree, targets: Targets) -> Targets:
    """The targets on the run's device, where the tree is then fitted; on the host where the device's memory is too small."""
    from efficientnerf.asset.cascades import cascades_of
    from stages.baking.memory import free_on_device, needed_on_device

    cells = sum(cascade.brick_index.size for cascade in cascades_of(tree))
    needed = needed_on_device(len(tree.density_values), tree.harmonics_count, len(tree.voxel_index), cells, tree.brick)
    needed += len(tree.density_values) * bool(tree.outer)  # the cascade of each voxel
    if targets.pixels.images is not None:
        needed += targets.pixels.images.nbytes
    if job.device == "cpu" or needed <= (free := free_on_device(job.device)):
        return targets.to(job.device)
    job.warn(
        f"refining {len(tree.density_values):,} voxels needs about {needed / 2**30:.1f} GiB on the device; {free / 2**30:.1f} are free there:"
        " they are refined on the CPU, which takes longer (lower bake.max_mib or bake.resolution for the device)"
    )
    return targets


def _psnr(error: float) -> float:
    return round(-10 * math.log10(max(error, 1e-10)), 3)


def refinement_steps(settings: BakeSettings, voxels: int, constant_background: bool) -> int:
    """Steps of the refinement of so many voxels, of a scene with a constant background or without one."""
    if (stated := given(settings.refine_steps)) is not None:
        return stated
    steps = max(MIN_STEPS, math.ceil(STEP_RAYS_PER_VOXEL * voxels / settings.refine_rays_per_batch))
    return steps if constant_background else UNBOUNDED_STEPS


def _take_steps(job: Job, point: Point, targets: Targets, steps: int, until: int) -> None:
    """Take steps up to `until` of `steps`, with checkpoints on the way and where it is stopped."""
    from efficientnerf.asset.refinement import fit

    settings, state = job.settings, point.state
    ratio = given(settings.view_dependent_lr_ratio)
    written, smooth = time.monotonic(), 0.0
    if ratio is None:
        ratio = UNBOUNDED_VIEW_DEPENDENT_LR_RATIO if state.tree.background is None else 1.0
    run = fit.optimise(
        state, targets, until=until, steps=steps, rays=settings.refine_rays_per_batch, density_lr=settings.density_lr, sh_lr=settings.sh_lr,
        lr_final_ratio=settings.lr_final_ratio, seed=settings.seed, view_dependent_lr_ratio=ratio,
    )  # fmt: skip
    for error in run:
        smooth = error if not smooth else 0.9 * smooth + 0.1 * error
        job.progress(state.step, steps, "refining", psnr=round(_psnr(smooth), 2), voxels=len(state.density))
        if time.monotonic() - written > CHECKPOINT_SECONDS:
            checkpoint.save(job, point)
            written = time.monotonic()
        try:
            job.safe_point()
        except BaseException:
            checkpoint.save(job, point)
            raise
