"""Stereo on pictures of textured walls of which the truth is known, and costs against slow ones."""

import numba
import numpy as np
import pytest
from scipy.ndimage import map_coordinates

from efficientnerf.backends.numba import stereo as kernel
from efficientnerf.capture.stereo import PIXELS, SOURCES, DensePoints, Picture, choose_sources, dense_points, undistorted
from efficientnerf.geometry.cameras import Camera, project
from tests.efficientnerf.capture.textured import HEIGHT, PARALLAX, WALL, WIDTH, cameras, off, photograph, sparse


def found(pictures: list[Picture], made: list[Camera]) -> list[DensePoints]:
    xyz, seen = sparse(made)
    return list(dense_points(pictures, choose_sources(np.array([c.centre for c in made]), xyz, seen), xyz, seen, lambda share: None))


def test_points_lie_on_the_surfaces_also_where_there_are_no_sparse_points() -> None:
    made = cameras()
    dense = found([undistorted(photograph(camera), camera) for camera in made], made)
    for each in dense:
        assert len(each.xyz) > 0.6 * WIDTH * HEIGHT
        assert np.percentile(off(each.xyz), 50) < PARALLAX / 3
        assert np.percentile(off(each.xyz), 95) < 1.5 * PARALLAX
        assert (np.abs(each.xyz[:, 1] - WALL) < PARALLAX).mean() > 0.15, "the wall is found without a sparse point on it"
        assert each.confirmed.any(axis=1).all()


def test_two_photographs_are_enough_and_one_is_not() -> None:
    made = cameras(2)
    pictures = [undistorted(photograph(camera), camera) for camera in made]
    assert all(len(each.xyz) > 0.4 * WIDTH * HEIGHT for each in found(pictures, made))
    assert not len(found(pictures[:1], made[:1])[0].xyz)


def test_a_gradient_gives_no_points() -> None:
    made = cameras()
    assert not sum(len(each.xyz) for each in found([undistorted(photograph(camera, contrast=0.1), camera) for camera in made], made))


def test_photographs_of_something_else_give_hardly_any_points() -> None:
    made = cameras()
    pictures = [undistorted(np.random.default_rng(n).integers(0, 256, (HEIGHT, WIDTH), np.uint8), camera) for n, camera in enumerate(made)]
    assert all(len(each.xyz) < 0.05 * WIDTH * HEIGHT for each in found(pictures, made))


def test_a_photograph_that_observes_too_few_sparse_points_has_none() -> None:
    made = cameras()
    xyz, seen = sparse(made)
    seen[1, 5:] = False
    pictures = [undistorted(photograph(camera), camera) for camera in made]
    dense = list(dense_points(pictures, choose_sources(np.array([c.centre for c in made]), xyz, seen), xyz, seen, lambda share: None))
    assert not len(dense[1].xyz)
    assert len(dense[2].xyz)


def test_the_number_of_threads_changes_no_byte() -> None:
    made = cameras(3)
    pictures = [undistorted(photograph(camera), camera) for camera in made]
    threads = numba.get_num_threads()
    both = found(pictures, made)
    numba.set_num_threads(1)
    try:
        alone = found(pictures, made)
    finally:
        numba.set_num_threads(threads)
    for one, other in zip(both, alone, strict=True):
        assert one.xyz.tobytes() == other.xyz.tobytes()
        assert one.confirmed.tobytes() == other.confirmed.tobytes()


def test_an_undistorted_picture_is_that_of_a_pinhole_camera() -> None:
    camera = cameras()[0]
    picture = undistorted(photograph(camera), camera)
    pinhole = Camera("pinhole", WIDTH, HEIGHT, "SIMPLE_PINHOLE", (150.0, WIDTH / 2, HEIGHT / 2), camera.world_from_camera)
    inner = np.s_[15:-15, 15:-15]
    assert np.abs(picture.grey[inner].astype(float) - photograph(pinhole)[inner]).mean() < 4
    point = np.array([[0.1, 0.3, 0.2]])
    towards = (point - picture.centre) @ picture.rotation @ picture.matrix.T
    np.testing.assert_allclose(towards[0, :2] / towards[0, 2] + 0.5, project(pinhole, point)[0][0])
    large = Camera("large", 900, 1200, camera.model, camera.params, camera.world_from_camera)
    assert undistorted(np.zeros((1200, 900), np.uint8), large).grey.size <= 1.01 * PIXELS


@pytest.mark.parametrize("bend", [0.4, -0.6])
def test_what_the_lens_does_not_show_is_black(bend: float) -> None:
    """With 0.4 the pinhole camera's corners lie beyond the picture, with -0.6 where the lens's model folds back."""
    camera = cameras()[0]
    bent = Camera("bent", WIDTH, HEIGHT, "SIMPLE_RADIAL", (70.0, WIDTH / 2, HEIGHT / 2, bend), camera.world_from_camera)
    grey = undistorted(np.full((HEIGHT, WIDTH), 200, np.uint8), bent).grey
    assert (grey[[0, 0, -1, -1], [0, -1, 0, -1]] == 0).all()
    assert grey[HEIGHT // 2, WIDTH // 2] == 200


@pytest.mark.parametrize("half", [False, True])
def test_pixels_go_to_other_pictures_as_points_do(half: bool) -> None:
    one, other = (undistorted(photograph(camera), camera) for camera in cameras(2))
    one, other = (one.halved(), other.halved()) if half else (one, other)
    turn, shift = one.to(other)
    point = np.array([0.2, 0.1, 0.3])
    own, its = (picture.matrix @ picture.rotation.T @ (point - picture.centre) for picture in (one, other))
    there = turn @ (own / own[2]) + shift / own[2]
    np.testing.assert_allclose(there[:2] / there[2], its[:2] / its[2], rtol=1e-4)


def test_sources_share_points_at_good_angles() -> None:
    angles = np.radians([0, 1, 9, 12, 60, 120])
    centres = np.stack([np.sin(angles), -np.cos(angles), np.zeros(6)], -1)
    xyz = np.random.default_rng(0).normal(scale=0.01, size=(30, 3))
    seen = np.ones((6, 30), bool)
    seen[5] = False
    sources = choose_sources(centres, xyz, seen)
    assert sources.shape == (6, SOURCES)
    assert sources[0, :2].tolist() in ([2, 3], [3, 2])
    assert 5 not in sources[0]
    assert (sources[5] == -1).all()


def test_quads_hold_the_pixels_that_interpolation_needs() -> None:
    grey = np.random.default_rng(0).integers(0, 256, (4, 5), np.uint8)
    quads = kernel.quads_of(grey)
    assert quads.shape == grey.shape
    bytes_ = quads.view(np.uint8).reshape(4, 5, 4)
    assert (bytes_[:-1, :-1] == np.stack([grey[:-1, :-1], grey[:-1, 1:], grey[1:, :-1], grey[1:, 1:]], -1)).all()


def test_random_numbers_fill_the_interval() -> None:
    drawn = np.array([[kernel._uniform(seed, x, y, k) for x in range(20) for y in range(20) for k in range(9)] for seed in range(3)])
    assert ((drawn >= 0) & (drawn < 1)).all()
    assert np.abs(np.histogram(drawn, 10, (0, 1))[0] / drawn.size - 0.1).max() < 0.01
    assert len(np.unique(drawn)) > 0.99 * drawn.size
    assert abs(np.corrcoef(drawn[:, :-1].ravel(), drawn[:, 1:].ravel())[0, 1]) < 0.05


def slow_cost(grey: np.ndarray, x: int, y: int, plane: np.ndarray, maps: np.ndarray, shifts: np.ndarray, others: list[np.ndarray]) -> float:
    """`kernel._cost` in plain NumPy and float64."""
    reach = np.arange(-kernel.REACH, kernel.REACH + 1, kernel.STEP)
    b, a = (offset.ravel() for offset in np.meshgrid(reach, reach, indexing="ij"))
    height, width = grey.shape
    values = grey[np.clip(y + b, 0, height - 1), np.clip(x + a, 0, width - 1)].astype(float)
    weights = np.exp(-np.abs(values - grey[y, x]) / kernel.COLOUR - (a**2 + b**2) / (2 * kernel.SPREAD**2))
    weights /= weights.sum()
    values -= (weights * values).sum()
    pixel = np.stack([x + a, y + b, np.ones_like(a)])
    inverse = plane[0] + plane[1] * a + plane[2] * b
    costs = [1.0, 1.0]
    for turn, shift, other in zip(maps, shifts, others, strict=True):
        at = turn @ pixel + shift[:, None] * inverse
        u, v = at[:2] / at[2]
        if not ((at[2] > 0) & (u >= 0) & (v >= 0) & (u < other.shape[1] - 1) & (v < other.shape[0] - 1)).all():
            continue
        theirs = map_coordinates(other.astype(float), [v, u], order=1)
        variance = (weights * theirs**2).sum() - (weights * theirs).sum() ** 2
        costs.append(1 - (weights * theirs * values).sum() / np.sqrt(variance * (weights * values**2).sum()))
    best, second = sorted(costs)[:2]
    return float(best + 0.5 * min(second - best, kernel.ALONE))


@pytest.mark.parametrize("depth", [2.5, 3.2, 4.0])
def test_costs_are_those_of_a_slow_reference(depth: float) -> None:
    """Of the better of two planes at one inverse depth: a random one, and the one across the axis, which is all that is tried besides it."""
    pictures = [undistorted(photograph(camera), camera) for camera in cameras(3)]
    own, others = pictures[0], pictures[1:]
    maps, shifts = (np.array(part) for part in zip(*[own.to(other) for other in others], strict=True))
    rng = np.random.default_rng(0)
    planes = np.zeros((HEIGHT, WIDTH, 3), np.float32)
    inverse = planes[..., 0] = np.float32(1 / depth)
    planes[..., 1:] = rng.uniform(-0.004, 0.004, (HEIGHT, WIDTH, 2))
    guess, cost = planes.astype(float), np.full((HEIGHT, WIDTH), kernel.WORST, np.float32)
    quads = np.concatenate([kernel.quads_of(other.grey).ravel() for other in others])
    starts, shapes = np.array([0, others[0].grey.size]), np.array([other.grey.shape for other in others])
    level = np.float32(1e12)  # a focal length at which a random plane is across the axis
    kernel.improve_planes(own.grey.astype(np.float32), inverse, inverse, level, 0, maps, shifts, quads, starts, shapes, planes, cost)
    compared = 0
    for _ in range(200):
        x, y = int(rng.integers(WIDTH)), int(rng.integers(HEIGHT))
        across = np.array([guess[y, x, 0], 0, 0])
        both = [slow_cost(own.grey, x, y, plane, maps.astype(float), shifts.astype(float), [other.grey for other in others]) for plane in (guess[y, x], across)]
        if cost[y, x] < 1:
            assert cost[y, x] == pytest.approx(min(both), abs=2e-3)
            compared += 1
        else:
            assert min(both) > 1 - 2e-3 or cost[y, x] == kernel.WORST
    assert compared > 50
