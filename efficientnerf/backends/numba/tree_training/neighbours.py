"""The neighbours of voxels (numba), for total variation. B bricks."""

from typing import NamedTuple

import numpy as np

from efficientnerf.backends.numba.runtime import numba
from efficientnerf.backends.numba.tree.cells import Cells


class Neighbours(NamedTuple):
    """The neighbours of bricks; without rows where there is no total variation."""

    around: np.ndarray  # (B, 6) int32 bricks beyond the faces -x, x, -y, y, -z, z of a brick, -1 where none is stored
    brick: int  # voxels along a side


def neighbours_of(cells: Cells) -> Neighbours:
    """Of a tree. Bricks of different cascades are no neighbours."""
    around = np.full((len(cells.voxel_index), 6), -1, np.int32)
    for shape, first in zip(cells.shape.tolist(), cells.first.tolist(), strict=True):
        index = cells.brick_index[first : first + int(np.prod(shape))].reshape(shape)
        padded = np.pad(index, 1, constant_values=-1)
        for face in range(6):
            shift = [slice(1, -1)] * 3
            shift[face // 2] = slice(2, None) if face % 2 else slice(None, -2)
            around[index[index >= 0], face] = padded[tuple(shift)][index >= 0]
    return Neighbours(around, cells.brick)


NO_NEIGHBOURS = Neighbours(np.zeros((0, 6), np.int32), 1)


@numba.njit(cache=True, forceinline=True, error_model="numpy")
def _beyond(face, inside, place, owner, at, stride, cube, brick, dense, around):
    """Density of the voxel beyond a face of the one at a place, `inside` if it is in the same brick; -0 where none is stored."""
    ahead = stride if face & 1 else -stride
    if inside:
        return dense[place + ahead]
    other = np.int64(around[6 * owner + face])
    return dense[other * cube + at - (brick - 1) * ahead] if other >= 0 else np.float32(-0.0)


@numba.njit(cache=True, forceinline=True, error_model="numpy")
def _ratio(density, thickness, voxel, least):
    """Optical thickness over that of a neighbour of some density, as two numbers; 1 where none is stored."""
    if density > 0:
        return thickness, max(density * voxel, least)
    return (1.0, 1.0) if np.signbit(density) else (thickness, least)


@numba.njit(cache=True, error_model="numpy")
def differences(place, thickness, voxel, least, brick, dense, around):
    """Sum of the differences between the logarithm of the optical thickness of the voxel at a place and those of the voxels beyond its faces that are stored;
    these are at least `least`. dense, around: pointers."""
    area = brick * brick
    cube = area * brick
    owner = place // cube
    at = place - owner * cube
    x = at // area
    y = (at - x * area) // brick
    z = at - x * area - y * brick
    over, under = 1.0, 1.0
    for axis in range(3):
        along, stride = (x, area) if axis == 0 else ((y, brick) if axis == 1 else (z, 1))
        a, b = _ratio(_beyond(2 * axis, along > 0, place, owner, at, stride, cube, brick, dense, around), thickness, voxel, least)
        c, d = _ratio(_beyond(2 * axis + 1, along + 1 < brick, place, owner, at, stride, cube, brick, dense, around), thickness, voxel, least)
        over, under = over * a * c, under * b * d
    return np.log(over / under)
