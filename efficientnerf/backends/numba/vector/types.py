"""The type of vectors, and its operators."""

from __future__ import annotations

import operator
from typing import Any

from llvmlite import ir
from numba import types
from numba.extending import intrinsic, models, overload, register_model

from efficientnerf.backends.numba.vector import emit

_ELEMENTS = {types.float32: emit.F32, types.float64: ir.DoubleType(), types.int32: emit.I32, types.boolean: emit.I1}
_FLOATS = (types.float32, types.float64)


class Vector(types.Type):
    """Type of `count` numbers of one element type: float32, float64, int32 or boolean."""

    def __init__(self, element: Any, count: int) -> None:
        self.element, self.count = element, count
        super().__init__(name=f"{element}x{count}")

    @property
    def llvm(self) -> Any:
        """The type of LLVM."""
        return ir.VectorType(_ELEMENTS[self.element], self.count)

    def of(self, element: Any) -> Vector:
        """The type of as many lanes of another element."""
        return Vector(element, self.count)

    def takes(self, kind: Any) -> bool:
        """Whether an operand may be used with such vectors: one of the same type, or a scalar."""
        return kind == self or (isinstance(kind, types.Integer) if self.element == types.int32 else kind == self.element and kind in _FLOATS)


@register_model(Vector)
class _VectorModel(models.PrimitiveModel):
    def __init__(self, manager: Any, kind: Any) -> None:
        super().__init__(manager, kind, kind.llvm)


def element_of(kind: Any) -> Any:
    """The element of vectors that hold a scalar: all integers as int32."""
    return types.int32 if isinstance(kind, types.Integer) else kind


def vector_among(*kinds: Any) -> Any:
    """The first type of operands that is a vector, or None."""
    return next((kind for kind in kinds if isinstance(kind, Vector)), None)


def spread(builder: Any, value: Any, kind: Any, count: int) -> Any:
    """An operand as a vector."""
    if isinstance(kind, Vector):
        return value
    if isinstance(kind, types.Integer) and value.type != emit.I32:
        value = builder.trunc(value, emit.I32) if value.type.width > 32 else builder.sext(value, emit.I32)
    return emit.splat(builder, value, count)


def _overload(operation: Any, emits: dict[Any, Any], *, compares: bool = False) -> None:
    """An operator on two vectors, or on a vector and a scalar; emits: by element, (builder, left, right) -> value."""

    @intrinsic
    def elementwise(typing_context: Any, a: Any, b: Any) -> Any:
        vector = vector_among(a, b)

        def body(builder: Any, *args: Any) -> Any:
            return emits[vector.element](builder, *(spread(builder, arg, kind, vector.count) for arg, kind in zip(args, (a, b), strict=True)))

        return (vector.of(types.boolean) if compares else vector)(a, b), emit.emits(body)

    @overload(operation)
    def implementation(a, b):
        vector = vector_among(a, b)
        if vector is not None and vector.element in emits and vector.takes(a) and vector.takes(b):
            return lambda a, b: elementwise(a, b)
        return None


def _instruction(name: str) -> Any:
    return lambda builder, a, b: getattr(builder, name)(a, b)


def _comparison(order: str) -> dict[Any, Any]:
    floats = dict.fromkeys(_FLOATS, lambda builder, a, b: builder.fcmp_ordered(order, a, b))
    return {**floats, types.int32: lambda builder, a, b: builder.icmp_signed(order, a, b)}


for _operation, _float, _int in (
    (operator.add, "fadd", "add"), (operator.sub, "fsub", "sub"), (operator.mul, "fmul", "mul"), (operator.truediv, "fdiv", None),
    (operator.and_, None, "and_"), (operator.or_, None, "or_"), (operator.rshift, None, "lshr"), (operator.lshift, None, "shl"),
):  # fmt: skip
    _emits = dict.fromkeys(_FLOATS, _instruction(_float)) if _float else {}
    _emits |= {types.int32: _instruction(_int)} if _int else {}
    _emits |= {types.boolean: _instruction(_int)} if _int in ("and_", "or_") else {}
    _overload(_operation, _emits)
for _operation, _order in ((operator.lt, "<"), (operator.le, "<="), (operator.gt, ">"), (operator.ge, ">="), (operator.eq, "=="), (operator.ne, "!=")):
    _overload(_operation, _comparison(_order), compares=True)


@intrinsic
def _inverted(typing_context: Any, mask: Any) -> Any:
    return mask(mask), emit.emits(lambda builder, mask: builder.not_(mask))


@overload(operator.invert)
def _invert(mask):
    return (lambda mask: _inverted(mask)) if isinstance(mask, Vector) and mask.element == types.boolean else None
