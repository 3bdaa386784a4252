"""Products of small matrices inside numba kernels, a tile of sums in registers at a time; in float32, or in bfloat16 with sums in float32.

A tile is some rows by some vectors of sixteen columns: each step of its sum takes one number of each row, sixteen times, and the vectors of that step.
Where numbers are bfloat16 two steps are one: two numbers that follow each other in the sum lie in one int32, the first in its lower half, and are
multiplied and added by one instruction (VDPBF16PS) where the processor has it, else widened first. So

    float32   a, b float32
    bfloat16  a, b pairs of bfloat16 (int32); `a` may also be given as the int16 of its numbers where pairs are neighbours there

Results are written as float32 or, through an address of int16, rounded to bfloat16.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from llvmlite import ir
from numba import types
from numba.core import cgutils, config
from numba.core.codegen import get_host_cpu_features
from numba.extending import intrinsic, overload

from efficientnerf.backends.numba.runtime import numba
from efficientnerf.backends.numba.simd import spread

LANES = 16
# What numba compiles for; it has the same two settings.
FEATURES = frozenset((get_host_cpu_features() if config.CPU_FEATURES is None else config.CPU_FEATURES).split(","))
DOTS = {"+avx512f", "+avx512bf16", "+avx512vl"} <= FEATURES
# Of a tile: AVX-512 has 32 registers of sixteen; others have 16 of eight, or 32 of four.
ROWS, VECTORS = (8, 2) if "+avx512f" in FEATURES else (4, 1)


class _BFloat(ir.Type):
    """LLVM's bfloat16, which llvmlite has no class for."""

    def _to_string(self) -> str:
        return "bfloat"

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _BFloat)

    def __hash__(self) -> int:
        return hash(_BFloat)


_FLOATS = ir.VectorType(ir.FloatType(), LANES)
_WORDS = ir.VectorType(ir.IntType(32), LANES)
_HALVES = ir.VectorType(ir.IntType(16), LANES)
_PAIRS = ir.VectorType(_BFloat(), 2 * LANES)
_CONTRACT = ("contract",)

float_pointer, pair_pointer, half_pointer = (types.CPointer(kind) for kind in (types.float32, types.int32, types.int16))


def _all(kind: Any, x: float) -> Any:
    return ir.Constant(kind, [x] * LANES)


def _load(builder: Any, address: Any, index: Any, kind: Any) -> Any:
    return builder.load(builder.bitcast(builder.gep(address, [index]), kind.as_pointer()), align=2 if kind is _HALVES else 4)


def _store(builder: Any, value: Any, address: Any, index: Any) -> None:
    builder.store(value, builder.bitcast(builder.gep(address, [index]), value.type.as_pointer()), align=2 if value.type is _HALVES else 4)


def _halves_of_pairs(builder: Any, pairs: Any) -> tuple[Any, Any]:
    low = builder.shl(pairs, _all(_WORDS, 16))
    high = builder.and_(pairs, _all(_WORDS, 0xFFFF0000))
    return builder.bitcast(low, _FLOATS), builder.bitcast(high, _FLOATS)


def _plus_product(builder: Any, total: Any, a: Any, b: Any) -> Any:
    """Sixteen sums, each with one more product, or two more of pairs."""
    if a.type == _FLOATS:
        return builder.fadd(builder.fmul(a, b, flags=_CONTRACT), total, flags=_CONTRACT)
    if DOTS:
        dots = ir.FunctionType(_FLOATS, [_FLOATS, _PAIRS, _PAIRS])
        dot = builder.module.declare_intrinsic("llvm.x86.avx512bf16.dpbf16ps.512", (), dots)
        return builder.call(dot, [total, builder.bitcast(a, _PAIRS), builder.bitcast(b, _PAIRS)])
    for x, y in reversed(list(zip(_halves_of_pairs(builder, a), _halves_of_pairs(builder, b), strict=True))):
        total = _plus_product(builder, total, x, y)
    return total


def _narrowed(builder: Any, value: Any) -> Any:
    """Sixteen float32 as bfloat16: the upper halves of their bits, rounded to the nearest, to even where there are two; what is no number stays none."""
    if DOTS:
        return builder.bitcast(builder.fptrunc(value, ir.VectorType(_BFloat(), LANES)), _HALVES)
    bits, sixteen = builder.bitcast(value, _WORDS), _all(_WORDS, 16)
    high = builder.lshr(bits, sixteen)
    odd = builder.and_(high, _all(_WORDS, 1))
    rounded = builder.lshr(builder.add(builder.add(bits, _all(_WORDS, 0x7FFF)), odd), sixteen)
    number = builder.fcmp_ordered("ord", value, value)
    return builder.trunc(builder.select(number, rounded, builder.or_(high, _all(_WORDS, 0x40))), _HALVES)


def _written(builder: Any, value: Any, address: Any, index: Any) -> None:
    _store(builder, _narrowed(builder, value) if address.type.pointee == ir.IntType(16) else value, address, index)


def _as_it_is(builder: Any, total: Any, there: Callable[[], Any]) -> Any:
    return total


def _added(builder: Any, total: Any, there: Callable[[], Any]) -> Any:
    return builder.fadd(total, there())


def _relu(builder: Any, total: Any, there: Callable[[], Any]) -> Any:
    return builder.select(builder.fcmp_unordered(">", total, _all(_FLOATS, 0.0)), total, _all(_FLOATS, 0.0))  # what is no number stays none


def _masked(builder: Any, total: Any, there: Callable[[], Any]) -> Any:
    value = there()
    if value.type == _HALVES:
        some = builder.icmp_unsigned("!=", value, _all(_HALVES, 0))
    else:
        some = builder.fcmp_unordered("!=", value, _all(_FLOATS, 0.0))
    return builder.select(some, total, _all(_FLOATS, 0.0))


def _product(finish: Callable[..., Any]) -> Any:
    @intrinsic
    def product(
        typing_context: Any, a: Any, a_at: Any, a_row: Any, a_step: Any, b: Any, b_at: Any, b_step: Any, count: Any,
        c: Any, c_at: Any, c_row: Any, rows: Any, columns: Any, other: Any, other_at: Any,
    ) -> Any:  # fmt: skip
        word = ir.FloatType() if b == float_pointer else ir.IntType(32)
        if b not in (float_pointer, pair_pointer) or a not in ((float_pointer,) if b == float_pointer else (pair_pointer, half_pointer)):
            raise TypeError(f"product of {a} and {b}: expected float32, or pairs of bfloat16")
        vector = ir.VectorType(word, LANES)

        def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
            a, a_at, a_row, a_step, b, b_at, b_step, count, c, c_at, c_row, rows, columns, other, other_at = args
            a = builder.bitcast(a, word.as_pointer())
            index = ir.IntType(64)

            def number(n: int) -> Any:
                return ir.Constant(index, n)

            def tile(row: Any, column: Any, vectors: int) -> None:
                sums = [[cgutils.alloca_once(builder, _FLOATS) for _ in range(vectors)] for _ in range(ROWS)]
                for one in sums:
                    for place in one:
                        builder.store(_all(_FLOATS, 0.0), place)
                starts = [builder.gep(a, [builder.add(a_at, builder.mul(builder.add(row, number(r)), a_row))]) for r in range(ROWS)]
                begin = builder.add(b_at, column)
                with cgutils.for_range(builder, count) as loop:
                    step, line = builder.mul(loop.index, a_step), builder.add(begin, builder.mul(loop.index, b_step))
                    lines = [_load(builder, b, builder.add(line, number(LANES * v)), vector) for v in range(vectors)]
                    for start, one in zip(starts, sums, strict=True):
                        factor = spread(builder, builder.load(builder.gep(start, [step]), align=4), LANES)
                        for place, value in zip(one, lines, strict=True):
                            builder.store(_plus_product(builder, builder.load(place), factor, value), place)
                for r, one in enumerate(sums):
                    line = builder.add(builder.mul(builder.add(row, number(r)), c_row), column)
                    for v, place in enumerate(one):
                        ahead = builder.add(line, number(LANES * v))

                        def there(ahead: Any = ahead) -> Any:
                            return _load(builder, other, builder.add(other_at, ahead), _HALVES if signature.args[13] == half_pointer else _FLOATS)

                        _written(builder, finish(builder, builder.load(place), there), c, builder.add(c_at, ahead))

            width = LANES * VECTORS
            whole = builder.udiv(columns, number(width))
            with cgutils.for_range(builder, builder.udiv(rows, number(ROWS))) as down:
                row = builder.mul(down.index, number(ROWS))
                with cgutils.for_range(builder, whole) as across:
                    tile(row, builder.mul(across.index, number(width)), VECTORS)
                if VECTORS > 1:
                    last = builder.mul(whole, number(width))
                    with builder.if_then(builder.icmp_unsigned("<", last, columns)):
                        tile(row, last, 1)
            return context.get_dummy_value()

        n = types.int64
        return types.void(a, n, n, n, b, n, n, n, c, n, n, n, n, other, n), codegen

    return product


_plain, _with_sum, _with_relu, _with_mask = (_product(finish) for finish in (_as_it_is, _added, _relu, _masked))

# c[r, n] = sum_k a[r, k] b[k, n] for r < rows, a multiple of ROWS, and n < columns, a multiple of LANES. a[r, k] lies at a[a_at + r a_row + k a_step],
# b[k, n] at b[b_at + k b_step + n] for k < count, c[r, n] at c[c_at + r c_row + n], and other[r, n], of the functions that have one, likewise.


@numba.njit(cache=True, error_model="numpy")
def product(a, a_at, a_row, a_step, b, b_at, b_step, count, c, c_at, c_row, rows, columns):  # type: ignore[no-untyped-def]
    """The product."""
    _plain(a, a_at, a_row, a_step, b, b_at, b_step, count, c, c_at, c_row, rows, columns, c, c_at)


@numba.njit(cache=True, error_model="numpy")
def product_added(a, a_at, a_row, a_step, b, b_at, b_step, count, c, c_at, c_row, rows, columns):  # type: ignore[no-untyped-def]
    """What lies there and the product."""
    _with_sum(a, a_at, a_row, a_step, b, b_at, b_step, count, c, c_at, c_row, rows, columns, c, c_at)


@numba.njit(cache=True, error_model="numpy")
def product_relu(a, a_at, a_row, a_step, b, b_at, b_step, count, c, c_at, c_row, rows, columns):  # type: ignore[no-untyped-def]
    """The product's ReLU."""
    _with_relu(a, a_at, a_row, a_step, b, b_at, b_step, count, c, c_at, c_row, rows, columns, c, c_at)


@numba.njit(cache=True, error_model="numpy")
def product_masked(a, a_at, a_row, a_step, b, b_at, b_step, count, c, c_at, c_row, rows, columns, other, other_at):  # type: ignore[no-untyped-def]
    """The product, but zero where `other` is."""
    _with_mask(a, a_at, a_row, a_step, b, b_at, b_step, count, c, c_at, c_row, rows, columns, other, other_at)


@intrinsic
def put_narrowed(typing_context: Any, source: Any, at: Any, left: Any, target: Any, place: Any) -> Any:
    """Sixteen float32 from source[at] on, those after the first `left` as zeros, to target[place] on: as they are, or as bfloat16 to int16."""

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        source, at, left, target, place = args
        _written(builder, _some(builder, _load(builder, source, at, _FLOATS), left), target, place)
        return context.get_dummy_value()

    return types.void(float_pointer, types.int64, types.int64, target, types.int64), codegen


@intrinsic
def put_pairs(typing_context: Any, source: Any, low: Any, high: Any, left: Any, target: Any, place: Any) -> Any:
    """Sixteen pairs to target[place] on, those after the first `left` zeros: from source[low] and source[high] on, float32 or the int16 of bfloat16."""

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        source, low, high, left, target, place = args
        kind = _FLOATS if signature.args[0] == float_pointer else _HALVES
        halves = [_load(builder, source, at, kind) for at in (low, high)]
        if kind is _FLOATS:
            halves = [_narrowed(builder, value) for value in halves]
        first, second = (builder.zext(value, _WORDS) for value in halves)
        _store(builder, _some(builder, builder.or_(first, builder.shl(second, _all(_WORDS, 16))), left), target, place)
        return context.get_dummy_value()

    return types.void(source, types.int64, types.int64, types.int64, pair_pointer, types.int64), codegen


def _some(builder: Any, value: Any, left: Any) -> Any:
    """The first `left` of sixteen, then zeros."""
    lanes = ir.Constant(_WORDS, list(range(LANES)))
    there = builder.icmp_signed("<", lanes, spread(builder, builder.trunc(left, ir.IntType(32)), LANES))
    return builder.select(there, value, ir.Constant(value.type, None))


@intrinsic
def turn(typing_context: Any, source: Any, at: Any, row: Any, target: Any, place: Any, column: Any) -> Any:
    """target[place + i column + j] = source[at + j row + i] for i and j below LANES; float32, or pairs, whose source may be given as for `product`."""

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        source, at, row, target, place, column = args
        kind = _FLOATS if signature.args[3] == float_pointer else _WORDS
        source = builder.bitcast(source, kind.element.as_pointer())
        steps = [ir.Constant(ir.IntType(64), n) for n in range(LANES)]
        lines = [_load(builder, source, builder.add(at, builder.mul(n, row)), kind) for n in steps]
        for far in (1, 2, 4, 8):  # squares of that side change places across the diagonal of those twice as large
            upper = ir.Constant(_WORDS, [n if not n & far else LANES + n - far for n in range(LANES)])
            lower = ir.Constant(_WORDS, [n + far if not n & far else LANES + n for n in range(LANES)])
            for n in range(LANES):
                if not n & far:
                    one, other = lines[n], lines[n + far]
                    lines[n], lines[n + far] = (builder.shuffle_vector(one, other, lanes) for lanes in (upper, lower))
        for n, line in zip(steps, lines, strict=True):
            _store(builder, line, target, builder.add(place, builder.mul(n, column)))
        return context.get_dummy_value()

    n = types.int64
    return types.void(source, n, n, target, n, n), codegen


def pairs_of_rows(source, at, row, width, target, lines, wide):  # type: ignore[no-untyped-def]
    """Pairs of neighbouring rows of a matrix into another with `lines` rows of `wide`, a multiple of LANES, to int32; to float32, the rows as they are.

    The matrix, float32 or int16, begins at source[at], its rows lie `row` apart and have `width` numbers; after them are zeros. It is read up to `wide`.
    """
    raise NotImplementedError("inside kernels only")


@overload(pairs_of_rows)
def _pairs_of_rows(source, at, row, width, target, lines, wide):  # type: ignore[no-untyped-def]
    def copied(source, at, row, width, target, lines, wide):  # type: ignore[no-untyped-def]
        for line in range(lines):
            for n in range(0, wide, LANES):
                put_narrowed(source, at + line * row + n, width - n, target, line * wide + n)

    def paired(source, at, row, width, target, lines, wide):  # type: ignore[no-untyped-def]
        for line in range(lines):
            low = at + 2 * line * row
            for n in range(0, wide, LANES):
                put_pairs(source, low + n, low + row + n, width - n, target, line * wide + n)

    return copied if target == float_pointer else paired


@numba.njit(cache=True, inline="always", error_model="numpy")
def narrowed(source, at, row, width, target, lines, wide):  # type: ignore[no-untyped-def]
    """As `pairs_of_rows`, but each row by itself, to int16 as bfloat16, or to float32 as it is."""
    for line in range(lines):
        for n in range(0, wide, LANES):
            put_narrowed(source, at + line * row + n, width - n, target, line * wide + n)
