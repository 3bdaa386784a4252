"""Optimiser steps on a tree's values, restricted to the voxels that rays met (numba, all cores).

RMSprop with bias corrections by how often a voxel was met. The second moment of a voxel's harmonics is the mean of its coefficients'.
Plenoxels (Fridovich-Keil et al. 2022) are optimised with RMSprop. N voxels, K harmonics, L cascades, B bricks.

A step minimises the rays' losses. Then it takes  density_rate total_variation sum_n (log tau - log tau_n)  from log tau, with tau the optical thickness of a
voxel that rays met, n over the voxels beyond its faces that are stored and tau_n before the step: the gradient of half the squared differences, apart from
the moments as the weight decay of AdamW (Loshchilov and Hutter 2019) is.
"""

import functools
from typing import Any, NamedTuple

import numpy as np

from efficientnerf.backends.layout import MAX_THICKNESS, MAX_VISITS, MIN_THICKNESS, MOST_VARIATION, Hyperparameters, Moments
from efficientnerf.backends.numba.runtime import PRANGE, numba
from efficientnerf.backends.numba.tree.cells import Cells, dense_densities, voxel_places
from efficientnerf.backends.numba.tree_training.gradients import BIN_BITS, Records
from efficientnerf.backends.numba.tree_training.neighbours import NO_NEIGHBOURS, Neighbours, differences
from efficientnerf.backends.numba.vector.maths import broadcast, fma, lowest_bit, sum_lanes
from efficientnerf.backends.numba.vector.memory import fetch_add, load, load_cycle, load_first, pointer, pointers, prefetch, store, store_first

LANES = 16  # rows of coefficients, the three channels of one after those of the other, are read in groups of so many; the last may hold fewer
AHEAD = 8  # voxels whose values are fetched before their turn


def padded(width: int) -> int:
    """Numbers of the groups that hold so many."""
    return -(-width // LANES) * LANES


def rows_of(basis: np.ndarray) -> np.ndarray:
    """(P, padded(3 K)) float32 of harmonics (P, K): each three times, as a row of coefficients has it."""
    count, terms = basis.shape
    rows = np.zeros((count, padded(3 * terms)), np.float32)
    rows[:, : 3 * terms].reshape(count, terms, 3)[:] = basis[:, :, None]
    return rows


@functools.lru_cache(maxsize=8)
def corrections(decay: float) -> np.ndarray:
    """1 / (1 - decay^n) float32 for n from 0 on, as far as it differs from one and visits are counted; the first is one."""
    powers = decay ** np.arange(MAX_VISITS + 1, dtype=np.float64)
    powers[0] = 0
    table = (1 / (1 - powers)).astype(np.float32)
    return table[: int((table != 1).nonzero()[0].max(initial=0)) + 2]


class Values(NamedTuple):
    """What is fitted."""

    density: np.ndarray  # (N,)
    sh: np.ndarray  # (N, 3 K)
    places: np.ndarray  # (N,) int64 of `voxel_places`
    dense: np.ndarray  # the same densities, of `dense_densities`
    cascades: np.ndarray  # (N,) uint8: the cascade of each voxel
    sides: np.ndarray  # (L,) float64: sides of the voxels of each cascade, units of the frame


def values_of(cells: Cells, density: np.ndarray, sh: np.ndarray) -> Values:
    """The values of a tree, which steps change in place."""
    places, owners = voxel_places(cells, len(density)), np.zeros(len(cells.voxel_index), np.uint8)
    for number, (shape, first) in enumerate(zip(cells.shape.tolist(), cells.first.tolist(), strict=True)):
        index = cells.brick_index[first : first + int(np.prod(shape))]
        owners[index[index >= 0]] = number
    cascades = owners[places // cells.brick**3] if len(cells.first) > 1 else np.zeros(len(density), np.uint8)
    return Values(density, sh, places, dense_densities(cells, places, density), cascades, cells.scale * (cells.step_length / cells.step))


class Step(NamedTuple):
    """What a step of one voxel reads and writes: pointers, and tuples of these."""

    records: Records
    values: Values
    moments: Moments
    neighbours: Neighbours
    bases: Any  # (P, padded) of `rows_of`
    following: Any  # of `_link`
    row: Any  # (padded,) the gradient by a voxel's coefficients
    width: int  # 3 K
    padded: int
    rates: Any  # (padded,)
    of_square: Any  # `corrections` of the moments, and the last one of these
    of_square_end: int


@numba.njit(cache=True, error_model="numpy")
def _link(low, chunks, slab, records, head, following, some):
    """Lists of the records of each voxel of a bin, in their order: head[v - low], and following[n], where n counts the records of the bin; a bit of `some` for
    each voxel that has any."""
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
            some[v >> 6] |= np.int64(1) << (v & 63)
    return 0


@numba.njit(cache=True, error_model="numpy")
def _link_all(low, slab, records, head, following, some):
    """`_link` with as much room as it needs: `following`, or a larger one."""
    more = _link(low, records.begin.shape[0], slab, records, head, following, some)
    if more > 0:
        following = np.empty((2 * more, 2), np.int64)
        _link(low, records.begin.shape[0], slab, records, head, following, some)
    return following


@numba.njit(cache=True, error_model="numpy")
def _take_voxels(some, met):
    """Numbers of the bits that are set, into `met`; returns how many, and sets none."""
    count = 0
    for word in range(len(some)):
        bits = some[word]
        some[word] = 0
        while bits != 0:
            met[count] = 64 * word + lowest_bit(bits)
            bits &= bits - 1
            count += 1
    return count


@numba.njit(cache=True, error_model="numpy")
def _gather(number, p):
    """Sum of the records of a list into `p.row`; returns that by density, and the sum of the squares of the row."""
    by_density, squares, n = 0.0, broadcast(np.float32(0), LANES), number
    while n >= 0:
        by_density += p.records.gradient[4 * p.following[2 * n] + 3]
        n = p.following[2 * n + 1]
    for j in range(0, p.padded, LANES):
        total, n = broadcast(np.float32(0), LANES), number
        while n >= 0:
            at = p.following[2 * n]
            basis = load(p.bases, p.padded * np.int64(p.records.numbers[2 * at + 1]) + j, LANES)
            total = fma(basis, load_cycle(p.records.gradient, 4 * at, j, LANES), total)
            n = p.following[2 * n + 1]
        squares = fma(total, total, squares)
        store(p.row, j, total)
    return by_density, np.float64(sum_lanes(squares))


@numba.njit(cache=True, error_model="numpy")
def _update(v, by_density, squares, p, h):
    """A step of one voxel, whose gradient by coefficients is `p.row` and the sum of its squares `squares`."""
    decay, epsilon = h.decay, h.epsilon
    visits = np.int64(min(p.moments.visits[v] + 1, MAX_VISITS))
    p.moments.visits[v] = np.int32(visits)
    correction, voxel = np.float64(p.of_square[min(visits, p.of_square_end)]), p.values.sides[p.values.cascades[v]]
    # With respect to the logarithm of the optical thickness; at least MIN_THICKNESS, so that density may appear.
    thickness = max(p.values.density[v] * voxel, MIN_THICKNESS)
    slope = by_density / voxel * thickness
    square = decay * p.moments.square_density[v] + (1 - decay) * slope * slope
    p.moments.square_density[v] = np.float32(square)
    change = h.density_rate * slope / (np.sqrt(square * correction) + epsilon)
    if h.total_variation > 0:
        share = min(h.density_rate * h.total_variation, MOST_VARIATION)
        change += share * differences(p.values.places[v], thickness, voxel, MIN_THICKNESS, p.neighbours.brick, p.values.dense, p.neighbours.around)
    thickness = min(max(thickness * np.exp(-change), MIN_THICKNESS), MAX_THICKNESS)
    p.values.density[v] = np.float32(thickness / voxel)
    square = decay * p.moments.square_sh[v] + (1 - decay) * squares / p.width
    p.moments.square_sh[v] = np.float32(square)
    scale = np.float32(-1.0 / (np.sqrt(square * correction) + epsilon))
    for j in range(0, p.width, LANES):
        by, at, count = load(p.row, j, LANES), v * p.width + j, p.width - j
        store_first(p.values.sh, at, fma(load(p.rates, j, LANES) * scale, by, load_first(p.values.sh, at, count, LANES)), count)


@numba.njit(cache=True, forceinline=True, error_model="numpy")
def _fetch(v, number, p):
    """Bring what a step of a voxel with such a first record reads into the caches."""
    prefetch(p.values.density, v)
    prefetch(p.moments.square_density, v)
    prefetch(p.moments.square_sh, v)
    prefetch(p.moments.visits, v)
    prefetch(p.values.dense, p.values.places[v])
    prefetch(p.records.gradient, 4 * p.following[2 * number])
    for j in range(0, p.width, LANES):
        prefetch(p.values.sh, v * p.width + j)
    prefetch(p.values.sh, v * p.width + p.width - 1)


@numba.njit(cache=True, error_model="numpy")
def _step_bins(task, records, rows, values, moments, neighbours, h, rates, of_square):
    """Takes bins until none is left."""
    bins, size = records.begin.shape[1] - 1, 1 << BIN_BITS
    met, some, row = np.empty(size, np.int64), np.zeros(size >> 6, np.int64), np.empty(rows.shape[1], np.float32)
    head, following = np.full(size, -1, np.int64), np.empty((1024, 2), np.int64)
    slab = fetch_add(pointer(task), 0, 1)
    while slab < bins:
        low = slab << BIN_BITS
        following = _link_all(low, slab, records, head, following, some)
        p = Step(
            pointers(records), pointers(values), pointers(moments), pointers(neighbours), pointer(rows), pointer(following), pointer(row), values.sh.shape[1],
            rows.shape[1], pointer(rates), pointer(of_square), len(of_square) - 1,
        )  # fmt: skip
        count = _take_voxels(some, met)
        for n in range(count):
            v = low + met[n]
            if n + 2 * AHEAD < count:
                prefetch(p.values.places, low + met[n + 2 * AHEAD])
            if n + AHEAD < count:
                _fetch(low + met[n + AHEAD], head[met[n + AHEAD]], p)
            by_density, squares = _gather(head[met[n]], p)
            head[met[n]] = -1
            _update(v, by_density, squares, p, h)
        slab = fetch_add(pointer(task), 0, 1)


@numba.njit(cache=True, parallel=PRANGE, error_model="numpy")
def _step(workers, task, records, rows, values, moments, neighbours, h, rates, of_square):
    for _ in numba.prange(workers):
        _step_bins(task, records, rows, values, moments, neighbours, h, rates, of_square)


@numba.njit(cache=True, error_model="numpy")
def _copy_bins(task, records, values):
    """Copies the densities of voxels that have records to where rays find them, until no bin is left."""
    bins, chunks = records.begin.shape[1] - 1, records.begin.shape[0]
    slab = fetch_add(pointer(task), 0, 1)
    while slab < bins:
        for chunk in range(chunks):
            for at in range(records.begin[chunk, slab], records.begin[chunk, slab + 1]):
                v = records.numbers[at, 0]
                values.dense[values.places[v]] = values.density[v]
        slab = fetch_add(pointer(task), 0, 1)


@numba.njit(cache=True, parallel=PRANGE, error_model="numpy")
def _copy(workers, task, records, values):
    for _ in numba.prange(workers):
        _copy_bins(task, records, values)


def step(records: Records, values: Values, moments: Moments, hyperparameters: Hyperparameters, neighbours: Neighbours = NO_NEIGHBOURS) -> None:
    """A step for the voxels that the records name; the others stay. float32.

    s <- decay s + (1 - decay) g^2
    p <- p - rate g / (sqrt(s / (1 - decay^visits)) + epsilon)
    """
    h, count = Hyperparameters._make(map(float, hyperparameters)), records.begin.shape[1] - 1
    rows, workers = rows_of(records.basis), min(numba.get_num_threads(), count)
    rates = np.full(rows.shape[1], h.sh_rate * h.view_share, np.float32)
    rates[:3] = h.sh_rate
    _step(workers, np.zeros(1, np.int64), records, rows, values, moments, neighbours, h, rates, corrections(h.decay))
    # Not before all bins are done: total variation is that of the densities before the step.
    _copy(workers, np.zeros(1, np.int64), records, values)
