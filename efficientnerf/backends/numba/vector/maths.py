"""Functions of vectors, lane by lane unless they say otherwise; some take scalars as well."""

import math
from typing import Any

import numpy as np
from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic, overload

from efficientnerf.backends.numba.runtime import numba
from efficientnerf.backends.numba.vector import emit
from efficientnerf.backends.numba.vector.types import Vector, element_of, spread, vector_among

LOG2_E = np.float32(math.log2(math.e))
_NONE, _ONE, _TWO = np.float32(0), np.float32(1), np.float32(2)


@intrinsic(prefer_literal=True)
def broadcast(typing_context: Any, value: Any, count: Any) -> Any:
    """A scalar, float32, float64 or an integer, in so many lanes."""
    kind = types.unliteral(value)
    vector = Vector(element_of(kind), count.literal_value)
    return vector(kind, count), emit.emits(lambda builder, value, count: spread(builder, value, kind, vector.count))


def broadcast_like(value, other):
    """The scalar `value`, or a vector of it where `other` is one."""
    raise NotImplementedError("inside kernels only")


@overload(broadcast_like)
def _broadcast_like(value, other):
    if not isinstance(other, Vector):
        return lambda value, other: value
    count = other.count
    return lambda value, other: broadcast(value, count)


@intrinsic
def pack(typing_context: Any, numbers: Any) -> Any:
    """A vector of the scalars of a tuple."""
    count = numbers.count
    return Vector(numbers.dtype, count)(numbers), emit.emits(lambda builder, numbers: emit.pack(builder, cgutils.unpack_tuple(builder, numbers, count)))


@intrinsic
def unpack(typing_context: Any, value: Any) -> Any:
    """The lanes as a tuple."""
    return types.UniTuple(value.element, value.count)(value), emit.emits(emit.unpack)


@intrinsic(prefer_literal=True)
def lane_numbers(typing_context: Any, count: Any) -> Any:
    """0, 1, ... in so many lanes of float64."""
    vector = Vector(types.float64, count.literal_value)
    return vector(count), emit.emits(lambda builder, count: ir.Constant(vector.llvm, [float(n) for n in range(vector.count)]))


@intrinsic
def select(typing_context: Any, mask: Any, a: Any, b: Any) -> Any:
    """a where the mask is set, else b; vectors or scalars."""
    vector = vector_among(a, b) or mask.of(element_of(types.unliteral(a)))

    def body(builder: Any, mask: Any, *args: Any) -> Any:
        return builder.select(mask, *(spread(builder, arg, kind, vector.count) for arg, kind in zip(args, (a, b), strict=True)))

    return vector(mask, a, b), emit.emits(body)


def _chosen(order: str) -> Any:
    """An intrinsic of two vectors of floats, or of one and a scalar: of each lane the first if it stands in this order to the second."""

    @intrinsic
    def elementwise(typing_context: Any, a: Any, b: Any) -> Any:
        vector = vector_among(a, b)

        def body(builder: Any, *args: Any) -> Any:
            left, right = (spread(builder, arg, kind, vector.count) for arg, kind in zip(args, (a, b), strict=True))
            return builder.select(builder.fcmp_ordered(order, left, right), left, right)

        return vector(a, b), emit.emits(body)

    return elementwise


minimum, maximum = _chosen("<"), _chosen(">")  # the second where either is NaN


@intrinsic
def fma(typing_context: Any, a: Any, b: Any, total: Any) -> Any:
    """a b + total of floats, scalars or vectors: rounded once where the processor has an instruction for it."""
    vector = vector_among(a, b, total)
    if vector is None and not a == b == total:
        raise TypeError(f"fma of {a}, {b} and {total}: expected numbers of one type")

    def body(builder: Any, *args: Any) -> Any:
        spread_out = args if vector is None else (spread(builder, arg, kind, vector.count) for arg, kind in zip(args, (a, b, total), strict=True))
        return emit.fma(builder, *spread_out)

    return (vector or a)(a, b, total), emit.emits(body)


def _unary(name: str) -> Any:
    """An intrinsic of LLVM on a float or a vector of floats."""

    @intrinsic
    def elementwise(typing_context: Any, value: Any) -> Any:
        return value(value), emit.emits(lambda builder, value: emit.call(builder, name, value))

    return elementwise


floor, ceil, absolute, sqrt = _unary("floor"), _unary("ceil"), _unary("fabs"), _unary("sqrt")


@intrinsic
def exp2_neg(typing_context: Any, value: Any) -> Any:
    """2^-x of a float32 or a vector of float32 for x >= 0, to 2e-7."""

    def body(builder: Any, value: Any) -> Any:
        bound = emit.constant(value.type, 126)
        return emit.exp2(builder, builder.select(builder.fcmp_ordered(">", value, bound), bound, value), 127)

    return value(value), emit.emits(body)


@intrinsic
def sigmoid(typing_context: Any, value: Any) -> Any:
    """Logistic function 1 / (1 + exp(-x)) of a vector of float32, to 3e-6."""

    def body(builder: Any, value: Any) -> Any:
        def constant(x: float) -> Any:
            return emit.constant(value.type, x)

        # exp(-x) = 2^-y = 2^(127 - n) 2^-f with y + 127 = n + f, 0 <= f < 1. n is positive, so truncation finds it.
        y = emit.fma(builder, value, constant(math.log2(math.e)), constant(127))
        for bound, order in ((1.0, "<"), (253.0, ">")):
            y = builder.select(builder.fcmp_ordered(order, y, constant(bound)), constant(bound), y)
        return builder.fdiv(constant(1), builder.fadd(emit.exp2(builder, y, 254), constant(1)))

    return value(value), emit.emits(body)


@numba.njit(cache=True, inline="always", error_model="numpy")
def exp(x):
    """e^x of a vector of float32 for x from -80 to 80."""
    y = x * LOG2_E
    return exp2_neg(maximum(y * np.float32(-1), _NONE)) / exp2_neg(maximum(y, _NONE))


@numba.njit(cache=True, inline="always", error_model="numpy")
def arctangent(t):
    """Arc tangent of a vector of float32 t >= 0, to 3e-7."""
    steep = t > _ONE
    x = select(steep, _ONE / maximum(t, np.float32(1e-30)), t)
    # Half of the angle lies within an eighth of a turn, where a short series is exact.
    x = x / (_ONE + sqrt(_ONE + x * x))
    y = x * x
    series = np.float32(0.11111111) - y * (np.float32(0.09090909) - y * np.float32(0.07692308))
    series = _ONE - y * (np.float32(0.33333333) - y * (np.float32(0.2) - y * (np.float32(0.14285715) - y * series)))
    angle = _TWO * x * series
    return select(steep, np.float32(np.pi / 2) - angle, angle)


def _conversion(element: Any, names: dict[Any, str]) -> Any:
    """An intrinsic: the same numbers as another element; names: the instruction by the element they are."""

    @intrinsic
    def convert(typing_context: Any, value: Any) -> Any:
        vector, instruction = value.of(element), names[value.element]
        return vector(value), emit.emits(lambda builder, value: getattr(builder, instruction)(value, vector.llvm))

    return convert


to_int32 = _conversion(types.int32, {types.float32: "fptosi"})  # truncated
to_float32 = _conversion(types.float32, {types.int32: "sitofp", types.float64: "fptrunc"})
to_float64 = _conversion(types.float64, {types.float32: "fpext"})


@intrinsic
def sum_lanes(typing_context: Any, value: Any) -> Any:
    """Sum over the lanes of float32, by halves; of int32, as an int64."""
    whole = value.element == types.int32

    def body(builder: Any, total: Any) -> Any:
        count = value.count
        while count > 1:
            count //= 2
            total = (builder.add if whole else builder.fadd)(*(emit.shuffle(builder, total, total, range(n, n + count)) for n in (0, count)))
        total = builder.extract_element(total, ir.Constant(emit.I32, 0))
        return builder.sext(total, emit.I64) if whole else total

    return (types.int64 if whole else value.element)(value), emit.emits(body)


@intrinsic
def sum_each(typing_context: Any, values: Any) -> Any:
    """Sums over the lanes of each vector of a tuple, by halves as `sum_lanes`, in the first lanes of one; the rest are 0."""
    vector, given = values.dtype, values.count

    def body(builder: Any, values: Any) -> Any:
        zero, lanes = ir.Constant(vector.llvm, None), vector.count
        vectors = [*cgutils.unpack_tuple(builder, values, given), *[zero] * (lanes - given)]
        width = lanes  # lanes that still belong to one sum
        while width > 1:
            half = width // 2
            # The first (or second) halves of the sums of one vector, then those of the other.
            firsts = [start + n for start in range(0, 2 * lanes, width) for n in range(half)]
            joined = []
            for left, right in zip(vectors[::2], vectors[1::2], strict=True):
                if left is zero:
                    joined.append(zero)
                    continue
                joined.append(builder.fadd(*(emit.shuffle(builder, left, right, [at + shift for at in firsts]) for shift in (0, half))))
            vectors, width = joined, half
        return vectors[0]

    return vector(values), emit.emits(body)


@intrinsic
def bits_of(typing_context: Any, mask: Any) -> Any:
    """Booleans as an int64, lane 0 the lowest bit."""
    bits = ir.IntType(mask.count)
    return types.int64(mask), emit.emits(lambda builder, mask: builder.zext(builder.bitcast(mask, bits), emit.I64))


@intrinsic(prefer_literal=True)
def mask_of(typing_context: Any, bits: Any, count: Any) -> Any:
    """Booleans of so many lowest bits of an int64."""
    vector = Vector(types.boolean, count.literal_value)
    convert = emit.emits(lambda builder, bits, count: builder.bitcast(builder.trunc(bits, ir.IntType(vector.count)), vector.llvm))
    return vector(types.int64, count), convert


@intrinsic
def lowest_bit(typing_context: Any, bits: Any) -> Any:
    """Number of the lowest set bit of an int64 other than 0."""
    return types.int64(types.int64), emit.emits(lambda builder, bits: builder.cttz(bits, ir.Constant(emit.I1, 1)))


@intrinsic
def popcount(typing_context: Any, bits: Any) -> Any:
    """Number of set bits of an int64, or of each lane of int32."""
    kind = bits if isinstance(bits, Vector) else types.int64
    return kind(kind), emit.emits(lambda builder, bits: emit.call(builder, "ctpop", bits))
