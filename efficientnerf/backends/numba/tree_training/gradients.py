"""Gradients of a tree's values on the CPU (numba, all cores), for its training.

Rays come in packets (`efficientnerf.backends.numba.tree_training.packets`). A packet finds the samples of its rays, sums the harmonics of each voxel that
these lie between, once, composites the rays, and goes back over the samples to sum gradients: four numbers for each voxel, by its density and by the arguments
of the three sigmoids. Each voxel then leaves one record. The records of a chunk of packets are sorted into bins of neighbouring voxels. A second pass
(`efficientnerf.backends.numba.tree_training.steps`) takes the bins one after the other and sums the records of a voxel in their order: there are no races, and
results depend neither on timing nor on the number of threads.

The harmonics of a packet are the mean of its rays': neighbouring pixels look the same way but for their distance over the focal length. A packet of one ray is
exact, and so is one of parallel rays.

The torch reference is `tests.efficientnerf.tree_reference` and its autograd. Works in float32, and in float64 for tests.
R rays, P packets, N voxels, K harmonics, M records, U chunks.
"""

from typing import NamedTuple

import numpy as np

from efficientnerf.backends.layout import EARLY_STOP, SSIM_C1, SSIM_C2, SSIM_WINDOW, RayTargets
from efficientnerf.backends.numba.runtime import PRANGE, numba
from efficientnerf.backends.numba.tree.cells import Cells
from efficientnerf.backends.numba.tree_training.packets import (
    BLOCKS,
    FIRST_BLOCKS,
    FIRST_SAMPLES,
    SAMPLES,
    WORDS,
    clear,
    clear_distance,
    packet_arrays,
    walk_ray,
)
from efficientnerf.backends.numba.tree_training.scalars import cast_like, sigmoid
from efficientnerf.backends.numba.vector.corners import mix_corners, spread_corners
from efficientnerf.backends.numba.vector.maths import fma
from efficientnerf.backends.numba.vector.memory import fetch_add, pointer, pointers, prefetch
from efficientnerf.backends.structure import structure_change

CHUNK = 32  # packets
BIN_BITS = 15  # voxels of a bin, power of two
_structure_change = numba.njit(inline="always", error_model="numpy")(structure_change)


class Records(NamedTuple):
    """What voxels got from packets."""

    numbers: np.ndarray  # (M, 2) int32 of the voxel, and of the packet
    gradient: np.ndarray  # (M, 4) of the loss by the arguments of the sigmoids, and by density
    begin: np.ndarray  # (U, bins + 1) int64: where the records of a chunk and bin begin, those of chunk u from u * capacity on
    basis: np.ndarray  # (P, K) harmonics of the packets


class Packets(NamedTuple):
    """Rays in packets: `first` (P + 1,) int64 first ray of each, and the end; origins and directions (R, 3) float64; bases (P, K) their harmonics."""

    first: np.ndarray
    origins: np.ndarray
    directions: np.ndarray
    bases: np.ndarray


class Limits(NamedTuple):
    """stop: transmittance below which a ray ends; capacity: most records of a chunk."""

    stop: float
    capacity: int


class RayScratch(NamedTuple):
    """Of the rays of a packet: the end of each one's samples, the light left behind them, and half of the loss's derivatives by its colour."""

    ends: np.ndarray
    left: np.ndarray
    slopes: np.ndarray


class RecordBuffer:
    """Memory of records, enlarged where a batch needs more; reused. Numbers of type `dtype`."""

    def __init__(self, dtype: type = np.float32) -> None:
        self.dtype, self.capacity, self.chunks = dtype, 128 * CHUNK, 0
        self._allocate()

    def _allocate(self) -> None:
        size = self.chunks * self.capacity
        self.numbers: np.ndarray = np.empty((size, 2), np.int32)
        self.gradient: np.ndarray = np.empty((size, 4), self.dtype)

    def reserve(self, chunks: int, capacity: int = 0) -> None:
        """Make room for so many chunks of so many records."""
        if chunks > self.chunks or capacity > self.capacity:
            self.chunks, self.capacity = max(chunks, self.chunks), max(capacity, self.capacity)
            self._allocate()


def packets_of(rays: int, side: int = 1) -> np.ndarray:
    """First ray of each packet, and the end, of rays that come in packets of `side`."""
    return np.append(np.arange(0, rays, side), rays).astype(np.int64)


@numba.njit(cache=True, error_model="numpy")
def _fill_colours(basis, terms, sh, tree, packet):
    """Sums of the harmonics of the slots at which samples lie, along the packet's mean direction; returns how many of these hold a voxel, see `stored`."""
    found, width = 0, 3 * terms
    for block in range(1, packet.state[BLOCKS]):
        first, source = block * tree.cube, packet.owner[block] * tree.cube
        for n in range(tree.cube):
            if packet.met[first + n] == 0:
                continue
            at, voxel = 4 * (first + n), np.int64(tree.voxel_index[source + n])
            for c in range(4):
                packet.gradient[at + c] = 0
                packet.colour[at + c] = 0
            if voxel >= 0:
                packet.stored[2 * found], packet.stored[2 * found + 1] = np.int32(first + n), np.int32(voxel)
                found += 1
                for j in range(0, width, WORDS):
                    prefetch(sh, width * voxel + j)
                prefetch(sh, width * voxel + width - 1)
    for n in range(found):
        at, row = 4 * np.int64(packet.stored[2 * n]), width * np.int64(packet.stored[2 * n + 1])
        red, green, blue = basis[0] * sh[row], basis[0] * sh[row + 1], basis[0] * sh[row + 2]
        for k in range(1, terms):
            red = fma(basis[k], sh[row + 3 * k], red)
            green = fma(basis[k], sh[row + 3 * k + 1], green)
            blue = fma(basis[k], sh[row + 3 * k + 2], blue)
        packet.colour[at], packet.colour[at + 1], packet.colour[at + 2], packet.colour[at + 3] = red, green, blue, 1
    return found


@numba.njit(cache=True, forceinline=True, error_model="numpy")
def _shade(n, packet):
    """Colour of a sample, sigmoids of what is interpolated between the corners that are stored; kept in `packet.shade`."""
    red, green, blue, total = mix_corners(packet.colour, packet.slots, packet.weights, 8 * n, 1, 4)
    inverse = cast_like(1, total) / total if total > 0 else 0 * total
    r, g, b = sigmoid(red * inverse), sigmoid(green * inverse), sigmoid(blue * inverse)
    packet.shade[4 * n], packet.shade[4 * n + 1], packet.shade[4 * n + 2], packet.shade[4 * n + 3] = r, g, b, inverse
    return r, g, b


@numba.njit(cache=True, error_model="numpy")
def _composite_ray(ray, begin, end, left, targets, packet):
    """Differences of a ray's colour from its target; its samples are `begin` to `end`, behind which so much light is left."""
    light = packet.light
    red, green, blue = 0.0, 0.0, 0.0
    for n in range(begin, end):
        r, g, b = _shade(n, packet)
        weight = light[3 * n] * light[3 * n + 1]
        red += weight * r
        green += weight * g
        blue += weight * b
    arriving, behind = np.float64(targets.transmittance[ray]), targets.background[ray]
    return (
        arriving * (red + left * np.float64(behind[0])) - targets.colour[ray, 0],
        arriving * (green + left * np.float64(behind[1])) - targets.colour[ray, 1],
        arriving * (blue + left * np.float64(behind[2])) - targets.colour[ray, 2],
    )


@numba.njit(cache=True, error_model="numpy")
def _add_structure(begin, end, targets, slopes):
    """Half of the derivatives of structural dissimilarity by the colours of a patch, added to their differences `slopes` (16, 3)."""
    share = 1 / (end - begin)
    for channel in range(3):
        of_x, of_y = 0.0, 0.0
        for ray in range(begin, end):
            y = np.float64(targets.colour[ray, channel])
            of_x += share * (y + slopes[ray - begin, channel])
            of_y += share * y
        squares, products = 0.0, 0.0
        for ray in range(begin, end):
            y = np.float64(targets.colour[ray, channel])
            x, y = y + slopes[ray - begin, channel] - of_x, y - of_y
            squares += share * (x * x + y * y)
            products += share * x * y
        for ray in range(begin, end):
            y = np.float64(targets.colour[ray, channel])
            x, y = y + slopes[ray - begin, channel] - of_x, y - of_y
            slopes[ray - begin, channel] -= targets.structure * _structure_change(x, y, of_x, of_y, squares, products, SSIM_C1, SSIM_C2, 2.0)


@numba.njit(cache=True, error_model="numpy")
def _pull_ray(ray, begin, end, left, slopes, targets, packet):
    """Adds a ray's gradients to the slots; slopes: half of the loss's derivatives by its colour."""
    light, shade, kind = packet.light, packet.shade, targets.colour.dtype.type
    arriving = np.float64(targets.transmittance[ray])
    behind = np.float64(targets.background[ray, 0]), np.float64(targets.background[ray, 1]), np.float64(targets.background[ray, 2])
    missing = 1 - left - np.float64(targets.opacity[ray])
    by_red, by_green, by_blue = 2 * arriving * slopes[0], 2 * arriving * slopes[1], 2 * arriving * slopes[2]
    by_left = (2 * targets.opacity_weight * missing - by_red * behind[0] - by_green * behind[1] - by_blue * behind[2]) * left
    # Back to front; red, green and blue become the colour behind the sample.
    red, green, blue = 0.0, 0.0, 0.0
    for n in range(end - 1, begin - 1, -1):
        weight, after = light[3 * n] * light[3 * n + 1], light[3 * n + 1] * (1 - light[3 * n])
        r, g, b, inverse = np.float64(shade[4 * n]), np.float64(shade[4 * n + 1]), np.float64(shade[4 * n + 2]), np.float64(shade[4 * n + 3])
        by_depth = by_left + by_red * (after * r - red) + by_green * (after * g - green) + by_blue * (after * b - blue)
        red += weight * r
        green += weight * g
        blue += weight * b
        scale = weight * inverse
        by_logits = kind(by_red * scale * r * (1 - r)), kind(by_green * scale * g * (1 - g)), kind(by_blue * scale * b * (1 - b))
        spread_corners(packet.gradient, packet.slots, packet.weights, 8 * n, 1, (*by_logits, kind(by_depth * light[3 * n + 2])))


@numba.njit(cache=True, error_model="numpy")
def _ray_scratch(count):
    return RayScratch(np.empty(count, np.int64), np.empty(count, np.float64), np.empty((count, 3), np.float64))


@numba.njit(cache=True, error_model="numpy")
def _trace_packet(number, packets, targets, limits, sh, tree, arrays, rays, loss):
    """Losses of the rays of a packet and the gradients of its slots; returns how many voxels it met, or -1 where there is no room.

    sh    pointer
    rays  RayScratch of as many as the packet has, or more
    """
    begin, end, origins, directions, basis = packets.first[number], packets.first[number + 1], packets.origins, packets.directions, packets.bases[number]
    packet, terms, (ends, left, slopes) = pointers(arrays), len(basis), rays
    clear(packet, tree)
    way = clear_distance(begin, end, origins, directions, tree)
    for ray in range(begin, end):
        left[ray - begin] = walk_ray(origins[ray], directions[ray], way, tree, limits.stop, packet)
        if left[ray - begin] < 0:
            return -1
        ends[ray - begin] = packet.state[SAMPLES]
    found = _fill_colours(basis, terms, sh, tree, packet)
    at = 0
    for ray in range(begin, end):
        n = ray - begin
        slopes[n, 0], slopes[n, 1], slopes[n, 2] = _composite_ray(ray, at, ends[n], left[n], targets, packet)
        missing = 1 - left[n] - np.float64(targets.opacity[ray])
        loss[ray] = slopes[n, 0] * slopes[n, 0] + slopes[n, 1] * slopes[n, 1] + slopes[n, 2] * slopes[n, 2] + targets.opacity_weight * missing * missing
        at = ends[n]
    if targets.structure > 0 and end - begin == SSIM_WINDOW * SSIM_WINDOW:
        _add_structure(begin, end, targets, slopes)
    at = 0
    for ray in range(begin, end):
        n = ray - begin
        _pull_ray(ray, at, ends[n], left[n], slopes[n], targets, packet)
        at = ends[n]
    return found


@numba.njit(cache=True, error_model="numpy")
def _leave_records(number, found, written, arrays, numbers, gradient, bins):
    """Records of the voxels that a packet found, from `written` on, counted by bins; returns their end."""
    packet = pointers(arrays)
    for n in range(found):
        slot, v = 4 * np.int64(packet.stored[2 * n]), packet.stored[2 * n + 1]
        numbers[written, 0], numbers[written, 1] = v, np.int32(number)
        for c in range(4):
            gradient[written, c] = packet.gradient[slot + c]
        bins[(v >> BIN_BITS) + 1] += 1
        written += 1
    return written


@numba.njit(cache=True, error_model="numpy")
def _sort_records(written, numbers, gradient, begin, base, out_numbers, out_gradient, place):
    """Puts records in order of their bins, and within these as they were, from `base` on; begin: counts by bins after a zero, afterwards where bins begin."""
    begin[0] = base
    for n in range(1, len(begin)):
        place[n - 1] = begin[n - 1]
        begin[n] += begin[n - 1]
    for n in range(written):
        v = numbers[n, 0]
        to = place[v >> BIN_BITS]
        place[v >> BIN_BITS] = to + 1
        out_numbers[to, 0], out_numbers[to, 1] = v, numbers[n, 1]
        for c in range(4):
            out_gradient[to, c] = gradient[n, c]


@numba.njit(cache=True, error_model="numpy")
def _enlarged(values, count, room):
    """The first `count` rows in an array of `room`."""
    out = np.empty((room, values.shape[1]), values.dtype)
    for n in range(count):  # an assignment of slices would take three seconds to compile: its error's text
        for k in range(values.shape[1]):
            out[n, k] = values[n, k]
    return out


@numba.njit(cache=True, error_model="numpy")
def _work(task, cells, sh, packets, targets, limits, numbers, gradient, begin, counts, loss):
    """Takes chunks until none is left. Chunk u writes its records from u * capacity on, and to counts[u] how many there are; more than `capacity`: none."""
    first, density, tree, flat = packets.first, cells.density, pointers(cells), pointer(sh)
    arrays = packet_arrays(np.int64(FIRST_BLOCKS), np.int64(FIRST_SAMPLES), tree.cube, density)
    rays = _ray_scratch(SSIM_WINDOW * SSIM_WINDOW)
    own_numbers, own_gradient = np.empty((128 * CHUNK, 2), np.int32), np.empty((128 * CHUNK, 4), density.dtype)
    place = np.empty(begin.shape[1] - 1, np.int64)
    chunk = fetch_add(pointer(task), 0, 1)
    while chunk * CHUNK < len(first) - 1:
        written, bins = np.int64(0), begin[chunk]
        bins[:] = 0
        for number in range(chunk * CHUNK, min(len(first) - 1, (chunk + 1) * CHUNK)):
            if first[number + 1] - first[number] > len(rays.ends):
                rays = _ray_scratch(first[number + 1] - first[number])
            found = _trace_packet(number, packets, targets, limits, flat, tree, arrays, rays, loss)
            while found < 0:
                arrays = packet_arrays(2 * arrays.most, 2 * arrays.samples, tree.cube, density)
                found = _trace_packet(number, packets, targets, limits, flat, tree, arrays, rays, loss)
            if written + found > len(own_numbers):
                room = 2 * (written + found)
                own_numbers, own_gradient = _enlarged(own_numbers, written, room), _enlarged(own_gradient, written, room)
            written = _leave_records(number, found, written, arrays, own_numbers, own_gradient, bins)
        counts[chunk] = written
        if written <= limits.capacity:
            _sort_records(written, own_numbers, own_gradient, bins, chunk * limits.capacity, numbers, gradient, place)
        chunk = fetch_add(pointer(task), 0, 1)


@numba.njit(cache=True, parallel=PRANGE, error_model="numpy")
def _forward_backward(workers, task, cells, sh, packets, targets, limits, numbers, gradient, begin, counts, loss):
    for _ in numba.prange(workers):
        _work(task, cells, sh, packets, targets, limits, numbers, gradient, begin, counts, loss)


def forward_backward(
    cells: Cells, first: np.ndarray, origins: np.ndarray, directions: np.ndarray, bases: np.ndarray, density: np.ndarray, sh: np.ndarray, targets: RayTargets,
    buffer: RecordBuffer, *, stop: float = EARLY_STOP,
) -> tuple[np.ndarray, Records]:  # fmt: skip
    """Loss (R,) of rays, voxel coordinates of cascade 0, and the gradients of its sum and of their structure (`RayTargets`), as records in `buffer`.

    first                (P + 1,) int64: first ray of each packet, and the end
    origins, directions  (R, 3) float64
    bases                (P, K) harmonics of the packets' directions
    density              of `dense_densities`
    sh                   (N, 3 K)
    stop                 transmittance below which a ray ends
    """
    chunks, bins = -(-(len(first) - 1) // CHUNK), (len(sh) >> BIN_BITS) + 1
    loss, counts, begin = np.zeros(len(origins)), np.zeros(chunks, np.int64), np.zeros((chunks, bins + 1), np.int64)
    buffer.reserve(chunks)
    workers, packets, cells = min(numba.get_num_threads(), max(chunks, 1)), Packets(first, origins, directions, bases), cells.having(density)
    while True:
        limits = Limits(float(stop), buffer.capacity)
        _forward_backward(workers, np.zeros(1, np.int64), cells, sh, packets, targets, limits, buffer.numbers, buffer.gradient, begin, counts, loss)
        if not chunks or counts.max() <= buffer.capacity:
            return loss, Records(buffer.numbers, buffer.gradient, begin, bases)
        buffer.reserve(chunks, int(1.25 * counts.max()))
