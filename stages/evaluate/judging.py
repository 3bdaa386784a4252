"""The verdict of the evaluate stage: its inputs besides the held-out views, its file and picture, and its message."""

import json
import math
import statistics
from collections.abc import Mapping, Sequence
from typing import Any

from pipeline.files import write_json
from stages.artifacts import BakeOutputs, EvaluateOutputs, PosesOutputs
from stages.bake.refine.refinement import usual_steps
from stages.bake.settings import BakeSettings
from stages.evaluate import sparse_points
from stages.evaluate.comparison import Evaluation, compare, counting, trivial
from stages.evaluate.summary import means
from stages.evaluate.trivial import equivalent_blur
from stages.evaluate.views import evenly_spaced
from stages.io.png import write_png
from stages.io.scene import View, views_of
from stages.reports import BakeReport, CameraVerdict, read_report
from stages.verdict.result import verdict_on_result

TRAINING_VIEWS = 4  # that the asset is compared with, evenly spaced: enough to tell an overfit asset


def training_figures(e: Evaluation) -> dict[str, Any] | None:
    """The asset on some views that training saw: means of PSNR, SSIM and PSNR with fitted colours, and the median of `equivalent_blur`. None where there are
    no such views."""
    views, figures, blurs = views_of(e.scene, "train"), [], []
    for k in evenly_spaced(len(views), TRAINING_VIEWS):
        e.job.safe_point()
        truth = e.truth(views[k])
        flat = trivial(truth)
        if flat is None:
            continue
        found = compare(e.shown(views[k], e.rendering(views[k]).colour, "the asset"), truth, None)
        figures.append(found)
        blurs.append(equivalent_blur(found["psnr_colour_fitted"] or -math.inf, flat["blurred"]))
    return {**means(figures, ("psnr", "ssim", "psnr_colour_fitted")), "blur": statistics.median(blurs), "views": len(figures)} if figures else None


def judge(e: Evaluation, views: Sequence[View], metrics: Mapping[str, Any]) -> None:
    """Write the verdict on a result and the picture of its sparse points; report it, with a warning for each problem."""
    cameras = PosesOutputs(e.job.inputs["poses"]).verdict
    if e.points is not None:
        # the view whose points agree least with the asset's depth
        counts = [found["sparse_points"] for found in metrics["views"]]
        shares = [1.0 if not found["points"] else 1 - (found["nearer"] + found["farther"]) / found["points"] for found in counts]
        view = views[shares.index(min(shares))]
        e.job.safe_point()
        truth, depth = e.truth(view), e.asset.render(view.camera, normals=False).depth
        pixels, kinds, _ = sparse_points.judged(e.points, e.scene.views.index(view), view.camera, depth, counting(truth))
        write_png(sparse_points.picture(truth.colour, depth, pixels, kinds), EvaluateOutputs(e.job.out).sparse_points)
    found = verdict_on_result(metrics, read_report(cameras, CameraVerdict) if cameras.is_file() else None)
    write_json(EvaluateOutputs(e.job.out).verdict, found.document())
    e.job.say(found.summary(), grade=found.grade)
    for problem in found.problems:
        if problem.grade != "good":
            e.job.warn(problem.text())


def refinement_of(bake: BakeOutputs) -> dict[str, int]:
    """Steps that were taken, and the least that are usual for so many voxels and rays a step: a poor figure for want of steps needs no other
    remedy."""
    report = read_report(bake.report, BakeReport)
    last = json.loads(bake.log.read_text(encoding="utf-8").splitlines()[-1])
    rays = last["rays"] or BakeSettings().refine_rays_per_batch  # 0: there was no step
    return {"steps": report.optimisation.steps, "usual_steps": usual_steps(report.voxels, rays, None if report.cascades is None else 0)}
