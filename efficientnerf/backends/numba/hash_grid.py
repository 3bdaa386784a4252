"""The hash encoding on the CPU (numba, all cores): forward, and the gradient of its table.

Features lie by level and not by sample, (2L, N), and so do points, (3, N): the places and weights of a block of samples are then computed in
vector registers into a small buffer, and what is left for each corner is one load (or one addition) in the table. A thread goes through all its
samples level by level, so that the part of the table in use, 1 MiB at 2^17 entries and 4 at 2^19, stays in a cache. Adam leaves none of it there; as
samples jump about in it, the first of them would wait for memory one after the other. So a level is read once in the order of memory before.

Forward, each sample is on its own. Backward, a level belongs to one thread, and its samples are added in their order. So the bytes depend neither on
timing nor on the number of threads.
"""

from __future__ import annotations

import numpy as np

from efficientnerf.backends.numba.runtime import numba
from efficientnerf.backends.numba.simd import pointer
from efficientnerf.backends.numba.table_entries import LINE, add_to_entries, interpolated_entry, touch

PRIME_Y, PRIME_Z = np.uint32(2654435761), np.uint32(805459861)  # Mueller et al. 2022, section 3
BLOCK = 128  # samples whose places and weights are computed together
TURNED = 4096  # points of a task
LINES_TOUCHED = 4  # by a sample in a level, about: neighbours along x are mostly in one cache line
SHARE = 2**15  # samples of a task, at most: 32 features of as many take 4 MiB


@numba.njit(cache=True, inline="always", error_model="numpy")
def _places(points, first, count, side, begin, dense, mask, place, weight):  # type: ignore[no-untyped-def]
    """place (8, BLOCK) in the table and weight (8, BLOCK) of the corners round some points; corner c = 4x + 2y + z."""
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
        if dense:  # a level that fits has a place for each lattice point
            at = start + (np.uint32(i) * row + np.uint32(j)) * row + np.uint32(k)
            place[0, n], place[1, n], place[2, n], place[3, n] = at, at + next_one, at + row, at + row + next_one
            at = at + row * row
            place[4, n], place[5, n], place[6, n], place[7, n] = at, at + next_one, at + row, at + row + next_one
        else:
            x0, y0, z0 = np.uint32(i), np.uint32(j) * PRIME_Y, np.uint32(k) * PRIME_Z
            x1, y1, z1 = x0 + next_one, y0 + PRIME_Y, z0 + PRIME_Z
            place[0, n], place[1, n] = start + ((x0 ^ y0 ^ z0) & mask), start + ((x0 ^ y0 ^ z1) & mask)
            place[2, n], place[3, n] = start + ((x0 ^ y1 ^ z0) & mask), start + ((x0 ^ y1 ^ z1) & mask)
            place[4, n], place[5, n] = start + ((x1 ^ y0 ^ z0) & mask), start + ((x1 ^ y0 ^ z1) & mask)
            place[6, n], place[7, n] = start + ((x1 ^ y1 ^ z0) & mask), start + ((x1 ^ y1 ^ z1) & mask)


@numba.njit(cache=True, error_model="numpy")
def _load_level(entries, side, dense, start, mask, samples):  # type: ignore[no-untyped-def]
    """Bring a level into the caches in the order of memory, if samples touch about all of it."""
    count = side**3 if dense else np.int64(mask) + 1
    if LINES_TOUCHED * samples * LINE >= count:
        for at in range(start, start + count, LINE):
            touch(entries, 2 * at)


@numba.njit(cache=True, parallel=True, error_model="numpy")
def transpose_points(points, out):  # type: ignore[no-untyped-def]
    """Points (N, 3) as (3, N)."""
    count = len(points)
    for task in numba.prange((count + TURNED - 1) // TURNED):
        for n in range(task * TURNED, min(count, (task + 1) * TURNED)):
            out[0, n], out[1, n], out[2, n] = points[n, 0], points[n, 1], points[n, 2]


@numba.njit(cache=True, parallel=True, error_model="numpy")
def _encode(points, table, sides, dense, starts, mask, tasks, out):  # type: ignore[no-untyped-def]
    samples = points.shape[1]
    share, entries = (samples + tasks - 1) // tasks, pointer(table)
    for task in numba.prange(tasks):
        place, weight = np.empty((8, BLOCK), np.uint32), np.empty((8, BLOCK), np.float32)
        p_place, p_weight = pointer(place), pointer(weight)
        end = min(samples, (task + 1) * share)
        for level in range(len(sides)):
            _load_level(entries, sides[level], dense[level], starts[level], mask, end - task * share)
            for first in range(task * share, end, BLOCK):
                count = min(BLOCK, end - first)
                # Two calls, so that the inner loop of each is free of branches.
                if dense[level]:
                    _places(points, first, count, sides[level], starts[level], True, mask, place, weight)
                else:
                    _places(points, first, count, sides[level], starts[level], False, mask, place, weight)
                for n in range(count):
                    a, b = interpolated_entry(entries, p_place, p_weight, n, BLOCK)
                    out[2 * level, first + n], out[2 * level + 1, first + n] = a, b


def encode(points: np.ndarray, table: np.ndarray, sides: np.ndarray, dense: np.ndarray, starts: np.ndarray, mask: np.uint32, out: np.ndarray) -> None:
    """Multiresolution hash encoding with two features a level: points (3, N), table (T, 2), out (2L, N), all float32."""
    threads = numba.get_num_threads()
    tasks = threads * max(1, -(-points.shape[1] // (SHARE * threads)))
    _encode(points, table, sides, dense, starts, mask, tasks, out)


@numba.njit(cache=True, parallel=True, error_model="numpy")
def _encode_backward(points, grad, sides, dense, starts, mask, order, table_grad):  # type: ignore[no-untyped-def]
    samples, entries = points.shape[1], pointer(table_grad)
    for task in numba.prange(len(order)):
        level = order[task]
        place, weight = np.empty((8, BLOCK), np.uint32), np.empty((8, BLOCK), np.float32)
        p_place, p_weight = pointer(place), pointer(weight)
        _load_level(entries, sides[level], dense[level], starts[level], mask, samples)
        for first in range(0, samples, BLOCK):
            count = min(BLOCK, samples - first)
            if dense[level]:
                _places(points, first, count, sides[level], starts[level], True, mask, place, weight)
            else:
                _places(points, first, count, sides[level], starts[level], False, mask, place, weight)
            for n in range(count):
                add_to_entries(entries, p_place, p_weight, n, BLOCK, grad[2 * level, first + n], grad[2 * level + 1, first + n])


def encode_backward(
    points: np.ndarray, grad: np.ndarray, sides: np.ndarray, dense: np.ndarray, starts: np.ndarray, mask: np.uint32, table_grad: np.ndarray
) -> None:
    """Adds the gradient with respect to the table: points (3, N), grad (2L, N), table_grad (T, 2), all float32."""
    threads, levels = numba.get_num_threads(), np.arange(len(sides))
    # A thread gets tasks that follow each other. Fine levels miss the caches more often, so that each gets some of both.
    order = np.concatenate([levels[thread::threads] for thread in range(min(threads, len(levels)))])
    _encode_backward(points, grad, sides, dense, starts, mask, order, table_grad)
