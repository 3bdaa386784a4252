"""The workflow from photographs to assets: its stages in order."""

from __future__ import annotations

from dataclasses import dataclass
from importlib import import_module
from pathlib import Path

from pipeline.stage import Stage


@dataclass(frozen=True)
class Workflow:
    """Stages and presets of a command line.

    stages   in order
    presets  the folder of its presets, TOML files
    child    the module that runs its stages in processes of their own; see `pipeline.executors.serving`
    """

    stages: tuple[Stage, ...]
    presets: Path
    child: str = "workflows.fleet.child"


# Modules of `stages`, in order.
NAMES = (
    "poses",  # the source -> cameras, images, sparse points
    "train",  # poses -> field, density voxels
    "bake",  # train, poses -> asset.nerftree
    "mesh",  # bake, train, poses -> PLY, GLB, OBJ
    "splats",  # bake, train, poses -> 3D Gaussians as PLY and SPZ, unless splats.make is off
    "evaluate",  # mesh, splats, bake, train, poses -> PSNR and SSIM of the network, of the asset, of the mesh and of the Gaussians
    "turntable",  # bake -> frames, video, EXR
    "points",  # bake -> PLY
)
STAGES: tuple[Stage, ...] = tuple(import_module(f"stages.{name}").STAGE for name in NAMES)
WORKFLOW = Workflow(STAGES, Path(__file__).parent / "presets")
