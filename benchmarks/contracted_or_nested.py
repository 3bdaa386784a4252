"""A whole scene in one grid of contracted space, or in nested grids that double: pictures of both at several resolutions (docs/experiments/whole-scene.md).

    python benchmarks/contracted_or_nested.py RUN [--resolutions 96,128,192,256] [--json FILE]

RUN is a run with `poses` and `train` of an unbounded scene. The trained field is evaluated in the voxels that its training rays show, as the stage `bake` does
(average of jittered points, dilated by one voxel), without refinement, and test views are rendered from them, trilinear, every half voxel. Both grids have the
same cubic voxels in the box and end 64 half sides from its centre.

    nested      a box n has twice the sides and voxels of the one before, which is cut out of it
    contracted  MERF's piecewise-projective contraction (Reiser et al. 2023, equation 5): where u_i is the largest coordinate in magnitude and beyond 1 it
                becomes sign(u_i) (2 - 1 / |u_i|), the others u_j / |u_i|; the identity in the box. Rays are straight in the box and in each of six arms.
"""

from __future__ import annotations

import argparse
import json
import math
import sys
import time
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from numba import njit, prange

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))

OUTER = 6  # cascades around the box: 2^6 half sides, as far as rays of the field go
BLOCK = 8  # voxels along a side of the blocks that a ray skips where they are empty
THRESHOLD = 1e-3  # of the weight of a voxel that is stored
POINTS = 4  # of a voxel, averaged
RAYS = 8192  # at once


class Grids(NamedTuple):
    """Numbered voxels of one kind of grid. Boxes and cells: u = (x - centre) / half is in [-1, 1] in the box.

    contracted  one grid over [-2, 2]^3 of contracted coordinates; else one for each cascade over [-1, 1]^3 of u / 2^n
    size        (3,) voxels of each grid
    index       (grids, *size) int32 number of the stored voxel, -1 where none
    blocks      (grids, ...) bool: whether interpolation in the block meets a stored voxel
    """

    contracted: bool
    size: np.ndarray
    index: np.ndarray
    blocks: np.ndarray


@njit(inline="always")
def place(contracted, u, size, out):  # type: ignore[no-untyped-def]
    """Voxel coordinates of u; the grid's number, and for contracted space the axis (0 the box, else 1 to 3)."""
    m, axis = abs(u[0]), 0
    for i in range(1, 3):
        if abs(u[i]) > m:
            m, axis = abs(u[i]), i
    if contracted:
        for i in range(3):
            c = u[i] if m <= 1 else (math.copysign(2 - 1 / m, u[i]) if i == axis else u[i] / m)
            out[i] = (c + 2) / 4 * size[i]
        return 0, 0 if m <= 1 else axis + 1
    n = 0
    while m > 1 and n < OUTER:
        m /= 2
        n += 1
    for i in range(3):
        out[i] = (u[i] / 2.0**n + 1) / 2 * size[i]
    return n, n


@njit(inline="always")
def squared_speed(contracted, u, direction, m, grid, part, facing, size):  # type: ignore[no-untyped-def]
    """Squared voxels that a ray passes in a world unit at u, whose greatest coordinate is m."""
    speed = 0.0
    for i in range(3):
        v = direction[i]
        if not contracted:
            v = v / 2.0**grid * size[i] / 2
        elif part == 0:
            v = v * size[i] / 4
        elif i == part - 1:
            v = v / (m * m) * size[i] / 4
        else:
            v = (v / m - u[i] * facing * direction[part - 1] / (m * m)) * size[i] / 4
        speed += v * v
    return speed


@njit(inline="always")
def blended(at, grid, size, index, density, sh, mixed, ahead):  # type: ignore[no-untyped-def]
    """Trilinear density at voxel coordinates, and the sum of the weights of stored voxels; their harmonics in `mixed` (K, 3). `ahead` (3,) is scratch."""
    sigma, total = 0.0, 0.0
    mixed[:] = 0
    for k in range(8):
        weight, held = 1.0, True
        for i in range(3):
            low = math.floor(at[i] - 0.5)
            f = at[i] - 0.5 - low
            one = (k >> i) & 1
            weight *= f if one else 1 - f
            ahead[i] = low + one
            held &= 0 <= ahead[i] < size[i]
        if not held or weight <= 0:
            continue
        voxel = index[grid, int(ahead[0]), int(ahead[1]), int(ahead[2])]
        if voxel < 0:
            continue
        sigma += weight * density[voxel]
        total += weight
        for j in range(sh.shape[1]):
            for c in range(3):
                mixed[j, c] += weight * sh[voxel, j, c]
    return sigma, total


@njit(parallel=True, fastmath=False)
def march(contracted, size, index, blocks, density, sh, harmonics, origins, directions, half, near, colour, opacity, counts):  # type: ignore[no-untyped-def]
    """Colour (R, 3), opacity (R,), and counts (R, 3): steps, steps in blocks that are not empty, parts.

    origins     (R, 3) in units of the box's half sides from its centre
    directions  (R, 3) likewise, so that t is in world units
    """
    for r in prange(len(origins)):
        u, at, ahead = np.empty(3), np.empty(3), np.empty(3)
        t, light, was, sign = near[r], 1.0, -1, 0.0
        mixed = np.empty((sh.shape[1], 3))
        while light > 1e-3:
            for i in range(3):
                u[i] = origins[r, i] + t * directions[r, i]
            m = max(abs(u[0]), abs(u[1]), abs(u[2]))
            if m >= 2.0**OUTER:
                outward = False
                for i in range(3):
                    outward |= abs(u[i]) == m and u[i] * directions[r, i] >= 0
                if outward:
                    break
            grid, part = place(contracted, u, size, at)
            facing = 0.0
            if contracted and part > 0:
                facing = math.copysign(1.0, u[part - 1])
            if part != was or facing != sign:
                counts[r, 2] += 1
                was, sign = part, facing
            speed = squared_speed(contracted, u, directions[r], m, grid, part, facing, size)
            step = 0.5 / math.sqrt(speed)
            for i in range(3):
                u[i] += 0.5 * step * directions[r, i]
            t += step
            counts[r, 0] += 1
            grid, part = place(contracted, u, size, at)
            inside = True
            for i in range(3):
                inside &= 0 <= at[i] < size[i]
            if not inside or not blocks[grid, int(at[0]) // BLOCK, int(at[1]) // BLOCK, int(at[2]) // BLOCK]:
                continue
            counts[r, 1] += 1
            sigma, total = blended(at, grid, size, index, density, sh, mixed, ahead)
            if sigma <= 0:
                continue
            m = max(abs(u[0]), abs(u[1]), abs(u[2]), 1.0)
            alpha = 1 - math.exp(-sigma * step / (m * m))  # a field's density beyond the box is of contracted length
            for c in range(3):
                logit = 0.0
                for j in range(sh.shape[1]):
                    logit += harmonics[r, j] * mixed[j, c]
                colour[r, c] += light * alpha / (1 + math.exp(-logit / total))
            light *= 1 - alpha
        opacity[r] = 1 - light


def voxel_of(contracted: bool, u: np.ndarray, size: np.ndarray) -> np.ndarray:
    """(N, 4) grid and voxel that hold points u (N, 3); the reference for `place`."""
    m = np.abs(u).max(axis=1)
    if contracted:
        far = np.maximum(m, 1)[:, None]
        c = np.where((np.abs(u) >= m[:, None]) & (m[:, None] > 1), np.sign(u) * (2 - 1 / far), u / far)
        return np.concatenate([np.zeros((len(u), 1), int), np.floor((c + 2) / 4 * size).astype(int).clip(0, size - 1)], axis=1)
    n = np.ceil(np.log2(np.maximum(m, 1)) - 1e-12).astype(int).clip(0, OUTER)
    return np.concatenate([n[:, None], np.floor((u / 2.0 ** n[:, None] + 1) / 2 * size).astype(int).clip(0, size - 1)], axis=1)


def world_of(contracted: bool, voxels: np.ndarray, inside: np.ndarray, size: np.ndarray) -> np.ndarray:
    """u (N, 3) of the places `inside` (N, 3) of voxels (N, 4): the inverse of `voxel_of`."""
    at = (voxels[:, 1:] + inside) / size
    if not contracted:
        return (2 * at - 1) * 2.0 ** voxels[:, :1]
    c = 4 * at - 2
    m = np.abs(c).max(axis=1, keepdims=True)
    r = 1 / np.maximum(2 - np.maximum(m, 1), 1e-3)
    return np.where(m <= 1, c, np.where(np.abs(c) >= m, np.sign(c), c) * r)


class Samples(NamedTuple):
    """What the field has along rays: u (N, 3) and weights (N,) of its samples."""

    u: np.ndarray
    weight: np.ndarray


@torch.no_grad()
def shown(m: Any, renderer: Any, views: Any, rays_of: Any, count: int, rng: np.random.Generator) -> Samples:
    """Fine samples, of weight above THRESHOLD, of about `count` pixels of the views."""
    from efficientnerf.model import render_rays

    parts: list[tuple[np.ndarray, np.ndarray]] = []
    each = count // len(views)
    for view in views:
        pixels = rng.random((each, 2)) * [view.camera.width, view.camera.height]
        for begin in range(0, each, RAYS):
            origins, directions = (torch.as_tensor(a, dtype=torch.float32) for a in rays_of(view.camera, pixels[begin : begin + RAYS]))
            slant = (directions @ torch.as_tensor(view.camera.forward, dtype=torch.float32)).clamp(min=1e-3)
            out = render_rays(m, origins, directions, renderer.near / slant, renderer.far / slant, torch.full_like(slant, 0.5), m.behind(directions))
            kept = out.fine_weight > THRESHOLD
            parts.append((m.space.unit(m.space.world(out.fine.point[kept])).numpy().astype(np.float32), out.fine_weight[kept].numpy()))
    return Samples(*(np.concatenate(column) for column in zip(*parts, strict=True)))


@torch.no_grad()
def stored(m: Any, contracted: bool, side: float, seen: Samples, rng: np.random.Generator) -> tuple[Grids, np.ndarray, np.ndarray, dict[str, int]]:
    """The grids, density (N,) per unit of the field's length and harmonics (N, K, 3) of the voxels that are seen and those around them."""
    from efficientnerf.asset.bake import _has_pivots
    from efficientnerf.rendering.compositing import activate
    from efficientnerf.sampling.occupancy import cell_of

    size = np.ceil(2 * m.space.half / side / (2 * BLOCK)).astype(int) * 2 * BLOCK * (2 if contracted else 1)
    grids = 1 if contracted else OUTER + 1
    marked = np.zeros((grids, *size), bool)
    for begin in range(0, len(seen.u), 2**21):
        marked[tuple(voxel_of(contracted, seen.u[begin : begin + 2**21].astype(np.float64), size).T)] = True
    visible = int(marked.sum())
    for axis in (1, 2, 3):
        wide = marked.copy()
        wide.swapaxes(1, axis)[:, 1:] |= marked.swapaxes(1, axis)[:, :-1]
        wide.swapaxes(1, axis)[:, :-1] |= marked.swapaxes(1, axis)[:, 1:]
        marked = wide
    voxels = np.argwhere(marked)
    density, sh = np.empty(len(voxels), np.float32), np.empty((len(voxels), (m.fine.degree + 1) ** 2, 3), np.float32)
    centre, half = torch.as_tensor(m.space.centre), torch.as_tensor(m.space.half)
    for begin in range(0, len(voxels), 2**15):
        block = voxels[begin : begin + 2**15]
        many = np.repeat(block, POINTS, axis=0)
        point = m.space.grid(torch.from_numpy(world_of(contracted, many, rng.random((len(many), 3)), size)) * half + centre).float()
        raw = m.fine(point)
        valid = m.voxels.values.view(-1)[cell_of(point, m.voxels.side)] > m.voxels.threshold
        middle = m.space.grid(torch.from_numpy(world_of(contracted, block, np.full((len(block), 3), 0.5), size)) * half + centre).float()
        sigma = (activate(raw[:, 0], m.fine.activation) * valid).reshape(len(block), POINTS) * _has_pivots(m, middle)[:, None]
        share = sigma / sigma.sum(dim=1, keepdim=True).clamp(min=1e-12)
        mixed = (raw[:, 1:].reshape(len(block), POINTS, -1) * share[..., None]).sum(dim=1).reshape(len(block), 3, -1)
        density[begin : begin + len(block)], sh[begin : begin + len(block)] = sigma.mean(dim=1).numpy(), mixed.transpose(1, 2).numpy()
    held = density > 0
    index = np.full((grids, *size), -1, np.int32)
    index[tuple(voxels[held].T)] = np.arange(held.sum(), dtype=np.int32)
    blocks = np.zeros((grids, *(size // BLOCK)), bool)
    for step in np.argwhere(np.ones((3, 3, 3), bool)) - 1:
        near = (voxels[held][:, 1:] + step).clip(0, size - 1) // BLOCK
        blocks[(voxels[held][:, 0], *near.T)] = True
    return Grids(contracted, size, index, blocks), density[held], sh[held], {"visible": visible, "stored": int(held.sum())}


def psnr(a: np.ndarray, b: np.ndarray) -> float:
    return -10 * math.log10(float(np.mean((a - b) ** 2)))


def measured(run: Path, resolutions: list[int], test_rays: int, training_rays: int) -> dict[str, Any]:
    from efficientnerf.geometry.cameras import rays
    from efficientnerf.rendering.harmonics import basis_numpy
    from stages.evaluate.views import evaluation_views, ground_truth, stride_for, subsample_camera
    from stages.io.field_file import load_renderer
    from stages.io.scene import load, views_of

    scene, renderer = load(run / "poses"), load_renderer(run / "train")
    m, rng = renderer.model, np.random.Generator(np.random.Philox(key=1))
    tests, _ = evaluation_views(scene)
    stride = stride_for(tests, test_rays)
    truth, drawn, bundles = [], [], []
    for view in tests:
        camera = subsample_camera(view.camera, stride)
        truth.append(ground_truth(run / "poses", view, None).subsampled(stride).colour.reshape(-1, 3))
        drawn.append(renderer.render(camera).colour.reshape(-1, 3))
        y, x = np.mgrid[: camera.height, : camera.width]
        origins, directions = rays(camera, np.stack([x.ravel(), y.ravel()], axis=-1) + 0.5)
        bundles.append((origins, directions, renderer.near / np.maximum(directions @ camera.forward, 1e-3)))
    origins, directions, near = (np.concatenate(part) for part in zip(*bundles, strict=True))
    photographs, network = np.concatenate(truth), np.concatenate(drawn)
    seen = shown(m, renderer, views_of(scene, "train"), rays, training_rays, rng)
    harmonics, behind = basis_numpy(directions, m.fine.degree), m.behind(torch.as_tensor(directions, dtype=torch.float32)).detach().numpy()
    beyond = np.abs(seen.u).max(axis=1) > 1
    rows: list[dict[str, Any]] = []
    for resolution in resolutions:
        for contracted in (False, True):
            begin = time.time()
            grids, density, sh, counts = stored(m, contracted, 2 * float(m.space.half.max()) / resolution, seen, rng)
            colour, opacity, steps = np.zeros_like(directions), np.zeros(len(directions)), np.zeros((len(directions), 3))
            u, du = (origins - m.space.centre) / m.space.half, directions / m.space.half
            march(contracted, grids.size, grids.index, grids.blocks, density, sh, harmonics, u, du, m.space.half, near, colour, opacity, steps)
            colour += (1 - opacity[:, None]) * behind
            within = grids.index[0] if not contracted else grids.index[0][tuple(slice(n // 4, n - n // 4) for n in grids.size)]
            rows.append({
                "grid": "contracted" if contracted else "nested", "resolution": resolution, **counts, "stored_in_box": int((within >= 0).sum()),
                "cells": int(np.prod(grids.index.shape)),
                "psnr_photographs": psnr(colour, photographs), "psnr_network": psnr(colour, network), "steps": float(steps[:, 0].mean()),
                "steps_in_blocks": float(steps[:, 1].mean()), "parts": float(steps[:, 2].mean()), "seconds": time.time() - begin,
            })  # fmt: skip
            print(json.dumps(rows[-1]), flush=True)
            del grids, density, sh
    about = {"run": run.name, "test_rays": len(near), "training_rays": training_rays, "psnr_network_to_photographs": psnr(network, photographs),
             "weight_beyond_the_box": float(seen.weight[beyond].sum() / seen.weight.sum()), "rows": rows}  # fmt: skip
    print(json.dumps({key: value for key, value in about.items() if key != "rows"}))
    return about


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run", type=Path)
    parser.add_argument("--resolutions", default="96,128,192,256")
    parser.add_argument("--test-rays", type=int, default=40_000)
    parser.add_argument("--training-rays", type=int, default=200_000)
    parser.add_argument("--json", type=Path)
    given = parser.parse_args()
    found = measured(given.run, [int(n) for n in given.resolutions.split(",")], given.test_rays, given.training_rays)
    if given.json is not None:
        given.json.write_text(json.dumps(found, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
