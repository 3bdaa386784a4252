"""Rows of coefficients, the three channels of one after those of the other, in SIMD lanes: groups of sixteen numbers, of which the last may hold fewer.

What is made for a row holds whole groups, with zeros at the end; rows of a tree's harmonics follow each other, so that only the part that is theirs is touched.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from llvmlite import ir
from numba import types
from numba.extending import intrinsic

from efficientnerf.backends.numba.simd import float32x16, multiply_add, splat

LANES = 16
_I32, _I64 = ir.IntType(32), ir.IntType(64)
_FLOATS, _BITS = ir.VectorType(ir.FloatType(), LANES), ir.VectorType(ir.IntType(1), LANES)


def padded(width: int) -> int:
    """Numbers of the groups that hold so many."""
    return -(-width // LANES) * LANES


def rows_of(basis: np.ndarray, terms: int) -> np.ndarray:
    """(P, padded(3 terms)) float32 of harmonics (P, K): each of the first `terms` three times, as a row of coefficients has it."""
    rows = np.zeros((len(basis), padded(3 * terms)), np.float32)
    rows[:, : 3 * terms].reshape(len(basis), terms, 3)[:] = basis[:, :terms, None]
    return rows


@intrinsic
def channels_from(typing_context: Any, address: Any, index: Any, begin: Any) -> Any:
    """Sixteen numbers of a row of which every coefficient has the three channels p[index], p[index + 1] and p[index + 2] of a pointer to float32; the first of
    them is number `begin` of the row."""

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        four = builder.load(builder.bitcast(builder.gep(args[0], [args[1]]), ir.VectorType(ir.FloatType(), 4).as_pointer()), align=4)
        turns = [builder.shuffle_vector(four, four, ir.Constant(ir.VectorType(_I32, LANES), [(n + turn) % 3 for n in range(LANES)])) for turn in range(3)]
        turn, found = builder.urem(args[2], ir.Constant(_I64, 3)), turns[0]
        for n in (1, 2):
            found = builder.select(builder.icmp_signed("==", turn, ir.Constant(_I64, n)), turns[n], found)
        return found

    return float32x16(types.CPointer(types.float32), types.int64, types.int64), codegen


@intrinsic
def multiply_add16(typing_context: Any, a: Any, b: Any, total: Any) -> Any:
    """a b + total of three Float32x16: `simd.multiply_add`."""
    return float32x16(float32x16, float32x16, float32x16), lambda context, builder, signature, args: multiply_add(builder, *args)


@intrinsic
def sum16(typing_context: Any, value: Any) -> Any:
    """The lanes' sum, by halves."""

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        total, count = args[0], LANES
        while count > 1:
            count //= 2
            halves = [ir.Constant(ir.VectorType(_I32, count), list(range(n, n + count))) for n in (0, count)]
            total = builder.fadd(*(builder.shuffle_vector(total, total, half) for half in halves))
        return builder.extract_element(total, ir.Constant(_I32, 0))

    return types.float32(float32x16), codegen


def _first(builder: Any, count: Any) -> Any:
    """A mask of so many lanes."""
    numbers = ir.Constant(ir.VectorType(_I64, LANES), list(range(LANES)))
    return builder.icmp_signed("<", numbers, splat(builder, count, LANES))


@intrinsic
def load_first16(typing_context: Any, address: Any, index: Any, count: Any) -> Any:
    """p[index : index + 16] of a pointer to float32, the first `count` of them, and zeros."""

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        pointer = builder.bitcast(builder.gep(args[0], [args[1]]), _FLOATS.as_pointer())
        kind = ir.FunctionType(_FLOATS, [_FLOATS.as_pointer(), _I32, _BITS, _FLOATS])
        load = builder.module.declare_intrinsic("llvm.masked.load.v16f32.p0v16f32", (), kind)
        return builder.call(load, [pointer, ir.Constant(_I32, 4), _first(builder, args[2]), ir.Constant(_FLOATS, [0.0] * LANES)])

    return float32x16(types.CPointer(types.float32), types.int64, types.int64), codegen


@intrinsic
def store_first16(typing_context: Any, address: Any, index: Any, value: Any, count: Any) -> Any:
    """p[index : index + 16] = value of a pointer to float32, the first `count` of them."""

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        pointer = builder.bitcast(builder.gep(args[0], [args[1]]), _FLOATS.as_pointer())
        kind = ir.FunctionType(ir.VoidType(), [_FLOATS, _FLOATS.as_pointer(), _I32, _BITS])
        store = builder.module.declare_intrinsic("llvm.masked.store.v16f32.p0v16f32", (), kind)
        builder.call(store, [args[2], pointer, ir.Constant(_I32, 4), _first(builder, args[3])])
        return context.get_dummy_value()

    return types.void(types.CPointer(types.float32), types.int64, float32x16, types.int64), codegen
