"""The workflow from photographs to assets: its stages in order."""

from importlib import import_module
from pathlib import Path

from pipeline.stage import ByName, Stage
from workflows.workflow import Workflow

# Folders of `stages`, in order.
NAMES = (
    "poses",  # the source -> cameras, images, sparse points
    "train",  # poses -> field, density voxels
    "bake",  # train, poses -> asset.nerftree
    "mesh",  # bake, train, poses -> PLY, GLB, OBJ
    "splats",  # bake, train, poses -> 3D Gaussians as PLY and SPZ, unless splats.make is off
    "evaluate",  # mesh, splats, bake, train, poses -> PSNR and SSIM of the network, of the asset, of the mesh and of the Gaussians
    "turntable",  # bake -> frames, video, EXR
    "points",  # mesh, bake -> PLY
)
STAGES: tuple[Stage, ...] = tuple(import_module(f"stages.{name}.settings").STAGE for name in NAMES)
WORKFLOW = Workflow(
    STAGES,
    Path(__file__).parent / "presets",
    space=ByName("stages.memory.forecast:space_needed"),
    memory=ByName("stages.memory.forecast:memory_needed"),
)
