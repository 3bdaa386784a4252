"""Eight groups of four numbers with a weight each, as the corners of a sample have: in SIMD lanes, of float32, and of float64 for tests."""

from __future__ import annotations

from typing import Any

from llvmlite import ir
from numba import types
from numba.extending import intrinsic

from efficientnerf.backends.numba.simd import multiply_add, splat

CORNERS = 8
_I32, _I64 = ir.IntType(32), ir.IntType(64)


def _corner(builder: Any, args: Any, n: int) -> tuple[Any, Any]:
    """Address of the group of corner n, and its weight four times."""
    values, slots, weights, at = args[:4]
    index = builder.add(at, ir.Constant(_I64, n))
    slot = builder.shl(builder.sext(builder.load(builder.gep(slots, [index])), _I64), ir.Constant(_I64, 2))
    weight = splat(builder, builder.load(builder.gep(weights, [index])), 4)
    return builder.bitcast(builder.gep(values, [slot]), ir.VectorType(weight.type.element, 4).as_pointer()), weight


def _bytes(kind: Any) -> int:
    return 4 if kind == types.float32 else 8


@intrinsic
def mixed(typing_context: Any, values: Any, slots: Any, weights: Any, at: Any) -> Any:
    """Sum over n of weights[at + n] times the group that begins at values[4 slots[at + n]]: four numbers. Pointers; slots are int32."""
    kind = values.dtype

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        sums: list[Any] = [None, None]  # two chains, which do not wait for each other
        for n in range(CORNERS):
            address, weight = _corner(builder, args, n)
            value, total = builder.load(address, align=_bytes(kind)), sums[n % 2]
            sums[n % 2] = builder.fmul(weight, value) if total is None else multiply_add(builder, weight, value, total)
        total = builder.fadd(*sums)
        lanes = [builder.extract_element(total, ir.Constant(_I32, n)) for n in range(4)]
        return context.make_tuple(builder, signature.return_type, lanes)

    return types.UniTuple(kind, 4)(values, types.CPointer(types.int32), types.CPointer(kind), types.int64), codegen


@intrinsic
def add_spread(typing_context: Any, values: Any, slots: Any, weights: Any, at: Any, a: Any, b: Any, c: Any, d: Any) -> Any:
    """The reverse of `mixed`: adds weights[at + n] times (a, b, c, d) to the groups, one after the other, for some may be the same."""
    kind = values.dtype

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        four = ir.Constant(ir.VectorType(args[4].type, 4), ir.Undefined)
        for n, number in enumerate(args[4:]):
            four = builder.insert_element(four, number, ir.Constant(_I32, n))
        for n in range(CORNERS):
            address, weight = _corner(builder, args, n)
            builder.store(multiply_add(builder, weight, four, builder.load(address, align=_bytes(kind))), address, align=_bytes(kind))
        return context.get_dummy_value()

    return types.void(values, types.CPointer(types.int32), types.CPointer(kind), types.int64, kind, kind, kind, kind), codegen
