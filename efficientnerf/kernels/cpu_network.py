"""What a small ReLU network and its optimiser need on the CPU beside matrix products (numba).

The network's are called from several threads at once, for a chunk of rows each, and let go of Python's lock; the optimiser takes all cores.
"""

from __future__ import annotations

import numba
import numpy as np

BLOCK = 8192
RUN = 256  # entries of a table that are skipped together where none of them has a gradient


@numba.njit(cache=True, nogil=True, inline="always", error_model="numpy")
def _narrowed(bits):  # type: ignore[no-untyped-def]
    """The upper half of a float32's bits, which is a bfloat16, rounded to the nearest, to even where there are two; what is no number stays none."""
    rounded = (bits + np.int32(0x7FFF) + ((bits >> np.int32(16)) & np.int32(1))) >> np.int32(16)
    kept = (bits >> np.int32(16)) | np.int32(0x40)
    return kept if (bits & np.int32(0x7FFFFFFF)) > np.int32(0x7F800000) else rounded


# Numbers come and go as bits, (..., ) int32 of float32 or int16 of bfloat16, so that one code serves both; `wide` says that they are of float32.


@numba.njit(cache=True, nogil=True, error_model="numpy")
def narrow(grad, wide, out):  # type: ignore[no-untyped-def]
    """out (M, O): grad (N, O) int32, then zeros."""
    flat, other = grad.reshape(-1), out.reshape(-1)
    for n in range(len(flat)):
        x = flat[n]
        other[n] = x if wide else _narrowed(x)
    other[len(flat) :] = 0


@numba.njit(cache=True, nogil=True, error_model="numpy")
def widen(rows, wide, offset, out):  # type: ignore[no-untyped-def]
    """out (N, O) float32: the first N of rows (M, O), `offset` added to the first column."""
    flat, other = rows.reshape(-1), out.reshape(-1).view(np.int32)
    for n in range(len(other)):
        x = np.int32(flat[n])
        other[n] = x if wide else x << np.int32(16)
    for n in range(len(out)):
        out[n, 0] += offset


@numba.njit(cache=True, nogil=True, error_model="numpy")
def relu(bits):  # type: ignore[no-untyped-def]
    """In place on a flat array."""
    none = bits.dtype.type(0)
    for n in range(len(bits)):
        x = bits[n]
        bits[n] = x if x > none else none


@numba.njit(cache=True, nogil=True, error_model="numpy")
def relu_backward(bits, grad):  # type: ignore[no-untyped-def]
    """Clears a gradient in place where what came out of the ReLU is zero; both flat, and not the same memory."""
    none = bits.dtype.type(0)
    for n in range(len(bits)):
        x = grad[n]
        grad[n] = x if bits[n] != none else none


@numba.njit(cache=True, error_model="numpy")
def _adam(value, grad, first, second, beta1, beta2, scale1, scale2, eps, skip_zeros):  # type: ignore[no-untyped-def]
    """One run of entries: without branches, so that it is done in vector registers."""
    one, zero = np.float32(1), np.float32(0)
    keep1, keep2 = one - beta1, one - beta2
    for n in range(len(value)):
        g = grad[n]
        m = beta1 * first[n] + keep1 * g
        v = beta2 * second[n] + keep2 * g * g
        x = value[n] - scale1 * m / (np.sqrt(scale2 * v) + eps)
        stays = skip_zeros and g == zero
        first[n] = first[n] if stays else m
        second[n] = second[n] if stays else v
        value[n] = value[n] if stays else x
        grad[n] = zero


@numba.njit(cache=True, parallel=True, error_model="numpy")
def adam(value, grad, first, second, rate, beta1, beta2, correction1, correction2, eps, skip_zeros):  # type: ignore[no-untyped-def]
    """Kingma and Ba's Adam in place on flat arrays; with `skip_zeros`, entries without a gradient are left alone. Clears the gradient.

    Values and moments are only read for runs of `RUN` entries with a gradient somewhere. A list of the touched entries would cost more than it
    saves: with 2^17 entries a level, 27,000 samples of a step touch two thirds of them, which lie in practically every cache line.
    """
    scale1, scale2 = rate / correction1, np.float32(1) / correction2
    count = len(value)
    for block in numba.prange((count + BLOCK - 1) // BLOCK):
        for begin in range(block * BLOCK, min(count, (block + 1) * BLOCK), RUN):
            end = min(count, begin + RUN)
            pull = grad[begin:end]
            touched = np.int32(0)
            for n in range(len(pull)):
                touched |= np.int32(pull[n] != 0)
            if not skip_zeros or touched != 0:
                _adam(value[begin:end], pull, first[begin:end], second[begin:end], beta1, beta2, scale1, scale2, eps, skip_zeros)
