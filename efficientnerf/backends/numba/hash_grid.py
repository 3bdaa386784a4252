"""Multiresolution hash encoding (Mueller et al. 2022, section 3) on the CPU (numba, all cores): forward, and the gradient of the table.

Features are stored by level, (2L, N), and points by axis, (3, N). For a block of samples, table indices and trilinear weights are computed in SIMD registers
into a small buffer; what remains is one load or one addition in the table for each corner. A thread processes all its samples level by level, so that the
part of the table in use stays in a cache; a level is prefetched in memory order, since samples access it at random and Adam evicts it.

Forward, samples are independent. Backward, a level belongs to one thread, which adds its samples in order. Results depend neither on timing nor on the
number of threads.

N samples, L levels, T table entries.
"""

import numpy as np

from efficientnerf.backends.numba.runtime import PRANGE, numba
from efficientnerf.backends.numba.vector.corners import mix_corners, spread_corners
from efficientnerf.backends.numba.vector.memory import pointer, touch

PRIME_Y, PRIME_Z = np.uint32(2654435761), np.uint32(805459861)  # Mueller et al. 2022, section 3
BLOCK = 128  # samples whose indices and weights are computed together
TRANSPOSE_BLOCK = 4096  # points per task of `transpose_points`
ENTRIES_PER_LINE = 8  # of a cache line of 64 bytes
LINES_PER_SAMPLE = 4  # cache lines of a level that a sample reads, about: corners adjacent along x mostly share one
TASK_SAMPLES = 2**15  # samples per task, at most: 32 features of as many take 4 MiB


@numba.njit(cache=True, inline="always", error_model="numpy")
def _corner_indices(points, first, count, side, begin, dense, mask, index, weight):
    """Table indices (8, BLOCK) and trilinear weights (8, BLOCK) of the corners of some points' cells; corner c = 4x + 2y + z."""
    one, next_one = np.float32(1), np.uint32(1)
    cells, top, zero = np.float32(side - 1), np.int32(side - 2), np.int32(0)
    row, start = np.uint32(side), np.uint32(begin)
    for n in range(count):
        x, y, z = points[0, first + n] * cells, points[1, first + n] * cells, points[2, first + n] * cells
        i, j, k = min(max(np.int32(x), zero), top), min(max(np.int32(y), zero), top), min(max(np.int32(z), zero), top)
        fx, fy, fz = x - np.float32(i), y - np.float32(j), z - np.float32(k)
        gx, gy, gz = one - fx, one - fy, one - fz
        a, b, c, d = gy * gz, gy * fz, fy * gz, fy * fz
        weight[0, n], weight[1, n], weight[2, n], weight[3, n] = gx * a, gx * b, gx * c, gx * d
        weight[4, n], weight[5, n], weight[6, n], weight[7, n] = fx * a, fx * b, fx * c, fx * d
        if dense:  # a level that fits in its table is indexed directly
            at = start + (np.uint32(i) * row + np.uint32(j)) * row + np.uint32(k)
            index[0, n], index[1, n], index[2, n], index[3, n] = at, at + next_one, at + row, at + row + next_one
            at = at + row * row
            index[4, n], index[5, n], index[6, n], index[7, n] = at, at + next_one, at + row, at + row + next_one
        else:
            x0, y0, z0 = np.uint32(i), np.uint32(j) * PRIME_Y, np.uint32(k) * PRIME_Z
            x1, y1, z1 = x0 + next_one, y0 + PRIME_Y, z0 + PRIME_Z
            index[0, n], index[1, n] = start + ((x0 ^ y0 ^ z0) & mask), start + ((x0 ^ y0 ^ z1) & mask)
            index[2, n], index[3, n] = start + ((x0 ^ y1 ^ z0) & mask), start + ((x0 ^ y1 ^ z1) & mask)
            index[4, n], index[5, n] = start + ((x1 ^ y0 ^ z0) & mask), start + ((x1 ^ y0 ^ z1) & mask)
            index[6, n], index[7, n] = start + ((x1 ^ y1 ^ z0) & mask), start + ((x1 ^ y1 ^ z1) & mask)


@numba.njit(cache=True, error_model="numpy")
def _prefetch_level(entries, side, dense, start, mask, samples):
    """Prefetch a level in memory order if the samples read about all of it."""
    count = side**3 if dense else np.int64(mask) + 1
    if LINES_PER_SAMPLE * samples * ENTRIES_PER_LINE >= count:
        for at in range(start, start + count, ENTRIES_PER_LINE):
            touch(entries, 2 * at)


@numba.njit(cache=True, parallel=PRANGE, error_model="numpy")
def transpose_points(points, out):
    """points (N, 3) into out (3, N)."""
    count = len(points)
    for task in numba.prange((count + TRANSPOSE_BLOCK - 1) // TRANSPOSE_BLOCK):
        for n in range(task * TRANSPOSE_BLOCK, min(count, (task + 1) * TRANSPOSE_BLOCK)):
            out[0, n], out[1, n], out[2, n] = points[n, 0], points[n, 1], points[n, 2]


@numba.njit(cache=True, parallel=PRANGE, error_model="numpy")
def _encode(points, table, sides, dense, starts, mask, tasks, out):
    samples = points.shape[1]
    task_samples, entries = (samples + tasks - 1) // tasks, pointer(table)
    for task in numba.prange(tasks):
        index, weight = np.empty((8, BLOCK), np.uint32), np.empty((8, BLOCK), np.float32)
        p_index, p_weight = pointer(index), pointer(weight)
        end = min(samples, (task + 1) * task_samples)
        for level in range(len(sides)):
            _prefetch_level(entries, sides[level], dense[level], starts[level], mask, end - task * task_samples)
            for first in range(task * task_samples, end, BLOCK):
                count = min(BLOCK, end - first)
                # `dense` is a literal in each call: the inner loops are branch-free.
                if dense[level]:
                    _corner_indices(points, first, count, sides[level], starts[level], True, mask, index, weight)
                else:
                    _corner_indices(points, first, count, sides[level], starts[level], False, mask, index, weight)
                for n in range(count):
                    a, b = mix_corners(entries, p_index, p_weight, n, BLOCK, 2)
                    out[2 * level, first + n], out[2 * level + 1, first + n] = a, b


def encode(points: np.ndarray, table: np.ndarray, sides: np.ndarray, dense: np.ndarray, starts: np.ndarray, mask: np.uint32, out: np.ndarray) -> None:
    """Multiresolution hash encoding with two features a level.

    points  (3, N) float32 in [0, 1]
    table   (T, 2) float32
    sides   (L,) resolution of each level; dense (L,) whether it is indexed directly; starts (L,) its first entry
    mask    entries of a hashed level, a power of two, less one
    out     (2L, N) float32, written
    """
    threads = numba.get_num_threads()
    tasks = threads * max(1, -(-points.shape[1] // (TASK_SAMPLES * threads)))
    _encode(points, table, sides, dense, starts, mask, tasks, out)


@numba.njit(cache=True, parallel=PRANGE, error_model="numpy")
def _encode_backward(points, grad, sides, dense, starts, mask, order, table_grad):
    samples, entries = points.shape[1], pointer(table_grad)
    for task in numba.prange(len(order)):
        level = order[task]
        index, weight = np.empty((8, BLOCK), np.uint32), np.empty((8, BLOCK), np.float32)
        p_index, p_weight = pointer(index), pointer(weight)
        _prefetch_level(entries, sides[level], dense[level], starts[level], mask, samples)
        for first in range(0, samples, BLOCK):
            count = min(BLOCK, samples - first)
            if dense[level]:
                _corner_indices(points, first, count, sides[level], starts[level], True, mask, index, weight)
            else:
                _corner_indices(points, first, count, sides[level], starts[level], False, mask, index, weight)
            for n in range(count):
                spread_corners(entries, p_index, p_weight, n, BLOCK, (grad[2 * level, first + n], grad[2 * level + 1, first + n]))


def encode_backward(
    points: np.ndarray, grad: np.ndarray, sides: np.ndarray, dense: np.ndarray, starts: np.ndarray, mask: np.uint32, table_grad: np.ndarray
) -> None:
    """Add the gradient with respect to the table, from grad (2L, N), to table_grad (T, 2), float32; the other arguments as for `encode`."""
    threads, levels = numba.get_num_threads(), np.arange(len(sides))
    # Threads take consecutive tasks. Fine levels miss the caches more often: deal coarse and fine ones to each thread.
    order = np.concatenate([levels[thread::threads] for thread in range(min(threads, len(levels)))])
    _encode_backward(points, grad, sides, dense, starts, mask, order, table_grad)
