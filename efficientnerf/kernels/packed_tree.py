"""A tree laid out for the marching kernel, made once from whatever the tree keeps in memory.

Marching reads densities far more often than anything else, at points whose eight voxels lie in up to eight bricks. So every brick gets a block
of its own densities and of the one layer around them, (b + 2)^3 values side by side: no lookup leaves the block. Where all eight voxels of
an interpolation are zero the density at its low corner is -0.0, which adds up as zero does and says that the other seven need not be read.

A second block says where the harmonics of the same voxels lie. Floats become 16-bit whole numbers with a scale to each
voxel, one cache line to a voxel at degree 2. So do codes into palettes in a tree of moderate size; in a large one they are read as the tree keeps
them, which takes about twice as long and a fifth of the memory: a table says which bricks lie around a brick, and there is no second block.

B bricks, N stored voxels, K harmonics, G groups of a palette; b = brick.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numba
import numpy as np

if TYPE_CHECKING:
    from efficientnerf.nerftree.tree import NerfTree

LANES = 16  # coefficients are padded to multiples of it: what the widest vectors hold
LEVELS = 32767
DECODED = 2**18  # voxels whose harmonics are floats at a time
ROWS_LIMIT = 128 * 2**20  # bytes: palettes are decoded into rows, which are read faster, where those take no more


class Packed(NamedTuple):
    """See the module. The harmonics are either in `sh` and `scale` or in the four arrays after them; the others are empty.

    cell     (X, Y, Z) int32: the brick of a coarse cell, or -1 - leap where it is empty
    density  (B, (b + 2)^3) float32, per world unit; local voxel (i, j, k) is voxel (i - 1, j - 1, k - 1) of the brick
    around   (B, 27) int32: the bricks at (-1, -1, -1), (-1, -1, 0), ... (1, 1, 1) of a brick, -1 where the cell there is empty
    voxel    (B, (b + 2)^3) int32: which row of sh, N where nothing is stored; with codes the tree's own `voxel_index`
    sh       (N + 1, P) int16: coefficient k of channel c at 3 k + c, padded with zeros; the last row is zeros
    scale    (N + 1,) float32: coefficient = sh * scale
    base, base_table, codes, palette  as in PaletteHarmonics: the tree's own
    column   (K - 1,) int64: which of a voxel's codes each harmonic above the base goes by
    """

    cell: np.ndarray
    density: np.ndarray
    around: np.ndarray
    voxel: np.ndarray
    sh: np.ndarray
    scale: np.ndarray
    base: np.ndarray
    base_table: np.ndarray
    codes: np.ndarray
    palette: np.ndarray
    column: np.ndarray

    @property
    def nbytes(self) -> int:
        """Of the arrays that are not the tree's own."""
        own = (self.cell, self.density, self.around, self.sh, self.scale)
        return sum(part.nbytes for part in own) + (0 if len(self.codes) else self.voxel.nbytes)

    @property
    def colour_bytes(self) -> int:
        """What a voxel's harmonics take."""
        return 3 + self.codes.shape[1] * self.codes.itemsize if len(self.codes) else self.sh.shape[1] * self.sh.itemsize + self.scale.itemsize


def padded_coefficients(degree: int) -> int:
    """P of a degree: coefficients of a voxel, padded."""
    return -(-3 * (degree + 1) ** 2 // LANES) * LANES


@numba.njit(cache=True, parallel=True, error_model="numpy")
def _fill(cells, brick, brick_index, voxel_index, values, density, around, voxel):  # type: ignore[no-untyped-def]
    """Blocks and neighbours of the bricks; cells (B, 3) says where each brick lies; voxel may be empty."""
    side = brick + 2
    for owner in numba.prange(len(cells)):
        for n in range(27):
            a, e, c = cells[owner, 0] + n // 9 - 1, cells[owner, 1] + n // 3 % 3 - 1, cells[owner, 2] + n % 3 - 1
            inside = 0 <= a < brick_index.shape[0] and 0 <= e < brick_index.shape[1] and 0 <= c < brick_index.shape[2]
            around[owner, n] = brick_index[a, e, c] if inside else -1
        for i in range(side):
            for j in range(side):
                for k in range(side):
                    # The neighbour and the voxel of it: 0, 1 or 2 along each axis.
                    p, q, r = (i + brick - 1) // brick, (j + brick - 1) // brick, (k + brick - 1) // brick
                    there = around[owner, (p * 3 + q) * 3 + r]
                    value, index = np.float32(0), np.int32(-1)
                    if there >= 0:
                        x, y, z = i - 1 - (p - 1) * brick, j - 1 - (q - 1) * brick, k - 1 - (r - 1) * brick
                        index = voxel_index[there, (x * brick + y) * brick + z]
                        value = values[index] if index >= 0 else value
                    density[owner, (i * side + j) * side + k] = value
                    if len(voxel) > 0:
                        voxel[owner, (i * side + j) * side + k] = index if index >= 0 else len(values)
        for i in range(side - 1):
            for j in range(side - 1):
                for k in range(side - 1):
                    at = (i * side + j) * side + k
                    idle = True
                    for n in range(8):
                        if density[owner, at + (n >> 2) * side * side + ((n >> 1) & 1) * side + (n & 1)] > 0:
                            idle = False
                    if idle:
                        density[owner, at] = np.float32(-0.0)


@numba.njit(cache=True, parallel=True, error_model="numpy")
def _quantise(values, sh, scale):  # type: ignore[no-untyped-def]
    """Rows of (n, K, 3) float32 to whole numbers and their scales."""
    for n in numba.prange(len(values)):
        most = np.float32(0)
        for k in range(values.shape[1]):
            for c in range(3):
                most = max(most, abs(values[n, k, c]))
        scale[n] = most / np.float32(LEVELS)
        if most > 0:
            for k in range(values.shape[1]):
                for c in range(3):
                    sh[n, 3 * k + c] = np.int16(np.rint(values[n, k, c] / most * np.float32(LEVELS)))


def pack(tree: NerfTree) -> Packed:
    """The packed form of a tree; see the module. ValueError where the tree is not interpolated, as the kernel that reads it does."""
    from efficientnerf.nerftree.palettes import PaletteHarmonics

    if tree.lookup != "trilinear":
        raise ValueError(f"a tree of lookup {tree.lookup} has no packed form, whose kernel interpolates; draw it by `efficientnerf.kernels.cpu_nearest`")

    brick = tree.brick
    cells = np.argwhere(tree.brick_index >= 0)
    place = np.empty_like(cells)
    place[tree.brick_index[tree.brick_index >= 0]] = cells
    cell = np.where(tree.brick_index >= 0, tree.brick_index, -1 - tree.leap.astype(np.int32)).astype(np.int32)
    width, harmonics, count = padded_coefficients(tree.degree), tree.harmonics, len(tree.density_values)
    blocks = (len(cells), (brick + 2) ** 3)
    density, around = np.empty(blocks, np.float32), np.empty((len(cells), 27), np.int32)
    if isinstance(harmonics, PaletteHarmonics) and count * (2 * width + 4) > ROWS_LIMIT:
        _fill(place, brick, tree.brick_index, tree.voxel_index, tree.density_values, density, around, np.empty((0, 0), np.int32))
        coded = harmonics.base, harmonics.base_table, harmonics.codes, harmonics.palette, harmonics.group_of
        return Packed(cell, density, around, tree.voxel_index, np.empty((0, width), np.int16), np.empty(0, np.float32), *coded)
    voxel = np.empty(blocks, np.int32)
    _fill(place, brick, tree.brick_index, tree.voxel_index, tree.density_values, density, around, voxel)
    sh, scale = np.zeros((count + 1, width), np.int16), np.zeros(count + 1, np.float32)
    for begin in range(0, count, DECODED):  # floats of all voxels at once may be more than all the rest
        block = slice(begin, min(count, begin + DECODED))
        _quantise(np.ascontiguousarray(tree.coefficients(block), np.float32), sh[block], scale[block])
    none = np.empty((0, 3), np.uint8), np.empty((0, 3), np.float32), np.empty((0, 0), np.uint8), np.empty((0, 0, 3), np.float32), np.empty(0, np.int64)
    return Packed(cell, density, around, voxel, sh, scale, *none)
