"""From photographs to everything: the stages, in order."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from pipeline.stage import Stage
from stages import bake, evaluate, mesh, points, poses, train, turntable


@dataclass(frozen=True)
class Workflow:
    """What the command line runs.

    stages   in order
    presets  the folder of its presets, TOML files
    """

    stages: tuple[Stage, ...]
    presets: Path


STAGES = (
    poses.STAGE,  # the source -> cameras, images, sparse points
    train.STAGE,  # poses -> field, density voxels
    bake.STAGE,  # train, poses -> asset.nerftree
    evaluate.STAGE,  # bake, train, poses -> PSNR and SSIM of the network and of the asset
    turntable.STAGE,  # bake -> frames, video, EXR
    mesh.STAGE,  # bake -> PLY, GLB
    points.STAGE,  # bake -> PLY
)
WORKFLOW = Workflow(STAGES, Path(__file__).parent / "presets")
