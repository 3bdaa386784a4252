"""Samples of a packet of rays (numba): where they lie between voxels, each brick that they meet held once in memory that is the packet's own.

The rays of a packet should be neighbours, as those of a patch of pixels are: they meet the same voxels, which then are looked up, shaded and given gradients
once. A packet of any rays is right, and slower. Samples lie as FORMAT.md says, section 6; in nested trees as `efficientnerf.asset.rendering.ray_parts` says.

Functions that write through pointers are not inlined by numba, which may take what they write for dead; LLVM inlines them.

A *slot* is a voxel of a brick that the packet has met: slot `block * cube + place`, where block 0 stands for all bricks that are not stored. An *entry* is a
coarse cell in which samples have the lowest of their eight voxels, with the blocks of the eight cells from there on.
Coordinates of rays are in voxels of cascade 0. N stored voxels, B bricks, L cascades, C coarse cells of all cascades, S samples, K harmonics.
"""

from typing import Any, NamedTuple

import numpy as np

from efficientnerf.backends.numba.runtime import numba
from efficientnerf.backends.numba.tree.march import cascade_distances, march_with
from efficientnerf.backends.numba.tree_training.scalars import absorbed, cast_like
from efficientnerf.backends.numba.vector.memory import prefetch

FIRST_BLOCKS, FIRST_SAMPLES = 128, 1024  # that a packet has room for before it grows
WORDS = 16  # of 4 bytes in a cache line
SLACK = 1e-3  # voxels by which a clear way ends early, so that no rounding makes it end late


class PacketArrays(NamedTuple):
    """Memory of a packet, arrays or pointers to them. `most` blocks and entries, `samples` samples; T slots, most times cube; H = 4 most."""

    most: int
    samples: int
    state: Any  # (3,) int64 numbers of blocks, of entries and of samples in use
    cell_table: Any  # (H,) int32 open addressing: entries by their cell, -1 free
    cell_key: Any  # (most,) int64 cell of an entry, row
    blocks: Any  # (most, 8) int32 first slots of the eight blocks of an entry
    sources: Any  # (most, 8) int64 where the densities of these begin
    brick_table: Any  # (H,) int32: blocks by their brick, -1 free
    owner: Any  # (most,) int32 brick of a block
    met: Any  # (T,) uint8 whether a sample lies at a slot
    colour: Any  # (T, 4) arguments of the sigmoids, and 1; zeros where no voxel is stored
    gradient: Any  # (T, 4) by these and by density
    stored: Any  # (T, 2) int32 slots at which samples lie and a voxel is stored, and these voxels
    slots: Any  # (S, 8) int32 of a sample
    weights: Any  # (S, 8) of interpolation
    light: Any  # (S, 3) float64 alpha, transmittance at which light arrives, length of the step in units of the frame
    shade: Any  # (S, 4) colour, and one over the weights of the voxels that are stored


BLOCKS, ENTRIES, SAMPLES = 0, 1, 2  # in `PacketArrays.state`


@numba.njit(cache=True, error_model="numpy")
def packet_arrays(most, samples, cube, density):
    """Memory with room for so many blocks and samples, nothing in use; numbers of the type of `density`."""
    slots, kind = most * cube, density.dtype
    arrays = PacketArrays(
        most, samples, np.zeros(3, np.int64), np.full(4 * most, -1, np.int32), np.empty(most, np.int64), np.zeros((most, 8), np.int32),
        np.zeros((most, 8), np.int64), np.full(4 * most, -1, np.int32), np.full(most, -1, np.int32), np.zeros(slots, np.uint8), np.zeros((slots, 4), kind),
        np.zeros((slots, 4), kind), np.zeros((slots, 2), np.int32), np.zeros((samples, 8), np.int32), np.zeros((samples, 8), kind),
        np.zeros((samples, 3), np.float64), np.zeros((samples, 4), kind),
    )  # fmt: skip
    arrays.state[BLOCKS] = 1
    return arrays


@numba.njit(cache=True, inline="always", error_model="numpy")
def _hash(key, size):
    """Where to look first in a table of `size`, a power of two."""
    mixed = np.uint64(key) * np.uint64(0x9E3779B97F4A7C15)
    return np.int64(mixed >> np.uint64(40)) & (size - 1)


@numba.njit(cache=True, error_model="numpy")
def clear(packet, tree):
    """Take everything out of a packet's memory."""
    for n in range(4 * packet.most):
        packet.cell_table[n] = np.int32(-1)
        packet.brick_table[n] = np.int32(-1)
    for n in range(packet.state[BLOCKS] * tree.cube):
        packet.met[n] = np.uint8(0)
    packet.state[BLOCKS], packet.state[ENTRIES], packet.state[SAMPLES] = 1, 0, 0


@numba.njit(cache=True, error_model="numpy")
def _block(owner, tree, packet):
    """The block of a brick; -1 where there is no room."""
    size = 4 * packet.most
    at = _hash(owner, size)
    while packet.brick_table[at] >= 0:
        block = np.int64(packet.brick_table[at])
        if packet.owner[block] == owner:
            return block
        at = (at + 1) & (size - 1)
    block = packet.state[BLOCKS]
    if block == packet.most:
        return np.int64(-1)
    packet.state[BLOCKS] = block + 1
    packet.brick_table[at], packet.owner[block] = np.int32(block), np.int32(owner)
    for n in range(0, tree.cube, WORDS):  # samples that come next are in it, and their voxels are asked for when the packet is shaded
        prefetch(tree.density, owner * tree.cube + n)
        prefetch(tree.voxel_index, owner * tree.cube + n)
    return block


@numba.njit(cache=True, inline="always", error_model="numpy")
def _key(a, b, c, cascade):
    """A number that stands for a coarse cell, from -1 on along each axis."""
    return ((np.int64(cascade) * 2**20 + a + 1) * 2**21 + b + 1) * 2**21 + c + 1


@numba.njit(cache=True, error_model="numpy")
def _entry(key, a, b, c, cascade, tree, packet):
    """The entry of a coarse cell, from -1 on along each axis, by its `_key`; made where it is new; -1 where there is no room."""
    nx, ny, nz = tree.shape[3 * cascade], tree.shape[3 * cascade + 1], tree.shape[3 * cascade + 2]
    size = 4 * packet.most
    at = _hash(key, size)
    while packet.cell_table[at] >= 0:
        entry = np.int64(packet.cell_table[at])
        if packet.cell_key[entry] == key:
            return entry
        at = (at + 1) & (size - 1)
    entry = packet.state[ENTRIES]
    if entry == packet.most:
        return np.int64(-1)
    for n in range(8):
        i, j, k = a + (n >> 2), b + ((n >> 1) & 1), c + (n & 1)
        packet.blocks[8 * entry + n], packet.sources[8 * entry + n] = np.int32(0), tree.absent
        if 0 <= i < nx and 0 <= j < ny and 0 <= k < nz:
            owner = np.int64(tree.brick_index[tree.first[cascade] + (i * ny + j) * nz + k])
            if owner >= 0:
                block = _block(owner, tree, packet)
                if block < 0:
                    return np.int64(-1)
                packet.blocks[8 * entry + n], packet.sources[8 * entry + n] = np.int32(block * tree.cube), owner * tree.cube
    packet.state[ENTRIES] = entry + 1
    packet.cell_table[at], packet.cell_key[entry] = np.int32(entry), key
    return entry


@numba.njit(cache=True, inline="always", error_model="numpy")
def _along(x, brick, stride):
    """Offsets of voxels x and x + 1 of a brick along an axis, and whether the second one lies in the next brick."""
    beyond = x + 1 == brick
    return x * stride, 0 if beyond else (x + 1) * stride, beyond


@numba.njit(cache=True, forceinline=True, error_model="numpy")
def _place(n, entry, brick, offset, weight, at, tree, packet):
    """Slot and weight of corner n of the sample that begins at `at`, in one of the eight bricks of an entry; returns its share of the density."""
    packet.slots[at + n] = np.int32(packet.blocks[8 * entry + brick] + offset)
    packet.weights[at + n] = weight
    return weight * tree.density[packet.sources[8 * entry + brick] + offset]


@numba.njit(cache=True, forceinline=True, error_model="numpy")
def _interpolated(entry, x, y, z, fx, fy, fz, at, tree, packet):
    """Density between the voxel (x, y, z) of an entry's cell and the seven beyond it; slots and weights from `at` on."""
    brick = tree.brick
    x0, x1, bx = _along(x, brick, brick * brick)
    y0, y1, by = _along(y, brick, brick)
    z0, z1, bz = _along(z, brick, 1)
    i, j, k = 4 if bx else 0, 2 if by else 0, 1 if bz else 0
    one = cast_like(1.0, fx)
    gx, gy, gz = one - fx, one - fy, one - fz
    a, b, c, d = gx * gy, gx * fy, fx * gy, fx * fy
    sigma = _place(0, entry, 0, x0 + y0 + z0, a * gz, at, tree, packet)
    sigma += _place(1, entry, k, x0 + y0 + z1, a * fz, at, tree, packet)
    sigma += _place(2, entry, j, x0 + y1 + z0, b * gz, at, tree, packet)
    sigma += _place(3, entry, j + k, x0 + y1 + z1, b * fz, at, tree, packet)
    sigma += _place(4, entry, i, x1 + y0 + z0, c * gz, at, tree, packet)
    sigma += _place(5, entry, i + k, x1 + y0 + z1, c * fz, at, tree, packet)
    sigma += _place(6, entry, i + j, x1 + y1 + z0, d * gz, at, tree, packet)
    sigma += _place(7, entry, i + j + k, x1 + y1 + z1, d * fz, at, tree, packet)
    return sigma


@numba.njit(cache=True, forceinline=True, error_model="numpy")
def _add(point, cell, cascade, tree, packet, state):
    """Adds a sample that has density to a packet.

    state  transmittance, or -1 where there is no room; number of samples; entry that the last one lay in, and its key
    """
    (u, v, w), (a, b, c), (transmittance, count, entry, key), brick = point, cell, state, tree.brick
    x, y, z, fx, fy, fz = int(u), int(v), int(w), 0.0, 0.0, 0.0
    if not tree.nearest:
        x, y, z = int(u + 0.5) - 1, int(v + 0.5) - 1, int(w + 0.5) - 1
        fx, fy, fz = u - 0.5 - x, v - 0.5 - y, w - 0.5 - z
        a, b, c = int((x + brick + 0.5) * tree.inverse) - 1, int((y + brick + 0.5) * tree.inverse) - 1, int((z + brick + 0.5) * tree.inverse) - 1
    here = _key(a, b, c, cascade)
    if here != key:
        entry, key = _entry(here, a, b, c, cascade, tree, packet), here
    if entry < 0 or count == packet.samples:
        return -1.0, count, entry, key
    at = 8 * count
    if tree.nearest:
        sigma = _place(0, entry, 0, ((x - a * brick) * brick + y - b * brick) * brick + z - c * brick, tree.one, at, tree, packet)
        for n in range(1, 8):
            packet.slots[at + n], packet.weights[at + n] = np.int32(0), 0
    else:
        gx, gy, gz = cast_like(fx, tree.one), cast_like(fy, tree.one), cast_like(fz, tree.one)
        sigma = _interpolated(entry, x - a * brick, y - b * brick, z - c * brick, gx, gy, gz, at, tree, packet)
    if sigma > 0:
        length = tree.step_length * tree.scale[cascade]
        alpha = np.float64(absorbed(cast_like(sigma * length, tree.one)))
        packet.light[3 * count], packet.light[3 * count + 1], packet.light[3 * count + 2] = alpha, transmittance, length
        for n in range(8):
            packet.met[packet.slots[at + n]] = np.uint8(1)
        count += 1
        transmittance *= 1 - alpha
    return transmittance, count, entry, key


@numba.njit(cache=True, forceinline=True, error_model="numpy")
def _add_sample(point, cell, t, cascade, tree, scene, state):
    """`_add` for `march_with`; scene: a tuple of the packet."""
    # numba takes for dead what is written to a structure that comes out of a tuple: here it is an argument.
    return _add(point, cell, cascade, tree, scene[0], state)


_march = march_with(_add_sample)


@numba.njit(cache=True, error_model="numpy")
def clear_distance(begin, end, origins, directions, tree):
    """Distance before which none of these rays meets an occupied cell: steps of the ray in their middle, less what they stray from it; of one cascade."""
    if tree.cascades > 1 or end - begin < 2:
        return 0.0
    share = 1.0 / (end - begin)
    ox = oy = oz = dx = dy = dz = 0.0
    for ray in range(begin, end):
        ox, oy, oz = ox + share * origins[ray, 0], oy + share * origins[ray, 1], oz + share * origins[ray, 2]
        dx, dy, dz = dx + share * directions[ray, 0], dy + share * directions[ray, 1], dz + share * directions[ray, 2]
    nx, ny, nz, brick = tree.shape[0], tree.shape[1], tree.shape[2], tree.brick
    apart, spread, t, most = 0.0, 0.0, np.inf, 0.0
    for ray in range(begin, end):
        apart = max(apart, abs(origins[ray, 0] - ox), abs(origins[ray, 1] - oy), abs(origins[ray, 2] - oz))
        spread = max(spread, abs(directions[ray, 0] - dx), abs(directions[ray, 1] - dy), abs(directions[ray, 2] - dz))
        t0, t1 = cascade_distances(origins[ray], directions[ray], tree, 0)
        if t1 > t0:
            t, most = min(t, t0), max(most, t1)
    speed = max(abs(dx), abs(dy), abs(dz)) + spread
    while t < most:
        a = min(max(int((ox + t * dx) * tree.inverse), 0), nx - 1)
        b = min(max(int((oy + t * dy) * tree.inverse), 0), ny - 1)
        c = min(max(int((oz + t * dz) * tree.inverse), 0), nz - 1)
        # All that is nearer than so many cells to this one is empty, along each axis.
        ahead = ((int(tree.leap[(a * ny + b) * nz + c]) - 1) * brick - apart - t * spread) / speed - SLACK
        if ahead < tree.step:
            return t
        t += ahead
    return most if most > 0 else np.inf


@numba.njit(cache=True, error_model="numpy")
def walk_ray(origin, direction, clear, tree, stop, packet):
    """Adds the samples of a ray that have density to a packet; returns the transmittance behind all of them, or -1 where there is no room.

    clear  distance before which the ray meets nothing
    """
    start = 1.0, packet.state[SAMPLES], np.int64(-1), np.int64(-1)
    transmittance, count, _last, _cell = _march(origin, direction, clear, tree, stop, (packet,), start)
    packet.state[SAMPLES] = count
    return transmittance
