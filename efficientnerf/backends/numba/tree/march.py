"""Rays marched through a tree by scalar kernels (numba): the one loop over samples, and constants that all marches share.

Samples lie as FORMAT.md says, section 6; in nested trees as `efficientnerf.asset.rendering.ray_parts` says. Coordinates of rays are in voxels of cascade 0.

`march_with` takes a visitor, as `efficientnerf.backends.triton.tree_march` does: rendering of nearest lookup (`tree.nearest`), the greatest weights of voxels
(`tree.contributions`) and the gradients of training (`tree_training.packets`). Interpolated trees are rendered by a march of their own, `packets.march`: there
a sample of thirty-two rays is taken at once. Through a made tree of 80 voxels a side a ray of this march, without any colour, takes 1.3 times as long as
one of a packet with colours (6.1 and 4.6 us on one core). docs/experiments/renderer.md
"""

import math
import types
from collections.abc import Callable
from typing import Any

import numpy as np

from efficientnerf.backends.numba.runtime import numba

PACKED_EARLY_STOP = 5e-4  # transmittance at which a ray of a packet ends; the rest of the tolerance is left to view colours
MIN_COLOUR_WEIGHT = 1e-4  # weight below which no colour is looked up; it is added to that of the next sample that has one
SKIP_MARGIN = 1e-3  # steps by which a skip ends early, so that float32 rounding never makes it end late

LOG2E = math.log2(math.e)
PARALLEL = np.float32(1e-30)  # component of a unit direction below which a ray is parallel to a face


@numba.njit(cache=True, error_model="numpy")
def most_samples(nx, ny, nz, step):
    """Samples on a ray through a grid of so many voxels, `step` apart, at most. Distances far beyond the grid are rounded to more than that."""
    return int(np.ceil(np.sqrt(nx * nx + ny * ny + nz * nz) / step)) + 2


@numba.njit(cache=True, inline="always", error_model="numpy")
def box_distances(ox, oy, oz, dx, dy, dz, nx, ny, nz):
    """Distances at which a ray enters, 0 at least, and leaves the box of a grid of so many voxels; the second is not greater where it misses it."""
    ix = 1 / dx if dx != 0 else 1e30
    iy = 1 / dy if dy != 0 else 1e30
    iz = 1 / dz if dz != 0 else 1e30
    t0 = max(min(-ox * ix, (nx - ox) * ix), min(-oy * iy, (ny - oy) * iy), min(-oz * iz, (nz - oz) * iz), 0.0)
    t1 = min(max(-ox * ix, (nx - ox) * ix), max(-oy * iy, (ny - oy) * iy), max(-oz * iz, (nz - oz) * iz))
    if not t1 > t0 or (dx == 0 and (ox < 0 or ox > nx)) or (dy == 0 and (oy < 0 or oy > ny)) or (dz == 0 and (oz < 0 or oz > nz)):
        return t0, t0
    return t0, t1


@numba.njit(cache=True, error_model="numpy")
def cascade_distances(origin, direction, tree, n):
    """Distances at which a ray enters and leaves the box of cascade n, voxels of cascade 0; see `box_distances`."""
    x, y, z = origin[0] - tree.corner[3 * n], origin[1] - tree.corner[3 * n + 1], origin[2] - tree.corner[3 * n + 2]
    side = tree.scale[n] * tree.brick
    return box_distances(
        x, y, z, direction[0], direction[1], direction[2], tree.shape[3 * n] * side, tree.shape[3 * n + 1] * side, tree.shape[3 * n + 2] * side
    )


@numba.njit(cache=True, inline="always", error_model="numpy")
def _cube_exit(o, d, inverse, cell, leap, brick):
    """Distance at which a ray leaves the empty cube of cells around its own, along one axis."""
    exit_ = ((cell + leap) * brick - o) * inverse if d > 0 else ((cell - leap + 1) * brick - o) * inverse
    return exit_ if d != 0 else 1e30


def _visit(point, cell, t, cascade, tree, scene, state):
    raise NotImplementedError("`march_with` puts a visitor here")


def _through_cascade(origin, direction, t0, t1, clear, cascade, tree, stop, scene, state):
    """Visits the samples of a ray between two distances in one cascade, all in its voxels; returns the state behind them."""
    (ox, oy, oz), (dx, dy, dz), brick, first = origin, direction, tree.brick, tree.first[cascade]
    ny, nz = tree.shape[3 * cascade + 1], tree.shape[3 * cascade + 2]
    sx, sy, sz = tree.shape[3 * cascade] * brick, ny * brick, nz * brick
    ix = 1 / dx if dx != 0 else 1e30
    iy = 1 / dy if dy != 0 else 1e30
    iz = 1 / dz if dz != 0 else 1e30
    last, k = int(np.floor(min((t1 - t0) / tree.step, most_samples(sx, sy, sz, tree.step)))) + 1, 0
    if clear > t0:
        k = int(min((clear - t0) / tree.step, float(last)))  # no later than the first sample behind it
    while k < last:
        t = t0 + (k + 0.5) * tree.step
        if t >= t1:
            break
        u, v, w = ox + t * dx, oy + t * dy, oz + t * dz
        if not (0 <= u < sx and 0 <= v < sy and 0 <= w < sz):  # by rounding, at a face
            k += 1
            continue
        a, b, c = int((int(u) + 0.5) * tree.inverse), int((int(v) + 0.5) * tree.inverse), int((int(w) + 0.5) * tree.inverse)
        leap = int(tree.leap[first + (a * ny + b) * nz + c])
        if leap > 0:
            fx, fy, fz = _cube_exit(ox, dx, ix, a, leap, brick), _cube_exit(oy, dy, iy, b, leap, brick), _cube_exit(oz, dz, iz, c, leap, brick)
            k = max(k + 1, int(np.ceil((min(fx, fy, fz) - t0) / tree.step - 0.5)))
            continue
        k += 1
        state = _visit((u, v, w), (a, b, c), t, cascade, tree, scene, state)
        if state[0] < stop:
            break
    return state


def _march(origin, direction, clear, tree, stop, scene, state):
    """Part p of a ray lies in cascade |L - 1 - p|, before or behind the box that is cut out of that."""
    outermost = tree.cascades - 1
    for part in range(2 * outermost + 1):
        n = abs(outermost - part)
        t0, t1 = cascade_distances(origin, direction, tree, n)
        if n == outermost and not t1 > t0:
            return state
        if n > 0:
            enter, leave = cascade_distances(origin, direction, tree, n - 1)
            if leave > enter and part < outermost:
                t1 = enter
            elif part > outermost:
                t0 = leave if leave > enter else t1
        if t1 > t0:
            scale = tree.scale[n]
            ox, oy, oz = origin[0] - tree.corner[3 * n], origin[1] - tree.corner[3 * n + 1], origin[2] - tree.corner[3 * n + 2]
            at, along = (ox / scale, oy / scale, oz / scale), (direction[0], direction[1], direction[2])
            state = _through_cascade(at, along, t0 / scale, t1 / scale, clear / scale, n, tree, stop, scene, state)
            if state[0] < stop:
                return state
    return state


def march_with(visit: Callable[..., Any]) -> Callable[..., Any]:
    """A kernel (origin, direction, clear, tree, stop, scene, state) -> state, which visits the samples of a ray in occupied coarse cells, front to back.

    visit   compiled, (point, cell, t, cascade, tree, scene, state) -> state: coordinates, coarse cell and distance in voxels of the cascade
    clear   distance before which the ray meets nothing, voxels of cascade 0
    tree    Cells with densities, of pointers
    stop    the ray ends where state[0] is below it
    scene   what does not change along the ray
    state   a tuple of numbers, the transmittance first
    """

    def bound(function: Any, **names: Any) -> Any:
        # A copy whose globals have the visitor: numba caches it under its own name, which it does not for closures over compiled functions.
        name = f"{function.__name__}_{visit.__name__}"
        copy = types.FunctionType(function.__code__.replace(co_name=name, co_qualname=name), {**globals(), **names}, name)
        copy.__module__, copy.__qualname__ = __name__, name
        return numba.njit(cache=True, error_model="numpy")(copy)

    return bound(_march, _through_cascade=bound(_through_cascade, _visit=visit))
