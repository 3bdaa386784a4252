"""The turntable stage: PNG frames, MP4 and EXR of the baked asset along an orbit."""

import shutil
from collections.abc import Sequence

from efficientnerf.asset import format
from efficientnerf.asset.camera_paths import turntable_cameras
from efficientnerf.asset.tree import NerfTree
from efficientnerf.geometry.cameras import Camera
from efficientnerf.settings import resolved
from pipeline.stage import Job
from stages.artifacts import BakeOutputs, TurntableOutputs
from stages.compiling import running_kernels
from stages.figures.frames import RenderOptions, encode_frames, render_frames
from stages.framing.restriction import restricted
from stages.memory.need import refuse_what_does_not_fit
from stages.scratch import Warn
from stages.turntable.memory import frames_needed
from stages.turntable.settings import TurntableSettings


@running_kernels
def run(job: Job) -> None:
    s: TurntableSettings = job.settings
    whole = format.load(BakeOutputs(job.inputs["bake"]).asset)
    cameras, tree = cameras_of(whole, s, job.warn), restricted(whole, s.region).to(job.device)
    del whole
    remedy = f"Lower turntable.width ({s.width}) or turntable.height ({s.height})."
    refuse_what_does_not_fit(job, frames_needed(tree, s.width * s.height, job.device), remedy)
    render_turntable(tree, job, cameras)


def cameras_of(tree: NerfTree, s: TurntableSettings, warn: Warn = lambda text: None) -> list[Camera]:
    """The cameras of the turntable's frames; `tree` has the interface of a NerfTree, with its region. A warning for each setting that their path has no use
    for."""
    return turntable_cameras(
        tree, frames=s.frames, width=s.width, height=s.height, elevation=resolved(s.elevation), radius=resolved(s.radius), fov=resolved(s.fov),
        sway=resolved(s.sway),
        path=s.path, surroundings=s.region == "all" and tree.region is not None,
        unused=lambda name, path: warn(f"turntable.{name}={getattr(s, name):g} has no effect: the camera path is {path} (turntable.path={s.path})"),
    )  # fmt: skip


def render_turntable(tree: NerfTree, job: Job, cameras: Sequence[Camera]) -> None:
    """Write frames and video, of the tree as it is. Frames are kept in job.work, so that a kill costs the last few at most; the video is made of the PNGs."""
    s: TurntableSettings = job.settings
    options = RenderOptions(background=s.background, supersample=s.supersample, exr=s.exr, fps=s.fps, crf=s.crf)

    def each(done: int, total: int) -> None:
        job.safe_point()
        job.progress(done, total, "frames")

    written = render_frames(tree, cameras, job.work / "frames", options, each, reuse=True, warn=job.warn)
    job.say("encoding the video")
    encode_frames([path for path in written if path.suffix == ".png"], TurntableOutputs(job.out).video, options, job.safe_point)
    for path in written:
        shutil.copyfile(path, job.out / path.name)  # no hard link: a run that was killed here has to be resumed, and what is linked is refused
