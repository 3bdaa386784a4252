"""Entries of a hash table, two float32 each, inside numba kernels: those round a sample, and those of a cache line.

numba by itself takes the two numbers of an entry apart, which makes twice the loads and stores.
"""

from __future__ import annotations

from typing import Any

from llvmlite import ir
from numba import types
from numba.extending import intrinsic

from efficientnerf.backends.numba.simd import spread

CORNERS = 8
LINE = 8  # entries of a cache line of 64 bytes

_ENTRY = ir.VectorType(ir.FloatType(), 2)
_FUSED = ("contract", "reassoc", "nsz")


def _corners(builder: Any, table: Any, place: Any, weight: Any, n: Any, row: Any) -> Any:
    """Of each corner: the address of its entry, and its weight twice."""
    for corner in range(CORNERS):
        at = builder.add(n, builder.mul(row, ir.Constant(ir.IntType(64), corner)))
        index = builder.zext(builder.load(builder.gep(place, [at])), ir.IntType(64))
        entry = builder.bitcast(builder.gep(table, [builder.shl(index, ir.Constant(ir.IntType(64), 1))]), _ENTRY.as_pointer())
        yield entry, spread(builder, builder.load(builder.gep(weight, [at])), 2)


@intrinsic
def interpolated_entry(typing_context: Any, table: Any, place: Any, weight: Any, n: Any, row: Any) -> Any:
    """sum_c weight[c row + n] table[place[c row + n]], as two numbers; all three are addresses, `place` of uint32."""

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        sums = [ir.Constant(_ENTRY, [0.0, 0.0])] * 2  # two, so that neither waits for the other
        for corner, (entry, factor) in enumerate(_corners(builder, *args)):
            product = builder.fmul(factor, builder.load(entry, align=4), flags=_FUSED)
            sums[corner % 2] = builder.fadd(sums[corner % 2], product, flags=_FUSED)
        total = builder.fadd(*sums, flags=_FUSED)
        both = [builder.extract_element(total, ir.Constant(ir.IntType(32), k)) for k in range(2)]
        return context.make_tuple(builder, signature.return_type, both)

    address = types.CPointer(types.float32)
    return types.UniTuple(types.float32, 2)(address, types.CPointer(types.uint32), address, types.int64, types.int64), codegen


@intrinsic
def add_to_entries(typing_context: Any, table: Any, place: Any, weight: Any, n: Any, row: Any, first: Any, second: Any) -> Any:
    """table[place[c row + n]] += weight[c row + n] (first, second) for each corner c, one after the other: corners may share an entry."""

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        *where, first, second = args
        pull = builder.insert_element(spread(builder, first, 2), second, ir.Constant(ir.IntType(32), 1))
        for entry, factor in _corners(builder, *where):
            product = builder.fmul(factor, pull, flags=_FUSED)
            builder.store(builder.fadd(builder.load(entry, align=4), product, flags=_FUSED), entry, align=4)
        return context.get_dummy_value()

    address = types.CPointer(types.float32)
    return types.void(address, types.CPointer(types.uint32), address, types.int64, types.int64, types.float32, types.float32), codegen


@intrinsic
def touch(typing_context: Any, address: Any, index: Any) -> Any:
    """Load p[index] of a pointer to float32 for nothing but its cache line. As an atomic load, for compilers leave out others that nobody uses."""

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        where = builder.bitcast(builder.gep(args[0], [args[1]]), ir.IntType(32).as_pointer())
        builder.load_atomic(where, "monotonic", 4)
        return context.get_dummy_value()

    return types.void(types.CPointer(types.float32), types.int64), codegen


@intrinsic
def adam_of_line(
    typing_context: Any, value: Any, grad: Any, first: Any, second: Any, n: Any,
    beta1: Any, keep1: Any, beta2: Any, keep2: Any, scale1: Any, scale2: Any, eps: Any,
) -> Any:  # fmt: skip
    """Adam on the sixteen numbers from n on that have a gradient, which is cleared; where none has one, nothing else is read."""

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        *places, n, beta1, keep1, beta2, keep2, scale1, scale2, eps = args
        line = ir.VectorType(ir.FloatType(), 2 * LINE)
        value, grad, first, second = (builder.bitcast(builder.gep(place, [n]), line.as_pointer()) for place in places)
        zero = ir.Constant(line, None)

        def every(x: Any) -> Any:
            return spread(builder, x, 2 * LINE)

        g = builder.load(grad, align=4)
        there = builder.fcmp_unordered("!=", g, zero)
        some = builder.icmp_unsigned("!=", builder.bitcast(there, ir.IntType(2 * LINE)), ir.Constant(ir.IntType(2 * LINE), 0))
        with builder.if_then(some):
            m0, v0, x0 = (builder.load(place, align=4) for place in (first, second, value))
            m = builder.fadd(builder.fmul(every(beta1), m0), builder.fmul(every(keep1), g))
            v = builder.fadd(builder.fmul(every(beta2), v0), builder.fmul(builder.fmul(every(keep2), g), g))
            root = builder.module.declare_intrinsic(f"llvm.sqrt.v{2 * LINE}f32", (), ir.FunctionType(line, [line]))
            below = builder.fadd(builder.call(root, [builder.fmul(every(scale2), v)]), every(eps))
            x = builder.fsub(x0, builder.fdiv(builder.fmul(every(scale1), m), below))
            for place, new, old in ((first, m, m0), (second, v, v0), (value, x, x0), (grad, zero, g)):
                builder.store(builder.select(there, new, old), place, align=4)
        return context.get_dummy_value()

    address, number = types.CPointer(types.float32), types.float32
    return types.void(address, address, address, address, types.int64, *(number,) * 7), codegen
