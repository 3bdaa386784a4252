"""What rendering an asset takes, and comparing its renders. docs/experiments/memory.md"""

from __future__ import annotations

from collections.abc import Sequence

from efficientnerf.asset.palettes import PaletteHarmonics
from efficientnerf.asset.tree import NerfTree
from efficientnerf.geometry.cameras import Camera
from efficientnerf.surface.shading import AT_ONCE
from stages.memory.need import MIB, Need, libraries

# Times the tree's arrays: these, and what renderers make of them. Bytes of a pixel: of a frame with all its channels while it is written as EXR; of a
# test view with its photograph, renders, errors and windows of SSIM.
TREE, FRAME, COMPARED = 3, 116, 160
DRAWN, SAMPLE = 90, 40  # bytes of a pixel of a view in which the mesh is drawn; of a sample of those that are drawn at a time
BAND = 160 * MIB  # rays at a time where each is rendered on its own
FIELD = 150  # bytes of a ray through the field, with what lies before and behind the box
FIELD_BLOCK = 400 * MIB  # the samples of a block of rays through a field whose density voxels prune nothing yet


def tree_bytes(tree: NerfTree) -> int:
    """Bytes of a tree and of what renderers make of it."""
    harmonics = tree.harmonics
    colours = 16 * len(tree.density_values)  # as seen from a camera
    stored = harmonics.base.nbytes + harmonics.codes.nbytes if isinstance(harmonics, PaletteHarmonics) else harmonics.nbytes
    return TREE * (tree.brick_index.nbytes + tree.voxel_index.nbytes + tree.density_values.nbytes + stored) + colours


def frames_needed(tree: NerfTree, pixels: int, device: str = "cpu") -> Need:
    """What it takes to render and write frames of so many pixels, one at a time."""
    return Need({
        "a frame": pixels * FRAME + (0 if tree.ndc is None and tree.lookup == "trilinear" else BAND),
        "the asset": tree_bytes(tree),
        "libraries": libraries(device),
    })  # fmt: skip


def views_needed(tree: NerfTree, cameras: Sequence[Camera], rays: int, field: int, device: str = "cpu", mesh: int = 0) -> Need:
    """What it takes to compare renders with photographs, one at a time.

    rays   through the field, of one view at most
    field  bytes of the field's file
    mesh   bytes of the mesh that is measured
    """
    most = max((camera.width * camera.height for camera in cameras), default=0)
    return Need({
        "a view": most * (COMPARED + DRAWN),
        "the mesh": mesh + SAMPLE * AT_ONCE,
        "its rays": rays * FIELD + FIELD_BLOCK,
        "the asset": tree_bytes(tree) * (3 if tree.outer else 1),  # cascade 0 alone, and what surrounds the mesh
        "the field": 3 * field,
        "libraries": libraries(device),
    })  # fmt: skip
