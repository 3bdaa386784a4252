"""Optimiser steps on a tree's values, restricted to the voxels that rays met (numba, all cores).

RMSprop, or Adam (Kingma and Ba 2015) where there is a momentum, with bias corrections by how often a voxel was met. The second moment of a voxel's harmonics is
the mean of its coefficients'. Plenoxels (Fridovich-Keil et al. 2022) are optimised with RMSprop. N voxels, K harmonics, L cascades, B bricks.

A step minimises the rays' losses and, of each voxel that they met, with tau its optical thickness,

    sparsity (1 - exp(-tau))  +  entropy H(1 - exp(-tau)),    H(a) = -a log a - (1 - a) log(1 - a).

Then it takes  density_rate total_variation sum_n (log tau - log tau_n)  from log tau, n over the voxels beyond its faces that are stored and tau_n before the
step: the gradient of half the squared differences, apart from the moments as the weight decay of AdamW (Loshchilov and Hutter 2019) is.
"""

from __future__ import annotations

import functools
from typing import NamedTuple

import numpy as np

from efficientnerf.backends.numba.runtime import numba
from efficientnerf.backends.numba.simd import fmuladd, pointer
from efficientnerf.backends.numba.tree_training.gradients import BIN_BITS, Records
from efficientnerf.backends.numba.tree_training.packets import Cells, dense_densities, voxel_places
from efficientnerf.backends.numba.tree_training.tasks import prefetch, take_next

MIN_THICKNESS, MAX_THICKNESS = 1e-7, 150.0  # optical thickness of a voxel: invisible, and opaque
MAX_VISITS = 60000
MOST_VARIATION = 1 / 8  # share of the differences to six neighbours that a step takes away, at most: with more than a sixth they would grow
AHEAD = 8  # voxels whose values are fetched before their turn


class Hyperparameters(NamedTuple):
    """Of a step.

    sides            (L,) float64: sides of the voxels of each cascade, units of the frame
    cascades         (N,) uint8: the cascade of each voxel
    density_rate     learning rate of the logarithm of the optical thickness
    sh_rates         (3 K,) float32 learning rates of the coefficients
    decay            of the running mean of the squared gradient
    epsilon          added to its root
    momentum         of the running mean of the gradient; 0: RMSprop
    total_variation  weights of the module's terms
    sparsity
    entropy
    terms            coefficients that have gradients, of each channel: the first ones; those beyond stay as they are
    """

    sides: np.ndarray
    cascades: np.ndarray
    density_rate: float
    sh_rates: np.ndarray
    decay: float
    epsilon: float
    momentum: float = 0.0
    total_variation: float = 0.0
    sparsity: float = 0.0
    entropy: float = 0.0
    terms: int = 25


@functools.lru_cache(maxsize=8)
def corrections(decay: float) -> np.ndarray:
    """1 / (1 - decay^n) float32 for n from 0 on, as far as it differs from one and visits are counted; the first is one."""
    powers = decay ** np.arange(MAX_VISITS + 1, dtype=np.float64)
    powers[0] = 0
    table = (1 / (1 - powers)).astype(np.float32)
    return table[: int((table != 1).nonzero()[0].max(initial=0)) + 2]


class Moments(NamedTuple):
    """Running means of the gradients by the logarithm of the optical thickness (N,) and by the coefficients (N, 3 K), without rows where there is no momentum;
    of their squares (N,), (N,); and the number of steps that met a voxel (N,) int32."""

    density: np.ndarray
    sh: np.ndarray
    square_density: np.ndarray
    square_sh: np.ndarray
    visits: np.ndarray


class Values(NamedTuple):
    """What is fitted.

    density  (N,)
    sh       (N, 3 K)
    places   (N,) int64 of `voxel_places`
    dense    the same densities, of `dense_densities`
    """

    density: np.ndarray
    sh: np.ndarray
    places: np.ndarray
    dense: np.ndarray


def values_of(cells: Cells, density: np.ndarray, sh: np.ndarray) -> Values:
    """The values of a tree, which steps change in place."""
    places = voxel_places(cells, len(density))
    return Values(density, sh, places, dense_densities(cells, places, density))


class Neighbours(NamedTuple):
    """Bricks beside bricks, for total variation; without rows where there is none.

    density  (N,) before the step
    around   (B, 6) int32 bricks beyond the faces -x, x, -y, y, -z, z of a brick, -1 where none is stored
    """

    density: np.ndarray
    around: np.ndarray
    voxel_index: np.ndarray
    brick: int


def neighbours_of(cells: Cells, voxels: int) -> Neighbours:
    """Of a tree of so many voxels. Those of different cascades are no neighbours."""
    around = np.full((len(cells.voxel_index), 6), -1, np.int32)
    for shape, first in zip(cells.shape.tolist(), cells.first.tolist(), strict=True):
        index = cells.brick_index[first : first + int(np.prod(shape))].reshape(shape)
        padded = np.pad(index, 1, constant_values=-1)
        for face in range(6):
            shift = [slice(1, -1)] * 3
            shift[face // 2] = slice(2, None) if face % 2 else slice(None, -2)
            around[index[index >= 0], face] = padded[tuple(shift)][index >= 0]
    return Neighbours(np.zeros(voxels, np.float32), around, cells.voxel_index, cells.brick)


NO_NEIGHBOURS = Neighbours(np.zeros(0, np.float32), np.zeros((0, 6), np.int32), np.zeros((0, 1), np.int32), 1)


@numba.njit(cache=True, error_model="numpy")
def _neighbour(place, face, neighbours):  # type: ignore[no-untyped-def]
    """The voxel beyond a face of the one at a place, -1 where none is stored."""
    brick = neighbours.brick
    cube = brick * brick * brick
    owner, at = place // cube, place % cube
    stride = brick * brick if face < 2 else brick if face < 4 else 1
    x = at // stride % brick
    if face & 1:
        if x + 1 < brick:
            return neighbours.voxel_index[owner, at + stride]
        other, at = neighbours.around[owner, face], at - (brick - 1) * stride
    else:
        if x > 0:
            return neighbours.voxel_index[owner, at - stride]
        other, at = neighbours.around[owner, face], at + (brick - 1) * stride
    return neighbours.voxel_index[other, at] if other >= 0 else np.int32(-1)


@numba.njit(cache=True, error_model="numpy")
def _link(low, chunks, slab, records, head, following):  # type: ignore[no-untyped-def]
    """Lists of the records of each voxel of a bin, in their order: head[v - low], and following[n], where n counts the records of the bin."""
    number = 0
    for chunk in range(chunks):
        number += records.begin[chunk, slab + 1] - records.begin[chunk, slab]
    if number > len(following):
        return number
    for chunk in range(chunks - 1, -1, -1):
        for at in range(records.begin[chunk, slab + 1] - 1, records.begin[chunk, slab] - 1, -1):
            number -= 1
            v = records.numbers[at, 0] - low
            following[number, 0], following[number, 1] = at, head[v]
            head[v] = number
    return 0


@numba.njit(cache=True, error_model="numpy")
def _gather(number, terms, records, following, gradient):  # type: ignore[no-untyped-def]
    """Sum of the records of a list into `gradient` (3 terms,); returns that by density."""
    by_density = 0.0
    gradient[: 3 * terms] = 0
    while number >= 0:
        at = following[number, 0]
        red, green, blue = records.gradient[at, 0], records.gradient[at, 1], records.gradient[at, 2]
        by_density += records.gradient[at, 3]
        basis = records.basis[records.numbers[at, 1]]
        for k in range(terms):
            gradient[3 * k] = fmuladd(basis[k], red, gradient[3 * k])
            gradient[3 * k + 1] = fmuladd(basis[k], green, gradient[3 * k + 1])
            gradient[3 * k + 2] = fmuladd(basis[k], blue, gradient[3 * k + 2])
        number = following[number, 1]
    return by_density


@numba.njit(cache=True, error_model="numpy")
def _beyond_neighbours(place, thickness, voxel, neighbours):  # type: ignore[no-untyped-def]
    """Gradient of the total variation by the logarithm of a voxel's optical thickness."""
    here, slope = np.log(thickness), 0.0
    for face in range(6):
        other = _neighbour(place, face, neighbours)
        if other >= 0:
            slope += here - np.log(max(neighbours.density[other] * voxel, MIN_THICKNESS))
    return slope


@numba.njit(cache=True, error_model="numpy")
def _regularised(slope, thickness, h):  # type: ignore[no-untyped-def]
    """The gradient by the logarithm of a voxel's optical thickness with those of sparsity and entropy."""
    if h.sparsity > 0:
        slope += h.sparsity * thickness * np.exp(-thickness)
    if h.entropy > 0:
        left = np.exp(-thickness)
        slope += h.entropy * thickness * left * -(np.log(max(1 - left, 1e-30)) + thickness)
    return slope


@numba.njit(cache=True, error_model="numpy")
def _update(v, by_density, gradient, terms, values, moments, neighbours, h, of_square, of_mean):  # type: ignore[no-untyped-def]
    """A step of one voxel; of_square, of_mean: `corrections` of the moments."""
    decay, epsilon, momentum = h.decay, h.epsilon, h.momentum
    visits = min(moments.visits[v] + 1, MAX_VISITS)
    moments.visits[v] = visits
    correction, voxel = np.float64(of_square[min(visits, len(of_square) - 1)]), h.sides[h.cascades[v]]
    # With respect to the logarithm of the optical thickness; at least MIN_THICKNESS, so that density may appear.
    thickness = max(values.density[v] * voxel, MIN_THICKNESS)
    slope = _regularised(by_density / voxel * thickness, thickness, h)
    square = decay * moments.square_density[v] + (1 - decay) * slope * slope
    moments.square_density[v] = square
    ahead = 1.0
    if momentum > 0:
        ahead = np.float64(of_mean[min(visits, len(of_mean) - 1)])
        slope = momentum * moments.density[v] + (1 - momentum) * slope
        moments.density[v] = slope
    change = h.density_rate * ahead * slope / (np.sqrt(square * correction) + epsilon)
    if h.total_variation > 0:
        change += min(h.density_rate * h.total_variation, MOST_VARIATION) * _beyond_neighbours(values.places[v], thickness, voxel, neighbours)
    new_density = min(max(thickness * np.exp(-change), MIN_THICKNESS), MAX_THICKNESS) / voxel
    values.density[v] = values.dense[values.places[v]] = new_density
    row, rates = values.sh[v], h.sh_rates
    red = green = blue = gradient.dtype.type(0)  # three sums, as one would wait for itself
    for k in range(terms):
        red = fmuladd(gradient[3 * k], gradient[3 * k], red)
        green = fmuladd(gradient[3 * k + 1], gradient[3 * k + 1], green)
        blue = fmuladd(gradient[3 * k + 2], gradient[3 * k + 2], blue)
    square = decay * moments.square_sh[v] + (1 - decay) * (red + green + blue) / (3 * terms)
    moments.square_sh[v] = square
    scale = gradient.dtype.type(ahead / (np.sqrt(square * correction) + epsilon))
    if momentum > 0:
        running, old, new = moments.sh[v], gradient.dtype.type(momentum), gradient.dtype.type(1 - momentum)
        for j in range(3 * terms):
            running[j] = old * running[j] + new * gradient[j]
            row[j] = fmuladd(-scale * rates[j], running[j], row[j])
    else:
        for j in range(3 * terms):
            row[j] = fmuladd(-scale * rates[j], gradient[j], row[j])


@numba.njit(cache=True, error_model="numpy")
def _link_all(low, slab, records, head, following):  # type: ignore[no-untyped-def]
    """`_link` with as much room as it needs: `following`, or a larger one."""
    more = _link(low, records.begin.shape[0], slab, records, head, following)
    if more > 0:
        following = np.empty((2 * more, 2), np.int64)
        _link(low, records.begin.shape[0], slab, records, head, following)
    return following


@numba.njit(cache=True, forceinline=True, error_model="numpy")
def _fetch(v, values, moments):  # type: ignore[no-untyped-def]
    """Bring what a step of a voxel reads into the caches."""
    width = values.sh.shape[1]
    prefetch(pointer(values.density), v)
    prefetch(pointer(moments.square_density), v)
    prefetch(pointer(moments.square_sh), v)
    prefetch(pointer(moments.visits), v)
    for j in range(0, width, 16):
        prefetch(pointer(values.sh), v * width + j)
    prefetch(pointer(values.sh), v * width + width - 1)


@numba.njit(cache=True, error_model="numpy")
def _step_bins(task, records, values, moments, neighbours, hyperparameters, of_square, of_mean):  # type: ignore[no-untyped-def]
    """Takes bins until none is left."""
    bins, size = records.begin.shape[1] - 1, 1 << BIN_BITS
    terms, met = min(hyperparameters.terms, values.sh.shape[1] // 3), np.empty(size + 1, np.int64)
    head, following, gradient = np.full(size, -1, np.int64), np.empty((1024, 2), np.int64), np.empty(values.sh.shape[1], values.sh.dtype)
    slab = take_next(pointer(task))
    while slab < bins:
        low = slab << BIN_BITS
        following = _link_all(low, slab, records, head, following)
        count = 0
        for n in range(min(len(values.density) - low, size)):
            met[count] = n
            count += 1 if head[n] >= 0 else 0
        for n in range(count):
            v = low + met[n]
            if n + AHEAD < count:
                _fetch(low + met[n + AHEAD], values, moments)
            by_density = _gather(head[v - low], terms, records, following, gradient)
            head[v - low] = -1
            _update(v, by_density, gradient, terms, values, moments, neighbours, hyperparameters, of_square, of_mean)
        slab = take_next(pointer(task))


@numba.njit(cache=True, parallel=True, error_model="numpy")
def _step(workers, task, records, values, moments, neighbours, hyperparameters, of_square, of_mean):  # type: ignore[no-untyped-def]
    for _ in numba.prange(workers):
        _step_bins(task, records, values, moments, neighbours, hyperparameters, of_square, of_mean)


@numba.njit(cache=True, error_model="numpy")
def _sum_gradients(records, grad_density, grad_sh):  # type: ignore[no-untyped-def]
    bins, terms, size = records.begin.shape[1] - 1, grad_sh.shape[1] // 3, 1 << BIN_BITS
    head, following, gradient = np.full(size, -1, np.int64), np.empty((1024, 2), np.int64), np.empty(grad_sh.shape[1], grad_sh.dtype)
    for slab in range(bins):
        low = slab << BIN_BITS
        following = _link_all(low, slab, records, head, following)
        for v in range(low, min(len(grad_density), low + size)):
            number = head[v - low]
            if number >= 0:
                head[v - low] = -1
                grad_density[v] += _gather(number, terms, records, following, gradient)
                grad_sh[v] += gradient


def step(
    records: Records, values: Values, moments: Moments, hyperparameters: Hyperparameters, neighbours: Neighbours = NO_NEIGHBOURS
) -> None:
    """A step for the voxels that the records name; the others stay.

        s <- decay s + (1 - decay) g^2        m <- momentum m + (1 - momentum) g
        p <- p - rate m / (1 - momentum^visits) / (sqrt(s / (1 - decay^visits)) + epsilon)
    """
    if hyperparameters.total_variation > 0:
        np.copyto(neighbours.density, values.density)
    _step(
        min(numba.get_num_threads(), records.begin.shape[1] - 1), np.zeros(1, np.int64), records, values, moments, neighbours, hyperparameters,
        corrections(hyperparameters.decay), corrections(hyperparameters.momentum),
    )  # fmt: skip


def sum_gradients(records: Records, grad_density: np.ndarray, grad_sh: np.ndarray) -> None:
    """Add the gradients of the summed loss with respect to density (N,) and sh (N, 3 K)."""
    _sum_gradients(records, grad_density, grad_sh)
