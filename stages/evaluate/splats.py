"""The 3D Gaussians of a run against the photographs: drawn from the held-back cameras before what is behind the asset in its own figures."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from efficientnerf.asset.tree import NerfTree
from efficientnerf.geometry.cameras import Camera
from efficientnerf.splats.rendering import render
from stages.artifacts import SplatsOutputs
from stages.formats.exporters.splats.frames import moved
from stages.formats.exporters.splats.ply import read_splats
from stages.formats.exporters.writing import source_frame
from stages.reports import RegionReport, read_report

FIGURES = ("psnr", "ssim")


@dataclass(frozen=True, eq=False)
class EvaluatedSplats:
    """Gaussians to be measured."""

    draw: Callable[[Camera, tuple[float, float, float] | None], np.ndarray]  # what a camera sees (H, W, 3) on a colour, or on black
    facts: dict[str, Any]  # that metrics.json repeats


def load_splats(outputs: SplatsOutputs, tree: NerfTree) -> EvaluatedSplats | None:
    """The Gaussians of a run, from the file that others read; None where it made none of all that the asset shows. They are drawn on the tree's
    device. Raises CorruptArtifact."""
    if not outputs.ply.is_file() or read_report(outputs.report, RegionReport).region != "all":
        return None
    gaussians = moved(read_splats(outputs.ply), source_frame(tree.metadata).world_from_capture)
    facts = {"gaussians": len(gaussians), "ply_bytes": outputs.ply.stat().st_size}
    return EvaluatedSplats(lambda camera, background: render(gaussians, camera, background, tree.device).colour, facts)
