"""The train stage: a scene in, a trained field out, and what `stages.artifacts.TrainOutputs` lists."""

import json
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from efficientnerf.capture.plane_sweep import SweptPlane
from efficientnerf.model import Model, model
from efficientnerf.rendering.field_renderer import FieldRenderer
from efficientnerf.settings import resolved
from efficientnerf.training import loop
from efficientnerf.training.loop import Trainer
from efficientnerf.training.pixels import Pixels
from efficientnerf.training.readback import AsyncOccupancy
from efficientnerf.training.sparse_depth import SparseDepthRays
from pipeline.stage import Job
from stages.artifacts import TrainOutputs
from stages.compiling import clock, running_kernels
from stages.cores import use_all_cores
from stages.io import field_file, scene
from stages.io.scene import Scene, View
from stages.train import support
from stages.train.budget import UNKNOWN, Budget, training_budget
from stages.train.checkpoints import Checkpoints
from stages.train.checks.watch import Watch
from stages.train.checks.wrong_views import findings_of, train_and_check, write_cameras
from stages.train.data import begin_sky, count_pixels, depth_range, pixels_of, sparse_depth_of
from stages.train.exposure import begin_exposure, exposure_facts, saved_exposure
from stages.train.hash_resolution import with_auto_sizes
from stages.train.log import TrainLog
from stages.train.memory import rows_for_training
from stages.train.previews import Previews
from stages.train.priors import Prior, cells_closed_at_first, mask_uncovered_cells


@running_kernels
def run(job: Job) -> None:
    while not trained(job):
        pass


def trained(job: Job) -> bool:
    """Train and write the outputs; False where training has to begin again, with what `stages.train.checks.watch` has chosen."""
    began = clock()

    use_all_cores()
    folder, outputs = job.inputs["poses"], TrainOutputs(job.out)
    s = (watch := Watch(job, scene.load(folder), folder)).scene
    views = scene.views_of(s, "train")
    settings, space = with_auto_sizes(watch.settings, s, count_pixels(views)), field_file.space_of(s)
    job.progress(0, settings.iterations, "reading images")
    pixels = pixels_of(folder, views, rows_for_training(job, folder, views, settings, space))
    near, far = depth_range(s, pixels, settings, job.warn)
    exposure = begin_exposure(folder, s, pixels, settings.exposure, job.device, job.say)
    m = model(space, replace(settings, exposure="off" if exposure is None else "on"), s.background, job.device, (near, far))
    if (sky := begin_sky(m, pixels)) is not None:
        job.say(f"the sky begins with {sky}")
    say_what_has_no_effect(job, space.contracted, alpha=pixels.images.shape[1] == 4)
    priors = mask_uncovered_cells(m, views, job)

    t = loop.trainer(m, exposure, cameras=[view.camera for view in views], closed=cells_closed_at_first(m, views, folder))
    checkpoints = Checkpoints(job)
    spent = checkpoints.restore(t, settings.iterations if settings.time_budget == "off" else UNKNOWN)
    log = TrainLog(job.work / TrainOutputs.log, t.step, spent, AsyncOccupancy(m.voxels), clock)
    renderer = FieldRenderer(m, near, far)
    previews = Previews(renderer.colour, m.background, folder, s, job.work, resolved(settings.preview_every))
    previews.draw_when_due(t.step)
    budget = begin_budget(job, t, watch.seconds + spent + clock() - began)
    fails = partial(watch.begins_again, renderer.colour, pixels, partial(checkpoints.save, t, log))
    if fails(t.step, t.schedule.iterations, log.seconds):
        return False

    log.begin_step()
    for done in train_and_check(job, t, pixels, s, lambda scene_now: sparse_depth(job, folder, scene_now, m, pixels, views)):
        log.end_step(done)
        if budget is not None:
            follow_budget(job, t, budget)
        last = done.step == t.schedule.iterations
        goal = t.schedule.iterations if budget is None else budget.goal
        psnr = previews.draw_when_due(done.step)
        shown = log.record(done, goal, psnr, last=last) | previews.figures
        job.progress(min(done.step, goal), goal, "training", **shown)
        if psnr is not None:
            log.draw_curve(job.work / TrainOutputs.curve)
        if not last and fails(done.step, t.schedule.iterations, log.seconds):
            return False
        checkpoints.reach(t, log, every=settings.checkpoint_every, last=last)
        log.begin_step()
    field_file.save_model(m, near, far, outputs.field, saved_exposure(t.exposure, s), t.schedule)
    write_cameras(outputs, t, views, folder, renderer)
    watch.write_choices(outputs.choices)
    support.write(support.load(job.work), outputs.support)
    write_report(outputs.report, job, t, log.seconds, previews.figures | watch.report() | {"wrong_views": findings_of(t, views)}, priors)
    log.publish(outputs.log, outputs.curve)
    previews.publish(outputs.previews, job.warn)
    return True


def say_what_has_no_effect(job: Job, contracted: bool, *, alpha: bool) -> None:
    """Name settings of contracted scenes where the scene is none."""
    if job.settings.plain_loss_weight > 0 and (alpha or not contracted):
        job.say("train.plain_loss_weight has no effect: it is for contracted scenes of photographs without alpha")
    if job.settings.highlight_loss_weight < 1 and not contracted:
        job.say("train.highlight_loss_weight has no effect: it is for contracted scenes")


def sparse_depth(job: Job, folder: Path, s: Scene, m: Model, pixels: Pixels, views: tuple[View, ...]) -> SparseDepthRays | None:
    """Rays to sparse points. A message says where there are points and none can be used."""
    settings, searched = m.settings, partial(job.reached, total=1.0, text="searching for the planes of table and wall")
    used = settings.sparse_depth_loss_weight > 0 and m.space.unbounded

    def sweep(points: np.ndarray) -> list[SweptPlane]:
        return support.find_planes(s, pixels, views, points, settings.seed, searched) if used else []

    found = sparse_depth_of(folder, s, settings.seed, sweep)
    if found is None and s.points and settings.sparse_depth_loss_weight > 0:
        job.say("no sparse point is in front of enough of the training cameras that observe it; train.sparse_depth_loss_weight has no effect")
    support.write(() if found is None else found.planes, job.work / TrainOutputs.support)
    if used and found is not None and found.on_support.any():
        what = "a plane supports" if len(found.planes) == 1 else f"{len(found.planes)} planes support"
        job.say(f"{what} the subject, where rays end: {int(found.on_support.sum())} rays are trained on")
    return found


def begin_budget(job: Job, t: Trainer, spent: float) -> Budget | None:
    """The budget, so many seconds of which are spent, and its schedule for the trainer; None where there is none."""
    if job.settings.time_budget == "off":
        return None
    budget = training_budget(t.model.settings, job.work, spent, clock, job.warn)
    t.schedule = budget.schedule
    return budget


def follow_budget(job: Job, t: Trainer, budget: Budget) -> None:
    """Adopt the budget's schedule where a step has changed it."""
    before, known = budget.schedule.iterations, budget.known
    if budget.after(t.step):
        t.schedule = budget.schedule
        rest = f" (so far: {before})" if known else ""
        job.say(f"{t.schedule.iterations} steps fit into the budget of {job.settings.time_budget} s{rest}")


def write_report(path: Path, job: Job, t: Trainer, seconds: float, found: dict[str, Any], priors: Sequence[Prior]) -> None:
    """The report; its seconds differ from run to run.

    found  figures of the last preview, and what the checks found
    """
    settings = t.model.settings
    job.record("schedule", t.schedule.state())
    report = {
        "iterations": t.schedule.iterations,
        "schedule": t.schedule.state(),
        "time_budget": job.settings.time_budget,
        "seconds": round(seconds, 1),
        "preview_psnr": None,
        "preview_ssim": None,
        **found,
        "priors": {prior.name: {"masked": round(prior.masked, 4), "contradicted": round(prior.contradicted, 4), "applied": prior.applied} for prior in priors},
        "exposure": exposure_facts(t.exposure),
        "occupied": t.model.voxels.occupied,
        "log2_hashmap_size": settings.log2_hashmap_size,
        "finest_resolution": settings.finest_resolution,
    }
    path.write_text(json.dumps(report, indent=1, sort_keys=True) + "\n", encoding="utf-8")
