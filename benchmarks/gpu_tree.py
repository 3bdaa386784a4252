"""The part *trees* of benchmarks/gpu.py: losses and gradients of a tree's rays, and a step. Sizes are arguments."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from gpu_kernels import copy_rate, milliseconds, orbit

from efficientnerf.asset.refinement import device as refinement
from efficientnerf.asset.refinement.host import in_voxels, packet_bases
from efficientnerf.asset.refinement.targets import STRUCTURE
from efficientnerf.asset.tree import NerfTree
from efficientnerf.backends.layout import Hyperparameters, Moments, RayTargets
from efficientnerf.backends.numba.tree.cells import cells_of, dense_densities, voxel_places
from efficientnerf.backends.numba.tree_training import gradients
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


def voxels_met(tree: NerfTree, origins: np.ndarray, directions: np.ndarray, targets: RayTargets, first: np.ndarray) -> tuple[int, int]:
    """How many voxels packets meet, summed over the packets, and how many all do."""
    start, along, bases = in_voxels(tree, origins, directions)
    cells, sh = cells_of(tree), tree.sh.reshape(len(tree.sh), -1)
    dense = dense_densities(cells, voxel_places(cells, len(sh)), tree.density_values)
    _, records = gradients.forward_backward(cells, first, start, along, packet_bases(bases, first), dense, sh, targets, gradients.RecordBuffer())
    found = [records.numbers[begin:end, 0] for begin, end in zip(records.begin[:, 0], records.begin[:, -1], strict=True)]
    return sum(map(len, found)), len(np.unique(np.concatenate(found)))


def tree_rates(device: str, tree: NerfTree, side: int, views: int, patches: int, repeats: int, mebibytes: int) -> dict[str, Any]:
    """Rays a second of losses with gradients, and with a step; beside what a copy within the device's memory allows.

    The floor counts bytes: of each voxel that a patch meets its density and harmonics are read and its sums read and written; of each that is met at all a
    step reads and writes values and sums. mebibytes: of the copy.
    """
    origins, directions = patch_rays(tree, side, views, patches)
    count, rng = len(origins), np.random.default_rng(1)
    first = np.arange(0, count + 1, PATCH_SIDE**2)
    host = RayTargets(*(rng.random(shape).astype(np.float32) for shape in ((count, 3), (count, 3), count, count)), 0.25)
    there = [torch.from_numpy(a).to(device) for a in (origins, directions, *host[:4])]
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

    of_packets, of_all = voxels_met(tree, origins, directions, host, first)
    width, rate = 3 * grid.terms, copy_rate(device, mebibytes, repeats)
    each = {"gradients": of_packets * (4 * (width + 1) + 16 * (width + 1)), "step": of_all * (8 * (width + 4) + 16 * (width + 1))}
    jobs: list[tuple[str, Callable[[], None]]] = [("gradients", loss_gradients), ("step", step)]
    took = {name: milliseconds(job, device, repeats) for name, job in jobs}
    floor = {name: some / rate / 1e6 for name, some in each.items()}  # milliseconds
    return {
        "voxels": len(density), "rays": count, "voxels_of_patches_per_ray": round(of_packets / count, 2), "voxels_met": of_all,
        "ms": {name: round(some, 4) for name, some in took.items()}, "floor_ms": {name: round(some, 4) for name, some in floor.items()},
        "rays_per_second": round(1e3 * count / took["gradients"]), "rays_per_second_with_step": round(1e3 * count / sum(took.values())),
        "floor_rays_per_second": round(1e3 * count / sum(floor.values())),
    }  # fmt: skip
