"""A tree as the tensors of a layout. WRITERS has them by name:

    compact  the file layout `compact`, a code of eight bits per harmonic       12 bytes a voxel of degree 2
    packed   the file layout `packed`: the same or fewer codes, entropy-coded    3 to 7
    small    the same layout, one code of 16 bits for all harmonics              6
    sparse   halves                                                             56
    full     all voxels of each brick, halves; full32: floats

B bricks, N stored voxels, K harmonics.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from efficientnerf.asset.cascades import bricks_of, order_of, voxel_sides
from efficientnerf.asset.file.container import FormatError
from efficientnerf.asset.palettes import MAX_HALF, PaletteHarmonics
from efficientnerf.asset.quantisation import compacted, quantised_density
from efficientnerf.asset.tree import NerfTree
from efficientnerf.rendering.harmonics import harmonics_count

SMALL_ENTRIES = 4096
PACKED_BYTES = 3  # of a voxel, its share of the masks left out
FILL_BLOCK = 2**21  # voxels times harmonics that are filled at once


@dataclass(frozen=True, eq=False)
class Written:
    """Tensors of a file layout in their little-endian types, and metadata that the layout needs."""

    layout: str
    tensors: dict[str, np.ndarray]
    metadata: dict[str, Any] = field(default_factory=dict)


def written_as(tree: NerfTree, writer: str | None) -> Written:
    """The tree's tensors as `writer` makes them; by default the one that loses nothing: `compact` for codes, else `sparse`."""
    if writer is None:
        return _coded(tree) if isinstance(tree.harmonics, PaletteHarmonics) else _sparse(tree)
    if writer not in WRITERS:
        raise ValueError(f"layout {writer!r}; expected one of {', '.join(WRITERS)}")
    return WRITERS[writer](tree)


def bytes_per_voxel(writer: str, degree: int) -> int:
    """Bytes of a stored voxel, without the masks of the bricks; in `packed` the target of the codes (docs/experiments/packed.md)."""
    harmonics = harmonics_count(degree)
    return {"compact": 4 + (harmonics - 1), "packed": PACKED_BYTES, "small": 4 + (2 if degree else 0), "sparse": 2 + 6 * harmonics}[writer]


def most_voxels(size: int, writer: str, degree: int, cells: int, brick: int, *, environment: int) -> int:
    """How many voxels, of all cascades together, fit a file of `size` bytes, if a quarter of the voxels of its bricks are stored (usually more are).

    cells        coarse cells of all grids
    environment  rows of the environment map, 0 without one
    """
    palette = {"compact": 256, "packed": 256, "small": SMALL_ENTRIES, "sparse": 0}[writer] * (harmonics_count(degree) - 1) * 6
    coded = writer == "packed"  # hardly any bits of cells and masks are left
    fixed = 2**14 + cells // (256 if coded else 8) + palette + 6 * environment**2
    mask = 0.0 if coded else 8 * math.ceil(brick**3 / 64) / max(1.0, brick**3 / 4)
    return max(0, int((size - fixed) / (bytes_per_voxel(writer, degree) + mask)))


def _mask(tree: NerfTree) -> np.ndarray:
    """64-bit words (B, ceil(b^3 / 64)): which voxels of each brick are stored."""
    stored = tree.voxel_index[bricks_of(tree)] >= 0
    words = math.ceil(tree.brick**3 / 64)
    padded = np.zeros((len(stored), words * 64), bool)
    padded[:, : tree.brick**3] = stored
    return np.ascontiguousarray(np.packbits(padded, axis=1, bitorder="little").view("<u8").reshape(len(stored), words))


def _densities(tree: NerfTree, order: np.ndarray) -> np.ndarray:
    density = _finite("density", tree.density_values[order])
    if (density < 0).any():
        raise FormatError("voxel.density: holds values below zero; such a tree can't be saved")
    return density


def _finite(what: str, values: np.ndarray) -> np.ndarray:
    if not np.isfinite(values).all():
        raise FormatError(f"voxel.{what}: holds values that are not finite; such a tree can't be saved")
    return values


def _sparse(tree: NerfTree) -> Written:
    order = order_of(tree)
    density = np.minimum(_densities(tree, order), MAX_HALF).astype("<f2")
    sh = np.clip(_finite("sh", tree.sh[order]), -MAX_HALF, MAX_HALF).astype("<f2")
    return Written("sparse", {"brick.mask": _mask(tree), "voxel.density": density, "voxel.sh": sh})


def _coded(tree: NerfTree) -> Written:
    """Codes as they are; only densities of more than 256 values are rounded."""
    assert isinstance(tree.harmonics, PaletteHarmonics)
    order = order_of(tree)
    codes = tree.harmonics.subset(order)
    table, density = np.unique(quantised_density(_densities(tree, order), voxel_sides(tree)[order] if tree.outer else tree.voxel), return_inverse=True)
    tensors = {
        "brick.mask": _mask(tree),
        "voxel.density": density.reshape(-1).astype("<u1"),
        "density.table": table.astype("<f4"),
        "voxel.base": codes.base,
        "base.table": _finite("sh", codes.base_table).astype("<f4"),
        "voxel.sh": codes.codes.astype("<u2" if len(codes.palette) > 256 else "<u1"),
        "sh.palette": np.clip(_finite("sh", codes.palette), -MAX_HALF, MAX_HALF).astype("<f2"),
    }
    return Written("compact", tensors, {"sh_groups": list(codes.groups)})


def _compact(tree: NerfTree) -> Written:
    kept = isinstance(tree.harmonics, PaletteHarmonics) and set(tree.harmonics.groups) <= {1} and len(tree.harmonics.palette) <= 256
    return _coded(tree if kept else compacted(_checked(tree)))


def _packed(tree: NerfTree) -> Written:
    """Codes as they are, whatever their groups, and else those of `compact`; `format.serialize` codes them. Cheaper ones: `efficientnerf.asset.economy`."""
    return replace(_coded(tree if isinstance(tree.harmonics, PaletteHarmonics) else compacted(_checked(tree))), layout="packed")


def _small(tree: NerfTree) -> Written:
    above = tree.harmonics_count - 1
    groups = (above,) if above else ()
    kept = isinstance(tree.harmonics, PaletteHarmonics) and tree.harmonics.groups == groups
    # A palette larger than a thirty-second of the voxels would be most of the file.
    entries = min(SMALL_ENTRIES, max(256, len(tree.density_values) // 32))
    return _coded(tree if kept else compacted(_checked(tree), entries, groups))


def _checked(tree: NerfTree) -> NerfTree:
    _densities(tree, order_of(tree))
    _finite("sh", tree.sh)
    return tree


def _full(tree: NerfTree, dtype: str = "<f2") -> Written:
    """All voxels of each brick. Voxels that were not stored get density 0, and a mean of the stored harmonics of their brick, the nearer
    the more: colours are interpolated over stored voxels alone, so that grey ones would show at the rim."""
    index, voxels, harmonics = tree.voxel_index[bricks_of(tree)], tree.brick**3, tree.harmonics_count
    _checked(tree)
    stored = index >= 0
    limit = MAX_HALF if dtype == "<f2" else np.inf
    density = np.minimum(np.where(stored, tree.density_values[index] if len(tree.density_values) else 0, 0), limit).astype(dtype)
    sh = np.zeros((len(index), voxels, harmonics, 3), dtype)
    line = np.subtract.outer(np.arange(tree.brick, dtype=np.int32), np.arange(tree.brick, dtype=np.int32)) ** 2
    away = (line[:, None, None, :, None, None] + line[:, None, None, :, None] + line[:, None, None, :]).reshape(voxels, voxels)  # squared distances
    near = (1 / np.maximum(away, 1).astype(np.float32) ** 3) * (away > 0)  # (b^3, b^3)
    each = max(1, FILL_BLOCK // (voxels * harmonics))
    for begin in range(0, len(index), each):
        block, here = index[begin : begin + each], stored[begin : begin + each]
        known = np.zeros((len(block), voxels, harmonics * 3), np.float32)
        known[here] = tree.sh[block[here]].reshape(-1, harmonics * 3)
        weight = here.astype(np.float32) @ near.T  # (bricks, b^3)
        filled = np.matmul(near, known) / np.maximum(weight, 1e-12)[..., None]
        values = np.where(here[..., None], known, filled)
        sh[begin : begin + each] = np.clip(values, -limit, limit).reshape(len(block), voxels, harmonics, 3).astype(dtype)
    return Written("full", {"brick.density": density, "brick.sh": sh})


WRITERS: dict[str, Callable[[NerfTree], Written]] = {
    "compact": _compact,
    "packed": _packed,
    "small": _small,
    "sparse": _sparse,
    "full": _full,
    "full32": lambda tree: _full(tree, "<f4"),
}
