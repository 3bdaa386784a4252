"""Valid and pivotal samples on CUDA (Triton): one lane a ray when marching, one lane a sample after.

How many samples a bundle has is known to the device alone. Without a capacity the host waits once for the number, to make arrays of that length. With
`capacity` it never waits: the arrays have that length, and are filled as `efficientnerf.sampling.samples` says. Training leaves rays that have not all of their
samples out of its loss.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import torch
import triton
import triton.language as tl
from torch import Tensor

from efficientnerf.backends.layout import RayBundle, SampleColumns
from efficientnerf.backends.triton.launch import INTERPRETED, LANES, blocks
from efficientnerf.backends.triton.vectors import Vec3, along, store_vec3
from efficientnerf.geometry.spaces import FARTHEST, Space
from efficientnerf.sampling.samples import Samples

RAYS = 256 if INTERPRETED else 32  # one warp: the end of a program's loop is decided without shared memory
NEAREST_SHELL = tl.constexpr(FARTHEST)


class Box(NamedTuple):
    """centre, half: Vec3 of the scene's box, world units."""

    centre: Any
    half: Any


@triton.jit
def _grid(p, CONTRACTED: tl.constexpr):
    """Unit coordinates to grid coordinates; see `efficientnerf.geometry.spaces`."""
    if CONTRACTED:
        m = tl.maximum(tl.maximum(tl.abs(p.x), tl.abs(p.y)), tl.maximum(tl.abs(p.z), 1.0))
        f = (2 - 1 / m) / m
        gx, gy, gz = (p.x * f + 2) * 0.25, (p.y * f + 2) * 0.25, (p.z * f + 2) * 0.25
    else:
        gx, gy, gz = (p.x + 1) * 0.5, (p.y + 1) * 0.5, (p.z + 1) * 0.5
    return Vec3(gx, gy, gz)


@triton.jit
def _unit_rays(bundle, r, live, box):
    """Origins and directions (Vec3 each) of rays in unit coordinates."""
    origins, directions = bundle.origins, bundle.directions
    ux = (tl.load(origins + r * 3, live, other=0.0) - box.centre.x) / box.half.x
    uy = (tl.load(origins + r * 3 + 1, live, other=0.0) - box.centre.y) / box.half.y
    uz = (tl.load(origins + r * 3 + 2, live, other=0.0) - box.centre.z) / box.half.z
    vx = tl.load(directions + r * 3, live, other=1.0) / box.half.x
    vy = tl.load(directions + r * 3 + 1, live, other=1.0) / box.half.y
    vz = tl.load(directions + r * 3 + 2, live, other=1.0) / box.half.z
    return Vec3(ux, uy, uz), Vec3(vx, vy, vz)


@triton.jit
def _slab(u, v):
    """Distances at which rays cross the faces at -1 and 1 of one axis, nearer first."""
    safe = tl.where(tl.abs(v) < 1e-12, 1e-12, v)
    one, other = (-1 - u) / safe, (1 - u) / safe
    return tl.minimum(one, other), tl.maximum(one, other)


@triton.jit
def _clip_to_box(u, v, near, far):
    """Distances at which rays enter and leave the box, within near and far."""
    ax, bx = _slab(u.x, v.x)
    ay, by = _slab(u.y, v.y)
    az, bz = _slab(u.z, v.z)
    return tl.maximum(tl.maximum(ax, ay), tl.maximum(az, near)), tl.minimum(tl.minimum(bx, by), tl.minimum(bz, far))


@triton.jit
def _voxel_of(g, side):
    """Flat index of the density voxel at grid coordinates. Clamped before they become integers: lanes whose ray has ended may be anywhere."""
    i = tl.minimum(tl.maximum(g.x * side, 0.0), side - 1.0).to(tl.int32)
    j = tl.minimum(tl.maximum(g.y * side, 0.0), side - 1.0).to(tl.int32)
    k = tl.minimum(tl.maximum(g.z * side, 0.0), side - 1.0).to(tl.int32)
    return (i * side + j) * side + k


@triton.jit
def _store(buffers, at, t, size, length, point, live):
    """Samples to their places."""
    tl.store(buffers.start + at, t, live)
    tl.store(buffers.extent + at, size, live)
    tl.store(buffers.length + at, length, live)
    store_vec3(buffers.point, at, point, live)


@triton.jit(do_not_specialize=["rays", "unpruned"])
def _march(
    bundle, box, voxels, first, tallies, out, rays, max_intervals, step, threshold, unpruned, side,
    CONTRACTED: tl.constexpr, WRITE: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """Counts the valid samples of each ray, or writes them from `first` on into SampleColumns.

    tallies  (R,) int32 each: valid samples, and intervals tried
    """
    r = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    live = r < rays
    u, v = _unit_rays(bundle, r, live, box)
    shift = tl.load(bundle.offset + r, live, other=0.0)
    t = tl.load(bundle.near + r, live, other=1.0)
    leave = tl.load(bundle.far + r, live, other=0.0)
    if not CONTRACTED:
        t, leave = _clip_to_box(u, v, t, leave)
    at = tl.zeros((BLOCK,), tl.int64)
    end = tl.zeros((BLOCK,), tl.int64)
    if WRITE:
        at = tl.load(first + r, live, other=0)
        end = tl.load(first + r + 1, live, other=0)
    limit = tl.where(r < unpruned, float("-inf"), threshold)
    valid = tl.zeros((BLOCK,), tl.int32)
    passed = tl.zeros((BLOCK,), tl.int32)
    alive = live & (t < leave)
    if WRITE:
        alive = alive & (at < end)
    n = 0
    while (n < max_intervals) & (tl.max(alive.to(tl.int32), 0) > 0):
        scale = tl.full((BLOCK,), 1.0, tl.float32)  # world length of a contracted one
        if CONTRACTED:
            reach = tl.maximum(tl.maximum(tl.abs(u.x + t * v.x), tl.abs(u.y + t * v.y)), tl.maximum(tl.abs(u.z + t * v.z), 1.0))
            scale = reach * reach
            alive = alive & (reach * NEAREST_SHELL <= 1)
        size = tl.minimum(step * scale, leave - t)
        g = _grid(along(u, v, t + shift * size), CONTRACTED)
        found = alive & (tl.load(voxels + _voxel_of(g, side), alive, other=0.0) > limit)
        if WRITE:
            _store(out, at, t, size, size / scale, g, found & (at < end))
            at += found.to(tl.int64)
        else:
            valid += found.to(tl.int32)
            passed += alive.to(tl.int32)
        t = tl.where(alive, t + step * scale, t)
        alive = alive & (t < leave)
        if WRITE:
            alive = alive & (at < end)
        n += 1
    if not WRITE:
        tl.store(tallies[0] + r, valid, live)
        tl.store(tallies[1] + r, passed, live)


def _box(space: Space) -> Box:
    return Box(Vec3(*(float(x) for x in space.centre)), Vec3(*(float(x) for x in space.half)))


def _offsets(counts: Tensor) -> Tensor:
    first = torch.zeros(len(counts) + 1, dtype=torch.int64, device=counts.device)
    torch.cumsum(counts, 0, out=first[1:])
    return first


def valid_samples(
    space: Space, origins: Tensor, directions: Tensor, near: Tensor, far: Tensor, offset: Tensor, step: float, max_intervals: int,
    voxels: Tensor, threshold: float, capacity: int | None = None, *, unpruned: int = 0,
) -> Samples:  # fmt: skip
    """See `efficientnerf.sampling.valid.valid_samples`; with `capacity` see the module, and `tried` is then a tensor on the device."""
    origins, directions, near, far, offset, voxels = (t.detach().contiguous() for t in (origins, directions, near, far, offset, voxels))
    rays, side = len(origins), voxels.shape[0]
    device = origins.device
    tallies = counts, tried = torch.zeros(rays, dtype=torch.int32, device=device), torch.zeros(rays, dtype=torch.int32, device=device)
    bundle = (RayBundle(origins, directions, near, far, offset), _box(space), voxels)
    rest = (rays, max_intervals, float(step), float(threshold), unpruned, side)
    grid, shape = (blocks(rays, RAYS),), {"CONTRACTED": space.contracted, "BLOCK": RAYS, "num_warps": 1}
    nothing = origins.new_empty(0)
    _march[grid](*bundle, counts, tallies, SampleColumns(*[nothing] * 4), *rest, WRITE=False, **shape)
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
    _march[grid](*bundle, first, tallies, SampleColumns(start, extent, length, point), *rest, WRITE=True, **shape)
    return Samples(first, start, extent, length, point, all_tried, complete)


@triton.jit
def _ray_of(first, n, rays, bits):
    """Which ray owns packed sample n: the last one that begins at or before it; `rays` has so many bits."""
    low = n * 0
    high = low + rays - 1
    for _ in range(bits):
        middle = (low + high + 1) // 2
        left = tl.load(first + middle) <= n
        low = tl.where(left, middle, low)
        high = tl.where(left, high, middle - 1)
    return low


@triton.jit(do_not_specialize=["rays", "samples", "bits"])
def _pivots(weight, first, out, rays, samples, threshold, max_pivots, bits, BLOCK: tl.constexpr):
    """Each lane counts the heavier samples of its ray; among equals the nearer counts as heavier."""
    n = tl.program_id(0).to(tl.int64) * BLOCK + tl.arange(0, BLOCK)
    live = n < samples
    w = tl.load(weight + n, live, other=0.0)
    chosen = live & (w > threshold) & (n < tl.load(first + rays))
    ray = _ray_of(first, n, rays, bits)
    other = tl.load(first + ray, chosen, other=0)
    end = tl.load(first + ray + 1, chosen, other=0)
    rank = tl.zeros((BLOCK,), tl.int32)
    going = chosen & (end - other > max_pivots)
    while tl.max(going.to(tl.int32), 0) > 0:
        theirs = tl.load(weight + other, going, other=0.0)
        rank += (going & ((theirs > w) | ((theirs == w) & (other < n)))).to(tl.int32)
        other += 1
        going = going & (other < end) & (rank < max_pivots)
    tl.store(out + n, (chosen & (rank < max_pivots)).to(tl.int8), live)


def select_pivots(weight: Tensor, first: Tensor, threshold: float, max_pivots: int) -> Tensor:
    """See `efficientnerf.sampling.pivotal.select_pivots`; padding is never pivotal."""
    weight, rays, samples = weight.detach().contiguous(), len(first) - 1, len(weight)
    out = torch.zeros(samples, dtype=torch.bool, device=weight.device)
    if rays and samples:
        block = LANES if INTERPRETED else 32
        _pivots[(blocks(samples, block),)](
            weight, first, out.view(torch.int8), rays, samples, float(threshold), max_pivots, rays.bit_length(),
            BLOCK=block, num_warps=1 if block == 32 else 4,
        )  # fmt: skip
    return out


@triton.jit(do_not_specialize=["rays", "samples", "capacity", "per_pivot", "bits"])
def _pivotal(
    bundle, box, first, coarse, pivotal, before, fine, rays, samples, capacity, per_pivot, bits, CONTRACTED: tl.constexpr, BLOCK: tl.constexpr
):
    """Divides the pivotal ones of the samples `coarse`, SampleColumns, into `fine`; before: pivotal samples before each."""
    n = tl.program_id(0).to(tl.int64) * BLOCK + tl.arange(0, BLOCK)
    live = n < samples
    live = live & (tl.load(pivotal + n, live, other=0) != 0)
    ray = _ray_of(first, n, rays, bits)
    u, v = _unit_rays(bundle, ray, live, box)
    shift = tl.load(bundle.offset + ray, live, other=0.0)
    size = tl.load(coarse.extent + n, live, other=0.0) / per_pivot
    part = tl.load(coarse.length + n, live, other=0.0) / per_pivot
    begin = tl.load(coarse.start + n, live, other=0.0)
    at = tl.load(before + n, live, other=0) * per_pivot
    for slot in range(per_pivot):
        put = live & (at + slot < capacity)
        t = begin + slot * size
        g = _grid(along(u, v, t + shift * size), CONTRACTED)
        _store(fine, at + slot, t, size, part, g, put)


def pivotal_samples(
    space: Space, origins: Tensor, directions: Tensor, offset: Tensor, coarse: Samples, pivotal: Tensor, per_pivot: int, capacity: int | None = None
) -> Samples:
    """See `efficientnerf.sampling.pivotal.pivotal_samples`; with `capacity` see the module."""
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
            RayBundle(origins, directions, offset, offset, offset), _box(space), coarse.first, SampleColumns(*coarse[1:5]), pivotal.view(torch.int8), before,
            SampleColumns(start, extent, length, point), rays, samples, total, per_pivot, rays.bit_length(), CONTRACTED=space.contracted, BLOCK=LANES,
        )  # fmt: skip
    return Samples(first, start, extent, length, point, coarse.tried, complete)
