"""Memory of extracting a surface. docs/experiments/memory.md"""

import math
from pathlib import Path

from efficientnerf.asset.tree import NerfTree
from efficientnerf.surface.fitting.photometric import MAX_PIXELS
from efficientnerf.surface.fusion import MARGIN
from efficientnerf.surface.isosurface import BLOCK, pool_of
from efficientnerf.surface.volume import VOXELS_AT_ONCE, volume_of
from stages.io.scene import load, views_of
from stages.memory.forecast import Known
from stages.memory.need import MIB, SURFACES, Need, libraries
from stages.memory.tree import asset_of, tree_bytes
from stages.mesh.check import CAPTURED, FUSED, LONGER_SIDE, ORBIT
from stages.mesh.refinement import MAX_PHOTOGRAPHS
from stages.mesh.settings import MeshSettings
from stages.mesh.texture import largest_photograph
from stages.train.data import count_pixels

# Bytes. Of a stored voxel: vertices and faces while they are joined, cleaned and decimated, as many as a thin shell has; of a cell in which enclosed space
# is found, and of a voxel of the bricks that these are made from.
VOXEL, CELL, BRICK_VOXEL = 150, 8, 64
# Of a pixel of a view whose depth is fused, and of a voxel of a block that is fused at a time.
PIXEL, BLOCK_VOXEL = 36, 120
# Of a texel, with what it has seen of photographs; of a photograph's pixel with depth and edges.
TEXEL, PHOTOGRAPH_PIXEL = 110, 60
# Of a vertex that is fitted to photographs: places and scores in them.
FITTED_VERTEX = 1600
# Bytes written: of a face in all files; of a texel in its own file and in GLB; of pictures. Faces of a voxel and texels of a photograph's pixel, at most.
WRITTEN_FACE, WRITTEN_TEXEL, SHEET, FACES, TEXELS = 180, 3, 3 * MIB // 4, 4, 4


def surface_needed(tree: NerfTree, texture: int, pixels: int, fitted: int = 0) -> Need:
    """Memory to mesh a tree and to texture it: so many texels a side, photographs of so many pixels, and so many vertices fitted to photographs."""
    views = CAPTURED + ORBIT + FUSED
    pool = pool_of(volume_of(tree))
    cells = [-(-side // pool) + 2 for side in tree.resolution]
    terms = {
        "vertices and faces": VOXEL * len(tree.density_values),
        "the grid": CELL * math.prod(cells) + BRICK_VOXEL * min(VOXELS_AT_ONCE, tree.voxel_index.size),
        "views": PIXEL * views * LONGER_SIDE**2 + BLOCK_VOXEL * (BLOCK + 1 + 2 * MARGIN) ** 3,
        "the asset": tree_bytes(tree),
        "libraries": libraries() + SURFACES,
    }
    optional = {"the texture": TEXEL * texture**2, "a photograph": PHOTOGRAPH_PIXEL * pixels,
                "the fit to photographs": (FITTED_VERTEX * fitted + MAX_PHOTOGRAPHS * min(pixels, MAX_PIXELS)) if fitted else 0}  # fmt: skip
    return Need(terms | {what: count for what, count in optional.items() if count})


def needed(tree: NerfTree, settings: MeshSettings, poses: Path) -> Need:
    """Memory of the stage mesh; `poses` is the folder of that stage."""
    texture = 0 if settings.texture == "off" else settings.texture_size
    fitted = 0 if settings.photometric_refinement == "off" else _most_faces(tree, settings) // 2
    pixels = largest_photograph(poses, "photographs" if fitted else settings.texture)
    return surface_needed(tree, texture=texture, pixels=pixels, fitted=fitted)


def _most_faces(tree: NerfTree, settings: MeshSettings) -> int:
    return min(settings.faces, FACES * len(tree.density_values))


def memory_needed(known: Known) -> Need:
    """`needed` for all of the asset."""
    return needed(asset_of(known), known.settings["mesh"], known.run / "poses")


def space_needed(known: Known) -> int:
    """Mesh files, textures and pictures."""
    own, views = known.settings["mesh"], views_of(load(known.run / "poses"), "train")
    faces = _most_faces(asset_of(known), own)
    texels = 0 if own.texture == "off" else min(own.texture_size**2, TEXELS * count_pixels(views))
    return SHEET + WRITTEN_FACE * faces + WRITTEN_TEXEL * texels
