"""Sixteen or thirty-two float32, int32 or booleans in SIMD lanes, with operators: what `simd` has for four.

Operands may be scalars: they are in all lanes. Comparisons give booleans. A vector that is wider than a register, as thirty-two lanes always are, LLVM divides.
"""

from __future__ import annotations

import operator
import sys
from typing import Any

from llvmlite import ir
from numba import types
from numba.extending import intrinsic, models, overload, register_model

from efficientnerf.backends.numba.simd import broadcast_like, float32x16, float32x32, splat, store
from efficientnerf.backends.numba.tree.packets.layout import LANES

_I32, _I64 = ir.IntType(32), ir.IntType(64)


class _Ints(types.Type):
    """Type of a vector of int32."""


class _Bits(types.Type):
    """Type of a vector of booleans."""


int32x16, bool16 = _Ints("SixteenInts"), _Bits("SixteenBits")
int32x32, bool32 = _Ints("ThirtyTwoInts"), _Bits("ThirtyTwoBits")
_FLOATS: dict[int, Any] = {16: float32x16, 32: float32x32}
_INTS: dict[int, Any] = {16: int32x16, 32: int32x32}
_BITS: dict[int, Any] = {16: bool16, 32: bool32}
_COUNTS = {kind: count for family in (_FLOATS, _INTS, _BITS) for count, kind in family.items()}


def _vector(kind: Any) -> Any:
    """The LLVM type of a vector."""
    element = ir.FloatType() if kind in _FLOATS.values() else _I32 if kind in _INTS.values() else ir.IntType(1)
    return ir.VectorType(element, _COUNTS[kind])


@register_model(_Ints)
@register_model(_Bits)
class _VectorModel(models.PrimitiveModel):
    def __init__(self, manager: Any, kind: Any) -> None:
        super().__init__(manager, kind, _vector(kind))


def _spread(builder: Any, value: Any, kind: Any, count: int) -> Any:
    """An operand as a vector."""
    if kind in _COUNTS:
        return value
    if isinstance(kind, types.Integer) and value.type != _I32:
        value = builder.trunc(value, _I32) if value.type.width > 32 else builder.sext(value, _I32)
    return splat(builder, value, count)


def _fits(kind: Any, vector: Any) -> bool:
    """Whether an operand may stand beside a vector."""
    return kind == vector or (isinstance(kind, types.Integer) if vector in _INTS.values() else kind == types.float32 and vector in _FLOATS.values())


def _overload_operator(operation: Any, vector: Any, result: Any, emit: Any) -> None:
    """An operator on two vectors, or on a vector and a scalar; emit(builder, left, right)."""

    @intrinsic
    def elementwise(typing_context: Any, a: Any, b: Any) -> Any:
        def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
            return emit(builder, *(_spread(builder, arg, kind, _COUNTS[vector]) for arg, kind in zip(args, signature.args, strict=True)))

        return result(a, b), codegen

    @overload(operation)
    def implementation(a, b):  # type: ignore[no-untyped-def]
        if vector in (a, b) and _fits(a, vector) and _fits(b, vector):
            return lambda a, b: elementwise(a, b)
        return None


_ORDERS = {operator.lt: "<", operator.le: "<=", operator.gt: ">", operator.ge: ">=", operator.eq: "==", operator.ne: "!="}
for _float, _int, _bool in zip(_FLOATS.values(), _INTS.values(), _BITS.values(), strict=True):
    for _operation, _name in ((operator.add, "fadd"), (operator.sub, "fsub"), (operator.mul, "fmul"), (operator.truediv, "fdiv")):
        _overload_operator(_operation, _float, _float, lambda builder, a, b, name=_name: getattr(builder, name)(a, b))
    for _operation, _name in (
        (operator.add, "add"), (operator.sub, "sub"), (operator.mul, "mul"), (operator.and_, "and_"), (operator.or_, "or_"), (operator.rshift, "lshr"),
        (operator.lshift, "shl"),
    ):  # fmt: skip
        _overload_operator(_operation, _int, _int, lambda builder, a, b, name=_name: getattr(builder, name)(a, b))
    for _operation, _name in ((operator.and_, "and_"), (operator.or_, "or_")):
        _overload_operator(_operation, _bool, _bool, lambda builder, a, b, name=_name: getattr(builder, name)(a, b))
    for _operation, _order in _ORDERS.items():
        _overload_operator(_operation, _float, _bool, lambda builder, a, b, order=_order: builder.fcmp_ordered(order, a, b))
        _overload_operator(_operation, _int, _bool, lambda builder, a, b, order=_order: builder.icmp_signed(order, a, b))


@intrinsic
def _inverted(typing_context: Any, mask: Any) -> Any:
    return mask(mask), lambda context, builder, signature, args: builder.not_(args[0])


@overload(operator.invert)
def _invert(mask):  # type: ignore[no-untyped-def]
    return (lambda mask: _inverted(mask)) if mask in _BITS.values() else None


@intrinsic
def select_lanes(typing_context: Any, mask: Any, a: Any, b: Any) -> Any:
    """a where the mask is set, else b; of float32, int32 or booleans, one of which may be a scalar."""
    vector = next(kind for kind in (a, b) if kind in _COUNTS)

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        kinds, count = signature.args, _COUNTS[vector]
        return builder.select(args[0], _spread(builder, args[1], kinds[1], count), _spread(builder, args[2], kinds[2], count))

    return vector(mask, a, b), codegen


def _call(builder: Any, name: str, value: Any) -> Any:
    """An LLVM intrinsic of a vector."""
    kind = value.type
    letter = "f" if kind.element == ir.FloatType() else "i"
    return builder.call(builder.module.declare_intrinsic(f"llvm.{name}.v{kind.count}{letter}32", (), ir.FunctionType(kind, [kind])), [value])


def _unary(name: str) -> Any:
    """An intrinsic of a vector of float32."""

    @intrinsic
    def elementwise(typing_context: Any, value: Any) -> Any:
        return value(value), lambda context, builder, signature, args: _call(builder, name, args[0])

    return elementwise


floor_lanes, ceil_lanes, abs_lanes, sqrt_lanes = _unary("floor"), _unary("ceil"), _unary("fabs"), _unary("sqrt")


def _chosen(order: str) -> Any:
    """An intrinsic of two vectors of float32, or of one and a scalar: of each lane the first if it stands in this order to the second."""

    @intrinsic
    def elementwise(typing_context: Any, a: Any, b: Any) -> Any:
        vector = a if a in _COUNTS else b

        def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
            left, right = (_spread(builder, arg, kind, _COUNTS[vector]) for arg, kind in zip(args, signature.args, strict=True))
            return builder.select(builder.fcmp_ordered(order, left, right), left, right)

        return vector(a, b), codegen

    return elementwise


min_lanes, max_lanes = _chosen("<"), _chosen(">")  # the second where either is no number


def _broadcast(count: int) -> Any:
    """An intrinsic: a scalar, float32 or an integer, in so many lanes."""

    @intrinsic
    def broadcast(typing_context: Any, value: Any) -> Any:
        vector = (_INTS if isinstance(value, types.Integer) else _FLOATS)[count]
        return vector(value), lambda context, builder, signature, args: _spread(builder, args[0], signature.args[0], count)

    return broadcast


broadcast16, broadcast32 = _broadcast(16), _broadcast(32)


@intrinsic
def to_ints(typing_context: Any, value: Any) -> Any:
    """Float32 to int32, truncated."""
    vector = _INTS[_COUNTS[value]]
    return vector(value), lambda context, builder, signature, args: builder.fptosi(args[0], _vector(vector))


@intrinsic
def to_floats(typing_context: Any, value: Any) -> Any:
    """Int32 to float32."""
    vector = _FLOATS[_COUNTS[value]]
    return vector(value), lambda context, builder, signature, args: builder.sitofp(args[0], _vector(vector))


@intrinsic
def bits_of(typing_context: Any, mask: Any) -> Any:
    """Booleans as an int64, lane 0 the lowest bit."""
    return types.int64(mask), lambda context, builder, signature, args: builder.zext(builder.bitcast(args[0], ir.IntType(_COUNTS[mask])), _I64)


def _mask(count: int) -> Any:
    """An intrinsic: booleans of so many lowest bits of an int64."""

    @intrinsic
    def mask(typing_context: Any, bits: Any) -> Any:
        def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
            return builder.bitcast(builder.trunc(args[0], ir.IntType(count)), _vector(_BITS[count]))

        return _BITS[count](types.int64), codegen

    return mask


mask16, mask32 = _mask(16), _mask(32)


@intrinsic
def lowest_bit(typing_context: Any, bits: Any) -> Any:
    """Number of the lowest set bit of an int64 other than 0."""
    return types.int64(types.int64), lambda context, builder, signature, args: builder.cttz(args[0], ir.Constant(ir.IntType(1), 1))


def _load(count: int) -> Any:
    """An intrinsic: p[index : index + count] of a pointer to float32, or to int32 or uint16 as int32."""

    @intrinsic
    def load(typing_context: Any, address: Any, index: Any) -> Any:
        vector = (_FLOATS if address.dtype == types.float32 else _INTS)[count]
        kind = _vector(vector)
        held, align = (ir.VectorType(ir.IntType(16), count), 2) if address.dtype == types.uint16 else (kind, 4)

        def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
            value = builder.load(builder.bitcast(builder.gep(args[0], [args[1]]), held.as_pointer()), align=align)
            return value if held is kind else builder.zext(value, kind)

        return vector(address, types.int64), codegen

    return load


load16, load32 = _load(16), _load(32)


@intrinsic
def load_bytes8(typing_context: Any, address: Any, index: Any) -> Any:
    """The eight bytes from p[index] on as an int64, the first the lowest."""

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        value = builder.load(builder.bitcast(builder.gep(args[0], [args[1]]), _I64.as_pointer()), align=1)
        return value if sys.byteorder == "little" else builder.bswap(value)

    return types.int64(address, types.int64), codegen


@intrinsic
def store_lanes(typing_context: Any, address: Any, index: Any, value: Any) -> Any:
    """p[index : index + 16 or 32] = value for a pointer to float32 or int32."""

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        builder.store(args[2], builder.bitcast(builder.gep(args[0], [args[1]]), _vector(value).as_pointer()), align=4)
        return context.get_dummy_value()

    return types.void(address, types.int64, value), codegen


def _prefetch(builder: Any, address: Any) -> None:
    place = builder.bitcast(address, ir.IntType(8).as_pointer())
    kind = ir.FunctionType(ir.VoidType(), [place.type, _I32, _I32, _I32])
    to_read, into_all_caches, of_data = (ir.Constant(_I32, n) for n in (0, 3, 1))
    builder.call(builder.module.declare_intrinsic("llvm.prefetch.p0", (), kind), [place, to_read, into_all_caches, of_data])


@intrinsic
def prefetch(typing_context: Any, address: Any, index: Any) -> Any:
    """Asks for the cache line of p[index], and does not wait for it."""

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        _prefetch(builder, builder.gep(args[0], [args[1]]))
        return context.get_dummy_value()

    return types.void(address, types.int64), codegen


@intrinsic
def popcount_lanes(typing_context: Any, bits: Any) -> Any:
    """Number of set bits of each lane of int32."""
    return bits(bits), lambda context, builder, signature, args: _call(builder, "ctpop", args[0])


@intrinsic
def gather_lanes(typing_context: Any, address: Any, index: Any) -> Any:
    """The elements of a pointer that a vector of int32 says, all of which must exist: float32 as such, int32 and uint8 as int32."""
    count = _COUNTS[index]
    vector = (_FLOATS if address.dtype == types.float32 else _INTS)[count]

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        out = ir.Constant(_vector(vector), ir.Undefined)
        for n in range(count):
            lane = ir.Constant(_I64, n)
            value = builder.load(builder.gep(args[0], [builder.sext(builder.extract_element(args[1], lane), _I64)]))
            out = builder.insert_element(out, builder.zext(value, _I32) if address.dtype == types.uint8 else value, lane)
        return out

    return vector(address, index), codegen


@intrinsic
def channels(typing_context: Any, address: Any, index: Any) -> Any:
    """LANES groups of four float32 or int32 from p[index] on: the first of each, the second, the third and the fourth, as four vectors."""
    vector, element = (_INTS[LANES], _I32) if address.dtype == types.int32 else (_FLOATS[LANES], ir.FloatType())

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        kind = ir.VectorType(element, 4 * LANES)
        whole = builder.load(builder.bitcast(builder.gep(args[0], [args[1]]), kind.as_pointer()), align=4)
        lanes = [ir.Constant(ir.VectorType(_I32, LANES), list(range(n, 4 * LANES, 4))) for n in range(4)]
        return context.make_tuple(builder, signature.return_type, [builder.shuffle_vector(whole, whole, each) for each in lanes])

    return types.UniTuple(vector, 4)(address, types.int64), codegen


def _gather_groups(size: int) -> Any:
    """An intrinsic: groups of so many int32 from p[q[at]] on, from p[q[at + 1]] on, and so on for LANES; the first of each, the second, ... as vectors."""

    @intrinsic
    def gather(typing_context: Any, address: Any, places: Any, at: Any) -> Any:
        group = ir.VectorType(_I32, size)

        def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
            parts = []
            for n in range(LANES):
                place = builder.load(builder.gep(args[1], [builder.add(args[2], ir.Constant(_I64, n))]))
                parts.append(builder.load(builder.bitcast(builder.gep(args[0], [builder.sext(place, _I64)]), group.as_pointer()), align=4))
            while len(parts) > 1:
                order = ir.Constant(ir.VectorType(_I32, 2 * parts[0].type.count), list(range(2 * parts[0].type.count)))
                parts = [builder.shuffle_vector(left, right, order) for left, right in zip(parts[::2], parts[1::2], strict=True)]
            lanes = [ir.Constant(ir.VectorType(_I32, LANES), list(range(n, size * LANES, size))) for n in range(size)]
            return context.make_tuple(builder, signature.return_type, [builder.shuffle_vector(parts[0], parts[0], each) for each in lanes])

        return types.UniTuple(_INTS[LANES], size)(types.CPointer(types.int32), types.CPointer(types.int32), types.int64), codegen

    return gather


gather_pairs, gather_fours = _gather_groups(2), _gather_groups(4)


@intrinsic
def prefetch_groups(typing_context: Any, address: Any, places: Any) -> Any:
    """`prefetch` of p[4 n] for each n of 4 LANES int32."""

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        for n in range(4 * LANES):
            place = builder.sext(builder.load(builder.gep(args[1], [ir.Constant(_I64, n)])), _I64)
            _prefetch(builder, builder.gep(args[0], [builder.shl(place, ir.Constant(_I64, 2))]))
        return context.get_dummy_value()

    return types.void(address, types.CPointer(types.int32)), codegen


@intrinsic
def store_pairs(typing_context: Any, address: Any, index: Any, a: Any, b: Any) -> Any:
    """p[index : index + 2 LANES] = a[0], b[0], a[1], b[1], ... for a pointer to float32."""

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        order = [LANES * (n % 2) + n // 2 for n in range(2 * LANES)]
        whole = builder.shuffle_vector(args[2], args[3], ir.Constant(ir.VectorType(_I32, 2 * LANES), order))
        builder.store(whole, builder.bitcast(builder.gep(args[0], [args[1]]), whole.type.as_pointer()), align=4)
        return context.get_dummy_value()

    return types.void(types.CPointer(types.float32), types.int64, _FLOATS[LANES], _FLOATS[LANES]), codegen


@intrinsic
def store_channels(typing_context: Any, address: Any, index: Any, a: Any, b: Any, c: Any, d: Any) -> Any:
    """The reverse of `channels`."""

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        def joined(left: Any, right: Any) -> Any:
            return builder.shuffle_vector(left, right, ir.Constant(ir.VectorType(_I32, 2 * left.type.count), list(range(2 * left.type.count))))

        whole = joined(joined(args[2], args[3]), joined(args[4], args[5]))
        order = ir.Constant(ir.VectorType(_I32, 4 * LANES), [LANES * (n % 4) + n // 4 for n in range(4 * LANES)])
        target = builder.bitcast(builder.gep(args[0], [args[1]]), whole.type.as_pointer())
        builder.store(builder.shuffle_vector(whole, whole, order), target, align=4)
        return context.get_dummy_value()

    return types.void(address, types.int64, a, b, c, d), codegen


@overload(store)
def _store(out, n, value):  # type: ignore[no-untyped-def]
    if value == float32x16:
        return lambda out, n, value: store_lanes(out, 16 * n, value)
    return (lambda out, n, value: store_lanes(out, 32 * n, value)) if value == float32x32 else None


@overload(broadcast_like)
def _broadcast_like(value, other):  # type: ignore[no-untyped-def]
    if other == float32x16:
        return lambda value, other: broadcast16(value)
    return (lambda value, other: broadcast32(value)) if other == float32x32 else None


@intrinsic
def exp2_neg_lanes(typing_context: Any, value: Any) -> Any:
    """2^-x of float32 x >= 0: `simd.exp2_neg4`."""
    from efficientnerf.backends.numba.simd import _constant, _exp2

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        bound = _constant(_vector(value), 126)
        return _exp2(builder, builder.select(builder.fcmp_ordered(">", args[0], bound), bound, args[0]), 127)

    return value(value), codegen
