"""Exponentials of kernels that work in float32, fast, and in float64, exact, for tests."""

import numpy as np
from numba import types
from numba.extending import overload

from efficientnerf.backends.numba.vector.maths import LOG2_E, exp2_neg

_ONE = np.float32(1)
_SERIES = tuple(np.float32(c) for c in (1 / 2, 1 / 6, 1 / 24))
_SMALL = np.float32(1 / 16)


def cast_like(value, like):
    """A number in the type of another."""
    raise NotImplementedError("inside kernels only")


@overload(cast_like, inline="always")
def _cast_like(value, like):
    return (lambda value, like: np.float32(value)) if like == types.float32 else (lambda value, like: np.float64(value))


def absorbed(x):
    """1 - exp(-x) for x >= 0."""
    raise NotImplementedError("inside kernels only")


@overload(absorbed, inline="always")
def _absorbed(x):
    def fast(x):
        return x * (_ONE - x * (_SERIES[0] - x * (_SERIES[1] - x * _SERIES[2]))) if x < _SMALL else _ONE - exp2_neg(x * LOG2_E)

    return fast if x == types.float32 else (lambda x: -np.expm1(-x))


def sigmoid(x):
    """1 / (1 + exp(-x))."""
    raise NotImplementedError("inside kernels only")


@overload(sigmoid, inline="always")
def _sigmoid(x):
    def fast(x):
        half = _ONE / (_ONE + exp2_neg(abs(x) * LOG2_E))
        return half if x >= 0 else _ONE - half

    return fast if x == types.float32 else (lambda x: 1 / (1 + np.exp(-x)))
