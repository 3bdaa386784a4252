"""LLVM instructions on vectors, which intrinsics are made of. A value is a number or a vector of LLVM."""

from collections.abc import Callable, Iterable
from typing import Any

import numpy as np
from llvmlite import ir

I1, I16, I32, I64, F32 = ir.IntType(1), ir.IntType(16), ir.IntType(32), ir.IntType(64), ir.FloatType()

# Minimax polynomial of 2^-f = 1 + f (c_0 + f (c_1 + ...)) on [0, 1], exact at 0: maximum error 6e-8.
EXP2_COEFFICIENTS = (-0.69314442, 0.24018671, -0.05531669, 0.00922838, -0.00095403)


def emits(body: Callable[..., Any]) -> Callable[..., Any]:
    """The code generator of an intrinsic: body (builder, *arguments) -> value, or a list of those of a tuple, or None."""

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        value = body(builder, *args)
        if value is None:
            return context.get_dummy_value()
        return context.make_tuple(builder, signature.return_type, value) if isinstance(value, list) else value

    return codegen


def index(n: int) -> Any:
    """An offset."""
    return ir.Constant(I64, n)


def constant(kind: Any, x: float) -> Any:
    """A value of a type; a vector has it in all lanes."""
    element = getattr(kind, "element", kind)
    number = float(np.float32(x)) if element == F32 else float(x) if element == ir.DoubleType() else int(x)
    return ir.Constant(kind, [number] * kind.count if isinstance(kind, ir.VectorType) else number)


def like(kind: Any, element: Any) -> Any:
    """The type of as many lanes as another has, of other elements."""
    return ir.VectorType(element, kind.count) if isinstance(kind, ir.VectorType) else element


def splat(builder: Any, value: Any, count: int) -> Any:
    """A vector with a scalar in all lanes."""
    first = builder.insert_element(ir.Constant(ir.VectorType(value.type, count), ir.Undefined), value, ir.Constant(I32, 0))
    return builder.shuffle_vector(first, first, ir.Constant(ir.VectorType(I32, count), None))


def shuffle(builder: Any, left: Any, right: Any, lanes: Iterable[int]) -> Any:
    """Lanes of two vectors, numbered through."""
    order = list(lanes)
    return builder.shuffle_vector(left, right, ir.Constant(ir.VectorType(I32, len(order)), order))


def concatenate(builder: Any, parts: list[Any]) -> Any:
    """A power of two of vectors end to end."""
    while len(parts) > 1:
        parts = [shuffle(builder, a, b, range(2 * a.type.count)) for a, b in zip(parts[::2], parts[1::2], strict=True)]
    return parts[0]


def pack(builder: Any, numbers: list[Any]) -> Any:
    """A vector of scalars."""
    value = ir.Constant(ir.VectorType(numbers[0].type, len(numbers)), ir.Undefined)
    for n, number in enumerate(numbers):
        value = builder.insert_element(value, number, ir.Constant(I32, n))
    return value


def unpack(builder: Any, value: Any) -> list[Any]:
    """The lanes of a vector."""
    return [builder.extract_element(value, ir.Constant(I32, n)) for n in range(value.type.count)]


def align_of(kind: Any) -> int:
    """Bytes that a vector in memory is aligned to: those of an element, four at most."""
    return 2 if kind.element == I16 else 4


def address_of(builder: Any, address: Any, at: Any, kind: Any) -> Any:
    """p[at] as a pointer to a type."""
    return builder.bitcast(builder.gep(address, [at]), kind.as_pointer())


def load(builder: Any, address: Any, at: Any, kind: Any) -> Any:
    """A vector of a type from p[at] on."""
    return builder.load(address_of(builder, address, at, kind), align=align_of(kind))


def store(builder: Any, address: Any, at: Any, value: Any) -> None:
    """A vector from p[at] on."""
    builder.store(value, address_of(builder, address, at, value.type), align=align_of(value.type))


def prefetch(builder: Any, address: Any) -> None:
    """Ask for the cache line of an address."""
    place = builder.bitcast(address, ir.IntType(8).as_pointer())
    kind = ir.FunctionType(ir.VoidType(), [place.type, I32, I32, I32])
    to_read, into_all_caches, of_data = (ir.Constant(I32, n) for n in (0, 3, 1))
    builder.call(builder.module.declare_intrinsic("llvm.prefetch.p0", (), kind), [place, to_read, into_all_caches, of_data])


def call(builder: Any, name: str, *values: Any) -> Any:
    """An intrinsic of LLVM on values of one type, which is that of its result."""
    kind = values[0].type
    element, count = (kind.element, f"v{kind.count}") if isinstance(kind, ir.VectorType) else (kind, "")
    suffix = {F32: "f32", ir.DoubleType(): "f64", I64: "i64"}.get(element, "i32")
    return builder.call(builder.module.declare_intrinsic(f"llvm.{name}.{count}{suffix}", (), ir.FunctionType(kind, [kind] * len(values))), values)


def fma(builder: Any, a: Any, b: Any, total: Any) -> Any:
    """a b + total: rounded once where the processor has an instruction for it, else twice, wherever the code is used."""
    return call(builder, "fmuladd", a, b, total)


def exp2(builder: Any, y: Any, bias: int) -> Any:
    """2^(bias - 127 - y) of float32 for 0 <= y < bias."""
    whole = like(y.type, I32)
    n = builder.fptosi(y, whole)
    f = builder.fsub(y, builder.sitofp(n, y.type))
    power = constant(y.type, EXP2_COEFFICIENTS[-1])
    for coefficient in (*EXP2_COEFFICIENTS[-2::-1], 1.0):
        power = fma(builder, power, f, constant(y.type, coefficient))
    exponent = builder.shl(builder.sub(constant(whole, bias), n), constant(whole, 23))
    return builder.fmul(power, builder.bitcast(exponent, y.type))


def first_lanes(builder: Any, count: Any, lanes: int) -> Any:
    """A mask of the first `count`, below 2^31, of so many lanes."""
    numbers = ir.Constant(ir.VectorType(I32, lanes), list(range(lanes)))
    return builder.icmp_signed("<", numbers, splat(builder, builder.trunc(count, I32), lanes))
