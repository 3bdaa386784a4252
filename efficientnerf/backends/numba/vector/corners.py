"""Eight groups of adjacent numbers with a weight each, as the corners of a sample's cell have: interpolation between them, and its reverse.

Corner c has the group that begins at values[size index[at + c stride]], and weights[at + c stride]. Indices are int32 or uint32; numbers are of one type,
float32, or float64 for tests.
"""

from collections.abc import Iterator
from typing import Any

from numba import types
from numba.core import cgutils
from numba.extending import intrinsic

from efficientnerf.backends.numba.vector import emit

CORNERS = 8


def _corners(builder: Any, args: Any, kind: Any, size: int) -> Iterator[tuple[Any, Any]]:
    """Address of the group of each corner, and its weight `size` times; kind: the type of the pointer to indices."""
    values, index, weights, at, stride = args
    extend = builder.sext if kind.dtype == types.int32 else builder.zext
    for n in range(CORNERS):
        place = builder.add(at, builder.mul(stride, emit.index(n)))
        weight = emit.splat(builder, builder.load(builder.gep(weights, [place])), size)
        begin = builder.mul(extend(builder.load(builder.gep(index, [place])), emit.I64), emit.index(size))
        yield emit.address_of(builder, values, begin, weight.type), weight


@intrinsic(prefer_literal=True)
def mix_corners(typing_context: Any, values: Any, index: Any, weights: Any, at: Any, stride: Any, size: Any) -> Any:
    """Weighted sum of the groups of all corners: a tuple of `size` numbers."""
    kind, count = index, size.literal_value

    def body(builder: Any, *args: Any) -> list[Any]:
        sums: list[Any] = [None, None]  # two chains, which do not wait for each other
        for n, (address, weight) in enumerate(_corners(builder, args[:5], kind, count)):
            value, total = builder.load(address, align=4), sums[n % 2]
            sums[n % 2] = builder.fmul(weight, value) if total is None else emit.fma(builder, weight, value, total)
        return emit.unpack(builder, builder.fadd(*sums))

    return types.UniTuple(values.dtype, count)(values, index, weights, types.int64, types.int64, size), emit.emits(body)


@intrinsic
def spread_corners(typing_context: Any, values: Any, index: Any, weights: Any, at: Any, stride: Any, numbers: Any) -> Any:
    """The reverse: adds a tuple of numbers, times each corner's weight, to the groups, one after the other, for some may be the same."""
    kind, count = index, numbers.count

    def body(builder: Any, *args: Any) -> None:
        group = emit.pack(builder, cgutils.unpack_tuple(builder, args[5], count))
        for address, weight in _corners(builder, args[:5], kind, count):
            builder.store(emit.fma(builder, weight, group, builder.load(address, align=4)), address, align=4)

    return types.void(values, index, weights, types.int64, types.int64, numbers), emit.emits(body)
