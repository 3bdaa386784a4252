"""Sixteen float32, int32 or booleans in SIMD lanes, with operators: what `simd` has for four.

Operands may be scalars: they are in all lanes. Comparisons give a Bool16. A vector is wider than a register on processors without AVX-512; LLVM divides it.
"""

from __future__ import annotations

import operator
import sys
from typing import Any

from llvmlite import ir
from numba import types
from numba.extending import intrinsic, models, overload, register_model

from efficientnerf.backends.numba.simd import Float32x16, broadcast_like, float32x16, splat, store

LANES = 16
_I32, _I64 = ir.IntType(32), ir.IntType(64)
_FLOATS, _INTS, _BITS = (ir.VectorType(kind, LANES) for kind in (ir.FloatType(), _I32, ir.IntType(1)))


class Int32x16(types.Type):
    """Type of a vector of sixteen int32."""

    def __init__(self) -> None:
        super().__init__(name="SixteenInts")


class Bool16(types.Type):
    """Type of a vector of sixteen booleans."""

    def __init__(self) -> None:
        super().__init__(name="SixteenBits")


int32x16, bool16 = Int32x16(), Bool16()


@register_model(Int32x16)
class _Int32x16Model(models.PrimitiveModel):
    def __init__(self, manager: Any, kind: Any) -> None:
        super().__init__(manager, kind, _INTS)


@register_model(Bool16)
class _Bool16Model(models.PrimitiveModel):
    def __init__(self, manager: Any, kind: Any) -> None:
        super().__init__(manager, kind, _BITS)


def _spread(builder: Any, value: Any, kind: Any) -> Any:
    """An operand as a vector."""
    if isinstance(kind, (Float32x16, Int32x16, Bool16)):
        return value
    if isinstance(kind, types.Integer) and value.type != _I32:
        value = builder.trunc(value, _I32) if value.type.width > 32 else builder.sext(value, _I32)
    return splat(builder, value, LANES)


def _fits(kind: Any, vector: Any) -> bool:
    """Whether an operand may stand beside a vector."""
    scalar = types.Integer if vector == int32x16 else types.Float if vector == float32x16 else ()
    return kind == vector or (isinstance(kind, scalar) and (vector == int32x16 or kind == types.float32))


def _overload_operator(operation: Any, vector: Any, result: Any, emit: Any) -> None:
    """An operator on two vectors, or on a vector and a scalar; emit(builder, left, right)."""

    @intrinsic
    def elementwise(typing_context: Any, a: Any, b: Any) -> Any:
        def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
            return emit(builder, *(_spread(builder, arg, kind) for arg, kind in zip(args, signature.args, strict=True)))

        return result(a, b), codegen

    @overload(operation)
    def implementation(a, b):  # type: ignore[no-untyped-def]
        if vector in (a, b) and _fits(a, vector) and _fits(b, vector):
            return lambda a, b: elementwise(a, b)
        return None


_ORDERS = {operator.lt: "<", operator.le: "<=", operator.gt: ">", operator.ge: ">=", operator.eq: "==", operator.ne: "!="}
for _operation, _name in ((operator.add, "fadd"), (operator.sub, "fsub"), (operator.mul, "fmul"), (operator.truediv, "fdiv")):
    _overload_operator(_operation, float32x16, float32x16, lambda builder, a, b, name=_name: getattr(builder, name)(a, b))
for _operation, _name in (
    (operator.add, "add"), (operator.sub, "sub"), (operator.mul, "mul"), (operator.and_, "and_"), (operator.or_, "or_"), (operator.rshift, "lshr"),
    (operator.lshift, "shl"),
):  # fmt: skip
    _overload_operator(_operation, int32x16, int32x16, lambda builder, a, b, name=_name: getattr(builder, name)(a, b))
for _operation, _name in ((operator.and_, "and_"), (operator.or_, "or_")):
    _overload_operator(_operation, bool16, bool16, lambda builder, a, b, name=_name: getattr(builder, name)(a, b))
for _operation, _order in _ORDERS.items():
    _overload_operator(_operation, float32x16, bool16, lambda builder, a, b, order=_order: builder.fcmp_ordered(order, a, b))
    _overload_operator(_operation, int32x16, bool16, lambda builder, a, b, order=_order: builder.icmp_signed(order, a, b))


@intrinsic
def _inverted(typing_context: Any, mask: Any) -> Any:
    return bool16(bool16), lambda context, builder, signature, args: builder.not_(args[0])


@overload(operator.invert)
def _invert(mask):  # type: ignore[no-untyped-def]
    return (lambda mask: _inverted(mask)) if mask == bool16 else None


@intrinsic
def select16(typing_context: Any, mask: Any, a: Any, b: Any) -> Any:
    """a where the mask is set, else b; of float32, int32 or booleans, one of which may be a scalar."""
    vector = next(kind for kind in (a, b) if kind in (float32x16, int32x16, bool16))

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        kinds = signature.args
        return builder.select(args[0], _spread(builder, args[1], kinds[1]), _spread(builder, args[2], kinds[2]))

    return vector(bool16, a, b), codegen


def _unary(name: str) -> Any:
    """An LLVM intrinsic of a Float32x16."""

    @intrinsic
    def elementwise(typing_context: Any, value: Any) -> Any:
        def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
            function = builder.module.declare_intrinsic(f"llvm.{name}.v16f32", (), ir.FunctionType(_FLOATS, [_FLOATS]))
            return builder.call(function, [args[0]])

        return float32x16(float32x16), codegen

    return elementwise


floor16, ceil16, abs16, sqrt16 = _unary("floor"), _unary("ceil"), _unary("fabs"), _unary("sqrt")


@intrinsic
def min16(typing_context: Any, a: Any, b: Any) -> Any:
    """The lesser; b where either is no number."""

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        left, right = (_spread(builder, arg, kind) for arg, kind in zip(args, signature.args, strict=True))
        return builder.select(builder.fcmp_ordered("<", left, right), left, right)

    return float32x16(a, b), codegen


@intrinsic
def max16(typing_context: Any, a: Any, b: Any) -> Any:
    """The greater; b where either is no number."""

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        left, right = (_spread(builder, arg, kind) for arg, kind in zip(args, signature.args, strict=True))
        return builder.select(builder.fcmp_ordered(">", left, right), left, right)

    return float32x16(a, b), codegen


@intrinsic
def broadcast16(typing_context: Any, value: Any) -> Any:
    """A scalar, float32 or an integer, in all lanes."""
    vector = int32x16 if isinstance(value, types.Integer) else float32x16
    return vector(value), lambda context, builder, signature, args: _spread(builder, args[0], signature.args[0])


@intrinsic
def to_int16(typing_context: Any, value: Any) -> Any:
    """Float32x16 to Int32x16, truncated."""
    return int32x16(float32x16), lambda context, builder, signature, args: builder.fptosi(args[0], _INTS)


@intrinsic
def to_float16(typing_context: Any, value: Any) -> Any:
    """Int32x16 to Float32x16."""
    return float32x16(int32x16), lambda context, builder, signature, args: builder.sitofp(args[0], _FLOATS)


@intrinsic
def bits_of(typing_context: Any, mask: Any) -> Any:
    """A Bool16 as an int64, lane 0 the lowest bit."""
    return types.int64(bool16), lambda context, builder, signature, args: builder.zext(builder.bitcast(args[0], ir.IntType(LANES)), _I64)


@intrinsic
def mask_of(typing_context: Any, bits: Any) -> Any:
    """A Bool16 of the lowest 16 bits of an int64."""
    return bool16(types.int64), lambda context, builder, signature, args: builder.bitcast(builder.trunc(args[0], ir.IntType(LANES)), _BITS)


@intrinsic
def lowest_bit(typing_context: Any, bits: Any) -> Any:
    """Number of the lowest set bit of an int64 other than 0."""
    return types.int64(types.int64), lambda context, builder, signature, args: builder.cttz(args[0], ir.Constant(ir.IntType(1), 1))


@intrinsic
def load16(typing_context: Any, address: Any, index: Any) -> Any:
    """p[index : index + 16] of a pointer to float32, or to int32 or uint16 as an Int32x16."""
    vector, kind = (float32x16, _FLOATS) if address.dtype == types.float32 else (int32x16, _INTS)
    held, align = (ir.VectorType(ir.IntType(16), LANES), 2) if address.dtype == types.uint16 else (kind, 4)

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        value = builder.load(builder.bitcast(builder.gep(args[0], [args[1]]), held.as_pointer()), align=align)
        return value if held is kind else builder.zext(value, kind)

    return vector(address, types.int64), codegen


@intrinsic
def load_bytes8(typing_context: Any, address: Any, index: Any) -> Any:
    """The eight bytes from p[index] on as an int64, the first the lowest."""

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        value = builder.load(builder.bitcast(builder.gep(args[0], [args[1]]), _I64.as_pointer()), align=1)
        return value if sys.byteorder == "little" else builder.bswap(value)

    return types.int64(address, types.int64), codegen


@intrinsic
def store16(typing_context: Any, address: Any, index: Any, value: Any) -> Any:
    """p[index : index + 16] = value for a pointer to float32 or int32."""
    kind = _INTS if address.dtype == types.int32 else _FLOATS

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        builder.store(args[2], builder.bitcast(builder.gep(args[0], [args[1]]), kind.as_pointer()), align=4)
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
def popcount16(typing_context: Any, bits: Any) -> Any:
    """Number of set bits of each lane of an Int32x16."""

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        return builder.call(builder.module.declare_intrinsic("llvm.ctpop.v16i32", (), ir.FunctionType(_INTS, [_INTS])), [args[0]])

    return int32x16(int32x16), codegen


@intrinsic
def gather16(typing_context: Any, address: Any, index: Any) -> Any:
    """The elements of a pointer that an Int32x16 says, all of which must exist: float32 as Float32x16, int32 and uint8 as Int32x16."""
    vector, kind = (float32x16, _FLOATS) if address.dtype == types.float32 else (int32x16, _INTS)

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        out = ir.Constant(kind, ir.Undefined)
        for n in range(LANES):
            lane = ir.Constant(_I32, n)
            value = builder.load(builder.gep(args[0], [builder.sext(builder.extract_element(args[1], lane), _I64)]))
            out = builder.insert_element(out, builder.zext(value, _I32) if address.dtype == types.uint8 else value, lane)
        return out

    return vector(address, int32x16), codegen


@intrinsic
def channels16(typing_context: Any, address: Any, index: Any) -> Any:
    """Sixteen groups of four float32 or int32 from p[index] on: the first of each, the second, the third and the fourth, as four vectors."""
    vector, element = (int32x16, _I32) if address.dtype == types.int32 else (float32x16, ir.FloatType())

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        kind = ir.VectorType(element, 4 * LANES)
        whole = builder.load(builder.bitcast(builder.gep(args[0], [args[1]]), kind.as_pointer()), align=4)
        lanes = [ir.Constant(ir.VectorType(_I32, LANES), list(range(n, 4 * LANES, 4))) for n in range(4)]
        return context.make_tuple(builder, signature.return_type, [builder.shuffle_vector(whole, whole, each) for each in lanes])

    return types.UniTuple(vector, 4)(address, types.int64), codegen


def _gather_groups(size: int) -> Any:
    """An intrinsic: groups of so many int32 from p[q[at]] on, from p[q[at + 1]] on, and so on for sixteen; the first of each, the second, ... as vectors."""

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

        return types.UniTuple(int32x16, size)(types.CPointer(types.int32), types.CPointer(types.int32), types.int64), codegen

    return gather


gather_pairs16, gather_fours16 = _gather_groups(2), _gather_groups(4)


@intrinsic
def prefetch_groups(typing_context: Any, address: Any, places: Any) -> Any:
    """`prefetch` of p[4 n] for each n of 64 int32."""

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        for n in range(64):
            place = builder.sext(builder.load(builder.gep(args[1], [ir.Constant(_I64, n)])), _I64)
            _prefetch(builder, builder.gep(args[0], [builder.shl(place, ir.Constant(_I64, 2))]))
        return context.get_dummy_value()

    return types.void(address, types.CPointer(types.int32)), codegen


@intrinsic
def store_pairs16(typing_context: Any, address: Any, index: Any, a: Any, b: Any) -> Any:
    """p[index : index + 32] = a[0], b[0], a[1], b[1], ... for a pointer to float32."""

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        order = [LANES * (n % 2) + n // 2 for n in range(2 * LANES)]
        whole = builder.shuffle_vector(args[2], args[3], ir.Constant(ir.VectorType(_I32, 2 * LANES), order))
        builder.store(whole, builder.bitcast(builder.gep(args[0], [args[1]]), whole.type.as_pointer()), align=4)
        return context.get_dummy_value()

    return types.void(types.CPointer(types.float32), types.int64, float32x16, float32x16), codegen


@intrinsic
def store_channels16(typing_context: Any, address: Any, index: Any, a: Any, b: Any, c: Any, d: Any) -> Any:
    """The reverse of `channels16`."""

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
    return (lambda out, n, value: store16(out, 16 * n, value)) if value == float32x16 else None


@overload(broadcast_like)
def _broadcast_like(value, other):  # type: ignore[no-untyped-def]
    return (lambda value, other: broadcast16(value)) if other == float32x16 else None


@intrinsic
def exp2_neg16(typing_context: Any, value: Any) -> Any:
    """2^-x of a Float32x16 for x >= 0: `simd.exp2_neg4`."""
    from efficientnerf.backends.numba.simd import _constant, _exp2

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        bound = _constant(_FLOATS, 126)
        return _exp2(builder, builder.select(builder.fcmp_ordered(">", args[0], bound), bound, args[0]), 127)

    return float32x16(float32x16), codegen
