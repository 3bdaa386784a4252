"""Images of trees by the CUDA kernel against the torch function and the CPU kernel."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from efficientnerf.asset.rendering import Rendering, render, render_rays
from efficientnerf.asset.tree import NerfTree, tree_from_voxels
from efficientnerf.geometry.cameras import Camera
from efficientnerf.rendering import environment
from tests.efficientnerf.device import DEVICE
from tests.efficientnerf.tree_reference import render_reference
from tests.efficientnerf.trees import LOW, in_codes, looking, nested_rays, random_cascades, random_tree, rays_at, tensors

cuda = pytest.importorskip("efficientnerf.backends.triton.tree")


def device_rays(tree: NerfTree, origins: np.ndarray, directions: np.ndarray) -> Rendering:
    found = cuda.render_rays(cuda.device_tree(tree, DEVICE), *(t.to(DEVICE) for t in tensors(origins, directions)))
    return Rendering(*(t.cpu().numpy() for t in found))


def device_image(tree: NerfTree, camera: Camera, **options: object) -> Rendering:
    return Rendering(*(t.cpu().numpy() for t in cuda.render_image(cuda.device_tree(tree, DEVICE), camera, **options)))


def agree(ours: Rendering, theirs: Rendering, faces: float = 0.0) -> None:
    """To 1e-3, but for a share `faces` of pixels whose ray runs along the face of a cell, where rounding decides on which side."""
    for name in ("colour", "opacity"):
        off = np.abs(getattr(ours, name) - getattr(theirs, name))
        assert (off > 1e-3).mean() <= faces, (name, off.max())
    decided = np.abs(theirs.opacity - 0.5) > 2e-3
    assert (np.isfinite(ours.depth) != np.isfinite(theirs.depth))[decided].mean() <= faces
    both = np.isfinite(ours.depth) & np.isfinite(theirs.depth) & decided
    assert both.any()
    assert (np.abs(ours.depth[both] - theirs.depth[both]) > 2e-3).mean() <= max(faces, 0.02)
    turned = np.abs(ours.normal - theirs.normal).max(axis=-1)[both]
    assert (turned > 0.05).mean() <= max(faces, 0.02)


@pytest.mark.parametrize(("brick", "degree", "step_size"), [(1, 0, 0.5), (4, 2, 1.0), (2, 4, 0.5)])
def test_rays_are_those_of_the_torch_function(brick: int, degree: int, step_size: float) -> None:
    tree = random_tree(brick, brick=brick, degree=degree, step_size=step_size)
    origins, directions = rays_at(tree, 96)
    colour, opacity = render_reference(tree, *tensors(origins, directions))
    found = device_rays(tree, origins, directions)
    # The kernel stops at 1e-3 of the light, and is in float32.
    np.testing.assert_allclose(found.opacity, opacity, atol=1.1e-3)
    np.testing.assert_allclose(found.colour, colour, atol=1.1e-3)
    assert 0.2 < (found.opacity > 0.05).mean() < 0.9
    agree(found, render_rays(tree, origins, directions))


def test_skipping_empty_space_changes_no_value() -> None:
    tree = random_tree(7, shape=(7, 6, 8), brick=2, degree=2, share=0.1)
    origins, directions = rays_at(tree, 96)
    agree(device_rays(tree, origins, directions), render_rays(tree, origins, directions), faces=0.011)


@pytest.mark.parametrize(("model", "params"), [
    ("SIMPLE_PINHOLE", (15.0, 5.0, 6.5)), ("PINHOLE", (15.0, 16.0, 4.5, 6.0)), ("OPENCV", (15.0, 16.0, 4.5, 6.0, 0.05, -0.02, 0.003, 0.002)),
    ("OPENCV_FISHEYE", (12.0, 12.0, 5.0, 6.0, 0.02, 0.0, 0.0, 0.0)),
])  # fmt: skip
def test_images_are_those_of_the_cpu(model: str, params: tuple[float, ...]) -> None:
    tree = random_tree(0, share=0.7, degree=2)
    camera = replace(looking(tree, 10), width=9, model=model, params=params)
    for background in (None, (1.0, 0.5, 0.0)) if model == "PINHOLE" else ((0.2, 0.5, 1.0),):
        found, expected = device_image(tree, camera, background=background), render(tree, camera, background=background)
        assert found.colour.shape == (camera.height, camera.width, 3)
        agree(found, expected, faces=0.02)
        assert np.array_equal(np.isfinite(found.depth), found.opacity >= 0.5)


@pytest.mark.parametrize(("brick", "degree"), [(1, 0), (4, 2)])
def test_rays_through_voxels_that_are_not_interpolated(brick: int, degree: int) -> None:
    tree = random_tree(brick, brick=brick, degree=degree, lookup="nearest")
    origins, directions = rays_at(tree, 96)
    found = device_rays(tree, origins, directions)
    assert 0.2 < (found.opacity > 0.05).mean() < 0.9
    agree(found, render_rays(tree, origins, directions), faces=0.02)  # samples at faces of voxels: float32 may see the one on the other side
    other = render_rays(tree, *rays_at(replace(tree, lookup="trilinear"), 96))
    assert np.abs(other.colour - device_rays(replace(tree, lookup="trilinear"), origins, directions).colour).max() > 0.05


def test_images_of_voxels_that_are_not_interpolated() -> None:
    tree = random_tree(0, share=0.7, degree=2, lookup="nearest")
    camera = looking(tree, 8)
    for supersample in (1, 2):
        agree(device_image(tree, camera, supersample=supersample), render(tree, camera, supersample=supersample), faces=0.03)


def test_an_empty_tree_and_no_rays() -> None:
    tree = tree_from_voxels((2, 3, 1), 0.1, LOW, np.zeros((0, 3), int), np.zeros(0), np.zeros((0, 4, 3)))
    found = device_image(tree, looking(tree), background=(0.2, 0.4, 0.6))
    assert not found.opacity.any()
    assert np.isinf(found.depth).all()
    np.testing.assert_allclose(found.colour, np.broadcast_to([0.2, 0.4, 0.6], found.colour.shape), atol=1e-6)
    assert device_rays(random_tree(0), np.zeros((0, 3)), np.zeros((0, 3))).colour.shape == (0, 3)


def test_palettes_are_decoded() -> None:
    coded = in_codes(random_tree(3, degree=1), (1, 2), 7)
    plain = replace(coded, harmonics=coded.harmonics.decoded())  # type: ignore[union-attr]
    origins, directions = rays_at(coded, 40)
    by_codes, by_values = (device_rays(each, origins, directions) for each in (coded, plain))
    assert np.array_equal(by_codes.colour, by_values.colour)
    assert np.array_equal(by_codes.opacity, by_values.opacity)


def test_rays_of_another_frame_have_the_colours_along_those_of_the_world() -> None:
    tree = random_tree(3, degree=2)
    origins, directions = rays_at(tree, 60)
    looking = np.roll(directions, 1, axis=0)
    found = cuda.render_rays(cuda.device_tree(tree, DEVICE), *(t.to(DEVICE) for t in tensors(origins, directions, looking)))
    from efficientnerf.backends.numba.tree.rendering import render_rays

    agree(Rendering(*(t.cpu().numpy() for t in found)), Rendering(*render_rays(tree, origins, directions, looking)), faces=0.02)


@pytest.mark.parametrize(("count", "brick", "degree", "lookup"), [(1, 3, 1, "trilinear"), (3, 4, 2, "trilinear"), (3, 2, 1, "nearest")])
def test_rays_through_cascades_are_those_of_the_torch_function(count: int, brick: int, degree: int, lookup: str) -> None:
    tree = replace(random_cascades(count, count=count, brick=brick, degree=degree, lookup=lookup), environment=None)
    origins, directions = nested_rays(tree, 80)
    colour, opacity = (part.numpy() for part in render_reference(tree, *tensors(origins, directions)))
    found = device_rays(tree, origins, directions)
    faces = 0.03 if lookup == "nearest" else 0.01  # samples at faces of voxels and of boxes: float32 may see the one on the other side
    assert (np.abs(found.opacity - opacity) > 1.1e-3).mean() <= faces
    assert (np.abs(found.colour - colour) > 1.1e-3).mean() <= faces
    assert (found.opacity > 0.05).mean() > 0.2
    agree(found, render_rays(tree, origins, directions), faces=0.03)


@pytest.mark.parametrize(("supersample", "background"), [(1, None), (2, (1.0, 0.5, 0.0))])
def test_images_of_cascades_lie_over_the_environment_or_the_background(supersample: int, background: tuple[float, float, float] | None) -> None:
    tree = random_cascades(2, degree=1, share=0.3)
    tree = replace(tree, density_values=tree.density_values / 4)
    side = 8 // supersample
    camera = replace(looking(tree, side), model="PINHOLE", params=(0.6 * side, 0.55 * side, 0.5 * side, 0.6 * side))
    found = device_image(tree, camera, background=background, supersample=supersample)
    agree(found, render(tree, camera, background=background, supersample=supersample), faces=0.05)  # normals beside the face of a box
    assert found.opacity.min() < 0.4 < 0.6 < found.opacity.max()


@pytest.mark.parametrize("side", [(1, 2), (8, 16), (64, 128)])
def test_the_environment_of_the_device_is_that_of_the_host(side: tuple[int, int]) -> None:
    """With directions at the poles, at the seam, and exactly along the axes."""
    rng = np.random.default_rng(0)
    image, directions = rng.random((*side, 3)).astype(np.float32), rng.normal(size=(500, 3))
    directions[::5, :2] *= 1e-3
    directions[1::5, 1] *= 1e-4
    directions = np.concatenate([directions / np.linalg.norm(directions, axis=1, keepdims=True), np.eye(3), -np.eye(3)])
    found = environment.lookup_on(torch.from_numpy(image).to(DEVICE), torch.from_numpy(directions.astype(np.float32)).to(DEVICE))
    np.testing.assert_allclose(found.cpu().numpy(), environment.lookup(image, directions), atol=1e-4)


@pytest.mark.gpu
def test_cascades_on_the_device_render_as_on_the_cpu() -> None:
    if not torch.cuda.is_available():
        pytest.skip("no CUDA device")
    tree = random_cascades(4, count=4, cells=8, brick=4, degree=2, share=0.2)
    camera = looking(tree, 200)
    agree(render(tree.to("cuda"), camera), render(tree, camera), faces=0.01)
