"""The rasteriser's kernels against plain torch: values and gradients."""

from dataclasses import replace

import numpy as np
import pytest

from efficientnerf.backends.numba.runtime import numba
from efficientnerf.backends.numba.splats import fitting, raster
from efficientnerf.backends.numba.splats.fit import SplatFit, grouped, projected, ungrouped
from efficientnerf.backends.numba.splats.projection import LANES, project
from efficientnerf.backends.numba.vector.memory import pointer
from efficientnerf.backends.splat_layout import DRAWS, GRADIENTS, OPACITY, RECORD, SCALE, SUMS, VISITS, Picture, SplatState
from efficientnerf.geometry import cameras
from efficientnerf.splats.gaussians import Gaussians
from efficientnerf.splats.refit import MOST_FADE, NOISE, rates_of
from efficientnerf.splats.rendering import gaussians_from, lens_of, render, values_of
from tests.efficientnerf.splats_reference import (
    HEIGHT,
    LENSES,
    WIDTH,
    camera,
    covariances,
    picture_of,
    reference_loss,
    render_reference,
    some_gaussians,
    tensors,
)


@pytest.mark.parametrize(("degree", "size"), [(0, 0.05), (1, 0.2), (2, 1.0), (3, 0.2)])
def test_images_are_those_of_the_plain_sums(degree: int, size: float) -> None:
    gaussians = some_gaussians(degree=degree, size=size)
    image = render(gaussians, camera())
    colour, light = render_reference(*tensors(gaussians), camera())
    np.testing.assert_allclose(image.colour, colour.detach(), atol=2e-4)
    np.testing.assert_allclose(image.opacity, 1 - light.detach(), atol=2e-4)
    assert image.opacity.max() > 0.5


@numba.njit(error_model="numpy")
def step_gradients(values, lens, degree, first, sums, out):  # type: ignore[no-untyped-def]
    """What `fitting.step` goes along: out like values."""
    rows = values.shape[1]
    total, basis, gradient = np.empty(16 * (SUMS + 1), np.float32), np.empty(16 * 16, np.float32), np.empty(16 * rows, np.float32)
    for group in range(values.shape[0]):
        fitting._gather_sums(group, first, sums, total)
        at = np.int64(group) * rows * LANES
        fitting._geometry_gradients(pointer(values), at, lens, pointer(total), pointer(gradient))
        fitting._colour_gradients(pointer(values), at, lens, degree, pointer(total), pointer(basis), pointer(gradient))
        for row in range(rows):
            for lane in range(LANES):
                out[group, row, lane] = gradient[16 * row + lane]


def gradients_of(gaussians: Gaussians, picture: Picture) -> tuple[np.ndarray, np.ndarray]:
    """By the Gaussians' values, in rows; and the squared errors of tiles."""
    values, lens = grouped(values_of(gaussians)), lens_of(camera())
    records = np.zeros((16 * len(values), RECORD), np.float32)
    pairs = projected(values, lens, gaussians.degree, records)
    sums, errors = np.full((len(pairs.gaussian), SUMS), np.nan, np.float32), np.full(len(pairs.begin) - 1, np.nan)
    raster.fit_tiles(slice(0, len(errors)), records, pairs, picture, sums, errors)
    found = np.empty_like(values)
    step_gradients(values, lens, gaussians.degree, pairs.first, sums, found)
    return ungrouped(found, len(gaussians)), errors


@pytest.mark.parametrize(
    ("degree", "over_all", "structure", "huber_delta"), [(2, True, 0.0, np.inf), (3, False, 0.0, 0.2), (0, True, 0.3, 0.2), (1, False, 0.3, np.inf)]
)
def test_gradients_are_those_of_the_plain_sums(degree: int, over_all: bool, structure: float, huber_delta: float) -> None:
    gaussians, picture = some_gaussians(count=53, degree=degree), picture_of(1, over_all, structure, huber_delta)
    rows, errors = gradients_of(gaussians, picture)

    wanted = tensors(gaussians)
    loss = reference_loss(*render_reference(*wanted, camera()), picture)
    loss.backward()
    image = render_reference(*wanted, camera())
    squared = reference_loss(*image, picture._replace(structure=np.float32(0), huber_delta=np.float32(np.inf)))
    assert 0.5 * errors.sum() == pytest.approx(squared.item(), rel=1e-5)
    assert (loss.item() > 1.1 * reference_loss(*image, picture._replace(structure=np.float32(0))).item()) == (structure > 0)
    for name, part, leaf in zip(("means", "scales", "rotations", "logits", "harmonics"), np.split(rows, [3, 6, 10, 11], axis=1), wanted, strict=True):
        gradient = leaf.grad.reshape(len(gaussians), -1).numpy()
        np.testing.assert_allclose(part, gradient, rtol=2e-3, atol=2e-4 * np.abs(gradient).max(), err_msg=name)


def test_what_shows_in_no_pixel_but_ends_one_hides_what_lies_behind_there() -> None:
    view = camera()
    (fx, fy, cx, cy), depths = view.params, np.array([1.0, 1.2, 1.4, 1.6, 1.8])
    towards = view.world_from_camera[:3, :3] @ [(17.5 - cx) / fx, (13.5 - cy) / fy, 1.0]  # the middle of a pixel
    before = 1 - 1.01e-4 ** (1 / 3)  # three leave 1.01e-4 of the light; a fiftieth less ends a pixel, a two hundredth less does not
    scales, opacities = np.array([99.0, 99.0, 99.0, 1e-4, 0.1]), np.array([before, before, before, 0.02, 0.0048])
    colours = np.random.default_rng(2).normal(size=(5, 1, 3))
    parts = view.centre + depths[:, None] * towards, np.repeat(scales[:, None], 3, axis=1), np.tile([1.0, 0, 0, 0], (5, 1)), opacities, colours
    gaussians, picture = Gaussians(*(part.astype(np.float32) for part in parts)), picture_of(1, over_all=False)
    wanted = tensors(gaussians)
    reference_loss(*render_reference(*wanted, view), picture).backward()
    np.testing.assert_allclose(gradients_of(gaussians, picture)[0][4, 11:], wanted[4].grad[4, 0], rtol=2e-3)


def test_a_step_moves_means_by_noise_in_longest_deviations_and_takes_from_opacities() -> None:
    """Of what is in the image; the noise of another step is another one, of the same step the same."""
    gaussians = some_gaussians(count=500, degree=0)
    unseen = np.arange(500) % 5 == 0
    means = np.where(unseen[:, None], camera().centre - camera().forward, gaussians.means).astype(np.float32)
    rows, lens, picture = values_of(replace(gaussians, means=means)), lens_of(camera()), picture_of(0, True)

    def after(fade: float, noise: float, number: int) -> SplatState:
        fit = SplatFit(rows, np.zeros((len(rows), GRADIENTS + rows.shape[1]), np.float32), 0)
        fit.step(lens, picture, rates_of(0.0, 0.004, seed=3, number=number)._replace(fade=np.float32(fade), noise=np.float32(noise)))
        return fit.state()

    still, moments, _errors = after(0.0, 0.0, 1)
    moved = moments[:, VISITS] > 0
    assert 100 < moved.sum() <= 400
    assert not moved[unseen].any()
    by = after(MOST_FADE, NOISE, 1).rows - still
    np.testing.assert_allclose(by[:, OPACITY], np.where(moved, -MOST_FADE, 0), atol=1e-5)
    noise = by[moved, :3] / np.exp(rows[moved, SCALE : SCALE + 3]).max(axis=1, keepdims=True) / NOISE
    assert abs(noise.mean()) < 0.15
    assert noise.std() == pytest.approx(1, abs=0.1)
    assert len(np.unique(noise.round(4))) > 0.9 * noise.size
    np.testing.assert_array_equal(np.delete(by, [0, 1, 2, OPACITY], axis=1), 0)
    np.testing.assert_array_equal(by[~moved], 0)
    np.testing.assert_array_equal(after(MOST_FADE, NOISE, 1).rows - still, by)
    assert (after(MOST_FADE, NOISE, 2).rows - still != by)[moved, :3].mean() > 0.9


def test_noise_of_a_step_begins_at_any_of_the_numbers_that_are_drawn() -> None:
    shifts = [rates_of(0.0, 0.004, number=number).shift for number in range(100)]
    assert len(set(shifts)) > 95
    assert max(shifts) > 0.9 * DRAWS
    draws = rates_of(0.0, 0.004).draws
    np.testing.assert_array_equal(draws[DRAWS:], draws[: 3 * LANES])
    assert (draws != rates_of(0.0, 0.004, seed=1).draws).any()


@pytest.mark.parametrize(("model", "extra"), LENSES)
def test_a_small_gaussian_lands_where_the_lens_sends_its_points(model: str, extra: tuple[float, ...]) -> None:
    lens, rng = camera(model, extra), np.random.default_rng(0)
    one = some_gaussians(count=1)
    pixels = np.array([[9.0, 7.0], [30.0, 20.0], [18.3, 13.1]])
    origins, directions = cameras.rays(lens, pixels)
    means = (origins + 3 * directions).astype(np.float32)
    scales = np.array([[0.3, 0.1, 0.02]], np.float32)
    gaussians = replace(one.subset(np.zeros(3, int)), means=means, scales=np.repeat(scales, 3, axis=0))
    records = np.zeros((16, RECORD), np.float32)
    project(grouped(values_of(gaussians)), lens_of(lens), 3, records)
    np.testing.assert_allclose(records[:3, :2], pixels, atol=2e-3)
    for n in range(3):
        points = rng.multivariate_normal(np.zeros(3), covariances(gaussians)[n], 4000) * 1e-3 + means[n]
        seen, _ = cameras.project(lens, points)
        conic = np.array([[records[n, 2], records[n, 3]], [records[n, 3], records[n, 4]]])
        np.testing.assert_allclose(np.linalg.inv(conic), np.cov(seen.T) * 1e6 + 0.3 * np.eye(2), rtol=0.1, atol=0.3)


def test_what_lies_behind_the_camera_or_beside_the_picture_is_not_rendered() -> None:
    view = camera()
    there = np.stack([view.centre - view.forward, view.centre + 30 * view.up + view.forward, view.centre]).astype(np.float32)
    gaussians = replace(some_gaussians(count=3), means=there, scales=np.full((3, 3), 0.1, np.float32))
    assert render(gaussians, view).opacity.max() == 0


@pytest.mark.parametrize(
    ("far", "wide", "model"),
    [(100.0, 1e-38, "PINHOLE"), (1e10, 1.0, "OPENCV_FISHEYE"), (1e30, 3e38, "PINHOLE"), (3e38, 1e10, "OPENCV_FISHEYE")],
)
def test_whatever_a_file_may_hold_is_rendered_without_harm(far: float, wide: float, model: str) -> None:
    view, gaussians = camera(model, (0.0,) * 4 if model == "OPENCV_FISHEYE" else ()), some_gaussians(count=20)
    places = np.concatenate([view.centre + view.forward * [[0.06], [1], [50]], np.clip(np.random.default_rng(0).normal(size=(17, 3)) * far, -3e38, 3e38)])
    scales = np.tile([wide, 1e-38, 3e38], (20, 1))
    gaussians = replace(gaussians, means=places.astype(np.float32), scales=scales.astype(np.float32), harmonics=gaussians.harmonics * np.float32(1e3))
    image = render(gaussians, view)
    assert np.isfinite(image.colour).all()
    assert image.opacity.min() >= 0
    assert image.opacity.max() <= 1


def test_pairs_name_the_blocks_that_a_gaussian_touches_and_few_others() -> None:
    """Needles along diagonals too, whose boxes are nearly empty."""
    gaussians = some_gaussians(count=200, degree=0)
    scales = gaussians.scales * np.array([8, 1, 0.1], np.float32)
    values = grouped(values_of(Gaussians(gaussians.means, scales, gaussians.rotations, gaussians.opacities, gaussians.harmonics)))
    records = np.zeros((LANES * len(values), RECORD), np.float32)
    pairs = projected(values, lens_of(camera()), 0, records)
    y, x = np.mgrid[: 16 * -(-HEIGHT // 16), : 16 * pairs.columns] + 0.5
    named = touched = boxed = 0
    for tile in range(len(pairs.begin) - 1):
        row, column = divmod(tile, pairs.columns)
        part = np.s_[16 * row : 16 * row + 16, 16 * column : 16 * column + 16]
        for pair in range(pairs.begin[tile], pairs.begin[tile + 1]):
            at = records[pairs.gaussian[pair]].astype(np.float64)
            dx, dy = x[part] - at[0], y[part] - at[1]
            strength = at[5] * np.exp(-0.5 * (at[2] * dx * dx + 2 * at[3] * dx * dy + at[4] * dy * dy))
            meets = (strength >= 1 / 255).reshape(4, 4, 4, 4).any(axis=(1, 3)).reshape(16)
            bits = (int(pairs.mask[pair]) >> np.arange(16) & 1).astype(bool)
            assert (bits | ~meets).all()
            boxed += int(((np.abs(dx) < at[9]) & (np.abs(dy) < at[10])).reshape(4, 4, 4, 4).any(axis=(1, 3)).sum())
            named, touched = named + int(bits.sum()), touched + int(meets.sum())
    assert 500 < touched <= named < 1.2 * touched
    assert named < 0.8 * boxed


def test_tiles_rendered_in_pieces_are_the_whole_and_ties_keep_their_order() -> None:
    gaussians = some_gaussians(count=40)
    twice = gaussians.subset(np.tile(np.arange(40), 2))
    records = np.zeros((80, RECORD), np.float32)
    pairs = projected(grouped(values_of(twice)), lens_of(camera()), 3, records)
    depth = records[pairs.gaussian, 11]
    for begin, end in zip(pairs.begin[:-1], pairs.begin[1:], strict=True):
        key = list(zip(depth[begin:end].tolist(), pairs.gaussian[begin:end].tolist(), strict=True))
        assert key == sorted(key)
    assert sorted(pairs.slot.tolist()) == list(range(len(pairs.slot)))
    colour, light = np.empty((HEIGHT, WIDTH, 3), np.float32), np.empty((HEIGHT, WIDTH), np.float32)
    for tile in range(len(pairs.begin) - 1):
        raster.render_tiles(slice(tile, tile + 1), records, pairs, colour, light)
    whole = render(twice, camera())
    assert (whole.colour == colour).all()
    assert (whole.opacity == 1 - light).all()


def test_groups_hold_what_was_put_in() -> None:
    gaussians = some_gaussians(count=21, degree=1)
    back = gaussians_from(ungrouped(grouped(values_of(gaussians)), 21))
    for name in ("means", "scales", "rotations", "opacities", "harmonics"):
        np.testing.assert_allclose(getattr(back, name), getattr(gaussians, name), rtol=1e-5, atol=1e-6)
