"""The evaluate stage: PSNR, SSIM and, where asked for, LPIPS of the network and of the baked asset on the views that training never saw.

    metrics.json       network and asset: means over the views; views[]: the figures of each
    contact_sheet.png  truth, network and asset with their errors

The network is slow to draw, so that only some views are drawn with it, and of these every n-th pixel along each side, through its own centre.
Its PSNR is then an unbiased estimate of that at full size; against photographs averaged down it would be held down by their soft edges. (Its SSIM
is that of the thinned pictures.) The asset is measured on every held-back view at the full working size. On photographs the asset lies between
what the network puts before and behind its box; in-box figures leave out the pixels where the network sees less than half of the light in the
box. On a constant background, in-box figures are over the pixels that the photograph's alpha covers.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
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

if TYPE_CHECKING:
    from efficientnerf.evaluation.lpips import Lpips

FORMAT = 1
NETWORK_SIDE = 400  # pixels: the longest side of what the network draws where evaluate.field_image_scale does not say
PSNR_CAP = 100.0  # decibels: JSON has no infinity; equal images get this
SHEET_ROWS = 8
SHEET_SIDE = 320


NETWORKS = ("alex", "vgg")  # of LPIPS


@dataclass(frozen=True)
class EvaluateSettings:
    """How much is measured."""

    field_views: PositiveInt | Literal["all"] = setting(4, "Number of test views that the field is rendered for, spread evenly.", advanced=True)
    field_image_scale: Annotated[float, Meta(ge=0.01, le=1.0)] | Auto = setting(
        "auto", f"Scale of the pixel grid on which the field is rendered; auto: at most {NETWORK_SIDE} along the longest side.", advanced=True
    )
    field_background_rays: PositiveInt = setting(
        500_000, "Total number of rays through the field for the background of the asset's other views, in unbounded scenes.", advanced=True
    )
    lpips: Literal["off", "alex", "vgg", "both"] = setting("off", "Network of LPIPS, where that is measured too; its weights are files of their own.")
    lpips_weights: str = setting(
        "auto", "Folder with the weights of LPIPS; auto: torch's cache and the package torchmetrics, which are searched in any case.", advanced=True
    )


@dataclass(frozen=True, eq=False)
class Truth:
    """A photograph to compare with.

    colour  (H, W, 3) float32, on the scene's background
    mask    (H, W) bool, pixels that count, or None
    inside  (H, W) bool, pixels that show the subject, where the photograph says so, or None
    """

    colour: np.ndarray
    mask: np.ndarray | None
    inside: np.ndarray | None


@compiling_kernels
def run(job: Job) -> None:
    from efficientnerf.asset.tree import NerfTree

    inputs = inputs_of(EvaluateInputs, job.inputs)

    def load_field() -> Any:
        from stages.io.field_file import load_renderer

        return load_renderer(inputs.train.folder, job.device)

    evaluate(NerfTree.load(inputs.bake.asset).to(job.device), load_field, job)


def evaluate(tree: Any, load_field: Callable[[], Any], job: Job) -> None:
    """Measure each view once; figures and thumbnails are kept in job.work, so that a kill costs at most one view.

    tree        with the interface of a NerfTree
    load_field  gives a FieldRenderer; called only where one is needed
    """
    from stages.io.scene import load

    settings: EvaluateSettings = job.settings
    scene = load(job.inputs[PosesOutputs.stage])
    views, split = held_back(scene)
    if split == "train":
        job.warn("no view was held back from training: the figures below are of views that training saw")
    drawn = set(spread(len(views), None if settings.field_views == "all" else settings.field_views))
    longest = max(max(view.camera.width, view.camera.height) for view in views)
    scale = given(settings.field_image_scale)
    stride = max(1, math.ceil(longest / NETWORK_SIDE if scale is None else 1.0 / scale - 1e-6))
    rest = background_stride([view for k, view in enumerate(views) if k not in drawn], settings.field_background_rays)
    wanted = {"off": (), "both": NETWORKS}.get(settings.lpips, (settings.lpips,))
    perceptual = {f"lpips_{network}": load_lpips(network, given(settings.lpips_weights)) for network in wanted}
    field: Any = None
    figures = []
    for k, view in enumerate(views):
        job.safe_point()
        job.progress(k, len(views), f"view {view.name}")
        done = job.work / f"view_{k:05d}.json"
        if not done.exists():
            needs_field = k in drawn or behind_of(scene) is None
            field = field or (load_field() if needs_field else None)
            thinning = stride if k in drawn else rest
            measured, pictures = measure(tree, field, scene, view, job, drawn=k in drawn, stride=thinning, perceptual=perceptual)
            if k in drawn:
                _keep_pictures(pictures, job.work, k)
            write_json(done, measured)
        figures.append(json.loads(done.read_text(encoding="utf-8")))
    job.progress(len(views), len(views))
    metrics = summary(figures, split=split, stride=stride, background=rest if behind_of(scene) is None else None, perceptual=tuple(perceptual))
    write_json(EvaluateOutputs(job.out).metrics, metrics)
    _write_sheet(metrics, sorted(drawn), job)


def held_back(scene: Scene) -> tuple[tuple[View, ...], str]:
    """The views to report on and their split: test, else val, else train."""
    from stages.io.scene import views_of

    for split in ("test", "val", "train"):
        views = views_of(scene, split)
        if views:
            return views, split
    raise ValueError("the scene holds no views")


def spread(count: int, wanted: int | None) -> list[int]:
    """Indices of `wanted` of `count` things, evenly spread; None: all."""
    if wanted is None or wanted >= count:
        return list(range(count))
    return [int((k + 0.5) * count / wanted) for k in range(wanted)]


def background_stride(views: Sequence[View], pixels: int) -> int:
    """The thinning at which all of the views together have about so many pixels at most."""
    total = sum(view.camera.width * view.camera.height for view in views)
    return max(1, math.ceil(math.sqrt(total / pixels)))


def truth_of(folder: Path, view: View, background: tuple[float, float, float] | None) -> Truth:
    """The photograph of a view at working size."""
    from stages.io.scene import read_image, read_mask

    pixels = read_image(folder, view).astype(np.float32) / 255.0
    mask = read_mask(folder, view)
    if pixels.shape[2] == 3:
        return Truth(pixels, mask, None)
    alpha = pixels[..., 3]
    if background is None:
        covered = alpha >= 0.5
        return Truth(pixels[..., :3], covered if mask is None else mask & covered, None)
    colour = pixels[..., :3] * alpha[..., None] + (1.0 - alpha[..., None]) * np.asarray(background, np.float32)
    return Truth(colour, mask, alpha > 0)


def thinned_camera(camera: Camera, stride: int) -> Camera:
    """The camera whose pixels look through the centres of every stride-th pixel of another, beginning at the offset of `thinned`."""
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


def thinned(values: np.ndarray, stride: int) -> np.ndarray:
    """Every stride-th row and column, (H, W, ...) -> (H', W', ...); the first is the middle of its group."""
    first = (stride - 1) // 2
    return values[first::stride, first::stride]


def thickened(values: np.ndarray, stride: int, width: int, height: int) -> np.ndarray:
    """The inverse of `thinned`, bilinear between the pixels that are known; beyond the outermost they are repeated."""
    import cv2

    values = np.ascontiguousarray(values, np.float32)
    if stride == 1:
        return values
    first = (stride - 1) // 2
    x, y = np.meshgrid((np.arange(width, dtype=np.float32) - first) / stride, (np.arange(height, dtype=np.float32) - first) / stride)
    return np.asarray(cv2.remap(values, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE))


def measure(
    tree: Any, field: Any, scene: Scene, view: View, job: Job, *, drawn: bool, stride: int, perceptual: Mapping[str, Lpips] | None = None
) -> tuple[dict[str, Any], list[np.ndarray]]:
    """The figures of one view, and, where the network is drawn, its pictures: truth, network, its error, asset, its error.

    drawn       whether the network is measured; else it is asked only for the background of the asset, and not at all on a constant one
    stride      thinning of what the network draws
    perceptual  LPIPS by the names of their figures
    """
    from stages.pictures.plots import eight_bits, error_picture

    truth = truth_of(job.inputs[PosesOutputs.stage], view, scene.background)
    plain = behind_of(scene)
    figures: dict[str, Any] = {"name": view.name, "network": None}
    pictures: list[np.ndarray] = []
    rendering = None
    if drawn or plain is None:
        rendering = field.render(thinned_camera(view.camera, stride), progress=lambda *_: job.safe_point())
    if drawn and rendering is not None:
        small = Truth(thinned(truth.colour, stride), *(None if m is None else thinned(m, stride) for m in (truth.mask, truth.inside)))
        inside = small.inside if plain is not None else rendering.inside_opacity >= 0.5
        network = _clean(rendering.colour, job, f"{view.name}: the network")
        figures["network"] = {**compare(network, small, inside), "width": network.shape[1], "height": network.shape[0], **shares(rendering.counts)}
        figures["network"] |= perceived(perceptual or {}, network, small)
        pictures += [eight_bits(small.colour), eight_bits(network), error_picture(network, small.colour)]
    asset, inside = asset_picture(tree, scene, view, rendering, stride)
    asset = _clean(asset, job, f"{view.name}: the asset")
    figures["asset"] = {**compare(asset, truth, truth.inside if inside is None else inside), "width": view.camera.width, "height": view.camera.height}
    figures["asset"] |= perceived(perceptual or {}, asset, truth)
    if plain is None:
        figures["asset"]["background_scale"] = 1.0 / stride
    if figures["asset"]["psnr"] is None:
        job.warn(f"{view.name}: its mask leaves no pixel to compare; the view is left out of the means")
    return figures, [*pictures, eight_bits(asset), error_picture(asset, truth.colour)]


def perceived(perceptual: Mapping[str, Lpips], image: np.ndarray, truth: Truth) -> dict[str, float | None]:
    """LPIPS by name; None for images too small for the networks."""
    from efficientnerf.evaluation.lpips import SMALLEST

    large = min(image.shape[:2]) >= SMALLEST
    return {name: metric(image, truth.colour, truth.mask) if large else None for name, metric in perceptual.items()}


def behind_of(scene: Scene) -> tuple[float, float, float] | None:
    """The constant colour behind the asset, where all that the pictures show lies in it; None where the network knows what lies beyond."""
    from efficientnerf.model import UNSEEN

    return scene.background if scene.background is not None or scene.forward is None else (UNSEEN, UNSEEN, UNSEEN)


SHARES = ("valid_share", "pivotal_share", "fine_per_ray")


def shares(counts: Any) -> dict[str, float]:
    """Valid and pivotal samples over rays x N_c (equations 5 and 12), counted between near and far, and fine samples a ray."""
    return {"valid_share": counts.valid_share, "pivotal_share": counts.pivotal_share, "fine_per_ray": counts.fine / max(counts.rays, 1)}


def asset_picture(tree: Any, scene: Scene, view: View, rendering: Any, stride: int) -> tuple[np.ndarray, np.ndarray | None]:
    """What the asset shows of a view (H, W, 3), and which pixels lie in its box (photographs only).

    On photographs: before + (1 - before's alpha) (asset + (1 - asset's alpha) behind), with the network's before and behind.
    """
    if (plain := behind_of(scene)) is not None:
        return tree.render(view.camera, background=plain).colour, None
    seen = tree.render(view.camera)
    size = (stride, view.camera.width, view.camera.height)
    before, behind = thickened(rendering.before, *size), thickened(rendering.behind, *size)
    middle = seen.colour + (1.0 - seen.opacity[..., None]) * behind
    return before[..., :3] + (1.0 - before[..., 3:]) * middle, thickened(rendering.inside_opacity, *size) >= 0.5


def compare(image: np.ndarray, truth: Truth, inside: np.ndarray | None) -> dict[str, float | None]:
    """psnr, ssim and psnr_in_box, None where nothing can be compared (no pixel, or fewer than an SSIM window)."""
    from efficientnerf.evaluation.metrics import psnr, ssim

    used = np.ones(image.shape[:2], bool) if truth.mask is None else truth.mask
    boxed = None if inside is None else used & inside
    windows = used[5:-5, 5:-5]
    return {
        "psnr": min(PSNR_CAP, psnr(image, truth.colour, truth.mask)) if used.any() else None,
        "ssim": ssim(image, truth.colour, truth.mask) if windows.any() else None,
        "psnr_in_box": min(PSNR_CAP, psnr(image, truth.colour, boxed)) if boxed is not None and boxed.any() else None,
    }


def summary(figures: Sequence[dict[str, Any]], *, split: str, stride: int, background: int | None, perceptual: Sequence[str] = ()) -> dict[str, Any]:
    """metrics.json: the means over the views (of PSNR in decibels, as published), how they were taken, and the figures of each."""
    drawn = [view["network"] for view in figures if view["network"] is not None]
    assets = [view["asset"] for view in figures]
    same = [view["asset"] for view in figures if view["network"] is not None]
    network: dict[str, Any] = {**_means(drawn), **_means(drawn, perceptual), **_means(drawn, SHARES), "views": len(drawn), "scale": 1.0 / stride}
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


def _clean(image: np.ndarray, job: Job, what: str) -> np.ndarray:
    """Clipped to 0-1; what is not a number counts as black and is told."""
    bad = int((~np.isfinite(image)).any(axis=-1).sum())
    if bad:
        job.warn(f"{what} is not a number at {bad} pixels; they count as black")
    return np.clip(np.nan_to_num(image.astype(np.float32), nan=0.0, posinf=0.0, neginf=0.0), 0.0, 1.0)


def _keep_pictures(pictures: Sequence[np.ndarray], folder: Path, k: int) -> None:
    from stages.io.png import write_png
    from stages.pictures.plots import thumbnail_of

    for column, picture in enumerate(pictures):
        write_png(np.asarray(thumbnail_of(picture, SHEET_SIDE)), folder / f"picture_{k:05d}_{column}.png")


def _write_sheet(metrics: dict[str, Any], drawn: Sequence[int], job: Job) -> None:
    from stages.io.png import read_png
    from stages.pictures.plots import contact_sheet

    def figure(found: dict[str, Any]) -> str:
        psnr = "no PSNR" if found["psnr"] is None else f"{found['psnr']:.2f} dB"
        return psnr if found["ssim"] is None else f"{psnr}, SSIM {found['ssim']:.3f}"

    shown = [drawn[k] for k in spread(len(drawn), SHEET_ROWS)]
    rows = [[read_png(job.work / f"picture_{k:05d}_{column}.png") for column in range(5)] for k in shown]
    labels = []
    for k in shown:
        view = metrics["views"][k]
        labels.append([view["name"], f"network {figure(view['network'])}", "error of the network", f"asset {figure(view['asset'])}", "error of the asset"])
    title = f"{metrics['split']} views: network {figure(metrics['network'])}; asset {figure(metrics['asset'])}; errors are white from 0.25"
    contact_sheet(rows, labels, EvaluateOutputs(job.out).contact_sheet, thumbnail=SHEET_SIDE, title=title)


STAGE = Stage(name="evaluate", version=1, settings=EvaluateSettings, needs=needs_of(EvaluateInputs), run=run)
