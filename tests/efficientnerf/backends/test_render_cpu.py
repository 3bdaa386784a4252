"""Images of packed trees: against the torch reference, of every camera model, and what skipping may not change; harmonics along rays."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from efficientnerf.asset.rendering import render, render_rays
from efficientnerf.asset.tree import NerfTree
from efficientnerf.backends.numba.tree.packed import packed_of
from efficientnerf.backends.numba.tree.rendering import render_rays as render_packed
from efficientnerf.backends.numba.tree.view_colours import sh_basis
from efficientnerf.geometry.cameras import Camera, rays, resized
from efficientnerf.rendering.harmonics import basis_numpy
from tests.efficientnerf.balls import pose
from tests.efficientnerf.tree_reference import render_reference
from tests.efficientnerf.trees import in_codes, random_tree, rays_at, uniform_tree

FIELDS = ("colour", "opacity", "depth", "normal")
LENSES = {
    "SIMPLE_PINHOLE": (40.0, 13.0, 11.0),
    "PINHOLE": (40.0, 37.0, 13.0, 11.0),
    "SIMPLE_RADIAL": (40.0, 13.0, 11.0, -0.08),
    "RADIAL": (40.0, 13.0, 11.0, -0.08, 0.01),
    "OPENCV": (40.0, 37.0, 13.0, 11.0, -0.08, 0.01, 0.004, -0.003),
    "FULL_OPENCV": (40.0, 37.0, 13.0, 11.0, -0.08, 0.01, 0.004, -0.003, 0.0, 0.01, 0.0, 0.0),
    "OPENCV_FISHEYE": (30.0, 29.0, 13.0, 11.0, 0.02, 0.0, 0.001, 0.0),
}


def camera_of(tree: NerfTree, model: str = "PINHOLE", distance: float = 2.5) -> Camera:
    at = pose(0.7, 0.4, distance)
    at[:3, 3] += (tree.bounds_min + tree.bounds_max) / 2
    return Camera("view", 27, 22, model, LENSES[model], at)


@pytest.mark.parametrize(("groups", "entries"), [((1,) * 8, 256), ((3, 5), 17), ((), 1)])
def test_palette_codes_render_as_what_they_decode_to(groups: tuple[int, ...], entries: int) -> None:
    tree = in_codes(random_tree(4, shape=(5, 4, 6), brick=4, share=0.5), groups, entries)
    origins, directions = rays_at(tree, 300)
    colour, opacity = render_reference(tree, torch.from_numpy(origins), torch.from_numpy(directions))
    outputs = render_rays(tree, origins, directions)
    assert np.array_equal(packed_of(tree).codes, tree.harmonics.codes[packed_of(tree).voxel_of[:-1]])  # type: ignore[union-attr]
    np.testing.assert_allclose(outputs.opacity, opacity, atol=1.01e-3)
    np.testing.assert_allclose(outputs.colour, colour, atol=1e-3)
    assert outputs.opacity.max() > 0.5


def far_camera(tree: NerfTree, voxels: float) -> Camera:
    """A camera that many voxels away whose image the tree fills."""
    at = pose(0.7, 0.4, voxels * tree.voxel)
    at[:3, 3] += (tree.bounds_min + tree.bounds_max) / 2
    return Camera("far", 40, 36, "SIMPLE_PINHOLE", (30 * voxels / max(tree.resolution), 20.0, 18.0), at)


@pytest.mark.parametrize(("degree", "distance"), [(0, 0.0), (0, 3000.0), (1, 300.0), (2, 30.0), (2, 1000.0), (3, 300.0), (4, 0.0), (4, 1000.0)])
@pytest.mark.parametrize("layout", ["floats", "codes"])
def test_images_match_the_torch_reference_from_near_and_far(degree: int, distance: float, layout: str) -> None:
    """View colours and colours at each sample: the harmonics of neighbours are independent here, and surfaces opaque."""
    tree = random_tree(degree, shape=(6, 5, 7), brick=4, degree=degree, share=0.6, sigma=300.0)
    if layout == "codes":
        tree = in_codes(tree, (1,) * ((degree + 1) ** 2 - 1), 256)
    camera = far_camera(tree, distance) if distance else replace(camera_of(tree, distance=0.02), params=(8.0, 8.0, 13.0, 11.0))
    origins, directions = rays(camera)
    colour, opacity = render_reference(tree, torch.from_numpy(origins), torch.from_numpy(directions))
    outputs = render(tree, camera)
    np.testing.assert_allclose(outputs.colour.reshape(-1, 3), colour, atol=1e-3)
    np.testing.assert_allclose(outputs.opacity.reshape(-1), opacity, atol=1.01e-3)
    assert (outputs.opacity > 0.9).mean() > 0.1


@pytest.mark.parametrize(("sigma", "share", "stop"), [(0.3, 0.9, 0.0), (3.0, 0.6, 0.0), (300.0, 0.6, 1e-3)])
def test_thin_and_opaque_media_match_the_torch_reference(sigma: float, share: float, stop: float) -> None:
    """The kernel may differ by the early stop, by 1e-4 for the weight of samples without a colour, and by rounding: 1e-3 together."""
    tree = random_tree(5, shape=(9, 7, 8), brick=4, degree=2, share=share, sigma=sigma)
    origins, directions = rays_at(tree, 500)
    colour, opacity = render_reference(tree, torch.from_numpy(origins), torch.from_numpy(directions))
    outputs = render_rays(tree, origins, directions)
    np.testing.assert_allclose(outputs.opacity, opacity, atol=max(1e-4, 1.01 * stop))
    np.testing.assert_allclose(outputs.colour, colour, atol=1e-3)
    assert np.abs(outputs.colour - colour.numpy()).mean() < 1e-4
    assert outputs.opacity.mean() > 0.05


@pytest.mark.parametrize(("model", "supersample"), [*((model, 1) for model in LENSES), ("OPENCV", 2)])
def test_images_of_every_camera_model_match_single_rays(model: str, supersample: int) -> None:
    tree = random_tree(0, share=0.7, degree=2)
    camera = camera_of(tree, model)
    fine = resized(camera, camera.width * supersample, camera.height * supersample)
    flat = render_rays(tree, *rays(fine))
    image = render(tree, camera, supersample=supersample)

    def mean(values: np.ndarray) -> np.ndarray:
        return values.reshape(camera.height, supersample, camera.width, supersample, -1).mean((1, 3))

    np.testing.assert_allclose(image.colour, mean(flat.colour), atol=1e-4)
    np.testing.assert_allclose(image.opacity, mean(flat.opacity)[..., 0], atol=1e-4)
    assert 0.1 < (image.opacity > 0.1).mean() < 1
    if supersample == 1:
        slant = (rays(camera)[1] @ camera.forward).reshape(image.depth.shape)
        solid = image.opacity > 0.501
        np.testing.assert_allclose(image.depth[solid], (flat.depth.reshape(solid.shape) * slant)[solid], rtol=1e-3)


def test_leaps_in_every_direction_alike_change_no_value(monkeypatch: pytest.MonkeyPatch) -> None:
    """As in a grid of more cells than leaps of eight directions are held for."""
    tree = random_tree(11, shape=(12, 10, 9), brick=4, degree=1, share=0.05)
    camera = camera_of(tree, "OPENCV", 1.5)
    usual = render(tree, camera)
    assert len(packed_of(tree).octants) == 8 * 12 * 10 * 9
    tree.derived.clear()
    monkeypatch.setattr("efficientnerf.backends.numba.tree.packed.MOST_OCTANT_BYTES", 0)
    other = render(tree, camera)
    assert len(packed_of(tree).octants) == 0
    for name in FIELDS:
        assert np.array_equal(getattr(usual, name), getattr(other, name)), name


@pytest.mark.parametrize("degree", range(5))
def test_the_kernels_harmonics_are_those_of_the_project(degree: int) -> None:
    directions = np.random.default_rng(0).normal(size=(50, 3))
    directions = (directions / np.linalg.norm(directions, axis=1, keepdims=True)).astype(np.float32)
    for d, row in zip(directions, basis_numpy(directions.astype(np.float64), degree), strict=True):
        out = np.zeros(len(row), np.float32)
        sh_basis(*d, degree, out)
        np.testing.assert_allclose(out, row, atol=2e-6)


def test_harmonics_may_be_evaluated_along_other_directions_than_the_rays() -> None:
    tree = uniform_tree(sigma=80.0)
    sh = np.zeros((len(tree.sh), 4, 3), np.float32)
    sh[:, 2] = 1.0  # brighter the more z a direction has
    tree = replace(tree, harmonics=sh)
    origins, directions = rays_at(tree, 40)
    sh_directions = np.random.default_rng(1).normal(size=directions.shape)
    sh_directions /= np.linalg.norm(sh_directions, axis=1, keepdims=True)
    colour, opacity, _, _ = render_packed(tree, origins, directions, sh_directions)
    expected = 1 / (1 + np.exp(-0.4886025119029199 * sh_directions[:, 2]))
    np.testing.assert_allclose(colour, (opacity * expected)[:, None] * np.ones(3), atol=1e-4)
