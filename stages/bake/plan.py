"""The voxels to bake: of one grid, or of the cascades of an unbounded scene."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from efficientnerf.asset.field_samples import FieldSamples, Grid
from efficientnerf.asset.tree import Region
from efficientnerf.geometry.spaces import Space
from stages.bake.resolution import Choice


@dataclass(frozen=True, eq=False)
class Plan:
    """Voxels that are baked.

    space        the field's, in the frame that the voxels are cubes of
    grids        nested, the innermost first; one unless the scene is unbounded
    indices      coordinates (N, 3) of the voxels in each of them
    bricks       coarse cells that hold a sample, of all grids
    seen         of unbounded scenes, for each grid (N, 2) what rays saw of the voxels (`efficientnerf.asset.field_samples.seen_weights`)
    samples      what the field shows along training rays, of unbounded scenes alone, as the next two
    region       the foreground
    environment  (H, 2 H, 3) what lies beyond all grids
    """

    choice: Choice
    space: Space
    grids: list[Grid]
    indices: list[np.ndarray]
    bricks: int
    seen: list[np.ndarray] | None = None
    samples: FieldSamples | None = None
    region: Region | None = None
    environment: np.ndarray | None = None

    @property
    def voxels(self) -> int:
        return sum(map(len, self.indices))

    @property
    def cells(self) -> int:
        """Coarse cells of all grids."""
        return sum(math.prod(shape) for shape, _, _ in self.grids)
