"""What numba does not offer on 64-bit words: counting their bits, and changing them while other threads do.

The kernels index with unsigned words throughout: a signed index may count from the end in numba, and that test is a third of a look-up.

Atomic operations are relaxed ("monotonic" in LLVM's terms): nothing but the word itself is handed from thread to thread, and a parallel loop
ends with a barrier.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numba.core import types
from numba.extending import intrinsic
from numba.np.arrayobj import make_array

from efficientnerf.backends.numba.runtime import numba

TASK = 4096  # voxels or points that a thread takes at a time
CHUNK = 256  # look-ups that go through each step side by side, so that their accesses to memory overlap
ZERO, ONE = np.uint64(0), np.uint64(1)

_WORDS = types.Array(types.uint64, 1, "C")


def _address(context: Any, builder: Any, array: Any, index: Any) -> Any:
    return builder.gep(make_array(_WORDS)(context, builder, array).data, [index])


@intrinsic
def population(typing_context, word):  # type: ignore[no-untyped-def]
    """How many bits of a uint64 are set, as a uint64. One instruction where the processor has it."""

    def generate(context, builder, signature, arguments):  # type: ignore[no-untyped-def]
        return builder.ctpop(arguments[0])

    return types.uint64(types.uint64), generate


@intrinsic
def atomic_or(typing_context, array, index, word):  # type: ignore[no-untyped-def]
    """array[index] |= word, of a contiguous (N,) uint64 array, as one step; returns what was there before."""

    def generate(context, builder, signature, arguments):  # type: ignore[no-untyped-def]
        return builder.atomic_rmw("or", _address(context, builder, *arguments[:2]), arguments[2], "monotonic")

    return types.uint64(_WORDS, types.uint64, types.uint64), generate


@intrinsic
def compare_and_swap(typing_context, array, index, expected, word):  # type: ignore[no-untyped-def]
    """array[index] = word where it is `expected`, of a contiguous (N,) uint64 array, as one step; returns what was there before."""

    def generate(context, builder, signature, arguments):  # type: ignore[no-untyped-def]
        address = _address(context, builder, *arguments[:2])
        return builder.extract_value(builder.cmpxchg(address, arguments[2], arguments[3], "monotonic", "monotonic"), 0)

    return types.uint64(_WORDS, types.uint64, types.uint64, types.uint64), generate


@numba.njit(cache=True, inline="always")
def whole(x):  # type: ignore[no-untyped-def]
    """A coordinate that is not negative, rounded down to a word."""
    return np.uint64(np.int64(x))


@numba.njit(cache=True, inline="always")
def within(x, y, z, top):  # type: ignore[no-untyped-def]
    """Whether a point lies in [0, top)^3; false for what is no number."""
    low = np.float32(0)
    return (x >= low) & (x < top) & (y >= low) & (y < top) & (z >= low) & (z < top)


@numba.njit(cache=True, inline="always")
def bits_below(mask, bit):  # type: ignore[no-untyped-def]
    """How many bits of a mask are set below a number of 0 to 63."""
    return population(mask & ((ONE << bit) - ONE))


@numba.njit(cache=True, parallel=True, error_model="numpy")
def fill(array, word):  # type: ignore[no-untyped-def]
    """array[:] = word on all cores: this is where the memory is really taken."""
    stretch = 1 << 16
    for task in numba.prange((len(array) + stretch - 1) // stretch):
        array[task * stretch : (task + 1) * stretch] = word


@numba.njit(cache=True, parallel=True, error_model="numpy")
def number_bits(records, first):  # type: ignore[no-untyped-def]
    """Numbers the set bits of masks in their order: records (2 M,) uint64 hold a mask and, after this, the number of its lowest set bit.

    The numbers begin at `first`; returns the one behind the last.
    """
    masks = len(records) // 2
    tasks = (masks + TASK - 1) // TASK
    begins = np.zeros(tasks + 1, np.uint64)
    for task in numba.prange(tasks):
        count = ZERO
        for i in range(task * TASK, min(masks, (task + 1) * TASK)):
            count += population(records[2 * i])
        begins[task + 1] = count
    begins[0] = first
    for task in range(tasks):
        begins[task + 1] += begins[task]
    for task in numba.prange(tasks):
        at = begins[task]
        for i in range(task * TASK, min(masks, (task + 1) * TASK)):
            records[2 * i + 1] = at
            at += population(records[2 * i])
    return begins[tasks]


@numba.njit(cache=True, parallel=True, error_model="numpy")
def gather(table, where, words):  # type: ignore[no-untyped-def]
    """words[i] = table[where[i]] and nothing else: the least that a look-up of a value can take."""
    n = len(where)
    for task in numba.prange((n + TASK - 1) // TASK):
        for i in range(task * TASK, min(n, (task + 1) * TASK)):
            words[i] = table[where[i]]
