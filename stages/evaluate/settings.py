"""How much is measured."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Any, Literal

from msgspec import Meta

from efficientnerf.settings import Auto, Off, PositiveInt, resolved, setting
from pipeline.stage import ByName, Stage
from stages.evaluate.lpips_weights import find_weights

MAX_FIELD_IMAGE_SIZE = 400  # pixels: the longest side of the field's renders where evaluate.field_image_scale is not given
MAX_FIELD_RAYS = 400_000  # of all of them together, then
NETWORKS = ("alex", "vgg")  # of LPIPS


@dataclass(frozen=True)
class EvaluateSettings:
    """How much is measured."""

    field_views: PositiveInt | Literal["all"] = setting(16, "Number of test views, spread evenly, that are rendered from the field.", advanced=True)
    field_image_scale: Annotated[float, Meta(ge=0.01, le=1.0)] | Auto = setting(
        "auto",
        f"Scale of the images that are rendered from the field; auto: at most {MAX_FIELD_IMAGE_SIZE} pixels along the longest side, and about"
        f" {MAX_FIELD_RAYS} pixels in all.",
        advanced=True,
    )
    strips: Literal["on", "off"] = setting(
        "on", "Whether to show photograph, network, asset and mesh side by side at full size, for the worst, the median and the best view."
    )
    captured_path_frames: Annotated[int, Meta(ge=1, le=9999)] | Off = setting(90, "Number of frames of the video along the captured cameras; off: none.")
    lpips: Literal["off", "alex", "vgg", "both"] = setting("off", "Network of LPIPS, if that is measured too; its weights are separate files.")
    lpips_weights: str = setting(
        "auto", "Folder of the LPIPS weights; auto: torch's cache and the package torchmetrics, which are always searched.", advanced=True
    )


def networks_of(settings: EvaluateSettings) -> tuple[str, ...]:
    """Of LPIPS, those that are asked for."""
    return {"off": (), "both": NETWORKS}.get(settings.lpips, (settings.lpips,))


def check(settings: Mapping[str, Any]) -> None:
    """UsageError where weights of LPIPS are missing."""
    own: EvaluateSettings = settings["evaluate"]
    for network in networks_of(own):
        find_weights(network, resolved(own.lpips_weights))


STAGE = Stage(
    name="evaluate",
    version=15,
    settings=EvaluateSettings,
    needs=("mesh", "splats", "bake", "train", "poses"),
    run=ByName("stages.evaluate.run:run"),
    uses_device=True,
    check=check,
)
