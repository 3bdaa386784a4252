"""SIMD vectors of float32 and raw pointers inside numba kernels.

numba has no vector type and does not vectorise across neighbouring scalars by itself. These types and intrinsics map to LLVM vectors, which LLVM legalises
to the registers of the processor: a vector wider than a register becomes several.

No kernel lets the compiler reorder sums or fuse products into them (`fastmath`): a process that compiles a kernel and one that loads it from the cache use
copies that were optimised in different surroundings, and would differ in the last bit. What is to be fused says so, by `fmuladd`.

A name's suffix is the number of lanes.
"""

from __future__ import annotations

import math
import operator
from collections.abc import Iterable
from typing import Any

import numpy as np
from llvmlite import ir
from numba import types
from numba.extending import intrinsic, models, overload, register_model

# Minimax polynomial of 2^-f = 1 + f (c_0 + f (c_1 + ...)) on [0, 1], exact at 0: maximum error 6e-8.
EXP2_COEFFICIENTS = (-0.69314442, 0.24018671, -0.05531669, 0.00922838, -0.00095403)

_VECTOR4 = ir.VectorType(ir.FloatType(), 4)
_VECTOR16 = ir.VectorType(ir.FloatType(), 16)
_VECTOR32 = ir.VectorType(ir.FloatType(), 32)


class Float32x4(types.Type):
    """Type of a vector of four float32."""

    def __init__(self) -> None:
        super().__init__(name="Four")


class Float32x16(types.Type):
    """Type of a vector of sixteen float32: four Float32x4 end to end."""

    def __init__(self) -> None:
        super().__init__(name="Sixteen")


class Float32x32(types.Type):
    """Type of a vector of thirty-two float32."""

    def __init__(self) -> None:
        super().__init__(name="ThirtyTwo")


float32x4, float32x16, float32x32 = Float32x4(), Float32x16(), Float32x32()


@register_model(Float32x4)
class _Float32x4Model(models.PrimitiveModel):
    def __init__(self, manager: Any, kind: Any) -> None:
        super().__init__(manager, kind, _VECTOR4)


@register_model(Float32x16)
class _Float32x16Model(models.PrimitiveModel):
    def __init__(self, manager: Any, kind: Any) -> None:
        super().__init__(manager, kind, _VECTOR16)


@register_model(Float32x32)
class _Float32x32Model(models.PrimitiveModel):
    def __init__(self, manager: Any, kind: Any) -> None:
        super().__init__(manager, kind, _VECTOR32)


def _overload_arithmetic(operation: Any, name: str) -> None:
    """An operator on two Float32x4, or on a Float32x4 and a float32."""

    @intrinsic
    def elementwise(typing_context: Any, a: Any, b: Any) -> Any:
        def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
            left, right = (arg if isinstance(kind, Float32x4) else splat(builder, arg, 4) for kind, arg in zip(signature.args, args, strict=True))
            return getattr(builder, name)(left, right)

        return float32x4(a, b), codegen

    @overload(operation)
    def implementation(a, b):  # type: ignore[no-untyped-def]
        if {a, b} <= {float32x4, types.float32} and float32x4 in {a, b}:
            return lambda a, b: elementwise(a, b)
        return None


for _operation, _name in ((operator.add, "fadd"), (operator.sub, "fsub"), (operator.mul, "fmul")):
    _overload_arithmetic(_operation, _name)


@intrinsic
def pointer(typing_context: Any, array: Any) -> Any:
    """Pointer to the first element of a contiguous array: p[n] is its n-th element in C order, without bounds checks and without wraparound.

    Passing an array to a function, or taking it out of a tuple, costs a reference count up and down. A pointer has none: the caller keeps the array alive.
    """
    if not isinstance(array, types.Array) or array.layout != "C":
        raise TypeError(f"pointer of {array}: expected a contiguous array")

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        return context.make_array(signature.args[0])(context, builder, args[0]).data

    return types.CPointer(array.dtype)(array), codegen


@intrinsic
def advanced(typing_context: Any, address: Any, count: Any) -> Any:
    """Pointer to the element that is `count` after the one that a pointer is to."""
    return address(address, types.int64), lambda context, builder, signature, args: builder.gep(args[0], [args[1]])


@intrinsic
def fmuladd(typing_context: Any, a: Any, b: Any, total: Any) -> Any:
    """a b + total of three float32 or three float64: `multiply_add`."""
    if a not in (types.float32, types.float64) or not a == b == total:
        raise TypeError(f"fmuladd of {a}, {b} and {total}: expected numbers of one type")
    return a(a, b, total), lambda context, builder, signature, args: multiply_add(builder, *args)


@intrinsic
def popcount(typing_context: Any, bits: Any) -> Any:
    """Number of set bits of an int64."""
    return types.int64(types.int64), lambda context, builder, signature, args: builder.ctpop(args[0])


@intrinsic
def fetch_add(typing_context: Any, address: Any, index: Any, amount: Any) -> Any:
    """p[index] of a pointer to int64, to which `amount` is then added, whatever other threads do."""

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        return builder.atomic_rmw("add", builder.gep(args[0], [args[1]]), args[2], "monotonic")

    return types.int64(address, types.int64, types.int64), codegen


@intrinsic
def load4(typing_context: Any, address: Any, index: Any) -> Any:
    """p[index : index + 4] of a pointer to float32."""

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        return _load(builder, args[0], args[1])

    return float32x4(types.CPointer(types.float32), types.int64), codegen


@intrinsic
def scale4(typing_context: Any, factor: Any, value: Any) -> Any:
    """factor * value for a float32 and a Float32x4."""

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        return builder.fmul(splat(builder, args[0], 4), args[1])

    return float32x4(types.float32, float32x4), codegen


@intrinsic
def add_scaled4(typing_context: Any, total: Any, factor: Any, value: Any) -> Any:
    """total + factor * value for a float32 factor."""

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        return multiply_add(builder, splat(builder, args[1], 4), args[2], args[0])

    return float32x4(float32x4, types.float32, float32x4), codegen


@intrinsic
def unpack4(typing_context: Any, value: Any) -> Any:
    """The lanes as a tuple."""

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        lanes = [builder.extract_element(args[0], ir.Constant(ir.IntType(32), n)) for n in range(4)]
        return context.make_tuple(builder, signature.return_type, lanes)

    return types.UniTuple(types.float32, 4)(float32x4), codegen


@intrinsic
def pack4(typing_context: Any, a: Any, b: Any, c: Any, d: Any) -> Any:
    """A vector of four scalars."""

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        value = ir.Constant(_VECTOR4, ir.Undefined)
        for n, scalar in enumerate(args):
            value = builder.insert_element(value, scalar, ir.Constant(ir.IntType(32), n))
        return value

    return float32x4(types.float32, types.float32, types.float32, types.float32), codegen


@intrinsic
def store4(typing_context: Any, address: Any, index: Any, value: Any) -> Any:
    """p[index : index + 4] = value for a pointer to float32."""

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        target = builder.bitcast(builder.gep(args[0], [args[1]]), _VECTOR4.as_pointer())
        builder.store(args[2], target, align=4)
        return context.get_dummy_value()

    return types.void(types.CPointer(types.float32), types.int64, float32x4), codegen


def store(out, n, value):  # type: ignore[no-untyped-def]
    """out[n] = value, for kernels that work on scalars, on Float32x4, Float32x16 and Float32x32; element n of those lies at 4 n, 16 n and 32 n."""
    raise NotImplementedError("inside kernels only")


@overload(store)
def _store(out, n, value):  # type: ignore[no-untyped-def]
    def scalar(out, n, value):  # type: ignore[no-untyped-def]
        out[n] = value

    if value in (float32x16, float32x32):
        return None  # `lanes` has that
    return (lambda out, n, value: store4(out, 4 * n, value)) if value == float32x4 else scalar


def broadcast_like(value, other):  # type: ignore[no-untyped-def]
    """The scalar `value`, or a Float32x4, Float32x16 or Float32x32 of it where `other` is one."""
    raise NotImplementedError("inside kernels only")


@overload(broadcast_like)
def _broadcast_like(value, other):  # type: ignore[no-untyped-def]
    if other in (float32x16, float32x32):
        return None
    return (lambda value, other: pack4(value, value, value, value)) if other == float32x4 else (lambda value, other: value)


@intrinsic
def sigmoid(typing_context: Any, value: Any) -> Any:
    """Logistic function 1 / (1 + exp(-x)) of a Float32x4, Float32x16 or Float32x32, to 3e-6."""

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        def constant(x: float) -> Any:
            return _constant(args[0].type, x)

        # exp(-x) = 2^-y = 2^(127 - n) 2^-f with y + 127 = n + f, 0 <= f < 1. n is positive, so truncation finds it.
        y = multiply_add(builder, args[0], constant(math.log2(math.e)), constant(127))
        for bound, order in ((1.0, "<"), (253.0, ">")):
            y = builder.select(builder.fcmp_ordered(order, y, constant(bound)), constant(bound), y)
        return builder.fdiv(constant(1), builder.fadd(_exp2(builder, y, 254), constant(1)))

    return value(value), codegen


@intrinsic
def exp2_neg4(typing_context: Any, value: Any) -> Any:
    """2^-x of a Float32x4 for x >= 0."""

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        bound = _constant(_VECTOR4, 126)
        return _exp2(builder, builder.select(builder.fcmp_ordered(">", args[0], bound), bound, args[0]), 127)

    return float32x4(float32x4), codegen


@intrinsic
def trilinear4(typing_context: Any, address: Any, a: Any, b: Any, c: Any, d: Any, j: Any, i: Any, x: Any, y: Any, z: Any) -> Any:
    """Trilinear interpolation of four channels at four points at once: (channel 0 of each point, Float32x4; all channels point by point, Float32x16).

    address     of float32; the four channels of a voxel are adjacent
    a, b, c, d  offset of the lowest of the eight neighbours of each point
    j, i        strides of y and x; that of z is 4
    x, y, z     fractions of the points between their neighbours

    Of the second result, NaN neighbours are left out and the remaining weights normalised; 0 where all eight are NaN. The first, whose channel must not be
    NaN, does not depend on that division.
    """

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        values, starts, (row, layer), fractions = args[0], args[1:5], args[5:7], args[7:]
        sides = [(builder.fsub(_constant(_VECTOR4, 1), f), f) for f in fractions]
        sums, weights = [], []
        for p in range(2):
            for q in range(2):
                edge = builder.fmul(sides[0][p], sides[1][q])
                for r in range(2):
                    weight = _repeat_lanes(builder, builder.fmul(edge, sides[2][r]))
                    ahead = ir.Constant(ir.IntType(64), 4 * r)
                    for use, stride in ((p, layer), (q, row)):
                        ahead = builder.add(ahead, stride) if use else ahead
                    value = _concat(builder, [_load(builder, values, builder.add(start, ahead)) for start in starts])
                    valid = builder.fcmp_ordered("ord", value, value)
                    sums.append(builder.fmul(weight, builder.select(valid, value, _constant(_VECTOR16, 0))))
                    weights.append(builder.select(valid, weight, _constant(_VECTOR16, 0)))
        total, total_weight = _tree_sum(builder, sums), _tree_sum(builder, weights)
        some = builder.fcmp_ordered(">", total_weight, _constant(_VECTOR16, 0))
        mean = builder.fdiv(total, builder.select(some, total_weight, _constant(_VECTOR16, 1)))
        return context.make_tuple(builder, signature.return_type, [_shuffle(builder, total, total, (0, 4, 8, 12)), mean])

    index = types.int64
    result = types.Tuple((float32x4, float32x16))
    return result(types.CPointer(types.float32), index, index, index, index, index, index, float32x4, float32x4, float32x4), codegen


@intrinsic
def split16(typing_context: Any, value: Any) -> Any:
    """A Float32x16 as a tuple of four Float32x4."""

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        parts = [_shuffle(builder, args[0], args[0], range(4 * n, 4 * n + 4)) for n in range(4)]
        return context.make_tuple(builder, signature.return_type, parts)

    return types.UniTuple(float32x4, 4)(float32x16), codegen


def splat(builder: Any, value: Any, lanes: int) -> Any:
    """A vector with a scalar in all lanes."""
    first = builder.insert_element(ir.Constant(ir.VectorType(value.type, lanes), ir.Undefined), value, ir.Constant(ir.IntType(32), 0))
    return builder.shuffle_vector(first, first, ir.Constant(ir.VectorType(ir.IntType(32), lanes), None))


def multiply_add(builder: Any, a: Any, b: Any, total: Any) -> Any:
    """a b + total of floats, or of vectors of them: rounded once where the processor has an instruction for it, else twice, wherever the code is used."""
    kind, vector = a.type, isinstance(a.type, ir.VectorType)
    name = f"v{kind.count}" if vector else ""
    name += "f32" if (kind.element if vector else kind) == ir.FloatType() else "f64"
    return builder.call(builder.module.declare_intrinsic(f"llvm.fmuladd.{name}", (), ir.FunctionType(kind, [kind] * 3)), [a, b, total])


def _tree_sum(builder: Any, values: list[Any]) -> Any:
    """Sum of a power of two of vectors, pairwise: short dependency chains."""
    while len(values) > 1:
        values = [builder.fadd(left, right) for left, right in zip(values[::2], values[1::2], strict=True)]
    return values[0]


def _constant(kind: Any, x: float) -> Any:
    """A constant vector with one value in all lanes."""
    return ir.Constant(kind, [float(np.float32(x)) if isinstance(kind.element, ir.FloatType) else int(x)] * kind.count)


def _exp2(builder: Any, y: Any, bias: int) -> Any:
    """2^(bias - 127 - y) for 0 <= y < bias."""
    whole = ir.VectorType(ir.IntType(32), y.type.count)
    n = builder.fptosi(y, whole)
    f = builder.fsub(y, builder.sitofp(n, y.type))
    power = _constant(y.type, EXP2_COEFFICIENTS[-1])
    for coefficient in (*EXP2_COEFFICIENTS[-2::-1], 1.0):
        power = multiply_add(builder, power, f, _constant(y.type, coefficient))
    exponent = builder.shl(builder.sub(_constant(whole, bias), n), _constant(whole, 23))
    return builder.fmul(power, builder.bitcast(exponent, y.type))


def _shuffle(builder: Any, left: Any, right: Any, lanes: Iterable[int]) -> Any:
    """Lanes of two vectors, numbered through."""
    indices = list(lanes)
    return builder.shuffle_vector(left, right, ir.Constant(ir.VectorType(ir.IntType(32), len(indices)), indices))


def _repeat_lanes(builder: Any, value: Any) -> Any:
    """A Float32x16 with each lane of a Float32x4 four times."""
    return _shuffle(builder, value, value, [n // 4 for n in range(16)])


def _concat(builder: Any, parts: list[Any]) -> Any:
    """Four Float32x4 end to end as a Float32x16."""
    low, high = (_shuffle(builder, parts[n], parts[n + 1], range(8)) for n in (0, 2))
    return _shuffle(builder, low, high, range(16))


def _load(builder: Any, address: Any, index: Any) -> Any:
    return builder.load(builder.bitcast(builder.gep(address, [index]), _VECTOR4.as_pointer()), align=4)
