"""A baked ball, and one whose foreground is its upper half, as asset files."""

from dataclasses import replace
from pathlib import Path

import numpy as np

from efficientnerf.asset import format
from efficientnerf.asset.tree import Region, tree_from_voxels
from efficientnerf.geometry.cameras import Similarity

# The capture lies on its side (y down), is four times as large as the training frame and somewhere else.
WORLD_FROM_CAPTURE = Similarity(0.25, np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]]), np.array([0.1, 0.2, 0.3]))
RADIUS = 0.55


def bake_ball(folder: Path, density: float = 300.0) -> Path:
    """A folder with asset.nerftree: a ball around the origin of the training frame, orange above and blue below."""
    cells, brick = 10, 4
    voxel = 2 / (cells * brick)
    index = np.stack(np.meshgrid(*[np.arange(cells * brick)] * 3, indexing="ij"), -1).reshape(-1, 3)
    centre = (index + 0.5) * voxel - 1
    distance = np.linalg.norm(centre, axis=1) - RADIUS
    kept = distance < voxel
    colour = np.where(centre[kept, 2:] > 0, [0.9, 0.5, 0.1], [0.1, 0.2, 0.8])
    sh = (np.log(colour / (1 - colour)) / 0.28209479177387814)[:, None]
    level = density * np.clip(0.5 - distance[kept] / voxel, 0, 1)
    similarity = WORLD_FROM_CAPTURE
    metadata = {
        "world_from_capture": {"scale": similarity.scale, "rotation": similarity.rotation.tolist(), "translation": similarity.translation.tolist()},
        "orbit": {"centre": [0.0, 0.0, 0.0], "radius": 3.0, "elevation": 25.0, "forward_facing": False, "heading": 40.0},
        "metric": True,
        "provenance": {},
    }
    tree = tree_from_voxels((cells,) * 3, voxel, np.full(3, -1.0), index[kept], level, sh.astype(np.float32), metadata=metadata)
    folder.mkdir(parents=True)
    format.save(tree, folder / "asset.nerftree")
    return folder


def with_region(ball: Path, folder: Path) -> Path:
    """The same asset whose foreground is its upper half and a little more."""
    folder.mkdir(parents=True)
    region = Region(np.array([[-0.9, -0.9, -0.2], [0.9, 0.9, 0.9]]), 0.9, 0.05)
    format.save(replace(format.load(ball / "asset.nerftree"), region=region), folder / "asset.nerftree")
    return folder
