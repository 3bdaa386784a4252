"""Slanted walls before a reference camera, as trees in normalised device coordinates."""

import numpy as np

from efficientnerf.asset.tree import NerfTree, tree_from_voxels
from efficientnerf.geometry.cameras import Camera
from efficientnerf.geometry.ndc import Ndc
from efficientnerf.rendering.harmonics import harmonics_count

NEAR = 2.0
DEPTH = 6.0  # of the wall before the reference camera, world units


def looking_along_y() -> np.ndarray:
    """A reference camera that looks along the world's +y, with z up, off the origin."""
    pose = np.eye(4)
    pose[:3, 0], pose[:3, 1], pose[:3, 2], pose[:3, 3] = [1, 0, 0], [0, 0, -1], [0, 1, 0], [0.3, -1.0, 0.2]
    return pose


def wall(slant: float = 0.0, *, voxels: int = 96, hard: float = 1.0, degree: int = 1, seed: int = 0) -> NerfTree:
    """A wall whose depth is DEPTH + slant x before the reference camera, twelve voxels thick, its density rising evenly from nothing, and of
    random colours that depend on the direction."""
    ndc = Ndc(looking_along_y(), 100.0, 100.0, 100.0, NEAR)
    low, voxel = np.array([-1.5, -1.5, -1.0]), 3.0 / voxels
    shape = (voxels // 4, voxels // 4, -(-int(2 / voxel) // 4))
    index = np.stack(np.meshgrid(*(np.arange(4 * n) for n in shape), indexing="ij"), -1).reshape(-1, 3)
    centre = low + (index + 0.5) * voxel
    # z = D + s x with x = x' z / a: the front in NDC is z = D / (1 - s x' / a).
    front = 1 - 2 * NEAR * (1 - slant * centre[:, 0] / ndc.slopes[0]) / DEPTH
    deep = (centre[:, 2] - front) / voxel  # voxels behind the front
    solid = (deep >= 0) & (deep < 12)
    index = index[solid]
    rng = np.random.default_rng(seed)
    sh = np.repeat(rng.normal(size=(1, harmonics_count(degree), 3)), len(index), axis=0).astype(np.float32)
    return tree_from_voxels(shape, voxel, low, index, (hard * deep[solid] / voxel).astype(np.float32), sh, ndc=ndc)


def camera_at(x: float, y: float, z: float) -> Camera:
    pose = looking_along_y()
    pose[:3, 3] += [x, y, z]
    return Camera("a", 40, 30, "SIMPLE_RADIAL", (60.0, 20.0, 15.0, -0.05), pose)
