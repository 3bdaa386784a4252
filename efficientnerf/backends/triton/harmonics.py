"""Spherical harmonics along rays, for the CUDA kernels (Triton) that render trees; formulas and order of `efficientnerf.rendering.harmonics`."""

from __future__ import annotations

import triton
import triton.language as tl

from efficientnerf.rendering import harmonics

FACTORS = tl.constexpr((harmonics.C0, -harmonics.C1, harmonics.C1, -harmonics.C1, *harmonics.C2, *harmonics.C3, *harmonics.C4))


@triton.jit
def harmonic(direction, TERM: tl.constexpr):
    """The TERM-th harmonic of directions (R,)."""
    x, y, z = direction.x, direction.y, direction.z
    xx, yy, zz = x * x, y * y, z * z
    if TERM == 0:
        value = 0.0 * x + 1.0
    elif TERM == 1:
        value = y
    elif TERM == 2:
        value = z
    elif TERM == 3:
        value = x
    elif TERM == 4:
        value = x * y
    elif TERM == 5:
        value = y * z
    elif TERM == 6:
        value = 2 * zz - xx - yy
    elif TERM == 7:
        value = x * z
    elif TERM == 8:
        value = xx - yy
    elif TERM == 9:
        value = y * (3 * xx - yy)
    elif TERM == 10:
        value = x * y * z
    elif TERM == 11:
        value = y * (4 * zz - xx - yy)
    elif TERM == 12:
        value = z * (2 * zz - 3 * xx - 3 * yy)
    elif TERM == 13:
        value = x * (4 * zz - xx - yy)
    elif TERM == 14:
        value = z * (xx - yy)
    elif TERM == 15:
        value = x * (xx - 3 * yy)
    elif TERM == 16:
        value = x * y * (xx - yy)
    elif TERM == 17:
        value = y * z * (3 * xx - yy)
    elif TERM == 18:
        value = x * y * (7 * zz - 1)
    elif TERM == 19:
        value = y * z * (7 * zz - 3)
    elif TERM == 20:
        value = zz * (35 * zz - 30) + 3
    elif TERM == 21:
        value = x * z * (7 * zz - 3)
    elif TERM == 22:
        value = (xx - yy) * (7 * zz - 1)
    elif TERM == 23:
        value = x * z * (xx - 3 * yy)
    else:
        value = xx * (xx - 3 * yy) - yy * (3 * xx - yy)
    return value * FACTORS[TERM]


@triton.jit
def basis_columns(direction, term, K: tl.constexpr):
    """(R, C): harmonic `term` (C,) of each column along directions (R,); 0 in columns whose term is not below K."""
    basis = tl.zeros_like(direction.x)[:, None] + tl.zeros_like(term)[None, :].to(tl.float32)
    for n in tl.static_range(K):
        basis = tl.where((term == n)[None, :], harmonic(direction, n)[:, None], basis)
    return basis
