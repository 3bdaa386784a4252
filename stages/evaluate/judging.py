"""The verdict of the evaluate stage: its inputs besides the held-out views, its file and picture, and its message."""

import json
import math
import statistics
from collections.abc import Mapping, Sequence
from typing import Any

from pipeline.files import write_json
from pipeline.stage import Job
from stages.artifacts import BakeOutputs, EvaluateOutputs, PosesOutputs
from stages.bake.refine.refinement import usual_steps
from stages.bake.settings import BakeSettings
from stages.evaluate import sparse_points
from stages.evaluate.asset import EvaluatedAsset, is_over_field, render_asset
from stages.evaluate.comparison import as_shown, compare, counting, trivial
from stages.evaluate.sparse_points import ReliablePoints
from stages.evaluate.summary import means
from stages.evaluate.trivial import equivalent_blur
from stages.evaluate.views import evenly_spaced, ground_truth
from stages.io.png import write_png
from stages.io.scene import Scene, View, views_of
from stages.reports import BakeReport, CameraVerdict, read_report
from stages.train.averaged import Taken
from stages.verdict.result import ResultVerdict, verdict_on_result

TRAINING_VIEWS = 4  # that the asset is compared with, evenly spaced: enough to tell an overfit asset


def training_figures(asset: EvaluatedAsset, scene: Scene, job: Job, taken: Taken | None = None) -> dict[str, Any] | None:
    """The asset on some views that training saw: means of PSNR, SSIM and PSNR with fitted colours, and the median of `equivalent_blur`. None where it does not
    show by itself all that a photograph shows, and where there are no such views.

    taken  `stages.train.averaged.as_taken`
    """
    views = views_of(scene, "train")
    if is_over_field(asset, scene):
        return None
    figures, blurs = [], []
    for k in evenly_spaced(len(views), TRAINING_VIEWS):
        job.safe_point()
        truth = ground_truth(job.inputs[PosesOutputs.stage], views[k], scene.background)
        flat = trivial(truth)
        if flat is None:
            continue
        image = as_shown(job, views[k], taken, render_asset(asset, scene, views[k], None, 1)[0], "the asset")
        found = compare(image, truth, None)
        figures.append(found)
        blurs.append(equivalent_blur(found["psnr_colour_fitted"] or -math.inf, flat["blurred"]))
    names = ("psnr", "ssim", "psnr_colour_fitted")
    return {**means(figures, names), "blur": statistics.median(blurs), "views": len(figures)} if figures else None


def judge(asset: EvaluatedAsset, scene: Scene, views: Sequence[View], points: ReliablePoints | None, metrics: Mapping[str, Any], job: Job) -> ResultVerdict:
    """Write the verdict on a result and the picture of its sparse points; report it, with a warning for each problem."""
    outputs, cameras = EvaluateOutputs(job.out), PosesOutputs(job.inputs[PosesOutputs.stage]).verdict
    if points is not None:
        _draw(asset, scene, views, points, metrics, job)
    found = verdict_on_result(metrics, read_report(cameras, CameraVerdict) if cameras.is_file() else None)
    write_json(outputs.verdict, found.document())
    job.say(found.summary(), grade=found.grade)
    for problem in found.problems:
        if problem.grade != "good":
            job.warn(problem.text())
    return found


def _draw(asset: EvaluatedAsset, scene: Scene, views: Sequence[View], points: ReliablePoints, metrics: Mapping[str, Any], job: Job) -> None:
    """Of the view whose points agree least with the asset's depth."""
    counts = [found["sparse_points"] for found in metrics["views"]]
    shares = [1.0 if not found["points"] else 1 - (found["nearer"] + found["farther"]) / found["points"] for found in counts]
    view = views[shares.index(min(shares))]
    job.safe_point()
    truth = ground_truth(job.inputs[PosesOutputs.stage], view, scene.background)
    depth = asset.render(view.camera, normals=False).depth
    pixels, kinds, _ = sparse_points.judged(points, scene.views.index(view), view.camera, depth, counting(truth))
    write_png(sparse_points.picture(truth.colour, depth, pixels, kinds), EvaluateOutputs(job.out).sparse_points)


def refinement_of(bake: BakeOutputs) -> dict[str, int]:
    """Steps that were taken, and the least that are usual for so many voxels and rays a step: a poor figure for want of steps needs no other
    remedy."""
    report = read_report(bake.report, BakeReport)
    last = json.loads(bake.log.read_text(encoding="utf-8").splitlines()[-1])
    rays = last["rays"] or BakeSettings().refine_rays_per_batch  # 0: there was no step
    return {"steps": report.optimisation.steps, "usual_steps": usual_steps(report.voxels, rays, None if report.cascades is None else 0)}
