"""Environment maps and backgrounds behind renders (numba): `efficientnerf.rendering.environment` laid over what a tree's voxels let through.

H, W rows and columns of rays.
"""

import math

import numpy as np

from efficientnerf.backends.numba.runtime import PRANGE, numba
from efficientnerf.backends.numba.tree.march import PACKED_EARLY_STOP
from efficientnerf.backends.numba.tree.ray_batch import RayBatch, given_rays, ray_at
from efficientnerf.backends.numba.vector.memory import pointer, pointers

RAYS_PER_CALL = 2**20  # so that signals are answered between calls


@numba.njit(cache=True, error_model="numpy")
def _lookup(x, y, z, environment, height, width, out):
    """`efficientnerf.rendering.environment.lookup` of one direction into (3,); zero where it is not finite."""
    out[0] = out[1] = out[2] = 0.0
    if not np.isfinite(x + y + z):
        return
    column = (math.atan2(y, x) / (2 * math.pi) + 0.5) * width - 0.5
    row = min(max(math.acos(min(max(z, -1.0), 1.0)) / math.pi * height - 0.5, 0.0), height - 1.0)
    left, top = math.floor(column), int(row)
    across, down = column - left, row - top
    low, right, left = min(top + 1, height - 1), (left + 1) % width, left % width
    for c in range(3):
        upper = environment[3 * (top * width + left) + c] * (1 - across) + environment[3 * (top * width + right) + c] * across
        lower = environment[3 * (low * width + left) + c] * (1 - across) + environment[3 * (low * width + right) + c] * across
        out[c] = upper * (1 - down) + lower * down


@numba.njit(cache=True, parallel=PRANGE, error_model="numpy")
def _add(first, end, batch, environment, opacity, colour):
    height, width = environment.shape[:2]
    for row in numba.prange(first, end):
        rays, texels, behind = pointers(batch), pointer(environment), np.empty(3)
        for column in range(opacity.shape[1]):
            transmittance = np.float32(1) - opacity[row, column]
            if transmittance < np.float32(PACKED_EARLY_STOP):  # the rest of such a ray was not looked at
                continue
            _, _, _, x, y, z, _ = ray_at(row, column, rays)
            _lookup(x, y, z, texels, height, width, behind)
            for c in range(3):
                colour[row, column, c] += transmittance * np.float32(behind[c])


def add_environment(environment: np.ndarray, batch: RayBatch, opacity: np.ndarray, colour: np.ndarray) -> None:
    """Adds to colours (H, W, 3), premultiplied by opacities (H, W), what of a map (H, 2 H, 3) is seen behind the rays of a batch, along their directions."""
    environment = np.ascontiguousarray(environment, np.float32)
    rows = max(1, RAYS_PER_CALL // max(1, opacity.shape[1]))
    for first in range(0, len(opacity), rows):
        _add(first, min(len(opacity), first + rows), batch, environment, opacity, colour)


def over_environment(environment: np.ndarray, directions: np.ndarray, opacity: np.ndarray, colour: np.ndarray) -> np.ndarray:
    """Colours (R, 3) of rays, premultiplied by opacities (R,), over what of a map is seen along their unit directions (R, 3), world frame."""
    shape = (len(directions), 1, 3)
    along = np.ascontiguousarray(directions, np.float64).reshape(shape)
    batch = given_rays(along, along)
    out = np.array(colour, np.float32).reshape(shape)
    add_environment(environment, batch, np.ascontiguousarray(opacity, np.float32).reshape(shape[:2]), out)
    return out.reshape(-1, 3)
