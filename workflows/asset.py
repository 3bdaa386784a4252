"""The workflow from photographs to assets: its stages in order."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import Any

from pipeline.stage import Stage
from stages.memory.forecast import memory_needed, space_needed


@dataclass(frozen=True)
class Workflow:
    """Stages and presets of a command line.

    stages   in order
    presets  the folder of its presets, TOML files
    child    the module that runs its stages in processes of their own; see `pipeline.executors.serving`
    space    (stage, run, its sources, settings by stage, bytes of memory or None) -> bytes that the stage writes
    memory   (stage, run, its sources, settings by stage, device) -> bytes that the stage takes; None: not known, it has a share of its worker's
    """

    stages: tuple[Stage, ...]
    presets: Path
    child: str = "workflows.fleet.child"
    space: Callable[[str, Path, Sequence[Path], Mapping[str, Any], int | None], int] = lambda *_: 0
    memory: Callable[[str, Path, Sequence[Path], Mapping[str, Any], str], int | None] = lambda *_: None


# Folders of `stages`, in order.
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
STAGES: tuple[Stage, ...] = tuple(import_module(f"stages.{name}.run").STAGE for name in NAMES)
WORKFLOW = Workflow(STAGES, Path(__file__).parent / "presets", space=space_needed, memory=memory_needed)
