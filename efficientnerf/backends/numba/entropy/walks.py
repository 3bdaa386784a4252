"""In which order the tensors of the layout `packed` are coded, and the context of each symbol: one walk for reading and writing.

Values of what was coded before predict what follows: those of the cells or voxels one step back along x, y and z, which always come first.
FORMAT.md, section 14. A walk goes on from item `begin` of each slice to its item `end`, on all cores.

B bricks, N stored voxels, b voxels along a side of a brick, S slices, G groups of harmonics.
"""

import numpy as np

from efficientnerf.backends.numba.entropy.rans import coded, digits, slice_of
from efficientnerf.backends.numba.runtime import PRANGE, numba
from efficientnerf.backends.numba.vector.memory import hold, pointer

BIT_CONTEXTS = 128  # which of seven neighbours are set
DENSITY_CONTEXTS = 33
BASE_CONTEXTS = 8 + 64 + 64  # green; red; blue
REPEAT_CONTEXTS, CODE_CONTEXTS, LOW_CONTEXTS = 7 * 16, 10 * 16, 256  # of a group: whether a code is a neighbour's; its leading byte; the other one
NEW = 3  # symbol: the code of no neighbour


@numba.njit(cache=True, error_model="numpy")
def walk_cells(coder, cells, begin, end):
    """Planes `begin` to `end` of a grid along x, in a stream of one slice.

    cells  (X + 1, Y + 1, Z + 1) uint8, 1 where one is occupied; the first plane, row and column are 0
    """
    one, at, failed = slice_of(coder, 0), coder.at[0], coder.failed[0]
    _, ny, nz = cells.shape
    for x in range(begin + 1, end + 1):
        for y in range(1, ny):
            for z in range(1, nz):
                a, b, c = cells[x - 1, y, z], cells[x, y - 1, z], cells[x, y, z - 1]
                d, e, f, g = cells[x - 1, y - 1, z], cells[x - 1, y, z - 1], cells[x, y - 1, z - 1], cells[x - 1, y - 1, z - 1]
                context = a | b << 1 | c << 2 | d << 3 | e << 4 | f << 5 | g << 6
                value, at, lacking = coded(one, 0, context, cells[x, y, z], at, 2)
                failed |= lacking
                cells[x, y, z] = value
    coder.at[0], coder.failed[0] = at, failed


@numba.njit
def _walk_masks(coder, s, stored, before, border, inner, b, begin, end):
    one, at, failed = slice_of(coder, s), coder.at[s], coder.failed[s]
    cube, side, plane = stored.shape[1], b + 1, (b + 1) * (b + 1)
    room = np.zeros(side * plane, np.uint8)
    near, voxels, bricks, places, own = pointer(room), pointer(stored), pointer(before), pointer(border), pointer(inner)
    for n in range(begin, end):
        for m in range(len(border)):
            brick = np.int64(bricks[8 * n + places[3 * m + 1]])
            near[places[3 * m]] = voxels[max(brick, 0) * cube + places[3 * m + 2]] & np.uint8(brick >= 0)
        for v in range(cube):
            p = np.int64(own[v])
            context = np.int64(near[p - plane]) | np.int64(near[p - side]) << 1 | np.int64(near[p - 1]) << 2
            context |= np.int64(near[p - plane - side]) << 3 | np.int64(near[p - plane - 1]) << 4
            context |= np.int64(near[p - side - 1]) << 5 | np.int64(near[p - plane - side - 1]) << 6
            value, at, lacking = coded(one, 0, context, voxels[n * cube + v], at, 2)
            failed |= lacking
            near[p] = value
            voxels[n * cube + v] = value
    hold((room,))
    coder.at[s], coder.failed[s] = at, failed


@numba.njit(cache=True, parallel=PRANGE, error_model="numpy")
def walk_masks(coder, stored, before, border, inner, b, first, begin, end):
    """Voxels of bricks.

    stored  (B, b^3) uint8, 1 where a voxel is
    before  (B, 8) int32: the brick that lies one cell back along x (4), y (2) and z (1), by the sum of these; -1 where none does, or one of another slice
    border  (M, 3) int32: places beside a brick: where in a cube of side b + 1, of which column of `before`, and which voxel of that brick
    inner   (b^3,) int32: where in that cube the brick's own voxels are
    first   (S + 1,) int64: bricks of the slices
    """
    for s in numba.prange(len(first) - 1):
        _walk_masks(coder, s, stored, before, border, inner, b, min(first[s] + begin, first[s + 1]), min(first[s] + end, first[s + 1]))


@numba.njit(inline="always")
def _slot(p, q, r, b):
    return (p * b + q) * b + r


@numba.njit(cache=True, parallel=PRANGE, error_model="numpy")
def find_neighbours(index, before, b, neighbours, begin, end):
    """Voxels one step back along x, y and z from those of bricks `begin` to `end`: neighbours (N, 3) int32, -1 where none is stored.

    index  (B, b^3) int32: numbers of the stored voxels
    """
    for n in numba.prange(begin, end):
        for p in range(b):
            for q in range(b):
                for r in range(b):
                    voxel = index[n, _slot(p, q, r, b)]
                    if voxel < 0:
                        continue
                    for axis in range(3):
                        i, j, k = p - (axis == 0), q - (axis == 1), r - (axis == 2)
                        brick = n
                        if i < 0 or j < 0 or k < 0:
                            brick = before[n, 4 >> axis]
                        neighbours[voxel, axis] = -1 if brick < 0 else index[brick, _slot(i % b, j % b, k % b, b)]


@numba.njit(inline="always")
def near_voxels(neighbours, n):
    """How many neighbours voxel n has, and which, those that are there first; the first of them stands for those that are not, and n itself for none."""
    i, j, k = np.int64(neighbours[3 * n]), np.int64(neighbours[3 * n + 1]), np.int64(neighbours[3 * n + 2])
    x, y, z = i >= 0, j >= 0, k >= 0
    count = np.int64(x) + np.int64(y) + np.int64(z)
    a = i if x else j if y else k if z else n
    second = j if x and y else k
    return count, a, second if count > 1 else a, k if count > 2 else a


@numba.njit(inline="always")
def _mean(total, count):
    """Sums below 2^16 of 0 to 3 values, divided by how many and rounded down; 0 of none."""
    return (total * (131072 if count == 1 else 65536 if count == 2 else 43691 if count == 3 else 0)) >> 17


@numba.njit(inline="always")
def _sum(count, a, b, c):
    """Of the values that are there."""
    return a * np.int64(count > 0) + b * np.int64(count > 1) + c * np.int64(count > 2)


@numba.njit(inline="always")
def density_context(codes, neighbours, n, entries):
    count, p, q, r = near_voxels(neighbours, n)
    mean = _mean(_sum(count, np.int64(codes[p]), np.int64(codes[q]), np.int64(codes[r])), count)
    return np.int64(count > 0) * (1 + min(32 * mean // entries, 31))


@numba.njit
def _walk_densities(coder, s, codes, neighbours, entries, begin, end):
    one, at, failed = slice_of(coder, s), coder.at[s], coder.failed[s]
    values, near, length = pointer(codes), pointer(neighbours), np.uint32(entries)
    for n in range(begin, end):
        value, at, lacking = coded(one, 0, density_context(values, near, n, np.int64(length)), values[n], at, 0)
        failed |= lacking
        values[n] = value
    coder.at[s], coder.failed[s] = at, failed


@numba.njit(cache=True, parallel=PRANGE, error_model="numpy")
def walk_densities(coder, codes, neighbours, entries, first, begin, end):
    """Codes (N,) uint8 into a table of so many entries.

    first  (S + 1,) int64: voxels of the slices
    """
    for s in numba.prange(len(first) - 1):
        _walk_densities(coder, s, codes, neighbours, entries, min(first[s] + begin, first[s + 1]), min(first[s] + end, first[s + 1]))


@numba.njit(inline="always")
def _predicted(codes, count, p, q, r, channel):
    """Mean of the neighbours' codes, and the class of how far they lie apart: 0 without neighbours, else 1 to 7."""
    a, b, c = np.int64(codes[3 * p + channel]), np.int64(codes[3 * q + channel]), np.int64(codes[3 * r + channel])
    apart = max(a, b, c) - min(a, b, c)
    return _mean(_sum(count, a, b, c), count), np.int64(count > 0) * (1 + min(digits(apart), 6))


@numba.njit(inline="always")
def base_prediction(codes, neighbours, entries, n, channel):
    """What a voxel's code of a channel is predicted to be, and its context. Green (1) comes first; how far it is from its prediction corrects the others."""
    count, p, q, r = near_voxels(neighbours, n)
    predicted, spread = _predicted(codes, count, p, q, r, channel)
    if channel == 1:
        return predicted, spread
    green, _ = _predicted(codes, count, p, q, r, 1)
    difference = np.int64(codes[3 * n + 1]) - green
    return min(max(predicted + difference, 0), entries - 1), 8 + 32 * channel + 8 * spread + min(digits(abs(difference)), 7)


@numba.njit(forceinline=True)
def _base(one, lane, codes, neighbours, entries, n, channel, at):
    """The code of a channel of a voxel; where the slice goes on, and 1 if words ran out."""
    predicted, context = base_prediction(codes, neighbours, entries, n, channel)
    symbol, at, lacking = coded(one, lane, context, (np.int64(codes[3 * n + channel]) - predicted) & 255, at, 0)
    codes[3 * n + channel] = (predicted + symbol) & 255
    return at, lacking


@numba.njit
def _walk_bases(coder, s, codes, neighbours, entries, begin, end):
    one, at, failed = slice_of(coder, s), coder.at[s], coder.failed[s]
    values, near = pointer(codes), pointer(neighbours)
    for n in range(begin, end):
        at, lacking = _base(one, 0, values, near, entries, n, 1, at)
        failed |= lacking
        at, lacking = _base(one, 1, values, near, entries, n, 0, at)
        failed |= lacking
        at, lacking = _base(one, 2, values, near, entries, n, 2, at)
        failed |= lacking
    coder.at[s], coder.failed[s] = at, failed


@numba.njit(cache=True, parallel=PRANGE, error_model="numpy")
def walk_bases(coder, codes, neighbours, entries, first, begin, end):
    """Codes (N, 3) uint8: of each voxel green, then red, then blue, each of which has a lane.

    first  (S + 1,) int64: voxels of the slices
    """
    for s in numba.prange(len(first) - 1):
        _walk_bases(coder, s, codes, neighbours, entries, min(first[s] + begin, first[s + 1]), min(first[s] + end, first[s + 1]))


@numba.njit(inline="always")
def known_codes(count, a, b, c, shift):
    """Of the codes of the neighbours that are there: how many are different, the second of these, in which of seven ways they agree, and the class of their
    leading bytes' lengths."""
    apart = np.int64(b != a)
    kinds = np.int64(count > 0) * (1 + apart + np.int64(c != a and c != b))
    agreement = count + 2 * np.int64(kinds == 2) + 3 * np.int64(kinds == 3)  # 0; 1 to 3; 4 and 5; 6
    lengths = _sum(count, digits(a >> shift), digits(b >> shift), digits(c >> shift))
    return kinds, b if apart else c, agreement, np.int64(count > 0) + _mean(lengths, count)


@numba.njit(inline="always")
def newness(leading):
    """Class of a code that is none of its neighbours', 1 to 3."""
    return 1 + np.int64(leading >= 8) + np.int64(leading >= 64)


@numba.njit
def _walk_codes(coder, s, codes, neighbours, densities, quarters, shift, begin, end):
    one, at, failed = slice_of(coder, s), coder.at[s], coder.failed[s]
    groups = codes.shape[1]
    each = REPEAT_CONTEXTS + CODE_CONTEXTS + (LOW_CONTEXTS if shift else 0)
    values, near, density, quarter = pointer(codes), pointer(neighbours), pointer(densities), pointer(quarters)
    for n in range(begin, end):
        count, p, q, r = near_voxels(near, n)
        beside = np.int64(quarter[density[n]])
        situation = beside
        for g in range(groups):
            a, b, c = np.int64(values[p * groups + g]), np.int64(values[q * groups + g]), np.int64(values[r * groups + g])
            kinds, second, agreement, length = known_codes(count, a, b, c, shift)
            value = np.int64(values[n * groups + g])
            symbol = NEW
            if not coder.reads:
                symbol = NEW if kinds == 0 else 0 if value == a else 1 if value == second and kinds > 1 else 2 if value == c and kinds > 2 else NEW
            o = each * g
            symbol, at, lacking = coded(one, g, o + 16 * agreement + situation, symbol, at, 4)
            failed |= lacking | (np.int64(symbol >= kinds) & np.int64(symbol != NEW))  # names no neighbour
            if symbol == NEW:
                leading, at, lacking = coded(one, g, o + REPEAT_CONTEXTS + 16 * length + situation, value >> shift, at, 0)
                failed |= lacking
                situation = 4 * newness(leading) + beside
                value = leading
                if shift:
                    low, at, lacking = coded(one, g, o + REPEAT_CONTEXTS + CODE_CONTEXTS + leading, np.int64(values[n * groups + g]) & 255, at, 0)
                    failed |= lacking
                    value = leading << 8 | low
            else:
                value = a if symbol == 0 else second if symbol == 1 else c
                situation = beside
            values[n * groups + g] = value
    coder.at[s], coder.failed[s] = at, failed


@numba.njit(cache=True, parallel=PRANGE, error_model="numpy")
def walk_codes(coder, codes, neighbours, densities, quarters, shift, first, begin, end):
    """Codes (N, G) of the groups of each voxel, each of which has a lane: whether one is that of a neighbour, and which if not.

    densities  (N,) uint8 codes; quarters (256,) uint8: the quarter of the table that each lies in
    shift      8 for codes of two bytes, 0 for those of one: a code's leading byte is what is left above
    first      (S + 1,) int64: voxels of the slices
    """
    for s in numba.prange(len(first) - 1):
        _walk_codes(coder, s, codes, neighbours, densities, quarters, shift, min(first[s] + begin, first[s + 1]), min(first[s] + end, first[s + 1]))
