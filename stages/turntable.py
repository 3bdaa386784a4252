"""The turntable stage: PNG frames, an MP4 and an EXR of the baked asset seen from all around."""

from __future__ import annotations

import shutil
from dataclasses import dataclass

from pipeline.stage import Job, Stage
from stages.artifacts import TurntableInputs, TurntableOutputs, inputs_of, needs_of
from stages.compiling import compiling_kernels
from stages.settings import setting


@dataclass(frozen=True)
class TurntableSettings:
    """What the turntable shows and how it is written."""

    frames: int = setting(60, "Number of pictures in the circle.", minimum=1, maximum=9999)
    width: int = setting(640, "Width of the pictures.", minimum=16, maximum=8192, unit="pixels")
    height: int = setting(480, "Height of the pictures.", minimum=16, maximum=8192, unit="pixels")
    fps: int = setting(30, "Frames per second of the video.", minimum=1, maximum=240)
    background: str = setting("white", "Colour behind the asset: white, black, transparent or #rrggbb. With transparent the video lies on white.")
    elevation: float | None = setting(None, "Angle above the horizon; none: as the capture's cameras stood.", minimum=-90, maximum=90, unit="degrees")
    radius: float | None = setting(None, "Distance from the centre in the capture's units; none: as the cameras stood, further if needed.", minimum=1e-9)
    fov: float | None = setting(None, "Vertical field of view; none: so that the asset fits, its middle in the middle.", minimum=1, maximum=160, unit="degrees")
    sway: float = setting(10.0, "How far the camera swings about the middle for captures taken from one side.", minimum=0, maximum=90, unit="degrees")
    supersample: int = setting(1, "Rays along each side of a pixel.", minimum=1, maximum=8)
    crf: int = setting(18, "Quality of the video: 0 is lossless, 51 the worst.", minimum=0, maximum=51)
    exr: str = setting("first", "Which frames are written as EXR (linear colour, alpha, depth, normals) too.", choices=("none", "first", "all"))


@compiling_kernels
def run(job: Job) -> None:
    from efficientnerf.asset.tree import NerfTree

    inputs = inputs_of(TurntableInputs, job.inputs)
    draw_turntable(NerfTree.load(inputs.bake.asset).to(job.device), job)


def draw_turntable(tree, job: Job) -> None:  # type: ignore[no-untyped-def]  # anything with the interface of a NerfTree
    """Frames go to job.work one by one, so that a kill costs at most one of them; the video is made of the PNGs, so that it does not depend on where."""
    from stages.framing.camera_paths import RenderOptions, draw_frames, encode_frames, turntable_cameras

    s: TurntableSettings = job.settings
    cameras = turntable_cameras(tree, frames=s.frames, width=s.width, height=s.height, elevation=s.elevation, radius=s.radius, fov=s.fov, sway=s.sway)
    options = RenderOptions(background=s.background, supersample=s.supersample, exr=s.exr, fps=s.fps, crf=s.crf)

    def each(done: int, total: int) -> None:
        job.safe_point()
        job.progress(done, total, "frames")

    written = draw_frames(tree, cameras, job.work / "frames", options, each, reuse=True)
    job.say("encoding the video")
    encode_frames([path for path in written if path.suffix == ".png"], TurntableOutputs(job.out).video, options, job.safe_point)
    for path in written:
        shutil.copyfile(path, job.out / path.name)


STAGE = Stage(name="turntable", version=2, settings=TurntableSettings, needs=needs_of(TurntableInputs), run=run)
