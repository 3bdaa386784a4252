"""Optimiser steps on a tree's values on CUDA (Triton): those of `efficientnerf.backends.numba.tree_training.steps`, whose formulas hold here.

Gradients are sums in fixed point (`efficientnerf.backends.triton.tree_gradients`), which a step sets back to zero. N voxels, K harmonics.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import triton
import triton.language as tl
from torch import Tensor

from efficientnerf.backends.layout import MAX_THICKNESS, MAX_VISITS, MIN_THICKNESS, MOST_VARIATION, Hyperparameters, Moments
from efficientnerf.backends.triton.launch import INTERPRETED, blocks
from efficientnerf.backends.triton.tree_gradients import DeviceGrid, fixed_point_scale

VOXELS_PER_PROGRAM = 256 if INTERPRETED else 32


class Neighbours(NamedTuple):
    """For total variation; without rows where there is none."""

    density: Tensor  # (N,) before the step
    beside: Tensor  # (N, 6) int32 voxels beyond the faces of each, -1 where none is stored


class Rule(NamedTuple):
    """voxel: side of cascade 0's voxels; the numbers of Hyperparameters, the logarithm of the decay, and `total_variation` the share of the differences;
    limits of `efficientnerf.backends.layout`."""

    voxel: Any
    density_rate: Any
    sh_rate: Any
    view_share: Any
    decay: Any
    log_decay: Any
    epsilon: Any
    total_variation: Any
    min_thickness: Any
    max_thickness: Any
    max_visits: Any


@triton.jit
def _total_variation(v, met, thickness, side, weight, before, beside, least):
    """Share `weight` of the differences of the logarithm of the optical thickness to those of the neighbours."""
    here, slope = tl.log(thickness), tl.zeros_like(thickness)
    for face in tl.static_range(6):
        other = tl.load(beside + 6 * v + face, met, other=-1)
        beyond = tl.maximum(tl.load(before + other, other >= 0, other=0.0) * side, least)
        slope += tl.where(other >= 0, here - tl.log(beyond), 0.0)
    return weight * slope


@triton.jit(do_not_specialize=["number"])
def _step(
    values, sums, moments, neighbours, stamp, cascade_of, place, voxels, number, unit, rule,
    CASCADES: tl.constexpr, SMOOTH: tl.constexpr, WIDTH: tl.constexpr, ROW: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """`efficientnerf.backends.numba.tree_training.steps.step` from gradients as integers, of `unit` each. SMOOTH: with total variation.

    values  density and harmonics; sums: gradients by optical thickness and harmonics
    """
    density, sh, h = values[0], values[1], rule
    v = tl.program_id(0).to(tl.int64) * BLOCK + tl.arange(0, BLOCK)
    met = tl.load(stamp + v, v < voxels, other=-1) == number
    if tl.max(met.to(tl.int32), 0) > 0:
        side = h.voxel
        if CASCADES > 1:
            side = h.voxel * tl.load(place + 4 * tl.load(cascade_of + v, met, other=0).to(tl.int32) + 3)
        visited = tl.minimum(tl.load(moments.visits + v, met, other=0) + 1, h.max_visits)
        correction = 1 / (1 - tl.exp(visited.to(tl.float32) * h.log_decay))
        # By the logarithm of the optical thickness, which is at least a little, so that density can grow from nothing.
        depth = tl.maximum(tl.load(density + v, met, other=0.0) * side, h.min_thickness)
        g = tl.load(sums[0] + v, met, other=0).to(tl.float32) * unit * depth
        square = h.decay * tl.load(moments.square_density + v, met, other=0.0) + (1 - h.decay) * g * g
        change = h.density_rate * g / (tl.sqrt(square * correction) + h.epsilon)
        if SMOOTH:
            change += _total_variation(v, met, depth, side, h.total_variation, neighbours.density, neighbours.beside, h.min_thickness)
        column = tl.arange(0, ROW)
        at = v[:, None] * WIDTH + column[None, :]
        there = met[:, None] & (column < WIDTH)[None, :]
        by_sh = tl.load(sums[1] + at, there, other=0).to(tl.float32) * unit
        square_sh = h.decay * tl.load(moments.square_sh + v, met, other=0.0) + (1 - h.decay) * tl.sum(by_sh * by_sh, 1) / WIDTH
        scale = h.sh_rate / (tl.sqrt(square_sh * correction) + h.epsilon)
        share = tl.where(column < 3, 1.0, h.view_share)
        moved = tl.load(sh + at, there, other=0.0) - scale[:, None] * share[None, :] * by_sh
        # The compiler may load a value once for each layout that it is used in, in other warps: none may store before all have loaded.
        tl.debug_barrier()
        tl.store(moments.visits + v, visited, met)
        tl.store(density + v, tl.minimum(tl.maximum(depth * tl.exp(-change), h.min_thickness), h.max_thickness) / side, met)
        tl.store(moments.square_density + v, square, met)
        tl.store(sums[0] + v, tl.zeros_like(v), met)
        tl.store(moments.square_sh + v, square_sh, met)
        tl.store(sh + at, moved, there)
        tl.store(sums[1] + at, tl.zeros_like(at), there)


def step(
    g: DeviceGrid, values: tuple[Tensor, Tensor], sums: tuple[Tensor, Tensor], moments: Moments, stamp: Tensor, h: Hyperparameters, neighbours: Neighbours, *,
    number: int, rays: int,
) -> None:  # fmt: skip
    """A step for the voxels that the last gradients, of `rays` rays, stamped with `number`; the others stay.

    values  density (N,) and harmonics (N, 3 K)
    """
    voxels = len(moments.visits)
    if h.total_variation > 0:
        neighbours.density.copy_(values[0])
    rates = (g.voxel, h.density_rate, h.sh_rate, h.view_share, h.decay, math.log(h.decay), h.epsilon)
    variation = min(h.density_rate * h.total_variation, MOST_VARIATION)
    rule = Rule._make([*map(float, (*rates, variation, MIN_THICKNESS, MAX_THICKNESS)), MAX_VISITS])
    _step[(blocks(voxels, VOXELS_PER_PROGRAM),)](
        values, sums, moments, neighbours, stamp, g.cascade_of, g.cascades.place, voxels, number, 1 / fixed_point_scale(rays), rule,
        CASCADES=len(g.cascades.first), SMOOTH=h.total_variation > 0, WIDTH=3 * g.terms, ROW=g.row,
        BLOCK=VOXELS_PER_PROGRAM, num_warps=4,
    )  # fmt: skip
