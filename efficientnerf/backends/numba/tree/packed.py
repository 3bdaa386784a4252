"""What the marching kernel reads of a tree, beside the arrays of the tree itself: made once, a few bytes a voxel.

A brick near which nothing absorbs light is empty to the kernel, as a coarse cell without one is. Blocks of the others, in which a march finds all that
it interpolates side by side, are laid out while a picture is drawn, where its rays come by: see `efficientnerf.backends.numba.tree.blocks`.

B bricks, N stored voxels, K harmonics, P entries of a palette; b = brick.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from efficientnerf.backends.numba.runtime import numba

if TYPE_CHECKING:
    from efficientnerf.asset.tree import NerfTree

SOME = 2**16  # voxels that stand for all


class Packed(NamedTuple):
    """See the module. The harmonics are either in `sh` or in the four arrays after it; the others are empty.

    leap      (X, Y, Z) uint8: as `NerfTree.leap`, but a brick near which nothing absorbs light is none
    live      (B, W) int64: bit n % 64 of word n // 64 is set where any of eight voxels has density, of which the first is voxel (i - 1, j - 1, k - 1) of the
              brick and n = (i (b + 2) + j) (b + 2) + k
    stored    (B + 1, V, 2) int64: which voxels of a brick are stored, a bit each, 64 in a word; and the number of the first of them in a word, from which
              on those of the word are numbered. A sixteenth of `voxel_index`, which blocks take whatever way they find it: it stays in a cache. The last
              brick has none
    place     (B, 3) int32: the coarse cell of a brick
    brick_index, voxel_index, density  the tree's own, where its voxels are in order, and so the harmonics
    sh        (N, K, 3) float32: the tree's own
    base, base_table, codes  as in PaletteHarmonics: the tree's own
    palette   (K - 1, P, 4) float32: the tree's, with a zero before red
    column    (K - 1,) int64: which of a voxel's codes each harmonic above the base goes by
    slope     how much colours turn: mean over voxels of what their harmonics' sums change, at most of the three channels, per radian that a direction
              moves, root mean square over all directions
    """

    leap: np.ndarray
    live: np.ndarray
    stored: np.ndarray
    place: np.ndarray
    brick_index: np.ndarray
    voxel_index: np.ndarray
    density: np.ndarray
    sh: np.ndarray
    base: np.ndarray
    base_table: np.ndarray
    codes: np.ndarray
    palette: np.ndarray
    column: np.ndarray
    slope: float

    @property
    def nbytes(self) -> int:
        """Of the arrays that are not the tree's own."""
        return self.leap.nbytes + self.live.nbytes + self.stored.nbytes + self.place.nbytes + self.palette.nbytes


@numba.njit(cache=True, error_model="numpy")
def _densities_around(owner, place, brick, brick_index, voxel_index, values, dense):  # type: ignore[no-untyped-def]
    """Whether a brick's voxels, and those in the one layer around them, have density, into (b + 2, b + 2, b + 2) uint8."""
    dense[:] = 0
    for n in range(27):
        p, q, r = n // 9, n // 3 % 3, n % 3
        a, e, c = place[owner, 0] + p - 1, place[owner, 1] + q - 1, place[owner, 2] + r - 1
        if not (0 <= a < brick_index.shape[0] and 0 <= e < brick_index.shape[1] and 0 <= c < brick_index.shape[2]):
            continue
        there = brick_index[a, e, c]
        if there < 0:
            continue
        # Of a neighbour only the layer that faces the brick.
        for x in range(brick - 1 if p == 0 else 0, 1 if p == 2 else brick):
            for y in range(brick - 1 if q == 0 else 0, 1 if q == 2 else brick):
                for z in range(brick - 1 if r == 0 else 0, 1 if r == 2 else brick):
                    voxel = voxel_index[there, (x * brick + y) * brick + z]
                    if voxel >= 0 and values[voxel] > 0:
                        dense[x + 1 + (p - 1) * brick, y + 1 + (q - 1) * brick, z + 1 + (r - 1) * brick] = 1


@numba.njit(cache=True, parallel=True, error_model="numpy")
def _live(place, brick, brick_index, voxel_index, values, out):  # type: ignore[no-untyped-def]
    """`Packed.live` into `out`, which is zero."""
    side = brick + 2
    for part in numba.prange((len(place) + 255) // 256):
        dense = np.empty((side, side, side), np.uint8)
        for owner in range(256 * part, min(len(place), 256 * part + 256)):
            _densities_around(owner, place, brick, brick_index, voxel_index, values, dense)
            # Of the voxel and the one after it, along one axis after the other.
            for i in range(side):
                for j in range(side):
                    for k in range(side - 1):
                        dense[i, j, k] |= dense[i, j, k + 1]
            for i in range(side):
                for j in range(side - 1):
                    for k in range(side - 1):
                        dense[i, j, k] |= dense[i, j + 1, k]
            for i in range(side - 1):
                for j in range(side - 1):
                    for k in range(side - 1):
                        n = (i * side + j) * side + k
                        out[owner, n >> 6] |= np.int64(dense[i, j, k] | dense[i + 1, j, k]) << (n & 63)


def _stored(voxel_index: np.ndarray) -> np.ndarray:
    """`Packed.stored` of voxels that are in order."""
    bricks, cube = voxel_index.shape
    words = (cube + 63) // 64
    bits = np.zeros((bricks + 1, 64 * words), bool)
    bits[:bricks, :cube] = voxel_index >= 0
    out = np.zeros((bricks + 1, words, 2), np.int64)
    out[..., 0] = np.packbits(bits, axis=1, bitorder="little").view(np.int64)
    count = bits.reshape(-1, 64).sum(axis=1)
    out[..., 1] = (np.cumsum(count) - count).reshape(bricks + 1, words)
    return out


def _slope(tree: NerfTree) -> float:
    """`Packed.slope`, of voxels from all over the tree."""
    from efficientnerf.rendering.harmonics import squared_slopes

    count = len(tree.density_values)
    if count == 0 or tree.degree == 0:
        return 0.0
    some = tree.coefficients(np.arange(0, count, -(-count // SOME)))
    return float(np.sqrt(np.einsum("nkc,nkc,k->nc", some, some, squared_slopes(tree.degree))).max(axis=1).mean())


def _in_order(tree: NerfTree) -> NerfTree:
    """The tree, its voxels numbered brick by brick and along each: as files and `tree_from_voxels` have them, or else as a copy."""
    from efficientnerf.asset.palettes import PaletteHarmonics

    there = tree.voxel_index >= 0
    order = tree.voxel_index[there]
    if np.array_equal(order, np.arange(len(order))):
        return tree
    index = np.full_like(tree.voxel_index, -1)
    index[there] = np.arange(len(order))
    harmonics = tree.harmonics.subset(order) if isinstance(tree.harmonics, PaletteHarmonics) else tree.harmonics[order]
    return replace(tree, voxel_index=index, density_values=tree.density_values[order], harmonics=harmonics)


def packed_of(tree: NerfTree) -> Packed:
    """The packed form of a tree, made once."""
    if "packed" not in tree.derived:
        tree.derived["packed"] = pack(tree)
    return tree.derived["packed"]


def pack(tree: NerfTree) -> Packed:
    """The packed form of a tree; see the module. ValueError where the tree is not interpolated, as the kernel that reads it does."""
    from efficientnerf.asset.palettes import PaletteHarmonics
    from efficientnerf.asset.tree import leaps

    if tree.lookup != "trilinear":
        raise ValueError(f"a tree of lookup {tree.lookup} has no packed form, whose kernel interpolates; draw it by `backends.numba.tree.nearest`")

    tree = _in_order(tree)
    cells = np.argwhere(tree.brick_index >= 0)
    place = np.empty(cells.shape, np.int32)
    place[tree.brick_index[tree.brick_index >= 0]] = cells
    live = np.zeros((len(place), ((tree.brick + 2) ** 3 + 63) // 64), np.int64)
    _live(place, tree.brick, tree.brick_index, tree.voxel_index, tree.density_values, live)
    full = tree.brick_index >= 0
    full[full] = np.asarray(live.any(axis=1))[tree.brick_index[full]]
    harmonics = tree.harmonics
    if isinstance(harmonics, PaletteHarmonics):
        palette = np.zeros((harmonics.palette.shape[1], harmonics.palette.shape[0], 4), np.float32)
        palette[..., 1:] = harmonics.palette.swapaxes(0, 1)
        coded = np.empty((0, harmonics.count, 3), np.float32), harmonics.base, harmonics.base_table, harmonics.codes, palette, harmonics.group_of
    else:
        none = np.empty((0, 3), np.uint8), np.empty((0, 3), np.float32), np.empty((0, 0), np.uint8), np.empty((0, 0, 4), np.float32), np.empty(0, np.int64)
        coded = np.ascontiguousarray(harmonics, np.float32), *none
    return Packed(leaps(full), live, _stored(tree.voxel_index), place, tree.brick_index, tree.voxel_index, tree.density_values, *coded, _slope(tree))
