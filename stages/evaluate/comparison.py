"""One view, measured: network and asset against the photograph, and the asset against the network.

gap       asset minus network on the pixels that the network was rendered at: PSNR, SSIM, PSNR with fitted colours
holes     share of those pixels where the asset's opacity is below HOLE and the network's above SOLID. Where the asset has cascades, the network's is that of
          what lies before the end of the last one: what is beyond has its place in the environment map
floaters  opacity of the asset nearer than the network's surfaces, less a margin (`efficientnerf.evaluation.surfaces`), over its total opacity: means over at
          most FLOATER_RAYS pixels. The network's own figure, the same of itself, says how much of that is soft edges
holes_excess_error, floaters_excess_error  the asset's squared error less the network's, of those pixels and weighed by that opacity, over what `holes` and
          `floaters` are shares of. Where it is not above 0, the photograph sides with the asset: it is the network's surface that is wrong there

Where training learned exposure, vignetting and response, renders are compared as the camera would show them. The exposure of a held-back photograph is not
learned but predicted by those of its neighbours (`efficientnerf.training.exposure.held_out`): psnr_colour_fitted is the PSNR after the affine change of the
render's colours, twelve numbers a view, that fits the photograph best (`metrics.colour_fitted`).
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from efficientnerf.asset.rendering import Rendering
from efficientnerf.evaluation.lpips import SMALLEST, Lpips
from efficientnerf.evaluation.metrics import colour_fitted
from efficientnerf.geometry.cameras import Camera, rays
from efficientnerf.rendering.field_renderer import FieldRenderer
from pipeline.errors import BadInput
from pipeline.stage import Job
from stages.evaluate.asset import EvaluatedAsset, over_field
from stages.evaluate.lpips_weights import find_weights
from stages.evaluate.mesh import EvaluatedMesh, mesh_image, mesh_metrics
from stages.evaluate.sparse_points import ReliablePoints, counts_of, judged
from stages.evaluate.splats import EvaluatedSplats
from stages.evaluate.trivial import blurred_psnrs, detail, mean_colour_psnr
from stages.evaluate.views import GroundTruth, constant_background, ground_truth, subsample, subsample_camera, upsample
from stages.figures.plots import error_map, to_uint8
from stages.io.scene import Scene, View
from stages.train.averaged import Taken

HOLE, SOLID = 0.5, 0.95
FLOATER_RAYS = 4096
QUALITY = ("psnr", "ssim", "psnr_in_box", "psnr_colour_fitted")
GAP = ("psnr", "ssim", "psnr_colour_fitted")
AGAINST_NETWORK = ("holes", "floaters", "holes_excess_error", "floaters_excess_error")
SAMPLE_SHARES = ("valid_share", "pivotal_share", "fine_per_ray")


@dataclass(frozen=True, eq=False)
class Evaluation:
    """What is measured on the views of a scene."""

    job: Job
    scene: Scene
    asset: EvaluatedAsset
    mesh: EvaluatedMesh
    splats: EvaluatedSplats | None  # None: the run has none of the whole scene
    points: ReliablePoints | None  # that the asset's depth is compared with; None: there are none
    taken: Taken | None  # `stages.train.averaged.as_taken`
    perceptual: Mapping[str, Lpips]  # LPIPS networks by the name of their metric

    @property
    def background(self) -> tuple[float, float, float] | None:
        """Constant, behind the asset; None: it has its own surroundings."""
        return constant_background(self.scene)

    def truth(self, view: View) -> GroundTruth:
        """The photograph."""
        return ground_truth(self.job.inputs["poses"], view, self.scene.background)

    def rendering(self, view: View) -> Rendering:
        """The asset as the view's camera sees it, without normals."""
        found: Rendering = self.asset.render(view.camera, background=self.background, normals=False)
        return found

    def shown(self, view: View, image: np.ndarray, what: str, stride: int = 1) -> np.ndarray:
        """A render of every stride-th pixel of a view as it is compared: clipped to 0-1, and as the view's camera shows it. Pixels that are not finite count
        as black, with a warning."""
        bad = int((~np.isfinite(image)).any(axis=-1).sum())
        if bad:
            self.job.warn(f"{view.name}: {what} is not finite at {bad} pixels, which count as black")
        image = np.clip(np.nan_to_num(image.astype(np.float32), nan=0.0, posinf=0.0, neginf=0.0), 0.0, 1.0)
        return image if self.taken is None else self.taken(view, image, stride)


def evaluate_view(e: Evaluation, view: View, field: FieldRenderer | None, stride: int) -> tuple[dict[str, Any], list[np.ndarray]]:
    """The metrics of one view, and its images for the contact sheet: ground truth, field and its error if it is measured, asset and its error.

    field   None: it is not measured on this view
    stride  of the pixels that it renders
    """
    truth, asset, seen = e.truth(view), e.asset, None
    metrics: dict[str, Any] = {"name": view.name, "network": None, "asset_with_network_background": None, "gap": None, **dict.fromkeys(AGAINST_NETWORK)}
    images: list[np.ndarray] = []
    small_camera = subsample_camera(view.camera, stride)
    if field is not None:
        seen = field.render(small_camera, progress=lambda *_: e.job.safe_point(), box=asset.box, reach=asset.reach, limits=asset.limits)
    output = e.rendering(view)
    image = e.shown(view, output.colour, "the asset")
    metrics |= {"trivial": trivial(truth), "sparse_points": None}
    if e.points is not None:
        _, kinds, subject = judged(e.points, e.scene.views.index(view), view.camera, output.depth, counting(truth))
        metrics["sparse_points"] = counts_of(kinds, subject)
    size = {"width": view.camera.width, "height": view.camera.height}
    inside = truth.inside if seen is None or asset.inner is None else upsample(seen.inside_opacity, stride, **size) >= 0.5
    metrics["asset"] = {**compare(image, truth, inside), **size, **lpips_metrics(e.perceptual, image, truth), "psnr_detail": detail_psnr(image, truth)}
    drawn, plain, covered, depth = mesh_image(e.mesh, view.camera, e.background)
    metrics["mesh"] = mesh_metrics(e.shown(view, drawn, "the mesh"), e.shown(view, plain, "the mesh"), covered, depth, image, truth, view.camera)
    if e.splats is not None:
        drawn = e.shown(view, e.splats.draw(view.camera, e.background), "the Gaussians")
        metrics["splats"] = {"psnr": truth.psnr(drawn), "ssim": truth.ssim(drawn)}
    if seen is not None:
        small = truth.subsampled(stride)
        render = e.shown(view, seen.colour, "the field", stride)
        inside = small.inside if asset.inner is None else seen.inside_opacity >= 0.5
        network = {**compare(render, small, inside), "width": render.shape[1], "height": render.shape[0]}
        # Valid and pivotal samples over rays x N_c (EfficientNeRF, equations 5 and 12), counted between near and far; fine samples a ray.
        counts = seen.counts
        network |= {"valid_share": counts.valid_share, "pivotal_share": counts.pivotal_share, "fine_per_ray": counts.fine / max(counts.rays, 1)}
        metrics["network"] = network | lpips_metrics(e.perceptual, render, small)
        same_image, same_opacity = subsample(image, stride), subsample(output.opacity, stride)
        metrics |= differences(asset, small_camera, same_image, same_opacity, replace(seen, colour=render), small, metrics["network"])
        if asset.inner is not None:
            other = e.shown(view, over_field(asset.inner, view, seen, stride), "the asset over the field")
            metrics["asset_with_network_background"] = {**compare(other, truth, upsample(seen.inside_opacity, stride, **size) >= 0.5), **size}
        images += [to_uint8(small.colour), to_uint8(render), error_map(render, small.colour)]
    if metrics["asset"]["psnr"] is None:
        e.job.warn(f"{view.name}: its mask leaves no pixel to compare; the view is not part of the means")
    return metrics, [*images, to_uint8(image), error_map(image, truth.colour)]


def differences(
    asset: EvaluatedAsset, camera: Camera, image: np.ndarray, opacity: np.ndarray, seen: Any, truth: GroundTruth, network: dict[str, Any]
) -> dict[str, Any]:
    """gap and AGAINST_NETWORK of a view, and the network's own floaters, which go to its metrics.

    camera          whose pixels are those of all images here
    image, opacity  of the asset
    seen            the field's rendering
    network         its metrics
    """
    own = compare(image, truth, None)
    gap = {name: own[name] - network[name] if own[name] is not None and network[name] is not None else None for name in GAP}
    used = truth.used
    excess = squared_error(image, truth) - squared_error(seen.colour, truth)
    open_ = (opacity < HOLE) & (seen.within > SOLID)
    holes, of_holes = (float(open_[used].mean()), float((open_ * excess)[used].mean())) if used.any() else (None, None)
    floaters, of_floaters, network["floaters"] = floating(asset, camera, opacity, seen, used, excess)
    return {"gap": gap, "holes": holes, "floaters": floaters, "holes_excess_error": of_holes, "floaters_excess_error": of_floaters}


def trivial(truth: GroundTruth) -> dict[str, Any] | None:
    """The scores of pictures of its mean colour and of its blurs, and those of blurs of its detail; None where no pixel counts."""
    if not truth.used.any():
        return None
    blurred, of_detail = (blurred_psnrs(picture, truth.mask) for picture in (truth.colour, detail(truth.colour, truth.mask)))
    return {"mean_colour": mean_colour_psnr(truth.colour, truth.mask), "blurred": blurred, "blurred_detail": of_detail}


def detail_psnr(image: np.ndarray, truth: GroundTruth) -> float | None:
    """PSNR of a render's detail against the photograph's, colours fitted; None where no pixel counts."""
    if not truth.used.any():
        return None
    fitted = colour_fitted(image, truth.colour, truth.mask)
    return replace(truth, colour=detail(truth.colour, truth.mask)).psnr(detail(fitted, truth.mask))


def counting(truth: GroundTruth) -> np.ndarray:
    """(H, W) bool: pixels of the photograph in which there is something to be hit."""
    return truth.used if truth.inside is None else truth.used & truth.inside


def squared_error(image: np.ndarray, truth: GroundTruth) -> np.ndarray:
    """(H, W) mean over the channels; of pixels without a finite value 0."""
    return np.nan_to_num(np.square(np.clip(np.asarray(image, np.float64), 0, 1) - truth.colour).mean(axis=-1))


def floating(
    asset: EvaluatedAsset, camera: Camera, opacity: np.ndarray, seen: Any, used: np.ndarray, excess: np.ndarray
) -> tuple[float | None, float | None, float | None]:
    """The share of the asset's opacity that lies away from the network's surfaces, its excess error, and the share of the network's own; None where nothing is
    opaque.

    used    (H, W) bool, pixels that count
    excess  (H, W) the asset's squared error less the network's
    """
    step = 1
    while len(range(0, camera.height, step)) * len(range(0, camera.width, step)) > FLOATER_RAYS:
        step += 1
    chosen = np.zeros(used.shape, bool)
    chosen[step // 2 :: step, step // 2 :: step] = True
    y, x = np.nonzero(chosen & used)
    if not len(y):
        return None, None, None
    origins, directions = rays(camera, np.stack([x, y], axis=-1) + 0.5)
    distance = seen.depth[y, x] / np.maximum(directions @ camera.forward, 1e-3)
    nearer = asset.nearer(origins, directions, asset.limits(origins, directions, distance))
    opaque = opacity[y, x]
    return _share(nearer, opaque), _share(nearer * excess[y, x], opaque), _share(seen.nearer[y, x], seen.opacity[y, x])


def _share(part: np.ndarray, whole: np.ndarray) -> float | None:
    total = float(np.nan_to_num(whole).sum())
    return min(1.0, float(np.nan_to_num(part).sum()) / total) if total > 1e-6 * len(whole) else None


def lpips_metrics(perceptual: Mapping[str, Lpips], image: np.ndarray, truth: GroundTruth) -> dict[str, float | None]:
    """LPIPS by name; None for images too small for the networks."""
    large = min(image.shape[:2]) >= SMALLEST
    return {name: metric(image, truth.colour, truth.mask) if large else None for name, metric in perceptual.items()}


def compare(image: np.ndarray, truth: GroundTruth, inside: np.ndarray | None) -> dict[str, float | None]:
    """The figures of QUALITY; None where no pixel, or no whole SSIM window, can be compared."""
    return {
        "psnr": truth.psnr(image),
        "ssim": truth.ssim(image),
        "psnr_in_box": None if inside is None else truth.psnr(image, inside),
        "psnr_colour_fitted": truth.psnr(colour_fitted(image, truth.colour, truth.mask)) if truth.used.any() else None,
    }


def load_lpips(network: str, folder: str | None) -> Lpips:
    """The metric by "alex" or "vgg"; see `find_weights`. Raises UsageError where weights are missing."""
    backbone, heads = find_weights(network, folder)
    try:
        return Lpips(network, _state(backbone), _state(heads))
    except ValueError as error:
        raise BadInput(f"LPIPS, {backbone.name} with {heads}: {error}. Get the files again.") from None


def _state(path: Path) -> dict[str, Any]:
    """Tensors of a file of torch's, read without executing anything in it."""
    try:
        state = torch.load(path, map_location="cpu", weights_only=True)
    except Exception as error:  # torch.load does not document what it raises for a damaged file
        raise BadInput(f"{path}: not a readable file of weights ({str(error).splitlines()[0][:80] if str(error) else type(error).__name__}).") from None
    if not isinstance(state, dict):
        raise BadInput(f"{path}: holds {type(state).__name__}; expected named tensors.")
    return state
