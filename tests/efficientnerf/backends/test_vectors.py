"""Vectors inside numba kernels against numpy: operators, functions, sums over the lanes, loads and stores, half floats, corners."""

import numba
import numpy as np
import pytest

from efficientnerf.backends.numba.vector import halves, maths, memory
from efficientnerf.backends.numba.vector.corners import mix_corners, spread_corners
from efficientnerf.backends.numba.vector.halves import mix_pairs, store_halves
from efficientnerf.backends.numba.vector.memory import load, pointer, store

LANES = 32


@numba.njit
def logistics(a, b, c, d):  # type: ignore[no-untyped-def]
    return maths.unpack(maths.sigmoid(maths.pack((a, b, c, d))))


@numba.njit
def power(x):  # type: ignore[no-untyped-def]
    return maths.exp2_neg(x)


@numba.njit
def powers(a, b, c, d):  # type: ignore[no-untyped-def]
    return maths.unpack(maths.exp2_neg(maths.pack((a, b, c, d))))


def test_the_kernels_exponential_and_logistic() -> None:
    x = np.concatenate([np.linspace(0, 5, 3000), np.geomspace(1e-9, 1e30, 402), [0.0, np.inf]]).astype(np.float32)
    np.testing.assert_allclose([power(v) for v in x], np.exp2(-x.astype(np.float64)), atol=2e-7)
    assert power(np.float32(0)) == 1
    np.testing.assert_allclose([powers(*v) for v in x.reshape(-1, 4)], np.exp2(-x.astype(np.float64)).reshape(-1, 4), atol=2e-7)
    assert powers(*np.zeros(4, np.float32)) == (1, 1, 1, 1)
    y = np.concatenate([-x, x, np.linspace(-20, 20, 2000).astype(np.float32)])
    with np.errstate(over="ignore"):
        np.testing.assert_allclose([logistics(*v) for v in y.reshape(-1, 4)], 1 / (1 + np.exp(-y.astype(np.float64).reshape(-1, 4))), atol=4e-6)


def half_kernels():  # type: ignore[no-untyped-def]
    """Rounding to half floats, and sums of pairs of groups of four, compiled now."""

    @numba.njit(error_model="numpy")
    def rounded(values, out):  # type: ignore[no-untyped-def]
        for n in range(0, len(values), 4):
            store_halves(pointer(out), n, maths.pack((values[n], values[n + 1], values[n + 2], values[n + 3])))

    @numba.njit(error_model="numpy")
    def mixed(weights, bits, at, out):  # type: ignore[no-untyped-def]
        for n, channel in enumerate(mix_pairs(pointer(weights), pointer(at), pointer(bits), LANES)):
            store(pointer(out), LANES * n, channel)

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


def lane_kernels(count):  # type: ignore[no-untyped-def]
    """What operators on so many lanes make of two rows of `floats`, and which lanes are less, compiled now."""

    @numba.njit(error_model="numpy")
    def in_lanes(floats, ints, bytes_, words, out):  # type: ignore[no-untyped-def]
        x, y = load(pointer(floats), 0, count), load(pointer(floats), count, count)
        less = (x < y) & (x > np.float32(0)) | ~(y >= np.float32(-1))
        whole = maths.to_int32(maths.absolute(x) + maths.ceil(maths.absolute(y)))
        masked = (whole + 3) * whole - 1 & 255 | whole >> 1
        values = (
            maths.select(less, x * y + np.float32(2), maths.floor(x) - y), maths.minimum(x, y) / maths.maximum(x, np.float32(0.5)),
            maths.to_float32(masked + (1 << whole)), maths.to_float32(maths.popcount(masked)), maths.sqrt(maths.absolute(x)),
            maths.to_float32(memory.gather(pointer(ints), whole & 7)), maths.to_float32(memory.gather(pointer(bytes_), whole & 7)),
            memory.gather(pointer(floats), whole & 31), maths.exp2_neg(maths.absolute(y)), maths.to_float32(load(pointer(words), 1, count)),
            maths.select(maths.mask_of(40, count), x, np.float32(0)),
        )  # fmt: skip
        for n in range(11):
            store(pointer(out), count * n, values[n])
        return maths.bits_of(less), maths.lowest_bit(maths.bits_of(maths.mask_of(40, count)))

    return in_lanes


@pytest.mark.parametrize("count", [16, 32])
def test_operators_on_lanes_are_numpys(count: int) -> None:
    rng = np.random.default_rng(0)
    floats, out = rng.normal(0, 3, 2 * count).astype(np.float32), np.zeros((11, count), np.float32)
    ints, bytes_ = rng.integers(-(2**20), 2**20, 8).astype(np.int32), rng.integers(0, 256, 8).astype(np.uint8)
    words = rng.integers(0, 2**16, count + 1).astype(np.uint16)
    bits, lowest = lane_kernels(count)(floats, ints, bytes_, words, out)
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
    a, b, c, d = memory.load_groups(pointer(floats), 0, 4, LANES)
    store(pointer(out), 0, a - b + c * d)
    memory.store_groups(pointer(out), LANES, (a, b))
    memory.store_groups(pointer(out), 3 * LANES, (a, b, c, d))
    e, f = memory.gather_groups(pointer(ints), pointer(at), 0, 2, LANES)
    g, h, i, j = memory.gather_groups(pointer(ints), pointer(at), 0, 4, LANES)
    for n, value in enumerate((e, f, g, h, i, j)):
        store(pointer(out), (7 + n) * LANES, maths.to_float32(value))


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
    x, y = load(pointer(doubles), 0, LANES), load(pointer(doubles), LANES, LANES)
    chosen = maths.select((x < y) & (y != 0.5), 1.0 / x - y, maths.maximum(x * 3.0, maths.floor(y)))
    store(pointer(out), 0, chosen + maths.sqrt(maths.absolute(x)) * maths.sqrt(2.0))
    store(pointer(out), LANES, maths.to_float64(maths.to_float32(y)) + maths.lane_numbers(LANES) + maths.broadcast(0.25, LANES))
    a, b, c = load(pointer(floats), 0, LANES), load(pointer(floats), LANES, LANES), load(pointer(floats), 2 * LANES, LANES)
    memory.store_rows(pointer(rows), 1, 30, (maths.to_float32(x),), 8)
    memory.store_rows(pointer(rows), 200, 40, (a, b, c), 8)
    return maths.sum_lanes(load(pointer(ints), 0, LANES))


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


@numba.njit(error_model="numpy")
def summed(floats, ints, out):  # type: ignore[no-untyped-def]
    x, y = load(pointer(floats), 0, 16), load(pointer(floats), 16, 16)
    store(pointer(out), 0, maths.sum_each((x, y, x * y)))
    memory.store_first(pointer(out), 16, memory.load_first(pointer(floats), 3, 5, 16) + np.float32(1), 7)
    store(pointer(out), 32, memory.load_cycle(pointer(floats), 2, 4, 16))
    return maths.sum_lanes(x), maths.sum_lanes(load(pointer(ints), 0, 16))


def test_sums_over_lanes_parts_of_vectors_and_cycles() -> None:
    rng = np.random.default_rng(4)
    floats, ints, out = rng.normal(size=32).astype(np.float32), rng.integers(-99, 99, 16).astype(np.int32), np.full(48, -5, np.float32)
    total, whole = summed(floats, ints, out)
    x, y = floats.reshape(2, 16)
    np.testing.assert_allclose(out[:3], [x.sum(), y.sum(), (x * y).sum()], rtol=1e-5, atol=1e-5)
    assert total == out[0]
    assert whole == ints.sum()
    assert not out[3:16].any()
    np.testing.assert_array_equal(out[16:23], [*(floats[3:8] + np.float32(1)), 1, 1])
    assert (out[23:32] == -5).all()
    np.testing.assert_array_equal(out[32:], floats[2:5][(4 + np.arange(16)) % 3])


@numba.njit(error_model="numpy")
def functions(floats, out):  # type: ignore[no-untyped-def]
    x = load(pointer(floats), 0, 32)
    store(pointer(out), 0, maths.exp(x))
    store(pointer(out), 32, maths.arctangent(maths.absolute(x)))
    store(pointer(out), 64, maths.fma(x, np.float32(3), x))


def test_exponentials_and_arc_tangents() -> None:
    x, out = np.random.default_rng(5).normal(0, 9, 32).astype(np.float32), np.zeros(96, np.float32)
    functions(x, out)
    exact = x.astype(np.float64)
    np.testing.assert_allclose(out[:32], np.exp(exact), rtol=3e-6)
    np.testing.assert_allclose(out[32:64], np.arctan(np.abs(exact)), atol=4e-7)
    np.testing.assert_allclose(out[64:], 4 * exact, rtol=1e-6)


@numba.njit(error_model="numpy")
def at_corners(values, index, weights, at, stride, pair, four):  # type: ignore[no-untyped-def]
    """Of groups of two, and of four, which are then added back."""
    two = mix_corners(pointer(values), pointer(index), pointer(weights), at, stride, 2)
    many = mix_corners(pointer(values), pointer(index), pointer(weights), at, stride, 4)
    spread_corners(pointer(pair), pointer(index), pointer(weights), at, stride, two)
    spread_corners(pointer(four), pointer(index), pointer(weights), at, stride, many)
    return two, many


@pytest.mark.parametrize(("at", "stride"), [(3, 1), (2, 5)])
@pytest.mark.parametrize("kind", [np.float32, np.float64])
@pytest.mark.parametrize("integer", [np.int32, np.uint32])
def test_corners_are_mixed_and_spread_by_their_weights(at: int, stride: int, kind: type, integer: type) -> None:
    rng = np.random.default_rng(6)
    values, weights, index = rng.normal(size=48).astype(kind), rng.random(48).astype(kind), rng.integers(0, 6, 48).astype(integer)
    pair, four = np.zeros(48, kind), np.zeros(48, kind)
    two, many = at_corners(values, index, weights, at, stride, pair, four)
    eight = at + stride * np.arange(8)
    for found, size, back in ((two, 2, pair), (many, 4, four)):
        groups, expected = values.reshape(-1, size)[index[eight]], np.zeros((48 // size, size))
        np.testing.assert_allclose(found, weights[eight] @ groups, rtol=1e-5, atol=1e-6)
        np.add.at(expected, index[eight], weights[eight, None] * np.array(found))
        np.testing.assert_allclose(back.reshape(-1, size), expected, rtol=1e-5, atol=1e-6)
