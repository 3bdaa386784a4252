"""Groups of numbers in memory and SIMD lanes (numba): two or four numbers of each ray of a packet, and pixels of its rows.

See `lanes` for the vectors.
"""

from __future__ import annotations

from typing import Any

from llvmlite import ir
from numba import types
from numba.extending import intrinsic

from efficientnerf.backends.numba.tree.packets.lanes import FLOATS, INTS, ask_for
from efficientnerf.backends.numba.tree.packets.layout import LANES

_I32, _I64 = ir.IntType(32), ir.IntType(64)


@intrinsic
def channels(typing_context: Any, address: Any, index: Any) -> Any:
    """LANES groups of four float32 or int32 from p[index] on: the first of each, the second, the third and the fourth, as four vectors."""
    vector, element = (INTS[LANES], _I32) if address.dtype == types.int32 else (FLOATS[LANES], ir.FloatType())

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

        return types.UniTuple(INTS[LANES], size)(types.CPointer(types.int32), types.CPointer(types.int32), types.int64), codegen

    return gather


gather_pairs, gather_fours = _gather_groups(2), _gather_groups(4)


@intrinsic
def prefetch_groups(typing_context: Any, address: Any, places: Any) -> Any:
    """`prefetch` of p[4 n] for each n of 4 LANES int32."""

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        for n in range(4 * LANES):
            place = builder.sext(builder.load(builder.gep(args[1], [ir.Constant(_I64, n)])), _I64)
            ask_for(builder, builder.gep(args[0], [builder.shl(place, ir.Constant(_I64, 2))]))
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

    return types.void(types.CPointer(types.float32), types.int64, FLOATS[LANES], FLOATS[LANES]), codegen


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


@intrinsic
def store_rows(typing_context: Any, address: Any, index: Any, stride: Any, value: Any) -> Any:
    """p[index + r stride : ... + 8] = value[8 r : 8 r + 8] for each row r of eight lanes, of a pointer to float32."""

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        _store_rows(builder, args[0], args[1], args[2], [args[3]])
        return context.get_dummy_value()

    return types.void(types.CPointer(types.float32), types.int64, types.int64, FLOATS[LANES]), codegen


@intrinsic
def store_rows_of_three(typing_context: Any, address: Any, index: Any, stride: Any, a: Any, b: Any, c: Any) -> Any:
    """p[index + r stride : ... + 24] = a[8 r], b[8 r], c[8 r], a[8 r + 1], ... likewise."""

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        _store_rows(builder, args[0], args[1], args[2], list(args[3:]))
        return context.get_dummy_value()

    return types.void(types.CPointer(types.float32), types.int64, types.int64, *[FLOATS[LANES]] * 3), codegen


def _store_rows(builder: Any, address: Any, index: Any, stride: Any, values: list[Any]) -> None:
    def shuffled(left: Any, right: Any, lanes: list[int]) -> Any:
        return builder.shuffle_vector(left, right, ir.Constant(ir.VectorType(_I32, len(lanes)), lanes))

    for row in range(0, LANES, 8):
        out = shuffled(values[0], values[0], list(range(row, row + 8)))
        if len(values) == 3:
            two = shuffled(values[0], values[1], [row + n for n in range(8)] + [LANES + row + n for n in range(8)])
            third = shuffled(values[2], values[2], [row + n % 8 for n in range(16)])
            out = shuffled(two, third, [(n // 3, 8 + n // 3, 16 + n // 3)[n % 3] for n in range(24)])
        builder.store(out, builder.bitcast(builder.gep(address, [index]), out.type.as_pointer()), align=4)
        index = builder.add(index, stride)
