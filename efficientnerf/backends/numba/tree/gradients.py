"""Gradients of a tree's values on the CPU (numba, all cores), for its refinement.

A ray's samples are kept in a buffer of their thread. Once its colour is known the buffer is traversed back to front, and each sample leaves a record: its
voxels, its place between them, and the gradients of the loss with respect to its density and to the arguments of its sigmoids. In a second pass the voxels are
split into slabs, one a task, and each slab sums what concerns it in the order of the records: there are no races, and results depend neither on timing nor on
the number of threads.

The torch reference is `efficientnerf.asset.rendering.render_reference` and its autograd. Works in float32, and in float64 for tests.
R rays, N voxels, K harmonics, M records.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from efficientnerf.backends.numba.runtime import numba
from efficientnerf.backends.numba.simd import pointer
from efficientnerf.backends.numba.tree.march import EARLY_STOP
from efficientnerf.backends.numba.tree.walk import SampleBuffer, TreeGrid, corner_weight, walk, walk_pointers

BLOCK = 128  # rays per task


class RayTargets(NamedTuple):
    """Supervision of rays. With c and a the premultiplied colour and the opacity that the tree gives a ray, its loss is

        sum over channels of (transmittance (c + (1 - a) background) - colour)^2  +  opacity_weight (a - opacity)^2

    colour          (R, 3) of the photograph, less the colour of what lies in front of the box
    background      (R, 3) colour of what lies behind the box
    transmittance   (R,)   of what lies in front of the box
    opacity         (R,)   of the photograph
    opacity_weight  of the opacity's error

    Arrays, or tensors of a device (`efficientnerf.backends.triton.tree_gradients`).
    """

    colour: Any
    background: Any
    transmittance: Any
    opacity: Any
    opacity_weight: float


class SampleRecords:
    """Records of samples, enlarged where a batch of rays needs more; reused.

    index     (M, 8) int32 voxels, as in `SampleBuffer`; fraction (M, 3)
    gradient  (M, 4) of the loss with respect to density, and to the arguments of the three sigmoids
    ray_of    (M,) int32

    Block b of rays writes to records b * capacity and on.
    """

    def __init__(self, dtype: type = np.float32) -> None:
        self.dtype = dtype
        self.capacity, self.blocks = 24 * BLOCK, 0
        self._allocate(0)

    def _allocate(self, blocks: int) -> None:
        size = blocks * self.capacity
        self.blocks = blocks
        self.index: np.ndarray = np.empty((size, 8), np.int32)
        self.fraction: np.ndarray = np.empty((size, 3), self.dtype)
        self.gradient: np.ndarray = np.empty((size, 4), self.dtype)
        self.ray_of: np.ndarray = np.empty(size, np.int32)

    def reserve(self, blocks: int, capacity: int = 0) -> None:
        """Make room for so many blocks of so many records."""
        if blocks > self.blocks or capacity > self.capacity:
            self.capacity = max(capacity, self.capacity)
            self._allocate(max(blocks, self.blocks))

    @property
    def arrays(self) -> tuple[np.ndarray, ...]:
        return self.index, self.fraction, self.gradient, self.ray_of


class Recorded(NamedTuple):
    """Written records, as the kernels read them: capacity of a block, the arrays, records in each block (B,), and the rays' harmonics (R, K)."""

    capacity: int
    corners: np.ndarray
    fraction: np.ndarray
    gradient: np.ndarray
    ray_of: np.ndarray
    counts: np.ndarray
    bases: np.ndarray


def recorded(records: SampleRecords, counts: np.ndarray, bases: np.ndarray) -> Recorded:
    """The records of `forward_backward`, which returned `counts`."""
    return Recorded(records.capacity, records.index, records.fraction, records.gradient, records.ray_of, counts, bases)


@numba.njit(cache=True, error_model="numpy")
def _shade(buffer, sample, sh, basis, mixed, rgb):  # type: ignore[no-untyped-def]
    """Colour of a sample into `rgb`: sigmoid of the harmonics' sum, coefficients interpolated over the corners that are stored."""
    mixed[:] = 0
    total = 0.0
    for n in range(8):
        voxel = buffer.index[8 * sample + n]
        if voxel >= 0:
            weight = corner_weight(n, buffer.fraction[3 * sample], buffer.fraction[3 * sample + 1], buffer.fraction[3 * sample + 2])
            total += weight
            row = sh[voxel]
            part = mixed.dtype.type(weight)
            for j in range(len(mixed)):
                mixed[j] += part * row[j]
    for c in range(3):
        logit = 0.0
        for k in range(len(basis)):
            logit += basis[k] * mixed[3 * k + c]
        rgb[c] = 1 / (1 + np.exp(-logit / total)) if total > 0 else 0.5


@numba.njit(cache=True, parallel=True, error_model="numpy")
def _forward_backward(  # type: ignore[no-untyped-def]
    grid, origins, directions, bases, density, sh, targets, stop, max_samples, capacity, index, fraction, gradient, ray_of, counts, loss
):
    """Block b writes its records from b * capacity on, and to counts[b] how many there are; more than `capacity`: the last ones were left out."""
    rays, terms, opacity_weight = len(origins), sh.shape[1], targets.opacity_weight
    for block in numba.prange((rays + BLOCK - 1) // BLOCK):
        b_index, b_fraction = np.full((max_samples, 8), -1, np.int32), np.zeros((max_samples, 3), density.dtype)
        alpha, light, distance, length = np.empty(max_samples), np.empty(max_samples), np.empty(max_samples), np.empty(max_samples)
        rgb, mixed, grad_colour, accumulated = np.empty((max_samples, 3), np.float64), np.empty(terms, sh.dtype), np.empty(3), np.empty(3)
        tree = walk_pointers(grid, density)
        buffer = SampleBuffer(max_samples, pointer(b_index), pointer(b_fraction), pointer(alpha), pointer(light), pointer(distance), pointer(length))
        written = 0
        for ray in range(block * BLOCK, min(rays, block * BLOCK + BLOCK)):
            count, left = walk(origins[ray], directions[ray], tree, stop, buffer)
            fits = written + count <= capacity
            at = block * capacity + written
            written += count
            accumulated[:] = 0
            for n in range(count):
                _shade(buffer, n, sh, bases[ray], mixed, rgb[n])
                for c in range(3):
                    accumulated[c] += light[n] * alpha[n] * rgb[n, c]
            # The loss, and its gradients with respect to the ray's colour and opacity.
            missing = 1 - left - targets.opacity[ray]
            grad_opacity, total = 2 * opacity_weight * missing, opacity_weight * missing * missing
            for c in range(3):
                error = targets.transmittance[ray] * (accumulated[c] + left * targets.background[ray, c]) - targets.colour[ray, c]
                grad_colour[c] = 2 * error * targets.transmittance[ray]
                grad_opacity -= grad_colour[c] * targets.background[ray, c]
                total += error * error
                accumulated[c] = 0
            loss[ray] = total
            if not fits:
                continue
            # Back to front; `accumulated` is the colour behind the sample.
            for n in range(count - 1, -1, -1):
                weight, after = light[n] * alpha[n], light[n] * (1 - alpha[n])
                grad_depth = grad_opacity * left  # with respect to the sample's optical depth
                to = at + n
                for c in range(3):
                    shade = rgb[n, c]
                    grad_depth += grad_colour[c] * (after * shade - accumulated[c])
                    accumulated[c] += weight * shade
                    gradient[to, 1 + c] = grad_colour[c] * weight * shade * (1 - shade)
                gradient[to, 0] = grad_depth * length[n]
                index[to], fraction[to], ray_of[to] = b_index[n], b_fraction[n], ray
        counts[block] = written


@numba.njit(cache=True, error_model="numpy")
def sum_records(low, high, records, grad_density, grad_sh, stamp, number, voxels):  # type: ignore[no-untyped-def]
    """Adds the records of voxels low <= v < high to the gradients; returns how many of these voxels any record names, and lists them in `voxels`.

    stamp  (N,) int32, not `number` before, and `number` for the listed voxels afterwards
    """
    terms, found, capacity, counts = grad_sh.shape[1], 0, records.capacity, records.counts
    index, fraction, gradient, ray_of, bases = records.corners, records.fraction, records.gradient, records.ray_of, records.bases
    grad_mixed = np.empty(terms, grad_sh.dtype)
    for block in range(len(counts)):
        for at in range(block * capacity, block * capacity + counts[block]):
            row = index[at]
            least, greatest, total = high, -1, 0.0
            for n in range(8):
                if row[n] >= 0:
                    least, greatest = min(least, row[n]), max(greatest, row[n])
                    total += corner_weight(n, fraction[at, 0], fraction[at, 1], fraction[at, 2])
            if least >= high or greatest < low:
                continue
            for k in range(terms // 3):
                for c in range(3):
                    grad_mixed[3 * k + c] = bases[ray_of[at], k] * gradient[at, 1 + c] / max(total, 1e-30)
            for n in range(8):
                v = row[n]
                if v < low or v >= high:
                    continue
                if stamp[v] != number:
                    stamp[v] = number
                    voxels[found] = v
                    found += 1
                weight = grad_density.dtype.type(corner_weight(n, fraction[at, 0], fraction[at, 1], fraction[at, 2]))
                grad_density[v] += weight * gradient[at, 0]
                target = grad_sh[v]
                for j in range(terms):
                    target[j] += weight * grad_mixed[j]
    return found


@numba.njit(cache=True, parallel=True, error_model="numpy")
def _sum_gradients(slabs, records, grad_density, grad_sh):  # type: ignore[no-untyped-def]
    count = len(grad_density)
    for slab in numba.prange(slabs):
        low, high = count * slab // slabs, count * (slab + 1) // slabs
        stamp, voxels = np.zeros(count, np.int32), np.empty(high - low, np.int32)
        sum_records(low, high, records, grad_density, grad_sh, stamp, 1, voxels)


@numba.njit(cache=True, parallel=True, error_model="numpy")
def _max_contributions(grid, origins, directions, density, stop, max_samples, transmittance, visibility):  # type: ignore[no-untyped-def]
    """Share p of the rays raises visibility[p]: no races, and a maximum does not depend on the order."""
    shares, rays = len(visibility), len(origins)
    for share in numba.prange(shares):
        index, fraction = np.full((max_samples, 8), -1, np.int32), np.zeros((max_samples, 3), density.dtype)
        alpha, light, distance, length = np.empty(max_samples), np.empty(max_samples), np.empty(max_samples), np.empty(max_samples)
        tree = walk_pointers(grid, density)
        buffer = SampleBuffer(max_samples, pointer(index), pointer(fraction), pointer(alpha), pointer(light), pointer(distance), pointer(length))
        into = visibility[share]
        for ray in range(rays * share // shares, rays * (share + 1) // shares):
            count, _ = walk(origins[ray], directions[ray], tree, stop, buffer)
            for m in range(count):
                weight = transmittance[ray] * light[m] * alpha[m]
                for n in range(8):
                    v = index[m, n]
                    if v >= 0:
                        into[v] = max(into[v], into.dtype.type(weight * corner_weight(n, fraction[m, 0], fraction[m, 1], fraction[m, 2])))


def slabs() -> int:
    """Tasks that voxels are split into."""
    return 2 * numba.get_num_threads()


def contribution_shares() -> int:
    """Tasks that the rays of `max_contributions` are split into; each has a copy of the result."""
    return min(16, numba.get_num_threads())


def forward_backward(
    grid: TreeGrid, origins: np.ndarray, directions: np.ndarray, bases: np.ndarray, density: np.ndarray, sh: np.ndarray, targets: RayTargets,
    records: SampleRecords, *, stop: float = EARLY_STOP,
) -> tuple[np.ndarray, np.ndarray]:  # fmt: skip
    """Loss (R,) of rays, voxel coordinates of cascade 0, and the number of records in each block; `records` then holds their samples' gradients.

    origins, directions  (R, 3) float64
    bases                (R, K) harmonics of the rays' directions
    density, sh          (N,), (N, 3 K)
    stop                 transmittance below which a ray ends
    """
    loss = np.zeros(len(origins))
    counts = np.zeros((len(origins) + BLOCK - 1) // BLOCK, np.int64)
    records.reserve(len(counts))
    while True:
        _forward_backward(
            grid, origins, directions, bases, density, sh, targets, stop, grid.max_samples, records.capacity, *records.arrays, counts, loss,
        )  # fmt: skip
        if not len(counts) or counts.max() <= records.capacity:
            return loss, counts
        records.reserve(len(counts), int(1.25 * counts.max()))


def sum_gradients(records: SampleRecords, counts: np.ndarray, bases: np.ndarray, grad_density: np.ndarray, grad_sh: np.ndarray) -> None:
    """Add the gradients of the summed loss of `forward_backward` with respect to density (N,) and sh (N, 3 K)."""
    _sum_gradients(slabs(), recorded(records, counts, bases), grad_density, grad_sh)


def max_contributions(
    grid: TreeGrid, origins: np.ndarray, directions: np.ndarray, density: np.ndarray, transmittance: np.ndarray, visibility: np.ndarray, *,
    stop: float = EARLY_STOP,
) -> None:  # fmt: skip
    """Raise the visibility of voxels to their greatest weight, times that of interpolation, on rays in voxel coordinates.

    origins, directions  (R, 3) float64
    density              (N,)
    transmittance        (R,) of what lies in front of the box
    visibility           (P, N) float32: for each share of the rays; P from 1 to the number of threads
    """
    _max_contributions(grid, origins, directions, density, stop, grid.max_samples, transmittance, visibility)
