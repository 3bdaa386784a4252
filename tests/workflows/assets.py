"""The smallest asset."""

from pathlib import Path
from typing import Any

import numpy as np

from efficientnerf.asset import format
from efficientnerf.asset.tree import tree_from_voxels


def write_block(path: Path, voxel: float = 0.5, metadata: dict[str, Any] | None = None) -> None:
    """Write a block of 4 x 4 x 4 dense voxels about the origin into a folder that is made if it is missing."""
    path.parent.mkdir(exist_ok=True)
    index = np.argwhere(np.ones((4, 4, 4), bool))
    low, density, harmonics = np.full(3, -2 * voxel), np.full(64, 50.0), np.zeros((64, 1, 3), np.float32)
    format.save(tree_from_voxels((1, 1, 1), voxel, low, index, density, harmonics, brick=4, metadata=metadata), path)
