"""SIMD access to a hash table's entries of two float32 inside numba kernels: the eight corners of a sample's cell, and whole cache lines for Adam.

Both features of an entry are loaded and stored as one vector; numba would access them separately.
"""

from __future__ import annotations

from typing import Any

from llvmlite import ir
from numba import types
from numba.extending import intrinsic

from efficientnerf.backends.numba.simd import multiply_add, splat

CORNERS = 8
ENTRIES_PER_LINE = 8  # of a cache line of 64 bytes

_ENTRY = ir.VectorType(ir.FloatType(), 2)


def _corners(builder: Any, table: Any, index: Any, weight: Any, n: Any, row: Any) -> Any:
    """Address of the entry, and weight splatted to two lanes, of each corner."""
    for corner in range(CORNERS):
        at = builder.add(n, builder.mul(row, ir.Constant(ir.IntType(64), corner)))
        entry_index = builder.zext(builder.load(builder.gep(index, [at])), ir.IntType(64))
        entry = builder.bitcast(builder.gep(table, [builder.shl(entry_index, ir.Constant(ir.IntType(64), 1))]), _ENTRY.as_pointer())
        yield entry, splat(builder, builder.load(builder.gep(weight, [at])), 2)


@intrinsic
def gather_corners(typing_context: Any, table: Any, index: Any, weight: Any, n: Any, row: Any) -> Any:
    """sum_c weight[c row + n] table[index[c row + n]], both features; table and weight point to float32, index to uint32."""

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        sums = [ir.Constant(_ENTRY, [0.0, 0.0])] * 2  # two accumulators shorten the dependency chain
        for corner, (entry, factor) in enumerate(_corners(builder, *args)):
            sums[corner % 2] = multiply_add(builder, factor, builder.load(entry, align=4), sums[corner % 2])
        total = builder.fadd(*sums)
        features = [builder.extract_element(total, ir.Constant(ir.IntType(32), k)) for k in range(2)]
        return context.make_tuple(builder, signature.return_type, features)

    address = types.CPointer(types.float32)
    return types.UniTuple(types.float32, 2)(address, types.CPointer(types.uint32), address, types.int64, types.int64), codegen


@intrinsic
def scatter_add_corners(typing_context: Any, table: Any, index: Any, weight: Any, n: Any, row: Any, first: Any, second: Any) -> Any:
    """table[index[c row + n]] += weight[c row + n] (first, second) for each corner c in turn: corners may share an entry."""

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        *corners, first, second = args
        grad = builder.insert_element(splat(builder, first, 2), second, ir.Constant(ir.IntType(32), 1))
        for entry, factor in _corners(builder, *corners):
            builder.store(multiply_add(builder, factor, grad, builder.load(entry, align=4)), entry, align=4)
        return context.get_dummy_value()

    address = types.CPointer(types.float32)
    return types.void(address, types.CPointer(types.uint32), address, types.int64, types.int64, types.float32, types.float32), codegen


@intrinsic
def prefetch(typing_context: Any, address: Any, index: Any) -> Any:
    """Bring the cache line of p[index] of a pointer to float32 into the caches; an atomic load, which the compiler may not remove."""

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        word = builder.bitcast(builder.gep(args[0], [args[1]]), ir.IntType(32).as_pointer())
        builder.load_atomic(word, "monotonic", 4)
        return context.get_dummy_value()

    return types.void(types.CPointer(types.float32), types.int64), codegen


@intrinsic
def adam_line(typing_context: Any, value: Any, grad: Any, first: Any, second: Any, n: Any, beta1: Any, beta2: Any, scale1: Any, scale2: Any, eps: Any) -> Any:
    """Adam on those of the sixteen values from n on whose gradient is not zero, and clear the gradient; reads nothing else where all gradients are zero."""

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        *arrays, n, beta1, beta2, scale1, scale2, eps = args
        one = ir.Constant(ir.FloatType(), 1.0)
        one_minus_beta1, one_minus_beta2 = builder.fsub(one, beta1), builder.fsub(one, beta2)
        line = ir.VectorType(ir.FloatType(), 2 * ENTRIES_PER_LINE)
        value, grad, first, second = (builder.bitcast(builder.gep(array, [n]), line.as_pointer()) for array in arrays)
        zero = ir.Constant(line, None)

        def broadcast(x: Any) -> Any:
            return splat(builder, x, 2 * ENTRIES_PER_LINE)

        g = builder.load(grad, align=4)
        nonzero = builder.fcmp_unordered("!=", g, zero)
        mask = ir.IntType(2 * ENTRIES_PER_LINE)
        any_nonzero = builder.icmp_unsigned("!=", builder.bitcast(nonzero, mask), ir.Constant(mask, 0))
        with builder.if_then(any_nonzero):
            m0, v0, x0 = (builder.load(array, align=4) for array in (first, second, value))
            m = builder.fadd(builder.fmul(broadcast(beta1), m0), builder.fmul(broadcast(one_minus_beta1), g))
            v = builder.fadd(builder.fmul(broadcast(beta2), v0), builder.fmul(builder.fmul(broadcast(one_minus_beta2), g), g))
            root = builder.module.declare_intrinsic(f"llvm.sqrt.v{2 * ENTRIES_PER_LINE}f32", (), ir.FunctionType(line, [line]))
            denominator = builder.fadd(builder.call(root, [builder.fmul(broadcast(scale2), v)]), broadcast(eps))
            x = builder.fsub(x0, builder.fdiv(builder.fmul(broadcast(scale1), m), denominator))
            for array, new, old in ((first, m, m0), (second, v, v0), (value, x, x0), (grad, zero, g)):
                builder.store(builder.select(nonzero, new, old), array, align=4)
        return context.get_dummy_value()

    address, number = types.CPointer(types.float32), types.float32
    return types.void(address, address, address, address, types.int64, *(number,) * 5), codegen
