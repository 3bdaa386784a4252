"""Targets of 3D Gaussians: training photographs, or the asset's own renders."""

from collections.abc import Callable
from pathlib import Path

import numpy as np

from efficientnerf.asset.camera_paths import turntable_cameras
from efficientnerf.asset.captured import captured_of
from efficientnerf.asset.rendering import render
from efficientnerf.asset.tree import NerfTree
from efficientnerf.geometry.cameras import Camera
from efficientnerf.splats.build import View
from stages.formats.exporters.frames import frame_from_rendering
from stages.io.scene import Scene, views_of
from stages.train.averaged import averaged_views

LONGER_SIDE = 640  # pixels, of renders at most
ORBIT = 36  # cameras round an asset that keeps none of its capture


def photographs(folder: Path, scene: Scene, trained: Path) -> list[View]:
    """The training photographs at working size, with the alpha that cuts an object out of a constant background; else alpha masks.

    folder   of the scene
    trained  of the stage train: where it learned the photographs' exposure, they are as if all had been exposed alike
    """
    found, read = [], averaged_views(folder, trained)
    for view in views_of(scene, "train"):
        pixels, mask = read(view)
        if pixels.shape[2] == 4 and scene.background is None:
            covered = pixels[..., 3] >= 128
            pixels, mask = np.ascontiguousarray(pixels[..., :3]), covered if mask is None else mask & covered
        found.append(View(view.camera, pixels, mask))
    return found


def renders(tree: NerfTree, cameras: list[Camera], tick: Callable[[int, int, str], None]) -> list[View]:
    """The asset's own, transparent where it is; opaque before an environment map."""
    found = []
    for number, camera in enumerate(cameras):
        seen = render(tree, camera, normals=False)
        opaque = np.ones_like(seen.opacity)
        pixels = frame_from_rendering(seen.colour, seen.opacity if tree.environment is None else opaque, None)
        found.append(View(camera, pixels))
        tick(number + 1, len(cameras), "renders of the asset")
    return found


def render_cameras(tree: NerfTree) -> list[Camera]:
    """The captured cameras that an asset keeps, at most LONGER_SIDE wide or high; else a turntable's."""
    captured = captured_of(tree.metadata)
    if captured is None:
        return turntable_cameras(tree, frames=ORBIT, width=LONGER_SIDE, height=3 * LONGER_SIDE // 4)
    return captured.cameras(min(1.0, LONGER_SIDE / max(captured.width, captured.height)))
