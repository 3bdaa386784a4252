"""What the turntable shows and how it is written."""

from dataclasses import dataclass
from typing import Annotated, Literal

from msgspec import Meta

from efficientnerf.settings import Auto, setting
from pipeline.stage import ByName, Stage


@dataclass(frozen=True)
class TurntableSettings:
    """What the turntable shows and how it is written."""

    region: Literal["foreground", "all"] = setting(
        "foreground", "What is shown: the subject and what it stands on, clipped at the edge (foreground), or the whole scene with its surroundings (all)."
    )
    path: Literal["auto", "orbit", "sway", "captured"] = setting(
        "auto",
        "Camera path: a circle (orbit), to and fro on the side that the photographs were taken from (sway), past the captured cameras (captured), or a"
        " circle where the photographs go round and else a sway (auto).",
        advanced=True,
    )
    frames: Annotated[int, Meta(ge=1, le=9999)] = setting(60, "Number of frames.")
    width: Annotated[int, Meta(ge=16, le=8192)] = setting(640, "Width of the frames.", unit="pixels")
    height: Annotated[int, Meta(ge=16, le=8192)] = setting(480, "Height of the frames.", unit="pixels")
    fps: Annotated[int, Meta(ge=1, le=240)] = setting(30, "Frames per second of the video.", advanced=True)
    background: Annotated[
        str, Meta(pattern="^(auto|white|black|transparent|#[0-9a-fA-F]{6})$", description="auto, white, black, transparent or a colour as #rrggbb")
    ] = setting(
        "auto",
        "Background: white, black, transparent or #rrggbb; the video of a transparent one is on white; auto: the environment where all of a scene is shown,"
        " else white.",
    )
    elevation: Annotated[float, Meta(ge=-90.0, le=90.0)] | Auto = setting(
        "auto", "Elevation of the camera above the horizon; auto: that of the captured cameras.", unit="degrees", advanced=True
    )
    radius: Annotated[float, Meta(ge=1e-9, le=1e9)] | Auto = setting(
        "auto", "Distance of the camera from the centre, in the capture's units; auto: that of the captured cameras, or more to fit the asset.", advanced=True
    )
    fov: Annotated[float, Meta(ge=1.0, le=160.0)] | Auto = setting(
        "auto", "Vertical field of view; auto: the asset fits, centred.", unit="degrees", advanced=True
    )
    sway: Annotated[float, Meta(ge=0.0, le=180.0)] | Auto = setting(
        "auto",
        "Amplitude of the camera's swing about the middle, for captures that do not go round; auto: nearly as far as the captured cameras, or 10.",
        unit="degrees",
        advanced=True,
    )
    supersample: Annotated[int, Meta(ge=1, le=8)] = setting(1, "Rays along each side of a pixel.", advanced=True)
    crf: Annotated[int, Meta(ge=0, le=51)] = setting(18, "Constant rate factor of the video: 0 is lossless, 51 the worst.", advanced=True)
    exr: Literal["off", "first", "all"] = setting(
        "first", "Frames that are also written as EXR, with linear colour, alpha, depth, normals and positions: none (off), the first, or all."
    )


STAGE = Stage(
    name="turntable",
    version=7,
    settings=TurntableSettings,
    needs=("bake",),
    run=ByName("stages.turntable.run:run"),
    uses_device=True,
)
