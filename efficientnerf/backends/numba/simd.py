"""Addresses, and four or sixteen float32 side by side, inside numba kernels: what numba's arrays and scalars cost too much for.

numba neither packs the arithmetic of neighbouring numbers by itself nor has a type for them, but LLVM has one on every processor, and cuts what is wider
than a processor's registers.
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

# 2^-f = 1 + f (c_0 + f (c_1 + ...)) for f from 0 to 1, to 6e-8: least largest error among those that are 1 at 0.
EXP2 = (-0.69314442, 0.24018671, -0.05531669, 0.00922838, -0.00095403)

_LANES = ir.VectorType(ir.FloatType(), 4)
_ALL = ir.VectorType(ir.FloatType(), 16)
_FUSED = ("contract", "reassoc", "nsz")


class Four(types.Type):
    """numba's type of four float32."""

    def __init__(self) -> None:
        super().__init__(name="Four")


class Sixteen(types.Type):
    """numba's type of sixteen float32: four Fours, one after the other."""

    def __init__(self) -> None:
        super().__init__(name="Sixteen")


four, sixteen = Four(), Sixteen()


@register_model(Four)
class _FourModel(models.PrimitiveModel):
    def __init__(self, manager: Any, kind: Any) -> None:
        super().__init__(manager, kind, _LANES)


@register_model(Sixteen)
class _SixteenModel(models.PrimitiveModel):
    def __init__(self, manager: Any, kind: Any) -> None:
        super().__init__(manager, kind, _ALL)


def _arithmetic(operation: Any, name: str) -> None:
    """Lets kernels write an operation on two Fours, or a Four and a float32, as on numbers."""

    @intrinsic
    def each(typing_context: Any, a: Any, b: Any) -> Any:
        def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
            one, other = (arg if isinstance(kind, Four) else spread(builder, arg, 4) for kind, arg in zip(signature.args, args, strict=True))
            return getattr(builder, name)(one, other, flags=_FUSED)

        return four(a, b), codegen

    @overload(operation)
    def implementation(a, b):  # type: ignore[no-untyped-def]
        if {a, b} <= {four, types.float32} and four in {a, b}:
            return lambda a, b: each(a, b)
        return None


for _operation, _name in ((operator.add, "fadd"), (operator.sub, "fsub"), (operator.mul, "fmul")):
    _arithmetic(_operation, _name)


@intrinsic
def one_over_root(typing_context: Any, value: Any) -> Any:
    """1 / sqrt(x) of each of four."""

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        root = builder.module.declare_intrinsic("llvm.sqrt.v4f32", (), ir.FunctionType(_LANES, [_LANES]))
        return builder.fdiv(_constant(_LANES, 1), builder.call(root, [args[0]]))

    return four(four), codegen


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
def ones(typing_context: Any, bits: Any) -> Any:
    """How many bits of an int64 are set."""
    return types.int64(types.int64), lambda context, builder, signature, args: builder.ctpop(args[0])


@intrinsic
def four_at(typing_context: Any, address: Any, index: Any) -> Any:
    """p[index], p[index + 1], p[index + 2], p[index + 3] of a pointer to float32."""

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        return _load(builder, args[0], args[1])

    return four(types.CPointer(types.float32), types.int64), codegen


@intrinsic
def scaled(typing_context: Any, factor: Any, value: Any) -> Any:
    """A float32 times each of four."""

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        return builder.fmul(spread(builder, args[0], 4), args[1], flags=_FUSED)

    return four(types.float32, four), codegen


@intrinsic
def plus_scaled(typing_context: Any, total: Any, factor: Any, value: Any) -> Any:
    """Four plus a float32 times four others, each to its own."""

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        product = builder.fmul(spread(builder, args[1], 4), args[2], flags=_FUSED)
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
def put_four(typing_context: Any, address: Any, index: Any, value: Any) -> Any:
    """Four into p[index], p[index + 1], p[index + 2], p[index + 3] of a pointer to float32."""

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        place = builder.bitcast(builder.gep(args[0], [args[1]]), _LANES.as_pointer())
        builder.store(args[2], place, align=4)
        return context.get_dummy_value()

    return types.void(types.CPointer(types.float32), types.int64, four), codegen


def put(out, n, value):  # type: ignore[no-untyped-def]
    """A number, or four, into the n-th place for such of an array or a pointer: kernels that take both write by it."""
    raise NotImplementedError("inside kernels only")


@overload(put)
def _put(out, n, value):  # type: ignore[no-untyped-def]
    def one(out, n, value):  # type: ignore[no-untyped-def]
        out[n] = value

    return (lambda out, n, value: put_four(out, 4 * n, value)) if value == four else one


def alike(value, other):  # type: ignore[no-untyped-def]
    """A number, or four times that number where `other` is a Four."""
    raise NotImplementedError("inside kernels only")


@overload(alike)
def _alike(value, other):  # type: ignore[no-untyped-def]
    return (lambda value, other: together(value, value, value, value)) if other == four else (lambda value, other: value)


@intrinsic
def logistic(typing_context: Any, value: Any) -> Any:
    """1 / (1 + exp(-x)) of each of four or sixteen, to 3e-6."""

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        def all_of(x: float) -> Any:
            return _constant(args[0].type, x)

        # exp(-x) = 2^-y = 2^(127 - n) 2^-f where y + 127 is n and a fraction f; n is positive, so that cutting off finds it.
        y = _plus(builder, _times(builder, args[0], all_of(math.log2(math.e))), all_of(127))
        for bound, order in ((1.0, "<"), (253.0, ">")):
            y = builder.select(builder.fcmp_ordered(order, y, all_of(bound)), all_of(bound), y)
        return builder.fdiv(all_of(1), _plus(builder, _power(builder, y, 254), all_of(1)))

    return value(value), codegen


@intrinsic
def exp2_minus(typing_context: Any, value: Any) -> Any:
    """2^-x of each of four x >= 0."""

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        bound = _constant(_LANES, 126)
        return _power(builder, builder.select(builder.fcmp_ordered(">", args[0], bound), bound, args[0]), 127)

    return four(four), codegen


@intrinsic
def interpolated(typing_context: Any, address: Any, a: Any, b: Any, c: Any, d: Any, j: Any, i: Any, x: Any, y: Any, z: Any) -> Any:
    """Trilinear interpolation at four points at once, each of four numbers: the first number of each point, as four; and all, as sixteen, point after point.

    address     of float32
    a, b, c, d  where, for each point, the first of its eight neighbours' four numbers lie; the next along z lie 4 on, along y j, and along x i
    x, y, z     four fractions each, of the points

    No-numbers are left out of the sixteen, and the others' weights divided by their sum; where there is nothing else the result is zero. The first four,
    which must be numbers, do not wait for that division.
    """

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        values, starts, (row, layer), fractions = args[0], args[1:5], args[5:7], args[7:]
        sides = [(builder.fsub(_constant(_LANES, 1), f), f) for f in fractions]
        sums, shares = [], []
        for p in range(2):
            for q in range(2):
                edge = _times(builder, sides[0][p], sides[1][q])
                for r in range(2):
                    weight = _each_four_times(builder, _times(builder, edge, sides[2][r]))
                    ahead = ir.Constant(ir.IntType(64), 4 * r)
                    for use, stride in ((p, layer), (q, row)):
                        ahead = builder.add(ahead, stride) if use else ahead
                    value = _joined(builder, [_load(builder, values, builder.add(start, ahead)) for start in starts])
                    there = builder.fcmp_ordered("ord", value, value)
                    sums.append(_times(builder, weight, builder.select(there, value, _constant(_ALL, 0))))
                    shares.append(builder.select(there, weight, _constant(_ALL, 0)))
        total, share = _sum(builder, sums), _sum(builder, shares)
        some = builder.fcmp_ordered(">", share, _constant(_ALL, 0))
        mean = builder.fdiv(total, builder.select(some, share, _constant(_ALL, 1)))
        return context.make_tuple(builder, signature.return_type, [_chosen(builder, total, total, (0, 4, 8, 12)), mean])

    index = types.int64
    both = types.Tuple((four, sixteen))
    return both(types.CPointer(types.float32), index, index, index, index, index, index, four, four, four), codegen


@intrinsic
def nothing(typing_context: Any) -> Any:
    """Sixteen zeros."""
    return sixteen(), lambda context, builder, signature, args: _constant(_ALL, 0)


@intrinsic
def plus_each_scaled(typing_context: Any, total: Any, factor: Any, address: Any, a: Any, b: Any, c: Any, d: Any) -> Any:
    """Sixteen plus four factors times the four numbers each that lie at p[a], p[b], p[c] and p[d]."""

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        value = _joined(builder, [_load(builder, args[2], start) for start in args[3:]])
        return _plus(builder, args[0], _times(builder, _each_four_times(builder, args[1]), value))

    index = types.int64
    return sixteen(sixteen, four, types.CPointer(types.float32), index, index, index, index), codegen


@intrinsic
def quarters(typing_context: Any, value: Any) -> Any:
    """Sixteen as a tuple of four Fours."""

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        parts = [_chosen(builder, args[0], args[0], range(4 * n, 4 * n + 4)) for n in range(4)]
        return context.make_tuple(builder, signature.return_type, parts)

    return types.UniTuple(four, 4)(sixteen), codegen


def spread(builder: Any, value: Any, lanes: int) -> Any:
    """A number in all lanes of a vector."""
    one = builder.insert_element(ir.Constant(ir.VectorType(value.type, lanes), ir.Undefined), value, ir.Constant(ir.IntType(32), 0))
    return builder.shuffle_vector(one, one, ir.Constant(ir.VectorType(ir.IntType(32), lanes), None))


def _times(builder: Any, x: Any, y: Any) -> Any:
    return builder.fmul(x, y, flags=_FUSED)


def _plus(builder: Any, x: Any, y: Any) -> Any:
    return builder.fadd(x, y, flags=_FUSED)


def _sum(builder: Any, values: list[Any]) -> Any:
    """Of an even number of vectors, in pairs: no sum waits for all others."""
    while len(values) > 1:
        values = [builder.fadd(one, other, flags=("contract", "nsz")) for one, other in zip(values[::2], values[1::2], strict=True)]
    return values[0]


def _constant(kind: Any, x: float) -> Any:
    """A number in all lanes."""
    return ir.Constant(kind, [float(np.float32(x)) if isinstance(kind.element, ir.FloatType) else int(x)] * kind.count)


def _power(builder: Any, y: Any, most: int) -> Any:
    """2^(most - 127 - y) for 0 <= y < most."""
    whole = ir.VectorType(ir.IntType(32), y.type.count)
    n = builder.fptosi(y, whole)
    f = builder.fsub(y, builder.sitofp(n, y.type))
    power = _constant(y.type, EXP2[-1])
    for coefficient in (*EXP2[-2::-1], 1.0):
        power = _plus(builder, _times(builder, power, f), _constant(y.type, coefficient))
    exponent = builder.shl(builder.sub(_constant(whole, most), n), _constant(whole, 23))
    return _times(builder, power, builder.bitcast(exponent, y.type))


def _chosen(builder: Any, one: Any, other: Any, lanes: Iterable[int]) -> Any:
    """Lanes of two vectors, one after the other."""
    places = list(lanes)
    return builder.shuffle_vector(one, other, ir.Constant(ir.VectorType(ir.IntType(32), len(places)), places))


def _each_four_times(builder: Any, value: Any) -> Any:
    return _chosen(builder, value, value, [n // 4 for n in range(16)])


def _joined(builder: Any, parts: list[Any]) -> Any:
    """Four Fours as sixteen."""
    low, high = (_chosen(builder, parts[n], parts[n + 1], range(8)) for n in (0, 2))
    return _chosen(builder, low, high, range(16))


def _load(builder: Any, address: Any, index: Any) -> Any:
    return builder.load(builder.bitcast(builder.gep(address, [index]), _LANES.as_pointer()), align=4)
