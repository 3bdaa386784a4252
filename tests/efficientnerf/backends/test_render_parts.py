"""Parts of the kernel that renders packed trees against their definitions: harmonics, exponentials, half floats, lanes, rows, colours of a view."""

from __future__ import annotations

from dataclasses import replace

import numba
import numpy as np
import pytest

from efficientnerf.asset.cascades import voxel_coordinates
from efficientnerf.asset.queries import density_block
from efficientnerf.backends.numba.simd import exp2_neg4, pack4, pointer, popcount, sigmoid, split16, trilinear4, unpack4
from efficientnerf.backends.numba.tree import march
from efficientnerf.backends.numba.tree.leaps import octant_leaps
from efficientnerf.backends.numba.tree.packed import packed_of
from efficientnerf.backends.numba.tree.packets import groups, halves, lanes
from efficientnerf.backends.numba.tree.packets.halves import mix_pairs, store_halves4
from efficientnerf.backends.numba.tree.packets.layout import LANES
from efficientnerf.backends.numba.tree.view_colours import compute_view_colours, packed_pointers, sh_basis
from efficientnerf.rendering.harmonics import basis_numpy
from tests.efficientnerf.trees import in_codes, random_tree


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
def pairs(packed, brick):  # type: ignore[no-untyped-def]
    """(B, side, side, side - 1, 2): of each two neighbours along z the first that is stored, and which are: bit 0, bit 1."""
    side, grid = brick + 2, packed_pointers(packed, brick, 0)
    out = np.empty((len(packed.rows), side, side, side - 1, 2), np.int64)
    for row in range(len(packed.rows) * side * side):
        if grid.narrow:
            word = np.int64(grid.rows[row]) & 0xFFFFFFFF
            first, mask = word >> side, word & ((np.int64(1) << side) - 1)
        else:
            first, mask = np.int64(grid.rows[2 * row]), np.int64(grid.rows[2 * row + 1])
        for k in range(side - 1):
            out[row // (side * side), row // side % side, row % side, k] = first + popcount(mask & ((np.int64(1) << k) - 1)), mask >> k & 3
    return out


@pytest.mark.parametrize(("brick", "wide"), [(1, False), (2, True), (4, False), (4, True), (5, False)])
def test_rows_find_the_voxels_of_a_brick_and_of_the_layer_around_it(brick: int, wide: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    if wide:
        monkeypatch.setattr("efficientnerf.backends.numba.tree.packed.MOST_BITS", 0)
    tree = random_tree(brick, brick=brick, degree=2, share=0.5)
    packed, side = packed_of(tree), brick + 2
    assert packed.rows.shape == (len(tree.voxel_index), (2 if wide else 1) * side**2)
    count = len(tree.density_values)
    assert np.array_equal(np.sort(packed.voxel_of[:-1]), np.arange(count))
    assert np.array_equal(packed.density[:-1], tree.density_values[packed.voxel_of[:-1]])
    assert packed.density[-1] == 0
    assert np.array_equal(packed.coordinates[:, :count].T, voxel_coordinates(tree)[packed.voxel_of[:-1]])
    assert packed.first_voxel.tolist() == [0, count]
    cells = np.pad(tree.brick_index, 1, constant_values=-1).repeat(brick, 0).repeat(brick, 1).repeat(brick, 2)[brick - 1 :, brick - 1 :, brick - 1 :]
    found = pairs(packed, brick)
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


@pytest.mark.parametrize(
    ("layout", "degree", "brick"),
    [(layout, degree, (1, 2, 4, 5)[(n + degree) % 4]) for n, layout in enumerate(["floats", "codes", "wide codes"]) for degree in range(5)],
)
def test_view_colours_are_the_sums_of_voxels_harmonics(brick: int, degree: int, layout: str, monkeypatch: pytest.MonkeyPatch) -> None:
    if layout == "wide codes":
        monkeypatch.setattr("efficientnerf.backends.numba.tree.packed.MOST_COORDINATES", 0)
    tree = random_tree(brick, brick=brick, degree=degree, share=0.5)
    if layout != "floats":
        tree = in_codes(tree, (1,) * ((degree + 1) ** 2 - 1), 300 if layout == "wide codes" else 200)
    centre, packed = np.array([-31.0, 12.5, 57.0]), packed_of(tree)
    direction, bits = np.concatenate([np.eye(3), -centre[:, None]], axis=1), np.zeros((len(tree.density_values) + 1, 4), np.uint16)
    assert packed.coordinates.dtype == (np.int32 if layout == "wide codes" else np.uint16)
    count = len(tree.density_values)
    for first, end in ((0, 5), (5, count)):
        compute_view_colours(first, end, 0, packed, direction, np.zeros(5), np.float32(2), tree.degree, bits)
    order, colours = packed.voxel_of[:-1], bits.view(np.float16)
    assert np.array_equal(colours[:-1, 0], (2 * tree.density_values[order]).astype(np.float16))
    away = voxel_coordinates(tree)[order] + 0.5 - centre
    basis = basis_numpy(away / np.linalg.norm(away, axis=1, keepdims=True), degree)
    np.testing.assert_allclose(colours[:-1, 1:], np.einsum("nk,nkc->nc", basis, tree.sh[order]), atol=1e-4, rtol=2**-11)
    assert not bits[-1].any()


def half_kernels():  # type: ignore[no-untyped-def]
    """Rounding to half floats, and sums of pairs of groups of four, compiled now."""

    @numba.njit(error_model="numpy")
    def rounded(values, out):  # type: ignore[no-untyped-def]
        for n in range(0, len(values), 4):
            store_halves4(pointer(out), n, pack4(values[n], values[n + 1], values[n + 2], values[n + 3]))

    @numba.njit(error_model="numpy")
    def mixed(weights, bits, at, out):  # type: ignore[no-untyped-def]
        for n, channel in enumerate(mix_pairs(pointer(weights), pointer(at), pointer(bits))):
            lanes.store_lanes(pointer(out), LANES * n, channel)

    return rounded, mixed


@pytest.mark.parametrize("converts", [True, False], ids=["as the processor does", "by integers"])
def test_half_floats_are_numpys(converts: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    if not converts:
        monkeypatch.setattr(halves, "_converts", lambda: False)
    rounded, mixed = half_kernels()
    rng = np.random.default_rng(3)
    every = np.arange(2**16, dtype=np.uint16)
    every = every[np.isfinite(every.view(np.float16))].view(np.float16).astype(np.float32)
    middles = (every[:-1] + every[1:]) / 2
    odd = np.array([np.nan, np.inf, -np.inf, 65519.0, -65519.0, 3e38, -0.0, 0.0], np.float32)
    values = np.concatenate([every, middles, rng.normal(size=4000) * 10.0 ** rng.uniform(-6, 4, 4000), odd]).astype(np.float32)
    values = values[: len(values) // 4 * 4]
    bits = np.zeros(len(values), np.uint16)
    rounded(values, bits)
    expected = np.clip(np.where(np.isnan(values), -halves.GREATEST, values), -halves.GREATEST, halves.GREATEST).astype(np.float16)
    assert np.array_equal(bits, expected.view(np.uint16))
    weights, groups, out = rng.random((4, LANES, 2)).astype(np.float32), expected.reshape(-1, 4).astype(np.float64), np.zeros((4, LANES), np.float32)
    for at in rng.integers(0, len(bits) // 4 - 1, (20, 4, LANES)).astype(np.int32):
        mixed(weights, bits, at, out)
        eight = np.stack([groups[at], groups[at + 1]], axis=2)
        exact = np.einsum("nlr,nlrc->cl", weights, eight)
        assert (np.abs(out - exact) <= 1e-6 * (np.abs(exact) + np.abs(eight).max(axis=(0, 2, 3)))).all()


def lane_kernels(load, mask, count):  # type: ignore[no-untyped-def]
    """What operators on so many lanes make of two rows of `floats`, and which lanes are less, compiled now."""

    @numba.njit(error_model="numpy")
    def in_lanes(floats, ints, bytes_, words, out):  # type: ignore[no-untyped-def]
        x, y = load(pointer(floats), 0), load(pointer(floats), count)
        less = (x < y) & (x > np.float32(0)) | ~(y >= np.float32(-1))
        whole = lanes.to_ints(lanes.abs_lanes(x) + lanes.ceil_lanes(lanes.abs_lanes(y)))
        masked = (whole + 3) * whole - 1 & 255 | whole >> 1
        values = (
            lanes.select_lanes(less, x * y + np.float32(2), lanes.floor_lanes(x) - y), lanes.min_lanes(x, y) / lanes.max_lanes(x, np.float32(0.5)),
            lanes.to_floats(masked + (1 << whole)), lanes.to_floats(lanes.popcount_lanes(masked)), lanes.sqrt_lanes(lanes.abs_lanes(x)),
            lanes.to_floats(lanes.gather_lanes(pointer(ints), whole & 7)), lanes.to_floats(lanes.gather_lanes(pointer(bytes_), whole & 7)),
            lanes.gather_lanes(pointer(floats), whole & 31), lanes.exp2_neg_lanes(lanes.abs_lanes(y)), lanes.to_floats(load(pointer(words), 1)),
            lanes.select_lanes(mask(40), x, np.float32(0)),
        )  # fmt: skip
        for n in range(11):
            lanes.store_lanes(pointer(out), count * n, values[n])
        return lanes.bits_of(less), lanes.lowest_bit(lanes.bits_of(mask(40)))

    return in_lanes


@pytest.mark.parametrize("count", [16, 32])
def test_operators_on_lanes_are_numpys(count: int) -> None:
    rng = np.random.default_rng(0)
    floats, out = rng.normal(0, 3, 2 * count).astype(np.float32), np.zeros((11, count), np.float32)
    ints, bytes_ = rng.integers(-(2**20), 2**20, 8).astype(np.int32), rng.integers(0, 256, 8).astype(np.uint8)
    words = rng.integers(0, 2**16, count + 1).astype(np.uint16)
    kernel = lane_kernels(lanes.load16, lanes.mask16, 16) if count == 16 else lane_kernels(lanes.load32, lanes.mask32, 32)
    bits, lowest = kernel(floats, ints, bytes_, words, out)
    x, y = floats.reshape(2, count)
    less = (x < y) & (x > 0) | ~(y >= -1)
    whole = (np.abs(x) + np.ceil(np.abs(y))).astype(np.int32)
    masked = (whole + 3) * whole - 1 & 255 | whole >> 1
    expected = [
        np.where(less, x * y + 2, np.floor(x) - y), np.minimum(x, y) / np.maximum(x, 0.5), masked + (1 << whole), [bin(n).count("1") for n in masked],
        np.sqrt(np.abs(x)), ints[whole & 7], bytes_[whole & 7], floats[whole & 31], np.exp2(-np.abs(y)), words[1:], np.where(40 >> np.arange(count) & 1, x, 0),
    ]  # fmt: skip
    np.testing.assert_allclose(out, np.array(expected, np.float32), rtol=1e-6, atol=1e-6)
    assert (bits, lowest) == (int((less.astype(np.int64) << np.arange(count)).sum()), 3)


@numba.njit(error_model="numpy")
def in_groups(floats, ints, at, out):  # type: ignore[no-untyped-def]
    """What comes of groups of four and of two numbers of a packet."""
    a, b, c, d = groups.channels(pointer(floats), 0)
    lanes.store_lanes(pointer(out), 0, a - b + c * d)
    groups.store_pairs(pointer(out), LANES, a, b)
    groups.store_channels(pointer(out), 3 * LANES, a, b, c, d)
    e, f = groups.gather_pairs(pointer(ints), pointer(at), 0)
    g, h, i, j = groups.gather_fours(pointer(ints), pointer(at), 0)
    for n, value in enumerate((e, f, g, h, i, j)):
        lanes.store_lanes(pointer(out), (7 + n) * LANES, lanes.to_floats(value))


def test_groups_of_numbers_go_into_lanes_and_back() -> None:
    rng = np.random.default_rng(1)
    floats, ints, out = rng.normal(size=(LANES, 4)).astype(np.float32), rng.integers(-9999, 9999, 50).astype(np.int32), np.zeros(13 * LANES, np.float32)
    at = rng.integers(0, 46, LANES).astype(np.int32)
    in_groups(floats.reshape(-1), ints, at, out)
    a, b, c, d = floats.T
    np.testing.assert_allclose(out[:LANES], a - b + c * d, rtol=1e-6, atol=1e-6)
    assert np.array_equal(out[LANES : 3 * LANES].reshape(-1, 2), floats[:, :2])
    assert np.array_equal(out[3 * LANES : 7 * LANES], floats.reshape(-1))
    assert np.array_equal(out[7 * LANES :].reshape(6, -1), [ints[at + n] for n in (0, 1, 0, 1, 2, 3)])


@numba.njit(error_model="numpy")
def in_doubles(doubles, floats, ints, rows, out):  # type: ignore[no-untyped-def]
    """What operators on lanes of float64 make of two rows of them; rows of eight of the first as float32 and of the three of `floats`; the sum of `ints`."""
    x, y = lanes.load32(pointer(doubles), 0), lanes.load32(pointer(doubles), LANES)
    chosen = lanes.select_lanes((x < y) & (y != 0.5), 1.0 / x - y, lanes.max_lanes(x * 3.0, lanes.floor_lanes(y)))
    lanes.store_lanes(pointer(out), 0, chosen + lanes.sqrt_lanes(lanes.abs_lanes(x)) * lanes.sqrt_lanes(2.0))
    lanes.store_lanes(pointer(out), LANES, lanes.to_doubles(lanes.to_floats(y)) + lanes.lane_numbers() + lanes.broadcast32(0.25))
    a, b, c = lanes.load32(pointer(floats), 0), lanes.load32(pointer(floats), LANES), lanes.load32(pointer(floats), 2 * LANES)
    groups.store_rows(pointer(rows), 1, 30, lanes.to_floats(x))
    groups.store_rows_of_three(pointer(rows), 200, 40, a, b, c)
    return lanes.sum_lanes(lanes.load32(pointer(ints), 0))


def test_lanes_of_float64_and_rows_of_pixels() -> None:
    rng = np.random.default_rng(2)
    doubles, floats, out = rng.normal(0, 3, 2 * LANES), rng.normal(size=3 * LANES).astype(np.float32), np.zeros((2, LANES))
    ints, rows = rng.integers(-9999, 9999, LANES).astype(np.int32), np.zeros(360, np.float32)
    assert in_doubles(doubles, floats, ints, rows, out) == ints.sum()
    x, y = doubles.reshape(2, LANES)
    np.testing.assert_array_equal(out[0], np.where(x < y, 1 / x - y, np.maximum(x * 3, np.floor(y))) + np.sqrt(np.abs(x)) * np.sqrt(2.0))
    np.testing.assert_array_equal(out[1], y.astype(np.float32).astype(np.float64) + np.arange(LANES) + 0.25)
    expected = np.zeros(360, np.float32)
    for row in range(4):
        expected[1 + 30 * row :][:8] = x[8 * row :][:8]
        expected[200 + 40 * row :][:24] = floats.reshape(3, LANES)[:, 8 * row :][:, :8].T.reshape(-1)
    np.testing.assert_array_equal(rows, expected)


@pytest.mark.parametrize(("shape", "share"), [((7, 5, 6), 0.3), ((1, 9, 2), 0.0), ((270, 1, 1), 0.02)])
def test_leaps_in_eight_directions_are_the_sides_of_empty_cubes(shape: tuple[int, int, int], share: float) -> None:
    occupied = np.random.default_rng(5).random(shape) < share
    leap, at = octant_leaps(occupied), np.argwhere(occupied)
    for octant in range(8):
        signs = np.array([1 if octant >> axis & 1 else -1 for axis in range(3)])
        for cell in np.ndindex(shape):
            ahead = (at - cell) * signs
            ahead = ahead[(ahead >= 0).all(axis=1)]
            assert leap[(octant, *cell)] == min(ahead.max(axis=1).min() if len(ahead) else 255, 255)


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
