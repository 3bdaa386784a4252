"""Sixteen or thirty-two float32, int32 or booleans, or thirty-two float64, in SIMD lanes, with operators: what `simd` has for four.

Operands may be scalars: they are in all lanes. Comparisons give booleans. A vector that is wider than a register, as thirty-two lanes always are, LLVM divides.
"""

from __future__ import annotations

import operator
import sys
from typing import Any

from llvmlite import ir
from numba import types
from numba.extending import intrinsic, models, overload, register_model

from efficientnerf.backends.numba.simd import _constant, _exp2, broadcast_like, float32x16, float32x32, splat, store

_I32, _I64 = ir.IntType(32), ir.IntType(64)


class _Ints(types.Type):
    """Type of a vector of int32."""


class _Doubles(types.Type):
    """Type of a vector of float64."""


class _Bits(types.Type):
    """Type of a vector of booleans."""


int32x16, bool16 = _Ints("SixteenInts"), _Bits("SixteenBits")
int32x32, bool32 = _Ints("ThirtyTwoInts"), _Bits("ThirtyTwoBits")
float64x32 = _Doubles("ThirtyTwoDoubles")
FLOATS: dict[int, Any] = {16: float32x16, 32: float32x32}
INTS: dict[int, Any] = {16: int32x16, 32: int32x32}
_BITS: dict[int, Any] = {16: bool16, 32: bool32}
_DOUBLES: dict[int, Any] = {32: float64x32}
_COUNTS = {kind: count for family in (FLOATS, INTS, _BITS, _DOUBLES) for count, kind in family.items()}


def _vector(kind: Any) -> Any:
    """The LLVM type of a vector."""
    elements = ((FLOATS, ir.FloatType()), (INTS, _I32), (_BITS, ir.IntType(1)), (_DOUBLES, ir.DoubleType()))
    return ir.VectorType(next(element for family, element in elements if kind in family.values()), _COUNTS[kind])


def _of(element: Any, count: int) -> Any:
    """The type of so many float32, float64, or integers."""
    return (INTS if isinstance(element, types.Integer) else _DOUBLES if element == types.float64 else FLOATS)[count]


@register_model(_Ints)
@register_model(_Bits)
@register_model(_Doubles)
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
    if vector in INTS.values():
        return kind == vector or isinstance(kind, types.Integer)
    return kind == vector or (kind, vector) in [(types.float32, each) for each in FLOATS.values()] + [(types.float64, each) for each in _DOUBLES.values()]


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
for _float, _bool in (*zip(FLOATS.values(), _BITS.values(), strict=True), (float64x32, bool32)):
    for _operation, _name in ((operator.add, "fadd"), (operator.sub, "fsub"), (operator.mul, "fmul"), (operator.truediv, "fdiv")):
        _overload_operator(_operation, _float, _float, lambda builder, a, b, name=_name: getattr(builder, name)(a, b))
    for _operation, _order in _ORDERS.items():
        _overload_operator(_operation, _float, _bool, lambda builder, a, b, order=_order: builder.fcmp_ordered(order, a, b))
for _int, _bool in zip(INTS.values(), _BITS.values(), strict=True):
    for _operation, _name in (
        (operator.add, "add"), (operator.sub, "sub"), (operator.mul, "mul"), (operator.and_, "and_"), (operator.or_, "or_"), (operator.rshift, "lshr"),
        (operator.lshift, "shl"),
    ):  # fmt: skip
        _overload_operator(_operation, _int, _int, lambda builder, a, b, name=_name: getattr(builder, name)(a, b))
    for _operation, _name in ((operator.and_, "and_"), (operator.or_, "or_")):
        _overload_operator(_operation, _bool, _bool, lambda builder, a, b, name=_name: getattr(builder, name)(a, b))
    for _operation, _order in _ORDERS.items():
        _overload_operator(_operation, _int, _bool, lambda builder, a, b, order=_order: builder.icmp_signed(order, a, b))


@intrinsic
def _inverted(typing_context: Any, mask: Any) -> Any:
    return mask(mask), lambda context, builder, signature, args: builder.not_(args[0])


@overload(operator.invert)
def _invert(mask):  # type: ignore[no-untyped-def]
    return (lambda mask: _inverted(mask)) if mask in _BITS.values() else None


@intrinsic
def select_lanes(typing_context: Any, mask: Any, a: Any, b: Any) -> Any:
    """a where the mask is set, else b; of float32, float64, int32 or booleans, one of which may be a scalar."""
    vector = next(kind for kind in (a, b) if kind in _COUNTS)

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        kinds, count = signature.args, _COUNTS[vector]
        return builder.select(args[0], _spread(builder, args[1], kinds[1], count), _spread(builder, args[2], kinds[2], count))

    return vector(mask, a, b), codegen


def _call(builder: Any, name: str, value: Any) -> Any:
    """An LLVM intrinsic of a vector, or of a float64."""
    kind = value.type
    suffix = "f64"
    if isinstance(kind, ir.VectorType):
        suffix = f"v{kind.count}" + {ir.FloatType(): "f32", ir.DoubleType(): "f64"}.get(kind.element, "i32")
    return builder.call(builder.module.declare_intrinsic(f"llvm.{name}.{suffix}", (), ir.FunctionType(kind, [kind])), [value])


def _unary(name: str) -> Any:
    """An intrinsic of a vector of float32 or float64, or of one float64."""

    @intrinsic
    def elementwise(typing_context: Any, value: Any) -> Any:
        return value(value), lambda context, builder, signature, args: _call(builder, name, args[0])

    return elementwise


floor_lanes, ceil_lanes, abs_lanes, sqrt_lanes = _unary("floor"), _unary("ceil"), _unary("fabs"), _unary("sqrt")


def _chosen(order: str) -> Any:
    """An intrinsic of two vectors of float32 or float64, or of one and a scalar: of each lane the first if it stands in this order to the second."""

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
    """An intrinsic: a scalar, float32, float64 or an integer, in so many lanes."""

    @intrinsic
    def broadcast(typing_context: Any, value: Any) -> Any:
        vector = _of(value, count)
        return vector(value), lambda context, builder, signature, args: _spread(builder, args[0], signature.args[0], count)

    return broadcast


broadcast16, broadcast32 = _broadcast(16), _broadcast(32)


@intrinsic
def to_ints(typing_context: Any, value: Any) -> Any:
    """Float32 to int32, truncated."""
    vector = INTS[_COUNTS[value]]
    return vector(value), lambda context, builder, signature, args: builder.fptosi(args[0], _vector(vector))


@intrinsic
def to_floats(typing_context: Any, value: Any) -> Any:
    """Int32 or float64 to float32."""
    vector, convert = FLOATS[_COUNTS[value]], "fptrunc" if value in _DOUBLES.values() else "sitofp"
    return vector(value), lambda context, builder, signature, args: getattr(builder, convert)(args[0], _vector(vector))


@intrinsic
def to_doubles(typing_context: Any, value: Any) -> Any:
    """Float32 to float64."""
    vector = _DOUBLES[_COUNTS[value]]
    return vector(value), lambda context, builder, signature, args: builder.fpext(args[0], _vector(vector))


@intrinsic
def lane_numbers(typing_context: Any) -> Any:
    """0, 1, ... in thirty-two lanes of float64."""
    return float64x32(), lambda context, builder, signature, args: ir.Constant(_vector(float64x32), [float(n) for n in range(32)])


@intrinsic
def sum_lanes(typing_context: Any, value: Any) -> Any:
    """Sum of a vector of int32."""

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        kind = args[0].type
        total = builder.module.declare_intrinsic(f"llvm.vector.reduce.add.v{kind.count}i32", (), ir.FunctionType(_I32, [kind]))
        return builder.sext(builder.call(total, [args[0]]), _I64)

    return types.int64(value), codegen


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
    """An intrinsic: p[index : index + count] of a pointer to float32 or float64, or to int32 or uint16 as int32."""

    @intrinsic
    def load(typing_context: Any, address: Any, index: Any) -> Any:
        vector = _of(address.dtype, count)
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
    """p[index : index + 16 or 32] = value for a pointer to float32, float64 or int32."""

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        builder.store(args[2], builder.bitcast(builder.gep(args[0], [args[1]]), _vector(value).as_pointer()), align=4)
        return context.get_dummy_value()

    return types.void(address, types.int64, value), codegen


def ask_for(builder: Any, address: Any) -> None:
    """`prefetch` of an address, for other intrinsics."""
    place = builder.bitcast(address, ir.IntType(8).as_pointer())
    kind = ir.FunctionType(ir.VoidType(), [place.type, _I32, _I32, _I32])
    to_read, into_all_caches, of_data = (ir.Constant(_I32, n) for n in (0, 3, 1))
    builder.call(builder.module.declare_intrinsic("llvm.prefetch.p0", (), kind), [place, to_read, into_all_caches, of_data])


@intrinsic
def prefetch(typing_context: Any, address: Any, index: Any) -> Any:
    """Asks for the cache line of p[index], and does not wait for it."""

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        ask_for(builder, builder.gep(args[0], [args[1]]))
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
    vector = (FLOATS if address.dtype == types.float32 else INTS)[count]

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        out = ir.Constant(_vector(vector), ir.Undefined)
        for n in range(count):
            lane = ir.Constant(_I64, n)
            value = builder.load(builder.gep(args[0], [builder.sext(builder.extract_element(args[1], lane), _I64)]))
            out = builder.insert_element(out, builder.zext(value, _I32) if address.dtype == types.uint8 else value, lane)
        return out

    return vector(address, index), codegen


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
    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        bound = _constant(_vector(value), 126)
        return _exp2(builder, builder.select(builder.fcmp_ordered(">", args[0], bound), bound, args[0]), 127)

    return value(value), codegen
