"""The evaluate stage: PSNR, SSIM and optionally LPIPS of the trained field, the baked asset, the mesh and the 3D Gaussians on the test views, and what parts
the first two.

Its files are those of `stages.artifacts.EvaluateOutputs`; metrics.json is described in `stages.evaluate.summary`.

The field is slow to render. Only some views are rendered with it, and of these every n-th pixel along each side, through the pixel's own centre: the
PSNR is an unbiased estimate of that at full size, which a comparison with downscaled photographs would not be. (SSIM is that of the subsampled
images.) The asset is measured on every test view at the full working size, and against the network on the network's pixels.

An asset with cascades is rendered by itself, surroundings and all. `asset_with_network_background` is its cascade 0 between what the field shows before and
behind that box, as was measured before there were cascades. In-box metrics leave out the pixels where less than half of the field's opacity lies in the box;
on a constant background they are over the pixels that the photograph's alpha covers.
"""

import math
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import replace
from functools import cache, partial
from pathlib import Path
from typing import Any

import numpy as np

from efficientnerf.asset import format
from efficientnerf.asset.rendering import Rendering
from efficientnerf.asset.tree import NerfTree
from efficientnerf.capture.captured_path import captured_cameras
from efficientnerf.geometry.cameras import Camera
from efficientnerf.rendering.field_renderer import FieldRenderer
from efficientnerf.settings import resolved
from pipeline.files import write_json
from pipeline.stage import Job
from stages.artifacts import BakeOutputs, EvaluateOutputs, MeshOutputs, SplatsOutputs
from stages.compiling import running_kernels
from stages.evaluate.asset import EvaluatedAsset, evaluated
from stages.evaluate.comparison import Evaluation, evaluate_view, load_lpips
from stages.evaluate.judging import judge, refinement_of, training_figures
from stages.evaluate.memory import needed
from stages.evaluate.mesh import EvaluatedMesh, load_mesh
from stages.evaluate.settings import MAX_FIELD_IMAGE_SIZE, MAX_FIELD_RAYS, EvaluateSettings, networks_of
from stages.evaluate.sparse_points import observed_points
from stages.evaluate.splats import EvaluatedSplats, load_splats
from stages.evaluate.strips import strip_views, write_strips
from stages.evaluate.summary import in_words, quality, summary
from stages.evaluate.views import bounded_stride, constant_background, evaluation_views, evenly_spaced, stride_for
from stages.figures.frames import RenderOptions, encode_frames, render_frames
from stages.figures.plots import contact_sheet, thumbnail_of
from stages.io.field_file import load_renderer
from stages.io.png import FAST, read_png, write_png
from stages.io.refined_cameras import load_scene
from stages.io.scene import Scene, View
from stages.memory.need import refuse_what_does_not_fit
from stages.reports import RegionReport, read_report
from stages.scratch import note, noted, once
from stages.train.averaged import as_taken

SHEET_ROWS = 8
THUMBNAIL = 320  # pixels, longest side
VIDEO_LONGEST, VIDEO_FPS, VIDEO_CRF = 480, 15, 20  # of the captured path; pixels, the longer side
Measured = str | float | dict[str, int | float | list[float] | None] | None  # the name of a view, or its metrics


@running_kernels
def run(job: Job) -> None:
    bake, mesh, splats = BakeOutputs(job.inputs["bake"]), MeshOutputs(job.inputs["mesh"]), SplatsOutputs(job.inputs["splats"])
    tree = format.load(bake.asset).to(job.device)
    refuse_what_does_not_fit(job, needed(tree, job.settings, job.inputs, job.device), "Lower poses.max_image_size or bake.max_mib.")
    load_field = partial(load_renderer, job.inputs["train"], job.device)
    region = read_report(mesh.report, RegionReport).region
    evaluate(evaluated(tree), tree, load_field, job, load_mesh(mesh, tree, region), load_splats(splats, tree), refinement_of(bake))


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
    poses, train = job.inputs["poses"], job.inputs["train"]
    scene = load_scene(poses, train)
    views, split = evaluation_views(scene)
    if split == "train":
        job.warn("the scene has no test or validation views; metrics are computed on training views")
    load_field, warn = cache(load_field), once(job.warn)
    drawn = evenly_spaced(len(views), None if settings.field_views == "all" else settings.field_views)
    stride = _field_stride([views[k] for k in drawn], resolved(settings.field_image_scale))
    perceptual = {f"lpips_{network}": load_lpips(network, resolved(settings.lpips_weights)) for network in networks_of(settings)}
    e = Evaluation(job, scene, asset, mesh, splats, observed_points(poses, scene, asset.reach), as_taken(train, scene), perceptual)
    summarised = partial(
        summary, split=split, stride=stride, perceptual=tuple(perceptual), mesh=mesh.facts, splats=None if splats is None else splats.facts,
        refinement=refinement,
    )  # fmt: skip
    figures = []
    for k, view in enumerate(views):
        job.safe_point()
        job.progress(k, len(views), f"view {view.name}")
        done, thumbnails = job.work / f"view_{k:05d}.json", _thumbnails(job.work, k) if k in drawn else []
        check = partial(_check, summarised, thumbnails, view, with_points=e.points is not None)
        measured = noted(done, dict[str, Measured], warn, check)
        if measured is None:
            measured, images = evaluate_view(e, view, load_field() if thumbnails else None, stride)
            for path, image in zip(thumbnails, images, strict=False):  # of other views there are none
                write_png(np.asarray(thumbnail_of(image, THUMBNAIL)), path, durable=False)
            note(done, measured, thumbnails)
        figures.append(measured)
    job.progress(len(views), len(views))
    strips = write_strips(e, load_field, views, strip_views(figures), warn) if settings.strips == "on" else []
    metrics = summarised(figures, strips=strips, train=None if split == "train" else training_figures(e))
    write_json(EvaluateOutputs(job.out).metrics, metrics)
    _write_sheet(metrics, drawn, job)
    frames = resolved(settings.captured_path_frames)
    if frames is not None:
        _write_captured_path(asset, tree, scene, frames, job)
    job.say(in_words(metrics))
    judge(e, views, metrics)


def _field_stride(views: Sequence[View], scale: float | None) -> int:
    """The stride of the pixels that the field renders; None: as is affordable."""
    if scale is not None:
        return bounded_stride(views, max(1, math.ceil(1.0 / scale - 1e-6)))
    longest = max(max(view.camera.width, view.camera.height) for view in views)
    return max(math.ceil(longest / MAX_FIELD_IMAGE_SIZE), stride_for(views, MAX_FIELD_RAYS))


def _check(
    summarised: Callable[[list[Any]], object], thumbnails: Sequence[Path], view: View, measured: Mapping[str, Any], outputs: Collection[str], *,
    with_points: bool,
) -> None:
    """Raises where these are not the metrics of a view as `evaluate_view` returns them, or a thumbnail is missing or can't be read.

    thumbnails   of a view whose field is measured; else there are none
    with_points  whether the asset is compared with sparse points
    """
    if measured["name"] != view.name or (measured["network"] is None) == bool(thumbnails) or (measured["sparse_points"] is None) == with_points:
        raise ValueError("no metrics of this view")
    summarised([measured])  # it reads all figures
    for path in thumbnails:
        if path.name not in outputs or read_png(path).shape[2] != 3:
            raise ValueError(f"{path.name} is missing")


def _thumbnails(folder: Path, k: int) -> list[Path]:
    """The pictures of a view for the contact sheet, one a column."""
    return [folder / f"picture_{k:05d}_{column}.png" for column in range(5)]


def _write_sheet(metrics: dict[str, Any], drawn: Sequence[int], job: Job) -> None:
    shown = [drawn[k] for k in evenly_spaced(len(drawn), SHEET_ROWS)]
    rows = [[read_png(path) for path in _thumbnails(job.work, k)] for k in shown]
    labels = []
    for k in shown:
        view = metrics["views"][k]
        labels.append([view["name"], f"field {quality(view['network'])}", "error of the field", f"asset {quality(view['asset'])}", "error of the asset"])
    title = f"{metrics['split']} views: field {quality(metrics['network'])}; asset {quality(metrics['asset'])}; errors are white from 0.25"
    contact_sheet(rows, labels, EvaluateOutputs(job.out).contact_sheet, thumbnail=THUMBNAIL, title=title)


def _write_captured_path(asset: EvaluatedAsset, tree: NerfTree, scene: Scene, frames: int, job: Job) -> None:
    """Write the video of the asset alone, as seen along the photographs' cameras. Frames are kept in job.work, so that a kill costs at most the last few.

    tree  the asset's, whose metadata frames need
    """
    behind = constant_background(scene)

    def draw(tree: NerfTree, camera: Camera, **more: Any) -> Rendering:
        rendering: Rendering = asset.render(camera, background=behind, **more)
        return replace(rendering, opacity=np.ones_like(rendering.opacity))  # whatever is behind has been drawn

    def each(done: int, total: int) -> None:
        job.safe_point()
        job.progress(done, total, "frames of the captured path")

    cameras = captured_cameras([view.camera for view in scene.views], frames, VIDEO_LONGEST)
    options = RenderOptions(exr="off", fps=VIDEO_FPS, crf=VIDEO_CRF, compress_level=FAST)
    written = render_frames(tree, cameras, job.work / "captured", options, each, reuse=True, draw=draw, warn=job.warn)
    encode_frames(written, EvaluateOutputs(job.out).captured_path, options, job.safe_point)
