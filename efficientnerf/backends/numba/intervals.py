"""Coarse intervals of sixteen rays at once, inside numba kernels: where their samples lie, and whether the density voxels are above the threshold there.

The arithmetic is that of one ray after the other, to the last bit.
"""

from __future__ import annotations

from typing import Any

from llvmlite import ir
from numba import types
from numba.extending import intrinsic

from efficientnerf.backends.numba.simd import spread

RAYS = 16
# Rows of the state, (ROWS, RAYS) float32: position and velocity in the space's unit box, the distance along the ray, where the ray leaves, the offset of
# samples in their intervals, the density that voxels must exceed, how many intervals were looked at, and where the last of them began.
UX, UY, UZ, VX, VY, VZ, T, LEAVE, OFFSET, LIMIT, TRIED, BEGAN, ROWS = range(13)

_FLOATS = ir.VectorType(ir.FloatType(), RAYS)
_WORDS = ir.VectorType(ir.IntType(32), RAYS)


class _Vectors:
    """Arithmetic of RAYS lanes in the order in which numba does that of one."""

    def __init__(self, builder: Any) -> None:
        self.builder = builder

    def number(self, x: float) -> Any:
        return ir.Constant(_FLOATS, [x] * RAYS)

    def every(self, x: Any) -> Any:
        return spread(self.builder, x, RAYS)

    def larger(self, x: Any, y: Any) -> Any:
        return self.builder.select(self.builder.fcmp_ordered(">", x, y), x, y)

    def smaller(self, x: Any, y: Any) -> Any:
        return self.builder.select(self.builder.fcmp_ordered("<", x, y), x, y)

    def size(self, x: Any) -> Any:
        bits = self.builder.and_(self.builder.bitcast(x, _WORDS), ir.Constant(_WORDS, [0x7FFFFFFF] * RAYS))
        return self.builder.bitcast(bits, _FLOATS)

    def along(self, start: list[Any], speed: list[Any], at: Any) -> list[Any]:
        return [self.builder.fadd(u, self.builder.fmul(at, v)) for u, v in zip(start, speed, strict=True)]

    def reach(self, place: list[Any]) -> Any:
        """The largest coordinate's size, 1 at least."""
        x, y, z = (self.size(one) for one in place)
        return self.larger(self.larger(x, y), self.larger(z, self.number(1)))


def _cell(v: _Vectors, place: list[Any], side: Any) -> Any:
    """The voxel of each place in grid coordinates; what is no number falls into the first."""
    b, side = v.builder, v.builder.trunc(side, ir.IntType(32))
    whole, last = v.every(side), v.every(b.sub(side, ir.Constant(ir.IntType(32), 1)))
    wide, top = b.sitofp(whole, _FLOATS), b.sitofp(last, _FLOATS)
    cell = ir.Constant(_WORDS, None)
    for x in place:
        inside = v.smaller(v.larger(b.fmul(x, wide), v.number(0)), top)
        cell = b.add(b.mul(cell, whole), b.fptosi(inside, _WORDS))
    return cell


def _next_intervals(contracted: bool) -> Any:
    @intrinsic
    def next_intervals(typing_context: Any, state: Any, voxels: Any, side: Any, step: Any, least: Any) -> Any:
        def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
            state, voxels, side, step, least = args
            v, b = _Vectors(builder), builder

            def row(n: int) -> Any:
                return b.bitcast(b.gep(state, [ir.Constant(ir.IntType(64), n * RAYS)]), _FLOATS.as_pointer())

            start, speed = ([b.load(row(n), align=4) for n in rows] for rows in ((UX, UY, UZ), (VX, VY, VZ)))
            t, leave, offset, limit, tried = (b.load(row(n), align=4) for n in (T, LEAVE, OFFSET, LIMIT, TRIED))
            there, length = b.fcmp_ordered("<", t, leave), v.every(step)
            if contracted:
                far = v.reach(v.along(start, speed, t))
                there = b.and_(there, b.fcmp_ordered("<=", b.fmul(far, v.every(least)), v.number(1)))
                length = b.fmul(length, b.fmul(far, far))
            place = v.along(start, speed, b.fadd(t, b.fmul(offset, v.smaller(length, b.fsub(leave, t)))))
            shift, scale = (v.number(2), v.number(0.25)) if contracted else (v.number(1), v.number(0.5))
            if contracted:
                m = v.reach(place)
                f = b.fdiv(b.fsub(v.number(2), b.fdiv(v.number(1), m)), m)
                place = [b.fmul(x, f) for x in place]
            cell = _cell(v, [b.fmul(b.fadd(x, shift), scale) for x in place], side)
            value = ir.Constant(_FLOATS, ir.Undefined)
            for n in range(RAYS):
                lane = ir.Constant(ir.IntType(32), n)
                at = b.zext(b.extract_element(cell, lane), ir.IntType(64))
                value = b.insert_element(value, b.load(b.gep(voxels, [at])), lane)
            valid = b.and_(there, b.fcmp_ordered(">", value, limit))
            b.store(t, row(BEGAN), align=4)
            b.store(b.select(there, b.fadd(t, length), t), row(T), align=4)
            b.store(b.select(there, b.fadd(tried, v.number(1)), tried), row(TRIED), align=4)
            masks = [b.zext(b.bitcast(mask, ir.IntType(RAYS)), ir.IntType(64)) for mask in (there, valid)]
            return b.or_(masks[0], b.shl(masks[1], ir.Constant(ir.IntType(64), RAYS)))

        number = types.float32
        return types.int64(types.CPointer(number), types.CPointer(number), types.int64, number, number), codegen

    return next_intervals


# One interval farther along each ray: bit n says that ray n was not at its end, bit RAYS + n that this interval is valid.
#
#     next_intervals(state, voxels, side, step, least)
#
# state is the address of the rows above, voxels of (side, side, side) float32. An interval is `step` long, and a ray ends at LEAVE; in contracted space it
# grows beyond the box with the square of the distance, and a ray ends where 1 / |u|_inf is below `least`, too.
next_intervals_in_box, next_intervals_contracted = _next_intervals(False), _next_intervals(True)


@intrinsic
def lowest_bit(typing_context: Any, bits: Any) -> Any:
    """Which of the bits of an int64, some of which are set, is the lowest that is."""

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        return builder.cttz(args[0], ir.Constant(ir.IntType(1), 1))

    return types.int64(types.int64), codegen
