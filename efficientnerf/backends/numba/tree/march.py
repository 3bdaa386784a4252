"""Constants of the marching of rays through trees, and the exponential that all kernels share (numba).

Packed, interpolated trees are marched through by `packets.march`, packet by packet of rays.
"""

from __future__ import annotations

import math

import numpy as np

from efficientnerf.backends.numba.runtime import numba
from efficientnerf.backends.numba.simd import EXP2_COEFFICIENTS, fmuladd

EARLY_STOP = 1e-3  # transmittance at which a ray may end
PACKED_EARLY_STOP = 5e-4  # transmittance at which a ray ends here; the rest of the tolerance is left to view colours
MIN_COLOUR_WEIGHT = 1e-4  # weight below which no colour is looked up; it is added to that of the next sample that has one
SKIP_MARGIN = 1e-3  # steps by which a skip ends early, so that float32 rounding never makes it end late

_ONE = np.float32(1)
LOG2E = math.log2(math.e)
PARALLEL = np.float32(1e-30)  # component of a unit direction below which a ray is parallel to a face
_EXP2 = tuple(np.float32(c) for c in EXP2_COEFFICIENTS)


@numba.njit(cache=True, inline="always", error_model="numpy")
def exp2_neg(x):  # type: ignore[no-untyped-def]
    """2^-x of a float32 x >= 0."""
    y = min(x, np.float32(126))
    whole = np.int32(y)
    f = y - np.float32(whole)
    p = fmuladd(f, fmuladd(f, fmuladd(f, fmuladd(f, fmuladd(f, _EXP2[4], _EXP2[3]), _EXP2[2]), _EXP2[1]), _EXP2[0]), _ONE)
    return p * np.int32((np.int32(127) - whole) << np.int32(23)).view(np.float32)
