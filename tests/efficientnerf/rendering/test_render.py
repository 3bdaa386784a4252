"""Pictures of trees and fields: loop, torch and kernel against each other, closed forms, and what skipping may not change."""

import math

import numpy as np
import pytest
import torch

from efficientnerf.asset.rendering import render, render_rays
from efficientnerf.geometry.cameras import Camera
from efficientnerf.rendering.field_renderer import FieldRenderer
from tests import reference
from tests.efficientnerf.balls import pose, untrained
from tests.efficientnerf.tree_reference import render_reference
from tests.efficientnerf.trees import TREES, looking, random_tree, rays_at, tensors, uniform_tree


@pytest.mark.parametrize(("brick", "degree", "step_size"), [(*tree, (0.3, 0.5, 1.0)[n % 3]) for n, tree in enumerate(TREES)])
def test_the_kernel_is_the_torch_function(brick: int, degree: int, step_size: float) -> None:
    tree = random_tree(brick, brick=brick, degree=degree, step_size=step_size)
    origins, directions = rays_at(tree, 400)
    colour, opacity = render_reference(tree, *tensors(origins, directions))
    seen = render_rays(tree, origins, directions)
    # The kernel stops at 1e-3 of the light and is in float32.
    np.testing.assert_allclose(seen.opacity, opacity, atol=1.2e-3)
    np.testing.assert_allclose(seen.colour, colour, atol=1.2e-3)
    assert 0.2 < (seen.opacity > 0.05).mean() < 0.9
    assert seen.opacity.max() > 0.8


@pytest.mark.parametrize(("lookup", "step_size"), [("trilinear", 0.5), ("trilinear", 1.0), ("nearest", 0.5)])
@pytest.mark.parametrize(("brick", "degree"), TREES[1:3])
def test_the_torch_function_is_the_loop(brick: int, degree: int, lookup: str, step_size: float) -> None:
    tree = random_tree(brick, brick=brick, degree=degree, lookup=lookup, step_size=step_size)
    origins, directions = rays_at(tree, 24)
    colour, opacity = render_reference(tree, *tensors(origins, directions))
    depth = render_rays(tree, origins, directions).depth
    for r in range(24):
        wanted_colour, wanted_opacity, wanted_depth = reference.tree_ray(tree, origins[r], directions[r])
        np.testing.assert_allclose(colour[r], wanted_colour, atol=1e-6)
        assert float(opacity[r]) == pytest.approx(wanted_opacity, abs=1e-6)
        if abs(wanted_opacity - 0.5) > 1e-3:
            assert depth[r] == pytest.approx(wanted_depth, abs=1e-3)


def test_gradients_of_the_torch_function_are_finite_differences() -> None:
    tree = random_tree(1, shape=(2, 1, 2), brick=2, degree=1, share=0.8, sigma=8.0)
    origins, directions = tensors(*rays_at(tree, 5))
    density = torch.from_numpy(tree.density_values).double().requires_grad_()
    sh = torch.from_numpy(tree.sh).double().requires_grad_()
    assert torch.autograd.gradcheck(lambda d, s: render_reference(tree, origins, directions, d, s), (density, sh), fast_mode=True)
    render_reference(tree, origins, directions, density, sh)[0].sum().backward()
    assert density.grad.abs().sum() > 0


@pytest.mark.parametrize("share", [0.02, 0.5])
def test_leaping_changes_no_value(share: float) -> None:
    tree = random_tree(7, shape=(7, 6, 8), brick=2, degree=2, share=share)
    origins, directions = rays_at(tree, 600)
    usual = render_rays(tree, origins, directions)
    for most in (0, 1, 2):
        timid = random_tree(7, shape=(7, 6, 8), brick=2, degree=2, share=share)
        timid.__dict__["leap"] = np.minimum(tree.leap, most)
        other = render_rays(timid, origins, directions)
        for name in ("colour", "opacity", "depth", "normal"):
            assert np.array_equal(getattr(usual, name), getattr(other, name)), name


def test_a_uniform_box_has_its_closed_form() -> None:
    """Away from the faces, where interpolation thins it, the density is sigma: opacity and depth follow."""
    tree = uniform_tree(sigma=2.0)
    middle = (tree.bounds_min + tree.bounds_max) / 2
    origin = np.array([middle[0] - 0.5, middle[1], middle[2]])  # inside
    seen = render_rays(tree, origin[None], np.array([[1.0, 0, 0]]))
    # The last half voxel before the face is at half of the density on average and better: three quarters of sigma over it.
    chord = (tree.bounds_max[0] - origin[0]) - 0.125 * tree.voxel
    assert float(seen.opacity[0]) == pytest.approx(1 - math.exp(-2 * chord), abs=2e-3)
    assert float(seen.depth[0]) == pytest.approx(math.log(2) / 2, abs=1e-3)
    np.testing.assert_allclose(seen.colour[0], seen.opacity[0] * reference.sigmoid(0.7), atol=1e-3)


@pytest.mark.parametrize("supersample", [1, 3])
def test_depth_is_finite_just_where_half_of_the_light_is_absorbed(supersample: int) -> None:
    tree = random_tree(4, share=0.7, sigma=20.0)
    picture = render(tree, looking(tree, 40), supersample=supersample)
    assert np.array_equal(np.isfinite(picture.depth), picture.opacity >= 0.5)
    length = np.linalg.norm(picture.normal, axis=-1)
    assert ((np.abs(length - 1) < 1e-3) | (length == 0)).all()


@pytest.mark.gpu
def test_the_torch_function_runs_on_the_device() -> None:
    if not torch.cuda.is_available():
        pytest.skip("no CUDA device")
    tree = random_tree(0, share=0.7)
    origins, directions = rays_at(tree, 200)
    there = render_reference(tree, *(t.float().cuda() for t in tensors(origins, directions)))
    seen = render_rays(tree, origins, directions)
    np.testing.assert_allclose(there[0].cpu(), seen.colour, atol=2e-3)


# Fields.


@pytest.mark.parametrize("contracted", [False, True])
def test_a_fields_picture_is_what_lies_before_in_and_behind_the_box(contracted: bool) -> None:
    m = untrained(contracted=contracted)
    m.fine.weights[-1].data.mul_(30)  # no longer thin: something lies everywhere
    m.fine.table.data.mul_(3e3)
    camera = Camera("view", 9, 7, "SIMPLE_PINHOLE", (12.0, 4.5, 3.5), pose(0.3, 0.2, 4.0))
    seen = FieldRenderer(m, 0.5, 30.0).render(camera)
    assert np.array_equal(seen.colour, FieldRenderer(m, 0.5, 30.0).colour(camera))  # no noise
    assert seen.inside_opacity.mean() > 0.01
    assert seen.inside_opacity.max() <= 1
    if not contracted:
        assert not seen.before.any()
        np.testing.assert_allclose(seen.behind, 1, atol=1e-5)
        np.testing.assert_allclose(seen.inside_opacity, seen.opacity, atol=1e-5)
    assert np.array_equal(np.isfinite(seen.depth), seen.opacity >= 0.5)
