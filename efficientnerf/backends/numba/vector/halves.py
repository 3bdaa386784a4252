"""Groups of four half floats in arrays of uint16: view colours and densities, half the bytes that rays wait for.

Processors with half floats (x86 with F16C, ARM) convert them by themselves; for others that is done with integers, to the same values.
"""

from typing import Any

from llvmlite import ir
from numba import types
from numba.core.registry import cpu_target
from numba.extending import intrinsic

from efficientnerf.backends.numba.vector import emit
from efficientnerf.backends.numba.vector.types import Vector

GREATEST = 65504.0  # of half floats that are finite


def _converts() -> bool:
    """Whether code is compiled for a processor that has half floats."""
    triple, _, features = cpu_target.target_context.codegen().magic_tuple()
    return triple.startswith(("aarch64", "arm64")) or "+f16c" in features.split(",")


def _widen(builder: Any, halves: Any) -> Any:
    """Float32 of a vector of the bits of half floats that are finite."""
    floats, whole = emit.like(halves.type, emit.F32), emit.like(halves.type, emit.I32)
    if _converts():
        return builder.fpext(builder.bitcast(halves, emit.like(halves.type, ir.HalfType())), floats)
    # Exponent and mantissa in their places, the sign above; the exponent's bias is 112 less than that of a float32.
    bits = builder.and_(builder.shl(builder.sext(halves, whole), emit.constant(whole, 13)), emit.constant(whole, -0x70002000))
    return builder.fmul(builder.bitcast(bits, floats), emit.constant(floats, 2.0**112))


def _narrow(builder: Any, value: Any) -> Any:
    """The bits of the half floats nearest to a vector of float32; at most GREATEST, and NaN becomes -GREATEST."""
    whole, short = emit.like(value.type, emit.I32), emit.like(value.type, emit.I16)

    def constant(x: int) -> Any:
        return emit.constant(whole, x)

    for order, bound in ((">", -GREATEST), ("<", GREATEST)):
        limit = emit.constant(value.type, bound)
        value = builder.select(builder.fcmp_ordered(order, value, limit), value, limit)
    if _converts():
        return builder.bitcast(builder.fptrunc(value, emit.like(value.type, ir.HalfType())), short)
    sign = builder.and_(builder.lshr(builder.bitcast(value, whole), constant(16)), constant(0x8000))
    bits = builder.and_(builder.bitcast(builder.fmul(value, emit.constant(value.type, 2.0**-112)), whole), constant(0x7FFFFFFF))
    odd = builder.and_(builder.lshr(bits, constant(13)), constant(1))
    bits = builder.lshr(builder.add(builder.add(bits, constant(0xFFF)), odd), constant(13))
    return builder.trunc(builder.or_(bits, sign), short)


@intrinsic
def store_halves(typing_context: Any, address: Any, index: Any, value: Any) -> Any:
    """p[index : index + count] = a vector of float32 rounded to half floats, for a pointer to uint16; beyond GREATEST it is that, and NaN -GREATEST."""
    store = emit.emits(lambda builder, address, index, value: emit.store(builder, address, index, _narrow(builder, value)))
    return types.void(types.CPointer(types.uint16), types.int64, value), store


def _mix_two(builder: Any, weights: Any, voxels: Any, values: Any, lane: int, count: int) -> Any:
    """Weighted sums of the pairs of rays `lane` and `lane + 1`: of the first voxels and of the second of one, then of the other, four numbers each."""
    sums: list[Any] = [None, None]
    for n in range(4):
        four = emit.load(builder, weights, emit.index(2 * count * n + 2 * lane), ir.VectorType(emit.F32, 4))
        weight = emit.shuffle(builder, four, four, [m // 4 for m in range(16)])
        pairs = []
        for m in range(2):
            voxel = builder.sext(builder.load(builder.gep(voxels, [emit.index(count * n + lane + m)])), emit.I64)
            pairs.append(emit.load(builder, values, builder.shl(voxel, emit.index(2)), ir.VectorType(emit.I16, 8)))
        value, total = _widen(builder, emit.shuffle(builder, pairs[0], pairs[1], range(16))), sums[n % 2]
        sums[n % 2] = builder.fmul(weight, value) if total is None else emit.fma(builder, weight, value, total)
    return builder.fadd(*sums)


@intrinsic(prefer_literal=True)
def mix_pairs(typing_context: Any, weights: Any, voxels: Any, values: Any, count: Any) -> Any:
    """Weighted sums of eight groups of four half floats for each of `count` rays: of the first numbers of the groups, of the second and so on, as four vectors.

    weights  (4, count, 2) float32: of four pairs of neighbouring groups
    voxels   (4, count) int32: which group is the first of each pair
    values   groups of four uint16; all those that `voxels` says must exist
    """
    lanes = count.literal_value

    def body(builder: Any, weights: Any, voxels: Any, values: Any, count: Any) -> list[Any]:
        fours = []
        for lane in range(0, lanes, 4):
            one, other = (_mix_two(builder, weights, voxels, values, lane + m, lanes) for m in (0, 2))
            low, high = (emit.shuffle(builder, one, other, [8 * (m // 4) + m % 4 + at for m in range(16)]) for at in (0, 4))
            fours.append(builder.fadd(low, high))
        whole = emit.concatenate(builder, fours)
        return [emit.shuffle(builder, whole, whole, range(n, 4 * lanes, 4)) for n in range(4)]

    result = types.UniTuple(Vector(types.float32, lanes), 4)
    return result(types.CPointer(types.float32), types.CPointer(types.int32), types.CPointer(types.uint16), count), emit.emits(body)
