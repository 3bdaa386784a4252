"""Groups of four numbers of 16 bits, half floats, in arrays of uint16 (numba): view colours and densities, half the bytes that rays wait for.

Processors with half floats (x86 with F16C, ARM) convert them by themselves; for others that is done with integers, to the same values.
"""

from __future__ import annotations

from typing import Any

from llvmlite import ir
from numba import types
from numba.core.registry import cpu_target
from numba.extending import intrinsic

from efficientnerf.backends.numba.simd import float32x4, float32x16, float32x32, multiply_add
from efficientnerf.backends.numba.tree.packets.layout import LANES

GREATEST = 65504.0  # of half floats that are finite
_I16, _I32, _I64 = ir.IntType(16), ir.IntType(32), ir.IntType(64)


def _converts() -> bool:
    """Whether code is compiled for a processor that has half floats."""
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


def _shuffled(builder: Any, left: Any, right: Any, lanes: list[int]) -> Any:
    return builder.shuffle_vector(left, right, ir.Constant(_vector(_I32, len(lanes)), lanes))


def _mix_two(builder: Any, weights: Any, voxels: Any, values: Any, lane: int) -> Any:
    """Weighted sums of the pairs of rays `lane` and `lane + 1`: of the first voxels and of the second of one, then of the other, four numbers each."""

    def load(address: Any, at: Any, kind: Any, align: int) -> Any:
        return builder.load(builder.bitcast(builder.gep(address, [at]), kind.as_pointer()), align=align)

    sums: list[Any] = [None, None]
    for n in range(4):
        four = load(weights, ir.Constant(_I64, 2 * LANES * n + 2 * lane), _vector(ir.FloatType(), 4), 4)
        weight = _shuffled(builder, four, four, [m // 4 for m in range(16)])
        pairs = []
        for m in range(2):
            voxel = builder.sext(builder.load(builder.gep(voxels, [ir.Constant(_I64, LANES * n + lane + m)])), _I64)
            pairs.append(load(values, builder.shl(voxel, ir.Constant(_I64, 2)), _vector(_I16, 8), 2))
        value, total = _widen(builder, _shuffled(builder, pairs[0], pairs[1], list(range(16)))), sums[n % 2]
        sums[n % 2] = builder.fmul(weight, value) if total is None else multiply_add(builder, weight, value, total)
    return builder.fadd(*sums)


@intrinsic
def mix_pairs(typing_context: Any, weights: Any, voxels: Any, values: Any) -> Any:
    """Weighted sums of eight groups of four half floats for each of LANES rays: of the first numbers of the groups, of the second and so on, as four vectors.

    weights  (4, LANES, 2) float32: of four pairs of neighbouring groups
    voxels   (4, LANES) int32: which group is the first of each pair
    values   groups of four uint16; all those that `voxels` says must exist
    """

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        fours = []
        for lane in range(0, LANES, 4):
            one, other = (_mix_two(builder, args[0], args[1], args[2], lane + m) for m in (0, 2))
            low, high = (_shuffled(builder, one, other, [8 * (m // 4) + m % 4 + at for m in range(16)]) for at in (0, 4))
            fours.append(builder.fadd(low, high))
        while len(fours) > 1:
            fours = [_shuffled(builder, low, high, list(range(2 * low.type.count))) for low, high in zip(fours[::2], fours[1::2], strict=True)]
        channels = [_shuffled(builder, fours[0], fours[0], list(range(n, 4 * LANES, 4))) for n in range(4)]
        return context.make_tuple(builder, signature.return_type, channels)

    result = types.UniTuple(float32x32 if LANES == 32 else float32x16, 4)
    return result(types.CPointer(types.float32), types.CPointer(types.int32), types.CPointer(types.uint16)), codegen
