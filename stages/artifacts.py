"""The files of each stage's artifact; each file name is stated here, once.

A stage writes `XOutputs(job.out)` and reads `YOutputs(job.inputs["y"])` of each stage y that it needs; a workflow reads `XOutputs.of_run(run)`.
A new stage states its own in its `settings.py`, or here if an earlier stage or `stages.io` has to know its files.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar, Self, overload


class Name:
    """A file or a folder of an artifact: of an instance of Outputs its path, of the class its name relative to the artifact's folder."""

    def __init__(self, name: str) -> None:
        self.name = name

    @overload
    def __get__(self, outputs: None, owner: type) -> str: ...
    @overload
    def __get__(self, outputs: Outputs, owner: type) -> Path: ...
    def __get__(self, outputs: Outputs | None, owner: type) -> str | Path:
        return self.name if outputs is None else outputs.folder / self.name


@dataclass(frozen=True)
class Outputs:
    """The outputs of a stage."""

    folder: Path
    stage: ClassVar[str]  # its name, which is also that of its folder in a run

    @classmethod
    def of_run(cls, run: Path) -> Self:
        """Those of the stage in the folder of a run."""
        return cls(run / cls.stage)


class PosesOutputs(Outputs):
    """The scene: cameras, working images, sparse points."""

    stage = "poses"
    scene = Name("scene.json")  # stages.io.scene
    images = Name("images")  # working images, below it at any depth
    masks = Name("masks")  # 0/255 PNG, 255 = use
    points = Name("points.safetensors")  # sparse points in the training frame, where there are any
    report = Name("report.json")  # images used and rejected, framing, warnings
    verdict = Name("verdict.json")  # stages.verdict.verdict: a grade, problems and what to do, and what is known of each photograph
    contact_sheet = Name("contact_sheet.png")
    silhouettes = Name("silhouettes.png")  # those that were made of the foreground, over the photographs
    cameras = Name("cameras.png")  # from above and from the side
    matches = Name("matches.png")  # which photographs match, where they were compared
    sharpness = Name("sharpness.png")  # photographs, the most blurred first
    frames = Name("frames.json")  # of videos: which frames were chosen and why, by time, sharpness and motion
    frames_plot = Name("frames_plot.png")
    frames_sheet = Name("frames.png")


class TrainOutputs(Outputs):
    """The trained field."""

    stage = "train"
    field = Name("field.safetensors")  # stages.io.field_file: fields, density voxels, the schedule, exposure where it was learned
    cameras = Name("cameras.json")  # training cameras where they changed, and views left out; stages.io.refined_cameras
    choices = Name("choices.json")  # what training did otherwise than scene and settings state, where it learned nothing; stages.train.choices
    support = Name("support.json")  # planes of a table, floor or wall that support the subject, where any was found; stages.train.support
    wrong_views = Name("wrong_views.png")  # photographs and renders of the views that were left out or got other poses
    report = Name("report.json")  # steps, seconds, and the settings that give the same field again
    log = Name("log.jsonl")  # a line every few steps
    curve = Name("curve.png")  # PSNR over steps
    previews = Name("previews")  # renders of a validation view


class BakeOutputs(Outputs):
    """The baked asset."""

    stage = "bake"
    asset = Name("asset.nerftree")  # efficientnerf/asset/FORMAT.md
    report = Name("report.json")  # resolution and what decided it, voxels, bytes, PSNR before and after the refinement; of an unbounded scene cascades, holes
    log = Name("log.jsonl")  # a line every few steps of the refinement
    curve = Name("curve.png")  # PSNR over these steps
    previews = Name("previews")  # renders of a validation view


class EvaluateOutputs(Outputs):
    """The metrics."""

    stage = "evaluate"
    metrics = Name("metrics.json")  # PSNR, SSIM, gap, holes, floaters, LPIPS: means, and of each view
    verdict = Name("verdict.json")  # stages.verdict.result: a grade, and problems with cause, remedy and picture
    sparse_points = Name("sparse_points.png")  # points of structure from motion that the asset's depth agrees with or not, of the worst view
    contact_sheet = Name("contact_sheet.png")
    # photograph, network, asset, mesh: strip_WHICH.png, as many of the three as there are views
    strip_worst = Name("strip_worst.png")
    strip_median = Name("strip_median.png")
    strip_best = Name("strip_best.png")
    captured_path = Name("captured_path.mp4")


class TurntableOutputs(Outputs):
    """Frames and a video."""

    stage = "turntable"
    video = Name("turntable.mp4")
    poster = Name("frame_0000.png")  # the first frame


class MeshOutputs(Outputs):
    """The surface as a mesh."""

    stage = "mesh"
    ply = Name("mesh.ply")  # the capture's frame
    glb = Name("mesh.glb")  # y up, the texture inside
    obj = Name("mesh.obj")  # the capture's frame
    material = Name("mesh.mtl")  # of the OBJ, where there is a texture
    texture = Name("mesh.png")  # the same
    preview = Name("preview.png")
    check = Name("check.png")  # where it differs most from the asset: opacity, mesh, what is missed and added
    report = Name("report.json")  # counts, topology, bounds, area, volume, agreement with the asset


class PointsOutputs(Outputs):
    """The surface as a point cloud."""

    stage = "points"
    ply = Name("points.ply")  # the capture's frame


class SplatsOutputs(Outputs):
    """The asset as 3D Gaussians; of a run that makes none the report alone."""

    stage = "splats"
    ply = Name("splats.ply")  # as 3DGS writes it, the capture's frame
    spz = Name("splats.spz")  # the same, small, y up
    preview = Name("preview.png")  # next to the asset
    report = Name("report.json")  # how many, bytes, seconds
