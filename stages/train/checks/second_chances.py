"""Second chances: where a run learns nothing, short trainings try changes that have rescued other captures.

Each trial leaves out one of the priors that keep density away, or lets training correct errors of photographs. All begin from nothing, draw
the same pixels, and are compared on the same pixels of the same held-out views. A trial that a kill cut short is done again; finished
ones are not. docs/experiments/early-check.md
"""

import copy
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace

import numpy as np

from efficientnerf.model import model
from efficientnerf.rendering.field_renderer import FieldRenderer
from efficientnerf.training import loop
from efficientnerf.training.pixels import Pixels
from efficientnerf.training.settings import TrainSettings
from efficientnerf.training.sparse_depth import SparseDepthRays
from pipeline.stage import Job
from stages.framing.view_coverage import kept_pixels
from stages.io.field_file import space_of
from stages.io.scene import Scene, View, views_of
from stages.scratch import note, noted
from stages.train.checks.early_check import EarlyResult, HeldOutView, judge
from stages.train.choices import TrainingChoices
from stages.train.data import begin_sky, depth_range, sparse_depth_of
from stages.train.exposure import begin_exposure
from stages.train.priors import filled_points, mask_cells_by
from stages.train.settings import stated_planes

# docs/experiments/early-check.md
SMALL = TrainSettings(
    iterations=300, sample_batch_size=16384, log2_hashmap_size=15, finest_resolution=512, occupancy_resolution=96, occupancy_warmup_steps=64,
)  # fmt: skip
BETTER = 0.2  # of the way from the mean colour to the blurred photograph: what a trial has to be ahead by
LOWER = 0.8  # of a near plane: what is lowered by less changes nothing
AS_STATED = "as stated"


@dataclass(frozen=True)
class Trial:
    """The result of a short training with other choices."""

    name: str
    choices: TrainingChoices
    result: EarlyResult


def candidates(s: Scene, settings: TrainSettings) -> dict[str, TrainingChoices]:
    """The choices that would change anything, by their names in messages; first the stated ones."""
    own = TrainingChoices()
    found, priors = {AS_STATED: own}, own
    if s.forward is None and stated_planes(settings) is None:
        if _lowers(replace(own, near="median"), s):
            found["near planes at most their median"] = replace(own, near="median")
        if _lowers(replace(own, near="off"), s):
            found["near planes off"] = priors = replace(own, near="off")
    if any(view.mask is not None for view in s.views):
        found["masks ignored"] = replace(own, masks=False)
        priors = replace(priors, masks=False)
    if s.contracted and settings.min_views != "off":
        found["min_views off"] = replace(own, min_views=False)
        priors = replace(priors, min_views=False)
    if priors not in found.values():
        found["all of these off"] = priors
    if s.background is None and settings.exposure != "on":
        found["exposure"] = replace(own, exposure=True)
    return found


def _lowers(choices: TrainingChoices, s: Scene) -> bool:
    """Whether any near plane becomes much lower."""
    return any(new.near < LOWER * old.near for new, old in zip(choices.scene(s).views, s.views, strict=True))


def try_all(job: Job, s: Scene, settings: TrainSettings, pixels: Pixels, held: Sequence[HeldOutView]) -> list[Trial]:
    """A trial of each candidate, in their order."""
    trials, depth = [], sparse_depth_of(job.inputs["poses"], s, settings.seed)
    for number, (name, choices) in enumerate(candidates(s, settings).items()):
        path = job.work / f"trial_{number}.json"
        trial = noted(path, Trial, job.warn)
        if trial is None or (trial.name, trial.choices) != (name, choices):
            result = _train(job, choices.scene(s), choices.settings(settings), pixels, held, depth, name)
            if result is None:
                continue
            trial = Trial(name, choices, result)
            note(path, asdict(trial))
        job.say(f"second chance, {name}: {trial.result.psnr:.2f} dB after a short training of {SMALL.iterations} steps", trial=asdict(trial))
        trials.append(trial)
    return trials


def best_of(trials: Sequence[Trial]) -> Trial | None:
    """The trial that is clearly better than what is stated; None: none is. Of those that are about as good the first: it changes least."""
    stated = next((trial for trial in trials if trial.name == AS_STATED), None)
    if stated is None:
        return None
    most = max(trial.result.progress for trial in trials)
    best = next(trial for trial in trials if trial.result.progress >= most - BETTER / 4)
    return best if best.result.progress >= stated.result.progress + BETTER else None


def _train(
    job: Job, s: Scene, settings: TrainSettings, pixels: Pixels, held: Sequence[HeldOutView], depth: SparseDepthRays | None, name: str
) -> EarlyResult | None:
    """The result of a short training on a scene; None where no pixel can be compared, or masks leave none to train on."""
    # Of the given settings those of what is learned, not of how much.
    kept = ("seed", "near_plane", "far_plane", "min_views", "exposure", "background_color")
    views, small = views_of(s, "train"), replace(SMALL, **{name: getattr(settings, name) for name in kept})
    own = _with_views(pixels, views)
    near, far = depth_range(s, own, small)
    m = model(space_of(s), small, s.background, job.device, (near, far))
    begin_sky(m, own)
    cameras, folder = [view.camera for view in views], job.inputs["poses"]
    mask_cells_by(m, cameras, own.near.tolist(), kept_pixels(folder, views), filled_points(folder, len(views)))
    exposure = begin_exposure(folder, s, own, small.exposure, job.device)
    for done in loop.train(loop.trainer(m, exposure, cameras=cameras), own, depth):
        job.reached(done.step, small.iterations, f"second chance, {name}")
    return judge(held, FieldRenderer(m, near, far).colour, small.iterations)


def _with_views(pixels: Pixels, views: Sequence[View]) -> Pixels:
    """The same pixels with the near planes, masks and cameras of these views, whatever the training that failed made of them; the bytes are shared."""
    own = copy.copy(pixels)
    own.near = np.array([view.near for view in views], np.float32)
    if all(view.mask is None for view in views):
        own.allowed = None
    own.leave_out(np.zeros(len(views), bool))
    poses = np.array([view.camera.world_from_camera for view in views], np.float32)
    if not (np.array_equal(own.rotation, poses[:, :3, :3]) and np.array_equal(own.centre, poses[:, :3, 3])):
        own.set_cameras([view.camera for view in views])
    return own
