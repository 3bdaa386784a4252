"""RMSprop on a tree's values, restricted to the voxels that rays met (numba, all cores).

Tieleman and Hinton 2012; Plenoxels (Fridovich-Keil et al. 2022) are optimised with it. N voxels, K harmonics, L cascades.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from efficientnerf.backends.numba.runtime import numba
from efficientnerf.backends.numba.tree.gradients import SampleRecords, recorded, slabs, sum_records

MIN_THICKNESS, MAX_THICKNESS = 1e-7, 150.0  # optical thickness of a voxel: invisible, and opaque
MAX_VISITS = 60000


class Hyperparameters(NamedTuple):
    """Of a step.

    sides         (L,) float64: sides of the voxels of each cascade, units of the frame
    cascades      (N,) uint8: the cascade of each voxel
    density_rate  learning rate of the logarithm of the optical thickness
    sh_rates      (3 K,) learning rates of the coefficients
    decay         of the running mean of the squared gradient
    """

    sides: np.ndarray
    cascades: np.ndarray
    density_rate: float
    sh_rates: np.ndarray
    decay: float
    epsilon: float


@numba.njit(cache=True, parallel=True, error_model="numpy")
def _rmsprop_step(  # type: ignore[no-untyped-def]
    slabs, records, density, sh, grad_density, grad_sh, square_density, square_sh, visits, stamp, number, hyperparameters
):
    count, terms = len(density), sh.shape[1]
    density_rate, decay, epsilon = hyperparameters.density_rate, hyperparameters.decay, hyperparameters.epsilon
    for slab in numba.prange(slabs):
        low, high = count * slab // slabs, count * (slab + 1) // slabs
        sh_rates, sides, cascades = hyperparameters.sh_rates, hyperparameters.sides, hyperparameters.cascades
        voxels = np.empty(high - low, np.int32)
        found = sum_records(low, high, records, grad_density, grad_sh, stamp, number, voxels)
        for n in range(found):
            v = voxels[n]
            visits[v] = min(visits[v] + 1, MAX_VISITS)
            correction, voxel = 1 / (1 - decay ** float(visits[v])), sides[cascades[v]]
            # With respect to the logarithm of the optical thickness; at least MIN_THICKNESS, so that density may appear.
            thickness = max(density[v] * voxel, MIN_THICKNESS)
            slope = grad_density[v] / voxel * thickness
            grad_density[v] = 0
            square_density[v] = decay * square_density[v] + (1 - decay) * slope * slope
            change = density_rate * slope / (np.sqrt(square_density[v] * correction) + epsilon)
            density[v] = min(max(thickness * np.exp(-change), MIN_THICKNESS), MAX_THICKNESS) / voxel
            grad, values, mean = grad_sh[v], sh[v], 0.0
            for j in range(terms):
                mean += grad[j] * grad[j]
            square_sh[v] = decay * square_sh[v] + (1 - decay) * mean / terms
            scale = grad_sh.dtype.type(1 / (np.sqrt(square_sh[v] * correction) + epsilon))
            for j in range(terms):
                values[j] -= scale * sh_rates[j] * grad[j]
                grad[j] = 0


def rmsprop_step(
    records: SampleRecords, counts: np.ndarray, bases: np.ndarray, values: tuple[np.ndarray, np.ndarray], sums: tuple[np.ndarray, np.ndarray],
    squares: tuple[np.ndarray, np.ndarray], visits: np.ndarray, stamp: np.ndarray, number: int, hyperparameters: Hyperparameters,
) -> None:  # fmt: skip
    """A step for the voxels that the last `forward_backward` met, with bias correction by how often a voxel was met; the others stay.

        s <- decay s + (1 - decay) g^2        p <- p - rate g / (sqrt(s / (1 - decay^visits)) + epsilon)

    values   density (N,) and sh (N, 3 K), updated in place
    sums     zeros of these shapes, zeros again afterwards
    squares  (N,) s of the logarithm of the optical thickness, and (N,) s of the coefficients, their mean over a voxel
    visits   (N,) int32
    stamp    (N,) int32, nowhere `number` before
    """
    _rmsprop_step(slabs(), recorded(records, counts, bases), *values, *sums, *squares, visits, stamp, number, hyperparameters)
