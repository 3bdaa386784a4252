"""The evaluate stage: PSNR, SSIM and optionally LPIPS of the trained field and of the baked asset on the test views.

    metrics.json       "network" (the field) and "asset": means over the views; "views": the metrics of each
    contact_sheet.png  ground truth, field and asset, with their errors

The field is slow to render. Only some views are rendered with it, and of these every n-th pixel along each side, through the pixel's own centre: the
PSNR is an unbiased estimate of that at full size, which a comparison with downscaled photographs would not be. (SSIM is that of the subsampled
images.) The asset is measured on every test view at the full working size. In unbounded scenes the asset is composited between what the field shows
before and behind its box, and in-box metrics leave out the pixels where less than half of the field's opacity lies in the box. On a constant background, in-box
metrics are over the pixels that the photograph's alpha covers.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import numpy as np
from msgspec import Meta

from efficientnerf.geometry.cameras import MODELS, Camera
from efficientnerf.settings import Auto, PositiveInt, given, setting
from pipeline.files import write_json
from pipeline.stage import Job, Stage
from stages.artifacts import EvaluateInputs, EvaluateOutputs, PosesOutputs, inputs_of, needs_of
from stages.compiling import compiling_kernels
from stages.io.scene import Scene, View
from stages.lpips_weights import load_lpips
from stages.scratch import note, noted, once

if TYPE_CHECKING:
    from efficientnerf.asset.tree import NerfTree
    from efficientnerf.evaluation.lpips import Lpips

FORMAT = 1
MAX_FIELD_IMAGE_SIZE = 400  # pixels: the longest side of the field's renders where evaluate.field_image_scale is not given
MAX_PSNR = 100.0  # decibels, of equal images: JSON has no infinity
SHEET_ROWS = 8
THUMBNAIL = 320  # pixels, longest side
NETWORKS = ("alex", "vgg")  # of LPIPS


@dataclass(frozen=True)
class EvaluateSettings:
    """How much is measured."""

    field_views: PositiveInt | Literal["all"] = setting(4, "Number of test views that the field is rendered for, spread evenly.", advanced=True)
    field_image_scale: Annotated[float, Meta(ge=0.01, le=1.0)] | Auto = setting(
        "auto", f"Scale of the pixel grid on which the field is rendered; auto: at most {MAX_FIELD_IMAGE_SIZE} along the longest side.", advanced=True
    )
    field_background_rays: PositiveInt = setting(
        500_000, "Total number of rays through the field for the background of the asset's other views, in unbounded scenes.", advanced=True
    )
    lpips: Literal["off", "alex", "vgg", "both"] = setting("off", "Network of LPIPS, where that is measured too; its weights are files of their own.")
    lpips_weights: str = setting(
        "auto", "Folder with the weights of LPIPS; auto: torch's cache and the package torchmetrics, which are searched in any case.", advanced=True
    )


Measured = str | dict[str, int | float | None] | None  # the name of a view, or its metrics
RenderTree = Callable[..., Any]  # (camera, background=...) -> Rendering


@dataclass(frozen=True, eq=False)
class GroundTruth:
    """The image that a render is compared with.

    colour  (H, W, 3) float32, on the scene's background
    mask    (H, W) bool, pixels that are compared; None: all
    inside  (H, W) bool, pixels that the image's alpha covers; None without alpha
    """

    colour: np.ndarray
    mask: np.ndarray | None
    inside: np.ndarray | None


@compiling_kernels
def run(job: Job) -> None:
    from efficientnerf.asset import format
    from efficientnerf.asset.rendering import render

    inputs = inputs_of(EvaluateInputs, job.inputs)

    def load_field() -> Any:
        from stages.io.field_file import load_renderer

        return load_renderer(inputs.train.folder, job.device)

    tree = format.load(inputs.bake.asset).to(job.device)
    _refuse_large_views(tree, inputs, job)
    evaluate(partial(render, tree), load_field, job)


def _refuse_large_views(tree: NerfTree, inputs: EvaluateInputs, job: Job) -> None:
    """UsageError where views of this size do not fit into memory."""
    from stages.io.scene import load
    from stages.memory.need import refuse_what_does_not_fit
    from stages.memory.rendering import views_needed

    cameras = [view.camera for view in evaluation_views(load(inputs.poses.folder))[0]]
    scale = given(job.settings.field_image_scale)
    most = max(camera.width * camera.height for camera in cameras)
    rays = MAX_FIELD_IMAGE_SIZE**2 if scale is None else math.ceil(scale**2 * most)
    refuse_what_does_not_fit(
        job, views_needed(tree, cameras, rays, inputs.train.field.stat().st_size, job.device), "Lower poses.max_image_size or bake.max_mib."
    )


def evaluate(render_tree: RenderTree, load_field: Callable[[], Any], job: Job) -> None:
    """Write the metrics and the contact sheet. Metrics and thumbnails of each view are kept in job.work, so that a kill costs at most one view.

    render_tree  as `efficientnerf.asset.rendering.render`, of a tree
    load_field   returns a FieldRenderer; called only where one is needed
    """
    from stages.io.scene import load

    settings: EvaluateSettings = job.settings
    scene = load(job.inputs[PosesOutputs.stage])
    views, split = evaluation_views(scene)
    if split == "train":
        job.warn("the scene has no test or validation views: the metrics are of views that training saw")
    rendered = set(evenly_spaced(len(views), None if settings.field_views == "all" else settings.field_views))
    longest = max(max(view.camera.width, view.camera.height) for view in views)
    scale = given(settings.field_image_scale)
    stride = max(1, math.ceil(longest / MAX_FIELD_IMAGE_SIZE if scale is None else 1.0 / scale - 1e-6))
    rest = background_stride([view for k, view in enumerate(views) if k not in rendered], settings.field_background_rays)
    wanted = {"off": (), "both": NETWORKS}.get(settings.lpips, (settings.lpips,))
    perceptual = {f"lpips_{network}": load_lpips(network, given(settings.lpips_weights)) for network in wanted}
    field: Any = None
    figures, warn = [], once(job.warn)
    for k, view in enumerate(views):
        job.safe_point()
        job.progress(k, len(views), f"view {view.name}")
        done = job.work / f"view_{k:05d}.json"
        check = partial(_check, job.work, k, view, with_field=k in rendered, perceptual=tuple(perceptual))
        measured = noted(done, dict[str, Measured], warn, check)
        if measured is None:
            needs_field = k in rendered or constant_background(scene) is None
            field = field or (load_field() if needs_field else None)
            measured, images = evaluate_view(
                render_tree, field, scene, view, job, with_field=k in rendered, stride=stride if k in rendered else rest, perceptual=perceptual
            )
            note(done, measured, _save_thumbnails(images, job.work, k) if k in rendered else ())
        figures.append(measured)
    job.progress(len(views), len(views))
    metrics = summary(figures, split=split, stride=stride, background=rest if constant_background(scene) is None else None, perceptual=tuple(perceptual))
    write_json(EvaluateOutputs(job.out).metrics, metrics)
    _write_sheet(metrics, sorted(rendered), job)


def _check(folder: Path, k: int, view: View, measured: Mapping[str, Any], outputs: Collection[str], *, with_field: bool, perceptual: Sequence[str]) -> None:
    """Raises where these are not the metrics of the k-th view as `evaluate_view` returns them, or a thumbnail is missing or can't be read."""
    from stages.io.png import read_png

    names = {"psnr", "ssim", "psnr_in_box", "width", "height", *perceptual}
    asset, network = measured["asset"], measured["network"]
    if measured["name"] != view.name or not names <= asset.keys() or with_field == (network is None):
        raise ValueError("no metrics of this view")
    if with_field and not {*names, *SAMPLE_SHARES} <= network.keys():
        raise ValueError("no metrics of the field")
    for path in _thumbnails(folder, k) if with_field else ():
        if path.name not in outputs or read_png(path).shape[2] != 3:
            raise ValueError(f"{path.name} is missing")


def _thumbnails(folder: Path, k: int) -> list[Path]:
    """The pictures of a view for the contact sheet, one a column."""
    return [folder / f"picture_{k:05d}_{column}.png" for column in range(5)]


def evaluation_views(scene: Scene) -> tuple[tuple[View, ...], str]:
    """The views to report on and their split: test, else val, else train. Raises ValueError where the scene has no views."""
    from stages.io.scene import views_of

    for split in ("test", "val", "train"):
        views = views_of(scene, split)
        if views:
            return views, split
    raise ValueError("the scene holds no views")


def evenly_spaced(count: int, wanted: int | None) -> list[int]:
    """`wanted` of the indices below `count`; None: all."""
    if wanted is None or wanted >= count:
        return list(range(count))
    return [int((k + 0.5) * count / wanted) for k in range(wanted)]


def background_stride(views: Sequence[View], rays: int) -> int:
    """The stride at which the views together have at most about this many rays."""
    total = sum(view.camera.width * view.camera.height for view in views)
    return max(1, math.ceil(math.sqrt(total / rays)))


def ground_truth(folder: Path, view: View, background: tuple[float, float, float] | None) -> GroundTruth:
    """The image of a view at working size.

    background  what images with alpha are composited on; None: alpha below one half masks
    """
    from stages.io.scene import read_image, read_mask

    pixels = read_image(folder, view).astype(np.float32) / 255.0
    mask = read_mask(folder, view)
    if pixels.shape[2] == 3:
        return GroundTruth(pixels, mask, None)
    alpha = pixels[..., 3]
    if background is None:
        covered = alpha >= 0.5
        return GroundTruth(pixels[..., :3], covered if mask is None else mask & covered, None)
    colour = pixels[..., :3] * alpha[..., None] + (1.0 - alpha[..., None]) * np.asarray(background, np.float32)
    return GroundTruth(colour, mask, alpha > 0)


def subsample_camera(camera: Camera, stride: int) -> Camera:
    """The camera whose pixel centres are those of the pixels that `subsample` keeps."""
    first = (stride - 1) // 2
    params = []
    for name, value in zip(MODELS[camera.model], camera.params, strict=True):
        if name in ("cx", "cy"):
            value = (value - first - 0.5) / stride + 0.5
        elif name in ("f", "fx", "fy"):
            value = value / stride
        params.append(value)
    width, height = (len(range(first, size, stride)) for size in (camera.width, camera.height))
    return replace(camera, width=width, height=height, params=tuple(params))


def subsample(values: np.ndarray, stride: int) -> np.ndarray:
    """Every stride-th row and column, beginning in the middle of the first stride; (H, W, ...) -> (H', W', ...)."""
    first = (stride - 1) // 2
    return values[first::stride, first::stride]


def upsample(values: np.ndarray, stride: int, width: int, height: int) -> np.ndarray:
    """The inverse of `subsample`: bilinear, clamped at the border; (H', W', ...) -> (height, width, ...)."""
    import cv2

    values = np.ascontiguousarray(values, np.float32)
    if stride == 1:
        return values
    first = (stride - 1) // 2
    x, y = np.meshgrid((np.arange(width, dtype=np.float32) - first) / stride, (np.arange(height, dtype=np.float32) - first) / stride)
    return np.asarray(cv2.remap(values, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE))


def evaluate_view(
    render_tree: RenderTree, field: Any, scene: Scene, view: View, job: Job, *, with_field: bool, stride: int, perceptual: Mapping[str, Lpips] | None = None
) -> tuple[dict[str, Any], list[np.ndarray]]:
    """The metrics of one view, and its images for the contact sheet: ground truth, field and its error if it is measured, asset and its error.

    with_field  whether the field is measured; else it renders the asset's background alone, and nothing where that is constant
    stride      of the pixels that the field renders
    perceptual  LPIPS networks by the name of their metric
    """
    from stages.figures.plots import error_map, to_uint8

    truth = ground_truth(job.inputs[PosesOutputs.stage], view, scene.background)
    background = constant_background(scene)
    metrics: dict[str, Any] = {"name": view.name, "network": None}
    images: list[np.ndarray] = []
    rendering = None
    if with_field or background is None:
        rendering = field.render(subsample_camera(view.camera, stride), progress=lambda *_: job.safe_point())
    if with_field and rendering is not None:
        small = GroundTruth(subsample(truth.colour, stride), *(None if m is None else subsample(m, stride) for m in (truth.mask, truth.inside)))
        inside = small.inside if background is not None else rendering.inside_opacity >= 0.5
        render = _clipped(rendering.colour, job, f"{view.name}: the field")
        metrics["network"] = {**compare(render, small, inside), "width": render.shape[1], "height": render.shape[0], **sample_shares(rendering.counts)}
        metrics["network"] |= lpips_metrics(perceptual or {}, render, small)
        images += [to_uint8(small.colour), to_uint8(render), error_map(render, small.colour)]
    asset, inside = render_asset(render_tree, scene, view, rendering, stride)
    asset = _clipped(asset, job, f"{view.name}: the asset")
    metrics["asset"] = {**compare(asset, truth, truth.inside if inside is None else inside), "width": view.camera.width, "height": view.camera.height}
    metrics["asset"] |= lpips_metrics(perceptual or {}, asset, truth)
    if background is None:
        metrics["asset"]["background_scale"] = 1.0 / stride
    if metrics["asset"]["psnr"] is None:
        job.warn(f"{view.name}: its mask leaves no pixel to compare; the view is left out of the means")
    return metrics, [*images, to_uint8(asset), error_map(asset, truth.colour)]


def lpips_metrics(perceptual: Mapping[str, Lpips], image: np.ndarray, truth: GroundTruth) -> dict[str, float | None]:
    """LPIPS by name; None for images too small for the networks."""
    from efficientnerf.evaluation.lpips import SMALLEST

    large = min(image.shape[:2]) >= SMALLEST
    return {name: metric(image, truth.colour, truth.mask) if large else None for name, metric in perceptual.items()}


def constant_background(scene: Scene) -> tuple[float, float, float] | None:
    """The colour behind the asset in bounded and forward-facing scenes; None where the field shows what lies beyond the box."""
    from efficientnerf.model import UNSEEN

    return scene.background if scene.background is not None or scene.forward is None else (UNSEEN, UNSEEN, UNSEEN)


SAMPLE_SHARES = ("valid_share", "pivotal_share", "fine_per_ray")


def sample_shares(counts: Any) -> dict[str, float]:
    """Valid and pivotal samples over rays x N_c (EfficientNeRF, equations 5 and 12), counted between near and far; fine samples a ray."""
    return {"valid_share": counts.valid_share, "pivotal_share": counts.pivotal_share, "fine_per_ray": counts.fine / max(counts.rays, 1)}


def render_asset(render_tree: RenderTree, scene: Scene, view: View, rendering: Any, stride: int) -> tuple[np.ndarray, np.ndarray | None]:
    """The asset's render of a view (H, W, 3), and which pixels lie in its box (unbounded scenes only).

    In unbounded scenes: before + (1 - before's alpha) (asset + (1 - asset's alpha) behind), where the field gives before and behind.
    """
    if (background := constant_background(scene)) is not None:
        return render_tree(view.camera, background=background).colour, None
    output = render_tree(view.camera)
    size = (stride, view.camera.width, view.camera.height)
    before, behind = upsample(rendering.before, *size), upsample(rendering.behind, *size)
    middle = output.colour + (1.0 - output.opacity[..., None]) * behind
    return before[..., :3] + (1.0 - before[..., 3:]) * middle, upsample(rendering.inside_opacity, *size) >= 0.5


def compare(image: np.ndarray, truth: GroundTruth, inside: np.ndarray | None) -> dict[str, float | None]:
    """psnr, ssim and psnr_in_box; None where no pixel, or no whole SSIM window, can be compared."""
    from efficientnerf.evaluation.metrics import psnr, ssim

    used = np.ones(image.shape[:2], bool) if truth.mask is None else truth.mask
    boxed = None if inside is None else used & inside
    windows = used[5:-5, 5:-5]
    return {
        "psnr": min(MAX_PSNR, psnr(image, truth.colour, truth.mask)) if used.any() else None,
        "ssim": ssim(image, truth.colour, truth.mask) if windows.any() else None,
        "psnr_in_box": min(MAX_PSNR, psnr(image, truth.colour, boxed)) if boxed is not None and boxed.any() else None,
    }


def summary(figures: Sequence[dict[str, Any]], *, split: str, stride: int, background: int | None, perceptual: Sequence[str] = ()) -> dict[str, Any]:
    """The document of metrics.json: means over the views (of PSNR in decibels, as published), how they were taken, and the metrics of each view."""
    drawn = [view["network"] for view in figures if view["network"] is not None]
    assets = [view["asset"] for view in figures]
    same = [view["asset"] for view in figures if view["network"] is not None]
    network: dict[str, Any] = {**_means(drawn), **_means(drawn, perceptual), **_means(drawn, SAMPLE_SHARES), "views": len(drawn), "scale": 1.0 / stride}
    asset: dict[str, Any] = {**_means(assets), **_means(assets, perceptual), "views": len(assets), "scale": 1.0, "on_network_views": _means(same)}
    if background is not None:
        asset["background_scale"] = {"network_views": 1.0 / stride, "other_views": 1.0 / background}
    return {"format": FORMAT, "split": split, "network": network, "asset": asset, "views": list(figures)}


def _means(figures: Sequence[dict[str, Any]], names: Sequence[str] = ("psnr", "ssim", "psnr_in_box")) -> dict[str, float | None]:
    means: dict[str, float | None] = {}
    for name in names:
        values = [view[name] for view in figures if view[name] is not None]
        means[name] = math.fsum(values) / len(values) if values else None
    return means


def _clipped(image: np.ndarray, job: Job, what: str) -> np.ndarray:
    """Clipped to 0-1; pixels that are not finite count as black, with a warning."""
    bad = int((~np.isfinite(image)).any(axis=-1).sum())
    if bad:
        job.warn(f"{what} is not finite at {bad} pixels; they count as black")
    return np.clip(np.nan_to_num(image.astype(np.float32), nan=0.0, posinf=0.0, neginf=0.0), 0.0, 1.0)


def _save_thumbnails(images: Sequence[np.ndarray], folder: Path, k: int) -> list[Path]:
    from stages.figures.plots import thumbnail_of
    from stages.io.png import write_png

    paths = _thumbnails(folder, k)
    for path, image in zip(paths, images, strict=True):
        write_png(np.asarray(thumbnail_of(image, THUMBNAIL)), path, durable=False)
    return paths


def _write_sheet(metrics: dict[str, Any], drawn: Sequence[int], job: Job) -> None:
    from stages.figures.plots import contact_sheet
    from stages.io.png import read_png

    def figure(found: dict[str, Any]) -> str:
        psnr = "no PSNR" if found["psnr"] is None else f"{found['psnr']:.2f} dB"
        return psnr if found["ssim"] is None else f"{psnr}, SSIM {found['ssim']:.3f}"

    shown = [drawn[k] for k in evenly_spaced(len(drawn), SHEET_ROWS)]
    rows = [[read_png(path) for path in _thumbnails(job.work, k)] for k in shown]
    labels = []
    for k in shown:
        view = metrics["views"][k]
        labels.append([view["name"], f"field {figure(view['network'])}", "error of the field", f"asset {figure(view['asset'])}", "error of the asset"])
    title = f"{metrics['split']} views: field {figure(metrics['network'])}; asset {figure(metrics['asset'])}; errors are white from 0.25"
    contact_sheet(rows, labels, EvaluateOutputs(job.out).contact_sheet, thumbnail=THUMBNAIL, title=title)


STAGE = Stage(name="evaluate", version=1, settings=EvaluateSettings, needs=needs_of(EvaluateInputs), run=run)
