"""Packets of rays through a tree on CUDA: losses and gradients against autograd and the CPU's packets, the same sums in any order, and how few they add."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from efficientnerf.asset.cascades import voxel_cascades, voxel_sides
from efficientnerf.asset.refinement import host
from efficientnerf.asset.refinement.fit import optimise
from efficientnerf.asset.refinement.rule import Rule
from efficientnerf.asset.refinement.state import initial_state
from efficientnerf.asset.refinement.targets import Targets
from efficientnerf.asset.tree import NerfTree
from efficientnerf.backends.numba.tree.march import EARLY_STOP
from efficientnerf.backends.numba.tree_training.gradients import RayTargets
from tests.efficientnerf.balls import pixels
from tests.efficientnerf.device import DEVICE
from tests.efficientnerf.refinements import ball_tree, device_gradients, gradients_by_autograd, packet_gradients, seen_at_random
from tests.efficientnerf.trees import nested_rays, random_cascades, random_tree, rays_at, uniform_tree
from tests.efficientnerf.walls import looking_along_y, wall

kernels = pytest.importorskip("efficientnerf.backends.triton.tree_packets")
per_ray = pytest.importorskip("efficientnerf.backends.triton.tree_gradients")
device = pytest.importorskip("efficientnerf.asset.refinement.device")

BENCHMARKS = Path(__file__).resolve().parents[3] / "benchmarks"
SIZES = (16, 5)  # of packets
FIRST = np.cumsum([0, *SIZES])


def fog(brick: int, degree: int, lookup: str, *, whole: bool) -> NerfTree:
    if whole:
        tree = replace(random_cascades(1, count=2, cells=2, brick=brick, degree=degree, share=0.6, lookup=lookup), environment=None)
        return replace(tree, density_values=tree.density_values / 8)
    return random_tree(2, shape=(2, 3, 2), brick=brick, degree=degree, share=0.7, sigma=4.0, lookup=lookup)


def packets(tree: NerfTree, apart: float, spread: float) -> tuple[np.ndarray, np.ndarray]:
    """Rays of packets: so many voxels apart, directions that differ by so much."""
    origins, directions = (a[[0, 1]].repeat(SIZES, axis=0) for a in (nested_rays(tree, 4, 3) if tree.outer else rays_at(tree, 4, 3)))
    rng = np.random.default_rng(1)
    directions = directions + spread * rng.uniform(-1, 1, directions.shape)
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    return origins + apart * tree.voxel * rng.uniform(-1, 1, origins.shape), directions


def on_device(
    tree: NerfTree, origins: np.ndarray, directions: np.ndarray, targets: RayTargets, first: np.ndarray, **more: Any
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Losses, and the gradients of their sum by density and harmonics; the voxels that have some are stamped."""
    rays = device.rays_in_voxels(tree, *(torch.from_numpy(a).to(DEVICE) for a in (origins, directions)))
    grid, density, sh = device.values_of(tree, torch.device(DEVICE))
    sent = RayTargets(*(torch.from_numpy(np.asarray(part, np.float32)).to(DEVICE) for part in targets[:4]), targets.opacity_weight)
    sums = torch.zeros(density.shape, dtype=torch.int64, device=DEVICE), torch.zeros(sh.shape, dtype=torch.int64, device=DEVICE)
    stamp = torch.zeros(len(density), dtype=torch.int32, device=DEVICE)
    loss = kernels.loss_and_gradients(grid, torch.from_numpy(first).to(DEVICE), rays, density, sh, sent, sums, stamp, 3, **more)
    by_thickness, by_sh = (part.cpu().double().numpy() / per_ray.fixed_point_scale(len(origins)) for part in sums)
    assert set(stamp.tolist()) <= {0, 3}
    assert not (by_sh.any(axis=1) & (stamp.cpu().numpy() != 3)).any()
    return loss.cpu().numpy(), by_thickness * voxel_sides(tree), by_sh.reshape(tree.sh.shape)


def close(found: tuple[np.ndarray, ...], wanted: tuple[np.ndarray, ...], much: float, share: float) -> None:
    """A sample at a face of a voxel, or a weight at its bound, may lie on the other side in float32: so may a share of the values."""
    for ours, theirs in zip(found, wanted, strict=True):
        assert (np.abs(ours - theirs) > much * np.abs(theirs).max()).mean() <= share


@pytest.mark.parametrize(("brick", "degree", "lookup", "whole"), [(1, 0, "trilinear", True), (2, 4, "trilinear", False), (2, 2, "nearest", True)])
def test_packets_of_parallel_rays_have_the_gradients_of_autograd(brick: int, degree: int, lookup: str, *, whole: bool) -> None:
    tree = fog(brick, degree, lookup, whole=whole)
    origins, directions = packets(tree, 1.5, 0.0)
    seen = seen_at_random(len(origins), 0.7)
    found, wanted = on_device(tree, origins, directions, seen, FIRST), gradients_by_autograd(tree, origins, directions, seen)
    close(found, wanted, 5e-4, 0.03)
    for n in range(1 + len(tree.outer)):
        assert (found[1][voxel_cascades(tree) == n] != 0).any()


@pytest.mark.parametrize("more", [{}, {"min_weight": 0.01}, {"terms": 4}], ids=["all", "min_weight", "terms"])
def test_packets_of_rays_that_spread_have_the_gradients_of_the_cpu(more: dict[str, Any]) -> None:
    """By the mean of their harmonics, which is not those of any ray."""
    tree = fog(2, 2, "trilinear", whole=False)
    origins, directions = packets(tree, 1.0, 0.1)
    seen = seen_at_random(len(origins), 0.3)
    found = on_device(tree, origins, directions, seen, FIRST, **more)
    wanted = packet_gradients(tree, origins, directions, seen, FIRST, stop=EARLY_STOP, min_weight=more.get("min_weight", 0.0))
    wanted[2][:, more.get("terms", 9) :] = 0
    close(found, wanted, 5e-4, 0.01)
    exact = gradients_by_autograd(tree, origins, directions, seen)
    assert np.abs(found[0] - exact[0]).max() > 1e-3
    assert np.abs(found[1] - exact[1]).max() < 0.2 * np.abs(exact[1]).max() or more


def test_in_normalised_device_coordinates_too() -> None:
    tree = wall(0.2, voxels=24, hard=0.05)
    pose = looking_along_y()
    rng = np.random.default_rng(0)
    directions = np.concatenate([np.array([lead]) + 0.01 * rng.uniform(-1, 1, (n, 3)) for lead, n in zip(([0.1, 1, 0.1], [-0.2, 1, 0.05]), SIZES, strict=True)])
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    origins = np.repeat(pose[None, :3, 3], len(directions), axis=0)
    seen = seen_at_random(len(origins), 0.4)
    found = on_device(tree, origins, directions, seen, FIRST)
    wanted = packet_gradients(tree, origins, directions, seen, FIRST, stop=EARLY_STOP)
    close(found, wanted, 1e-3, 0.02)
    assert (found[1] != 0).sum() > 50


def test_sums_do_not_depend_on_the_order_of_the_packets() -> None:
    tree = fog(2, 1, "trilinear", whole=False)
    origins, directions = packets(tree, 1.0, 0.05)
    seen = seen_at_random(len(origins), 0.3, np.float32)
    found = on_device(tree, origins, directions, seen, FIRST)
    order = np.roll(np.arange(len(origins)), -SIZES[0])
    turned = RayTargets(*(part[order] for part in seen[:4]), seen.opacity_weight)
    again = on_device(tree, origins[order], directions[order], turned, np.cumsum([0, *SIZES[::-1]]))
    np.testing.assert_array_equal(again[0], found[0][order])
    for a, b in zip(found[1:], again[1:], strict=True):
        np.testing.assert_array_equal(a, b)


def test_no_packets_and_packets_beside_the_tree_have_no_gradient() -> None:
    tree = fog(2, 1, "trilinear", whole=False)
    none = np.zeros((0, 3))
    for part in on_device(tree, none, none, seen_at_random(0, 0.0), np.zeros(1, np.int64)):
        assert not part.any()
    origins, directions = packets(tree, 1.0, 0.0)
    loss, *by = on_device(tree, origins + 100.0, directions, seen_at_random(len(origins), 0.2), FIRST)
    assert loss.all()
    assert not any(part.any() for part in by)


@contextmanager
def counted_additions() -> Iterator[list[int]]:
    """Numbers that are added to memory by atomic operations, by each of these."""
    from triton.runtime.interpreter import InterpreterBuilder as Builder

    found: list[int] = []
    add = Builder.create_atomic_rmw

    def create_atomic_rmw(self: Any, kind: Any, at: Any, value: Any, mask: Any, *more: Any) -> Any:
        found.append(int(mask.data.sum()))
        return add(self, kind, at, value, mask, *more)

    Builder.create_atomic_rmw = create_atomic_rmw
    try:
        yield found
    finally:
        Builder.create_atomic_rmw = add


@pytest.mark.skipif(DEVICE != "cpu", reason="counts in the interpreter")
def test_a_voxel_that_rays_share_is_added_once_or_little_more() -> None:
    tree = uniform_tree((2, 2, 2), brick=2, sigma=3.0)
    x, y = np.meshgrid(np.arange(4), np.arange(4))
    middle = (tree.bounds_min + tree.bounds_max) / 2
    origins = middle + np.stack([0.5 * tree.voxel * (x.ravel() - 1.3), 0.5 * tree.voxel * (y.ravel() - 1.4), np.full(16, -3.0)], axis=1)
    directions = np.tile(np.array([0.2, 0.1, 1.0]) / np.linalg.norm([0.2, 0.1, 1.0]), (16, 1))
    origins -= 3 * (directions - [0, 0, 1])
    seen = seen_at_random(16, 0.3)
    with counted_additions() as few:
        found = on_device(tree, origins, directions, seen, np.array([0, 16]))
    with counted_additions() as many:
        device_gradients(tree, origins, directions, seen, DEVICE)
    met = (found[1] != 0).sum()
    assert met > 30
    assert 4 * met <= sum(few) < 1.3 * 4 * met  # three channels of one harmonic, and density
    assert sum(few) < sum(many) / 8


def test_large_packets_are_cut() -> None:
    first = np.array([0, 16, 49, 50, 82])
    np.testing.assert_array_equal(device.packets_within(first, 16), [0, 16, 32, 48, 49, 50, 66, 82])
    np.testing.assert_array_equal(device.packets_within(first, 64), first)
    np.testing.assert_array_equal(device.packets_within(np.zeros(1, np.int64), 16), [0])


def test_steps_of_narrow_patches_are_those_of_the_cpu(monkeypatch: pytest.MonkeyPatch) -> None:
    rule = Rule(total_variation=0.03, min_weight=2e-3, degree=lambda step: int(step > 1))
    for module in (host, device):
        monkeypatch.setattr(module, "MAX_PACKET_ANGLE", 10.0)
    tree = ball_tree(8)
    tree = replace(tree, harmonics=np.random.default_rng(0).normal(size=tree.sh.shape).astype(np.float32))
    targets = Targets(pixels(6, 16), (1.0, 1.0, 1.0))
    states = [initial_state(tree) for _ in range(2)]
    for state, each in zip(states, (targets, targets.sent(DEVICE)), strict=True):
        assert len(list(optimise(state, each, until=2, rays=8, density_lr=0.3, sh_lr=0.05, fall=lambda _: 0.5, seed=1, rule=rule))) == 2
        state.fetch()
    assert len(np.unique(states[0].visits)) > 1
    assert (states[0].visits == states[1].visits).mean() > 0.99
    for name in ("density", "sh", "square_density", "square_sh"):
        close((getattr(states[1], name),), (getattr(states[0], name),), 1e-3, 0.02)


def test_the_benchmark_of_packets_counts_what_they_meet(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(str(BENCHMARKS))
    import gpu_kernels
    import gpu_tree

    monkeypatch.setattr(gpu_tree, "milliseconds", lambda run, device, repeats: run() or 0.5)
    found = gpu_tree.tree_rates(DEVICE, gpu_kernels.shell(8, 0), 16, 2, 2, 1, 1)
    assert found["rays"] == 32
    assert 0 < found["voxels_met"] <= found["voxels_of_packets_per_ray"] * 32
    assert found["voxels_met"] < found["voxels"]
    assert found["rays_per_second"] == {"ray_by_ray": 64000, "packets": 64000}
    assert found["floor_rays_per_second"] > 0


@pytest.mark.gpu
def test_packets_on_a_device_have_the_gradients_of_the_cpu() -> None:
    if not torch.cuda.is_available():
        pytest.skip("no CUDA device")
    for tree in (random_tree(3, shape=(8, 8, 8), brick=4, degree=2, share=0.5, sigma=5.0), random_cascades(3, cells=8, brick=4, degree=3)):
        tree = replace(tree, environment=None)
        lead = nested_rays(tree, 500) if tree.outer else rays_at(tree, 500)
        rng = np.random.default_rng(0)
        sizes = rng.integers(1, 17, 500)
        origins, directions = (a.repeat(sizes, axis=0) for a in lead)
        directions = directions + 0.01 * rng.uniform(-1, 1, directions.shape)
        directions /= np.linalg.norm(directions, axis=1, keepdims=True)
        seen, first = seen_at_random(len(origins), 0.3), np.cumsum([0, *sizes])
        found = on_device(tree, origins, directions, seen, first)
        close(found, packet_gradients(tree, origins, directions, seen, first, stop=EARLY_STOP), 2e-3, 0.03)
        for a, b in zip(found, on_device(tree, origins, directions, seen, first), strict=True):
            np.testing.assert_array_equal(a, b)
