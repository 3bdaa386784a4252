"""Register-tiled products of small matrices inside numba kernels, in float32, or in bfloat16 with float32 accumulators.

A tile of the result is ROWS rows by VECTORS vectors of LANES columns, accumulated in registers: each step of the sum broadcasts one element of each row of `a`
and multiplies it with the vectors of a row of `b`. In bfloat16 a step takes two elements of the sum at once: elements that are neighbours along the sum are
packed into one int32, the first in its lower half (the VNNI layout), and multiplied and added by VDPBF16PS where the processor has it; elsewhere they are
widened to float32 first.

    float32   a, b float32
    bfloat16  a, b int32 pairs; `a` may also be given as int16 where the elements of a pair are adjacent in memory

Results are stored as float32 or, through a pointer to int16, rounded to bfloat16.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

from llvmlite import ir
from numba import types
from numba.core import cgutils, config
from numba.core.codegen import get_host_cpu_features
from numba.extending import intrinsic, overload

from efficientnerf.backends.numba.runtime import numba
from efficientnerf.backends.numba.simd import multiply_add, splat

LANES = 16
# Features of the processor that numba compiles for.
FEATURES = frozenset((get_host_cpu_features() if config.CPU_FEATURES is None else config.CPU_FEATURES).split(","))
DOTS = {"+avx512f", "+avx512bf16", "+avx512vl"} <= FEATURES
# Size of a tile. AVX-512 has 32 registers of sixteen float32; others have 16 of eight, or 32 of four.
ROWS, VECTORS = (8, 2) if "+avx512f" in FEATURES else (4, 1)


class _BFloat(ir.Type):
    """LLVM's bfloat, for which llvmlite has no class."""

    def _to_string(self) -> str:
        return "bfloat"

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _BFloat)

    def __hash__(self) -> int:
        return hash(_BFloat)


_FLOAT32 = ir.VectorType(ir.FloatType(), LANES)
_INT32 = ir.VectorType(ir.IntType(32), LANES)
_INT16 = ir.VectorType(ir.IntType(16), LANES)
_BFLOAT16 = ir.VectorType(_BFloat(), 2 * LANES)

float_pointer, pair_pointer, bfloat16_pointer = (types.CPointer(kind) for kind in (types.float32, types.int32, types.int16))


def _constant(kind: Any, x: float) -> Any:
    """A vector with one value in all lanes."""
    return ir.Constant(kind, [x] * LANES)


def _load(builder: Any, address: Any, index: Any, kind: Any) -> Any:
    return builder.load(builder.bitcast(builder.gep(address, [index]), kind.as_pointer()), align=2 if kind is _INT16 else 4)


def _store(builder: Any, value: Any, address: Any, index: Any) -> None:
    builder.store(value, builder.bitcast(builder.gep(address, [index]), value.type.as_pointer()), align=2 if value.type is _INT16 else 4)


def _unpack_pairs(builder: Any, pairs: Any) -> tuple[Any, Any]:
    """The two bfloat16 of each pair as float32."""
    low = builder.shl(pairs, _constant(_INT32, 16))
    high = builder.and_(pairs, _constant(_INT32, 0xFFFF0000))
    return builder.bitcast(low, _FLOAT32), builder.bitcast(high, _FLOAT32)


def _multiply_add(builder: Any, total: Any, a: Any, b: Any) -> Any:
    """total + a b of float32, or total + a_0 b_0 + a_1 b_1 of pairs."""
    if a.type == _FLOAT32:
        return multiply_add(builder, a, b, total)
    if DOTS:
        dots = ir.FunctionType(_FLOAT32, [_FLOAT32, _BFLOAT16, _BFLOAT16])
        dot = builder.module.declare_intrinsic("llvm.x86.avx512bf16.dpbf16ps.512", (), dots)
        return builder.call(dot, [total, builder.bitcast(a, _BFLOAT16), builder.bitcast(b, _BFLOAT16)])
    for x, y in reversed(list(zip(_unpack_pairs(builder, a), _unpack_pairs(builder, b), strict=True))):
        total = _multiply_add(builder, total, x, y)
    return total


def _to_bfloat16(builder: Any, value: Any) -> Any:
    """float32 to bfloat16 as int16: round to nearest, ties to even; NaN stays NaN."""
    if DOTS:
        return builder.bitcast(builder.fptrunc(value, ir.VectorType(_BFloat(), LANES)), _INT16)
    bits, sixteen = builder.bitcast(value, _INT32), _constant(_INT32, 16)
    high = builder.lshr(bits, sixteen)
    odd = builder.and_(high, _constant(_INT32, 1))
    rounded = builder.lshr(builder.add(builder.add(bits, _constant(_INT32, 0x7FFF)), odd), sixteen)
    not_nan = builder.fcmp_ordered("ord", value, value)
    return builder.trunc(builder.select(not_nan, rounded, builder.or_(high, _constant(_INT32, 0x40))), _INT16)


def _convert_and_store(builder: Any, value: Any, address: Any, index: Any) -> None:
    _store(builder, _to_bfloat16(builder, value) if address.type.pointee == ir.IntType(16) else value, address, index)


def _identity(builder: Any, total: Any, load_other: Callable[[], Any]) -> Any:
    return total


def _accumulate(builder: Any, total: Any, load_other: Callable[[], Any]) -> Any:
    return builder.fadd(total, load_other())


def _relu(builder: Any, total: Any, load_other: Callable[[], Any]) -> Any:
    return builder.select(builder.fcmp_unordered(">", total, _constant(_FLOAT32, 0.0)), total, _constant(_FLOAT32, 0.0))  # NaN stays NaN


def _mask(builder: Any, total: Any, load_other: Callable[[], Any]) -> Any:
    value = load_other()
    if value.type == _INT16:
        nonzero = builder.icmp_unsigned("!=", value, _constant(_INT16, 0))
    else:
        nonzero = builder.fcmp_unordered("!=", value, _constant(_FLOAT32, 0.0))
    return builder.select(nonzero, total, _constant(_FLOAT32, 0.0))


class Matrix(NamedTuple):
    """Element (r, k) lies at data[start + r * row + k * column]; strides and start in elements of `data`, a pointer."""

    data: Any
    start: int
    row: int
    column: int


class Rows(NamedTuple):
    """A matrix of contiguous rows: element (k, n) lies at data[start + k * row + n]."""

    data: Any
    start: int
    row: int


def _product(finish: Callable[..., Any]) -> Any:
    """An intrinsic that computes tiles of the product and applies `finish` to each vector of sums before it is stored."""

    @intrinsic
    def product(typing_context: Any, a: Any, b: Any, c: Any, count: Any, rows: Any, columns: Any, other: Any, other_start: Any) -> Any:
        a_data, b_data = a.types[0], b.types[0]
        element = ir.FloatType() if b_data == float_pointer else ir.IntType(32)
        if b_data not in (float_pointer, pair_pointer) or a_data not in ((float_pointer,) if b_data == float_pointer else (pair_pointer, bfloat16_pointer)):
            raise TypeError(f"product of {a_data} and {b_data}: expected float32, or pairs of bfloat16")
        vector = ir.VectorType(element, LANES)

        def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
            index = ir.IntType(64)

            def fields(n: int) -> list[Any]:
                kinds = signature.args[n].types
                values = cgutils.unpack_tuple(builder, args[n], len(kinds))
                return [values[0], *(context.cast(builder, value, kind, types.int64) for value, kind in zip(values[1:], kinds[1:], strict=True))]

            (a, a_start, a_row, a_column), (b, b_start, b_row), (c, c_start, c_row) = fields(0), fields(1), fields(2)
            count, rows, columns, other, other_start = args[3:]
            a = builder.bitcast(a, element.as_pointer())

            def number(n: int) -> Any:
                return ir.Constant(index, n)

            def tile(row: Any, column: Any, vectors: int) -> None:
                sums = [[cgutils.alloca_once(builder, _FLOAT32) for _ in range(vectors)] for _ in range(ROWS)]
                for accumulators in sums:
                    for accumulator in accumulators:
                        builder.store(_constant(_FLOAT32, 0.0), accumulator)
                starts = [builder.gep(a, [builder.add(a_start, builder.mul(builder.add(row, number(r)), a_row))]) for r in range(ROWS)]
                begin = builder.add(b_start, column)
                with cgutils.for_range(builder, count) as loop:
                    step, line = builder.mul(loop.index, a_column), builder.add(begin, builder.mul(loop.index, b_row))
                    lines = [_load(builder, b, builder.add(line, number(LANES * v)), vector) for v in range(vectors)]
                    for start, accumulators in zip(starts, sums, strict=True):
                        factor = splat(builder, builder.load(builder.gep(start, [step]), align=4), LANES)
                        for accumulator, value in zip(accumulators, lines, strict=True):
                            builder.store(_multiply_add(builder, builder.load(accumulator), factor, value), accumulator)
                for r, accumulators in enumerate(sums):
                    line = builder.add(builder.mul(builder.add(row, number(r)), c_row), column)
                    for v, accumulator in enumerate(accumulators):
                        ahead = builder.add(line, number(LANES * v))

                        def load_other(ahead: Any = ahead) -> Any:
                            return _load(builder, other, builder.add(other_start, ahead), _INT16 if signature.args[6] == bfloat16_pointer else _FLOAT32)

                        _convert_and_store(builder, finish(builder, builder.load(accumulator), load_other), c, builder.add(c_start, ahead))

            width = LANES * VECTORS
            tiles = builder.udiv(columns, number(width))
            with cgutils.for_range(builder, builder.udiv(rows, number(ROWS))) as down:
                row = builder.mul(down.index, number(ROWS))
                with cgutils.for_range(builder, tiles) as along_row:
                    tile(row, builder.mul(along_row.index, number(width)), VECTORS)
                if VECTORS > 1:
                    last = builder.mul(tiles, number(width))
                    with builder.if_then(builder.icmp_unsigned("<", last, columns)):
                        tile(row, last, 1)
            return context.get_dummy_value()

        n = types.int64
        return types.void(a, b, c, n, n, n, other, n), codegen

    return product


_product_plain, _product_added, _product_relu, _product_masked = (_product(finish) for finish in (_identity, _accumulate, _relu, _mask))

# c[r, n] = sum_k a[r, k] b[k, n] for r < rows, a multiple of ROWS, n < columns, a multiple of LANES, and k < count; `a` a Matrix, `b` and `c` Rows.


@numba.njit(cache=True, error_model="numpy")
def product(a, b, c, count, rows, columns):  # type: ignore[no-untyped-def]
    """c = a b."""
    _product_plain(a, b, c, count, rows, columns, c.data, c.start)


@numba.njit(cache=True, error_model="numpy")
def product_added(a, b, c, count, rows, columns):  # type: ignore[no-untyped-def]
    """c += a b."""
    _product_added(a, b, c, count, rows, columns, c.data, c.start)


@numba.njit(cache=True, error_model="numpy")
def product_relu(a, b, c, count, rows, columns):  # type: ignore[no-untyped-def]
    """c = ReLU(a b)."""
    _product_relu(a, b, c, count, rows, columns, c.data, c.start)


@numba.njit(cache=True, error_model="numpy")
def product_masked(a, b, c, count, rows, columns, mask, mask_start):  # type: ignore[no-untyped-def]
    """c = a b where `mask` is not zero, else 0; mask[r, n] lies at mask[mask_start + r c.row + n]."""
    _product_masked(a, b, c, count, rows, columns, mask, mask_start)


@intrinsic
def copy16(typing_context: Any, source: Any, at: Any, count: Any, target: Any, to: Any) -> Any:
    """target[to : to + 16] = source[at : at + 16], float32, zeros from the `count`-th on; converted to bfloat16 where target points to int16."""

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        source, at, count, target, to = args
        _convert_and_store(builder, _first_lanes(builder, _load(builder, source, at, _FLOAT32), count), target, to)
        return context.get_dummy_value()

    return types.void(float_pointer, types.int64, types.int64, target, types.int64), codegen


@intrinsic
def store_pairs16(typing_context: Any, source: Any, low: Any, high: Any, count: Any, target: Any, to: Any) -> Any:
    """target[to : to + 16] = pairs of source[low : low + 16] and source[high : high + 16], float32 or bfloat16 as int16; zeros from the `count`-th on."""

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        source, low, high, count, target, to = args
        kind = _FLOAT32 if signature.args[0] == float_pointer else _INT16
        halves = [_load(builder, source, at, kind) for at in (low, high)]
        if kind is _FLOAT32:
            halves = [_to_bfloat16(builder, value) for value in halves]
        first, second = (builder.zext(value, _INT32) for value in halves)
        _store(builder, _first_lanes(builder, builder.or_(first, builder.shl(second, _constant(_INT32, 16))), count), target, to)
        return context.get_dummy_value()

    return types.void(source, types.int64, types.int64, types.int64, pair_pointer, types.int64), codegen


def _first_lanes(builder: Any, value: Any, count: Any) -> Any:
    """The first `count` of sixteen lanes, then zeros."""
    lanes = ir.Constant(_INT32, list(range(LANES)))
    inside = builder.icmp_signed("<", lanes, splat(builder, builder.trunc(count, ir.IntType(32)), LANES))
    return builder.select(inside, value, ir.Constant(value.type, None))


@intrinsic
def transpose16(typing_context: Any, source: Any, at: Any, row: Any, target: Any, to: Any, column: Any) -> Any:
    """target[to + i column + j] = source[at + j row + i] for i, j < LANES; float32, or pairs, whose source may point to int16 as for `product`."""

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        source, at, row, target, to, column = args
        kind = _FLOAT32 if signature.args[3] == float_pointer else _INT32
        source = builder.bitcast(source, kind.element.as_pointer())
        steps = [ir.Constant(ir.IntType(64), n) for n in range(LANES)]
        lines = [_load(builder, source, builder.add(at, builder.mul(n, row)), kind) for n in steps]
        for far in (1, 2, 4, 8):  # swap off-diagonal blocks of that side in blocks twice as large
            upper = ir.Constant(_INT32, [n if not n & far else LANES + n - far for n in range(LANES)])
            lower = ir.Constant(_INT32, [n + far if not n & far else LANES + n for n in range(LANES)])
            for n in range(LANES):
                if not n & far:
                    first, second = lines[n], lines[n + far]
                    lines[n], lines[n + far] = (builder.shuffle_vector(first, second, lanes) for lanes in (upper, lower))
        for n, line in zip(steps, lines, strict=True):
            _store(builder, line, target, builder.add(to, builder.mul(n, column)))
        return context.get_dummy_value()

    n = types.int64
    return types.void(source, n, n, target, n, n), codegen


def pack_row_pairs(source, width, target, count, padded_width):  # type: ignore[no-untyped-def]
    """Pairs of rows 2 n and 2 n + 1 of `source` (Rows of `width`, float32 or int16) to row n < count of `target`, a pointer to int32; to float32, a copy.

    padded_width  row length of the target, a multiple of LANES; source is read up to it, and zeros are written from `width` on
    """
    raise NotImplementedError("inside kernels only")


@overload(pack_row_pairs)
def _pack_row_pairs(source, width, target, count, padded_width):  # type: ignore[no-untyped-def]
    def copy(source, width, target, count, padded_width):  # type: ignore[no-untyped-def]
        for line in range(count):
            for n in range(0, padded_width, LANES):
                copy16(source.data, source.start + line * source.row + n, width - n, target, line * padded_width + n)

    def pack(source, width, target, count, padded_width):  # type: ignore[no-untyped-def]
        for line in range(count):
            low = source.start + 2 * line * source.row
            for n in range(0, padded_width, LANES):
                store_pairs16(source.data, low + n, low + source.row + n, width - n, target, line * padded_width + n)

    return copy if target == float_pointer else pack


@numba.njit(cache=True, inline="always", error_model="numpy")
def copy_rows(source, width, target, count, padded_width):  # type: ignore[no-untyped-def]
    """As `pack_row_pairs`, without pairing: float32 rows to a pointer to float32, or as bfloat16 to a pointer to int16."""
    for line in range(count):
        for n in range(0, padded_width, LANES):
            copy16(source.data, source.start + line * source.row + n, width - n, target, line * padded_width + n)
