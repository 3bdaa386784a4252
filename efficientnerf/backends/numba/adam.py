"""Adam on the CPU, for a small network and for the touched entries of a table (numba, all cores)."""

from __future__ import annotations

import numpy as np

from efficientnerf.backends.numba.runtime import numba
from efficientnerf.backends.numba.simd import pointer
from efficientnerf.backends.numba.table_entries import LINE, adam_of_line

BLOCK = 8192


@numba.njit(cache=True, error_model="numpy")
def _adam(value, grad, first, second, begin, end, beta1, beta2, scale1, scale2, eps, skip_zeros):  # type: ignore[no-untyped-def]
    """Some entries: without branches, so that it is done in vector registers."""
    one, zero = np.float32(1), np.float32(0)
    keep1, keep2 = one - beta1, one - beta2
    for n in range(begin, end):
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

    Values and moments are then only read for cache lines with a gradient somewhere. A list of the touched entries would cost more than it saves.
    """
    one, count = np.float32(1), len(value)
    scale1, scale2, keep1, keep2 = rate / correction1, one / correction2, one - beta1, one - beta2
    p_value, p_grad, p_first, p_second = pointer(value), pointer(grad), pointer(first), pointer(second)
    for block in numba.prange((count + BLOCK - 1) // BLOCK):
        begin, end = block * BLOCK, min(count, (block + 1) * BLOCK)
        if skip_zeros:
            lines = (end - begin) // (2 * LINE)
            for line in range(lines):
                adam_of_line(p_value, p_grad, p_first, p_second, begin + line * 2 * LINE, beta1, keep1, beta2, keep2, scale1, scale2, eps)
            begin += lines * 2 * LINE
        _adam(value, grad, first, second, begin, end, beta1, beta2, scale1, scale2, eps, skip_zeros)
