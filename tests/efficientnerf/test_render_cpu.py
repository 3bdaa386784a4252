"""The marching kernel and its packed tree: parts against their definitions, pictures of every camera model, and what skipping may not change."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from efficientnerf.cameras import Camera, rays, resized
from efficientnerf.harmonics import basis_numpy, harmonics_count
from efficientnerf.kernels import cpu_march
from efficientnerf.nerftree.tree import NerfTree, tree_from_voxels
from efficientnerf.render import render_tree_reference
from tests.efficientnerf.balls import pose
from tests.efficientnerf.trees import random_tree, rays_at, uniform_tree

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


@pytest.mark.parametrize("degree", range(5))
def test_the_kernels_harmonics_are_those_of_the_project(degree: int) -> None:
    directions = np.random.default_rng(0).normal(size=(50, 3))
    directions = (directions / np.linalg.norm(directions, axis=1, keepdims=True)).astype(np.float32)
    expected = basis_numpy(directions.astype(np.float64), degree)
    width = 3 * harmonics_count(degree) + 5
    for d, row in zip(directions, expected, strict=True):
        out = np.zeros((3, width), np.float32)
        cpu_march._harmonics(*d, degree, out)
        for c in range(3):
            wanted = np.zeros(width)
            wanted[c : 3 * len(row) : 3] = row
            np.testing.assert_allclose(out[c], wanted, atol=2e-6)


def test_the_kernels_exponential_and_logistic() -> None:
    x = np.concatenate([np.linspace(0, 5, 3000), np.geomspace(1e-9, 1e30, 400), [0.0, np.inf]]).astype(np.float32)
    np.testing.assert_allclose([cpu_march._exp_minus(v) for v in x], np.exp(-x.astype(np.float64)), atol=2e-7)
    assert cpu_march._exp_minus(np.float32(0)) == 1
    y = np.concatenate([-x, x[:-1], np.linspace(-20, 20, 2000).astype(np.float32)])
    with np.errstate(over="ignore"):
        np.testing.assert_allclose([cpu_march._logistic(v) for v in y], 1 / (1 + np.exp(-y.astype(np.float64))), atol=4e-6)


@pytest.mark.parametrize("brick", [1, 2, 3, 4, 5])
def test_blocks_of_the_packed_tree_hold_a_brick_and_the_layer_round_it(brick: int) -> None:
    tree = random_tree(brick, brick=brick, degree=2)
    packed, side = tree.packed, brick + 2
    whole = tree.density_block((-1, -1, -1), tuple(n + 1 for n in tree.resolution))  # type: ignore[arg-type]
    for x, y, z in np.argwhere(tree.brick_index >= 0):
        block = packed.density[packed.cell[x, y, z]].reshape(side, side, side)
        low = np.array([x, y, z]) * brick
        expected = whole[tuple(slice(a, a + side) for a in low)]
        assert np.array_equal(block, expected)
        stored = packed.voxel[packed.cell[x, y, z]].reshape(side, side, side)
        known = stored < len(tree.density_values)
        assert np.array_equal(tree.density_values[stored[known]], expected[known])
        assert not expected[~known].any()
        inner = stored[1:-1, 1:-1, 1:-1].reshape(-1)
        assert np.array_equal(np.where(inner < len(tree.density_values), inner, -1), tree.voxel_index[tree.brick_index[x, y, z]])
        eight = np.stack([expected[i : i + side - 1, j : j + side - 1, k : k + side - 1] for i, j, k in np.ndindex(2, 2, 2)])
        assert np.array_equal(np.signbit(block[:-1, :-1, :-1]), (eight == 0).all(axis=0))
    assert np.array_equal(-1 - packed.cell[tree.brick_index < 0], tree.leap[tree.brick_index < 0])


def test_harmonics_of_the_packed_tree_are_the_trees_to_a_part_in_65534_of_the_largest_of_a_voxel() -> None:
    tree = random_tree(0, degree=3, share=0.8)
    sh = tree.sh.copy()
    sh[::5] *= 1000
    sh[3] = 0
    packed = replace(tree, harmonics=sh).packed
    count = 3 * sh.shape[1]
    close = packed.sh[:-1, :count].astype(np.float64) * packed.scale[:-1, None]
    assert (np.abs(close - sh.reshape(len(sh), -1)) <= np.abs(sh).max(axis=(1, 2))[:, None] * (0.505 / 32767)).all()
    assert not packed.sh[:, count:].any()
    assert not packed.sh[-1].any()
    assert packed.nbytes > packed.sh.nbytes + packed.density.nbytes


def in_palettes(tree: NerfTree, groups: tuple[int, ...], entries: int) -> NerfTree:
    """The tree with random codes in place of its harmonics."""
    from efficientnerf.nerftree.palettes import PaletteHarmonics

    rng, count = np.random.default_rng(0), len(tree.density_values)
    codes = rng.integers(entries, size=(count, len(groups))).astype(np.uint8 if entries <= 256 else np.uint16)
    palette = rng.normal(size=(entries, sum(groups), 3)).astype(np.float32)
    base, table = rng.integers(256, size=(count, 3)).astype(np.uint8), rng.normal(size=(256, 3)).astype(np.float32)
    return replace(tree, harmonics=PaletteHarmonics(base, table, codes, palette, groups))


@pytest.mark.parametrize(("groups", "entries"), [((1,) * 8, 256), ((8,), 1000), ((3, 5), 17), ((), 1)])
def test_codes_into_palettes_are_drawn_as_what_they_decode_to(groups: tuple[int, ...], entries: int, monkeypatch: pytest.MonkeyPatch) -> None:
    from efficientnerf.kernels import packed_tree

    tree = in_palettes(random_tree(4, shape=(5, 4, 6), brick=4, share=0.5), groups, entries)
    origins, directions = rays_at(tree, 300)
    colour, opacity = render_tree_reference(tree, torch.from_numpy(origins), torch.from_numpy(directions))
    rows = tree.render_rays(origins, directions)
    assert not len(tree.packed.codes)
    monkeypatch.setattr(packed_tree, "ROWS_LIMIT", 0)
    large = replace(tree)
    coded = large.render_rays(origins, directions)
    assert large.packed.codes is tree.harmonics.codes  # type: ignore[union-attr]
    assert large.packed.nbytes < tree.packed.nbytes
    for seen in (rows, coded):
        np.testing.assert_allclose(seen.opacity, opacity, atol=1.01e-3)
        np.testing.assert_allclose(seen.colour, colour, atol=1e-3)
    assert coded.opacity.max() > 0.5


@pytest.mark.parametrize("brick", [1, 2, 4, 5])
def test_codes_are_found_across_bricks_of_any_size(brick: int, monkeypatch: pytest.MonkeyPatch) -> None:
    from efficientnerf.kernels import packed_tree

    monkeypatch.setattr(packed_tree, "ROWS_LIMIT", 0)
    tree = in_palettes(random_tree(brick, brick=brick, share=0.6), (1, 1, 1), 256)
    origins, directions = rays_at(tree, 300)
    colour, _ = render_tree_reference(tree, torch.from_numpy(origins), torch.from_numpy(directions))
    np.testing.assert_allclose(tree.render_rays(origins, directions).colour, colour, atol=1e-3)


def test_the_work_of_a_picture_is_counted() -> None:
    from efficientnerf.kernels.cpu_tree import picture_work

    tree = uniform_tree(sigma=0.5)
    camera = camera_of(tree)
    cells, tested, mixed, colours = np.moveaxis(picture_work(tree, camera), -1, 0)
    seen = tree.render(camera).opacity > 0
    assert ((mixed > 0) == seen).all()
    assert (tested >= mixed).all()
    assert (mixed >= colours).all()
    assert (cells[seen] > 0).all()
    # A chord of the box in half voxels, at most its diagonal.
    assert tested.max() <= 2 * np.linalg.norm(tree.resolution) + 1


@pytest.mark.parametrize(("sigma", "share", "stop"), [(0.3, 0.9, 0.0), (3.0, 0.6, 0.0), (300.0, 0.6, 1e-3)])
def test_fog_and_solids_are_the_torch_functions(sigma: float, share: float, stop: float) -> None:
    """The kernel may differ by what it leaves of the light, by 1e-4 for colours that are owed, and by rounding: 1e-3 together."""
    tree = random_tree(5, shape=(9, 7, 8), brick=4, degree=2, share=share, sigma=sigma)
    origins, directions = rays_at(tree, 500)
    colour, opacity = render_tree_reference(tree, torch.from_numpy(origins), torch.from_numpy(directions))
    seen = tree.render_rays(origins, directions)
    np.testing.assert_allclose(seen.opacity, opacity, atol=max(1e-4, 1.01 * stop))
    np.testing.assert_allclose(seen.colour, colour, atol=1e-3)
    assert np.abs(seen.colour - colour.numpy()).mean() < 1e-4
    assert seen.opacity.mean() > 0.05


def test_coefficients_as_large_as_a_file_can_hold_are_drawn_like_others() -> None:
    tree = random_tree(2, degree=2, share=0.7)
    sh = tree.sh.copy()
    sh[::7, 0] = 65000.0
    sh[1::7, 0] = -65000.0
    tree = replace(tree, harmonics=sh)
    origins, directions = rays_at(tree, 300)
    colour, _ = render_tree_reference(tree, torch.from_numpy(origins), torch.from_numpy(directions))
    error = np.abs(tree.render_rays(origins, directions).colour - colour.numpy())
    # A coefficient beside one of 65000 is known to 1, but there the logistic is flat, except for the few rays on its slope.
    assert np.quantile(error, 0.98) < 1e-3


@pytest.mark.parametrize("model", LENSES)
@pytest.mark.parametrize("supersample", [1, 2])
def test_pictures_of_every_camera_model_are_their_rays(model: str, supersample: int) -> None:
    tree = random_tree(0, share=0.7, degree=2)
    camera = camera_of(tree, model)
    fine = resized(camera, camera.width * supersample, camera.height * supersample)
    flat = tree.render_rays(*rays(fine))
    picture = tree.render(camera, supersample=supersample)

    def mean(values: np.ndarray) -> np.ndarray:
        return values.reshape(camera.height, supersample, camera.width, supersample, -1).mean((1, 3))

    np.testing.assert_allclose(picture.colour, mean(flat.colour), atol=1e-4)
    np.testing.assert_allclose(picture.opacity, mean(flat.opacity)[..., 0], atol=1e-4)
    assert 0.1 < (picture.opacity > 0.1).mean() < 1
    if supersample == 1:
        slant = (rays(camera)[1] @ camera.forward).reshape(picture.depth.shape)
        solid = picture.opacity > 0.501
        np.testing.assert_allclose(picture.depth[solid], (flat.depth.reshape(solid.shape) * slant)[solid], rtol=1e-3)


@pytest.mark.parametrize("model", ["PINHOLE", "OPENCV", "OPENCV_FISHEYE"])
@pytest.mark.parametrize("share", [0.01, 0.05, 0.4])
@pytest.mark.parametrize("distance", [0.1, 1.5, 9.0])
def test_tiles_that_skip_empty_space_change_no_value(model: str, share: float, distance: float) -> None:
    tree = random_tree(11, shape=(12, 10, 9), brick=4, degree=1, share=share)
    timid = replace(tree)
    timid.__dict__["leap"] = np.zeros_like(tree.leap)
    camera = camera_of(tree, model, distance)
    usual, other = tree.render(camera), timid.render(camera)
    for name in FIELDS:
        assert np.array_equal(getattr(usual, name), getattr(other, name)), name


def test_rays_that_belong_to_no_camera_may_come_in_any_order() -> None:
    tree = random_tree(3, shape=(9, 8, 7), brick=4, share=0.1)
    origins, directions = rays_at(tree, 700)
    order = np.random.default_rng(0).permutation(len(origins))
    one, other = tree.render_rays(origins, directions), tree.render_rays(origins[order], directions[order])
    for name in FIELDS:
        assert np.array_equal(getattr(one, name)[order], getattr(other, name)), name


def test_a_camera_inside_and_one_that_looks_away() -> None:
    tree = uniform_tree(sigma=40.0)
    inside = camera_of(tree, distance=0.05)
    seen = tree.render(inside)
    assert (seen.opacity > 0.99).all()
    np.testing.assert_allclose(seen.depth[11, 13], np.log(2) / 40, rtol=0.05)
    away = inside.world_from_camera.copy()
    away[:3, 3] += 30 * away[:3, 2]
    nothing = tree.render(replace(inside, world_from_camera=away), background=(0.2, 0.4, 0.6))
    assert not nothing.opacity.any()
    assert np.isinf(nothing.depth).all()
    assert not nothing.normal.any()
    np.testing.assert_allclose(nothing.colour, np.broadcast_to(np.float32([0.2, 0.4, 0.6]), nothing.colour.shape))


def test_normals_are_those_of_the_tree_where_half_of_the_light_is_gone() -> None:
    tree = random_tree(6, shape=(5, 6, 4), brick=4, share=0.7, sigma=60.0)
    origins, directions = rays_at(tree, 400)
    seen = tree.render_rays(origins, directions)
    hit = np.isfinite(seen.depth)
    assert hit.sum() > 50
    at = origins[hit] + seen.depth[hit, None] * directions[hit]
    # The gradient bends where a difference reaches from one voxel to the next; rounding may put it on either side.
    assert np.quantile(np.abs(seen.normal[hit] - tree.normal(at)), 0.98) < 1e-3


def test_harmonics_may_be_asked_for_other_directions_than_the_rays() -> None:
    from efficientnerf.kernels.cpu_tree import render_rays

    tree = uniform_tree(sigma=80.0)
    sh = np.zeros((len(tree.sh), 4, 3), np.float32)
    sh[:, 2] = 1.0  # brighter the more z a direction has
    tree = replace(tree, harmonics=sh)
    origins, directions = rays_at(tree, 40)
    looking = np.random.default_rng(1).normal(size=directions.shape)
    looking /= np.linalg.norm(looking, axis=1, keepdims=True)
    colour, opacity, _, _ = render_rays(tree, origins, directions, looking)
    expected = 1 / (1 + np.exp(-0.4886025119029199 * looking[:, 2]))
    np.testing.assert_allclose(colour, (opacity * expected)[:, None] * np.ones(3), atol=1e-4)


def test_a_tree_without_voxels_has_pictures() -> None:
    tree = tree_from_voxels((2, 3, 1), 0.1, np.zeros(3), np.zeros((0, 3), int), np.zeros(0), np.zeros((0, 4, 3)))
    seen = tree.render(camera_of(tree), supersample=2)
    assert not seen.opacity.any()
    assert not seen.colour.any()


def test_a_background_has_three_numbers() -> None:
    tree = random_tree(0)
    with pytest.raises(ValueError, match="expected three numbers"):
        tree.render(camera_of(tree), background=(1.0, 1.0))  # type: ignore[arg-type]


def test_directions_that_are_no_numbers_see_nothing() -> None:
    tree = random_tree(0)
    bad = np.array([[np.nan, 0, 1], [0, 0, 0], [np.inf, 0, 0]])
    seen = tree.render_rays(np.zeros((3, 3)), bad)
    assert np.isfinite(seen.opacity).all()
