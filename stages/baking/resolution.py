"""The resolution of an asset: as fine as its budget has room for, and no finer than the photographs tell apart.

How many voxels a surface or a fog takes at some resolution can't be told from the box. So the network is looked at once, on the finest grid
that comes into question; on coarser grids the same voxels are counted: first on two that are cheap, whose exponent says how the number grows (2
for surfaces, 3 for what fills space), then on the one that this promises. Nothing depends on the clock or on the memory that happens to be free.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from stages.framing.forward_facing import ForwardFacing
    from stages.io.scene import Scene

LEAST = 32  # voxels along the longest side
PIXELS = 0.5  # of a pixel's width that a voxel is at least wide. Held-back views of chair_200 at 1: 36.5 dB; 0.75: 37.4; 0.5: 37.6, at three times the bytes
SURROUNDED = 4 / 3  # likewise where surroundings are learned: photographs hold noise, and finer voxels learn it. Held-back views of still_life at
# 1.31 pixels (384 voxels a side): 28.57 dB; 0.98 (512): 28.44, and 28.36 after twice the steps
MOST = {"cut out": 1024, "surrounded": 384, "ndc": 1024}  # finer voxels took photographs longer than they were seen to gain
MIB = 24  # an asset's size at most
# For a pixel of what the cameras of a forward-facing capture show, and at most. Held-back views of fern_4, of which the network has 24.08 dB, in 24 MiB
# (2.8 pixels to a voxel's width): 23.50 dB; 50 (2.1): 23.97, from twice as many voxels.
NDC_BYTES, NDC_MIB = 36, 56
CLOSE = 0.93  # of the room that is used, at least
TRIES = 4


@dataclass(frozen=True)
class Choice:
    """A resolution, and one sentence on what decided it."""

    resolution: int
    why: str


def finest_resolution(s: Scene, most: int | None) -> Choice:
    """Voxels along the longest side of the box, so that a voxel covers half a pixel at the box's centre, for the median camera, and 4/3 of it
    where surroundings are learned; at most `most` of them, or MOST where it is None.

    In normalised device coordinates, where a pixel is as wide at any depth, a voxel is as wide as 4/3 of a pixel.
    """
    if s.forward is not None:
        wide, share = ndc_pixel(s, s.forward), SURROUNDED
        side = float((s.forward.bounds[1] - s.forward.bounds[0])[:2].max())
    else:
        centre = np.asarray(s.bounds, np.float64).mean(axis=0)
        wide = float(np.median([np.linalg.norm(view.camera.centre - centre) / view.camera.intrinsics["fx"] for view in s.views]))
        share = PIXELS if s.background is not None else SURROUNDED
        side = float((s.bounds[1] - s.bounds[0]).max())
    if most is None:
        most = MOST["ndc" if s.forward is not None else "cut out" if s.background is not None else "surrounded"]
    told = max(LEAST, round(side / (share * wide)))
    if told > most:
        return Choice(most, f"bake.max_resolution; pixels would tell {told} apart")
    return Choice(told, f"a voxel covers {share:.2g} of a pixel")


def budget_of(s: Scene, given: int | None) -> int:
    """MiB that an asset may have: those given, or else MIB. In normalised device coordinates, where nothing is empty and each pixel needs voxels
    of its own, NDC_BYTES to each pixel of the box's face, where that is more; at most NDC_MIB."""
    if given is not None or s.forward is None:
        return MIB if given is None else given
    across, down = (s.forward.bounds[1] - s.forward.bounds[0])[:2] / ndc_pixel(s, s.forward)
    return int(np.clip(NDC_BYTES * across * down / 2**20, MIB, NDC_MIB))


def ndc_pixel(s: Scene, forward: ForwardFacing) -> float:
    """How wide a pixel of the median camera is in normalised device coordinates, at any depth."""
    return forward.ndc.slopes[0] / float(np.median([view.camera.intrinsics["fx"] for view in s.views]))


def affordable_resolution(finest: Choice, count: Callable[[int], int], room: Callable[[int], int]) -> Choice:
    """The greatest resolution up to the finest at which no more voxels are baked than there is room for, about.

    count  voxels that would be baked at a resolution
    room   voxels that may be
    """
    top = finest.resolution
    low, high = (max(LEAST, top // n) for n in (4, 2))
    few, more = count(low), count(high)
    power = float(np.clip(math.log(max(more, 1) / max(few, 1)) / math.log(high / low), 1.5, 3)) if high > low else 2.0

    def scaled(at: int, voxels: int) -> int:
        return int(np.clip(int(at * (0.5 * (1 + CLOSE) * room(at) / max(voxels, 1)) ** (1 / power)), LEAST, top))

    at = top if more * (top / high) ** power <= 1.2 * room(top) else scaled(high, more)
    best = 0
    for _ in range(TRIES):
        voxels = count(at)
        if voxels <= room(at):
            best = max(best, at)
            if at == top or voxels >= CLOSE * room(at):
                break
        following = scaled(at, voxels)
        if following in (at, best):
            break
        at = following
    best = best or at
    return finest if best == top else Choice(best, f"as fine as bake.max_mib has room for, where voxels grow with the resolution to the power {power:.1f}")
