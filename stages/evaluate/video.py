"""The video of the captured path: the asset alone, as seen along the photographs' cameras."""

from dataclasses import replace
from typing import Any

import numpy as np

from efficientnerf.asset.rendering import Rendering
from efficientnerf.asset.tree import NerfTree
from efficientnerf.capture.captured_path import captured_cameras
from efficientnerf.geometry.cameras import Camera
from pipeline.stage import Job
from stages.artifacts import EvaluateOutputs
from stages.evaluate.asset import EvaluatedAsset
from stages.evaluate.views import constant_background
from stages.figures.frames import RenderOptions, encode_frames, render_frames
from stages.io.png import FAST
from stages.io.scene import Scene

LONGEST = 480  # pixels, the longer side of the video
FPS, CRF = 15, 20


def write_captured_path(asset: EvaluatedAsset, tree: NerfTree, scene: Scene, frames: int, job: Job) -> None:
    """Write the video. Frames are kept in job.work, so that a kill costs at most the last few.

    tree  the asset's, whose metadata frames need
    """
    behind = constant_background(scene)

    def draw(tree: NerfTree, camera: Camera, **more: Any) -> Rendering:
        rendering: Rendering = asset.render(camera, background=behind, **more)
        return replace(rendering, opacity=np.ones_like(rendering.opacity))  # whatever is behind has been drawn

    def each(done: int, total: int) -> None:
        job.safe_point()
        job.progress(done, total, "frames of the captured path")

    cameras = captured_cameras([view.camera for view in scene.views], frames, LONGEST)
    options = RenderOptions(exr="off", fps=FPS, crf=CRF, compress_level=FAST)
    written = render_frames(tree, cameras, job.work / "captured", options, each, reuse=True, draw=draw, warn=job.warn)
    encode_frames(written, EvaluateOutputs(job.out).captured_path, options, job.safe_point)
