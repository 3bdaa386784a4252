"""The part of the bake stage that fits the baked values to the training images and drops what does not show; goes on where it was stopped.

Half of the steps are spent on all voxels that were baked. Then the tree is drawn for many training pixels: voxels that hardly contribute to any of
them are dropped (floaters have faded by then), and as many of the least more as the asset's size asks for. The other half of the
steps makes up for what is missing.
"""

from __future__ import annotations

import math
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from efficientnerf.settings import given
from pipeline.files import atomic
from pipeline.stage import Job

if TYPE_CHECKING:
    from efficientnerf.asset.refinement import Optimiser, Targets
    from efficientnerf.asset.tree import NerfTree
    from stages.bake import BakeSettings

CHECKPOINT = "optimisation.safetensors"
CHECKPOINT_SECONDS = 30.0
SAMPLE = 2**16  # training pixels that the report's figures are taken from
# Training pixels per voxel that are looked at to see which voxels show; not fewer than bake.visibility_rays. Four kept a tenth more that no picture missed
WEIGHED = 1.0
WEIGHED_NDC = 0.25  # likewise in normalised device coordinates, where no ray misses and each meets many voxels. Held-back views of fern_8 at 1:
# 25.33 dB in 23.6 MB; 0.25 (and 1 million): 25.32 in 22.2

LEAST_STEPS, RAYS_PER_VOXEL, PHOTOGRAPHED_STEPS = 320, 5, 160  # see `steps_of`
PHOTOGRAPHS = 0.2  # view_share where surroundings are learned. Held-back views of still_life, 384 voxels a side: at 1, 28.57 dB; 0.2: 28.65; 0.05: 28.59


def optimised(job: Job, tree: NerfTree, targets: Targets, most: int) -> tuple[NerfTree, dict[str, Any]]:
    """The fitted tree with at most `most` voxels, and figures for the report."""
    from efficientnerf.asset import refinement

    settings = job.settings
    steps = steps_of(settings, min(len(tree.density_values), most), tree.background is not None)
    facts: dict[str, Any] = {"steps": steps, "psnr_before": None, "psnr_after": None, "voxels_baked": len(tree.density_values)}
    sample = min(SAMPLE, 4 * len(targets.pixels))
    targets = _where_there_is_room(job, tree, targets)
    before = refinement.error(tree, targets, sample, settings.seed)
    o, pruned = _restored(job, tree) or (refinement.optimiser(tree, refinement.OPAQUE if steps else math.inf), False)
    del tree  # the optimiser has values of its own
    if not pruned:
        _fit(job, o, targets, steps, steps // 2, pruned)
        o = _without_unseen(job, o, targets, most)
        _checkpoint(job, o, True)
    _fit(job, o, targets, steps, steps, True)
    o.leave()
    tree = o.tree
    facts["psnr_before"], facts["psnr_after"] = _decibels(before), _decibels(refinement.error(tree, targets, sample, settings.seed))
    return tree, facts


def _where_there_is_room(job: Job, tree: NerfTree, targets: Targets) -> Targets:
    """The targets on the run's device, where the tree is fitted then; on the host where the device's memory would not do."""
    from stages.baking.memory import free_on_device, needed_on_device

    needed = needed_on_device(len(tree.density_values), tree.harmonics_count, len(tree.voxel_index), tree.brick_index.size, tree.brick)
    if targets.pixels.images is not None:
        needed += targets.pixels.images.nbytes
    if job.device == "cpu" or needed <= (free := free_on_device(job.device)):
        return targets.to(job.device)
    job.warn(
        f"fitting {len(tree.density_values):,} voxels needs about {needed / 2**30:.1f} GiB on the device; {free / 2**30:.1f} are free there:"
        " they are fitted on the CPU, which takes longer (lower bake.max_mib or bake.resolution for the device)"
    )
    return targets


def _decibels(error: float) -> float:
    return round(-10 * math.log10(max(error, 1e-10)), 3)


def steps_of(settings: BakeSettings, voxels: int, cut_out: bool) -> int:
    """Steps of the optimisation of so many voxels, of a cut-out object or of photographs with surroundings."""
    if (stated := given(settings.refine_steps)) is not None:
        return stated
    return max(LEAST_STEPS, math.ceil(RAYS_PER_VOXEL * voxels / settings.refine_rays_per_batch)) if cut_out else PHOTOGRAPHED_STEPS


def _fit(job: Job, o: Optimiser, targets: Targets, steps: int, until: int, pruned: bool) -> None:
    """Steps up to `until` of `steps`, with a checkpoint now and then, and where it is stopped."""
    from efficientnerf.asset import refinement

    settings = job.settings
    ratio = given(settings.view_dependent_lr_ratio)
    written, smooth = time.monotonic(), 0.0
    run = refinement.optimise(
        o, targets, until=until, steps=steps, rays=settings.refine_rays_per_batch, density_rate=settings.density_lr,
        colour_rate=settings.sh_lr, final=settings.lr_final_ratio, seed=settings.seed,
        view_share=ratio if ratio is not None else 1.0 if o.tree.background is not None else PHOTOGRAPHS,
    )  # fmt: skip
    for error in run:
        smooth = error if not smooth else 0.9 * smooth + 0.1 * error
        job.progress(o.step, steps, "fitting to the images", psnr=round(_decibels(smooth), 2), voxels=len(o.density))
        if time.monotonic() - written > CHECKPOINT_SECONDS:
            _checkpoint(job, o, pruned)
            written = time.monotonic()
        try:
            job.safe_point()
        except BaseException:
            _checkpoint(job, o, pruned)
            raise


def _without_unseen(job: Job, o: Optimiser, targets: Targets, most: int) -> Optimiser:
    """Only the voxels that contribute more than bake.weight_threshold to a pixel, and of these at most `most`, those that contribute most."""
    from efficientnerf.asset import bake, refinement

    settings = job.settings
    o.leave()
    share = WEIGHED if o.tree.ndc is None else WEIGHED_NDC
    count = min(max(settings.visibility_rays, int(share * len(o.density))), 4 * len(targets.pixels))

    def looked(done: int, total: int) -> None:
        job.progress(done, total, "dropping what does not show")
        job.safe_point()

    greatest = refinement.greatest_weights(o.tree, targets, count, settings.seed, looked)
    keep = greatest > settings.weight_threshold
    if keep.sum() > most:
        order = np.argsort(-greatest, kind="stable")
        keep = np.zeros(len(keep), bool)
        keep[order[:most]] = True
        left_out = float(greatest[order[most]])
        job.say(f"voxels that never weigh more than {left_out:.3g} in a pixel are left out: bake.max_mib has room for {most:,}")
    if not keep.any():
        return o
    if o.tree.background is None:
        from efficientnerf.asset.components import small_components

        keep &= ~small_components(o.tree, keep, settings.min_component)
    return refinement.kept(o, keep, bake.with_voxels(o.tree, keep))


def _checkpoint(job: Job, o: Optimiser, pruned: bool) -> None:
    from safetensors.numpy import save_file

    from efficientnerf.asset import bake, refinement

    o.fetch()
    tensors = {name: np.ascontiguousarray(getattr(o, name)) for name in refinement.STATE}
    tensors["coordinates"] = bake.voxel_coordinates(o.tree)
    tensors["progress"] = np.array([o.step, pruned], np.int64)
    with atomic(job.work / CHECKPOINT, durable=False) as temporary:
        save_file(tensors, str(temporary))


def _restored(job: Job, tree: NerfTree) -> tuple[Optimiser, bool] | None:
    """The optimiser as the last checkpoint has it, and whether voxels were dropped by then; None where there is none that can be read."""
    from efficientnerf.asset import refinement
    from efficientnerf.asset.tree import tree_from_voxels

    found = _read(job.work / CHECKPOINT)
    if found is None:
        return None
    try:
        step, pruned = (int(x) for x in found["progress"])
        fitted = tree_from_voxels(
            tree.shape, tree.voxel, tree.bounds_min, found["coordinates"], found["density"], found["sh"].reshape(len(found["sh"]), -1, 3),
            brick=tree.brick, background=tree.background, metadata=tree.metadata, ndc=tree.ndc, lookup=tree.lookup,
        )  # fmt: skip
        o = refinement.Optimiser(fitted, **{name: np.array(found[name]) for name in refinement.SQUARES}, step=step)
    except (KeyError, ValueError) as error:
        job.warn(f"{CHECKPOINT} can't be used ({error}); the optimisation begins again")
        return None
    job.say(f"the optimisation goes on from step {o.step}")
    return o, bool(pruned)


def _read(path: Path) -> dict[str, np.ndarray] | None:
    from safetensors import SafetensorError
    from safetensors.numpy import load_file

    try:
        return load_file(str(path))
    except (OSError, SafetensorError, ValueError):
        return None
