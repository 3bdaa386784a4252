"""Rays through trees whose voxels are not interpolated (`NerfTree.lookup` is "nearest"), on the CPU (numba, all cores): a plain march over the tree as it
lies, sampled as FORMAT.md says, section 6. The torch reference is `efficientnerf.asset.rendering.render_reference`.

R rays, K harmonics.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from efficientnerf.backends.numba.runtime import numba
from efficientnerf.backends.numba.tree.march import STEP, STOP
from efficientnerf.backends.numba.tree.rendering import normal_at
from efficientnerf.rendering.harmonics import basis_numpy

if TYPE_CHECKING:
    from efficientnerf.asset.tree import NerfTree


@numba.njit(cache=True, error_model="numpy")
def _entry(start, along, sides):  # type: ignore[no-untyped-def]
    """Where a ray enters and leaves the grid, from its origin on; it leaves first where it misses."""
    t0, t1 = 0.0, np.inf
    for n in range(3):
        if along[n] != 0:
            one, other = -start[n] / along[n], (sides[n] - start[n]) / along[n]
            t0, t1 = max(t0, min(one, other)), min(t1, max(one, other))
        elif not 0 <= start[n] <= sides[n]:
            t1 = -1.0
    return t0, t1


@numba.njit(cache=True, error_model="numpy")
def _shade(sh, basis, rgb):  # type: ignore[no-untyped-def]
    """Sigmoid of the harmonics' sum of one voxel (K, 3) into `rgb`."""
    for c in range(3):
        logit = 0.0
        for k in range(len(basis)):
            logit += basis[k] * sh[k, c]
        rgb[c] = 1 / (1 + np.exp(-logit))


@numba.njit(cache=True, error_model="numpy")
def _march(start, along, basis, brick, brick_index, voxel_index, density, sh, leap, reach, colour):  # type: ignore[no-untyped-def]
    """Adds a ray's colour to `colour`; its opacity, and where half of the light is gone, voxels from the origin, or infinity.

    reach  length of a step, units of the frame
    """
    sides, cell, at, rgb = np.empty(3), np.empty(3, np.int64), np.empty(3, np.int64), np.empty(3)
    for n in range(3):
        sides[n] = brick_index.shape[n] * brick
    t0, t1 = _entry(start, along, sides)
    light, hit, shaded = 1.0, np.inf, -1
    k, last = 0, int(np.ceil((t1 - t0) / STEP - 0.5)) if t1 > t0 else 0
    while k < last:
        t = t0 + (k + 0.5) * STEP
        for n in range(3):  # at a face rounding might lead out of the grid
            at[n] = min(max(int(np.floor(start[n] + t * along[n])), 0), int(sides[n]) - 1)
            cell[n] = at[n] // brick
        far = int(leap[cell[0], cell[1], cell[2]])
        if far > 0:
            end = np.inf
            for n in range(3):
                if along[n] != 0:
                    face = (cell[n] + far if along[n] > 0 else cell[n] - far + 1) * brick
                    end = min(end, (face - start[n]) / along[n])
            k = max(k + 1, int(np.ceil((end - t0) / STEP - 0.5)))
            continue
        k += 1
        local = ((at[0] - cell[0] * brick) * brick + at[1] - cell[1] * brick) * brick + at[2] - cell[2] * brick
        voxel = voxel_index[brick_index[cell[0], cell[1], cell[2]], local]
        if voxel < 0 or not density[voxel] > 0:
            continue
        if voxel != shaded:
            _shade(sh[voxel], basis, rgb)
            shaded = voxel
        thickness = density[voxel] * reach
        left = light * np.exp(-thickness)
        for c in range(3):
            colour[c] += (light - left) * rgb[c]
        if left <= 0.5 < light:
            hit = t - 0.5 * STEP + np.log(2 * light) / thickness * STEP
        light = left
        if light < STOP:
            break
    return 1 - light, hit


@numba.njit(cache=True, parallel=True, error_model="numpy")
def _trace(starts, alongs, bases, brick, brick_index, voxel_index, density, sh, leap, reach, colour, opacity, hit):  # type: ignore[no-untyped-def]
    for ray in numba.prange(len(starts)):
        opacity[ray], hit[ray] = _march(
            starts[ray], alongs[ray], bases[ray], brick, brick_index, voxel_index, density, sh, leap, reach, colour[ray]
        )  # fmt: skip


def render_rays(
    tree: NerfTree, origins: np.ndarray, directions: np.ndarray, looking: np.ndarray | None = None
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Colour (R, 3) premultiplied, opacity (R,), distance (R,), normal (R, 3) of rays, float32; see `backends.numba.tree.rendering.render_rays`."""
    origins, alongs = np.asarray(origins, np.float64), np.ascontiguousarray(directions, np.float64)
    starts = np.ascontiguousarray((origins - tree.bounds_min) / tree.voxel)
    bases = np.ascontiguousarray(basis_numpy(np.asarray(directions if looking is None else looking, np.float32), tree.degree))
    colour, opacity, hit = np.zeros((len(starts), 3)), np.zeros(len(starts)), np.full(len(starts), np.inf)
    reach = float(STEP * tree.voxel)
    _trace(starts, alongs, bases, tree.brick, tree.brick_index, tree.voxel_index, tree.density_values, tree.sh, tree.leap, reach, colour, opacity, hit)
    depth = hit * tree.voxel
    normal, solid = np.zeros((len(starts), 3), np.float32), np.isfinite(hit)
    if solid.any():
        normal[solid] = normal_at(tree, origins[solid] + depth[solid, None] * alongs[solid])
    return colour.astype(np.float32), opacity.astype(np.float32), depth.astype(np.float32), normal
