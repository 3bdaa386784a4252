"""Gradients of a rendered tree's loss, by autograd and by the kernels."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import torch

from efficientnerf.asset.cascades import voxel_cascades, voxel_coordinates, voxel_sides
from efficientnerf.asset.refinement.host import in_voxels, packet_bases
from efficientnerf.asset.refinement.state import RefinementState
from efficientnerf.asset.tree import NerfTree
from efficientnerf.backends.layout import EARLY_STOP, Hyperparameters, Moments, RayTargets
from efficientnerf.backends.numba.tree.cells import cells_of, dense_densities, voxel_places
from efficientnerf.backends.numba.tree_training import gradients as kernels
from efficientnerf.backends.numba.tree_training.gradients import RecordBuffer, Records, packets_of
from efficientnerf.backends.numba.tree_training.steps import values_of
from tests.efficientnerf.balls import BOUNDS
from tests.efficientnerf.tree_reference import render_reference
from tests.efficientnerf.trees import random_cascades, random_tree, rays_at, uniform_tree


def seen_at_random(count: int, matte: float, dtype: Any = np.float64) -> RayTargets:
    rng = np.random.default_rng(5)
    shapes: tuple[Any, ...] = ((count, 3), (count, 3), count, count)
    return RayTargets(*(rng.random(shape).astype(dtype) for shape in shapes), matte)


def loss_by_torch(colour: torch.Tensor, opacity: torch.Tensor, seen: RayTargets) -> torch.Tensor:
    truth, behind, gain, matte = (torch.from_numpy(a).double() for a in (seen.colour, seen.background, seen.transmittance, seen.opacity))
    off = gain[:, None] * (colour + (1 - opacity)[:, None] * behind) - truth
    return (off**2).sum(dim=1) + seen.opacity_weight * (opacity - matte) ** 2


def dissimilarity_by_torch(colour: torch.Tensor, opacity: torch.Tensor, seen: RayTargets) -> torch.Tensor:
    """Sum of 1 - SSIM over rays and channels, of patches of 16 rays each."""
    truth, behind, gain = (torch.from_numpy(a).double() for a in (seen.colour, seen.background, seen.transmittance))
    x, y = (part[: len(part) // 16 * 16].reshape(-1, 16, 3) for part in (gain[:, None] * (colour + (1 - opacity)[:, None] * behind), truth))
    of_x, of_y = x.mean(1, keepdim=True), y.mean(1, keepdim=True)
    covariance, variances = ((x - of_x) * (y - of_y)).mean(1), ((x - of_x) ** 2 + (y - of_y) ** 2).mean(1)
    means = (2 * of_x * of_y + 0.01**2) / (of_x**2 + of_y**2 + 0.01**2)
    return 16 * (1 - means[:, 0] * (2 * covariance + 0.03**2) / (variances + 0.03**2)).sum()


def gradients_by_autograd(tree: NerfTree, origins: np.ndarray, directions: np.ndarray, seen: RayTargets) -> tuple[np.ndarray, ...]:
    """What `gradients` gives, by torch's reference in float64; patches are of 16 rays each."""
    density, sh = (torch.from_numpy(a).double().requires_grad_() for a in (tree.density_values, tree.sh))
    rendered = render_reference(tree, torch.from_numpy(origins), torch.from_numpy(directions), density, sh)
    loss = loss_by_torch(*rendered, seen)
    (loss.sum() + seen.structure * dissimilarity_by_torch(*rendered, seen)).backward()
    return loss.detach().numpy(), density.grad.numpy(), sh.grad.numpy()


def gradients(
    tree: NerfTree, origins: np.ndarray, directions: np.ndarray, seen: RayTargets, dtype: Any = np.float64, stop: float = 0.0, packet: int = 1,
) -> tuple[np.ndarray, ...]:  # fmt: skip
    """Loss of each ray, and the gradients of their sum by density and harmonics, from the kernels, in packets of so many rays."""
    return packet_gradients(tree, origins, directions, seen, packets_of(len(origins), packet), dtype, stop)


def packet_gradients(
    tree: NerfTree, origins: np.ndarray, directions: np.ndarray, seen: RayTargets, first: np.ndarray, dtype: Any = np.float64, stop: float = 0.0,
) -> tuple[np.ndarray, ...]:  # fmt: skip
    """`gradients` of packets whose first rays, and the end, are (P + 1,)."""
    start, along, bases = in_voxels(tree, origins, directions)
    density, sh = tree.density_values.astype(dtype), tree.sh.reshape(len(tree.sh), -1).astype(dtype)
    cells = cells_of(tree)
    dense = dense_densities(cells, voxel_places(cells, len(sh)), density)
    loss, records = kernels.forward_backward(
        cells, first, start, along, packet_bases(bases.astype(dtype), first), dense, sh, seen, RecordBuffer(dtype), stop=stop,
    )  # fmt: skip
    by_density, by_sh = np.zeros_like(density), np.zeros_like(sh)
    sum_gradients(records, by_density, by_sh)
    return loss, by_density, by_sh.reshape(tree.sh.shape)


def sum_gradients(records: Records, grad_density: np.ndarray, grad_sh: np.ndarray) -> None:
    """Add the gradients of the summed loss with respect to density (N,) and sh (N, 3 K)."""
    terms = grad_sh.shape[1] // 3
    for slab in range(records.begin.shape[1] - 1):
        for begin, end in records.begin[:, slab : slab + 2]:
            voxel, packet = records.numbers[begin:end].T
            gradient = records.gradient[begin:end]
            np.add.at(grad_density, voxel, gradient[:, 3])
            np.add.at(grad_sh, voxel, (records.basis[packet, :terms, None] * gradient[:, None, :3]).reshape(-1, 3 * terms))


def ball_tree(side: int = 20) -> NerfTree:
    """Fog of one grey all over the box of the ball's pictures."""
    tree = uniform_tree((side // 4,) * 3, voxel=2 / side, sigma=0.5, logit=0.0)
    sh = np.zeros((len(tree.density_values), 4, 3), np.float32)
    return replace(tree, bounds_min=BOUNDS[0], harmonics=sh, background=(1.0, 1.0, 1.0))


def device_gradients(tree: NerfTree, origins: np.ndarray, directions: np.ndarray, targets: RayTargets, device: str) -> tuple[np.ndarray, ...]:
    """`gradients` by Triton's kernels, and the voxels that rays meet are stamped."""
    from efficientnerf.asset.refinement.device import rays_in_voxels, values_of, windows_of
    from efficientnerf.backends.triton import tree_gradients

    rays = rays_in_voxels(tree, *(torch.from_numpy(a).to(device) for a in (origins, directions)))
    grid, density, sh = values_of(tree, torch.device(device))
    outputs = tree_gradients.forward(grid, rays, density, sh)
    sent = RayTargets(*(torch.from_numpy(np.asarray(part, np.float32)).to(device) for part in targets[:4]), targets.opacity_weight, targets.structure)
    loss, *by = tree_gradients.loss_and_gradients(*outputs, sent, windows_of(packets_of(len(origins), 16), torch.device(device)))
    sums = torch.zeros(density.shape, dtype=torch.int64, device=device), torch.zeros(sh.shape, dtype=torch.int64, device=device)
    stamp = torch.zeros(len(density), dtype=torch.int32, device=device)
    tree_gradients.backward(grid, rays, density, sh, outputs, (by[0], by[1]), sums, stamp, 3)
    by_thickness, by_sh = (part.cpu().double().numpy() / tree_gradients.fixed_point_scale(len(origins)) for part in sums)
    assert set(stamp.tolist()) <= {0, 3}
    assert not (by_sh.any(axis=1) & (stamp.cpu().numpy() != 3)).any()
    return loss.cpu().numpy(), by_thickness * voxel_sides(tree), by_sh.reshape(tree.sh.shape)


def records_of(tree: NerfTree, state: RefinementState, seed: int, packet: int = 4) -> Records:
    origins, directions = rays_at(tree, 100, seed=seed)
    seen = seen_at_random(100, 0.2, np.float32)
    start, along, bases = in_voxels(tree, origins, directions)
    first = packets_of(100, packet)
    cells, basis = cells_of(tree), packet_bases(bases, first)
    values = values_of(cells, state.density, state.sh)
    return kernels.forward_backward(cells, first, start, along, basis, values.dense, values.sh, seen, RecordBuffer(), stop=EARLY_STOP)[1]


def neighbours_by_place(tree: NerfTree) -> np.ndarray:
    """(N, 6) the voxels of the same cascade beyond the faces -x, x, -y, y, -z, z of each, -1 where none is stored."""
    at = np.concatenate([voxel_coordinates(tree), voxel_cascades(tree)[:, None]], axis=1)
    number = {tuple(place): n for n, place in enumerate(at.tolist())}
    steps = [way * np.eye(4, dtype=int)[axis] for axis in range(3) for way in (-1, 1)]
    return np.array([[number.get(tuple((place + step).tolist()), -1) for step in steps] for place in at])


def moments_of(state: RefinementState) -> Moments:
    return Moments(state.square_density, state.square_sh, state.visits)


def rule_of(**more: Any) -> Hyperparameters:
    return Hyperparameters(0.1, 0.01, 0.5, 0.9, 1e-12, **more)


GRIDS: list[Callable[[], NerfTree]] = [lambda: random_tree(4, brick=2, degree=1), lambda: random_cascades(4, brick=2)]
