"""Renders of nested grids and environment maps on the CPU: against the reference, and what must not change them."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch

from efficientnerf.asset.cascades import cascade_grids, cascade_tree, cascades_of, nested, point_cascades
from efficientnerf.asset.palettes import PaletteHarmonics
from efficientnerf.asset.queries import colour_at, density_at, normal_at
from efficientnerf.asset.rendering import Rendering, ray_parts, render, render_rays
from efficientnerf.asset.tree import NerfTree
from efficientnerf.backends.numba.tree import rendering
from efficientnerf.backends.numba.tree.packed import packed_of
from efficientnerf.geometry.cameras import Camera, rays
from efficientnerf.rendering import environment
from tests.efficientnerf.balls import pose
from tests.efficientnerf.tree_reference import render_reference, tree_density
from tests.efficientnerf.trees import random_cascades, random_tree, rays_at, uniform_tree

FIELDS = ("colour", "opacity", "depth", "normal")
LENSES = {
    "PINHOLE": (20.0, 18.0, 12.0, 10.0),
    "OPENCV": (20.0, 18.0, 12.0, 10.0, -0.08, 0.01, 0.004, -0.003),
    "OPENCV_FISHEYE": (12.0, 12.0, 12.0, 10.0, 0.02, 0.0, 0.001, 0.0),
}
CASES = [(1, 3, 1), (2, 2, 0), (3, 4, 2), (5, 1, 1), (3, 5, 3), (2, 3, 4)]  # cascades, brick, degree


def camera_of(tree: NerfTree, model: str = "PINHOLE", distance: float = 1.0) -> Camera:
    """A camera that many half diagonals of the innermost box away from its middle."""
    at = pose(0.7, 0.4, distance * float(np.linalg.norm(tree.bounds_max - tree.bounds_min)) / 2)
    at[:3, 3] += (tree.bounds_min + tree.bounds_max) / 2
    return Camera("view", 24, 20, model, LENSES[model], at)


def in_palettes(tree: NerfTree, entries: int = 200) -> NerfTree:
    """The tree with random codes in place of its harmonics."""
    rng, count, terms = np.random.default_rng(0), len(tree.density_values), tree.harmonics_count - 1
    codes, palette = rng.integers(entries, size=(count, terms)).astype(np.uint8), rng.normal(size=(entries, terms, 3)).astype(np.float32)
    base, table = rng.integers(256, size=(count, 3)).astype(np.uint8), rng.normal(size=(256, 3)).astype(np.float32)
    return replace(tree, harmonics=PaletteHarmonics(base, table, codes, palette, (1,) * terms))


def many_rays(tree: NerfTree, count: int, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Through and beside each cascade, a part of them from inside."""
    parts = [rays_at(replace(tree, shape=c.shape, voxel=c.voxel, bounds_min=c.bounds_min, outer=()), count, seed + n) for n, c in enumerate(cascades_of(tree))]
    origins, directions = zip(*parts, strict=True)
    return np.concatenate(origins), np.concatenate(directions)


def reference_depth(tree: NerfTree, origins: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """Distances at which the transmittance falls to one half, by plain steps."""
    o, d, density = torch.from_numpy(origins), torch.from_numpy(directions), torch.as_tensor(tree.density_values, dtype=torch.float64)
    left, depth = torch.ones(len(o), dtype=torch.float64), torch.full((len(o),), np.inf, dtype=torch.float64)
    for n, begin, end in ray_parts(tree, o, d):
        cascade = cascades_of(tree)[n]
        grid = replace(tree, shape=cascade.shape, voxel=cascade.voxel, bounds_min=cascade.bounds_min, brick_index=cascade.brick_index, outer=())
        step = cascade.voxel / 2
        for k in range(int(((end - begin).nan_to_num(0).clamp(0, 2 * sum(grid.resolution) * step).max() / step).ceil()) + 1):
            t = begin + (k + 0.5) * step
            sigma = tree_density(grid, (o + t[:, None] * d - torch.as_tensor(cascade.bounds_min)) / cascade.voxel, density)[0] * (t < end)
            after = left * torch.exp(-sigma * step)
            crossed = (left > 0.5) & (after <= 0.5)
            depth = torch.where(crossed, t - step / 2 + torch.log(2 * left) / sigma.clamp(min=1e-30), depth)
            left = after
    return depth.numpy()


def assert_as_the_reference(tree: NerfTree, outputs: Rendering, origins: np.ndarray, directions: np.ndarray) -> None:
    colour, opacity = (part.numpy() for part in render_reference(tree, torch.from_numpy(origins), torch.from_numpy(directions)))
    np.testing.assert_allclose(outputs.colour.reshape(-1, 3), colour, atol=1e-3)
    np.testing.assert_allclose(outputs.opacity.reshape(-1), opacity, atol=1.01e-3)
    assert opacity.max() > 0.5


@pytest.mark.parametrize(("count", "brick", "degree", "layout"), [(*case, layout) for case, layout in zip(CASES, 3 * ["floats", "codes"], strict=True)])
def test_rays_match_the_reference(count: int, brick: int, degree: int, layout: str) -> None:
    tree = random_cascades(count + brick, count=count, brick=brick, degree=degree)
    if layout == "codes":
        tree = in_palettes(tree)
    origins, directions = many_rays(tree, 80)
    outputs = render_rays(tree, origins, directions)
    assert_as_the_reference(tree, outputs, origins, directions)
    expected = reference_depth(tree, origins, directions)
    clear = np.abs(outputs.opacity - 0.5) > 1e-4
    assert np.array_equal(np.isfinite(outputs.depth[clear]), np.isfinite(expected[clear]))
    hit = np.isfinite(expected) & clear
    assert hit.sum() > 10
    np.testing.assert_allclose(outputs.depth[hit], expected[hit], rtol=2e-4, atol=2e-4)


@pytest.mark.parametrize(("model", "distance"), [*((model, distance) for model in LENSES for distance in (0.02, 2.7)), ("PINHOLE", 40.0)])
@pytest.mark.parametrize(("count", "brick", "degree"), CASES[2:4])
def test_images_match_the_reference(count: int, brick: int, degree: int, model: str, distance: float) -> None:
    tree = random_cascades(count, count=count, brick=brick, degree=degree, share=0.4)
    camera = camera_of(tree, model, distance)
    if distance > 3:
        camera = replace(camera, params=(20.0 * distance, 18.0 * distance, *camera.params[2:]))
    assert_as_the_reference(tree, render(tree, camera), *rays(camera))


@pytest.mark.parametrize("layout", ["floats", "codes"])
def test_view_colours_of_far_cascades_match_the_reference(layout: str) -> None:
    """From so far away that colours are summed once for the view."""
    tree = random_cascades(4, count=3, brick=4, degree=2, share=0.6)
    if layout == "codes":
        tree = in_palettes(tree)
    camera = camera_of(tree, distance=400.0)
    camera = replace(camera, params=(4000.0, 3600.0, 12.0, 10.0))
    assert_as_the_reference(tree, render(tree, camera), *rays(camera))


def test_normals_are_those_of_the_cascade_that_is_hit() -> None:
    tree = random_cascades(5, count=3, brick=4, share=0.5)
    origins, directions = many_rays(tree, 200)
    outputs = render_rays(tree, origins, directions)
    hit = np.isfinite(outputs.depth)
    at = origins[hit] + outputs.depth[hit, None] * directions[hit]
    cascade = point_cascades(tree, at)
    assert all((cascade == n).sum() > 20 for n in range(3))
    assert np.quantile(np.abs(outputs.normal[hit] - normal_at(tree, at)), 0.97) < 1e-3


def test_a_background_takes_the_place_of_the_environment() -> None:
    tree, background = random_cascades(1), (0.2, 0.5, 0.9)
    camera = camera_of(tree)
    bare = replace(tree, environment=None)
    for supersample in (1, 2):
        one = render(tree, camera, background=background, supersample=supersample)
        other = render(bare, camera, background=background, supersample=supersample)
        for name in FIELDS:
            assert np.array_equal(getattr(one, name), getattr(other, name)), name
    origins, directions = rays(camera)
    alone = render_rays(bare, origins, directions)
    over = render_rays(tree, origins, directions, background=background)
    np.testing.assert_allclose(over.colour, alone.colour + (1 - alone.opacity[:, None]) * np.float32(background), atol=1e-6)
    with pytest.raises(ValueError, match="expected three numbers"):
        render_rays(tree, origins, directions, background=(1.0, 1.0))  # type: ignore[arg-type]


@pytest.mark.parametrize("lookup", ["trilinear", "nearest"])
def test_the_environment_is_seen_along_the_ray_through_what_is_not_opaque(lookup: str) -> None:
    tree = random_tree(1, share=0.1, lookup=lookup)
    rng = np.random.default_rng(0)
    surroundings = rng.random((16, 32, 3)).astype(np.float32)
    origins, directions = rays_at(tree, 400)
    directions[:6] = [[0, 0, 1], [0, 0, -1], [-1, 0, 0], [-1, -1e-12, 0], [1, 0, 0], [0, 1, 0]]
    alone = render_rays(tree, origins, directions)
    seen = render_rays(replace(tree, environment=surroundings), origins, directions)
    expected = alone.colour + (1 - alone.opacity[:, None]) * environment.lookup(surroundings, directions)
    through = alone.opacity < 0.999
    np.testing.assert_allclose(seen.colour[through], expected[through], atol=1e-6)
    np.testing.assert_allclose(seen.colour, expected, atol=1e-3)
    assert np.array_equal(seen.opacity, alone.opacity)


def test_images_depend_neither_on_threads_nor_on_pieces(monkeypatch: pytest.MonkeyPatch) -> None:
    tree = random_cascades(5, count=4, brick=4, degree=2, share=0.5)
    packed_of(tree)
    camera, calls = camera_of(tree, distance=1.7), []
    usual, far = render(tree, camera, supersample=2), render(tree, replace(camera, world_from_camera=camera_of(tree, distance=90.0).world_from_camera))
    whole = rendering.render_batch

    def in_small_pieces(*given: Any) -> bool:
        calls.append(len(given))
        return bool(whole(*given[:9], 500, *given[10:]))

    monkeypatch.setattr(rendering, "render_batch", in_small_pieces)
    monkeypatch.setattr("numba.get_num_threads", lambda: 3)
    for expected, found in (
        (usual, render(tree, camera, supersample=2)),
        (far, render(tree, replace(camera, world_from_camera=camera_of(tree, distance=90.0).world_from_camera))),
    ):
        for name in FIELDS:
            assert np.array_equal(getattr(expected, name), getattr(found, name)), name
    assert len(calls) > 20


@pytest.mark.parametrize(("model", "share", "distance"), [("PINHOLE", 0.01, 9.0), ("OPENCV", 0.1, 1.5), ("OPENCV_FISHEYE", 0.1, 0.1)])
def test_tiles_that_skip_empty_space_change_no_value(model: str, share: float, distance: float) -> None:
    tree = random_cascades(11, count=4, cells=6, brick=3, share=share)
    timid = replace(tree)
    packed = packed_of(tree)
    timid.derived["packed"] = packed._replace(leap=np.minimum(packed.leap, 1), octants=np.minimum(packed.octants, 1))
    camera = camera_of(tree, model, distance)
    usual, other = render(tree, camera), render(timid, camera)
    for name in FIELDS:
        assert np.array_equal(getattr(usual, name), getattr(other, name)), name


@pytest.mark.parametrize(("distance", "focal"), [(0.02, 8.0), (0.8, 200.0), (2.5, 20.0)])
def test_voxels_that_are_not_in_view_change_no_value(distance: float, focal: float, monkeypatch: pytest.MonkeyPatch) -> None:
    """Their colours are not summed. All samples have colours of the view here, and so would show what was left out."""
    tree = random_cascades(8, count=3, cells=20, brick=2, degree=2, share=0.1)
    camera = camera_of(tree, distance=distance)
    camera = replace(camera, params=(focal, focal, *camera.params[2:]))
    monkeypatch.setattr(rendering, "VOXELS_PER_SLOPE", -100.0)
    filled, whole, huge = [], rendering.compute_view_colours, np.float16(6e4).view(np.uint16)

    def over_huge(*given: Any) -> None:
        if not filled:
            given[-1][:-1] = huge
        whole(*given)
        filled.append((given[-1][:-1, 1] != huge).mean())

    with monkeypatch.context() as patch:
        patch.setattr(rendering, "compute_view_colours", over_huge)
        usual = render(tree, camera)
    monkeypatch.setattr(rendering, "_cone", lambda camera: rendering.EVERYWHERE)
    other = render(tree, camera)
    assert other.opacity.max() > 0.5
    assert focal < 200 or filled[-1] < 0.9
    for name in FIELDS:
        assert np.array_equal(getattr(usual, name), getattr(other, name)), name


@pytest.mark.parametrize("least", [-1e-42, 1e-31, 0.0])
def test_rays_along_the_faces_of_boxes_and_cells(least: float) -> None:
    """From outside, from the inner box's face and from its middle, along each axis; in the planes of a box's faces either side may be seen, or none."""
    grids = cascade_grids(np.array([[-8.0] * 3, [8.0] * 3]), 1.0, 4, 3)
    tree = nested([replace(uniform_tree(shape, brick=4, voxel=voxel, sigma=0.05), bounds_min=low) for shape, voxel, low in grids])
    for axis in range(3):
        for beside in (-32.0, -16.0, -8.0, 0.0, 4.0, 8.0, 16.0, 32.0):
            origins, directions = np.full((3, 3), beside), np.full((3, 3), least)
            origins[:, axis], directions[:, axis] = [-40.0, -8.0, 0.0], 1.0
            found = render_rays(tree, origins, directions)
            assert np.isfinite(found.opacity).all()
            if abs(beside) < 8:
                reference = render_reference(tree, torch.from_numpy(origins), torch.from_numpy(directions))[1]
                np.testing.assert_allclose(found.opacity, reference, atol=1e-3)
                assert found.opacity.min() > 0.7


@pytest.mark.parametrize(("count", "brick", "degree"), CASES[1:4])
def test_points_are_looked_up_in_the_cascade_that_they_belong_to(count: int, brick: int, degree: int) -> None:
    tree = random_cascades(count, count=count, brick=brick, degree=degree, share=0.5)
    rng = np.random.default_rng(0)
    last = cascades_of(tree)[-1].bounds(brick)
    points = np.concatenate([rng.uniform(*c.bounds(brick), (300, 3)) for c in cascades_of(tree)] + [last + np.array([[-0.1], [0.1]])])
    directions = rng.normal(size=points.shape)
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    owner = point_cascades(tree, points)
    for n, cascade in enumerate(cascades_of(tree)):
        low, high = cascade.bounds(brick)
        inside = ((points >= low) & (points < high)).all(axis=1)
        assert (owner[inside] <= n).all()
        assert (owner[~inside] != n).all()
        alone, mine = cascade_tree(tree, n), owner == n
        assert np.array_equal(density_at(tree, points)[mine], density_at(alone, points[mine]))
        assert np.array_equal(normal_at(tree, points)[mine], normal_at(alone, points[mine]))
        assert np.array_equal(colour_at(tree, points, directions)[mine], colour_at(alone, points[mine], directions[mine]))
        assert np.array_equal(colour_at(tree, points)[mine], colour_at(alone, points[mine]))
        assert density_at(alone, points[mine]).max() > 0
    assert (owner[-2:] == -1).all()
    assert not density_at(tree, points[-2:]).any()
    assert not density_at(tree, np.array([[np.nan, 0, 0], [np.inf, 0, 0]])).any()
