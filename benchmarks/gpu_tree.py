"""The part *trees* of benchmarks/gpu.py: losses and gradients of a tree's rays, and a step. Sizes are arguments."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from gpu_kernels import milliseconds, orbit

from efficientnerf.asset.refinement import device as refinement
from efficientnerf.asset.refinement.targets import STRUCTURE
from efficientnerf.asset.tree import NerfTree
from efficientnerf.backends.layout import Hyperparameters, Moments, RayTargets
from efficientnerf.backends.triton import tree_gradients, tree_steps
from efficientnerf.geometry.cameras import rays

PATCH_SIDE = 4


def patch_rays(tree: NerfTree, side: int, views: int, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Origins and directions of `count` random patches of pixels that look at the middle of the tree, from an orbit of images of side x side pixels."""
    rng, cameras = np.random.default_rng(0), orbit(side, views)
    middle, reach = (tree.bounds_min + tree.bounds_max) / 2, float((tree.bounds_max - tree.bounds_min).min() / 2)
    seen = [rays(camera) for camera in cameras]
    corners = []
    for number, (origins, directions) in enumerate(seen):
        near = np.linalg.norm(np.cross(directions, middle - origins), axis=1).reshape(side, side)[::PATCH_SIDE, ::PATCH_SIDE]
        low = PATCH_SIDE * np.argwhere(near < 0.75 * reach)
        low = low[(low <= side - PATCH_SIDE).all(axis=1)]
        corners.append(np.concatenate([np.full((len(low), 1), number), low], axis=1))
    chosen = rng.choice(np.concatenate(corners), count)
    step = np.arange(PATCH_SIDE)
    at = ((chosen[:, 1, None] + step)[:, :, None] * side + (chosen[:, 2, None] + step)[:, None]).reshape(count, -1)
    parts = [np.stack([seen[view][n] for view in range(views)])[chosen[:, :1], at].reshape(-1, 3) for n in range(2)]
    return parts[0], parts[1]


def tree_rates(device: str, tree: NerfTree, side: int, views: int, patches: int, repeats: int) -> dict[str, Any]:
    """Rays a second of losses with gradients, and with a step."""
    origins, directions = patch_rays(tree, side, views, patches)
    count, rng = len(origins), np.random.default_rng(1)
    first = np.arange(0, count + 1, PATCH_SIDE**2)
    goals = [rng.random(shape).astype(np.float32) for shape in ((count, 3), (count, 3), count, count)]
    there = [torch.from_numpy(a).to(device) for a in (origins, directions, *goals)]
    sent, targets = refinement.rays_in_voxels(tree, there[0], there[1]), RayTargets(*there[2:], 0.25, STRUCTURE)
    windows = refinement.windows_of(first, torch.device(device))
    grid, density, sh = refinement.values_of(tree, torch.device(device))
    sums = torch.zeros(density.shape, dtype=torch.int64, device=device), torch.zeros(sh.shape, dtype=torch.int64, device=device)
    stamp, none = torch.zeros(len(density), dtype=torch.int32, device=device), torch.zeros(0, device=device)
    moments = Moments(torch.zeros_like(density), torch.zeros_like(density), torch.zeros_like(stamp))
    neighbours = tree_steps.Neighbours(none, torch.zeros(0, 6, dtype=torch.int32, device=device))

    def loss_gradients() -> None:
        outputs = tree_gradients.forward(grid, sent, density, sh)
        _, *by = tree_gradients.loss_and_gradients(*outputs, targets, windows)
        tree_gradients.backward(grid, sent, density, sh, outputs, (by[0], by[1]), sums, stamp, 1)

    def step() -> None:  # of no length, so that every repetition does the same
        rule = Hyperparameters(0.0, 0.0, 1.0)
        tree_steps.step(grid, (density, sh), sums, moments, stamp, rule, neighbours, number=1, rays=count)

    took = {"gradients": milliseconds(loss_gradients, device, repeats), "step": milliseconds(step, device, repeats)}
    return {
        "voxels": len(density), "rays": count, "ms": {name: round(some, 4) for name, some in took.items()},
        "rays_per_second": round(1e3 * count / took["gradients"]), "rays_per_second_with_step": round(1e3 * count / sum(took.values())),
    }  # fmt: skip
