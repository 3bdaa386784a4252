"""The train stage: a scene in, a trained field out.

    field.safetensors  both fields, the density voxels, what they mean; each photograph's exposure where it was learned
    report.json        steps and seconds, and the settings that give the same field again
    log.jsonl          a line every few steps
    curve.png          PSNR over steps
    previews/          a held-back view every so often

Checkpoints lie in the scratch folder that belongs to the request; the last two are kept. A run that goes on from one ends with the bytes of a run
that was never disturbed.
"""

from __future__ import annotations

import json
import math
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from efficientnerf.settings import given
from efficientnerf.training.settings import TrainSettings
from pipeline.stage import Job, Stage
from stages.artifacts import TrainInputs, TrainOutputs, inputs_of, needs_of
from stages.compiling import compiling_kernels
from stages.training.budget import MOST, TIMED, Budget

if TYPE_CHECKING:
    from efficientnerf.model import Model
    from efficientnerf.training.loop import Progress, SparseDepthRays, Trainer
    from efficientnerf.training.pixels import Pixels
    from stages.io.scene import Scene, View

LOG_EVERY = 10
CHECKPOINTS_KEPT = 2
FEWEST_OBSERVERS = 3
clock = time.monotonic
NOWHERE = 1e-9  # scene is 2 across: nearer to a camera than this, a point has no direction


@compiling_kernels
def run(job: Job) -> None:
    from efficientnerf.model import model
    from efficientnerf.rendering.field_renderer import FieldRenderer
    from efficientnerf.training import loop
    from efficientnerf.training.readback import AsyncOccupancy
    from stages.io import field_file, scene
    from stages.training.hash_resolution import with_auto_sizes

    _check(job.settings)
    use_all_cores()
    folder = inputs_of(TrainInputs, job.inputs).poses.folder
    s = scene.load(folder)
    views = scene.views_of(s, "train")
    job.progress(0, job.settings.iterations, "reading images")
    pixels = pixels_of(folder, views)
    settings = with_auto_sizes(job.settings, s, len(pixels))
    near, far = _range(s, pixels, settings)
    m = model(field_file.space_of(s), settings, s.background, job.device, (near, far))
    _close(m, views, job)
    t = loop.trainer(m, len(views))
    log = job.work / TrainOutputs.log
    spent = _resume(t, job, log)
    budget = Budget(settings, job.work, spent, clock) if settings.time_budget != "off" else None
    if budget is not None:
        m.settings = budget.planned()

    renderer = FieldRenderer(m, near, far)
    watched = _watched(s)
    _preview(renderer, watched, folder, job, t.step, settings)
    lines: list[str] = []
    started, first, loss = clock(), t.step, 0.0
    held_back: float | None = None
    occupied = AsyncOccupancy(m.voxels)
    pace: dict[str, Any] = {}
    working, logged, resumed = 0.0, first, clock()  # seconds of steps alone, since the last line of the log
    for done in loop.train(t, pixels, anchors_of(folder, s)):
        working += clock() - resumed
        loss = done.loss if done.step == first + 1 else 0.95 * loss + 0.05 * done.loss
        if budget is not None:
            _settle_steps(job, m, budget, done.step)
        last = done.step == m.settings.iterations
        drawn = _preview(renderer, watched, folder, job, done.step, settings)
        held_back = drawn or held_back
        seconds = spent + clock() - started
        shown = done.step % LOG_EVERY == 0 or last
        if shown or drawn is not None or not pace:
            share = occupied()
        if shown or drawn is not None:
            lines.append(json.dumps(_line(done, loss, share, seconds, working / (done.step - logged), drawn), sort_keys=True))
            working, logged = 0.0, done.step
        goal = settings.occupancy_warmup_steps + TIMED if m.settings.iterations == MOST else m.settings.iterations
        if shown or not pace:
            pace = _pace(done, share, seconds - spent, done.step - first, goal)
        facts = {"loss": loss, "psnr": round(-10 * math.log10(max(loss, 1e-10)), 2), **({} if held_back is None else {"held_back_psnr": held_back})}
        job.progress(min(done.step, goal), goal, "training", **facts, **pace)
        if drawn is not None:
            _curve([*_lines(log), *map(json.loads, lines)], job.work / TrainOutputs.curve)
        if done.step % settings.checkpoint_every == 0 and not last:
            _checkpoint(t, job, log, lines, seconds)
        try:
            job.safe_point()
        except BaseException:
            if not last:
                _checkpoint(t, job, log, lines, seconds)
            raise
        resumed = clock()
    _append(log, lines)
    field_file.save_model(m, near, far, TrainOutputs(job.out).field, gains_of(t, views))
    _report(job, t, spent + clock() - started, held_back)
    _publish_log(log, job)


def _check(settings: TrainSettings) -> None:
    """UsageError where settings contradict each other."""
    from pipeline.errors import UsageError

    if len(settings.rate_aims) % 2:
        raise UsageError(f"train.rate_aims={list(settings.rate_aims)}: expected pairs, a number of steps and the step up to which it was aimed at.")
    if settings.coarse == "voxels" and (settings.field, settings.sampling, settings.occupancy_rule) != ("hash", "efficient", "maximum"):
        raise UsageError("train.coarse=voxels needs train.field=hash, train.sampling=efficient and train.occupancy_rule=maximum.")


def _close(m: Model, views: tuple[View, ...], job: Job) -> None:
    """Close the voxels whose matter would be seen by too few photographs for them to tell where it is."""
    import torch

    from efficientnerf.sampling.occupancy import mask_cells
    from stages.framing.view_coverage import cells_below_min_views

    if not m.space.contracted or m.settings.min_views == "off":
        return
    job.progress(0, m.settings.iterations, "looking for what few photographs show")
    mask_cells(m.voxels, torch.from_numpy(cells_below_min_views(m.space, [view.camera for view in views], m.settings.min_views, m.voxels.side)))


def gains_of(t: Trainer, views: tuple[View, ...]) -> dict[str, np.ndarray] | None:
    """The factors (3,) that were learned for each training view, by the name of its image; None where none were."""
    if t.exposure is None:
        return None
    from efficientnerf.training.exposure import log_gains

    return dict(zip((view.image for view in views), np.exp(log_gains(t.exposure.detach()).cpu().numpy()), strict=True))


def _settle_steps(job: Job, m: Model, budget: Budget, step: int) -> None:
    """Once enough steps have been timed, settle how many there will be, and again on the way."""
    known = m.settings.iterations
    if (settled := budget.after(step)) is not None:
        m.settings = settled
        job.say(f"{settled.iterations} steps fit into the budget of {job.settings.time_budget} s" + ("" if known == MOST else f" (so far: {known})"))


def _report(job: Job, t: Trainer, seconds: float, held_back: float | None) -> None:
    """What was reached, and how to make the same field again; seconds make it differ from run to run."""
    reached = t.model.settings
    report = {
        "iterations": reached.iterations,
        "rate_hold": reached.rate_hold,
        "rate_aims": reached.rate_aims,
        "budget": job.settings.time_budget,
        "seconds": round(seconds, 1),
        "held_back_psnr": held_back,
        "occupied": t.model.voxels.occupied,
        "log2_table": reached.log2_hashmap_size,
        "finest": reached.finest_resolution,
        "again": _again(reached),
    }
    TrainOutputs(job.out).report.write_text(json.dumps(report, indent=1, sort_keys=True) + "\n", encoding="utf-8")


def _again(reached: TrainSettings) -> str:
    """Options that give the same field again."""
    aims = f" --set train.rate_aims={json.dumps(reached.rate_aims, separators=(',', ':'))}" if reached.rate_aims else ""
    return f"--set train.time_budget=off --set train.iterations={reached.iterations} --set train.rate_hold={reached.rate_hold}{aims}"


def _range(s: Scene, pixels: Pixels, settings: TrainSettings) -> tuple[float, float]:
    """Nearest and farthest of all views along their axes; where the settings state them, of the pixels too."""
    if settings.far_plane != "auto":
        near, far = stated_range(s, settings)
        pixels.near[:], pixels.far[:] = near, far
        return near, far
    return min(view.near for view in s.views), max(view.far for view in s.views)


def stated_range(s: Scene, settings: TrainSettings) -> tuple[float, float]:
    """train.near_plane and train.far_plane in the training frame."""
    from pipeline.errors import UsageError

    if s.background is None:
        raise UsageError("train.near_plane and train.far_plane are for scenes on a constant background; this one has surroundings. Leave them auto.")
    near, far = given(settings.near_plane), given(settings.far_plane)
    if near is None or far is None or near >= far:
        raise UsageError(f"train.near_plane={settings.near_plane}, train.far_plane={settings.far_plane}: expected two numbers, the second one greater.")
    return near * float(s.world_from_capture.scale), far * float(s.world_from_capture.scale)


def pixels_of(folder: Path, views: tuple[View, ...]) -> Pixels:
    """All pixels of some views of a scene, as bytes; one image at a time is held beside them."""
    from efficientnerf.training.pixels import Pixels
    from stages.io import scene

    images = (scene.read_image(folder, view) for view in views)
    masks = (scene.read_mask(folder, view) for view in views)
    near, far = np.array([view.near for view in views]), np.array([view.far for view in views])
    channels = 4 if any(scene.has_alpha(folder, view) for view in views) else 3
    return Pixels([view.camera for view in views], images, masks, near, far, channels)


def anchors_of(folder: Path, s: Scene) -> SparseDepthRays | None:
    """Rays of training cameras to the sparse points that were seen there; only points that three photographs or more agree on, and only
    from cameras they lie before: posed data sets name points behind a camera, or in it, too."""
    from efficientnerf.training.loop import SparseDepthRays
    from stages.io import scene

    if not s.points:
        return None
    points = scene.read_points(folder)
    loop = np.array([view.split == "train" for view in s.views])
    centres = np.array([view.camera.centre for view in s.views])
    pairs = [(n, view) for n, seen in enumerate(points.tracks) if len(seen) >= FEWEST_OBSERVERS for view in seen if loop[view]]
    if not pairs:
        return None
    which, view = np.array(pairs, np.int64).T
    away = points.xyz[which] - centres[view]
    distance = np.linalg.norm(away, axis=1)
    forward = np.array([v.camera.forward for v in s.views])
    before = (away * forward[view]).sum(1) > NOWHERE  # so is the distance; what is not a number is not before anything
    if not before.any():
        return None
    away, distance, view = away[before], distance[before], view[before]
    return SparseDepthRays(centres[view].astype(np.float32), (away / distance[:, None]).astype(np.float32), distance.astype(np.float32))


def use_all_cores() -> None:
    """Let torch compute on all the cores this process may use: the number is part of what makes results repeat."""
    import os

    import torch

    torch.set_num_threads(int(os.environ.get("OMP_NUM_THREADS", 0)) or len(os.sched_getaffinity(0)))


def _checkpoints(job: Job) -> list[Path]:
    return sorted(job.work.glob("checkpoint_*.safetensors"))


def _checkpoint(t: Trainer, job: Job, log: Path, lines: list[str], seconds: float) -> None:
    from efficientnerf.training.loop import state_of
    from stages.io.field_file import write_tensors

    _append(log, lines)
    lines.clear()
    write_tensors(state_of(t), {"step": t.step, "seconds": seconds}, job.work / f"checkpoint_{t.step:08d}.safetensors")
    for old in _checkpoints(job)[:-CHECKPOINTS_KEPT]:
        old.unlink()


def _resume(t: Trainer, job: Job, log: Path) -> float:
    """Go on from the newest checkpoint that can be read, if there is one; the seconds that were trained up to it."""
    from efficientnerf.training.loop import restore
    from pipeline.errors import CorruptArtifact
    from stages.io.field_file import read_tensors

    spent = 0.0
    for path in reversed(_checkpoints(job)):
        try:
            tensors, about = read_tensors(path)
            restore(t, tensors)
            spent = float(about["seconds"])
        except (CorruptArtifact, KeyError, ValueError) as error:
            job.warn(f"{path.name} can't be used ({error}); going on from the one before it")
            path.unlink()
            continue
        job.say(f"training goes on from step {t.step}")
        break
    # What was logged after the checkpoint will be logged again.
    if log.exists():
        kept = [line for line in _lines(log) if line["step"] <= t.step]
        log.write_text("".join(json.dumps(line, sort_keys=True) + "\n" for line in kept), encoding="utf-8")
    return spent


def _lines(log: Path) -> list[dict[str, Any]]:
    out: list[dict[str, Any]] = []
    if not log.exists():  # nothing has been written before the first checkpoint
        return out
    for text in log.read_text(encoding="utf-8").splitlines():
        try:
            out.append(json.loads(text))
        except ValueError:  # a line cut short by a kill
            break
    return out


def _append(log: Path, lines: list[str]) -> None:
    with open(log, "a", encoding="utf-8") as file:
        file.writelines(line + "\n" for line in lines)


def _pace(done: Progress, occupied: float, seconds: float, steps: int, goal: int) -> dict[str, Any]:
    """How fast it goes, for the display: samples of this step at the mean pace so far, the share of valid voxels, and seconds left."""
    each = max(seconds / max(steps, 1), 1e-9)
    return {"samples_per_s": round((done.valid + done.fine) / each), "occupied": round(occupied, 4), "left": round(each * max(0, goal - done.step), 1)}


def _line(done: Progress, loss: float, occupied: float, seconds: float, step_seconds: float, held_back: float | None) -> dict[str, Any]:
    """seconds: of the stage, pictures and checkpoints included; step_seconds: of a step alone, the mean since the last line; left_out: of the step's rays,
    those that found no room for their samples; on CUDA counts and shares are those of some steps before (`efficientnerf.training.readback`)."""
    return {
        "step_seconds": round(step_seconds, 6),
        "held_back_psnr": held_back,
        "step": done.step,
        "loss": loss,
        "psnr": -10 * math.log10(max(loss, 1e-10)),
        "rays": done.rays,
        "tried": done.tried,
        "valid": done.valid,
        "pivotal": done.pivotal,
        "fine": done.fine,
        "left_out": done.left_out,
        "occupied": occupied,
        "seconds": round(seconds, 3),
    }


def _watched(s: Scene) -> View | None:
    """The held-back view that previews show: one of val if there is any, so that the test views stay unseen until the end."""
    from stages.io.scene import views_of

    views = views_of(s, "val") or views_of(s, "test")
    return views[len(views) // 2] if views else None


PREVIEW_SIDE = 200


def _preview(renderer: Any, view: View | None, folder: Path, job: Job, step: int, settings: TrainSettings) -> float | None:
    """Draw the watched view small, keep the picture, return its PSNR."""
    if view is None or settings.preview_every == "off" or step == 0 or step % settings.preview_every:
        return None
    from efficientnerf.evaluation.metrics import psnr
    from stages.evaluate import ground_truth, subsample, subsample_camera
    from stages.io.png import write_png
    from stages.pictures.plots import to_uint8

    target = job.work / f"preview_{step:06d}.png"
    stride = max(1, math.ceil(max(view.camera.width, view.camera.height) / PREVIEW_SIDE))
    truth = subsample(ground_truth(folder, view, renderer.model.background).colour, stride)
    picture = np.clip(renderer.render(subsample_camera(view.camera, stride)).colour, 0, 1)
    write_png(to_uint8(np.concatenate([truth, picture], axis=1)), target)
    return round(float(psnr(picture, truth)), 2)


def _curve(lines: list[dict[str, Any]], path: Path) -> None:
    """PSNR over steps, of the training rays and of the held-back view: while it trains in the scratch folder, beside the previews, then in the artifact."""
    from stages.pictures.plots import curve

    series = {"training rays, running mean": ([x["step"] for x in lines], [x["psnr"] for x in lines])}
    held_back = [(x["step"], x["held_back_psnr"]) for x in lines if x.get("held_back_psnr") is not None]
    if held_back:
        series["held-back view"] = ([step for step, _ in held_back], [psnr for _, psnr in held_back])
    curve(path, series, x_label="step", y_label="PSNR / dB")


def _publish_log(log: Path, job: Job) -> None:
    import shutil

    outputs = TrainOutputs(job.out)
    shutil.copyfile(log, outputs.log)
    _curve(_lines(log), outputs.curve)
    previews = sorted(job.work.glob("preview_*.png"))
    if previews:
        outputs.previews.mkdir()
        for path in previews:
            shutil.copyfile(path, outputs.previews / path.name)


STAGE = Stage(
    name="train",
    version=2,
    settings=TrainSettings,
    needs=needs_of(TrainInputs),
    run=run,
    volatile=(TrainOutputs.log, TrainOutputs.curve, f"{TrainOutputs.previews}/*", TrainOutputs.report),
)
