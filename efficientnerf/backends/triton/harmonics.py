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
    elif TERM < 4:
        value = (y, z, x)[TERM - 1]
    elif TERM < 9:
        value = (x * y, y * z, 2 * zz - xx - yy, x * z, xx - yy)[TERM - 4]
    elif TERM < 16:
        value = (
            y * (3 * xx - yy), x * y * z, y * (4 * zz - xx - yy), z * (2 * zz - 3 * xx - 3 * yy), x * (4 * zz - xx - yy), z * (xx - yy), x * (xx - 3 * yy),
        )[TERM - 9]  # fmt: skip
    else:
        value = (
            x * y * (xx - yy), y * z * (3 * xx - yy), x * y * (7 * zz - 1), y * z * (7 * zz - 3), zz * (35 * zz - 30) + 3, x * z * (7 * zz - 3),
            (xx - yy) * (7 * zz - 1), x * z * (xx - 3 * yy), xx * (xx - 3 * yy) - yy * (3 * xx - yy),
        )[TERM - 16]  # fmt: skip
    return value * FACTORS[TERM]


@triton.jit
def basis_columns(direction, term, K: tl.constexpr):
    """(R, C): harmonic `term` (C,) of each column along directions (R,); 0 in columns whose term is not below K."""
    basis = tl.zeros_like(direction.x)[:, None] + tl.zeros_like(term)[None, :].to(tl.float32)
    for n in tl.static_range(K):
        basis = tl.where((term == n)[None, :], harmonic(direction, n)[:, None], basis)
    return basis
