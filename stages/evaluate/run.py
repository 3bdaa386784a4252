"""The evaluate stage: PSNR, SSIM and optionally LPIPS of the trained field, the baked asset, the mesh and the 3D Gaussians on the test views, and what parts
the first two.

    verdict.json       a grade, and for each problem its cause, what to do and the picture that shows it (stages.verdict.result)
    sparse_points.png  where the asset's depth agrees with the sparse points, of the view where it does least (stages.evaluate.sparse_points)
    metrics.json       "network" (the field), "asset", "mesh" and, where there are Gaussians, "splats": means over the views; "gap", "holes", "floaters": the
                       asset against the network; "views": the metrics of each (stages.evaluate.summary, .comparison, .mesh, .splats)
    contact_sheet.png  ground truth, field and asset, with their errors
    strip_*.png        photograph, network, asset and mesh at full size: the worst, the median and the best view
    captured_path.mp4  the asset along the captured cameras

The field is slow to render. Only some views are rendered with it, and of these every n-th pixel along each side, through the pixel's own centre: the
PSNR is an unbiased estimate of that at full size, which a comparison with downscaled photographs would not be. (SSIM is that of the subsampled
images.) The asset is measured on every test view at the full working size, and against the network on the network's pixels.

An asset with cascades is rendered by itself, surroundings and all. `asset_with_network_background` is its cascade 0 between what the field shows before and
behind that box, as was measured before there were cascades. An asset of one box in an unbounded scene has no other figure than that. In-box metrics leave out
the pixels where less than half of the field's opacity lies in the box; on a constant background they are over the pixels that the photograph's alpha covers.
"""

import math
from collections.abc import Callable, Collection, Mapping, Sequence
from functools import cache, partial
from pathlib import Path
from typing import Any

import numpy as np

from efficientnerf.asset import format
from efficientnerf.asset.tree import NerfTree
from efficientnerf.rendering.field_renderer import FieldRenderer
from efficientnerf.settings import resolved
from pipeline.files import write_json
from pipeline.stage import Job
from stages.artifacts import EvaluateInputs, EvaluateOutputs, PosesOutputs, TrainOutputs, inputs_of
from stages.compiling import compiling_kernels
from stages.evaluate.asset import EvaluatedAsset, evaluated, is_over_field
from stages.evaluate.comparison import AGAINST_NETWORK, GAP, QUALITY, SAMPLE_SHARES, evaluate_view, load_lpips
from stages.evaluate.judging import judge, refinement_of, training_figures
from stages.evaluate.memory import needed
from stages.evaluate.mesh import FIGURES, EvaluatedMesh, load_mesh
from stages.evaluate.settings import MAX_FIELD_IMAGE_SIZE, MAX_FIELD_RAYS, EvaluateSettings, networks_of
from stages.evaluate.sparse_points import COUNTS, observed_points
from stages.evaluate.splats import FIGURES as SPLATS_FIGURES
from stages.evaluate.splats import EvaluatedSplats, load_splats
from stages.evaluate.strips import strip_views, write_strips
from stages.evaluate.summary import in_words, quality, summary
from stages.evaluate.trivial import BLURS
from stages.evaluate.video import write_captured_path
from stages.evaluate.views import bounded_stride, constant_background, evaluation_views, evenly_spaced, stride_for
from stages.figures.plots import contact_sheet, thumbnail_of
from stages.io.field_file import load_renderer
from stages.io.png import read_png, write_png
from stages.io.refined_cameras import load_scene
from stages.io.scene import View
from stages.memory.need import refuse_what_does_not_fit
from stages.reports import RegionReport, read_report
from stages.scratch import note, noted, once
from stages.train.averaged import as_taken

SHEET_ROWS = 8
THUMBNAIL = 320  # pixels, longest side


Measured = str | float | dict[str, int | float | list[float] | None] | None  # the name of a view, or its metrics


@compiling_kernels
def run(job: Job) -> None:
    inputs = inputs_of(EvaluateInputs, job.inputs)

    def load_field() -> FieldRenderer:
        return load_renderer(inputs.train.folder, job.device)

    tree = format.load(inputs.bake.asset).to(job.device)
    refuse_what_does_not_fit(job, needed(tree, job.settings, inputs, job.device), "Lower poses.max_image_size or bake.max_mib.")
    region = read_report(inputs.mesh.report, RegionReport).region
    evaluate(evaluated(tree), tree, load_field, job, load_mesh(inputs.mesh, tree, region), load_splats(inputs.splats, tree), refinement_of(inputs.bake))


def evaluate(
    asset: EvaluatedAsset, tree: NerfTree, load_field: Callable[[], FieldRenderer], job: Job, mesh: EvaluatedMesh, splats: EvaluatedSplats | None = None,
    refinement: Mapping[str, int] | None = None,
) -> None:
    """Write metrics, pictures and video. Metrics and thumbnails of each view are kept in job.work, so that a kill costs at most one view.

    tree        the asset's
    load_field  returns a FieldRenderer; called only where one is needed
    mesh        made of the asset
    splats      the same
    refinement  of the asset, `refinement_of`
    """
    settings: EvaluateSettings = job.settings
    scene = load_scene(job.inputs[PosesOutputs.stage], job.inputs[TrainOutputs.stage])
    views, split = evaluation_views(scene)
    if split == "train":
        job.warn("the scene has no test or validation views; metrics are computed on training views")
    load_field, warn = cache(load_field), once(job.warn)
    drawn = evenly_spaced(len(views), None if settings.field_views == "all" else settings.field_views)
    stride = _field_stride([views[k] for k in drawn], resolved(settings.field_image_scale))
    surrounded = not is_over_field(asset, scene)
    rest = None if surrounded else stride_for([view for k, view in enumerate(views) if k not in drawn], settings.field_background_rays)
    composited = surrounded and constant_background(scene) is None
    perceptual = {f"lpips_{network}": load_lpips(network, resolved(settings.lpips_weights)) for network in networks_of(settings)}
    points = observed_points(job.inputs[PosesOutputs.stage], scene, asset.reach)
    taken = as_taken(job.inputs[TrainOutputs.stage], scene)
    figures, others = [], [name for name, known in (("splats", splats), ("sparse_points", points)) if known is not None]
    for k, view in enumerate(views):
        job.safe_point()
        job.progress(k, len(views), f"view {view.name}")
        done, with_field = job.work / f"view_{k:05d}.json", k in drawn
        check = partial(_check, job.work, k, view, with_field=with_field, composited=composited, perceptual=[*perceptual], others=others)
        measured = noted(done, dict[str, Measured], warn, check)
        if measured is None:
            field = load_field() if with_field or not surrounded else None
            measured, images = evaluate_view(
                asset, mesh, field, scene, view, job, with_field=with_field, stride=stride if with_field or rest is None else rest, perceptual=perceptual,
                splats=splats, points=points, taken=taken,
            )  # fmt: skip
            note(done, measured, _save_thumbnails(images, job.work, k) if with_field else ())
        figures.append(measured)
    job.progress(len(views), len(views))
    strips = write_strips(asset, mesh, load_field, scene, views, strip_views(figures), job, warn, taken) if settings.strips == "on" else []
    train = None if split == "train" else training_figures(asset, scene, job, taken)
    metrics = summary(figures, split=split, stride=stride, background=rest, perceptual=tuple(perceptual), strips=strips, mesh=mesh.facts,
                      splats=None if splats is None else splats.facts, refinement=refinement, train=train)  # fmt: skip
    write_json(EvaluateOutputs(job.out).metrics, metrics)
    _write_sheet(metrics, drawn, job)
    frames = resolved(settings.captured_path_frames)
    if frames is not None:
        write_captured_path(asset, tree, scene, frames, job)
    job.say(in_words(metrics))
    judge(asset, scene, views, points, metrics, job)


def _field_stride(views: Sequence[View], scale: float | None) -> int:
    """The stride of the pixels that the field renders; None: as is affordable."""
    if scale is not None:
        return bounded_stride(views, max(1, math.ceil(1.0 / scale - 1e-6)))
    longest = max(max(view.camera.width, view.camera.height) for view in views)
    return max(math.ceil(longest / MAX_FIELD_IMAGE_SIZE), stride_for(views, MAX_FIELD_RAYS))


def _check(
    folder: Path, k: int, view: View, measured: Mapping[str, Any], outputs: Collection[str], *, with_field: bool, composited: bool, perceptual: Sequence[str],
    others: Collection[str],
) -> None:
    """Raises where these are not the metrics of the k-th view as `evaluate_view` returns them, or a thumbnail is missing or can't be read.

    composited  whether there are metrics of the asset over the field's surroundings, too
    others      of "splats" and "sparse_points" those that there are
    """
    names = {*QUALITY, "width", "height", *perceptual}
    asset, network = measured["asset"], measured["network"]
    if measured["name"] != view.name or not names <= asset.keys() or with_field == (network is None):
        raise ValueError("no metrics of this view")
    if with_field and not ({*names, *SAMPLE_SHARES, "floaters"} <= network.keys() and {*GAP} <= measured["gap"].keys()):
        raise ValueError("no metrics of the field")
    flat = measured["trivial"]
    if flat is not None and (not isinstance(flat["mean_colour"], float) or [type(each) for each in flat["blurred"]] != [float] * len(BLURS)):
        raise ValueError("no figures of trivial pictures")
    if "sparse_points" in others and not all(isinstance(measured["sparse_points"][name], int) for name in COUNTS):
        raise ValueError("no comparison with sparse points")
    if not {*FIGURES} <= measured["mesh"].keys():
        raise ValueError("no metrics of the mesh")
    if "splats" in others and not {*SPLATS_FIGURES} <= measured["splats"].keys():
        raise ValueError("no metrics of the Gaussians")
    if not all(isinstance(measured[name], int | float | None) for name in AGAINST_NETWORK):
        raise ValueError("no metrics of the asset against the field")
    if with_field and composited and not {*QUALITY} <= measured["asset_with_network_background"].keys():
        raise ValueError("no metrics of the asset over the field")
    for path in _thumbnails(folder, k) if with_field else ():
        if path.name not in outputs or read_png(path).shape[2] != 3:
            raise ValueError(f"{path.name} is missing")


def _thumbnails(folder: Path, k: int) -> list[Path]:
    """The pictures of a view for the contact sheet, one a column."""
    return [folder / f"picture_{k:05d}_{column}.png" for column in range(5)]


def _save_thumbnails(images: Sequence[np.ndarray], folder: Path, k: int) -> list[Path]:
    paths = _thumbnails(folder, k)
    for path, image in zip(paths, images, strict=True):
        write_png(np.asarray(thumbnail_of(image, THUMBNAIL)), path, durable=False)
    return paths


def _write_sheet(metrics: dict[str, Any], drawn: Sequence[int], job: Job) -> None:
    shown = [drawn[k] for k in evenly_spaced(len(drawn), SHEET_ROWS)]
    rows = [[read_png(path) for path in _thumbnails(job.work, k)] for k in shown]
    labels = []
    for k in shown:
        view = metrics["views"][k]
        labels.append([view["name"], f"field {quality(view['network'])}", "error of the field", f"asset {quality(view['asset'])}", "error of the asset"])
    title = f"{metrics['split']} views: field {quality(metrics['network'])}; asset {quality(metrics['asset'])}; errors are white from 0.25"
    contact_sheet(rows, labels, EvaluateOutputs(job.out).contact_sheet, thumbnail=THUMBNAIL, title=title)
