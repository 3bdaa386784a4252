"""Groups of four numbers of 16 bits, half floats, in arrays of uint16 (numba): view colours and densities, half the bytes that rays wait for.

Processors with half floats (x86 with F16C, ARM) convert them by themselves; for others that is done with integers, to the same values.
"""

from __future__ import annotations

from typing import Any

from llvmlite import ir
from numba import types
from numba.extending import intrinsic

from efficientnerf.backends.numba.simd import float32x4, multiply_add

GREATEST = 65504.0  # of half floats that are finite
_I16, _I32, _I64 = ir.IntType(16), ir.IntType(32), ir.IntType(64)


def _converts() -> bool:
    """Whether code is compiled for a processor that has half floats."""
    from numba.core.registry import cpu_target

    triple, _, features = cpu_target.target_context.codegen().magic_tuple()
    return triple.startswith(("aarch64", "arm64")) or "+f16c" in features.split(",")


def _vector(kind: Any, count: int) -> Any:
    return ir.VectorType(kind, count)


def _each(kind: Any, x: float) -> Any:
    """A constant in all lanes."""
    return ir.Constant(kind, [x] * kind.count)


def _widen(builder: Any, halves: Any) -> Any:
    """Float32 of a vector of the bits of half floats that are finite."""
    count = halves.type.count
    floats, whole = _vector(ir.FloatType(), count), _vector(_I32, count)
    if _converts():
        return builder.fpext(builder.bitcast(halves, _vector(ir.HalfType(), count)), floats)
    # Exponent and mantissa in their places, the sign above; the exponent's bias is 112 less than that of a float32.
    bits = builder.and_(builder.shl(builder.sext(halves, whole), _each(whole, 13)), _each(whole, -0x70002000))
    return builder.fmul(builder.bitcast(bits, floats), _each(floats, 2.0**112))


def _narrow(builder: Any, value: Any) -> Any:
    """The bits of the half floats nearest to a vector of float32, of which those that are no number become the least and all are at most GREATEST."""
    count = value.type.count
    whole, short = _vector(_I32, count), _vector(_I16, count)
    for order, bound in ((">", -GREATEST), ("<", GREATEST)):
        value = builder.select(builder.fcmp_ordered(order, value, _each(value.type, bound)), value, _each(value.type, bound))
    if _converts():
        return builder.bitcast(builder.fptrunc(value, _vector(ir.HalfType(), count)), short)
    sign = builder.and_(builder.lshr(builder.bitcast(value, whole), _each(whole, 16)), _each(whole, 0x8000))
    bits = builder.and_(builder.bitcast(builder.fmul(value, _each(value.type, 2.0**-112)), whole), _each(whole, 0x7FFFFFFF))
    odd = builder.and_(builder.lshr(bits, _each(whole, 13)), _each(whole, 1))
    bits = builder.lshr(builder.add(builder.add(bits, _each(whole, 0xFFF)), odd), _each(whole, 13))
    return builder.trunc(builder.or_(bits, sign), short)


@intrinsic
def store_halves4(typing_context: Any, address: Any, index: Any, value: Any) -> Any:
    """p[index : index + 4] = value, a Float32x4 rounded to half floats, for a pointer to uint16; beyond GREATEST it is that, and no number -GREATEST."""

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        halves = _narrow(builder, args[2])
        builder.store(halves, builder.bitcast(builder.gep(args[0], [args[1]]), halves.type.as_pointer()), align=2)
        return context.get_dummy_value()

    return types.void(types.CPointer(types.uint16), types.int64, float32x4), codegen


@intrinsic
def mix_pairs(typing_context: Any, weights: Any, at: Any, stride: Any, values: Any, a: Any, b: Any, c: Any, d: Any) -> Any:
    """Weighted sum of eight groups of four half floats: those at q[a], q[b], q[c] and q[d], and the one after each, by two weights each, at p[at],
    p[at + stride] and so on."""

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        pair, eight = _vector(ir.FloatType(), 2), _vector(_I16, 8)
        sums: list[Any] = [None, None]
        for n, index in enumerate(args[4:]):
            place = builder.add(args[1], builder.mul(args[2], ir.Constant(_I64, n)))
            two = builder.load(builder.bitcast(builder.gep(args[0], [place]), pair.as_pointer()), align=4)
            weight = builder.shuffle_vector(two, two, ir.Constant(_vector(_I32, 8), [0, 0, 0, 0, 1, 1, 1, 1]))
            value = _widen(builder, builder.load(builder.bitcast(builder.gep(args[3], [index]), eight.as_pointer()), align=2))
            total = sums[n % 2]
            sums[n % 2] = builder.fmul(weight, value) if total is None else multiply_add(builder, weight, value, total)
        both = builder.fadd(*sums)
        halves = [builder.shuffle_vector(both, both, ir.Constant(_vector(_I32, 4), list(range(n, n + 4)))) for n in (0, 4)]
        return builder.fadd(*halves)

    index = types.int64
    return float32x4(types.CPointer(types.float32), index, index, types.CPointer(types.uint16), index, index, index, index), codegen
