"""Addresses, and four float32 side by side, inside numba kernels: what numba's arrays and scalars cost too much for.

numba neither packs the arithmetic of neighbouring numbers by itself nor has a type for them, but LLVM has one on every processor.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from llvmlite import ir
from numba import types
from numba.extending import intrinsic, models, register_model

# 2^-f = 1 + f (c_0 + f (c_1 + ...)) for f from 0 to 1, to 6e-8: least largest error among those that are 1 at 0.
EXP2 = (-0.69314442, 0.24018671, -0.05531669, 0.00922838, -0.00095403)

_LANES = ir.VectorType(ir.FloatType(), 4)
_WHOLE = ir.VectorType(ir.IntType(32), 4)
_FUSED = ("contract", "reassoc", "nsz")


class Four(types.Type):
    """numba's type of four float32."""

    def __init__(self) -> None:
        super().__init__(name="Four")


four = Four()


@register_model(Four)
class _FourModel(models.PrimitiveModel):
    def __init__(self, manager: Any, kind: Any) -> None:
        super().__init__(manager, kind, _LANES)


@intrinsic
def pointer(typing_context: Any, array: Any) -> Any:
    """Where the elements of a contiguous array begin: p[n] is its n-th in C order, neither checked nor counted from the end.

    Every function that an array is handed to, or that takes it out of a tuple, counts one more reference to it and later one less, at a cost of several
    look-ups. An address has no references; whoever takes it keeps the array while it is in use.
    """
    if not isinstance(array, types.Array) or array.layout != "C":
        raise TypeError(f"pointer of {array}: expected a contiguous array")

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        return context.make_array(signature.args[0])(context, builder, args[0]).data

    return types.CPointer(array.dtype)(array), codegen


@intrinsic
def four_at(typing_context: Any, address: Any, index: Any) -> Any:
    """p[index], p[index + 1], p[index + 2], p[index + 3] of a pointer to float32."""

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        place = builder.gep(args[0], [args[1]])
        return builder.load(builder.bitcast(place, _LANES.as_pointer()), align=4)

    return four(types.CPointer(types.float32), types.int64), codegen


@intrinsic
def scaled(typing_context: Any, factor: Any, value: Any) -> Any:
    """A float32 times each of four."""

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        return builder.fmul(_spread(builder, args[0]), args[1], flags=_FUSED)

    return four(types.float32, four), codegen


@intrinsic
def plus_scaled(typing_context: Any, total: Any, factor: Any, value: Any) -> Any:
    """Four plus a float32 times four others, each to its own."""

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        product = builder.fmul(_spread(builder, args[1]), args[2], flags=_FUSED)
        return builder.fadd(args[0], product, flags=_FUSED)

    return four(four, types.float32, four), codegen


@intrinsic
def apart(typing_context: Any, value: Any) -> Any:
    """The four as a tuple."""

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        lanes = [builder.extract_element(args[0], ir.Constant(ir.IntType(32), n)) for n in range(4)]
        return context.make_tuple(builder, signature.return_type, lanes)

    return types.UniTuple(types.float32, 4)(four), codegen


@intrinsic
def together(typing_context: Any, a: Any, b: Any, c: Any, d: Any) -> Any:
    """Four float32 as four."""

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        value = ir.Constant(_LANES, ir.Undefined)
        for n, one in enumerate(args):
            value = builder.insert_element(value, one, ir.Constant(ir.IntType(32), n))
        return value

    return four(types.float32, types.float32, types.float32, types.float32), codegen


@intrinsic
def logistic(typing_context: Any, value: Any) -> Any:
    """1 / (1 + exp(-x)) of each, to 3e-6."""

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        def times(x: Any, y: Any) -> Any:
            return builder.fmul(x, y, flags=_FUSED)

        def plus(x: Any, y: Any) -> Any:
            return builder.fadd(x, y, flags=_FUSED)

        def all_of(x: float) -> Any:
            return ir.Constant(_LANES, [float(np.float32(x))] * 4)

        # exp(-x) = 2^-y = 2^(127 - n) 2^-f where y + 127 is n and a fraction f; n is positive, so that cutting off finds it.
        y = plus(times(args[0], all_of(math.log2(math.e))), all_of(127))
        for bound, order in ((1.0, "<"), (253.0, ">")):
            y = builder.select(builder.fcmp_ordered(order, y, all_of(bound)), all_of(bound), y)
        n = builder.fptosi(y, _WHOLE)
        f = builder.fsub(y, builder.sitofp(n, _LANES))
        power = all_of(EXP2[-1])
        for coefficient in (*EXP2[-2::-1], 1.0):
            power = plus(times(power, f), all_of(coefficient))
        exponent = builder.shl(builder.sub(ir.Constant(_WHOLE, [254] * 4), n), ir.Constant(_WHOLE, [23] * 4))
        return builder.fdiv(all_of(1), plus(times(power, builder.bitcast(exponent, _LANES)), all_of(1)))

    return four(four), codegen


def _spread(builder: Any, value: Any) -> Any:
    """A float32 four times."""
    one = builder.insert_element(ir.Constant(_LANES, ir.Undefined), value, ir.Constant(ir.IntType(32), 0))
    return builder.shuffle_vector(one, ir.Constant(_LANES, ir.Undefined), ir.Constant(ir.VectorType(ir.IntType(32), 4), [0, 0, 0, 0]))
