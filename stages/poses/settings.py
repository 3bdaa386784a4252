"""How a source is read and framed."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from msgspec import Meta

from efficientnerf.settings import Auto, PositiveInt, given, setting
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

    format: Format = setting("auto", "Format of the source; auto: found out from its files.")
    max_image_size: Annotated[int, Meta(ge=32, le=16384)] = setting(
        1024, "Longest side of the images that later stages read; larger ones are reduced.", unit="pixels"
    )
    up: Literal["auto", "x", "y", "z", "-x", "-y", "-z"] = setting("auto", "Axis of the capture's frame that points up; auto: estimated.")
    crop_box: tuple[Coordinate, Coordinate, Coordinate, Coordinate, Coordinate, Coordinate] | Auto = setting(
        "auto", "Crop box in the capture's frame: x y z of one corner, then of the opposite one; auto: estimated."
    )
    box_margin: Annotated[float, Meta(ge=0.0, le=2.0)] = setting(
        0.05, "Margin on each side of an estimated crop box, as a fraction of its longest side.", advanced=True
    )
    space: Literal["auto", "box", "contracted", "ndc"] = setting(
        "auto",
        "Space of the field: the box alone, with a background without depth beyond it (box); all of an unbounded scene (contracted); or normalised device"
        " coordinates, for forward-facing captures (ndc); auto: ndc for forward-facing LLFF folders, box for objects with alpha, else contracted.",
    )
    masks: Literal["auto", "silhouette", "ignore"] = setting(
        "auto",
        "What masks and alpha channels mean: outside of them is background, and the object alone is trained, on random colours (silhouette), or pixels outside"
        " of them are left out (ignore); auto: silhouette where they keep one compact object in nearly all photographs, and for renders with alpha.",
    )
    mask_from: Annotated[
        str,
        Meta(
            pattern="^(auto|off|foreground|static|green|white|#[0-9a-fA-F]{6})$",
            description="auto, off, foreground, static, green, white or a colour as #rrggbb",
        ),
    ] = setting(
        "auto",
        "What silhouettes are made from where photographs have no masks: the subject as a first quick training of the scene finds it (foreground), a background"
        " that stands still while the object turns (static), a screen of one colour (green, white, #rrggbb), or nothing (off); auto: static where cameras found"
        " by the object alone show that it turned.",
        advanced=True,
    )
    mask_model: Annotated[str, Meta(pattern=r"^(off|/.+)$", description="off or an absolute path")] = setting(
        "off", "ONNX file of a network that tells a subject from its background (as rembg has them), by which silhouettes are made; off: none.", advanced=True
    )
    features_model: Annotated[str, Meta(pattern=r"^(off|/.+)$", description="off or an absolute path")] = setting(
        "off",
        "ONNX file of a network that detects features (ALIKED), by which photographs are matched that have no camera else; off: none.",
        advanced=True,
    )
    matcher_model: Annotated[str, Meta(pattern=r"^(off|/.+)$", description="off or an absolute path")] = setting(
        "off", "ONNX file of a network that matches these features (LightGlue); off: none.", advanced=True
    )
    mask_polarity: Literal["auto", "white", "black"] = setting(
        "auto",
        "What is kept of given masks: what is not black in them (white), or what is (black); auto: white, unless black shows one compact object in nearly all.",
        advanced=True,
    )
    test_every: Annotated[int, Meta(ge=2, le=10**6)] = setting(
        8, "Every n-th image in sorted order is a test view, where the source states no split.", advanced=True
    )
    llff_factor: PositiveInt | Auto = setting(
        "auto", "Reduction factor n of the LLFF images to use (images_n); auto: the largest images there are.", advanced=True
    )
    frames: Annotated[int, Meta(ge=3, le=10_000)] = setting(
        150, "Most frames that are chosen of videos, of all of them together: the sharpest ones that differ.", advanced=True
    )
    strict: bool = setting(False, "Refuse a source with images that are missing, unreadable or not registered, instead of warning.")
    allow_outside: bool = setting(False, "Read images that lie, or are linked to, outside the source folder.", advanced=True)
    lens: Literal["auto", "perspective", "fisheye", "equirectangular"] = setting(
        "auto",
        "What photographs and videos show: what a usual lens projects (perspective), a fisheye lens (fisheye), or 360 degrees (equirectangular), which are cut"
        " into views of pinhole cameras; auto: fisheye where EXIF names such a lens, 360 degrees where a picture is twice as wide as high and XMP says so.",
        advanced=True,
    )
    matching: Literal["auto", "exhaustive", "retrieval", "sequential"] = setting(
        "auto",
        "Which photographs are matched: all pairs (exhaustive), each with those that look most like it (retrieval), or with those that follow (sequential);"
        " auto: exhaustive for up to 60, else retrieval.",
    )
    max_features: Annotated[int, Meta(ge=256, le=65536)] | Auto = setting(
        "auto", "Most features detected in a photograph; auto: 4096, of more than 60 photographs 2048.", advanced=True
    )
    feature_image_size: Annotated[int, Meta(ge=320, le=8192)] = setting(
        1600, "Longest side of the photographs in which features are detected.", unit="pixels", advanced=True
    )
    seed: Annotated[int, Meta(ge=0, le=2**31 - 1)] = setting(0, "Seed of every random choice in finding cameras.", advanced=True)


def files(source: Path, settings: PosesSettings) -> list[Path]:
    """What the scene depends on: files of the source, and the networks that masks are made and photographs matched by."""
    networks = [Path(path) for path in (settings.mask_model, settings.features_model, settings.matcher_model) if path != "off"]
    return [*importers.files(source, settings), *networks]


def check(settings: Mapping[str, Any]) -> None:
    """UsageError where a crop box is stated that has no volume."""
    box = given(settings["poses"].crop_box)
    if box is not None and min(abs(low - high) for low, high in zip(box[:3], box[3:], strict=True)) < LEAST_SIDE:
        raise UsageError(f"poses.crop_box={list(box)}: has no volume; expected x y z of one corner, and of the opposite one.")


STAGE = Stage(
    name="poses",
    version=14,
    settings=PosesSettings,
    needs=(),
    run=ByName("stages.poses.run:run"),
    reads_source=True,
    source_files=files,
    check=check,
)
