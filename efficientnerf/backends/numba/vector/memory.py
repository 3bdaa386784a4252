"""Vectors and memory: p is a pointer, and p[n] the n-th element of its array in C order."""

import sys
from typing import Any

from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic, overload

from efficientnerf.backends.numba.runtime import numba
from efficientnerf.backends.numba.vector import emit
from efficientnerf.backends.numba.vector.types import Vector, element_of

_FLOATS, _INTS = types.CPointer(types.float32), types.CPointer(types.int32)


@intrinsic
def pointer(typing_context: Any, array: Any) -> Any:
    """Pointer to the first element of a contiguous array, without bounds checks and without wraparound; the caller keeps the array alive, see `hold`."""
    if not isinstance(array, types.Array) or array.layout != "C":
        raise TypeError(f"pointer of {array}: expected a contiguous array")

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        return context.make_array(signature.args[0])(context, builder, args[0]).data

    return types.CPointer(array.dtype)(array), codegen


@intrinsic
def pointers(typing_context: Any, record: Any) -> Any:
    """A NamedTuple with pointers to its arrays, see `pointer`; what is no array stays."""
    for kind in record.types:
        if isinstance(kind, types.Array) and kind.layout != "C":
            raise TypeError(f"pointers of {record}: expected contiguous arrays")
    result = types.BaseTuple.from_types([types.CPointer(kind.dtype) if isinstance(kind, types.Array) else kind for kind in record.types], record.instance_class)

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        fields = zip(record.types, cgutils.unpack_tuple(builder, args[0], len(record.types)), strict=True)
        found = [context.make_array(kind)(context, builder, value).data if isinstance(kind, types.Array) else value for kind, value in fields]
        return context.make_tuple(builder, signature.return_type, found)

    return result(record), codegen


@intrinsic
def hold(typing_context: Any, arrays: Any) -> Any:
    """Does nothing with a tuple of arrays of a kernel, behind the last use of pointers to them: numba frees an array after the last line that names it."""
    return types.void(arrays), emit.emits(lambda builder, arrays: None)


@intrinsic
def advanced(typing_context: Any, address: Any, count: Any) -> Any:
    """Pointer to p[count]."""
    return address(address, types.int64), emit.emits(lambda builder, address, count: builder.gep(address, [count]))


@intrinsic
def fetch_add(typing_context: Any, address: Any, index: Any, amount: Any) -> Any:
    """p[index] of a pointer to int64, to which `amount` is then added, whatever other threads do.

    Threads that take their next task so, when they are done with one, do not wait for each other's long ones.
    """
    add = emit.emits(lambda builder, address, index, amount: builder.atomic_rmw("add", builder.gep(address, [index]), amount, "monotonic"))
    return types.int64(types.CPointer(types.int64), types.int64, types.int64), add


@intrinsic
def prefetch(typing_context: Any, address: Any, index: Any) -> Any:
    """Ask for the cache line of p[index], and do not wait for it."""
    return types.void(address, types.int64), emit.emits(lambda builder, address, index: emit.prefetch(builder, builder.gep(address, [index])))


@intrinsic
def touch(typing_context: Any, address: Any, index: Any) -> Any:
    """Bring the cache line of p[index] of a pointer to float32 into the caches; an atomic load, which the compiler may not remove."""

    def body(builder: Any, address: Any, index: Any) -> None:
        builder.load_atomic(builder.bitcast(builder.gep(address, [index]), emit.I32.as_pointer()), "monotonic", 4)

    return types.void(_FLOATS, types.int64), emit.emits(body)


@intrinsic(prefer_literal=True)
def load(typing_context: Any, address: Any, index: Any, count: Any) -> Any:
    """p[index : index + count] of a pointer to float32 or float64, or to int32 or uint16 as int32."""
    vector = Vector(element_of(address.dtype), count.literal_value)
    held = ir.VectorType(emit.I16, vector.count) if address.dtype == types.uint16 else vector.llvm

    def body(builder: Any, address: Any, index: Any, count: Any) -> Any:
        value = emit.load(builder, address, index, held)
        return value if held == vector.llvm else builder.zext(value, vector.llvm)

    return vector(address, types.int64, count), emit.emits(body)


@intrinsic
def store(typing_context: Any, address: Any, index: Any, value: Any) -> Any:
    """p[index : index + count] = value for a pointer to float32, float64 or int32."""
    return types.void(address, types.int64, value), emit.emits(emit.store)


@numba.njit(cache=True, inline="always", error_model="numpy")
def load_three(p, at, count):
    """Three vectors that lie end to end, from p[at] on."""
    return load(p, at, count), load(p, at + count, count), load(p, at + 2 * count, count)


@numba.njit(cache=True, inline="always", error_model="numpy")
def store_three(p, at, count, a, b, c):
    """The reverse."""
    store(p, at, a)
    store(p, at + count, b)
    store(p, at + 2 * count, c)


def store_nth(out, n, value):
    """out[n] = value, a scalar; or a vector, the n-th of those that lie end to end."""
    raise NotImplementedError("inside kernels only")


@overload(store_nth)
def _store_nth(out, n, value):
    def scalar(out, n, value):
        out[n] = value

    if not isinstance(value, Vector):
        return scalar
    count = value.count
    return lambda out, n, value: store(out, count * n, value)


@intrinsic(prefer_literal=True)
def load_first(typing_context: Any, address: Any, index: Any, first: Any, count: Any) -> Any:
    """p[index : index + count] of a pointer to float32: the first `first` of them, and zeros; nothing else is read."""
    vector = Vector(types.float32, count.literal_value)

    def body(builder: Any, address: Any, index: Any, first: Any, count: Any) -> Any:
        kind, mask = vector.llvm, emit.first_lanes(builder, first, vector.count)
        function = ir.FunctionType(kind, [kind.as_pointer(), emit.I32, mask.type, kind])
        masked = builder.module.declare_intrinsic(f"llvm.masked.load.v{vector.count}f32.p0v{vector.count}f32", (), function)
        return builder.call(masked, [emit.address_of(builder, address, index, kind), ir.Constant(emit.I32, 4), mask, ir.Constant(kind, None)])

    return vector(_FLOATS, types.int64, types.int64, count), emit.emits(body)


@intrinsic
def store_first(typing_context: Any, address: Any, index: Any, value: Any, first: Any) -> Any:
    """p[index : index + first] = the first lanes of a vector of float32."""

    kind, count = value.llvm, value.count

    def body(builder: Any, address: Any, index: Any, value: Any, first: Any) -> None:
        mask = emit.first_lanes(builder, first, count)
        function = ir.FunctionType(ir.VoidType(), [kind, kind.as_pointer(), emit.I32, mask.type])
        masked = builder.module.declare_intrinsic(f"llvm.masked.store.v{count}f32.p0v{count}f32", (), function)
        builder.call(masked, [value, emit.address_of(builder, address, index, kind), ir.Constant(emit.I32, 4), mask])

    return types.void(_FLOATS, types.int64, value, types.int64), emit.emits(body)


@intrinsic
def load_bytes8(typing_context: Any, address: Any, index: Any) -> Any:
    """The eight bytes from p[index] on as an int64, the first the lowest."""

    def body(builder: Any, address: Any, index: Any) -> Any:
        value = builder.load(builder.bitcast(builder.gep(address, [index]), emit.I64.as_pointer()), align=1)
        return value if sys.byteorder == "little" else builder.bswap(value)

    return types.int64(address, types.int64), emit.emits(body)


@intrinsic(prefer_literal=True)
def load_cycle(typing_context: Any, address: Any, index: Any, begin: Any, count: Any) -> Any:
    """p[index], p[index + 1], p[index + 2], p[index] and so on of a pointer to float32, from number `begin` on; p[index + 3] is read."""
    vector = Vector(types.float32, count.literal_value)

    def body(builder: Any, address: Any, index: Any, begin: Any, count: Any) -> Any:
        four = emit.load(builder, address, index, ir.VectorType(emit.F32, 4))
        turns = [emit.shuffle(builder, four, four, [(n + turn) % 3 for n in range(vector.count)]) for turn in range(3)]
        turn, found = builder.urem(begin, emit.index(3)), turns[0]
        for n in (1, 2):
            found = builder.select(builder.icmp_signed("==", turn, emit.index(n)), turns[n], found)
        return found

    return vector(_FLOATS, types.int64, types.int64, count), emit.emits(body)


@intrinsic
def gather(typing_context: Any, address: Any, index: Any) -> Any:
    """The elements p[n] of a vector of int32, all of which must exist: float32 as such, int32 and uint8 as int32."""
    vector, bytes_ = index.of(element_of(address.dtype)), address.dtype == types.uint8

    def body(builder: Any, address: Any, index: Any) -> Any:
        out = ir.Constant(vector.llvm, ir.Undefined)
        for n in range(vector.count):
            value = builder.load(builder.gep(address, [builder.sext(builder.extract_element(index, emit.index(n)), emit.I64)]))
            out = builder.insert_element(out, builder.zext(value, emit.I32) if bytes_ else value, emit.index(n))
        return out

    return vector(address, index), emit.emits(body)


def _split(builder: Any, whole: Any, size: int, count: int) -> list[Any]:
    """Groups of `size` numbers: the first of each as a vector, the second and so on."""
    return [emit.shuffle(builder, whole, whole, range(n, size * count, size)) for n in range(size)]


@intrinsic(prefer_literal=True)
def load_groups(typing_context: Any, address: Any, index: Any, size: Any, count: Any) -> Any:
    """`count` groups of `size` float32 or int32 from p[index] on: a tuple of the first of each as a vector, the second and so on."""
    vector, each = Vector(element_of(address.dtype), count.literal_value), size.literal_value

    def body(builder: Any, address: Any, index: Any, size: Any, count: Any) -> list[Any]:
        return _split(builder, emit.load(builder, address, index, ir.VectorType(vector.llvm.element, each * vector.count)), each, vector.count)

    return types.UniTuple(vector, each)(address, types.int64, size, count), emit.emits(body)


@intrinsic(prefer_literal=True)
def gather_groups(typing_context: Any, address: Any, places: Any, at: Any, size: Any, count: Any) -> Any:
    """`count` groups of `size` int32, from p[q[at]] on, from p[q[at + 1]] on and so on; as `load_groups`."""
    vector, each = Vector(types.int32, count.literal_value), size.literal_value
    group = ir.VectorType(emit.I32, each)

    def body(builder: Any, address: Any, places: Any, at: Any, size: Any, count: Any) -> list[Any]:
        parts = []
        for n in range(vector.count):
            place = builder.load(builder.gep(places, [builder.add(at, emit.index(n))]))
            parts.append(emit.load(builder, address, builder.sext(place, emit.I64), group))
        return _split(builder, emit.concatenate(builder, parts), each, vector.count)

    return types.UniTuple(vector, each)(_INTS, _INTS, types.int64, size, count), emit.emits(body)


@intrinsic(prefer_literal=True)
def prefetch_groups(typing_context: Any, address: Any, places: Any, count: Any) -> Any:
    """`prefetch` of p[4 n] for each n of the first `count` of a pointer to int32."""
    lanes = count.literal_value

    def body(builder: Any, address: Any, places: Any, count: Any) -> None:
        for n in range(lanes):
            place = builder.sext(builder.load(builder.gep(places, [emit.index(n)])), emit.I64)
            emit.prefetch(builder, builder.gep(address, [builder.shl(place, emit.index(2))]))

    return types.void(address, _INTS, count), emit.emits(body)


def _interleaved(builder: Any, values: list[Any]) -> Any:
    """One vector of the first lanes of some, the second and so on."""
    size, count = len(values), values[0].type.count
    whole = emit.concatenate(builder, [*values, *[values[-1]] * (-size % 4 if size > 2 else 0)])
    return emit.shuffle(builder, whole, whole, [count * (n % size) + n // size for n in range(size * count)])


@intrinsic
def store_groups(typing_context: Any, address: Any, index: Any, values: Any) -> Any:
    """The reverse of `load_groups`, for a pointer to float32: p[index] = a[0], p[index + 1] = b[0], ..., then a[1] and so on, of a tuple of vectors."""
    size = values.count

    def body(builder: Any, address: Any, index: Any, values: Any) -> None:
        emit.store(builder, address, index, _interleaved(builder, cgutils.unpack_tuple(builder, values, size)))

    return types.void(_FLOATS, types.int64, values), emit.emits(body)


@intrinsic(prefer_literal=True)
def store_rows(typing_context: Any, address: Any, index: Any, stride: Any, values: Any, width: Any) -> Any:
    """`store_groups` in rows of `width` lanes: those of row r from p[index + r stride] on."""
    columns, count, size = width.literal_value, values.dtype.count, values.count

    def body(builder: Any, address: Any, index: Any, stride: Any, values: Any, width: Any) -> None:
        vectors = cgutils.unpack_tuple(builder, values, size)
        for row in range(0, count, columns):
            parts = [emit.shuffle(builder, each, each, range(row, row + columns)) for each in vectors]
            emit.store(builder, address, index, _interleaved(builder, parts))
            index = builder.add(index, stride)

    return types.void(_FLOATS, types.int64, types.int64, values, width), emit.emits(body)
