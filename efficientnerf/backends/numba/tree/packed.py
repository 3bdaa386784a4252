"""The packed form of a tree for the marching kernel, beside the tree's own arrays: made once, a few bytes a voxel.

To the kernel a brick is empty if neither its voxels nor those around it have density. Voxels have a packed order, in which those that are neighbours along z
lie beside each other: see `efficientnerf.backends.numba.tree.packets.rows`.

L cascades, C coarse cells of all of them, B bricks, N stored voxels, K harmonics, P entries of a palette; b = brick.
"""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from efficientnerf.asset import cascades
from efficientnerf.asset.cascades import cascades_of
from efficientnerf.asset.palettes import PaletteHarmonics
from efficientnerf.asset.tree import NerfTree
from efficientnerf.backends.numba.runtime import PRANGE, numba
from efficientnerf.backends.numba.tree.leaps import leaps, octant_leaps
from efficientnerf.backends.numba.tree.packets.rows import MOST_SIDE, fill_rows, order_voxels
from efficientnerf.rendering.harmonics import squared_slopes

SLOPE_VOXELS = 2**16  # voxels that `colour_slope` is estimated from
FEWEST_PAIRS = 64  # of neighbours, for what they share to be estimated
COLUMN_CELLS_PER_CALL = 2**22  # cells that one call of the kernel that orders voxels goes through
MOST_COORDINATES = 2**16  # numbers of two bytes
MOST_OCTANT_BYTES = 2**27
MOST_BITS = 2**32  # numbers of a row's word
VOXELS_PER_CALL = 2**23  # of bricks that one call of a kernel goes through, so that signals are answered between


class Packed(NamedTuple):
    """See the module. The harmonics are either in `sh` or in the four arrays after it; the others are empty.

    grids         (L, 4) int64: coarse cells of a cascade along x, y, z, and which of all cells is its first
    places        (L, 4) float64: side of its voxels and that of cascade 0's, divided; and what is added to voxel coordinates of cascade 0, so divided, to have
                  those of the cascade
    leap          (C,) uint8: as `NerfTree.leap`, but bricks without density in or around them count as empty, and so do those in the box of the cascade before
    octants       (8 C,) uint8: of each cascade `leaps.octant_leaps` of the same cells; empty where that would be more than MOST_OCTANT_BYTES
    has_density   (B, W) int64 bit masks: bit n % 64 of word n // 64 is set where any of the eight voxels has density that begin at voxel
                  (i - 1, j - 1, k - 1) of the brick; n = (i (b + 2) + j) (b + 2) + k
    rows          (B, (b + 2)^2) int32: the first voxel, in the packed order, and the mask of the stored ones of the rows along z of a brick and of the layer
                  around it, in the lowest b + 2 bits; (B, 2 (b + 2)^2), the voxel and then the mask, where the voxels are too many for the other bits
    voxel_of      (N + 1,) int32: which stored voxel is n-th in the packed order; the last is none
    coordinates   (3, N + 16) uint16, int32 for a grid of more voxels along a side: where it lies in its cascade; the last sixteen are none
    first_voxel   (L + 1,) int64: the first voxel of each cascade in that order, and N
    cells         (B, 3) int32: the coarse cell of a brick
    brick_index   (C,) int32: those of the cascades
    density       (N + 1,) float32, in the packed order; the last, of what is not stored, is 0
    sh            (N, K, 3) float32: the tree's own
    base, codes   as in PaletteHarmonics, in the packed order
    base_table    as in PaletteHarmonics: the tree's own
    palette       (K - 1, P, 4) float32: the tree's, with a zero before red
    code_columns  (K - 1,) int64: which of a voxel's codes selects the entry of each harmonic above degree 0
    colour_slope  (L,) float64, view dependence: mean over voxels of the change of colour before the sigmoid, at most of the three channels, per radian of the
                  direction, root mean square over directions
    """

    grids: np.ndarray
    places: np.ndarray
    leap: np.ndarray
    octants: np.ndarray
    has_density: np.ndarray
    rows: np.ndarray
    voxel_of: np.ndarray
    coordinates: np.ndarray
    first_voxel: np.ndarray
    cells: np.ndarray
    brick_index: np.ndarray
    density: np.ndarray
    sh: np.ndarray
    base: np.ndarray
    base_table: np.ndarray
    codes: np.ndarray
    palette: np.ndarray
    code_columns: np.ndarray
    colour_slope: np.ndarray

    @property
    def nbytes(self) -> int:
        """Of the arrays beside the tree's own, but for the smallest."""
        own = self.leap, self.octants, self.has_density, self.rows, self.voxel_of, self.coordinates, self.cells, self.density
        return sum(array.nbytes for array in (*own, self.base, self.codes, self.palette))


@numba.njit(cache=True, error_model="numpy")
def _block_has_density(owner, cells, brick, brick_index, voxel_index, values, dense):
    """Whether a brick's voxels, and those in the layer around them, have density, into (b + 2, b + 2, b + 2) uint8."""
    dense[:] = 0
    for n in range(27):
        p, q, r = n // 9, n // 3 % 3, n % 3
        a, e, c = cells[owner, 0] + p - 1, cells[owner, 1] + q - 1, cells[owner, 2] + r - 1
        if not (0 <= a < brick_index.shape[0] and 0 <= e < brick_index.shape[1] and 0 <= c < brick_index.shape[2]):
            continue
        neighbour = brick_index[a, e, c]
        if neighbour < 0:
            continue
        # Of a neighbour only the layer that faces the brick.
        for x in range(brick - 1 if p == 0 else 0, 1 if p == 2 else brick):
            for y in range(brick - 1 if q == 0 else 0, 1 if q == 2 else brick):
                for z in range(brick - 1 if r == 0 else 0, 1 if r == 2 else brick):
                    voxel = voxel_index[neighbour, (x * brick + y) * brick + z]
                    if voxel >= 0 and values[voxel] > 0:
                        dense[x + 1 + (p - 1) * brick, y + 1 + (q - 1) * brick, z + 1 + (r - 1) * brick] = 1


@numba.njit(cache=True, parallel=PRANGE, error_model="numpy")
def _has_density(first, end, cells, brick, brick_index, voxel_index, values, out):
    """`Packed.has_density` of bricks first <= B < end into `out`, which is zero."""
    side = brick + 2
    for task in numba.prange((end - first + 255) // 256):
        dense = np.empty((side, side, side), np.uint8)
        for owner in range(first + 256 * task, min(end, first + 256 * task + 256)):
            _block_has_density(owner, cells, brick, brick_index, voxel_index, values, dense)
            # Maximum over a voxel and its successor, one axis after the other.
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


def brick_ranges(first: int, end: int, brick: int) -> Iterator[tuple[int, int]]:
    """First brick and end of ranges of about VOXELS_PER_CALL voxels, of bricks `first` to `end`."""
    each = max(256, VOXELS_PER_CALL // brick**3)
    return ((begin, min(end, begin + each)) for begin in range(first, end, each))


def _slope(coefficients: np.ndarray, degree: int) -> float:
    """Mean over voxels (N, K, 3) of the change of colour before the sigmoid per radian, see `Packed.colour_slope`."""
    return float(np.sqrt(np.einsum("nkc,nkc,k->nc", coefficients, coefficients, squared_slopes(degree))).max(axis=1).mean())


def _colour_slope(tree: NerfTree, first: int, end: int) -> float:
    """`Packed.colour_slope` of the voxels of bricks first <= B < end, from a regular subset of them.

    Of nested grids the part of it that neighbours do not share: what they share is reproduced by the interpolation between them.
    """
    voxels = tree.voxel_index[first:end]
    stored = voxels[voxels >= 0]
    if not len(stored) or tree.degree == 0:
        return 0.0
    slope = _slope(tree.coefficients(stored[:: -(-len(stored) // SLOPE_VOXELS)]), tree.degree)
    if not tree.outer:
        return slope
    each = max(1, SLOPE_VOXELS // tree.brick**2)
    rows = voxels[:: -(-len(voxels) // each)].reshape(-1, tree.brick)
    pairs = np.stack([rows[:, :-1], rows[:, 1:]], axis=-1).reshape(-1, 2)  # neighbours along z
    pairs = pairs[(pairs >= 0).all(axis=1)]
    if len(pairs) < FEWEST_PAIRS or slope == 0:
        return slope
    apart = _slope((tree.coefficients(pairs[:, 0]) - tree.coefficients(pairs[:, 1])) / np.float32(2**0.5), tree.degree)
    return apart * min(1.0, apart / slope)  # docs/experiments/renderer.md


def packed_of(tree: NerfTree) -> Packed:
    """The packed form of a tree, made once."""
    if "packed" not in tree.derived:
        tree.derived["packed"] = pack(tree)
    return tree.derived["packed"]


def bricks_of(tree: NerfTree) -> list[tuple[int, int]]:
    """First brick and end of each cascade."""
    return cascades.brick_ranges(tree) if tree.outer else [(0, len(tree.voxel_index))]


def _places(tree: NerfTree) -> tuple[np.ndarray, np.ndarray]:
    """`Packed.grids` and `Packed.places`."""
    cascades = cascades_of(tree)
    count = [int(np.prod(cascade.shape)) for cascade in cascades]
    grids = [[*cascade.shape, sum(count[:n])] for n, cascade in enumerate(cascades)]
    places = [[cascade.voxel / tree.voxel, *(tree.bounds_min - cascade.bounds_min) / cascade.voxel] for cascade in cascades]
    return np.array(grids, np.int64), np.array(places, np.float64)


def _pack_cascade(tree: NerfTree, number: int, cells: np.ndarray, has_density: np.ndarray) -> np.ndarray:
    """Fills in a cascade's rows of `Packed.cells` and `Packed.has_density`, the latter zero before; returns which of its cells are not empty, (X, Y, Z)."""
    cascades, (first, end) = cascades_of(tree), bricks_of(tree)[number]
    cascade = cascades[number]
    occupied = np.flatnonzero(cascade.brick_index.reshape(-1) >= 0)
    cells[cascade.brick_index.reshape(-1)[occupied]] = np.stack(np.unravel_index(occupied, cascade.shape), axis=1)
    for begin, stop in brick_ranges(first, end, tree.brick):
        _has_density(begin, stop, cells, tree.brick, cascade.brick_index, tree.voxel_index, tree.density_values, has_density)
    full = np.zeros(cascade.shape, bool)
    full[tuple(cells[first:end][has_density[first:end].any(axis=1)].T)] = True
    if number:  # no sample lies in the box of the cascade before
        inner = np.round((cascades[number - 1].bounds(tree.brick) - cascade.bounds_min) / (cascade.voxel * tree.brick)).astype(int)
        full[tuple(slice(*side) for side in inner.T)] = False
    return full


def _rows(tree: NerfTree, cells: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """`Packed.rows`, `Packed.voxel_of`, `Packed.coordinates` and `Packed.first_voxel`."""
    if tree.brick + 2 > MOST_SIDE:
        raise ValueError(f"bricks of {tree.brick} voxels along a side; at most {MOST_SIDE - 2} are rendered")
    bricks, count = len(tree.voxel_index), len(tree.density_values)
    if max(2 * bricks * (tree.brick + 2) ** 2, count, sum(cascade.brick_index.size for cascade in cascades_of(tree))) >= 2**31:
        raise ValueError(f"{bricks} bricks of {tree.brick} voxels along a side: more than the CPU's kernels can number")
    begin, stored = np.empty((bricks, tree.brick**2), np.int32), np.empty((bricks, tree.brick**2), np.int32)
    words = 1 if count <= MOST_BITS >> tree.brick + 2 else 2
    rows, voxel_of = np.empty((bricks, words * (tree.brick + 2) ** 2), np.int32), np.full(count + 1, -1, np.int32)
    widest = tree.brick * max(max(cascade.shape) for cascade in cascades_of(tree))
    coordinates, first_voxel = np.zeros((3, count + 16), np.uint16 if widest <= MOST_COORDINATES else np.int32), [0]
    for cascade, ends in zip(cascades_of(tree), bricks_of(tree), strict=True):
        columns, each, voxel = cascade.shape[0] * cascade.shape[1], max(1, COLUMN_CELLS_PER_CALL // max(1, cascade.shape[2])), first_voxel[-1]
        for first in range(0, columns, each):
            last = min(columns, first + each)
            voxel = order_voxels(first, last, voxel, tree.brick, cascade.brick_index, tree.voxel_index, begin, stored, voxel_of, coordinates)
        first_voxel.append(voxel)
        for first, end in brick_ranges(*ends, tree.brick):
            fill_rows(first, end, cells, tree.brick, cascade.brick_index, begin, stored, rows)
    return rows, voxel_of, coordinates, np.array(first_voxel, np.int64)


def pack(tree: NerfTree) -> Packed:
    """The packed form of a tree; ValueError for nearest lookup, since the kernel that reads it interpolates."""
    if tree.lookup != "trilinear":
        raise ValueError(f"a tree of lookup {tree.lookup} has no packed form, whose kernel interpolates; render it by `backends.numba.tree.nearest`")

    bricks = bricks_of(tree)
    cells = np.empty((len(tree.voxel_index), 3), np.int32)
    has_density = np.zeros((len(cells), ((tree.brick + 2) ** 3 + 63) // 64), np.int64)
    full = [_pack_cascade(tree, n, cells, has_density) for n in range(len(bricks))]
    leap, directed = [leaps(cells).reshape(-1) for cells in full], 8 * sum(cells.size for cells in full) <= MOST_OCTANT_BYTES
    octants = np.concatenate([octant_leaps(cells).reshape(-1) for cells in full]) if directed else np.empty(0, np.uint8)
    brick_index = [cascade.brick_index.reshape(-1) for cascade in cascades_of(tree)]
    harmonics, order = tree.harmonics, _rows(tree, cells)
    voxel_of = order[1]
    if isinstance(harmonics, PaletteHarmonics):
        palette = np.zeros((harmonics.palette.shape[1], harmonics.palette.shape[0], 4), np.float32)
        palette[..., 1:] = harmonics.palette.swapaxes(0, 1)
        held = harmonics.subset(voxel_of[:-1])
        coded = np.empty((0, harmonics.count, 3), np.float32), held.base, held.base_table, held.codes, palette, harmonics.group_of
    else:
        none = np.empty((0, 3), np.uint8), np.empty((0, 3), np.float32), np.empty((0, 0), np.uint8), np.empty((0, 0, 4), np.float32), np.empty(0, np.int64)
        coded = np.ascontiguousarray(harmonics, np.float32), *none
    density = np.zeros(len(voxel_of), np.float32)
    density[:-1] = tree.density_values[voxel_of[:-1]]
    slopes = [_colour_slope(tree, *ends) for ends in bricks]
    joined = (leap[0], brick_index[0]) if len(leap) == 1 else (np.concatenate(leap), np.concatenate(brick_index))
    own = np.ascontiguousarray(joined[1]), density
    return Packed(*_places(tree), joined[0], octants, has_density, *order, cells, *own, *coded, np.array(slopes))
