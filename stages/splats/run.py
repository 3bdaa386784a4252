"""The splats stage: the asset as 3D Gaussians, which other programs render in real time; as PLY and SPZ, with a preview and a report.

Where splats.make is off, or auto and none can be made, the report says so, and there is no more.
"""

import math
import time
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import torch

from efficientnerf.asset.camera_paths import turntable_cameras
from efficientnerf.asset.format import load
from efficientnerf.asset.rendering import render
from efficientnerf.asset.tree import NerfTree
from efficientnerf.settings import resolved
from efficientnerf.splats import rendering
from efficientnerf.splats.build import Budget, NothingToShow, gaussians_of_asset
from efficientnerf.splats.gaussians import Gaussians
from efficientnerf.splats.refit import PIXELS
from pipeline.errors import StageFailed, UsageError
from pipeline.files import write_json
from pipeline.stage import Job
from stages.artifacts import BakeOutputs, SplatsOutputs
from stages.compiling import running_kernels
from stages.figures.plots import to_uint8
from stages.formats.exporters import SPLAT_EXPORTERS
from stages.formats.exporters.splats.frames import in_capture
from stages.formats.exporters.writing import source_frame
from stages.framing.restriction import restricted
from stages.io.png import write_png
from stages.io.refined_cameras import load_scene
from stages.memory.device import fits_on_device
from stages.memory.need import refuse_what_does_not_fit
from stages.splats.memory import most_gaussians, needed, needed_on_device
from stages.splats.pictures import photographs, render_cameras, renders
from stages.splats.settings import SplatsSettings

PASSES, STEPS_A_VIEW, FEWEST_STEPS, MOST_STEPS = 16, 30, 1080, 3600  # docs/experiments/splats.md
MORE_WITH_TIME, MOST_TIMED_STEPS = 3, 8000  # with a time budget, which may end them earlier: so many times as many, at most
PREVIEW = (480, 360)  # pixels, of each of the two pictures


def gaussians_of(
    tree: NerfTree, settings: SplatsSettings, progress: Callable[[int, int, str], None], captured: tuple[Path, Path] | None = None
) -> Gaussians:
    """Gaussians of what a tree shows, in the training frame, made on the tree's device; `progress` takes (done, total, text).

    captured  folders of the stages poses and train, whose photographs they are fitted to; None: the tree's own renders

    Raises StageFailed where nothing shows.
    """
    began, seconds = time.monotonic(), resolved(settings.time_budget)
    if captured is None or settings.pictures == "asset" or settings.region == "foreground":
        views = renders(tree, render_cameras(tree), progress)
    else:
        views = photographs(captured[0], load_scene(*captured), captured[1])
    try:
        budget = budget_of(settings, [view.camera.width * view.camera.height for view in views])
        return gaussians_of_asset(tree, views, budget, progress, None if seconds is None else lambda: (time.monotonic() - began) / seconds)
    except NothingToShow as error:
        raise StageFailed(f"splats: {error}. Train longer, or bake the asset again.") from error


def budget_of(settings: SplatsSettings, pixels: Sequence[int]) -> Budget:
    """The budget of Gaussians, for pictures of so many pixels each."""
    steps = resolved(settings.iterations)
    if steps is None:
        usual = max(math.ceil(PASSES * sum(pixels) / PIXELS), STEPS_A_VIEW * len(pixels), FEWEST_STEPS)
        steps = min(usual, MOST_STEPS) if settings.time_budget == "off" else min(MORE_WITH_TIME * usual, MOST_TIMED_STEPS)
    return Budget(most_gaussians(settings, pixels), settings.sh_degree, steps, settings.seed)


def preview(tree: NerfTree, gaussians: Gaussians) -> np.ndarray:
    """(H, W, 3) uint8: the asset and its Gaussians side by side, from the first camera of a turntable, on white."""
    camera = turntable_cameras(tree, frames=1, width=PREVIEW[0], height=PREVIEW[1])[0]
    white = None if tree.environment is not None else (1.0, 1.0, 1.0)
    own, theirs = render(tree, camera, background=white, normals=False), rendering.render(gaussians, camera, white, tree.device)
    return to_uint8(np.clip(np.concatenate([own.colour, theirs.colour], axis=1), 0, 1))


@running_kernels
def run(job: Job) -> None:
    outputs, settings = SplatsOutputs(job.out), job.settings
    if settings.make == "off":
        write_json(outputs.report, {"gaussians": 0, "made": False})
        job.say("skipped (splats.make=off)", gaussians=0)
        return
    try:
        _make(job, outputs, settings)
    except (StageFailed, UsageError) as error:
        if settings.make == "on":
            raise
        write_json(outputs.report, {"gaussians": 0, "made": False, "reason": str(error)})
        job.warn(f"no Gaussians are made; the run continues: {error}")


def _make(job: Job, outputs: SplatsOutputs, settings: SplatsSettings) -> None:
    """Raises UsageError where memory is too small, StageFailed where nothing shows."""
    started = time.monotonic()
    tree = restricted(load(BakeOutputs(job.inputs["bake"]).asset), settings.region)
    captured = job.inputs["poses"], job.inputs["train"]
    remedy = f"Lower splats.count ({settings.count}), poses.max_image_size or bake.max_mib."
    refuse_what_does_not_fit(job, needed(tree, settings, captured, job.device), remedy)
    if fits_on_device(job, needed_on_device(settings), f"fitting {settings.count:,} Gaussians", "Lower splats.count"):
        tree = tree.to(job.device)
    try:
        gaussians = gaussians_of(tree, settings, job.reached, captured)
    except torch.OutOfMemoryError:
        job.warn(f"the device has no memory left for {settings.count:,} Gaussians. They are fitted on the CPU, which takes longer. Lower splats.count.")
        tree = tree.to("cpu")
        gaussians = gaussians_of(tree, settings, job.reached, captured)
    job.safe_point()
    frame = source_frame(tree.metadata)
    written = in_capture(gaussians, frame)
    for path in (outputs.ply, outputs.spz):
        SPLAT_EXPORTERS[path.suffix](written, path, frame)
    write_png(preview(tree, gaussians), outputs.preview)
    sizes = {"ply_bytes": outputs.ply.stat().st_size, "spz_bytes": outputs.spz.stat().st_size}
    write_json(outputs.report, {"gaussians": len(gaussians), "made": True, "sh_degree": gaussians.degree, "region": settings.region, **sizes})
    job.say(f"{len(gaussians)} Gaussians in {time.monotonic() - started:.0f} s", gaussians=len(gaussians))
