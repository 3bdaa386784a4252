"""How a source is read and framed."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from msgspec import Meta

from efficientnerf.settings import Auto, Off, PositiveInt, resolved, setting
from pipeline.errors import UsageError
from pipeline.stage import ByName, Stage
from stages.formats import importers

if TYPE_CHECKING:  # mypy takes no Literal of a tuple that is computed
    Format = str
else:
    Format = Literal[importers.FORMATS]  # the names of the table of importers

Coordinate = Annotated[float, Meta(ge=-1e9, le=1e9)]
LEAST_SIDE = 1e-9  # of a crop box, in the capture's units


@dataclass(frozen=True)
class PosesSettings:
    """How a source is read and framed."""

    format: Format = setting("auto", "Format of the source; auto: detected from its files.")
    max_image_size: Annotated[int, Meta(ge=32, le=16384)] = setting(
        1024, "Longest side of the images that later stages read; larger images are downscaled.", unit="pixels"
    )
    up: Literal["auto", "x", "y", "z", "-x", "-y", "-z"] = setting("auto", "Up axis of the capture's frame; auto: estimated.")
    crop_box: tuple[Coordinate, Coordinate, Coordinate, Coordinate, Coordinate, Coordinate] | Auto = setting(
        "auto", "Crop box in the capture's frame: x y z of one corner, then of the opposite corner; auto: estimated."
    )
    box_margin: Annotated[float, Meta(ge=0.0, le=2.0)] = setting(
        0.05, "Margin on each side of an estimated crop box, as a fraction of its longest side.", advanced=True
    )
    space: Literal["auto", "box", "contracted", "ndc"] = setting(
        "auto",
        "Space of the field: a box, with a background without depth around it (box), an unbounded scene (contracted), or normalised device coordinates for"
        " forward-facing captures (ndc); auto: box for objects with alpha, ndc for forward-facing captures by cameras close to each other, else contracted.",
    )
    masks: Literal["auto", "silhouette", "ignore"] = setting(
        "auto",
        "What masks and alpha channels mean: pixels outside are background, and only the object is trained, on random colours (silhouette), or pixels"
        " outside are not used (ignore); auto: silhouette for renders with alpha, and where masks keep one compact object in nearly all photographs.",
    )
    mask_from: Annotated[
        str,
        Meta(
            pattern="^(auto|off|foreground|static|green|white|#[0-9a-fA-F]{6})$",
            description="auto, off, foreground, static, green, white or a colour as #rrggbb",
        ),
    ] = setting(
        "auto",
        "How silhouettes are made where photographs have no masks: the subject is found by a short first training (foreground), the background stands still"
        " while the object turns (static), the background has one colour (green, white, #rrggbb), or not at all (off); auto: static where cameras found from"
        " the object alone show that it turned, white where a white backdrop holds no feature.",
        advanced=True,
    )
    mask_model: Annotated[str, Meta(pattern=r"^(off|/.+)$", description="off or an absolute path")] = setting(
        "off", "ONNX file of a network that segments the subject (as rembg uses them), to make silhouettes; off: none.", advanced=True
    )
    features_model: Annotated[str, Meta(pattern=r"^(off|/.+)$", description="off or an absolute path")] = setting(
        "off", "ONNX file of a network that detects features (ALIKED), for photographs that get no camera otherwise; off: none.", advanced=True
    )
    matcher_model: Annotated[str, Meta(pattern=r"^(off|/.+)$", description="off or an absolute path")] = setting(
        "off", "ONNX file of a network that matches these features (LightGlue); off: none.", advanced=True
    )
    mask_polarity: Literal["auto", "white", "black"] = setting(
        "auto",
        "Which pixels masks keep: those that are not black (white), or those that are (black); auto: white, unless black shows one compact object in nearly"
        " all masks.",
        advanced=True,
    )
    test_every: Annotated[int, Meta(ge=2, le=10**6)] = setting(
        8,
        "Every n-th image in sorted order is a test view, unless the source has a split; of fewer than twice n the middle ones are.",
        advanced=True,
    )
    llff_factor: PositiveInt | Auto = setting("auto", "Downscale factor n of the LLFF images (images_n); auto: the largest images available.", advanced=True)
    frames: Annotated[int, Meta(ge=3, le=10_000)] = setting(
        150, "Maximum number of frames from all videos together; the sharpest ones that differ are chosen.", advanced=True
    )
    strict: bool = setting(False, "Refuse a source with missing, unreadable or unregistered images, instead of warning.")
    allow_outside: bool = setting(False, "Read images that lie, or are linked to, outside the source folder.", advanced=True)
    lens: Literal["auto", "perspective", "fisheye", "equirectangular"] = setting(
        "auto",
        "Lens of photographs and videos: an ordinary lens (perspective), a fisheye lens (fisheye), or 360 degrees (equirectangular), which is cut into"
        " pinhole views; auto: fisheye where EXIF names such a lens, 360 degrees where an image is twice as wide as high and XMP says so.",
        advanced=True,
    )
    matching: Literal["auto", "exhaustive", "retrieval", "sequential"] = setting(
        "auto",
        "Which photographs are matched: all pairs (exhaustive), each with the most similar ones (retrieval), or each with the ones that follow (sequential);"
        " auto: exhaustive for up to 60 photographs, else retrieval.",
    )
    max_features: Annotated[int, Meta(ge=256, le=65536)] | Auto = setting(
        "auto", "Maximum number of features per photograph; auto: 4096, or 2048 for more than 60 photographs.", advanced=True
    )
    feature_image_size: Annotated[int, Meta(ge=320, le=8192)] = setting(
        1600, "Longest side of the images in which features are detected.", unit="pixels", advanced=True
    )
    marker_size: Annotated[float, Meta(ge=1e-3, le=100.0)] | Off = setting(
        "off",
        "Length of the black edges of ArUco or AprilTag markers in the scene, which gives lengths in metres; off: none are looked for.",
        unit="metres",
        advanced=True,
    )
    seed: Annotated[int, Meta(ge=0, le=2**31 - 1)] = setting(0, "Seed of all random choices in finding cameras.", advanced=True)


def files(source: Path, settings: PosesSettings) -> list[Path]:
    """What the scene depends on: files of the source, and the networks that masks are made and photographs matched by."""
    networks = [Path(path) for path in (settings.mask_model, settings.features_model, settings.matcher_model) if path != "off"]
    return [*importers.files(source, settings), *networks]


def check(settings: Mapping[str, Any]) -> None:
    """UsageError where a crop box is stated that has no volume."""
    box = resolved(settings["poses"].crop_box)
    if box is not None and min(abs(low - high) for low, high in zip(box[:3], box[3:], strict=True)) < LEAST_SIDE:
        raise UsageError(f"poses.crop_box={list(box)}: has no volume; expected x y z of one corner, and of the opposite one.")


STAGE = Stage(
    name="poses",
    version=25,
    settings=PosesSettings,
    needs=(),
    run=ByName("stages.poses.run:run"),
    reads_source=True,
    source_files=files,
    check=check,
)
