"""Refinement in the bake stage: the baked values are fitted to the training images, in two phases (`efficientnerf.asset.refinement.schedule`).

After the first the tree is rendered along many training rays, and voxels that do not show are dropped (`stages.bake.pruning`): floaters have faded by then.
The steps after that correct for what is missing. An interrupted refinement goes on from its
checkpoint (`stages.bake.refine.checkpoint`).

With bake.time_budget the number of steps of a phase follows from the time that its first ones take, as in training (`stages.train.budget`).
"""

import math
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from efficientnerf.asset.cascades import cascades_of
from efficientnerf.asset.field_samples import FieldSamples
from efficientnerf.asset.refinement import fit
from efficientnerf.asset.refinement.error_map import count_cells
from efficientnerf.asset.refinement.schedule import PHASES, RefinementSchedule, stated_schedule
from efficientnerf.asset.refinement.state import MAX_INITIAL_THICKNESS, initial_state
from efficientnerf.asset.refinement.targets import Targets
from efficientnerf.asset.rendering import render
from efficientnerf.asset.tree import NerfTree
from efficientnerf.geometry.cameras import Camera
from efficientnerf.training.patches import PatchGrid
from efficientnerf.training.schedule import Schedule
from pipeline.stage import Job
from stages.artifacts import BakeOutputs
from stages.bake import pruning
from stages.bake.holes import find_holes
from stages.bake.memory import needed_on_device
from stages.bake.plan import Bake, coarse_cells
from stages.bake.pruning import Pruned
from stages.bake.refine import checkpoint
from stages.bake.refine.checkpoint import Point
from stages.bake.refine.log import RefinementLog
from stages.bake.refine.timing import FINISH_SECONDS_PER_VOXEL, HOLD, WARMUP, WEIGHT_SECONDS, Stopwatch, allotted, clock, packing_seconds
from stages.bake.voxels import Voxels
from stages.cores import count_cores
from stages.io.scene import Scene
from stages.memory.device import fits_on_device
from stages.train.budget import UNKNOWN, Budget
from stages.train.log import psnr_of
from stages.train.previews import Previews

CHECKPOINT_SECONDS = 30.0
ERROR_RAYS = 2**16  # training pixels that the report's PSNR is measured on
# docs/experiments/refinement.md
MIN_STEPS, STEP_RAYS_PER_VOXEL, SCENE_STEP_RAYS_PER_VOXEL = 320, 15, (6, 15)  # see `usual_steps`
UNREFINED = 0.1  # of the steps that are usual: with fewer the asset is hardly refined


@dataclass(eq=False)
class Refinement:
    """A refinement that is going on."""

    job: Job
    scene: Scene
    plan: Bake
    targets: Targets
    most: int  # voxels that the asset holds
    stopwatch: Stopwatch
    point: Point
    log: RefinementLog
    budget: float | None  # seconds of the stage up to the end of the last step, or None
    per_ray: float = 0.0  # seconds that measuring the error of a ray took
    samples: FieldSamples | None = None  # of the field, for unbounded scenes: they restore what was dropped wrongly
    baked: np.ndarray | None = None  # (N,) of unbounded scenes the densities before the first step
    written: float = field(default_factory=clock)

    def run(self) -> NerfTree:
        """Take all steps that are left; the tree after the last of them."""
        point = self.point
        if not point.schedule.each:
            self._begin_phase()
        if point.phase == 0:
            self._take_steps()
            point.state, point.pruned, point.kept = pruning.prune(
                self.job, self.scene, self.plan, point.state, self.targets, self.most, self.samples, self.baked
            )
            point.phase = 1
            self._begin_phase()
            self._save()
        self._take_steps()
        point.state.to_host()
        return replace(point.state.tree)  # what a renderer made of earlier values is left behind

    def _begin_phase(self) -> None:
        """Allot time to the phase, if there is a budget."""
        point = self.point
        if self.budget is None:
            return
        point.began = point.seconds = self.stopwatch.seconds
        point.allotted = allotted(point.phase, self.budget - point.began - (0.0 if point.phase else self._pruning_seconds()))
        point.schedule = point.schedule.with_phase(point.phase, Schedule(UNKNOWN, HOLD))

    def _pruning_seconds(self) -> float:
        """About how many seconds it takes to find which voxels show."""
        state = self.point.state
        return pruning.count_rays(self.job, self.plan, len(state.density), self.targets) * self.per_ray * WEIGHT_SECONDS

    def _take_steps(self) -> None:
        """Take the steps that are left of the phase, with checkpoints on the way and where it is stopped."""
        settings, point, state, job = self.job.settings, self.point, self.point.state, self.job
        begin, number = point.schedule.begin(point.phase), point.phase
        spent = point.seconds - point.began
        budget = None if self.budget is None else Budget(point.allotted, point.schedule.each[number], WARMUP, spent, clock)
        phase, end = PHASES[number].name, point.schedule.begin(number + 1)
        if state.step >= end:
            return
        run = fit.optimise(
            state, self.targets, until=end, rays=settings.refine_rays_per_batch, density_lr=settings.density_lr, sh_lr=settings.sh_lr,
            fall=lambda step: settings.lr_final_ratio ** point.schedule.fraction(step), seed=settings.seed,
            view_dependent_lr_ratio=self.plan.view_dependent_lr_ratio, total_variation=self.plan.total_variation, error_map=self.plan.error_map,
        )  # fmt: skip
        step_began = clock()
        for error in run:
            took = clock() - step_began
            if budget is not None and budget.after(state.step - begin):
                point.schedule = point.schedule.with_phase(number, budget.schedule)
                end = point.schedule.begin(number + 1)
                job.say(f"{budget.schedule.iterations} steps with {phase} fit into the budget")
            fraction = point.schedule.fraction(state.step)
            shown = self.log.record(state, phase, fraction, settings.refine_rays_per_batch, error, took, last=state.step == end)
            # in steps, or in seconds where there is a budget
            done, total = (self.stopwatch.seconds, self.budget) if self.budget is not None else (state.step, point.schedule.begin(len(point.schedule.each)))
            job.progress(min(done, total), total, f"refining {phase}", **shown)
            if clock() - self.written > CHECKPOINT_SECONDS:
                self._save()
            try:
                job.safe_point()
            except BaseException:
                self._save()
                raise
            if state.step >= end:
                break
            step_began = clock()

    def _save(self) -> None:
        self.point.seconds = self.stopwatch.seconds
        self.log.flush()
        checkpoint.save(self.job, self.point)
        self.written = clock()


def refined(
    job: Job, s: Scene, plan: Bake, voxels: Voxels, tree: NerfTree, targets: Targets, stopwatch: Stopwatch
) -> tuple[NerfTree, dict[str, Any]]:
    """The refined tree of at most as many voxels as the asset holds, and the entries of the report; the log, the curve and the previews are written."""
    settings, seconds = job.settings, plan.seconds
    samples, capacity = None if voxels.surroundings is None else voxels.surroundings.samples, plan.capacity(coarse_cells(voxels.grids))
    most = min(len(tree.density_values), capacity)
    steps = plan.refine_steps
    if steps is None:
        steps = usual_steps(most, settings.refine_rays_per_batch, len(targets.pixels) if plan.kind == "scene" else None)
    report: dict[str, Any] = {"psnr_before": None, "psnr_after": None, "voxels_baked": len(tree.density_values)}
    sample = min(ERROR_RAYS, 4 * len(targets.pixels))
    targets = targets_on_device(job, tree, targets)
    before = fit.error(tree, targets, sample, settings.seed)
    began = clock()
    if seconds is not None:
        fit.error(tree, targets, sample, settings.seed)  # again: kernels were loaded meanwhile
    measuring = clock() - began
    per_ray = measuring / sample
    finish = measuring + FINISH_SECONDS_PER_VOXEL * most
    if plan.layout == "packed":
        finish += packing_seconds(most, count_cores(), per_ray, settings.refine_rays_per_batch)
    schedule = stated_schedule(steps) if seconds is None else RefinementSchedule()
    thickness = MAX_INITIAL_THICKNESS if steps else math.inf
    bare = replace(tree, harmonics=np.zeros((len(tree.density_values), 0, 3), np.float32))
    baked = None if samples is None else initial_state(bare, thickness).density
    cells = count_cells(PatchGrid(targets.host_pixels, fit.PATCH_SIDE))
    point = _first_point(job, tree, schedule, stopwatch, cells, thickness, timed=seconds is not None)
    log = RefinementLog(
        job.work / BakeOutputs.log, point.state.step, point.schedule.fraction(point.state.step), stopwatch, _previews(job, s, point, targets), clock
    )  # fmt: skip
    if point.state.step == 0:
        log.begin(point.state, PHASES[0].name, before)
    del tree  # the state has values of its own
    made = Refinement(job, s, plan, targets, capacity, stopwatch, point, log, None if seconds is None else seconds - finish, per_ray, samples, baked)
    tree = made.run()
    if point.state.step < UNREFINED * steps:
        job.warn(_unrefined(point.state.step, steps))
    report |= {"steps": point.state.step, "schedule": point.schedule.state(), "time_budget": settings.time_budget}
    report["psnr_before"], report["psnr_after"] = (round(psnr_of(error), 3) for error in (before, fit.error(tree, targets, sample, settings.seed)))
    job.record("schedule", point.schedule.state())
    if samples is not None:
        report["holes"] = _holes(job, tree, samples, point.pruned or Pruned())
    outputs = BakeOutputs(job.out)
    log.publish(outputs.log, outputs.curve)
    log.previews.publish(outputs.previews, job.warn)
    return tree, report


def _unrefined(taken: int, usual: int) -> str:
    """The warning about a time budget that was too short, and what to do."""
    done = f"bake.time_budget left time for {taken} step{'' if taken == 1 else 's'} of the refinement, where {usual:,} are usual"
    return f"{done}: refinement hardly improved the asset. Give more time (--budget) or fewer voxels (bake.max_mib), or run it while the machine is idle."


def _first_point(job: Job, tree: NerfTree, schedule: RefinementSchedule, stopwatch: Stopwatch, cells: int, thickness: float, *, timed: bool) -> Point:
    """Where an earlier attempt stopped, or else the beginning."""
    found = checkpoint.restored(job, tree, schedule, HOLD if timed else None, cells=cells)
    if found is None:
        return Point(initial_state(tree, thickness), schedule)
    stopwatch.set(found.seconds)
    return found


def _previews(job: Job, s: Scene, point: Point, targets: Targets) -> Previews:
    """Renders of the tree as it is at the time."""
    def seen(camera: Camera) -> np.ndarray:
        # What a renderer makes of values is kept with a tree, and these change.
        tree = replace(point.state.tree).to(job.device if targets.on_device else "cpu")
        return render(tree, camera, background=targets.background, normals=False).colour

    return Previews(seen, targets.background, job.inputs["poses"], s, job.work)


def _holes(job: Job, tree: NerfTree, samples: FieldSamples, pruned: Pruned) -> dict[str, Any]:
    """The entry of the report about holes, which is also a message."""
    holes = {**pruned.report(), "refined": round(find_holes(job, tree, samples)[1], 6)}
    job.say(f"holes, where the field is opaque and the asset is not: {holes['pruned']:.2%} of the rays after voxels were dropped,"
            f" {holes['restored']:.2%} with {pruned.voxels:,} voxels restored, {holes['refined']:.2%} at the end")  # fmt: skip
    return holes


def targets_on_device(job: Job, tree: NerfTree, targets: Targets) -> Targets:
    """The targets on the run's device, where the tree is then fitted; on the host where the device's memory is too small."""
    cells = sum(cascade.brick_index.size for cascade in cascades_of(tree))
    voxels = len(tree.density_values)
    needed = needed_on_device(voxels, tree.harmonics_count, len(tree.voxel_index), cells, tree.brick, smooth=job.settings.total_variation != 0)
    needed += voxels * bool(tree.outer)  # the cascade of each voxel
    if targets.pixels.images is not None:
        needed += targets.pixels.images.nbytes
    fits = fits_on_device(job, needed, f"refining {voxels:,} voxels", "Lower bake.max_mib or bake.resolution")
    return targets.to(job.device) if fits else targets


def usual_steps(voxels: int, rays: int, pixels: int | None) -> int:
    """Steps of so many rays where nothing is stated.

    pixels  of all training images of an unbounded scene, which are soon overfitted: a ray for each, between 6 and 15 for each voxel; None: of another
            scene, 15 for each voxel
    """
    least, most = SCENE_STEP_RAYS_PER_VOXEL
    wanted = STEP_RAYS_PER_VOXEL * voxels if pixels is None else min(max(pixels, least * voxels), most * voxels)
    return max(MIN_STEPS, math.ceil(wanted / rays))
