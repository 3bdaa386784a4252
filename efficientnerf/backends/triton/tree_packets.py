"""Losses of packets of neighbouring rays through a tree and their gradients, in one launch on CUDA (Triton): a program a packet.

`efficientnerf.backends.triton.tree_gradients` does the same ray by ray. Here what neighbouring samples share is read, shaded and added once: the harmonics of
a packet are the mean of its rays', as on the CPU, so that a voxel has one colour in it, and gets gradients by its density and three arguments of sigmoids.

A ray holds, in registers, the eight voxels that its last sample lies between: one in each *slot*, by the parity of a voxel's coordinates. The next sample,
a voxel on at most, finds many of them there again. A voxel that comes into a slot is shaded for all rays of the packet that hold it; one that leaves it hands
the sum of its gradients to another ray that holds it, and only the last one adds to memory. docs/experiments/tree-training-kernels.md

Order of sums: samples of a ray front to back; rays of a packet as Triton reduces its lanes; packets in fixed point, which no order changes. So the same
packets give the same bytes, on one kind of device and one version of Triton, in whatever order they come.

P packets, R rays, N voxels, K harmonics.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import torch
import triton
import triton.language as tl
from torch import Tensor

from efficientnerf.backends.layout import RayTargets
from efficientnerf.backends.triton.harmonics import basis_columns
from efficientnerf.backends.triton.tree_gradients import DeviceGrid, Scene, Sums, Upstream, Voxels, by_sample, fixed_point_scale
from efficientnerf.backends.triton.tree_march import Rays, march_cascades
from efficientnerf.backends.triton.vectors import Vec3, add_scaled, load_vec3, sigmoid, zeros_vec3

RAYS = 16  # of a program
WARPS = {4: 1, 16: 1, 32: 1, 64: 2, 128: 4}  # of a program, by the length of a row of coefficients: so many that nothing spills
NO_VOXEL = tl.constexpr(2**31 - 1)  # above all voxels


class Held(NamedTuple):
    """What rays hold in their slots, (RAYS, 8) each: voxel, -1 for none; density; whether it is shaded; colour (Vec3), arguments of the sigmoids."""

    voxel: Any
    density: Any
    shaded: Any
    colour: Any


class Gathered(NamedTuple):
    """Gradients that wait in slots, (RAYS, 8) each: by the arguments of the sigmoids (Vec3), and by the voxel's optical thickness."""

    colour: Any
    thickness: Any


class Forward(NamedTuple):
    """transmittance; colour (Vec3), premultiplied; Held."""

    transmittance: Any
    colour: Any
    held: Any


class Backward(NamedTuple):
    """transmittance; behind (Vec3): colour of the samples still to come; Held; Gathered."""

    transmittance: Any
    behind: Any
    held: Any
    gathered: Any


class Shaded(NamedTuple):
    """Of samples: weight where they show, else 0; colour (Vec3); transmittance behind them; shares of the slots (RAYS, 8), which sum to one where they show."""

    weight: Any
    colour: Any
    after: Any
    shares: Any


@triton.jit
def _zeros(RAYS: tl.constexpr):  # type: ignore[no-untyped-def]
    return tl.zeros((RAYS, 8), tl.float32)


@triton.jit
def _nothing_held(RAYS: tl.constexpr):  # type: ignore[no-untyped-def]
    none = tl.full((RAYS, 8), -1, tl.int32)
    return Held(none, _zeros(RAYS), none < -1, Vec3(_zeros(RAYS), _zeros(RAYS), _zeros(RAYS)))


@triton.jit
def _any(mask):  # type: ignore[no-untyped-def]
    return tl.max(tl.max(mask.to(tl.int32), 1), 0) > 0


@triton.jit
def _corners(index, sample, voxel, BRICK: tl.constexpr, NEAREST: tl.constexpr):  # type: ignore[no-untyped-def]
    """Voxels in the slots of rays after a sample, which are `voxel` where a ray has none, and their weights of interpolation."""
    EDGE: tl.constexpr = BRICK + 2
    number = tl.arange(0, 8)[None, :] ^ sample.parity[:, None]  # of the corner that belongs into a slot
    x, y, z = number // 4, number // 2 % 2, number % 2
    f = sample.fraction
    weight = tl.where(x > 0, f.x[:, None], 1 - f.x[:, None]) * tl.where(y > 0, f.y[:, None], 1 - f.y[:, None])
    weight = weight * tl.where(z > 0, f.z[:, None], 1 - f.z[:, None])
    inside = sample.inside[:, None] & (number >= 0)
    there = inside & (number == 0) if NEAREST else inside
    found = tl.load(index + sample.corner[:, None] + ((x * EDGE + y) * EDGE + z), there, other=-1)
    return tl.where(inside, found, voxel), tl.where(inside & (found >= 0), weight, 0.0)


@triton.jit
def _shade(scene, sums, held, wanted, K: tl.constexpr):  # type: ignore[no-untyped-def]
    """Held with colours of the voxels that are `wanted`, one of each slot at a time, for all rays that hold them; they are stamped."""
    column = scene.column
    channel = column % 3
    shaded, red, green, blue = held.shaded, held.colour.x, held.colour.y, held.colour.z
    while _any(wanted):
        first = tl.min(tl.where(wanted, held.voxel, NO_VOXEL), 0)  # (8,)
        there = first < NO_VOXEL
        row = scene.sh + first.to(tl.int64)[:, None] * (3 * K) + column[None, :]
        terms = tl.load(row, there[:, None] & (column < 3 * K)[None, :], other=0.0) * scene.basis[None, :]  # (8, C)
        same = (held.voxel == first[None, :]) & there[None, :]
        red = tl.where(same, tl.sum(tl.where((channel == 0)[None, :], terms, 0.0), 1)[None, :], red)
        green = tl.where(same, tl.sum(tl.where((channel == 1)[None, :], terms, 0.0), 1)[None, :], green)
        blue = tl.where(same, tl.sum(tl.where((channel == 2)[None, :], terms, 0.0), 1)[None, :], blue)
        tl.store(sums.stamp + first, sums.number, there)
        shaded = shaded | same
        wanted = wanted & (held.voxel != first[None, :])
    return Held(held.voxel, held.density, shaded, Vec3(red, green, blue))


@triton.jit
def _met(scene, sums, sample, state, BRICK: tl.constexpr, NEAREST: tl.constexpr, K: tl.constexpr):  # type: ignore[no-untyped-def]
    """What rays hold after a sample, and what that shows."""
    before = state.held
    voxel, weight = _corners(scene.index, sample, before.voxel, BRICK, NEAREST)
    new = voxel != before.voxel
    density = tl.where(new, tl.load(scene.density + voxel, new & (voxel >= 0), other=0.0), before.density)
    thickness = tl.sum(weight * density, 1) * (sample.step * scene.voxel * sample.unit)
    after = state.transmittance * tl.exp(-thickness)
    light = state.transmittance - after
    visible = (thickness > 0) & (light >= scene.min_weight)
    shaded = before.shaded & (new == 0)
    held = Held(voxel, density, shaded, before.colour)
    held = _shade(scene, sums, held, visible[:, None] & (weight > 0) & (shaded == 0), K)
    total = tl.sum(weight, 1)
    shares = weight * tl.where(visible, 1 / tl.maximum(total, 1e-20), 0.0)[:, None]
    red, green, blue = tl.sum(shares * held.colour.x, 1), tl.sum(shares * held.colour.y, 1), tl.sum(shares * held.colour.z, 1)
    rgb = Vec3(sigmoid(red), sigmoid(green), sigmoid(blue))
    return held, new, weight, Shaded(light * visible.to(tl.float32), rgb, after, shares)


@triton.jit
def _composite(given, sample, state, BRICK: tl.constexpr, NEAREST: tl.constexpr, K: tl.constexpr, COLUMNS: tl.constexpr):  # type: ignore[no-untyped-def]
    """given  Scene and Sums"""
    held, _, _, s = _met(given[0], given[1], sample, state, BRICK, NEAREST, K)
    return Forward(s.after, add_scaled(state.colour, s.weight, s.colour), held)


@triton.jit
def _add(scene, sums, voxel, there, colour, thickness, K: tl.constexpr):  # type: ignore[no-untyped-def]
    """Add gradients of eight voxels to memory."""
    column = scene.column
    channel = column % 3
    by_colour = tl.where((channel == 0)[None, :], colour.x[:, None], tl.where((channel == 1)[None, :], colour.y[:, None], colour.z[:, None]))
    row = sums.sh + voxel.to(tl.int64)[:, None] * (3 * K) + column[None, :]
    by_row = (by_colour * scene.basis[None, :] * sums.scale).to(tl.int64)
    tl.atomic_add(row, by_row, there[:, None] & (column < 3 * sums.terms)[None, :], sem="relaxed")
    tl.atomic_add(sums.thickness + voxel, (thickness * sums.scale).to(tl.int64), there, sem="relaxed")


@triton.jit
def _hand_over(scene, sums, voxel, gathered, leaving, holds, K: tl.constexpr, RAYS: tl.constexpr):  # type: ignore[no-untyped-def]
    """Gathered of the slots that stay; what is `leaving` goes to the first ray that then `holds` the voxel, or to memory.

    voxel  (RAYS, 8) before;  holds  (RAYS, 8) voxels after
    """
    ray = tl.arange(0, RAYS)
    stays = leaving == 0
    red, green, blue = tl.where(stays, gathered.colour.x, 0.0), tl.where(stays, gathered.colour.y, 0.0), tl.where(stays, gathered.colour.z, 0.0)
    thickness = tl.where(stays, gathered.thickness, 0.0)
    while _any(leaving):
        first = tl.min(tl.where(leaving, voxel, NO_VOXEL), 0)  # (8,)
        there = first < NO_VOXEL
        same = leaving & (voxel == first[None, :])
        by_red, by_green = tl.sum(tl.where(same, gathered.colour.x, 0.0), 0), tl.sum(tl.where(same, gathered.colour.y, 0.0), 0)
        by_blue, by_thickness = tl.sum(tl.where(same, gathered.colour.z, 0.0), 0), tl.sum(tl.where(same, gathered.thickness, 0.0), 0)
        heir = tl.min(tl.where((holds == first[None, :]) & there[None, :], ray[:, None], RAYS), 0)  # (8,)
        takes = ray[:, None] == heir[None, :]
        red, green = red + tl.where(takes, by_red[None, :], 0.0), green + tl.where(takes, by_green[None, :], 0.0)
        blue, thickness = blue + tl.where(takes, by_blue[None, :], 0.0), thickness + tl.where(takes, by_thickness[None, :], 0.0)
        alone = there & (heir == RAYS)
        if tl.max(alone.to(tl.int32), 0) > 0:
            _add(scene, sums, first, alone, Vec3(by_red, by_green, by_blue), by_thickness, K)
        leaving = leaving & (same == 0)
    return Gathered(Vec3(red, green, blue), thickness)


@triton.jit
def _some(gathered):  # type: ignore[no-untyped-def]
    """Slots with a gradient."""
    return (gathered.colour.x != 0) | (gathered.colour.y != 0) | (gathered.colour.z != 0) | (gathered.thickness != 0)


@triton.jit
def _gather(given, sample, state, BRICK: tl.constexpr, NEAREST: tl.constexpr, K: tl.constexpr, COLUMNS: tl.constexpr):  # type: ignore[no-untyped-def]
    """given  Scene, Sums and Upstream"""
    scene, sums, by = given[0], given[1], given[2]
    held, new, weight, s = _met(scene, sums, sample, state, BRICK, NEAREST, K)
    g = _hand_over(scene, sums, state.held.voxel, state.gathered, new & _some(state.gathered), held.voxel, K, weight.shape[0])
    behind, by_depth, by_rgb = by_sample(by, state.behind, s.weight, s.colour, s.after)
    red, green, blue = g.colour.x + s.shares * by_rgb.x[:, None], g.colour.y + s.shares * by_rgb.y[:, None], g.colour.z + s.shares * by_rgb.z[:, None]
    shows = tl.sum(s.shares, 1) > 0
    thickness = g.thickness + weight * tl.where(shows, by_depth * sample.step, 0.0)[:, None]
    return Backward(s.after, behind, held, Gathered(Vec3(red, green, blue), thickness))


@triton.jit
def _loss(colour, left, seen, behind, arriving, opacity, opacity_weight):  # type: ignore[no-untyped-def]
    """Losses of rays, see `RayTargets`, and their gradients, Upstream."""
    over = add_scaled(colour, left, behind)
    error = Vec3(arriving * over.x - seen.x, arriving * over.y - seen.y, arriving * over.z - seen.z)
    missing = 1 - left - opacity
    loss = error.x * error.x + error.y * error.y + error.z * error.z + opacity_weight * missing * missing
    by = Vec3(2 * arriving * error.x, 2 * arriving * error.y, 2 * arriving * error.z)
    by_opacity = 2 * opacity_weight * missing - (by.x * behind.x + by.y * behind.y + by.z * behind.z)
    return loss, Upstream(by, left * by_opacity)


@triton.jit(do_not_specialize=["number", "terms"])
def _packets(  # type: ignore[no-untyped-def]
    first, rays, targets, cascades, voxels, loss, sums, stamp, number, terms, scale,
    NEAREST: tl.constexpr, CASCADES: tl.constexpr, BRICK: tl.constexpr, K: tl.constexpr, ROW: tl.constexpr, RAYS: tl.constexpr,
):  # fmt: skip
    """Losses (R,) of a packet's rays; adds `scale` times the gradients of their sum by optical thickness (N,) and harmonics (N, 3 K), as integers."""
    begin, end = tl.load(first + tl.program_id(0)), tl.load(first + tl.program_id(0) + 1)
    r = begin + tl.arange(0, RAYS)
    live = r < end
    origin, direction = load_vec3(rays.origins, r, live), load_vec3(rays.directions, r, live)
    column = tl.arange(0, ROW)
    bases = basis_columns(load_vec3(rays.views, r, live), column // 3, K)  # (RAYS, ROW)
    basis = tl.sum(tl.where(live[:, None], bases, 0.0), 0) / (end - begin).to(tl.float32)
    scene = Scene(voxels.index, voxels.density, voxels.sh, voxels.voxel, voxels.min_weight, basis, column)
    into = Sums(sums[0], sums[1], stamp, number, terms, scale)
    one = tl.full((RAYS,), 1.0, tl.float32)
    seen_through = march_cascades(
        cascades, origin, direction, live, (scene, into), Forward(one, zeros_vec3(RAYS), _nothing_held(RAYS)), _composite, CASCADES, BRICK, NEAREST, K, ROW
    )
    wanted, behind = load_vec3(targets.colour, r, live), load_vec3(targets.background, r, live)
    light, solid = tl.load(targets.transmittance + r, live, other=0.0), tl.load(targets.opacity + r, live, other=0.0)
    error, by = _loss(seen_through.colour, seen_through.transmittance, wanted, behind, light, solid, targets.opacity_weight)
    tl.store(loss + r, error, live)
    gathered = Gathered(Vec3(_zeros(RAYS), _zeros(RAYS), _zeros(RAYS)), _zeros(RAYS))
    start = Backward(one, seen_through.colour, _nothing_held(RAYS), gathered)
    last = march_cascades(cascades, origin, direction, live, (scene, into, by), start, _gather, CASCADES, BRICK, NEAREST, K, ROW)
    nobody = tl.full((RAYS, 8), -1, tl.int32)
    _hand_over(scene, into, last.held.voxel, last.gathered, _some(last.gathered), nobody, K, RAYS)


def loss_and_gradients(
    g: DeviceGrid, first: Tensor, rays: Rays, density: Tensor, sh: Tensor, targets: RayTargets, sums: tuple[Tensor, Tensor], stamp: Tensor, number: int, *,
    min_weight: float = 0.0, terms: int = 25,
) -> Tensor:  # fmt: skip
    """Losses (R,) of rays in packets; the gradients of their sum are added to `sums`, see `efficientnerf.backends.triton.tree_gradients.backward`.

    first  (P + 1,) int64: first ray of each packet, and the end; none has more than RAYS, or none at all
    """
    count = len(rays.origins)
    loss = torch.empty(count, device=density.device)
    if len(first) > 1:
        wanted = RayTargets(*(part.float().contiguous() for part in targets[:4]), float(targets.opacity_weight))
        _packets[(len(first) - 1,)](
            first, rays, wanted, g.cascades, Voxels(g.index, density, sh, float(g.voxel), float(min_weight)), loss, sums, stamp, number,
            min(terms, g.terms), fixed_point_scale(count),
            NEAREST=g.nearest, CASCADES=len(g.cascades.first), BRICK=g.brick, K=g.terms, ROW=g.row, RAYS=RAYS, num_warps=WARPS[g.row],
        )  # fmt: skip
    return loss
