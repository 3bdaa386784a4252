"""Memory that an asset takes, from its header: the rule of FORMAT.md, section 10, which keeps it in proportion to the file's size.

A bit of a file may stand for four bytes of an index, and an untrusted file may hold little else; in an entropy-coded one for whatever its metadata claim.
"""

import math
from typing import Any

import numpy as np

from efficientnerf.asset.file.container import FormatError
from efficientnerf.asset.file.metadata import layout_of
from efficientnerf.asset.file.whole_scene import environment_rows, grids_of
from efficientnerf.rendering.harmonics import harmonics_count

MAX_RATIO, MAX_PACKED_RATIO, FIXED_BYTES = 8, 24, 200_000_000  # of the file's size, of an entropy-coded one's, and bytes
CELL = 6  # its brick, how far a ray may leap from it, and whether it is full
BRICK, SLOT = 72, 5  # where it lies, and which of its voxels are stored; for each of its voxels which of the stored ones it is
VOXEL = 20  # its density, and its colour for a view
NEIGHBOURS = 12  # three of them, while it is unpacked
ENVIRONMENT = 24  # a pair of texels of an environment map as floats
PALETTE = 28  # a coefficient of a palette as a float, in two orders of the axes, one of them padded
_REASONS = (
    "Its cells or bricks are nearly all empty: bake it with other bricks (bake.brick_size), or do not trust it.",
    "Its voxels hardly differ, or its cells are nearly all empty: write it as compact, or do not trust it.",
)


def counts_of(meta: dict[str, Any], shapes: dict[str, tuple[int, ...]]) -> tuple[int, int]:
    """How many bricks and stored voxels a file has, by the shapes of its tensors, or of those that it is unpacked to."""
    if layout_of(meta) == "full":
        bricks = shapes["brick.density"][0]
        return bricks, bricks * int(meta["brick"]) ** 3
    return shapes["brick.mask"][0], shapes["voxel.density"][0]


def needed(meta: dict[str, Any], shapes: dict[str, tuple[int, ...]], types: dict[str, np.dtype[Any]]) -> int:
    """Bytes of FORMAT.md, section 10; shapes and types as in `check_memory`."""
    cube, coefficients, layout = int(meta["brick"]) ** 3, 3 * harmonics_count(int(meta["sh_degree"])), layout_of(meta)
    bricks, voxels = counts_of(meta, shapes)
    cells = sum(math.prod(grid.shape) for grid in grids_of(meta))
    total = CELL * cells + (BRICK + SLOT * cube) * bricks + ENVIRONMENT * environment_rows(meta) ** 2
    if layout not in ("compact", "packed"):
        return total + (VOXEL + 4 * coefficients) * voxels
    each = VOXEL + (NEIGHBOURS if layout == "packed" else 0) + 3 + shapes["voxel.sh"][1] * types["voxel.sh"].itemsize
    if str(meta["layout"]).startswith("nearest-"):
        each += 4 * coefficients
    return total + each * voxels + PALETTE * math.prod(shapes["sh.palette"][:2])


def check_memory(name: str, meta: dict[str, Any], size: int, shapes: dict[str, tuple[int, ...]], types: dict[str, np.dtype[Any]]) -> None:
    """Raises FormatError where a file of `size` bytes needs more than the rule allows.

    shapes, types  of the layout's tensors, or of those that it is unpacked to
    """
    packed, most = layout_of(meta) == "packed", needed(meta, shapes, types)
    times = MAX_PACKED_RATIO if packed else MAX_RATIO
    if most > times * size + FIXED_BYTES:
        found = f"{size / 1e6:.1f} MB that take {most / 1e6:.0f} MB of memory; expected at most {times} times the size and {FIXED_BYTES / 1e6:.0f} MB"
        raise FormatError(f"{name}: {found}. {_REASONS[packed]}")
