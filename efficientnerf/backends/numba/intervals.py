"""The next coarse interval of sixteen rays at once, one per SIMD lane, inside numba kernels: its sample, and whether the density voxel there is valid.

The arithmetic of a lane is that of the scalar loop, bit for bit.
"""

from __future__ import annotations

from typing import Any

from llvmlite import ir
from numba import types
from numba.extending import intrinsic

from efficientnerf.backends.numba.simd import splat

LANES = 16
# Rows of the state, (ROWS, LANES) float32: origin and direction in unit coordinates; distance along the ray, and where the ray leaves the space; offset of a
# sample in its interval; threshold of the density voxels; number of intervals visited; start of the last of them.
UX, UY, UZ, VX, VY, VZ, T, T_EXIT, OFFSET, THRESHOLD, VISITED, START, ROWS = range(13)

_FLOAT32 = ir.VectorType(ir.FloatType(), LANES)
_INT32 = ir.VectorType(ir.IntType(32), LANES)


class _Vectors:
    """Vector arithmetic with the operations, and the order of them, that numba uses for scalars."""

    def __init__(self, builder: Any) -> None:
        self.builder = builder

    def constant(self, x: float) -> Any:
        return ir.Constant(_FLOAT32, [x] * LANES)

    def broadcast(self, x: Any) -> Any:
        return splat(self.builder, x, LANES)

    def maximum(self, x: Any, y: Any) -> Any:
        return self.builder.select(self.builder.fcmp_ordered(">", x, y), x, y)

    def minimum(self, x: Any, y: Any) -> Any:
        return self.builder.select(self.builder.fcmp_ordered("<", x, y), x, y)

    def absolute(self, x: Any) -> Any:
        bits = self.builder.and_(self.builder.bitcast(x, _INT32), ir.Constant(_INT32, [0x7FFFFFFF] * LANES))
        return self.builder.bitcast(bits, _FLOAT32)

    def point_at(self, origin: list[Any], direction: list[Any], t: Any) -> list[Any]:
        return [self.builder.fadd(u, self.builder.fmul(t, v)) for u, v in zip(origin, direction, strict=True)]

    def norm(self, point: list[Any]) -> Any:
        """Maximum norm, at least 1."""
        x, y, z = (self.absolute(coordinate) for coordinate in point)
        return self.maximum(self.maximum(x, y), self.maximum(z, self.constant(1)))


def _voxel_index(v: _Vectors, point: list[Any], side: Any) -> Any:
    """Flat index of the voxel at each point in grid coordinates; NaN falls into voxel 0."""
    b, side = v.builder, v.builder.trunc(side, ir.IntType(32))
    sides, last = v.broadcast(side), v.broadcast(b.sub(side, ir.Constant(ir.IntType(32), 1)))
    float_side, float_last = b.sitofp(sides, _FLOAT32), b.sitofp(last, _FLOAT32)
    index = ir.Constant(_INT32, None)
    for x in point:
        clamped = v.minimum(v.maximum(b.fmul(x, float_side), v.constant(0)), float_last)
        index = b.add(b.mul(index, sides), b.fptosi(clamped, _INT32))
    return index


def _next_intervals(contracted: bool) -> Any:
    @intrinsic
    def next_intervals(typing_context: Any, state: Any, voxels: Any, side: Any, step: Any, farthest: Any) -> Any:
        def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
            state, voxels, side, step, farthest = args
            v, b = _Vectors(builder), builder

            def row(n: int) -> Any:
                return b.bitcast(b.gep(state, [ir.Constant(ir.IntType(64), n * LANES)]), _FLOAT32.as_pointer())

            origin, direction = ([b.load(row(n), align=4) for n in rows] for rows in ((UX, UY, UZ), (VX, VY, VZ)))
            t, t_exit, offset, threshold, visited = (b.load(row(n), align=4) for n in (T, T_EXIT, OFFSET, THRESHOLD, VISITED))
            active, length = b.fcmp_ordered("<", t, t_exit), v.broadcast(step)
            if contracted:
                norm = v.norm(v.point_at(origin, direction, t))
                active = b.and_(active, b.fcmp_ordered("<=", b.fmul(norm, v.broadcast(farthest)), v.constant(1)))
                length = b.fmul(length, b.fmul(norm, norm))
            point = v.point_at(origin, direction, b.fadd(t, b.fmul(offset, v.minimum(length, b.fsub(t_exit, t)))))
            shift, scale = (v.constant(2), v.constant(0.25)) if contracted else (v.constant(1), v.constant(0.5))
            if contracted:
                norm = v.norm(point)
                factor = b.fdiv(b.fsub(v.constant(2), b.fdiv(v.constant(1), norm)), norm)
                point = [b.fmul(x, factor) for x in point]
            index = _voxel_index(v, [b.fmul(b.fadd(x, shift), scale) for x in point], side)
            density = ir.Constant(_FLOAT32, ir.Undefined)
            for n in range(LANES):
                lane = ir.Constant(ir.IntType(32), n)
                at = b.zext(b.extract_element(index, lane), ir.IntType(64))
                density = b.insert_element(density, b.load(b.gep(voxels, [at])), lane)
            valid = b.and_(active, b.fcmp_ordered(">", density, threshold))
            b.store(t, row(START), align=4)
            b.store(b.select(active, b.fadd(t, length), t), row(T), align=4)
            b.store(b.select(active, b.fadd(visited, v.constant(1)), visited), row(VISITED), align=4)
            masks = [b.zext(b.bitcast(mask, ir.IntType(LANES)), ir.IntType(64)) for mask in (active, valid)]
            return b.or_(masks[0], b.shl(masks[1], ir.Constant(ir.IntType(64), LANES)))

        number = types.float32
        return types.int64(types.CPointer(number), types.CPointer(number), types.int64, number, number), codegen

    return next_intervals


# Advance each ray by one interval: bit n of the result is set where ray n had not left the space, bit LANES + n where the interval is valid.
#
#     next_intervals(state, voxels, side, step, farthest)
#
# state and voxels are pointers to the rows above and to (side, side, side) float32. In the box an interval is `step` long, and a ray ends at T_EXIT; in
# contracted space it grows beyond the box with the square of the norm, and a ray ends where 1 / norm is below `farthest`, too.
next_intervals_bounded, next_intervals_contracted = _next_intervals(False), _next_intervals(True)


@intrinsic
def lowest_bit(typing_context: Any, bits: Any) -> Any:
    """Index of the lowest set bit of an int64 that is not zero."""

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        return builder.cttz(args[0], ir.Constant(ir.IntType(1), 1))

    return types.int64(types.int64), codegen
