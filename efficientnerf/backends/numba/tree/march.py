"""Constants of the marching of rays through trees (numba).

Packed, interpolated trees are marched through by `packets.march`, packet by packet of rays.
"""

from __future__ import annotations

import math

import numpy as np

PACKED_EARLY_STOP = 5e-4  # transmittance at which a ray ends; the rest of the tolerance is left to view colours
MIN_COLOUR_WEIGHT = 1e-4  # weight below which no colour is looked up; it is added to that of the next sample that has one
SKIP_MARGIN = 1e-3  # steps by which a skip ends early, so that float32 rounding never makes it end late

LOG2E = math.log2(math.e)
PARALLEL = np.float32(1e-30)  # component of a unit direction below which a ray is parallel to a face
