"""Adam (Kingma and Ba 2015) on the CPU (numba, all cores), dense or restricted to the entries of a table that have a gradient."""

import numpy as np

from efficientnerf.backends.numba.runtime import PRANGE, numba
from efficientnerf.backends.numba.vector.maths import bits_of, select, sqrt
from efficientnerf.backends.numba.vector.memory import load, pointer, store

BLOCK = 8192  # values per task
LINE = 16  # values of a cache line of 64 bytes
_ZERO, _ONE = np.float32(0), np.float32(1)


@numba.njit(cache=True, inline="always", error_model="numpy")
def _adam_line(value, grad, first, second, n, beta1, beta2, scale1, scale2, eps):
    """Adam on those of a line's values from n on whose gradient is not zero; clears the gradient. Reads nothing else where all gradients are zero."""
    g = load(grad, n, LINE)
    some = ~(g == _ZERO)
    if bits_of(some) != 0:
        m0, v0, x0 = load(first, n, LINE), load(second, n, LINE), load(value, n, LINE)
        m = beta1 * m0 + (_ONE - beta1) * g
        v = beta2 * v0 + (_ONE - beta2) * g * g
        x = x0 - scale1 * m / (sqrt(scale2 * v) + eps)
        store(first, n, select(some, m, m0))
        store(second, n, select(some, v, v0))
        store(value, n, select(some, x, x0))
        store(grad, n, select(some, _ZERO, g))


@numba.njit(cache=True, error_model="numpy")
def _adam_range(value, grad, first, second, begin, end, beta1, beta2, scale1, scale2, eps, skip_zeros):
    """Values begin to end; branch-free, so that LLVM vectorises it."""
    one, zero = np.float32(1), np.float32(0)
    one_minus_beta1, one_minus_beta2 = one - beta1, one - beta2
    for n in range(begin, end):
        g = grad[n]
        m = beta1 * first[n] + one_minus_beta1 * g
        v = beta2 * second[n] + one_minus_beta2 * g * g
        x = value[n] - scale1 * m / (np.sqrt(scale2 * v) + eps)
        skip = skip_zeros and g == zero
        first[n] = first[n] if skip else m
        second[n] = second[n] if skip else v
        value[n] = value[n] if skip else x
        grad[n] = zero


@numba.njit(cache=True, parallel=PRANGE, error_model="numpy")
def adam(value, grad, first, second, learning_rate, beta1, beta2, correction1, correction2, eps, skip_zeros):
    """A step of Adam in place, on flat float32 arrays of one length; clears the gradient.

    correction1, correction2  1 - beta^step: bias corrections of the moments
    skip_zeros                leave values and moments whose gradient is zero unchanged; cache lines without a gradient are not read
    """
    one, count = np.float32(1), len(value)
    scale1, scale2 = learning_rate / correction1, one / correction2
    p_value, p_grad, p_first, p_second = pointer(value), pointer(grad), pointer(first), pointer(second)
    for block in numba.prange((count + BLOCK - 1) // BLOCK):
        begin, end = block * BLOCK, min(count, (block + 1) * BLOCK)
        if skip_zeros:
            lines = (end - begin) // LINE
            for line in range(lines):
                _adam_line(p_value, p_grad, p_first, p_second, begin + line * LINE, beta1, beta2, scale1, scale2, eps)
            begin += lines * LINE
        _adam_range(value, grad, first, second, begin, end, beta1, beta2, scale1, scale2, eps, skip_zeros)
