"""The turntable stage: PNG frames, MP4 and EXR of the baked asset along an orbit."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Any, Literal

from msgspec import Meta

from efficientnerf.settings import Auto, given, setting
from pipeline.stage import Job, Stage
from stages.artifacts import TurntableInputs, TurntableOutputs, inputs_of, needs_of
from stages.compiling import compiling_kernels
from stages.scratch import Warn

if TYPE_CHECKING:
    from efficientnerf.geometry.cameras import Camera


@dataclass(frozen=True)
class TurntableSettings:
    """What the turntable shows and how it is written."""

    region: Literal["foreground", "all"] = setting(
        "foreground", "What is shown: the subject with what supports it, its edge clipped (foreground), or the whole scene with its surroundings (all)."
    )
    path: Literal["auto", "orbit", "sway", "captured"] = setting(
        "auto",
        "The camera's path: a circle (orbit), to and fro on the side that the photographs were taken from (sway), past the captured cameras (captured), or a"
        " circle where the photographs go round and else a sway (auto).",
        advanced=True,
    )
    frames: Annotated[int, Meta(ge=1, le=9999)] = setting(60, "Number of frames in the circle.")
    width: Annotated[int, Meta(ge=16, le=8192)] = setting(640, "Width of the frames.", unit="pixels")
    height: Annotated[int, Meta(ge=16, le=8192)] = setting(480, "Height of the frames.", unit="pixels")
    fps: Annotated[int, Meta(ge=1, le=240)] = setting(30, "Frames per second of the video.", advanced=True)
    background: Annotated[
        str, Meta(pattern="^(auto|white|black|transparent|#[0-9a-fA-F]{6})$", description="auto, white, black, transparent or a colour as #rrggbb")
    ] = setting(
        "auto",
        "Background: white, black, transparent or #rrggbb; the video of a transparent one lies on white; auto: the environment where all of a scene is shown,"
        " else white.",
    )
    elevation: Annotated[float, Meta(ge=-90.0, le=90.0)] | Auto = setting(
        "auto", "Angle of the camera above the horizon; auto: that of the capture's cameras.", unit="degrees", advanced=True
    )
    radius: Annotated[float, Meta(ge=1e-9, le=1e9)] | Auto = setting(
        "auto", "Distance of the camera from the centre in the capture's units; auto: that of the capture's cameras, or more to fit the asset.", advanced=True
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
        "first", "Frames that are written as EXR too, with linear colour, alpha, depth, normals and positions: none (off), the first, or all."
    )


@compiling_kernels
def run(job: Job) -> None:
    from efficientnerf.asset import format
    from stages.framing.restriction import restricted
    from stages.memory.need import refuse_what_does_not_fit
    from stages.turntable.memory import frames_needed

    s: TurntableSettings = job.settings
    whole = format.load(inputs_of(TurntableInputs, job.inputs).bake.asset)
    cameras, tree = cameras_of(whole, s, job.warn), restricted(whole, s.region).to(job.device)
    del whole
    remedy = f"Lower turntable.width ({s.width}) or turntable.height ({s.height})."
    refuse_what_does_not_fit(job, frames_needed(tree, s.width * s.height, job.device), remedy)
    render_turntable(tree, job, cameras=cameras)


def cameras_of(tree: Any, s: TurntableSettings, warn: Warn = lambda text: None) -> list[Camera]:
    """The cameras of the turntable's frames; `tree` has the interface of a NerfTree, with its region. A warning for each setting that their path has no use
    for."""
    from stages.framing.camera_paths import turntable_cameras

    return turntable_cameras(
        tree, frames=s.frames, width=s.width, height=s.height, elevation=given(s.elevation), radius=given(s.radius), fov=given(s.fov), sway=given(s.sway),
        path=s.path, surroundings=s.region == "all" and tree.region is not None,
        unused=lambda name, path: warn(f"turntable.{name}={getattr(s, name):g} has no effect: the camera's path is {path} (turntable.path={s.path})"),
    )  # fmt: skip


def render_turntable(tree: Any, job: Job, draw: Callable[..., Any] | None = None, cameras: Sequence[Camera] | None = None) -> None:
    """Write frames and video, of the tree as it is. Frames are kept in job.work, so that a kill costs at most one; the video is encoded from the PNGs."""
    from stages.figures.frames import RenderOptions, encode_frames, render_frames

    s: TurntableSettings = job.settings
    cameras = cameras_of(tree, s) if cameras is None else cameras
    options = RenderOptions(background=s.background, supersample=s.supersample, exr=s.exr, fps=s.fps, crf=s.crf)

    def each(done: int, total: int) -> None:
        job.safe_point()
        job.progress(done, total, "frames")

    written = render_frames(tree, cameras, job.work / "frames", options, each, reuse=True, draw=draw, warn=job.warn)
    job.say("encoding the video")
    encode_frames([path for path in written if path.suffix == ".png"], TurntableOutputs(job.out).video, options, job.safe_point)
    for path in written:
        shutil.copyfile(path, job.out / path.name)  # no hard link: a run that was killed here has to be resumed, and what is linked is refused


STAGE = Stage(name="turntable", version=5, settings=TurntableSettings, needs=needs_of(TurntableInputs), run=run, uses_device=True)
