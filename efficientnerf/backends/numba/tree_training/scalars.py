"""Exponentials of kernels that work in float32, fast, and in float64, exact, for tests."""

from __future__ import annotations

import math

import numpy as np
from numba import types
from numba.extending import overload

from efficientnerf.backends.numba.runtime import numba
from efficientnerf.backends.numba.simd import EXP2_COEFFICIENTS, fmuladd

_ONE, _LOG2E = np.float32(1), np.float32(math.log2(math.e))
_C = tuple(np.float32(c) for c in EXP2_COEFFICIENTS)
_SERIES = tuple(np.float32(c) for c in (1 / 2, 1 / 6, 1 / 24))
_SMALL, _MOST = np.float32(1 / 16), np.float32(126)


def cast_like(value, like):  # type: ignore[no-untyped-def]
    """A number in the type of another."""
    raise NotImplementedError("inside kernels only")


@overload(cast_like, inline="always")
def _cast_like(value, like):  # type: ignore[no-untyped-def]
    return (lambda value, like: np.float32(value)) if like == types.float32 else (lambda value, like: np.float64(value))


@numba.njit(cache=True, inline="always", error_model="numpy")
def _exp_neg(x):  # type: ignore[no-untyped-def]
    """exp(-x) of a float32 x >= 0, to 1e-7."""
    y = min(x * _LOG2E, _MOST)
    whole = np.int32(y)
    f = y - np.float32(whole)
    p = fmuladd(f, fmuladd(f, fmuladd(f, fmuladd(f, fmuladd(f, _C[4], _C[3]), _C[2]), _C[1]), _C[0]), _ONE)
    return p * np.int32((np.int32(127) - whole) << np.int32(23)).view(np.float32)


def absorbed(x):  # type: ignore[no-untyped-def]
    """1 - exp(-x) for x >= 0."""
    raise NotImplementedError("inside kernels only")


@overload(absorbed, inline="always")
def _absorbed(x):  # type: ignore[no-untyped-def]
    def fast(x):  # type: ignore[no-untyped-def]
        return x * (_ONE - x * (_SERIES[0] - x * (_SERIES[1] - x * _SERIES[2]))) if x < _SMALL else _ONE - _exp_neg(x)

    return fast if x == types.float32 else (lambda x: -np.expm1(-x))


def sigmoid(x):  # type: ignore[no-untyped-def]
    """1 / (1 + exp(-x))."""
    raise NotImplementedError("inside kernels only")


@overload(sigmoid, inline="always")
def _sigmoid(x):  # type: ignore[no-untyped-def]
    def fast(x):  # type: ignore[no-untyped-def]
        half = _ONE / (_ONE + _exp_neg(abs(x)))
        return half if x >= 0 else _ONE - half

    return fast if x == types.float32 else (lambda x: 1 / (1 + np.exp(-x)))
