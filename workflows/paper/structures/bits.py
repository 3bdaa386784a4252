"""Bit operations and atomics on uint64 that numba lacks.

Kernels index with uint64 throughout: a signed index may be negative in numba, and that test is a third of a query.

Atomic operations are relaxed ("monotonic" in LLVM): nothing but the word itself passes between threads, and a parallel loop ends with a barrier.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numba.core import types
from numba.extending import intrinsic
from numba.np.arrayobj import make_array

from efficientnerf.backends.numba.runtime import numba

TASK = 4096  # voxels or points per task
CHUNK = 256  # queries whose steps are interleaved, so that cache misses overlap
ZERO, ONE = np.uint64(0), np.uint64(1)

_UINT64S = types.Array(types.uint64, 1, "C")


def _address(context: Any, builder: Any, array: Any, index: Any) -> Any:
    return builder.gep(make_array(_UINT64S)(context, builder, array).data, [index])


@intrinsic
def popcount(typing_context, word):  # type: ignore[no-untyped-def]
    """Number of set bits of a uint64, as a uint64."""

    def generate(context, builder, signature, arguments):  # type: ignore[no-untyped-def]
        return builder.ctpop(arguments[0])

    return types.uint64(types.uint64), generate


@intrinsic
def atomic_or(typing_context, array, index, word):  # type: ignore[no-untyped-def]
    """array[index] |= word on a contiguous (N,) uint64 array, atomically; returns the previous value."""

    def generate(context, builder, signature, arguments):  # type: ignore[no-untyped-def]
        return builder.atomic_rmw("or", _address(context, builder, *arguments[:2]), arguments[2], "monotonic")

    return types.uint64(_UINT64S, types.uint64, types.uint64), generate


@intrinsic
def compare_and_swap(typing_context, array, index, expected, word):  # type: ignore[no-untyped-def]
    """array[index] = word if it is `expected`, on a contiguous (N,) uint64 array, atomically; returns the previous value."""

    def generate(context, builder, signature, arguments):  # type: ignore[no-untyped-def]
        address = _address(context, builder, *arguments[:2])
        return builder.extract_value(builder.cmpxchg(address, arguments[2], arguments[3], "monotonic", "monotonic"), 0)

    return types.uint64(_UINT64S, types.uint64, types.uint64, types.uint64), generate


@numba.njit(cache=True, inline="always")
def floor_to_uint64(x):  # type: ignore[no-untyped-def]
    """A non-negative coordinate rounded down, as uint64."""
    return np.uint64(np.int64(x))


@numba.njit(cache=True, inline="always")
def in_grid(x, y, z, top):  # type: ignore[no-untyped-def]
    """Whether a point lies in [0, top)^3; false for NaN."""
    low = np.float32(0)
    return (x >= low) & (x < top) & (y >= low) & (y < top) & (z >= low) & (z < top)


@numba.njit(cache=True, inline="always")
def rank(mask, bit):  # type: ignore[no-untyped-def]
    """Number of set bits of a mask below `bit`, 0 to 63."""
    return popcount(mask & ((ONE << bit) - ONE))


@numba.njit(cache=True, parallel=True, error_model="numpy")
def fill(array, word):  # type: ignore[no-untyped-def]
    """array[:] = word on all cores; this touches the pages first."""
    task_size = 1 << 16
    for task in numba.prange((len(array) + task_size - 1) // task_size):
        array[task * task_size : (task + 1) * task_size] = word


@numba.njit(cache=True, parallel=True, error_model="numpy")
def assign_ranks(records, first):  # type: ignore[no-untyped-def]
    """Writes to each record, (2 M,) uint64 of a mask and a rank, the number of set bits in the masks before it, plus `first`; returns the total.

    The index of a set bit is then its record's rank plus `rank(mask, bit)`.
    """
    masks = len(records) // 2
    tasks = (masks + TASK - 1) // TASK
    begins = np.zeros(tasks + 1, np.uint64)
    for task in numba.prange(tasks):
        count = ZERO
        for i in range(task * TASK, min(masks, (task + 1) * TASK)):
            count += popcount(records[2 * i])
        begins[task + 1] = count
    begins[0] = first
    for task in range(tasks):
        begins[task + 1] += begins[task]
    for task in numba.prange(tasks):
        at = begins[task]
        for i in range(task * TASK, min(masks, (task + 1) * TASK)):
            records[2 * i + 1] = at
            at += popcount(records[2 * i])
    return begins[tasks]


@numba.njit(cache=True, parallel=True, error_model="numpy")
def gather(table, index, packed):  # type: ignore[no-untyped-def]
    """packed[i] = table[index[i]] and nothing else: a lower bound for the time of any query."""
    n = len(index)
    for task in numba.prange((n + TASK - 1) // TASK):
        for i in range(task * TASK, min(n, (task + 1) * TASK)):
            packed[i] = table[index[i]]
