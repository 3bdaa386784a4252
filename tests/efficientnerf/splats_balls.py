"""A coloured ball as a tree, its photographs, and how far Gaussians are from them."""

import numpy as np

from efficientnerf.asset.rendering import render as render_tree
from efficientnerf.asset.tree import NerfTree, tree_from_voxels
from efficientnerf.geometry.cameras import Camera
from efficientnerf.rendering.harmonics import C0
from efficientnerf.splats.build import View
from efficientnerf.splats.gaussians import Gaussians
from efficientnerf.splats.rendering import render
from tests.efficientnerf.balls import pose

SIDE = 24


def ball(side: int = 24, degree: int = 1) -> NerfTree:
    """A ball of radius 0.8 in the middle of the world, red to the one side and green to the other, with a shell of voxels alone."""
    voxel = 2 / side
    indices = np.argwhere(np.ones((side,) * 3, bool))
    at = (indices + 0.5) * voxel - 1
    far = np.linalg.norm(at, axis=1)
    near = np.abs(far - 0.75) < 1.5 * voxel
    sh = np.zeros((int(near.sum()), (degree + 1) ** 2, 3), np.float32)
    sh[:, 0] = np.where(at[near, :1] > 0, [2.0, -2, -2], [-2.0, 2, -2]) / C0
    return tree_from_voxels((side // 4,) * 3, voxel, np.full(3, -1.0), indices[near], np.full(len(sh), 4 / voxel, np.float32), sh)


def ring(count: int, side: int = SIDE, distance: float = 3.0) -> list[Camera]:
    found = []
    for n in range(count):
        at = pose(2 * np.pi * n / count, 0.4)
        at[:3, 3] *= distance / np.linalg.norm(at[:3, 3])
        found.append(Camera(f"view {n}", side, side, "SIMPLE_PINHOLE", (1.4 * side, side / 2, side / 2), at))
    return found


def photographs(tree: NerfTree, cameras: list[Camera]) -> list[View]:
    """Renders of the tree with straight alpha."""
    views = []
    for camera in cameras:
        seen = render_tree(tree, camera, normals=False)
        colour = seen.colour / np.maximum(seen.opacity[..., None], 1e-3)
        views.append(View(camera, np.round(np.clip(np.concatenate([colour, seen.opacity[..., None]], axis=2), 0, 1) * 255).astype(np.uint8)))
    return views


def error(gaussians: Gaussians, views: list[View]) -> float:
    """Mean squared error over white."""
    total = 0.0
    for view in views:
        wanted = view.pixels / 255
        total += np.square(render(gaussians, view.camera, (1, 1, 1)).colour - (wanted[..., :3] * wanted[..., 3:] + 1 - wanted[..., 3:])).mean()
    return total / len(views)
