"""The marching kernel and its packed tree: parts against their definitions, images of every camera model, and what skipping may not change."""

from __future__ import annotations

from dataclasses import replace

import numba
import numpy as np
import pytest
import torch

from efficientnerf.asset.queries import density_block, normal_at
from efficientnerf.asset.rendering import render, render_rays, render_reference
from efficientnerf.asset.tree import NerfTree, tree_from_voxels, voxel_coordinates
from efficientnerf.backends.numba.simd import exp2_neg4, pack4, pointer, popcount, sigmoid, split16, trilinear4, unpack4
from efficientnerf.backends.numba.tree import march
from efficientnerf.backends.numba.tree.packed import packed_of
from efficientnerf.backends.numba.tree.packets import lanes
from efficientnerf.backends.numba.tree.view_colours import compute_view_colours, sh_basis
from efficientnerf.geometry.cameras import Camera, rays, resized
from efficientnerf.rendering.harmonics import basis_numpy
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
    for d, row in zip(directions, expected, strict=True):
        out = np.zeros(len(row), np.float32)
        sh_basis(*d, degree, out)
        np.testing.assert_allclose(out, row, atol=2e-6)


@numba.njit
def logistics(a, b, c, d):  # type: ignore[no-untyped-def]
    return unpack4(sigmoid(pack4(a, b, c, d)))


@numba.njit
def powers(a, b, c, d):  # type: ignore[no-untyped-def]
    return unpack4(exp2_neg4(pack4(a, b, c, d)))


def test_the_kernels_exponential_and_logistic() -> None:
    x = np.concatenate([np.linspace(0, 5, 3000), np.geomspace(1e-9, 1e30, 402), [0.0, np.inf]]).astype(np.float32)
    np.testing.assert_allclose([march.exp2_neg(v) for v in x], np.exp2(-x.astype(np.float64)), atol=2e-7)
    assert march.exp2_neg(np.float32(0)) == 1
    np.testing.assert_allclose([powers(*v) for v in x.reshape(-1, 4)], np.exp2(-x.astype(np.float64)).reshape(-1, 4), atol=2e-7)
    assert powers(*np.zeros(4, np.float32)) == (1, 1, 1, 1)
    y = np.concatenate([-x, x, np.linspace(-20, 20, 2000).astype(np.float32)])
    with np.errstate(over="ignore"):
        np.testing.assert_allclose([logistics(*v) for v in y.reshape(-1, 4)], 1 / (1 + np.exp(-y.astype(np.float64).reshape(-1, 4))), atol=4e-6)


@numba.njit
def between(values, starts, x, y, z):  # type: ignore[no-untyped-def]
    """Of a cube of three voxels a side with four numbers each."""
    four = pack4(x[0], x[1], x[2], x[3]), pack4(y[0], y[1], y[2], y[3]), pack4(z[0], z[1], z[2], z[3])
    first, mean = trilinear4(pointer(values), starts[0], starts[1], starts[2], starts[3], 12, 36, four[0], four[1], four[2])
    a, b, c, d = split16(mean)
    return unpack4(first), (unpack4(a), unpack4(b), unpack4(c), unpack4(d))


def test_four_points_are_interpolated_over_the_stored_corners() -> None:
    rng = np.random.default_rng(2)
    values = rng.normal(size=(3, 3, 3, 4)).astype(np.float32)
    values[..., 1:][rng.random((3, 3, 3)) < 0.4] = np.nan
    values[:2, :2, :2, 1:] = np.nan
    low = np.stack(np.meshgrid(*[range(2)] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
    for cells in low.reshape(2, 4, 3):
        at = rng.random((4, 3)).astype(np.float32)
        first, found = between(values, 4 * (cells @ [9, 3, 1]), *at.T.copy())
        for (i, j, k), f, row in zip(cells, at, found, strict=True):
            weight = np.einsum("i,j,k->ijk", *np.stack([1 - f, f], axis=1))
            eight = values[i : i + 2, j : j + 2, k : k + 2]
            share = weight[..., None] * ~np.isnan(eight)
            expected = np.einsum("ijkc,ijkc->c", share, np.nan_to_num(eight)) / np.maximum(share.sum((0, 1, 2)), 1e-12)
            np.testing.assert_allclose(row, expected, atol=2e-6)
        assert np.isfinite(found).all()
        np.testing.assert_allclose(first, np.array(found)[:, 0], atol=2e-6)


@numba.njit
def pair_of(row, k, rows):  # type: ignore[no-untyped-def]
    """Of voxels k and k + 1 of a row, numbered over all bricks: the first that is stored, and which are: bit 0, bit 1."""
    mask = np.int64(rows[2 * row + 1])
    return rows[2 * row] + popcount(mask & ((np.int64(1) << k) - 1)), mask >> k & 3


@numba.njit
def pairs(rows, side):  # type: ignore[no-untyped-def]
    """(B, side, side, side - 1, 2): of each two neighbours along z the first that is stored, and which are."""
    out = np.empty((len(rows), side, side, side - 1, 2), np.int64)
    for row in range(len(rows) * side * side):
        for k in range(side - 1):
            out[row // (side * side), row // side % side, row % side, k] = pair_of(row, k, pointer(rows))
    return out


@pytest.mark.parametrize("brick", [1, 2, 3, 4, 5])
def test_rows_find_the_voxels_of_a_brick_and_of_the_layer_around_it(brick: int) -> None:
    tree = random_tree(brick, brick=brick, degree=2, share=0.5)
    packed, side = packed_of(tree), brick + 2
    count = len(tree.density_values)
    assert np.array_equal(np.sort(packed.voxel_of[:-1]), np.arange(count))
    assert np.array_equal(packed.density[:-1], tree.density_values[packed.voxel_of[:-1]])
    assert packed.density[-1] == 0
    cells = np.pad(tree.brick_index, 1, constant_values=-1).repeat(brick, 0).repeat(brick, 1).repeat(brick, 2)[brick - 1 :, brick - 1 :, brick - 1 :]
    found = pairs(packed.rows, side)
    for table, live, place in zip(found, packed.has_density, packed.cells, strict=True):
        at = np.stack(np.meshgrid(*[np.arange(side)] * 3, indexing="ij"), axis=-1) + place * brick  # of the voxel after the one that is meant
        local = (at - 1) % brick @ [brick**2, brick, 1]
        owner = cells[tuple(at.reshape(-1, 3).T)].reshape(local.shape)
        voxel = np.where(owner >= 0, tree.voxel_index[owner, local], -1)
        low, high = voxel[..., :-1], voxel[..., 1:]
        assert np.array_equal(table[..., 1], (low >= 0) + 2 * (high >= 0))
        first, second = packed.voxel_of[table[..., 0]], packed.voxel_of[np.minimum(table[..., 0] + 1, count)]
        assert np.array_equal(first[low >= 0], low[low >= 0])
        assert np.array_equal(first[(low < 0) & (high >= 0)], high[(low < 0) & (high >= 0)])
        assert np.array_equal(second[(low >= 0) & (high >= 0)], high[(low >= 0) & (high >= 0)])
        density = np.where(voxel >= 0, tree.density_values[voxel], 0)
        eight = np.stack([density[i : i + side - 1, j : j + side - 1, k : k + side - 1] for i, j, k in np.ndindex(2, 2, 2)])
        bits = np.unpackbits(live.view(np.uint8), bitorder="little").astype(bool)
        assert np.array_equal(bits[: side**3].reshape(side, side, side)[:-1, :-1, :-1], (eight > 0).any(axis=0))
        assert bits.sum() == (eight > 0).any(axis=0).sum()


@pytest.mark.parametrize("brick", [1, 2, 4, 5])
@pytest.mark.parametrize("degree", range(5))
@pytest.mark.parametrize("layout", ["floats", "codes"])
def test_view_colours_are_the_sums_of_voxels_harmonics(brick: int, degree: int, layout: str) -> None:
    tree = random_tree(brick, brick=brick, degree=degree, share=0.5)
    if layout == "codes":
        tree = in_palettes(tree, (1,) * ((degree + 1) ** 2 - 1), 200)
    centre, packed = np.array([-31.0, 12.5, 57.0]), packed_of(tree)
    direction, colours = np.concatenate([np.eye(3), -centre[:, None]], axis=1), np.zeros((len(tree.density_values) + 1, 4), np.float32)
    compute_view_colours(0, len(packed.cells), 0, packed, tree.brick, direction, np.zeros(5), np.float32(2), tree.degree, colours)
    order = packed.voxel_of[:-1]
    assert np.array_equal(colours[:-1, 0], 2 * tree.density_values[order])
    away = voxel_coordinates(tree)[order] + 0.5 - centre
    basis = basis_numpy(away / np.linalg.norm(away, axis=1, keepdims=True), degree)
    np.testing.assert_allclose(colours[:-1, 1:], np.einsum("nk,nkc->nc", basis, tree.sh[order]), atol=1e-4)
    assert not colours[-1].any()


@numba.njit(error_model="numpy")
def in_lanes(floats, ints, bytes_, out):  # type: ignore[no-untyped-def]
    """What operators on sixteen lanes make of two rows of `floats`."""
    x, y = lanes.load16(pointer(floats), 0), lanes.load16(pointer(floats), 16)
    less = (x < y) & (x > np.float32(0)) | ~(y >= np.float32(-1))
    whole = lanes.to_int16(lanes.abs16(x) + lanes.ceil16(lanes.abs16(y)))
    masked = (whole + 3) * whole - 1 & 255 | whole >> 1
    values = (
        lanes.select16(less, x * y + np.float32(2), lanes.floor16(x) - y), lanes.min16(x, y) / lanes.max16(x, np.float32(0.5)),
        lanes.to_float16(masked + (1 << whole)), lanes.to_float16(lanes.popcount16(masked)), lanes.sqrt16(lanes.abs16(x)),
        lanes.to_float16(lanes.gather16(pointer(ints), whole & 7)), lanes.to_float16(lanes.gather16(pointer(bytes_), whole & 7)),
        lanes.gather16(pointer(floats), whole & 31), lanes.exp2_neg16(lanes.abs16(y)),
    )  # fmt: skip
    for n in range(9):
        lanes.store16(pointer(out), 16 * n, values[n])
    a, b, c, d = lanes.channels16(pointer(floats), 0)
    lanes.store16(pointer(out), 144, a - b + c * d)
    lanes.store_channels16(pointer(out), 160, a, b, c, d)
    return lanes.bits_of(less), lanes.lowest_bit(lanes.bits_of(lanes.mask_of(40)))


def test_operators_on_lanes_are_numpys() -> None:
    rng = np.random.default_rng(0)
    floats, out = rng.normal(0, 3, 64).astype(np.float32), np.zeros(224, np.float32)
    ints, bytes_ = rng.integers(-(2**20), 2**20, 8).astype(np.int32), rng.integers(0, 256, 8).astype(np.uint8)
    bits, lowest = in_lanes(floats, ints, bytes_, out)
    x, y = floats[:16], floats[16:32]
    less = (x < y) & (x > 0) | ~(y >= -1)
    whole = (np.abs(x) + np.ceil(np.abs(y))).astype(np.int32)
    masked = (whole + 3) * whole - 1 & 255 | whole >> 1
    expected = [
        np.where(less, x * y + 2, np.floor(x) - y), np.minimum(x, y) / np.maximum(x, 0.5), masked + (1 << whole), [bin(n).count("1") for n in masked],
        np.sqrt(np.abs(x)), ints[whole & 7], bytes_[whole & 7], floats[whole & 31], np.exp2(-np.abs(y)),
        floats[::4] - floats[1::4] + floats[2::4] * floats[3::4],
    ]  # fmt: skip
    np.testing.assert_allclose(out[:160].reshape(10, 16), np.array(expected, np.float32), rtol=1e-6, atol=1e-6)
    assert np.array_equal(out[160:], floats)
    assert (bits, lowest) == (int((less << np.arange(16)).sum()), 3)


def test_bricks_without_density_in_or_around_them_are_empty_to_the_kernel() -> None:
    tree = random_tree(7, shape=(8, 7, 6), brick=2, share=0.2)
    dark = tree.density_values * (np.random.default_rng(1).random(len(tree.density_values)) < 0.1)
    tree = replace(tree, density_values=dark.astype(np.float32))
    absorbs = np.zeros(tree.shape, bool)
    for cell in np.argwhere(tree.brick_index >= 0):
        absorbs[tuple(cell)] = density_block(tree, tuple(cell * 2 - 1), tuple(cell * 2 + 3)).any()
    assert 0 < absorbs.sum() < (tree.brick_index >= 0).sum()
    leap = packed_of(tree).leap.reshape(tree.shape)
    assert not leap[absorbs].any()
    for at in np.argwhere(~absorbs):
        assert leap[tuple(at)] == np.abs(np.argwhere(absorbs) - at).max(axis=1).min()


def in_palettes(tree: NerfTree, groups: tuple[int, ...], entries: int) -> NerfTree:
    """The tree with random codes in place of its harmonics."""
    from efficientnerf.asset.palettes import PaletteHarmonics

    rng, count = np.random.default_rng(0), len(tree.density_values)
    codes = rng.integers(entries, size=(count, len(groups))).astype(np.uint8 if entries <= 256 else np.uint16)
    palette = rng.normal(size=(entries, sum(groups), 3)).astype(np.float32)
    base, table = rng.integers(256, size=(count, 3)).astype(np.uint8), rng.normal(size=(256, 3)).astype(np.float32)
    return replace(tree, harmonics=PaletteHarmonics(base, table, codes, palette, groups))


@pytest.mark.parametrize(("groups", "entries"), [((1,) * 8, 256), ((8,), 1000), ((3, 5), 17), ((), 1)])
def test_palette_codes_render_as_what_they_decode_to(groups: tuple[int, ...], entries: int) -> None:
    tree = in_palettes(random_tree(4, shape=(5, 4, 6), brick=4, share=0.5), groups, entries)
    origins, directions = rays_at(tree, 300)
    colour, opacity = render_reference(tree, torch.from_numpy(origins), torch.from_numpy(directions))
    outputs = render_rays(tree, origins, directions)
    assert packed_of(tree).codes is tree.harmonics.codes  # type: ignore[union-attr]
    np.testing.assert_allclose(outputs.opacity, opacity, atol=1.01e-3)
    np.testing.assert_allclose(outputs.colour, colour, atol=1e-3)
    assert outputs.opacity.max() > 0.5


@pytest.mark.parametrize("brick", [1, 2, 4, 5])
def test_codes_are_found_across_bricks_of_any_size(brick: int) -> None:
    tree = in_palettes(random_tree(brick, brick=brick, share=0.6), (1, 1, 1), 256)
    origins, directions = rays_at(tree, 300)
    colour, _ = render_reference(tree, torch.from_numpy(origins), torch.from_numpy(directions))
    np.testing.assert_allclose(render_rays(tree, origins, directions).colour, colour, atol=1e-3)


def far_camera(tree: NerfTree, voxels: float) -> Camera:
    """A camera that many voxels away whose image the tree fills."""
    at = pose(0.7, 0.4, voxels * tree.voxel)
    at[:3, 3] += (tree.bounds_min + tree.bounds_max) / 2
    return Camera("far", 40, 36, "SIMPLE_PINHOLE", (30 * voxels / max(tree.resolution), 20.0, 18.0), at)


@pytest.mark.parametrize("degree", range(5))
@pytest.mark.parametrize("distance", [0.0, 30.0, 300.0, 1000.0, 3000.0])
@pytest.mark.parametrize("layout", ["floats", "codes"])
def test_images_match_the_torch_reference_from_near_and_far(degree: int, distance: float, layout: str) -> None:
    """View colours and colours at each sample: the harmonics of neighbours are independent here, and surfaces opaque."""
    tree = random_tree(degree, shape=(6, 5, 7), brick=4, degree=degree, share=0.6, sigma=300.0)
    if layout == "codes":
        tree = in_palettes(tree, (1,) * ((degree + 1) ** 2 - 1), 256)
    camera = far_camera(tree, distance) if distance else replace(camera_of(tree, distance=0.02), params=(8.0, 8.0, 13.0, 11.0))
    origins, directions = rays(camera)
    colour, opacity = render_reference(tree, torch.from_numpy(origins), torch.from_numpy(directions))
    outputs = render(tree, camera)
    np.testing.assert_allclose(outputs.colour.reshape(-1, 3), colour, atol=1e-3)
    np.testing.assert_allclose(outputs.opacity.reshape(-1), opacity, atol=1.01e-3)
    assert (outputs.opacity > 0.9).mean() > 0.1


def test_images_depend_not_on_threads(monkeypatch: pytest.MonkeyPatch) -> None:
    tree = random_tree(5, shape=(9, 7, 8), brick=4, degree=2, share=0.6, sigma=100.0)
    packed_of(tree)  # made once, for both
    for distance in (40.0, 2000.0):
        camera = far_camera(tree, distance)
        usual = render(tree, camera, supersample=2)
        with monkeypatch.context() as patch:
            patch.setattr("numba.get_num_threads", lambda: 3)
            other = render(tree, camera, supersample=2)
        for name in FIELDS:
            assert np.array_equal(getattr(usual, name), getattr(other, name)), name


def test_ray_statistics_are_consistent() -> None:
    from efficientnerf.backends.numba.tree.rendering import ray_statistics

    tree = uniform_tree(sigma=0.5)
    camera = camera_of(tree)
    visited, tested, interpolated, lookups = np.moveaxis(ray_statistics(tree, camera), -1, 0)
    hit = render(tree, camera).opacity > 0
    assert ((interpolated > 0) == hit).all()
    assert (tested >= interpolated).all()
    assert (interpolated >= lookups).all()
    assert (visited[hit] > 0).all()
    # A chord of the box in half voxels, at most its diagonal.
    assert tested.max() <= 2 * np.linalg.norm(tree.resolution) + 1


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


def test_the_largest_coefficients_of_a_file_render_like_others() -> None:
    tree = random_tree(2, degree=2, share=0.7)
    sh = tree.sh.copy()
    sh[::7, 0] = 65000.0
    sh[1::7, 0] = -65000.0
    tree = replace(tree, harmonics=sh)
    origins, directions = rays_at(tree, 300)
    colour, _ = render_reference(tree, torch.from_numpy(origins), torch.from_numpy(directions))
    error = np.abs(render_rays(tree, origins, directions).colour - colour.numpy())
    # A coefficient beside one of 65000 is known to 1, but there the logistic is flat, except for the few rays on its slope.
    assert np.quantile(error, 0.98) < 1e-3


@pytest.mark.parametrize("model", LENSES)
@pytest.mark.parametrize("supersample", [1, 2])
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


@pytest.mark.parametrize("model", ["PINHOLE", "OPENCV", "OPENCV_FISHEYE"])
@pytest.mark.parametrize("share", [0.01, 0.05, 0.4])
@pytest.mark.parametrize("distance", [0.1, 1.5, 9.0])
def test_tiles_that_skip_empty_space_change_no_value(model: str, share: float, distance: float) -> None:
    tree = random_tree(11, shape=(12, 10, 9), brick=4, degree=1, share=share)
    timid = replace(tree)
    timid.derived["packed"] = packed_of(tree)._replace(leap=np.minimum(packed_of(tree).leap, 1))
    camera = camera_of(tree, model, distance)
    usual, other = render(tree, camera), render(timid, camera)
    for name in FIELDS:
        assert np.array_equal(getattr(usual, name), getattr(other, name)), name


def test_given_rays_may_come_in_any_order() -> None:
    tree = random_tree(3, shape=(9, 8, 7), brick=4, share=0.1)
    origins, directions = rays_at(tree, 700)
    order = np.random.default_rng(0).permutation(len(origins))
    one, other = render_rays(tree, origins, directions), render_rays(tree, origins[order], directions[order])
    for name in FIELDS:
        assert np.array_equal(getattr(one, name)[order], getattr(other, name)), name


def test_a_camera_inside_and_one_facing_away() -> None:
    tree = uniform_tree(sigma=40.0)
    inside = camera_of(tree, distance=0.05)
    outputs = render(tree, inside)
    assert (outputs.opacity > 0.99).all()
    np.testing.assert_allclose(outputs.depth[11, 13], np.log(2) / 40, rtol=0.05)
    away = inside.world_from_camera.copy()
    away[:3, 3] += 30 * away[:3, 2]
    empty = render(tree, replace(inside, world_from_camera=away), background=(0.2, 0.4, 0.6))
    assert not empty.opacity.any()
    assert np.isinf(empty.depth).all()
    assert not empty.normal.any()
    np.testing.assert_allclose(empty.colour, np.broadcast_to(np.float32([0.2, 0.4, 0.6]), empty.colour.shape))


def test_normals_are_those_of_the_tree_where_the_transmittance_is_one_half() -> None:
    tree = random_tree(6, shape=(5, 6, 4), brick=4, share=0.7, sigma=60.0)
    origins, directions = rays_at(tree, 400)
    outputs = render_rays(tree, origins, directions)
    hit = np.isfinite(outputs.depth)
    assert hit.sum() > 50
    at = origins[hit] + outputs.depth[hit, None] * directions[hit]
    # The gradient bends where a difference reaches from one voxel to the next; rounding may put it on either side.
    assert np.quantile(np.abs(outputs.normal[hit] - normal_at(tree, at)), 0.98) < 1e-3


def test_harmonics_may_be_evaluated_along_other_directions_than_the_rays() -> None:
    from efficientnerf.backends.numba.tree.rendering import render_rays

    tree = uniform_tree(sigma=80.0)
    sh = np.zeros((len(tree.sh), 4, 3), np.float32)
    sh[:, 2] = 1.0  # brighter the more z a direction has
    tree = replace(tree, harmonics=sh)
    origins, directions = rays_at(tree, 40)
    sh_directions = np.random.default_rng(1).normal(size=directions.shape)
    sh_directions /= np.linalg.norm(sh_directions, axis=1, keepdims=True)
    colour, opacity, _, _ = render_rays(tree, origins, directions, sh_directions)
    expected = 1 / (1 + np.exp(-0.4886025119029199 * sh_directions[:, 2]))
    np.testing.assert_allclose(colour, (opacity * expected)[:, None] * np.ones(3), atol=1e-4)


def test_a_tree_without_voxels_renders() -> None:
    tree = tree_from_voxels((2, 3, 1), 0.1, np.zeros(3), np.zeros((0, 3), int), np.zeros(0), np.zeros((0, 4, 3)))
    outputs = render(tree, camera_of(tree), supersample=2)
    assert not outputs.opacity.any()
    assert not outputs.colour.any()


def test_a_background_has_three_numbers() -> None:
    tree = random_tree(0)
    with pytest.raises(ValueError, match="expected three numbers"):
        render(tree, camera_of(tree), background=(1.0, 1.0))  # type: ignore[arg-type]


def test_nan_directions_render_as_empty() -> None:
    tree = random_tree(0)
    bad = np.array([[np.nan, 0, 1], [0, 0, 0], [np.inf, 0, 0]])
    outputs = render_rays(tree, np.zeros((3, 3)), bad)
    assert np.isfinite(outputs.opacity).all()


@pytest.mark.parametrize("layout", ["floats", "codes"])
def test_the_order_of_voxels_does_not_change_images(layout: str) -> None:
    tree = random_tree(1, brick=4, degree=2, share=0.6)
    if layout == "codes":
        tree = in_palettes(tree, (1,) * 8, 200)
    rng = np.random.default_rng(0)
    bricks, voxels = rng.permutation(len(tree.voxel_index)), rng.permutation(len(tree.density_values))
    other = replace(
        tree,
        brick_index=np.where(tree.brick_index >= 0, np.argsort(bricks)[tree.brick_index], -1).astype(np.int32),
        voxel_index=np.where(tree.voxel_index >= 0, np.argsort(voxels)[tree.voxel_index], -1)[bricks].astype(np.int32),
        density_values=tree.density_values[voxels],
        harmonics=tree.harmonics.subset(voxels) if layout == "codes" else tree.sh[voxels],  # type: ignore[union-attr]
    )
    for distance in (40.0, 2000.0):
        one, two = render(tree, far_camera(tree, distance)), render(other, far_camera(tree, distance))
        assert one.opacity.max() > 0.5
        for name in FIELDS:
            assert np.array_equal(getattr(one, name), getattr(two, name)), name
