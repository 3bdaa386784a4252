"""Vectors of sixteen numbers as Gaussians need them, beside those of `tree.packets.lanes`."""

from __future__ import annotations

from typing import Any

import numpy as np
from llvmlite import ir
from numba.extending import intrinsic

from efficientnerf.backends.numba.runtime import numba
from efficientnerf.backends.numba.simd import float32x16
from efficientnerf.backends.numba.tree.packets.lanes import exp2_neg_lanes, max_lanes, select_lanes, sqrt_lanes

LANES = 16
LOG2_E = np.float32(1.4426950408889634)
_NONE, _ONE = np.float32(0), np.float32(1)
_I32 = ir.IntType(32)


@intrinsic
def sums16(typing_context: Any, a: Any, b: Any, c: Any, d: Any, e: Any, f: Any, g: Any, h: Any, i: Any, j: Any) -> Any:
    """The sums over the lanes of ten Float32x16, in the first ten lanes of one; the rest are 0. Summed by halves, as `sum16` does."""

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        zero = ir.Constant(args[0].type, [0.0] * LANES)
        vectors = [*args, *[zero] * (LANES - len(args))]
        width = LANES  # lanes that still belong to one sum
        while width > 1:
            half = width // 2
            # The first (or second) halves of the sums of one vector, then those of the other.
            firsts = [start + n for start in range(0, 2 * LANES, width) for n in range(half)]
            joined = []
            for left, right in zip(vectors[::2], vectors[1::2], strict=True):
                if left is zero:
                    joined.append(zero)
                    continue
                halves = [ir.Constant(ir.VectorType(_I32, LANES), [at + shift for at in firsts]) for shift in (0, half)]
                joined.append(builder.fadd(*(builder.shuffle_vector(left, right, order) for order in halves)))
            vectors, width = joined, half
        return vectors[0]

    return float32x16(*[float32x16] * 10), codegen


@numba.njit(cache=True, inline="always", error_model="numpy")
def exp16(x):  # type: ignore[no-untyped-def]
    """e^x for x from -80 to 80."""
    y = x * LOG2_E
    return exp2_neg_lanes(max_lanes(y * np.float32(-1), _NONE)) / exp2_neg_lanes(max_lanes(y, _NONE))


@numba.njit(cache=True, inline="always", error_model="numpy")
def arctangent16(t):  # type: ignore[no-untyped-def]
    """Arc tangent of t >= 0, to 3e-7."""
    steep = t > _ONE
    x = select_lanes(steep, _ONE / max_lanes(t, np.float32(1e-30)), t)
    # Half of the angle lies within an eighth of a turn, where a short series is exact.
    x = x / (_ONE + sqrt_lanes(_ONE + x * x))
    y = x * x
    series = np.float32(0.11111111) - y * (np.float32(0.09090909) - y * np.float32(0.07692308))
    series = _ONE - y * (np.float32(0.33333333) - y * (np.float32(0.2) - y * (np.float32(0.14285715) - y * series)))
    angle = np.float32(2) * x * series
    return select_lanes(steep, np.float32(np.pi / 2) - angle, angle)
