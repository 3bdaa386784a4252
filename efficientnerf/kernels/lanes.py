"""Addresses, and four float32 side by side, inside numba kernels: what numba's arrays and scalars cost too much for.

numba neither packs the arithmetic of neighbouring numbers by itself nor has a type for them, but LLVM has one on every processor.
"""

from __future__ import annotations

from typing import Any

from llvmlite import ir
from numba import types
from numba.extending import intrinsic, models, register_model

_LANES = ir.VectorType(ir.FloatType(), 4)
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


def _spread(builder: Any, value: Any) -> Any:
    """A float32 four times."""
    one = builder.insert_element(ir.Constant(_LANES, ir.Undefined), value, ir.Constant(ir.IntType(32), 0))
    return builder.shuffle_vector(one, ir.Constant(_LANES, ir.Undefined), ir.Constant(ir.VectorType(ir.IntType(32), 4), [0, 0, 0, 0]))
