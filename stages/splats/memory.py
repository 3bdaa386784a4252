"""What making 3D Gaussians takes."""

from __future__ import annotations

from typing import TYPE_CHECKING

from stages.memory.need import Need, libraries
from stages.memory.rendering import tree_bytes

if TYPE_CHECKING:
    from efficientnerf.asset.tree import NerfTree

# Bytes. Of a parameter: value, gradient, two moments, and one more while Gaussians are merged and written; of a stored voxel while they are merged; of a
# pixel of a picture: its colours and mask; of a pixel of the one that is drawn: colours, transmittance, gradients and the Gaussians that cover its tile.
PARAMETER, VOXEL, PIXEL, DRAWN = 20, 100, 4, 400


def splats_needed(tree: NerfTree, count: int, sh_degree: int, pixels: int, largest: int) -> Need:
    """What it takes to make so many Gaussians and to fit them to pictures.

    pixels   of all pictures
    largest  of one of them, at most
    """
    parameters = 11 + 3 * (sh_degree + 1) ** 2
    return Need({
        "Gaussians": PARAMETER * parameters * count,
        "merging": VOXEL * len(tree.density_values),
        "pictures": PIXEL * pixels + DRAWN * largest,
        "the asset": tree_bytes(tree),
        "libraries": libraries(),
    })  # fmt: skip
