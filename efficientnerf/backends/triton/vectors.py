"""Points, directions and colours as one value of three components, for the CUDA kernels (Triton)."""

from __future__ import annotations

from typing import Any, NamedTuple

import triton
import triton.language as tl


class Vec3(NamedTuple):
    """Three blocks of one shape, or three numbers."""

    x: Any
    y: Any
    z: Any


@triton.jit
def load_vec3(buffer, r, live):
    """Rows `r` of a buffer (R, 3); (1, 0, 0) where not live."""
    return Vec3(tl.load(buffer + r * 3, live, other=1.0), tl.load(buffer + r * 3 + 1, live, other=0.0), tl.load(buffer + r * 3 + 2, live, other=0.0))


@triton.jit
def store_vec3(buffer, r, v, live):
    """Rows `r` of a buffer (R, 3)."""
    tl.store(buffer + r * 3, v.x, live)
    tl.store(buffer + r * 3 + 1, v.y, live)
    tl.store(buffer + r * 3 + 2, v.z, live)


@triton.jit
def zeros_vec3(BLOCK: tl.constexpr):
    return Vec3(tl.zeros((BLOCK,), tl.float32), tl.zeros((BLOCK,), tl.float32), tl.zeros((BLOCK,), tl.float32))


@triton.jit
def along(origin, direction, t):
    """origin + t direction."""
    return Vec3(origin.x + t * direction.x, origin.y + t * direction.y, origin.z + t * direction.z)


@triton.jit
def add_scaled(total, weight, v):
    """total + weight v."""
    return Vec3(total.x + weight * v.x, total.y + weight * v.y, total.z + weight * v.z)


@triton.jit
def sigmoid(x):
    e = tl.exp(-tl.abs(x))
    return tl.where(x >= 0, 1.0, e) / (1 + e)
