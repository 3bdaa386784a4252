"""The resolution of an asset: as fine as its size allows, and no finer than the training images resolve.

The number of voxels at a resolution cannot be derived from the box. Visibility is computed once, on the finest grid in question, and the same voxels are
counted on coarser grids: first on two cheap ones, which give the exponent of growth (2 for surfaces, 3 for volumes), then on the one that follows
from it. Nothing depends on the clock or on free memory.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from efficientnerf.capture.forward_facing import ForwardFacing
from stages.io.scene import Scene, views_of

MIN_RESOLUTION = 32  # voxels along the longest side
# docs/experiments/bake-resolution.md: width of a voxel in pixels, at least, with a constant background, of an unbounded scene (its innermost cascade), and in
# normalised device coordinates (images hold noise that finer voxels would learn); voxels along the longest side, at most; MiB of an asset, at most
VOXEL_PIXELS, SCENE_VOXEL_PIXELS, NDC_VOXEL_PIXELS = 0.5, 1.0, 4 / 3
MAX_RESOLUTION = 1024
MAX_MIB = 38
# Of unbounded scenes: bytes for each pixel of the training images; MiB at most, where these are more than MAX_MIB (docs/experiments/bake-resolution.md); the
# share of what the field shows that may lie beyond the last cascade, in the environment map; coarse cells of all cascades.
SCENE_BYTES, SCENE_MAX_MIB, MAX_BEYOND, MAX_CELLS = 0.7, 76, 0.01, 2**24
# In normalised device coordinates: bytes for each pixel of the box's face; MiB at least and at most. docs/experiments/ndc.md
NDC_BYTES, NDC_MIN_MIB, NDC_MAX_MIB = 34, 24, 56
# With bake.time_budget: MiB for each second of a core, which are refined to within little of what longer gives; MiB at least. A voxel of an unbounded scene
# takes fewer rays. docs/experiments/tree-training.md
TIMED_MIB, SCENE_TIMED_MIB, MIN_TIMED_MIB = 0.115, 0.23, 2.0
MAX_OVERSHOOT = 2  # voxels baked over voxels that fit into the asset, at most: of which the refinement keeps the heaviest
OVERSHOOT = 1.7  # the same where the resolution is chosen: few of the dilated voxels show. docs/experiments/bake-resolution.md
MIN_FILL = 0.93  # of the size that is used, at least
MAX_TRIES = 4


@dataclass(frozen=True)
class Choice:
    """A resolution, and one sentence on what decided it."""

    resolution: int
    why: str


def finest_resolution(s: Scene, most: int = MAX_RESOLUTION) -> Choice:
    """Voxels along the longest side of the box, so that a voxel covers half a pixel at the box's centre, for the median camera; at most `most` of them.

    In normalised device coordinates, where a pixel is as wide at any depth, a voxel is as wide as 4/3 of a pixel.
    """
    if s.forward is not None:
        wide, share = ndc_pixel(s, s.forward), NDC_VOXEL_PIXELS
        side = float((s.forward.bounds[1] - s.forward.bounds[0])[:2].max())
    else:
        wide, share = pixel_at_centre(s, s.bounds), VOXEL_PIXELS
        side = float((s.bounds[1] - s.bounds[0]).max())
    return _resolved(side / (share * wide), share, most)


def finest_of_cascades(s: Scene, bounds: np.ndarray, count: int, brick: int, most: int | None) -> Choice:
    """`finest_resolution` of the innermost of so many cascades, which covers `bounds` (2, 3): a voxel covers a pixel at its centre. At most `most`, or as many
    as MAX_CELLS allow where it is None."""
    sides = np.asarray(bounds[1] - bounds[0], np.float64)
    if most is None:
        cells_at_one = float(np.prod(sides / sides.max())) / brick**3  # of a cascade, over the cube of the resolution
        most = max(MIN_RESOLUTION, int((MAX_CELLS / count / cells_at_one) ** (1 / 3)))
    return _resolved(float(sides.max()) / (SCENE_VOXEL_PIXELS * pixel_at_centre(s, bounds)), SCENE_VOXEL_PIXELS, most)


def _resolved(voxels: float, share: float, most: int) -> Choice:
    """So many voxels, each `share` of a pixel wide, but `most` at most."""
    resolved = max(MIN_RESOLUTION, round(voxels))
    if resolved > most:
        return Choice(most, f"bake.max_resolution; pixels resolve {resolved}")
    return Choice(resolved, f"a voxel covers {share:.2g} of a pixel")


def pixel_at_centre(s: Scene, bounds: np.ndarray) -> float:
    """Width of a pixel of the median camera at the centre of a box (2, 3), world units."""
    centre = np.asarray(bounds, np.float64).mean(axis=0)
    return float(np.median([np.linalg.norm(view.camera.centre - centre) / view.camera.intrinsics["fx"] for view in s.views]))


def scene_mib(pixels: int) -> float:
    """MiB that the asset of an unbounded scene may have where none are stated: the more pixels its training images have, the more voxels these tell apart."""
    return float(np.clip(SCENE_BYTES * pixels / 2**20, MAX_MIB, SCENE_MAX_MIB))


def usual_mib(s: Scene, *, packed: bool = False) -> float:
    """MiB that an asset may have where none are stated: MAX_MIB, or `scene_mib` of an unbounded scene. In normalised device coordinates, where nothing is empty
    and each pixel needs voxels of its own, NDC_BYTES to each pixel of the box's face, from NDC_MIN_MIB to NDC_MAX_MIB. An asset is as
    large as its voxels are, of which the finest have the width that pixels tell apart (`finest_resolution`). A packed one has a third of that."""
    mib: float = MAX_MIB
    if s.forward is not None:
        across, down = (s.forward.bounds[1] - s.forward.bounds[0])[:2] / ndc_pixel(s, s.forward)
        mib = int(np.clip(NDC_BYTES * across * down / 2**20, NDC_MIN_MIB, NDC_MAX_MIB))
    elif s.background is None:
        mib = scene_mib(sum(view.camera.width * view.camera.height for view in views_of(s, "train")))
    return math.ceil(mib / 3) if packed else mib


def mib_for_voxels(mib: float, usual: float, *, packed: bool, fixed: bool) -> float:
    """MiB that voxels are chosen by: bytes of a packed asset beyond the usual size go into finer codes, unless its resolution is stated. See
    docs/experiments/packed.md."""
    return min(mib, usual) if packed and not fixed else mib


def timed_mib(mib: float, seconds: float, cores: int, *, whole: bool, packed: bool = False) -> float:
    """MiB of those that an asset may have, which can be refined in so many seconds: fewer voxels that rays have met often are better than more of them."""
    timed = max(MIN_TIMED_MIB, (SCENE_TIMED_MIB if whole else TIMED_MIB) * seconds * cores)
    return min(mib, timed / 3 if packed else timed)


def ndc_pixel(s: Scene, forward: ForwardFacing) -> float:
    """Width of a pixel of the median camera in normalised device coordinates, at any depth."""
    return forward.ndc.slopes[0] / float(np.median([view.camera.intrinsics["fx"] for view in s.views]))


def affordable_resolution(finest: Choice, count: Callable[[int], int], capacity: Callable[[int], int]) -> Choice:
    """The greatest resolution up to the finest at which about as many voxels are baked as the asset holds.

    count     voxels that would be baked at a resolution
    capacity  voxels that the asset holds
    """
    top = finest.resolution
    low, high = (max(MIN_RESOLUTION, top // n) for n in (4, 2))
    few, more = count(low), count(high)
    power = float(np.clip(math.log(max(more, 1) / max(few, 1)) / math.log(high / low), 1.5, 3)) if high > low else 2.0

    def scaled(at: int, voxels: int) -> int:
        return int(np.clip(int(at * (0.5 * (1 + MIN_FILL) * capacity(at) / max(voxels, 1)) ** (1 / power)), MIN_RESOLUTION, top))

    at = top if more * (top / high) ** power <= 1.2 * capacity(top) else scaled(high, more)
    best = 0
    for _ in range(MAX_TRIES):
        voxels = count(at)
        if voxels <= capacity(at):
            best = max(best, at)
            if at == top or voxels >= MIN_FILL * capacity(at):
                break
        following = scaled(at, voxels)
        if following in (at, best):
            break
        at = following
    best = best or at
    return finest if best == top else Choice(best, f"as fine as its size allows, where voxels grow with the resolution to the power {power:.1f}")
