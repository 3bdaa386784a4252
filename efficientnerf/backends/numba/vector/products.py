"""Register-tiled products of small matrices inside numba kernels, in float32, or in bfloat16 with float32 accumulators.

A tile of the result is ROWS rows by VECTORS vectors of LANES columns, accumulated in registers: each step of the sum broadcasts one element of each row of `a`
and multiplies it with the vectors of a row of `b`. In bfloat16 a step takes two elements of the sum at once: elements that are neighbours along the sum are
packed into one int32, the first in its lower half (the VNNI layout), and multiplied and added by VDPBF16PS where the processor has it; elsewhere they are
widened to float32 first.

    float32   a, b float32
    bfloat16  a, b int32 pairs; `a` may also be given as int16 where the elements of a pair are adjacent in memory

Results are stored as float32 or, through a pointer to int16, rounded to bfloat16.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

from llvmlite import ir
from numba import types
from numba.core import cgutils, config
from numba.core.codegen import get_host_cpu_features
from numba.extending import intrinsic, overload

from efficientnerf.backends.numba.runtime import numba
from efficientnerf.backends.numba.vector import emit

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


_FLOAT32, _INT32, _INT16 = (ir.VectorType(element, LANES) for element in (emit.F32, emit.I32, emit.I16))
_BFLOAT16 = ir.VectorType(_BFloat(), 2 * LANES)

float_pointer, pair_pointer, bfloat16_pointer = (types.CPointer(kind) for kind in (types.float32, types.int32, types.int16))


def _unpack_pairs(builder: Any, pairs: Any) -> tuple[Any, Any]:
    """The two bfloat16 of each pair as float32."""
    low = builder.shl(pairs, emit.constant(_INT32, 16))
    high = builder.and_(pairs, emit.constant(_INT32, 0xFFFF0000))
    return builder.bitcast(low, _FLOAT32), builder.bitcast(high, _FLOAT32)


def _multiply_add(builder: Any, total: Any, a: Any, b: Any) -> Any:
    """total + a b of float32, or total + a_0 b_0 + a_1 b_1 of pairs."""
    if a.type == _FLOAT32:
        return emit.fma(builder, a, b, total)
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
    bits, sixteen = builder.bitcast(value, _INT32), emit.constant(_INT32, 16)
    high = builder.lshr(bits, sixteen)
    odd = builder.and_(high, emit.constant(_INT32, 1))
    rounded = builder.lshr(builder.add(builder.add(bits, emit.constant(_INT32, 0x7FFF)), odd), sixteen)
    not_nan = builder.fcmp_ordered("ord", value, value)
    return builder.trunc(builder.select(not_nan, rounded, builder.or_(high, emit.constant(_INT32, 0x40))), _INT16)


def _convert_and_store(builder: Any, value: Any, address: Any, index: Any) -> None:
    emit.store(builder, address, index, _to_bfloat16(builder, value) if address.type.pointee == emit.I16 else value)


def _identity(builder: Any, total: Any, load_other: Callable[[], Any]) -> Any:
    return total


def _accumulate(builder: Any, total: Any, load_other: Callable[[], Any]) -> Any:
    return builder.fadd(total, load_other())


def _relu(builder: Any, total: Any, load_other: Callable[[], Any]) -> Any:
    return builder.select(builder.fcmp_unordered(">", total, emit.constant(_FLOAT32, 0.0)), total, emit.constant(_FLOAT32, 0.0))  # NaN stays NaN


def _mask(builder: Any, total: Any, load_other: Callable[[], Any]) -> Any:
    value = load_other()
    if value.type == _INT16:
        nonzero = builder.icmp_unsigned("!=", value, emit.constant(_INT16, 0))
    else:
        nonzero = builder.fcmp_unordered("!=", value, emit.constant(_FLOAT32, 0.0))
    return builder.select(nonzero, total, emit.constant(_FLOAT32, 0.0))


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


def _sum_tile(builder: Any, a: Matrix, b: Rows, vector: Any, count: Any, row: Any, column: Any, vectors: int) -> list[list[Any]]:
    """Sums of ROWS rows of so many vectors of the product, from a row and a column on, in registers."""
    sums = [[cgutils.alloca_once(builder, _FLOAT32) for _ in range(vectors)] for _ in range(ROWS)]
    for accumulators in sums:
        for accumulator in accumulators:
            builder.store(emit.constant(_FLOAT32, 0.0), accumulator)
    data = builder.bitcast(a.data, vector.element.as_pointer())
    starts = [builder.gep(data, [builder.add(a.start, builder.mul(builder.add(row, emit.index(r)), a.row))]) for r in range(ROWS)]
    begin = builder.add(b.start, column)
    with cgutils.for_range(builder, count) as loop:
        step, line = builder.mul(loop.index, a.column), builder.add(begin, builder.mul(loop.index, b.row))
        lines = [emit.load(builder, b.data, builder.add(line, emit.index(LANES * v)), vector) for v in range(vectors)]
        for start, accumulators in zip(starts, sums, strict=True):
            factor = emit.splat(builder, builder.load(builder.gep(start, [step]), align=4), LANES)
            for accumulator, value in zip(accumulators, lines, strict=True):
                builder.store(_multiply_add(builder, builder.load(accumulator), factor, value), accumulator)
    return sums


def _for_tiles(builder: Any, rows: Any, columns: Any, tile: Callable[[Any, Any, int], None]) -> None:
    """Emits the loops over tiles of rows and columns; tile: (first row, first column, vectors)."""
    width = LANES * VECTORS
    tiles = builder.udiv(columns, emit.index(width))
    with cgutils.for_range(builder, builder.udiv(rows, emit.index(ROWS))) as down:
        row = builder.mul(down.index, emit.index(ROWS))
        with cgutils.for_range(builder, tiles) as along_row:
            tile(row, builder.mul(along_row.index, emit.index(width)), VECTORS)
        if VECTORS > 1:
            last = builder.mul(tiles, emit.index(width))
            with builder.if_then(builder.icmp_unsigned("<", last, columns)):
                tile(row, last, 1)


def _product(finish: Callable[..., Any]) -> Any:
    """An intrinsic that computes tiles of the product and applies `finish` to each vector of sums before it is stored."""

    @intrinsic
    def product(typing_context: Any, a: Any, b: Any, c: Any, count: Any, rows: Any, columns: Any, other: Any, other_start: Any) -> Any:
        a_data, b_data = a.types[0], b.types[0]
        if b_data not in (float_pointer, pair_pointer) or a_data not in ((float_pointer,) if b_data == float_pointer else (pair_pointer, bfloat16_pointer)):
            raise TypeError(f"product of {a_data} and {b_data}: expected float32, or pairs of bfloat16")
        vector, held = _FLOAT32 if b_data == float_pointer else _INT32, _INT16 if other == bfloat16_pointer else _FLOAT32

        def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
            def fields(n: int) -> list[Any]:
                kinds = signature.args[n].types
                values = cgutils.unpack_tuple(builder, args[n], len(kinds))
                return [values[0], *(context.cast(builder, value, kind, types.int64) for value, kind in zip(values[1:], kinds[1:], strict=True))]

            a, b, c = Matrix(*fields(0)), Rows(*fields(1)), Rows(*fields(2))
            count, rows, columns, other, other_start = args[3:]

            def tile(row: Any, column: Any, vectors: int) -> None:
                for r, accumulators in enumerate(_sum_tile(builder, a, b, vector, count, row, column, vectors)):
                    line = builder.add(builder.mul(builder.add(row, emit.index(r)), c.row), column)
                    for v, accumulator in enumerate(accumulators):
                        ahead = builder.add(line, emit.index(LANES * v))

                        def load_other(ahead: Any = ahead) -> Any:
                            return emit.load(builder, other, builder.add(other_start, ahead), held)

                        _convert_and_store(builder, finish(builder, builder.load(accumulator), load_other), c.data, builder.add(c.start, ahead))

            _for_tiles(builder, rows, columns, tile)
            return context.get_dummy_value()

        n = types.int64
        return types.void(a, b, c, n, n, n, other, n), codegen

    return product


_product_plain, _product_added, _product_relu, _product_masked = (_product(finish) for finish in (_identity, _accumulate, _relu, _mask))

# c[r, n] = sum_k a[r, k] b[k, n] for r < rows, a multiple of ROWS, n < columns, a multiple of LANES, and k < count; `a` a Matrix, `b` and `c` Rows.


@numba.njit(cache=True, error_model="numpy")
def product(a, b, c, count, rows, columns):
    """c = a b."""
    _product_plain(a, b, c, count, rows, columns, c.data, c.start)


@numba.njit(cache=True, error_model="numpy")
def product_added(a, b, c, count, rows, columns):
    """c += a b."""
    _product_added(a, b, c, count, rows, columns, c.data, c.start)


@numba.njit(cache=True, error_model="numpy")
def product_relu(a, b, c, count, rows, columns):
    """c = ReLU(a b)."""
    _product_relu(a, b, c, count, rows, columns, c.data, c.start)


@numba.njit(cache=True, error_model="numpy")
def product_masked(a, b, c, count, rows, columns, mask, mask_start):
    """c = a b where `mask` is not zero, else 0; mask[r, n] lies at mask[mask_start + r c.row + n]."""
    _product_masked(a, b, c, count, rows, columns, mask, mask_start)


@intrinsic
def copy16(typing_context: Any, source: Any, at: Any, count: Any, target: Any, to: Any) -> Any:
    """target[to : to + 16] = source[at : at + 16], float32, zeros from the `count`-th on; converted to bfloat16 where target points to int16."""

    def body(builder: Any, source: Any, at: Any, count: Any, target: Any, to: Any) -> None:
        _convert_and_store(builder, _first_lanes(builder, emit.load(builder, source, at, _FLOAT32), count), target, to)

    return types.void(float_pointer, types.int64, types.int64, target, types.int64), emit.emits(body)


@intrinsic
def store_pairs16(typing_context: Any, source: Any, low: Any, high: Any, count: Any, target: Any, to: Any) -> Any:
    """target[to : to + 16] = pairs of source[low : low + 16] and source[high : high + 16], float32 or bfloat16 as int16; zeros from the `count`-th on."""
    kind = _FLOAT32 if source == float_pointer else _INT16

    def body(builder: Any, source: Any, low: Any, high: Any, count: Any, target: Any, to: Any) -> None:
        halves = [emit.load(builder, source, at, kind) for at in (low, high)]
        if kind is _FLOAT32:
            halves = [_to_bfloat16(builder, value) for value in halves]
        first, second = (builder.zext(value, _INT32) for value in halves)
        emit.store(builder, target, to, _first_lanes(builder, builder.or_(first, builder.shl(second, emit.constant(_INT32, 16))), count))

    return types.void(source, types.int64, types.int64, types.int64, pair_pointer, types.int64), emit.emits(body)


def _first_lanes(builder: Any, value: Any, count: Any) -> Any:
    """The first `count` of sixteen lanes, then zeros."""
    return builder.select(emit.first_lanes(builder, count, LANES), value, ir.Constant(value.type, None))


@intrinsic
def transpose16(typing_context: Any, source: Any, at: Any, row: Any, target: Any, to: Any, column: Any) -> Any:
    """target[to + i column + j] = source[at + j row + i] for i, j < LANES; float32, or pairs, whose source may point to int16 as for `product`."""
    kind = _FLOAT32 if target == float_pointer else _INT32

    def body(builder: Any, source: Any, at: Any, row: Any, target: Any, to: Any, column: Any) -> None:
        source = builder.bitcast(source, kind.element.as_pointer())
        lines = [emit.load(builder, source, builder.add(at, builder.mul(emit.index(n), row)), kind) for n in range(LANES)]
        for far in (1, 2, 4, 8):  # swap off-diagonal blocks of that side in blocks twice as large
            upper, lower = [n if not n & far else LANES + n - far for n in range(LANES)], [n + far if not n & far else LANES + n for n in range(LANES)]
            for n in range(LANES):
                if not n & far:
                    first, second = lines[n], lines[n + far]
                    lines[n], lines[n + far] = (emit.shuffle(builder, first, second, lanes) for lanes in (upper, lower))
        for n, line in enumerate(lines):
            emit.store(builder, target, builder.add(to, builder.mul(emit.index(n), column)), line)

    n = types.int64
    return types.void(source, n, n, target, n, n), emit.emits(body)


def pack_row_pairs(source, width, target, count, padded_width):
    """Pairs of rows 2 n and 2 n + 1 of `source` (Rows of `width`, float32 or int16) to row n < count of `target`, a pointer to int32; to float32, a copy.

    padded_width  row length of the target, a multiple of LANES; source is read up to it, and zeros are written from `width` on
    """
    raise NotImplementedError("inside kernels only")


@overload(pack_row_pairs)
def _pack_row_pairs(source, width, target, count, padded_width):
    def copy(source, width, target, count, padded_width):
        for line in range(count):
            for n in range(0, padded_width, LANES):
                copy16(source.data, source.start + line * source.row + n, width - n, target, line * padded_width + n)

    def pack(source, width, target, count, padded_width):
        for line in range(count):
            low = source.start + 2 * line * source.row
            for n in range(0, padded_width, LANES):
                store_pairs16(source.data, low + n, low + source.row + n, width - n, target, line * padded_width + n)

    return copy if target == float_pointer else pack


@numba.njit(cache=True, inline="always", error_model="numpy")
def copy_rows(source, width, target, count, padded_width):
    """As `pack_row_pairs`, without pairing: float32 rows to a pointer to float32, or as bfloat16 to a pointer to int16."""
    for line in range(count):
        for n in range(0, padded_width, LANES):
            copy16(source.data, source.start + line * source.row + n, width - n, target, line * padded_width + n)
