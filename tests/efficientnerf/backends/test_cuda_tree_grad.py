"""The fit of baked values by the CUDA kernels against torch's autograd and the CPU kernel."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch

from efficientnerf.asset.cascades import cascade_grids, nested, voxel_cascades
from efficientnerf.asset.refinement.error_map import ErrorMap
from efficientnerf.asset.refinement.fit import error, max_weights, optimise
from efficientnerf.asset.refinement.state import STATE, RefinementState, initial_state
from efficientnerf.asset.refinement.targets import Targets
from efficientnerf.asset.tree import NerfTree
from efficientnerf.backends.layout import RayTargets
from efficientnerf.geometry.cameras import Camera
from efficientnerf.training.device_pixels import DevicePixels
from efficientnerf.training.patches import PatchGrid
from efficientnerf.training.pixels import Pixels
from tests.efficientnerf.balls import BOUNDS, cameras, photograph, pixels
from tests.efficientnerf.device import DEVICE
from tests.efficientnerf.refinements import ball_tree, device_gradients, gradients_by_autograd, neighbours_by_place, seen_at_random
from tests.efficientnerf.trees import nested_rays, random_cascades, random_tree, rays_at, uniform_tree
from tests.efficientnerf.walls import camera_at, wall

kernels = pytest.importorskip("efficientnerf.backends.triton.tree_gradients")
device = pytest.importorskip("efficientnerf.asset.refinement.device")


@pytest.mark.parametrize(("brick", "degree", "opacity_weight"), [(1, 0, 0.7), (4, 2, 0.0), (2, 3, 0.25)])
def test_values_and_gradients_are_those_of_autograd(brick: int, degree: int, opacity_weight: float) -> None:
    # Rays that stop early or run along a voxel's face depart from the exact sums: low densities, and rays at no angle of the grid.
    tree = random_tree(brick, brick=brick, degree=degree, sigma=4.0)
    origins, directions = (a[np.arange(100) % 4 != 2] for a in rays_at(tree, 100))
    seen = seen_at_random(len(origins), opacity_weight)._replace(structure=0.1)
    found, wanted = device_gradients(tree, origins, directions, seen, DEVICE), gradients_by_autograd(tree, origins, directions, seen)
    np.testing.assert_allclose(found[0], wanted[0], atol=2e-5)
    for ours, theirs in zip(found[1:], wanted[1:], strict=True):
        off, scale = np.abs(ours - theirs), np.abs(theirs).max()
        assert off.max() < 2e-4 * scale
        assert (off > 1e-4 * scale).mean() < 0.02  # in float32 a sample may lie in the voxel on the other side of a face
    assert (found[1] != 0).mean() > 0.15


@pytest.mark.parametrize(("count", "brick", "degree", "lookup"), [(3, 3, 1, "trilinear"), (3, 2, 1, "nearest")])
def test_values_and_gradients_through_cascades_are_those_of_autograd(count: int, brick: int, degree: int, lookup: str) -> None:
    tree = replace(random_cascades(count, count=count, brick=brick, degree=degree, lookup=lookup), environment=None)
    tree = replace(tree, density_values=tree.density_values / 8)
    origins, directions = (a[np.arange(80) % 4 != 3] for a in nested_rays(tree, 80))
    seen = seen_at_random(len(origins), 0.4)
    found, wanted = device_gradients(tree, origins, directions, seen, DEVICE), gradients_by_autograd(tree, origins, directions, seen)
    # A sample at a face of a voxel, or at the end of its part, may lie on the other side in float32.
    assert (np.abs(found[0] - wanted[0]) > 2e-4).mean() < (0.1 if lookup == "nearest" else 0.03)
    for ours, theirs in zip(found[1:], wanted[1:], strict=True):
        off, scale = np.abs(ours - theirs), np.abs(theirs).max()
        assert (off > 2e-3 * scale).mean() < 0.02
    for n in range(count):
        assert (found[1][voxel_cascades(tree) == n] != 0).mean() > 0.1


def test_sums_do_not_depend_on_the_order_of_the_rays() -> None:
    tree = random_tree(4, brick=2, degree=1, share=0.6)
    origins, directions = rays_at(tree, 40)
    seen = seen_at_random(40, 0.3, np.float32)
    _, by_density, by_sh = device_gradients(tree, origins, directions, seen, DEVICE)
    order = np.random.default_rng(0).permutation(40)
    again = device_gradients(tree, origins[order], directions[order], RayTargets(*(part[order] for part in seen[:4]), seen.opacity_weight), DEVICE)
    assert np.array_equal(by_density, again[1])
    assert np.array_equal(by_sh, again[2])


def test_sums_of_the_most_rays_cannot_overflow() -> None:
    """The greatest gradients there are: full light through low density onto a pixel that is off by 2, all on one voxel."""
    for rays in (1, 32768, 2**22):
        assert 25.0 * 7 * rays * kernels.fixed_point_scale(rays) < 2**62.5
        assert kernels.fixed_point_scale(rays) >= 2**32
    tree = uniform_tree((1, 1, 1), brick=1, sigma=1e-3, logit=0.0)
    count = 500
    middle = (tree.bounds_min + tree.bounds_max) / 2
    origins = np.tile(middle - [0, 0, 2.0], (count, 1))
    directions = np.tile([0.0, 0, 1], (count, 1))
    seen = RayTargets(np.full((count, 3), -1.0), np.ones((count, 3)), np.ones(count), np.ones(count), 0.25)
    _, by_density, _ = device_gradients(tree, origins, directions, seen, DEVICE)
    per_ray = by_density[0] / tree.voxel / count
    assert -25 < per_ray < -4


def test_an_empty_tree_and_rays_beside_it_have_no_gradient() -> None:
    tree = random_tree(1, brick=2)
    origins, directions = rays_at(tree, 40)
    away = origins + 100.0
    loss, by_density, by_sh = device_gradients(tree, away, directions, seen_at_random(40, 0.0), DEVICE)
    assert not by_density.any()
    assert not by_sh.any()
    assert (loss > 0).any()
    bare = replace(
        tree, brick_index=np.full_like(tree.brick_index, -1), voxel_index=tree.voxel_index[:0], density_values=tree.density_values[:0], harmonics=tree.sh[:0]
    )
    assert (device_gradients(bare, origins, directions, seen_at_random(40, 0.0), DEVICE)[0] > 0).any()


def fitted(
    targets: Targets, tree: NerfTree, until: list[int], rays: int = 16, steps: int = 3, total_variation: float = 0.0
) -> tuple[RefinementState, list[float]]:
    """Steps in one go, or in several with the state fetched in between, as a checkpoint does."""
    o = initial_state(tree)
    errors: list[float] = []
    for end in until:
        errors += optimise(o, targets, until=end, rays=rays, density_lr=0.3, sh_lr=0.05, fall=lambda step: 0.1 ** (step / steps),
                           seed=1, view_dependent_lr_ratio=0.5,
                           total_variation=total_variation)  # fmt: skip
        o.fetch()
    return o, errors


def nested_balls() -> NerfTree:
    """Thin fog in two cascades, of which the outer one reaches round the ball of the pictures."""
    grids = cascade_grids(np.stack([np.full(3, -0.4), np.full(3, 0.4)]), 0.2, 1, 2)
    trees = [replace(uniform_tree(s, brick=1, voxel=v, sigma=0.5), bounds_min=low, background=(1.0, 1.0, 1.0)) for s, v, low in grids]
    tree = nested(trees)
    return replace(tree, harmonics=np.zeros((len(tree.density_values), 4, 3), np.float32))


@pytest.mark.parametrize(("tree", "total_variation"), [(ball_tree(8), 0.0), (nested_balls(), 0.03)], ids=["one grid", "cascades"])
def test_steps_are_those_of_the_cpu(tree: NerfTree, total_variation: float) -> None:
    """From colours that are no pixel's: where an error is next to nothing its rounding would show, for steps are of one length."""
    tree = replace(tree, harmonics=np.random.default_rng(0).normal(size=tree.sh.shape).astype(np.float32))
    on_host = Targets(pixels(6, 16), (1.0, 1.0, 1.0))
    on_device = on_host.sent(DEVICE)
    assert on_device.on_device
    ours, errors = fitted(on_device, tree, [3], total_variation=total_variation)
    theirs, wanted = fitted(on_host, tree, [3], total_variation=total_variation)
    assert (ours.visits == theirs.visits).mean() > 0.99
    assert len(np.unique(theirs.visits)) > 2
    for name in ("density", "sh", "square_density", "square_sh"):
        a, b = getattr(ours, name), getattr(theirs, name)
        assert (np.abs(a - b) > 1e-3 * np.abs(b) + 1e-3 * np.abs(b).max()).mean() < 0.02, name
    assert errors[0] == pytest.approx(wanted[0], rel=1e-5)
    assert errors == [errors[0]] * 3  # nothing later has arrived
    assert error(ours.result(), on_device, 60, 0) == pytest.approx(error(theirs.result(), on_host, 60, 0), rel=1e-2)


@pytest.mark.parametrize("tree", [random_tree(2), random_tree(3, brick=1), nested_balls()], ids=["one", "bricks of one voxel", "cascades"])
def test_voxels_beside_are_a_step_away(tree: NerfTree) -> None:
    np.testing.assert_array_equal(device.voxels_beside(tree), neighbours_by_place(tree))


def test_interrupted_or_not_the_bytes_are_the_same() -> None:
    targets = Targets(pixels(6, 16), (1.0, 1.0, 1.0)).sent(DEVICE)
    whole, apart = (fitted(targets, ball_tree(4), until)[0] for until in ([3], [1, 3]))
    for name in STATE:
        assert np.array_equal(getattr(whole, name), getattr(apart, name)), name


def test_the_room_that_a_fit_takes_is_known_before() -> None:
    from stages.bake.memory import needed_on_device

    tree = random_tree(4, shape=(5, 5, 5), brick=4, degree=2, share=0.5)
    errors = ErrorMap(PatchGrid(pixels(2, 8), 4))
    arrays = device.Steps(initial_state(tree), torch.device(DEVICE), errors, smooth=True)
    tensors = [*arrays.values.values(), *arrays.neighbours, arrays.by_thickness, arrays.by_sh, arrays.stamp, arrays.grid.index, arrays.grid.cascades.owner]
    taken = sum(t.numel() * t.element_size() for t in tensors)
    # The grid is there once then; three times while it is sent.
    needed = needed_on_device(len(tree.density_values), 9, len(tree.voxel_index), tree.brick_index.size, 4, smooth=True)
    assert needed == taken + 8 * tree.brick_index.size
    nest = device.Steps(initial_state(random_cascades(4)), torch.device(DEVICE), errors).grid
    assert nest.cascades.owner.numel() == 3 * 4**3
    assert len(nest.cascade_of) == len(random_cascades(4).density_values)


@pytest.mark.parametrize("tree", [
    replace(random_tree(4, shape=(5, 5, 5), brick=4, degree=1, share=0.5, sigma=20.0), voxel=2 / 20, bounds_min=BOUNDS[0]), nested_balls(),
], ids=["one grid", "cascades"])  # fmt: skip
def test_weights_are_those_of_the_cpu(tree: NerfTree) -> None:
    targets = Targets(pixels(4, 12), (1.0, 1.0, 1.0))
    wanted = max_weights(tree, targets, 250, 0)
    told: list[int] = []
    found = max_weights(tree, targets.sent(DEVICE), 250, 0, lambda done, _: told.append(done))
    assert told == [250]
    assert (wanted > 0.01).mean() > 0.2
    assert (np.abs(found - wanted) > 2e-3).mean() < 0.01


@pytest.mark.parametrize("kind", ["alpha", "infinite", "photographs", "declared"])
def test_targets_on_the_device_say_the_same(kind: str) -> None:
    some = pixels(5, 12)
    if kind == "photographs":
        made = cameras(5, 12)
        some = Pixels(made, [photograph(c) for c in made], [None] * 5, np.full(5, 1.0), np.full(5, 5.0))
        rng = np.random.default_rng(0)
        targets = Targets(some, None, rng.random((8, 16, 3)).astype(np.float32))
    else:
        if kind == "infinite":
            some.images = np.ascontiguousarray(some.images[:, :3])
        targets = Targets(some, (0.2, 0.5, 0.7), reaches_infinity=kind == "infinite")
    index = some.choose(100, np.random.default_rng(1))
    same = [each.of(index, constant_background=kind == "declared") for each in (targets, targets.sent(DEVICE))]
    for ours, theirs in zip((*same[1][:2], *same[1][2][:4]), (*same[0][:2], *same[0][2][:4]), strict=True):
        np.testing.assert_allclose(ours.cpu().numpy(), theirs, atol=1e-5 if kind == "photographs" else 2e-6)
        assert theirs.dtype == np.float32
    assert same[0][2].opacity_weight == same[1][2].opacity_weight


@pytest.mark.parametrize("stride", [1, 8])
def test_rays_of_pixels_are_those_of_the_host(stride: int, monkeypatch: pytest.MonkeyPatch) -> None:
    from efficientnerf.training import pixels as module

    monkeypatch.setattr(module, "EXACT", 2**23 if stride == 1 else 0)
    lens = ("OPENCV", (30.0, 33.0, 9.0, 12.0, 0.05, -0.02, 0.003, 0.002))
    poses = [c.world_from_camera for c in cameras(2)]
    views = [Camera("a", 21, 23, *lens, poses[0]), Camera("b", 18, 12, "SIMPLE_PINHOLE", (20.0, 9.0, 6.0), poses[1])]
    rng = np.random.default_rng(0)
    images = [rng.integers(0, 256, (c.height, c.width, 3), np.uint8) for c in views]
    host = Pixels(views, images, [None, np.ones((12, 18), bool)], np.array([1.0, 2.0]), np.array([4.0, 5.0]))
    assert host.stride == stride
    index = host.choose(400, np.random.default_rng(3))
    there = DevicePixels(host, DEVICE)
    for ours, theirs in zip(there.bundle(index), host.bundle(index), strict=True):
        np.testing.assert_allclose(ours.cpu().numpy(), theirs, rtol=1e-5, atol=1e-6)
    there.images = None  # as where they are too many for the device
    np.testing.assert_allclose(there.bundle(index)[4].cpu().numpy(), host.bundle(index)[4], atol=1e-7)


def test_in_normalised_device_coordinates_too() -> None:
    tree: Any = wall()
    camera = camera_at(0, 0, 0)
    image = np.full((camera.height, camera.width, 3), 128, np.uint8)
    targets = Targets(Pixels([camera], [image], [None], np.ones(1), np.full(1, 5.0)), (0.5, 0.5, 0.5), reaches_infinity=True)
    count = min(80, len(targets.pixels))
    wanted, found = error(tree, targets, count, 0), error(tree, targets.sent(DEVICE), count, 0)
    assert wanted > 1e-3
    assert found == pytest.approx(wanted, rel=1e-3)


@pytest.mark.gpu
def test_the_fit_on_a_device_ends_as_on_the_cpu() -> None:
    if not torch.cuda.is_available():
        pytest.skip("no CUDA device")
    on_host = Targets(pixels(10, 48), (1.0, 1.0, 1.0))
    on_device = on_host.to("cuda")
    ends = [error(fitted(t, ball_tree(40), [80], rays=2048, steps=80)[0].result(), on_host, 5000, 0) for t in (on_host, on_device)]
    assert ends[1] == pytest.approx(ends[0], rel=0.05)
    ends = [error(fitted(t, nested_balls(), [80], rays=2048, steps=80)[0].result(), on_host, 5000, 0) for t in (on_host, on_device)]
    assert ends[1] == pytest.approx(ends[0], rel=0.05)
    again = [fitted(on_device, ball_tree(40), [80], rays=2048, steps=80)[0].density for _ in range(2)]
    assert np.array_equal(*again)
