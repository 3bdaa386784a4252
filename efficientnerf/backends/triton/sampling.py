"""Valid and pivotal samples on CUDA (Triton): one lane a ray when marching, one lane a sample after.

How many samples a bundle has is known to the device alone. Without a capacity the host waits once for the number, to make arrays of that length. With
`capacity` it never waits: the arrays have that length, and are filled as `efficientnerf.sampling.samples` says. Training leaves rays that have not all of their
samples out of its loss.
"""

from __future__ import annotations

import torch
import triton
import triton.language as tl
from torch import Tensor

from efficientnerf.backends.triton.hash_grid import INTERPRETED, LANES, blocks
from efficientnerf.geometry.spaces import FARTHEST, Space
from efficientnerf.sampling.samples import Samples

RAYS = 256 if INTERPRETED else 32  # one warp: the end of a program's loop is decided without shared memory
NEAREST_SHELL = tl.constexpr(FARTHEST)


@triton.jit
def _grid(px, py, pz, CONTRACTED: tl.constexpr):  # type: ignore[no-untyped-def]
    """Unit coordinates to grid coordinates; see `efficientnerf.geometry.spaces`."""
    if CONTRACTED:
        m = tl.maximum(tl.maximum(tl.abs(px), tl.abs(py)), tl.maximum(tl.abs(pz), 1.0))
        f = (2 - 1 / m) / m
        gx, gy, gz = (px * f + 2) * 0.25, (py * f + 2) * 0.25, (pz * f + 2) * 0.25
    else:
        gx, gy, gz = (px + 1) * 0.5, (py + 1) * 0.5, (pz + 1) * 0.5
    return gx, gy, gz


@triton.jit
def _ray(origins, directions, r, live, cx, cy, cz, hx, hy, hz):  # type: ignore[no-untyped-def]
    """Rays in unit coordinates: origin and direction."""
    ux = (tl.load(origins + r * 3, live, other=0.0) - cx) / hx
    uy = (tl.load(origins + r * 3 + 1, live, other=0.0) - cy) / hy
    uz = (tl.load(origins + r * 3 + 2, live, other=0.0) - cz) / hz
    vx = tl.load(directions + r * 3, live, other=1.0) / hx
    vy = tl.load(directions + r * 3 + 1, live, other=1.0) / hy
    vz = tl.load(directions + r * 3 + 2, live, other=1.0) / hz
    return ux, uy, uz, vx, vy, vz


@triton.jit
def _slab(u, v):  # type: ignore[no-untyped-def]
    """Where rays cross the faces at -1 and 1 of one axis, nearer first."""
    safe = tl.where(tl.abs(v) < 1e-12, 1e-12, v)
    one, other = (-1 - u) / safe, (1 - u) / safe
    return tl.minimum(one, other), tl.maximum(one, other)


@triton.jit(do_not_specialize=["whole"])
def _march(  # type: ignore[no-untyped-def]
    origins, directions, near, far, offset, cx, cy, cz, hx, hy, hz, voxels, first, counts, tried, start, extent, length, point,
    rays, slots, step, threshold, whole, side, CONTRACTED: tl.constexpr, WRITE: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """Counts the valid samples of each ray, or writes them from `first` on."""
    r = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    live = r < rays
    ux, uy, uz, vx, vy, vz = _ray(origins, directions, r, live, cx, cy, cz, hx, hy, hz)
    shift = tl.load(offset + r, live, other=0.0)
    t = tl.load(near + r, live, other=1.0)
    leave = tl.load(far + r, live, other=0.0)
    if not CONTRACTED:
        ax, bx = _slab(ux, vx)
        ay, by = _slab(uy, vy)
        az, bz = _slab(uz, vz)
        t = tl.maximum(tl.maximum(ax, ay), tl.maximum(az, t))
        leave = tl.minimum(tl.minimum(bx, by), tl.minimum(bz, leave))
    at = tl.zeros((BLOCK,), tl.int64)
    end = tl.zeros((BLOCK,), tl.int64)
    if WRITE:
        at = tl.load(first + r, live, other=0)
        end = tl.load(first + r + 1, live, other=0)
    limit = tl.where(r < whole, float("-inf"), threshold)
    valid = tl.zeros((BLOCK,), tl.int32)
    seen = tl.zeros((BLOCK,), tl.int32)
    alive = live & (t < leave)
    if WRITE:
        alive = alive & (at < end)
    k = 0
    while (k < slots) & (tl.max(alive.to(tl.int32), 0) > 0):
        stretch = tl.full((BLOCK,), 1.0, tl.float32)
        if CONTRACTED:
            reach = tl.maximum(tl.maximum(tl.abs(ux + t * vx), tl.abs(uy + t * vy)), tl.maximum(tl.abs(uz + t * vz), 1.0))
            stretch = reach * reach
            alive = alive & (reach * NEAREST_SHELL <= 1)
        size = tl.minimum(step * stretch, leave - t)
        s = t + shift * size
        gx, gy, gz = _grid(ux + s * vx, uy + s * vy, uz + s * vz, CONTRACTED)
        # Clamped before they become integers: lanes whose ray has ended may be anywhere.
        i = tl.minimum(tl.maximum(gx * side, 0.0), side - 1.0).to(tl.int32)
        j = tl.minimum(tl.maximum(gy * side, 0.0), side - 1.0).to(tl.int32)
        l = tl.minimum(tl.maximum(gz * side, 0.0), side - 1.0).to(tl.int32)
        found = alive & (tl.load(voxels + (i * side + j) * side + l, alive, other=0.0) > limit)
        if WRITE:
            put = found & (at < end)
            tl.store(start + at, t, put)
            tl.store(extent + at, size, put)
            tl.store(length + at, size / stretch, put)
            tl.store(point + at * 3, gx, put)
            tl.store(point + at * 3 + 1, gy, put)
            tl.store(point + at * 3 + 2, gz, put)
            at += found.to(tl.int64)
        else:
            valid += found.to(tl.int32)
            seen += alive.to(tl.int32)
        t = tl.where(alive, t + step * stretch, t)
        alive = alive & (t < leave)
        if WRITE:
            alive = alive & (at < end)
        k += 1
    if not WRITE:
        tl.store(counts + r, valid, live)
        tl.store(tried + r, seen, live)


def _box(space: Space) -> tuple[float, ...]:
    return (*(float(x) for x in space.centre), *(float(x) for x in space.half))


def _offsets(counts: Tensor) -> Tensor:
    first = torch.zeros(len(counts) + 1, dtype=torch.int64, device=counts.device)
    torch.cumsum(counts, 0, out=first[1:])
    return first


def valid_samples(
    space: Space, origins: Tensor, directions: Tensor, near: Tensor, far: Tensor, offset: Tensor, step: float, slots: int, voxels: Tensor, threshold: float,
    capacity: int | None = None, *, whole: int = 0,
) -> Samples:  # fmt: skip
    """See `efficientnerf.sampling.samples.valid_samples`; with `capacity` see the module, and `tried` is then a tensor on the device."""
    origins, directions, near, far, offset, voxels = (t.detach().contiguous() for t in (origins, directions, near, far, offset, voxels))
    rays, side = len(origins), voxels.shape[0]
    device = origins.device
    counts, tried = (torch.zeros(rays, dtype=torch.int32, device=device) for _ in range(2))
    bundle = (origins, directions, near, far, offset, *_box(space), voxels)
    rest = (rays, slots, float(step), float(threshold), whole, side)
    grid, shape = (blocks(rays, RAYS),), {"CONTRACTED": space.contracted, "BLOCK": RAYS, "num_warps": 1}
    nothing = origins.new_empty(0)
    _march[grid](*bundle, counts, counts, tried, nothing, nothing, nothing, nothing, *rest, WRITE=False, **shape)
    first = _offsets(counts)
    total_tried = tried.sum(dtype=torch.int64)
    complete = None
    if capacity is None:
        samples, all_tried = torch.stack([first[-1], total_tried]).tolist()
    else:
        samples, all_tried, complete = capacity, total_tried, first[1:] <= capacity
        first.clamp_(max=capacity)
    # Zeros: the padding, and what the two passes, compiled on their own, might disagree about by a rounding.
    start, extent, length, point = (origins.new_zeros(samples), origins.new_zeros(samples), origins.new_zeros(samples), origins.new_zeros(samples, 3))
    _march[grid](*bundle, first, counts, tried, start, extent, length, point, *rest, WRITE=True, **shape)
    return Samples(first, start, extent, length, point, all_tried, complete)


@triton.jit
def _ray_of(first, n, rays, BITS: tl.constexpr):  # type: ignore[no-untyped-def]
    """Which ray owns packed sample n: the last one that begins at or before it."""
    low = n * 0
    high = low + rays - 1
    for _ in tl.static_range(BITS):
        middle = (low + high + 1) // 2
        left = tl.load(first + middle) <= n
        low = tl.where(left, middle, low)
        high = tl.where(left, high, middle - 1)
    return low


@triton.jit
def _pivots(weight, first, out, rays, samples, threshold, most, BITS: tl.constexpr, BLOCK: tl.constexpr):  # type: ignore[no-untyped-def]
    """Each lane counts the heavier samples of its ray; among equals the nearer counts as heavier."""
    n = tl.program_id(0).to(tl.int64) * BLOCK + tl.arange(0, BLOCK)
    live = n < samples
    w = tl.load(weight + n, live, other=0.0)
    chosen = live & (w > threshold) & (n < tl.load(first + rays))
    ray = _ray_of(first, n, rays, BITS)
    other = tl.load(first + ray, chosen, other=0)
    end = tl.load(first + ray + 1, chosen, other=0)
    rank = tl.zeros((BLOCK,), tl.int32)
    going = chosen & (end - other > most)
    while tl.max(going.to(tl.int32), 0) > 0:
        theirs = tl.load(weight + other, going, other=0.0)
        rank += (going & ((theirs > w) | ((theirs == w) & (other < n)))).to(tl.int32)
        other += 1
        going = going & (other < end) & (rank < most)
    tl.store(out + n, (chosen & (rank < most)).to(tl.int8), live)


def select_pivots(weight: Tensor, first: Tensor, threshold: float, most: int) -> Tensor:
    """See `efficientnerf.sampling.samples.select_pivots`; padding is never pivotal."""
    weight, rays, samples = weight.detach().contiguous(), len(first) - 1, len(weight)
    out = torch.zeros(samples, dtype=torch.bool, device=weight.device)
    if rays and samples:
        block = LANES if INTERPRETED else 32
        _pivots[(blocks(samples, block),)](
            weight, first, out.view(torch.int8), rays, samples, float(threshold), most, BITS=rays.bit_length(), BLOCK=block, num_warps=1 if block == 32 else 4
        )
    return out


@triton.jit
def _pivotal(  # type: ignore[no-untyped-def]
    origins, directions, offset, cx, cy, cz, hx, hy, hz, first, start, extent, length, pivotal, before,
    fine_start, fine_extent, fine_length, point, rays, samples, capacity,
    CONTRACTED: tl.constexpr, PER_PIVOT: tl.constexpr, BITS: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    n = tl.program_id(0).to(tl.int64) * BLOCK + tl.arange(0, BLOCK)
    live = n < samples
    live = live & (tl.load(pivotal + n, live, other=0) != 0)
    ray = _ray_of(first, n, rays, BITS)
    ux, uy, uz, vx, vy, vz = _ray(origins, directions, ray, live, cx, cy, cz, hx, hy, hz)
    shift = tl.load(offset + ray, live, other=0.0)
    size = tl.load(extent + n, live, other=0.0) / PER_PIVOT
    part = tl.load(length + n, live, other=0.0) / PER_PIVOT
    begin = tl.load(start + n, live, other=0.0)
    at = tl.load(before + n, live, other=0) * PER_PIVOT
    for slot in tl.static_range(PER_PIVOT):
        put = live & (at + slot < capacity)
        t = begin + slot * size
        s = t + shift * size
        gx, gy, gz = _grid(ux + s * vx, uy + s * vy, uz + s * vz, CONTRACTED)
        tl.store(fine_start + at + slot, t, put)
        tl.store(fine_extent + at + slot, size, put)
        tl.store(fine_length + at + slot, part, put)
        tl.store(point + (at + slot) * 3, gx, put)
        tl.store(point + (at + slot) * 3 + 1, gy, put)
        tl.store(point + (at + slot) * 3 + 2, gz, put)


def pivotal_samples(
    space: Space, origins: Tensor, directions: Tensor, offset: Tensor, coarse: Samples, pivotal: Tensor, per_pivot: int, capacity: int | None = None
) -> Samples:
    """See `efficientnerf.sampling.samples.pivotal_samples`; with `capacity` see the module."""
    origins, directions, offset = (t.detach().contiguous() for t in (origins, directions, offset))
    rays, samples = len(origins), len(pivotal)
    pivotal = pivotal & (torch.arange(samples, device=origins.device) < coarse.first[-1])  # padding may have been marked by chance
    before = _offsets(pivotal)  # (N + 1,) pivotal samples before each
    first = before[coarse.first] * per_pivot
    complete = None
    if capacity is None:
        total = int(first[-1])
    else:
        total, complete = capacity, first[1:] <= capacity
        first.clamp_(max=capacity)
    start, extent, length, point = (origins.new_zeros(total), origins.new_zeros(total), origins.new_zeros(total), origins.new_zeros(total, 3))
    if rays and samples and total:
        _pivotal[(blocks(samples),)](
            origins, directions, offset, *_box(space), coarse.first, coarse.start, coarse.extent, coarse.length, pivotal.view(torch.int8), before,
            start, extent, length, point, rays, samples, total,
            CONTRACTED=space.contracted, PER_PIVOT=per_pivot, BITS=rays.bit_length(), BLOCK=LANES,
        )  # fmt: skip
    return Samples(first, start, extent, length, point, coarse.tried, complete)
