"""Rays through a tree forward and backward on the CPU (numba, all cores), for the optimisation of its values.

A ray is marched as in FORMAT.md, section 6. Its samples with density are kept in a buffer of their thread; once the ray's colour is known the
buffer is walked from its end to its beginning, and each sample leaves a record: its eight voxels, its place between them, and the gradient of the
loss by its density and by the arguments of the sigmoid. In a second pass the voxels are dealt to the threads in slabs, and each slab
sums what concerns it in the order of the records. So there are no races, and the bytes depend neither on timing nor on the number of threads.

The torch reference is `efficientnerf.asset.rendering.render_reference` and its autograd. All of it works in float32, and in float64 for tests.
R rays, N voxels, K harmonics, M records.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from efficientnerf.backends.numba.runtime import numba
from efficientnerf.backends.numba.tree.march import STEP, STOP
from efficientnerf.backends.numba.tree.rendering import stored_voxel

BLOCK = 128  # rays per task
MIN_THICKNESS, MAX_THICKNESS = 1e-7, 150.0  # optical thickness of a voxel: nothing that shows, and beyond opaque


@numba.njit(cache=True, error_model="numpy")
def _corners(i, j, k, brick, brick_index, voxel_index, index):  # type: ignore[no-untyped-def]
    """The stored voxels (i or i + 1, j or j + 1, k or k + 1), z fastest, into `index`; -1 where there is none."""
    li, lj, lk = i % brick, j % brick, k % brick
    if i >= 0 and j >= 0 and k >= 0 and li < brick - 1 and lj < brick - 1 and lk < brick - 1:
        owner = brick_index[i // brick, j // brick, k // brick]  # in one brick, and in the grid: the point itself is
        first = (li * brick + lj) * brick + lk
        for n in range(8):
            index[n] = voxel_index[owner, first + ((n >> 2) * brick + ((n >> 1) & 1)) * brick + (n & 1)] if owner >= 0 else -1
        return
    for n in range(8):
        index[n] = stored_voxel(i + (n >> 2), j + ((n >> 1) & 1), k + (n & 1), brick, brick_index, voxel_index)


@numba.njit(cache=True, inline="always", error_model="numpy")
def _share(n, fx, fy, fz):  # type: ignore[no-untyped-def]
    """Trilinear weight of corner n."""
    return (fx if n & 4 else 1 - fx) * (fy if n & 2 else 1 - fy) * (fz if n & 1 else 1 - fz)


@numba.njit(cache=True, error_model="numpy")
def _march(origin, direction, brick, brick_index, voxel_index, density, leap, length, nearest, stop, index, frac, alpha, light):  # type: ignore[no-untyped-def]
    """Samples of one ray that have density, into the buffers: corners, place between them, opacity, light that arrives. Their number and the light left.

    length   of a step, world units
    nearest  the voxel that holds a sample is the only corner, of share 1
    """
    nx, ny, nz = brick_index.shape[0] * brick, brick_index.shape[1] * brick, brick_index.shape[2] * brick
    ox, oy, oz = origin[0], origin[1], origin[2]
    dx, dy, dz = direction[0], direction[1], direction[2]
    ix = 1 / dx if dx != 0 else 1e30
    iy = 1 / dy if dy != 0 else 1e30
    iz = 1 / dz if dz != 0 else 1e30
    t0 = max(min(-ox * ix, (nx - ox) * ix), min(-oy * iy, (ny - oy) * iy), min(-oz * iz, (nz - oz) * iz), 0.0)
    t1 = min(max(-ox * ix, (nx - ox) * ix), max(-oy * iy, (ny - oy) * iy), max(-oz * iz, (nz - oz) * iz))
    left = 1.0
    if not t1 > t0 or (dx == 0 and (ox < 0 or ox > nx)) or (dy == 0 and (oy < 0 or oy > ny)) or (dz == 0 and (oz < 0 or oz > nz)):
        return 0, left
    count = k = 0
    last = int(np.floor((t1 - t0) / STEP)) + 1
    while k < last and count < len(alpha):
        t = t0 + (k + 0.5) * STEP
        if t >= t1:
            break
        u, v, w = ox + t * dx, oy + t * dy, oz + t * dz
        if not (0 <= u < nx and 0 <= v < ny and 0 <= w < nz):  # by rounding, at a face
            k += 1
            continue
        a, b, c = int(u) // brick, int(v) // brick, int(w) // brick
        far = int(leap[a, b, c])
        if far > 0:
            fx = ((a + far) * brick - ox) * ix if dx > 0 else ((a - far + 1) * brick - ox) * ix
            fy = ((b + far) * brick - oy) * iy if dy > 0 else ((b - far + 1) * brick - oy) * iy
            fz = ((c + far) * brick - oz) * iz if dz > 0 else ((c - far + 1) * brick - oz) * iz
            if dx == 0:
                fx = 1e30
            if dy == 0:
                fy = 1e30
            if dz == 0:
                fz = 1e30
            k = max(k + 1, int(np.ceil((min(fx, fy, fz) - t0) / STEP - 0.5)))
            continue
        x, y, z = np.floor(u - 0.5), np.floor(v - 0.5), np.floor(w - 0.5)
        fx, fy, fz = u - 0.5 - x, v - 0.5 - y, w - 0.5 - z
        row = index[count]
        if nearest:
            fx = fy = fz = 0.0
            row[:] = -1
            row[0] = stored_voxel(int(u), int(v), int(w), brick, brick_index, voxel_index)
        else:
            _corners(int(x), int(y), int(z), brick, brick_index, voxel_index, row)
        sigma = 0.0
        for n in range(8):
            if row[n] >= 0:
                sigma += _share(n, fx, fy, fz) * density[row[n]]
        if sigma > 0:
            frac[count, 0], frac[count, 1], frac[count, 2] = fx, fy, fz
            alpha[count], light[count] = 1 - np.exp(-sigma * length), left
            left *= 1 - alpha[count]
            count += 1
            if left < stop:
                break
        k += 1
    return count, left


@numba.njit(cache=True, error_model="numpy")
def _shade(index, frac, sh, basis, mixed, rgb):  # type: ignore[no-untyped-def]
    """Colour of one sample into `rgb`: sigmoid of the harmonics' sum, coefficients mixed over the corners that are stored."""
    mixed[:] = 0
    total = 0.0
    for n in range(8):
        if index[n] >= 0:
            share = _share(n, frac[0], frac[1], frac[2])
            total += share
            row = sh[index[n]]
            part = mixed.dtype.type(share)
            for j in range(len(mixed)):
                mixed[j] += part * row[j]
    for c in range(3):
        logit = 0.0
        for k in range(len(basis)):
            logit += basis[k] * mixed[3 * k + c]
        rgb[c] = 1 / (1 + np.exp(-logit / total)) if total > 0 else 0.5


Arrays = tuple[np.ndarray, ...]


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


@numba.njit(cache=True, parallel=True, error_model="numpy")
def _look(  # type: ignore[no-untyped-def]
    origins, directions, bases, brick, brick_index, voxel_index, density, sh, leap, length, nearest, stop, most,
    seen_colour, seen_behind, seen_gain, seen_opacity, matte, room, index, frac, gradient, ray_of, counts, loss,
):  # fmt: skip
    """Forward and backward. Block b writes its records from b * room on, and to counts[b] how many there are (more than `room`: they did not fit)."""
    rays, terms = len(origins), sh.shape[1]
    for block in numba.prange((rays + BLOCK - 1) // BLOCK):
        b_index, b_frac = np.empty((most, 8), np.int32), np.empty((most, 3), density.dtype)
        b_alpha, b_light, b_rgb = np.empty(most, np.float64), np.empty(most, np.float64), np.empty((most, 3), np.float64)
        mixed, by_colour, behind_it = np.empty(terms, sh.dtype), np.empty(3), np.empty(3)
        written = 0
        for ray in range(block * BLOCK, min(rays, block * BLOCK + BLOCK)):
            count, left = _march(
                origins[ray], directions[ray], brick, brick_index, voxel_index, density, leap, length, nearest, stop, b_index, b_frac, b_alpha, b_light,
            )  # fmt: skip
            fits = written + count <= room
            at = block * room + written
            written += count
            behind_it[:] = 0
            for n in range(count):
                _shade(b_index[n], b_frac[n], sh, bases[ray], mixed, b_rgb[n])
                for c in range(3):
                    behind_it[c] += b_light[n] * b_alpha[n] * b_rgb[n, c]
            # The loss, and its gradient by the ray's colour and opacity.
            missing = 1 - left - seen_opacity[ray]
            by_opacity, total = 2 * matte * missing, matte * missing * missing
            for c in range(3):
                error = seen_gain[ray] * (behind_it[c] + left * seen_behind[ray, c]) - seen_colour[ray, c]
                by_colour[c] = 2 * error * seen_gain[ray]
                by_opacity -= by_colour[c] * seen_behind[ray, c]
                total += error * error
                behind_it[c] = 0
            loss[ray] = total
            if not fits:
                continue
            for n in range(count - 1, -1, -1):
                weight, after = b_light[n] * b_alpha[n], b_light[n] * (1 - b_alpha[n])
                by_depth = by_opacity * left  # optical depth of this sample
                to = at + n
                for c in range(3):
                    shade = b_rgb[n, c]
                    by_depth += by_colour[c] * (after * shade - behind_it[c])
                    behind_it[c] += weight * shade
                    gradient[to, 1 + c] = by_colour[c] * weight * shade * (1 - shade)
                gradient[to, 0] = by_depth * length
                index[to], frac[to], ray_of[to] = b_index[n], b_frac[n], ray
        counts[block] = written


@numba.njit(cache=True, error_model="numpy")
def _gather(slab_low, slab_high, room, index, frac, gradient, ray_of, counts, bases, by_density, by_sh, stamp, number, touched):  # type: ignore[no-untyped-def]
    """Sum the records over the voxels slab_low <= v < slab_high; returns how many of them any record names, listed in `touched`."""
    terms, found = by_sh.shape[1], 0
    spread = np.empty(terms, by_sh.dtype)
    for block in range(len(counts)):
        for at in range(block * room, block * room + counts[block]):
            row = index[at]
            least, greatest, known = slab_high, -1, 0.0
            for n in range(8):
                if row[n] >= 0:
                    least, greatest = min(least, row[n]), max(greatest, row[n])
                    known += _share(n, frac[at, 0], frac[at, 1], frac[at, 2])
            if least >= slab_high or greatest < slab_low:
                continue
            for k in range(terms // 3):
                for c in range(3):
                    spread[3 * k + c] = bases[ray_of[at], k] * gradient[at, 1 + c] / max(known, 1e-30)
            for n in range(8):
                v = row[n]
                if v < slab_low or v >= slab_high:
                    continue
                if stamp[v] != number:
                    stamp[v] = number
                    touched[found] = v
                    found += 1
                share = by_density.dtype.type(_share(n, frac[at, 0], frac[at, 1], frac[at, 2]))
                by_density[v] += share * gradient[at, 0]
                target = by_sh[v]
                for j in range(terms):
                    target[j] += share * spread[j]
    return found


@numba.njit(cache=True, parallel=True, error_model="numpy")
def _sum(slabs, room, index, frac, gradient, ray_of, counts, bases, by_density, by_sh):  # type: ignore[no-untyped-def]
    voxels = len(by_density)
    for slab in numba.prange(slabs):
        low, high = voxels * slab // slabs, voxels * (slab + 1) // slabs
        stamp, touched = np.zeros(voxels, np.int32), np.empty(high - low, np.int32)
        _gather(low, high, room, index, frac, gradient, ray_of, counts, bases, by_density, by_sh, stamp, 1, touched)


@numba.njit(cache=True, parallel=True, error_model="numpy")
def _greatest(origins, directions, brick, brick_index, voxel_index, density, leap, length, nearest, stop, most, gain, greatest):  # type: ignore[no-untyped-def]
    """Raise greatest[p] to what the rays of part p show of each voxel: nothing is shared, and a maximum doesn't ask in which order it was taken."""
    parts, rays = len(greatest), len(origins)
    for part in numba.prange(parts):
        index, frac, alpha, light = np.empty((most, 8), np.int32), np.empty((most, 3), density.dtype), np.empty(most), np.empty(most)
        into = greatest[part]
        for ray in range(rays * part // parts, rays * (part + 1) // parts):
            count, _ = _march(
                origins[ray], directions[ray], brick, brick_index, voxel_index, density, leap, length, nearest, stop, index, frac, alpha, light,
            )  # fmt: skip
            for m in range(count):
                arrives = gain[ray] * light[m] * alpha[m]
                for n in range(8):
                    v = index[m, n]
                    if v >= 0:
                        into[v] = max(into[v], into.dtype.type(arrives * _share(n, frac[m, 0], frac[m, 1], frac[m, 2])))


@numba.njit(cache=True, parallel=True, error_model="numpy")
def _descend(  # type: ignore[no-untyped-def]
    slabs, room, index, frac, gradient, ray_of, counts, bases, density, sh, by_density, by_sh, square_density, square_sh, visits, stamp,
    number, thickness, rate_density, rates_sh, decay, epsilon,
):  # fmt: skip
    """Sum the records and take a step with the voxels that they name; the sums are zero again afterwards."""
    voxels, terms = len(density), sh.shape[1]
    for slab in numba.prange(slabs):
        low, high = voxels * slab // slabs, voxels * (slab + 1) // slabs
        touched = np.empty(high - low, np.int32)
        found = _gather(low, high, room, index, frac, gradient, ray_of, counts, bases, by_density, by_sh, stamp, number, touched)
        for n in range(found):
            v = touched[n]
            visits[v] = min(visits[v] + 1, 60000)
            right = 1 / (1 - decay ** float(visits[v]))
            # Of the logarithm of the optical thickness; where there is none a little is taken, so that matter may come.
            depth = max(density[v] * thickness, MIN_THICKNESS)
            slope = by_density[v] / thickness * depth
            by_density[v] = 0
            square_density[v] = decay * square_density[v] + (1 - decay) * slope * slope
            change = rate_density * slope / (np.sqrt(square_density[v] * right) + epsilon)
            density[v] = min(max(depth * np.exp(-change), MIN_THICKNESS), MAX_THICKNESS) / thickness
            grown, values, mean = by_sh[v], sh[v], 0.0
            for j in range(terms):
                mean += grown[j] * grown[j]
            square_sh[v] = decay * square_sh[v] + (1 - decay) * mean / terms
            scale = by_sh.dtype.type(1 / (np.sqrt(square_sh[v] * right) + epsilon))
            for j in range(terms):
                values[j] -= scale * rates_sh[j] * grown[j]
                grown[j] = 0


class SampleRecords:
    """Room for what samples leave behind, grown where a bundle of rays needs more of it; used again and again."""

    def __init__(self, dtype: type = np.float32) -> None:
        self.dtype = dtype
        self.room, self.blocks = 24 * BLOCK, 0
        self._make(0)

    def _make(self, blocks: int) -> None:
        size = blocks * self.room
        self.blocks = blocks
        self.index: np.ndarray = np.empty((size, 8), np.int32)
        self.frac: np.ndarray = np.empty((size, 3), self.dtype)
        self.gradient: np.ndarray = np.empty((size, 4), self.dtype)
        self.ray_of: np.ndarray = np.empty(size, np.int32)

    def hold(self, blocks: int, room: int = 0) -> None:
        if blocks > self.blocks or room > self.room:
            self.room = max(room, self.room)
            self._make(max(blocks, self.blocks))

    @property
    def arrays(self) -> tuple[np.ndarray, ...]:
        return self.index, self.frac, self.gradient, self.ray_of


class TreeGrid(NamedTuple):
    """Where the voxels of a tree lie; see `NerfTree`. `length` of half a voxel, world units; `nearest` if the tree is not interpolated."""

    brick: int
    brick_index: np.ndarray
    voxel_index: np.ndarray
    leap: np.ndarray
    length: float
    nearest: bool = False

    @property
    def most(self) -> int:
        """Samples on a ray at most."""
        sides = np.array(self.brick_index.shape) * self.brick
        return int(np.ceil(np.linalg.norm(sides) / STEP)) + 2


def slabs() -> int:
    return 2 * numba.get_num_threads()


def contribution_parts() -> int:
    """Into how many shares the rays of `max_contributions` are dealt; each has a copy of what is found."""
    return min(16, numba.get_num_threads())


def forward_backward(
    grid: TreeGrid, origins: np.ndarray, directions: np.ndarray, bases: np.ndarray, density: np.ndarray, sh: np.ndarray, targets: RayTargets,
    records: SampleRecords, *, stop: float = STOP,
) -> tuple[np.ndarray, np.ndarray]:  # fmt: skip
    """Loss (R,) of rays in voxel coordinates; `records` then holds their samples, and the returned counts how many there are in each block.

    origins, directions  (R, 3) float64
    bases                (R, K)
    density, sh          (N,), (N, 3 K)
    """
    loss = np.zeros(len(origins))
    counts = np.zeros((len(origins) + BLOCK - 1) // BLOCK, np.int64)
    records.hold(len(counts))
    while True:
        _look(
            origins, directions, bases, grid.brick, grid.brick_index, grid.voxel_index, density, sh, grid.leap, grid.length, grid.nearest, stop, grid.most,
            targets.colour, targets.background, targets.transmittance, targets.opacity, targets.opacity_weight, records.room, *records.arrays, counts, loss,
        )  # fmt: skip
        if not len(counts) or counts.max() <= records.room:
            return loss, counts
        records.hold(len(counts), int(1.25 * counts.max()))


def sum_gradients(records: SampleRecords, counts: np.ndarray, bases: np.ndarray, by_density: np.ndarray, by_sh: np.ndarray) -> None:
    """Add the gradients of the summed loss of `forward_backward`'s rays by density (N,) and by sh (N, 3 K)."""
    _sum(slabs(), records.room, *records.arrays, counts, bases, by_density, by_sh)


def max_contributions(
    grid: TreeGrid, origins: np.ndarray, directions: np.ndarray, density: np.ndarray, gain: np.ndarray, into: np.ndarray, *, stop: float = STOP
) -> None:
    """Raise `into` to the greatest contributions of voxels to the pixels of rays in voxel coordinates, through what interpolation leaves of them.

    origins, directions  (R, 3) float64
    density              (N,)
    gain                 (R,) light that reaches the box
    into                 (P, N) float32: of each share of the rays; P at least one, and more than threads are of no use
    """
    _greatest(
        origins, directions, grid.brick, grid.brick_index, grid.voxel_index, density, grid.leap, grid.length, grid.nearest, stop, grid.most, gain, into,
    )  # fmt: skip


def rmsprop_step(
    records: SampleRecords, counts: np.ndarray, bases: np.ndarray, values: Arrays, sums: Arrays, squares: Arrays, visits: np.ndarray, stamp: np.ndarray, *,
    number: int, thickness: float, density_rate: float, sh_rates: np.ndarray, decay: float, epsilon: float,
) -> None:  # fmt: skip
    """A step of RMSprop for the voxels that the last `forward_backward` met (the others are left alone), corrected for how often a voxel was met.

        s <- decay s + (1 - decay) g^2        p <- p - rate g / (sqrt(s / (1 - decay^visits)) + epsilon)

    values     density (N,) and sh (N, 3 K), changed in place
    sums       zeros of these shapes, and zeros again afterwards
    squares    (N,) and (N,): s of the density's parameter, and of a voxel's sh its mean over the coefficients: they are of a kind
    visits     (N,) int32; stamp (N,) int32, none of it equal to `number`
    thickness  of a voxel, world units: density times it is what is fitted, through its logarithm

    Tieleman and Hinton 2012; Plenoxels (Fridovich-Keil et al. 2022) are fitted with it.
    """
    _descend(
        slabs(), records.room, *records.arrays, counts, bases, *values, *sums, *squares, visits, stamp,
        number, thickness, density_rate, sh_rates, decay, epsilon,
    )  # fmt: skip
